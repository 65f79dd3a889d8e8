"""YAML files to validated, frozen records, and these to the objects of the package.

A mistake in a file is one `ConfigError` of one line: the file, the path of the key, what was expected, what came.
Nothing here imports torch before something is built, so that a wrong file is refused at once.

`ObserveConfig` is the file of `torchfsid observe`. Other files' models are made of the same pieces: `Strict`,
`TaskConfig`, `BarrierConfig`, `PriorConfig`, `NoiseConfig`, `UkfConfig`.
"""

from __future__ import annotations

import difflib
import re
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from torchfsid.errors import ConfigError

if TYPE_CHECKING:
    from torchfsid.barriers import Barrier
    from torchfsid.inverse_optimal import NoiseBound
    from torchfsid.tasks import Task


def _wrong(message: str, key: object = None) -> PydanticCustomError:
    """An error whose message is complete; `key` is the part of the section that it is about."""
    return PydanticCustomError("complete", "{message}", {"message": message, "key": key})


def _number(value: object) -> object:
    """PyYAML takes 1e-6, a number without a dot, for text."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _name(value: object) -> object:
    """Bodies are named by text; a whole number stands for the text that writes it."""
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    if not isinstance(value, str) or not value:
        raise _wrong(f"expected a name, got {reprlib.repr(value)} (put names in quotes)")
    return value


Number = Annotated[float, BeforeValidator(_number), Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Flag = Annotated[bool, Field(strict=True)]
BodyName = Annotated[str, BeforeValidator(_name)]
Vector = Annotated[tuple[Number, ...], Field(min_length=1)]
PlanarVector = Annotated[tuple[Number, ...], Field(min_length=2, max_length=2)]


class Strict(BaseModel):
    """A section of a file: frozen, and a key that it does not know is an error with a guess at what was meant."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _knows_its_keys(cls, data: Any) -> Any:
        for key in data if isinstance(data, Mapping) else ():
            if key not in cls.model_fields:
                guess = difflib.get_close_matches(str(key), cls.model_fields, n=1)
                hint = f"did you mean '{guess[0]}'?" if guess else f"known keys: {', '.join(cls.model_fields)}"
                raise _wrong(f"unknown key ({hint})", key)
        return data


class _Task(Strict):
    @property
    def parameters(self) -> int:
        """p, the number of entries of theta."""
        return 2

    def build(self, bodies: Sequence[str]) -> Task:
        """The task, for a team of these bodies; `ConfigError` if it needs one that is not there."""
        raise NotImplementedError


class GoalConfig(_Task):
    """`GoalTask`: go to a goal with a known gain [1/s]."""

    kind: Literal["goal"] = "goal"
    gain: Positive

    def build(self, bodies: Sequence[str]) -> Task:
        from torchfsid.tasks import GoalTask

        return GoalTask(self.gain)


class UnknownGainGoalConfig(_Task):
    """`UnknownGainGoalTask`: theta = (k, k x_d)."""

    kind: Literal["goal_unknown_gain"] = "goal_unknown_gain"

    @property
    def parameters(self) -> int:
        return 3

    def build(self, bodies: Sequence[str]) -> Task:
        from torchfsid.tasks import UnknownGainGoalTask

        return UnknownGainGoalTask()


class VelocityConfig(_Task):
    """`VelocityTask`: keep a constant velocity."""

    kind: Literal["velocity"] = "velocity"

    def build(self, bodies: Sequence[str]) -> Task:
        from torchfsid.tasks import VelocityTask

        return VelocityTask()


class FormationConfig(_Task):
    """`FormationTask`: keep an offset to the body named `leader`, with a known gain [1/s]."""

    kind: Literal["formation"] = "formation"
    gain: Positive
    leader: BodyName

    def build(self, bodies: Sequence[str]) -> Task:
        from torchfsid.tasks import FormationTask

        _require_body("task.leader", self.leader, bodies)
        return FormationTask(self.gain, leader=list(bodies).index(self.leader))


class OrbitConfig(_Task):
    """`OrbitTask`: circle a centre at a known rate [rad/s], positive anticlockwise."""

    kind: Literal["orbit"] = "orbit"
    rate: Number

    def build(self, bodies: Sequence[str]) -> Task:
        from torchfsid.tasks import OrbitTask

        return OrbitTask(self.rate)


class PatrolConfig(_Task):
    """`PatrolTask`: follow a closed path of some harmonics of a known rate [rad/s], with a known gain [1/s]."""

    kind: Literal["patrol"] = "patrol"
    gain: Positive
    rate: Number
    harmonics: Annotated[int, Field(strict=True, ge=1)] = 1

    @property
    def parameters(self) -> int:
        return 2 + 4 * self.harmonics

    def build(self, bodies: Sequence[str]) -> Task:
        from torchfsid.tasks import PatrolTask

        return PatrolTask(self.gain, self.rate, self.harmonics)


TaskConfig = Annotated[
    GoalConfig | UnknownGainGoalConfig | VelocityConfig | FormationConfig | OrbitConfig | PatrolConfig,
    Field(discriminator="kind"),
]


class ClassKConfig(Strict):
    """`ClassK`: gain sign(h) |h|^power."""

    gain: Positive
    power: Positive = 1.0


class AvoidanceConfig(Strict):
    """`CollisionAvoidance`, with `safety_distance` [m] or, when the radii are known, a `margin` [m] beyond them."""

    kind: Literal["avoidance"] = "avoidance"
    distance: Literal["squared", "euclidean"] = "squared"
    safety_distance: Positive | None = None
    margin: NonNegative | None = None
    class_k: ClassKConfig
    neighbour_velocity: Literal["none", "current", "previous"] = "none"
    soft: Flag = False

    @model_validator(mode="after")
    def _one_distance(self) -> AvoidanceConfig:
        if (self.safety_distance is None) == (self.margin is None):
            raise _wrong(f"expected safety_distance or margin, got {'neither' if self.margin is None else 'both'}")
        return self

    def build(self) -> Barrier:
        from torchfsid.barriers import ClassK, CollisionAvoidance

        class_k = ClassK(self.class_k.gain, self.class_k.power)
        return CollisionAvoidance(
            class_k, self.safety_distance, self.margin, self.distance, self.neighbour_velocity, self.soft
        )


class SpeedBoxConfig(Strict):
    """`SpeedBox`: a limit per axis [m/s]."""

    kind: Literal["speed_box"] = "speed_box"
    limit: Annotated[tuple[Positive, ...], Field(min_length=2, max_length=2)]
    soft: Flag = False

    def build(self) -> Barrier:
        from torchfsid.barriers import SpeedBox

        return SpeedBox(self.limit, self.soft)


class SpeedPolygonConfig(Strict):
    """`SpeedPolygon`: a regular polygon of circumradius `limit` [m/s]."""

    kind: Literal["speed_polygon"] = "speed_polygon"
    sides: Annotated[int, Field(strict=True, ge=3, le=360)]
    limit: Positive
    soft: Flag = False

    def build(self) -> Barrier:
        from torchfsid.barriers import SpeedPolygon

        return SpeedPolygon(self.sides, self.limit, self.soft)


class ArenaConfig(Strict):
    """`Arena`: walls around a box [m], kept at a distance `margin` [m]."""

    kind: Literal["arena"] = "arena"
    lower: PlanarVector
    upper: PlanarVector
    margin: NonNegative = 0.0
    class_k: ClassKConfig
    soft: Flag = False

    @model_validator(mode="after")
    def _is_a_box(self) -> ArenaConfig:
        _require_box(self.lower, self.upper)
        return self

    def build(self) -> Barrier:
        from torchfsid.barriers import Arena, ClassK

        class_k = ClassK(self.class_k.gain, self.class_k.power)
        return Arena(self.lower, self.upper, class_k, self.margin, self.soft)


BarrierConfig = Annotated[
    AvoidanceConfig | SpeedBoxConfig | SpeedPolygonConfig | ArenaConfig, Field(discriminator="kind")
]


class PriorConfig(Strict):
    """The prior set of theta, a box in theta's units."""

    lower: Vector
    upper: Vector

    @model_validator(mode="after")
    def _is_a_box(self) -> PriorConfig:
        _require_box(self.lower, self.upper)
        return self


class NoiseConfig(Strict):
    """`NoiseBound`: bounds on the error of the measured control [m/s]; `slack` defaults to `velocity`."""

    velocity: NonNegative
    slack: NonNegative | None = None

    def build(self) -> NoiseBound:
        from torchfsid.inverse_optimal import NoiseBound

        return NoiseBound(self.velocity, self.slack)


class UkfConfig(Strict):
    """The unscented Kalman filter on [x; theta], and how the hybrid observer joins it with the set.

    Attributes:
        position_noise: standard deviation of a measured position [m]; R is its square.
        process_noise: standard deviation of theta's drift in one second [units of theta].
        prior_std: standard deviation of theta at the start; None: that of the prior box.
        qp_inside: the QP is solved inside the filter's dynamics; otherwise the measurement says which rows are active.
        feedback: the hybrid's projected estimate replaces the filter's own.
    """

    position_noise: Positive = 1e-3
    process_noise: NonNegative = 1e-4
    prior_std: Positive | None = None
    qp_inside: Flag = False
    feedback: Flag = False


class ObserveConfig(Strict):
    """The file of `torchfsid observe`.

    Attributes:
        set: the set that is intersected over time.
        active_tolerance: distance [m/s] to its boundary below which a row counts as active (G., Eqs. (12), (18)).
        velocity: take velocities from the log, or from differences of its positions.
        obstacles: bodies of the log that are avoided but not inferred.
    """

    task: TaskConfig
    barriers: Annotated[tuple[BarrierConfig, ...], Field(min_length=1)]
    prior: PriorConfig
    noise: NoiseConfig
    set: Literal["inverse_optimal", "critical_region"] = "inverse_optimal"
    active_tolerance: Positive = 1e-3
    velocity: Literal["logged", "differentiated"] = "logged"
    obstacles: tuple[BodyName, ...] = ()
    ukf: UkfConfig = UkfConfig()

    @model_validator(mode="after")
    def _prior_fits_task(self) -> ObserveConfig:
        expected, got = self.task.parameters, len(self.prior.lower)
        if got != expected:
            raise _wrong(f"task '{self.task.kind}' has {expected} parameters, lower and upper have {got}", "prior")
        return self

    @property
    def neighbour_velocities(self) -> frozenset[str]:
        """Which velocities of the bodies the barriers use: some of `none`, `current`, `previous`."""
        return frozenset(b.neighbour_velocity for b in self.barriers if b.kind == "avoidance")

    @property
    def uses_radius(self) -> bool:
        """Does a barrier need the bodies' radii?"""
        return any(b.kind == "avoidance" and b.margin is not None for b in self.barriers)

    @property
    def required(self) -> tuple[str, ...]:
        """The bodies without which a measurement says nothing about theta: the leader of a formation."""
        return (self.task.leader,) if self.task.kind == "formation" else ()

    def robots(self, bodies: Sequence[str]) -> list[str]:
        """The bodies to infer: all but the obstacles and a formation's leader, who keeps no offset to itself.

        Raises:
            ConfigError: the file names a body that is not there, or no robot is left.
        """
        for i, name in enumerate(self.obstacles):
            _require_body(f"obstacles[{i}]", name, bodies)
        robots = [body for body in bodies if body not in self.obstacles and body not in self.required]
        if not robots:
            raise ConfigError("obstacles: no robot is left to infer")
        return robots


def _require_box(lower: Sequence[float], upper: Sequence[float]) -> None:
    if len(lower) != len(upper):
        raise _wrong(f"lower has {len(lower)} entries, upper has {len(upper)}")
    for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
        if not low < high:
            raise _wrong(f"lower[{i}] must be less than upper[{i}], got {low} and {high}")


def _require_body(path: str, name: str, bodies: Sequence[str]) -> None:
    if name not in bodies:
        raise ConfigError(f"{path}: no body is called {name!r}; there are {reprlib.repr(list(bodies))}")


Config = TypeVar("Config", bound=Strict)


def load(path: str | Path, model: type[Config], overrides: Iterable[str] = ()) -> Config:
    """The file at `path`, after `overrides` such as "noise.velocity=0.02", as a `model`.

    Raises:
        ConfigError: the file cannot be read, is not YAML, or is not what `model` expects.
    """
    return validate(apply_overrides(read_yaml(path), overrides), model, source=str(path))


def dump(config: Strict) -> str:
    """The configuration with its defaults filled in, as YAML that loads back to the same configuration."""
    content = config.model_dump(mode="json", exclude_none=True)
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None)


def read_yaml(path: str | Path) -> dict[Any, Any]:
    """The mapping in a YAML file, not yet validated. Raises `ConfigError`."""
    try:
        text = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    data = _parse(text, str(path))
    if not isinstance(data, dict):
        got = "nothing" if data is None else reprlib.repr(data)
        raise ConfigError(f"{path}: expected keys and values, got {got}")
    return data


def apply_overrides(mapping: dict[Any, Any], overrides: Iterable[str]) -> dict[Any, Any]:
    """A copy of a raw mapping with values replaced: "a.b=value", "barriers.0.margin=0.2"; values are YAML.

    Keys that do not exist are added, and left to the validation. Raises `ConfigError` for what is not such a text.
    """
    for override in overrides:
        path, equals, text = override.partition("=")
        keys = [key.strip() for key in path.split(".")]
        if not equals or not all(keys):
            raise ConfigError(f"override {override!r}: expected path.to.key=value")
        where = f"override {override!r}"
        mapping = _replaced(mapping, keys, _parse(text, where), where)
    return mapping


def _replaced(node: Any, keys: list[str], value: object, where: str) -> Any:
    """`node` with the value at `keys`, copied along the way: aliases share nodes that must not change together."""
    if not keys:
        return value
    first, *rest = keys
    if isinstance(node, list):
        if first not in map(str, range(len(node))):
            raise ConfigError(f"{where}: expected a number below {len(node)} in place of {first!r}")
        i = int(first)
        return [*node[:i], _replaced(node[i], rest, value, where), *node[i + 1 :]]
    if node is None or isinstance(node, dict):
        node = node or {}
        return {**node, first: _replaced(node.get(first), rest, value, where)}
    raise ConfigError(f"{where}: {reprlib.repr(node)} has no key {first!r}")


def validate(mapping: Mapping[Any, Any], model: type[Config], source: str) -> Config:
    """The mapping as a `model`. Raises `ConfigError`, which names the `source` and the path of the first mistake."""
    try:
        return model.model_validate(mapping)
    except ValidationError as error:
        first, *others = error.errors(include_url=False)
        more = f" (and {len(others)} more)" if others else ""
        raise ConfigError(f"{source}: {_path(first, mapping)}: {_sentence(first)}{more}") from error


def _path(error: ErrorDetails, mapping: Mapping[Any, Any]) -> str:
    """`barriers[0].safety_distance`. Pydantic also names the kind of a section on the way, which is no key."""
    keys: list[Any] = []
    node: Any = mapping
    kind = None
    for part in error["loc"]:
        if kind is not None and part == kind:
            kind = None
            continue
        keys.append(part)
        try:
            node = node[part]
        except (KeyError, IndexError, TypeError):
            node = None
        kind = node.get("kind") if isinstance(node, Mapping) else None
    context = error.get("ctx", {})
    if error["type"] == "complete" and context["key"] is not None:
        keys.append(context["key"])
    if error["type"] in ("union_tag_invalid", "union_tag_not_found"):
        keys.append("kind")
    path = ""
    for key in keys:
        if isinstance(key, int):
            path += f"[{key}]"
        else:
            path += ("." if path else "") + (key if isinstance(key, str) and key.isprintable() else reprlib.repr(key))
    return path or "the file"


def _sentence(error: ErrorDetails) -> str:
    kind, context, got = error["type"], error.get("ctx", {}), reprlib.repr(error["input"])
    if kind == "complete":
        return context["message"]
    if kind in ("missing", "union_tag_not_found"):
        return "required key is missing"
    if kind == "union_tag_invalid":
        return f"expected one of {context['expected_tags']}, got {reprlib.repr(error['input']['kind'])}"
    if kind in ("too_short", "too_long"):
        bound = f"at least {context['min_length']}" if kind == "too_short" else f"at most {context['max_length']}"
        return f"expected {bound} entries, got {context['actual_length']}"
    if kind == "tuple_type":
        return f"expected a list, got {got}"
    if kind in ("model_type", "model_attributes_type"):
        return f"expected keys and values, got {got}"
    return f"{error['msg']}, got {got}"


class _Loader(yaml.SafeLoader):
    """YAML as `safe_load` reads it, except that a key may not be given twice, and that only plain decimal notation
    makes a whole number: the body called 010 is not number 8."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        for key, _ in node.value:
            if (key.tag, repr(key.value)) in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {key.value!r} is given twice", key.start_mark)
            seen.add((key.tag, repr(key.value)))
        return super().construct_mapping(node, deep)

    def construct_decimal(self, node: yaml.ScalarNode) -> int | str:
        text = self.construct_scalar(node)
        return int(text) if re.fullmatch(r"0|-?[1-9][0-9]*", text) else text


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_decimal)


def _parse(text: str | bytes, source: str) -> Any:
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ConfigError(f"{source}: {line}not valid YAML: {_one_line(error.problem or error)}") from error
    # PyYAML also lets the errors of Python's own constructors through (!!int x, 2001-99-99, very deep nesting ...).
    except (yaml.YAMLError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ConfigError(f"{source}: not valid YAML: {_one_line(error)}") from error


def _one_line(message: object) -> str:
    return " ".join(str(message).split())
