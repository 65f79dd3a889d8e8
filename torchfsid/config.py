"""YAML files to validated, frozen records, and these to the objects of the package.

A mistake in a file is one `ConfigError` of one line that names the file, the dotted path of the key, what was expected
and what came. Nothing here imports torch until something is built, so that a wrong file is refused at once.

`Strict` and the sections below (`TaskConfig`, `BarrierConfig`, `PriorConfig`, `NoiseConfig`, `UkfConfig`) are pieces
that other files' models are made of; `ObserveConfig` is the file of `torchfsid observe`.
"""

from __future__ import annotations

import difflib
import re
import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from torchfsid.errors import ConfigError

if TYPE_CHECKING:
    import torchfsid.barriers
    import torchfsid.inverse_optimal
    import torchfsid.tasks


def _read_text_as_number(value: object) -> object:
    """PyYAML takes 1e-6, a number without a dot, for text."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _name(value: object) -> object:
    """Bodies are named by text; a whole number is the text that writes it."""
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    if not isinstance(value, str):
        raise _wrong(f"expected a name, got {_shown(value)}: put it in quotes")
    return value


Number = Annotated[float, BeforeValidator(_read_text_as_number), Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Count = Annotated[int, Field(strict=True, ge=1)]
Flag = Annotated[bool, Field(strict=True)]
BodyName = Annotated[str, BeforeValidator(_name), Field(min_length=1)]
PlanarVector = Annotated[tuple[Number, ...], Field(min_length=2, max_length=2)]


def _wrong(message: str, key: object = None) -> PydanticCustomError:
    """An error whose message is complete; `key` is the part of the record that it is about."""
    return PydanticCustomError("complete", "{message}", {"message": message, "key": key})


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


# Tasks: what a robot wants. `parameters` is p, the number of entries of theta.


class GoalConfig(Strict):
    """`GoalTask`: go to a goal [m] with a known gain [1/s]."""

    kind: Literal["goal"] = "goal"
    gain: Positive

    @property
    def parameters(self) -> int:
        return 2

    def build(self, bodies: Sequence[str]) -> torchfsid.tasks.GoalTask:
        from torchfsid.tasks import GoalTask

        return GoalTask(self.gain)


class UnknownGainGoalConfig(Strict):
    """`UnknownGainGoalTask`: theta = (k, k x_d)."""

    kind: Literal["goal_unknown_gain"] = "goal_unknown_gain"

    @property
    def parameters(self) -> int:
        return 3

    def build(self, bodies: Sequence[str]) -> torchfsid.tasks.UnknownGainGoalTask:
        from torchfsid.tasks import UnknownGainGoalTask

        return UnknownGainGoalTask()


class VelocityConfig(Strict):
    """`VelocityTask`: keep a constant velocity [m/s]."""

    kind: Literal["velocity"] = "velocity"

    @property
    def parameters(self) -> int:
        return 2

    def build(self, bodies: Sequence[str]) -> torchfsid.tasks.VelocityTask:
        from torchfsid.tasks import VelocityTask

        return VelocityTask()


class FormationConfig(Strict):
    """`FormationTask`: keep an offset [m] to the body named `leader`, with a known gain [1/s]."""

    kind: Literal["formation"] = "formation"
    gain: Positive
    leader: BodyName

    @property
    def parameters(self) -> int:
        return 2

    def build(self, bodies: Sequence[str]) -> torchfsid.tasks.FormationTask:
        from torchfsid.tasks import FormationTask

        _require_body("task.leader", self.leader, bodies)
        return FormationTask(self.gain, leader=list(bodies).index(self.leader))


class OrbitConfig(Strict):
    """`OrbitTask`: circle a centre [m] at a known rate [rad/s], positive anticlockwise."""

    kind: Literal["orbit"] = "orbit"
    rate: Number

    @property
    def parameters(self) -> int:
        return 2

    def build(self, bodies: Sequence[str]) -> torchfsid.tasks.OrbitTask:
        from torchfsid.tasks import OrbitTask

        return OrbitTask(self.rate)


class PatrolConfig(Strict):
    """`PatrolTask`: follow a closed path of so many harmonics of a known rate [rad/s], with a known gain [1/s]."""

    kind: Literal["patrol"] = "patrol"
    gain: Positive
    rate: Number
    harmonics: Count = 1

    @property
    def parameters(self) -> int:
        return 2 + 4 * self.harmonics

    def build(self, bodies: Sequence[str]) -> torchfsid.tasks.PatrolTask:
        from torchfsid.tasks import PatrolTask

        return PatrolTask(self.gain, self.rate, self.harmonics)


TaskConfig = Annotated[
    GoalConfig | UnknownGainGoalConfig | VelocityConfig | FormationConfig | OrbitConfig | PatrolConfig,
    Field(discriminator="kind"),
]


# Barriers: what a robot must not do. `soft` rows may be violated by their controller.


class ClassKConfig(Strict):
    """`ClassK`: gain sign(h) |h|^power."""

    gain: Positive
    power: Positive = 1.0


class AvoidanceConfig(Strict):
    """`CollisionAvoidance`, with `safety_distance` [m] or, when the radii are known, `margin` [m] beyond them."""

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
            got = "neither" if self.margin is None else "both"
            raise _wrong(f"expected either safety_distance or margin, got {got}")
        return self

    def build(self) -> torchfsid.barriers.CollisionAvoidance:
        from torchfsid.barriers import ClassK, CollisionAvoidance

        return CollisionAvoidance(
            class_k=ClassK(self.class_k.gain, self.class_k.power),
            safety_distance=self.safety_distance,
            margin=self.margin,
            distance=self.distance,
            neighbour_velocity=self.neighbour_velocity,
            soft=self.soft,
        )


class SpeedBoxConfig(Strict):
    """`SpeedBox`: a limit per axis [m/s]."""

    kind: Literal["speed_box"] = "speed_box"
    limit: Annotated[tuple[Positive, ...], Field(min_length=2, max_length=2)]
    soft: Flag = False

    def build(self) -> torchfsid.barriers.SpeedBox:
        from torchfsid.barriers import SpeedBox

        return SpeedBox(self.limit, soft=self.soft)


class SpeedPolygonConfig(Strict):
    """`SpeedPolygon`: a regular polygon of circumradius `limit` [m/s]."""

    kind: Literal["speed_polygon"] = "speed_polygon"
    sides: Annotated[int, Field(strict=True, ge=3, le=360)]
    limit: Positive
    soft: Flag = False

    def build(self) -> torchfsid.barriers.SpeedPolygon:
        from torchfsid.barriers import SpeedPolygon

        return SpeedPolygon(self.sides, self.limit, soft=self.soft)


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

    def build(self) -> torchfsid.barriers.Arena:
        from torchfsid.barriers import Arena, ClassK

        class_k = ClassK(self.class_k.gain, self.class_k.power)
        return Arena(self.lower, self.upper, class_k, margin=self.margin, soft=self.soft)


BarrierConfig = Annotated[
    AvoidanceConfig | SpeedBoxConfig | SpeedPolygonConfig | ArenaConfig, Field(discriminator="kind")
]


# What is known beforehand, and how well things are measured.


class PriorConfig(Strict):
    """The prior set of theta, a box in theta's units."""

    lower: Annotated[tuple[Number, ...], Field(min_length=1)]
    upper: Annotated[tuple[Number, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _is_a_box(self) -> PriorConfig:
        _require_box(self.lower, self.upper)
        return self


class NoiseConfig(Strict):
    """`NoiseBound`: bounds on the error of the measured control [m/s]; `slack` defaults to `velocity`."""

    velocity: NonNegative
    slack: NonNegative | None = None

    def build(self) -> torchfsid.inverse_optimal.NoiseBound:
        from torchfsid.inverse_optimal import NoiseBound

        return NoiseBound(self.velocity, self.slack)


class UkfConfig(Strict):
    """The unscented Kalman filter on [x; theta], and how the hybrid observer joins it with the set.

    Attributes:
        position_noise: standard deviation of a measured position [m]; R is its square.
        process_noise: standard deviation of theta's drift after one second [units of theta].
        prior_std: standard deviation of theta at the start; default: that of the prior box.
        qp_inside: solve the QP inside the filter's dynamics instead of taking the active set from the measurement.
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
        set: which set is intersected over time.
        active_tolerance: how close to its boundary a row counts as active [m/s]; for `critical_region` and the filter.
        velocity: take the velocities from the log, or from differences of its positions.
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
            message = f"task '{self.task.kind}' has {expected} parameters, lower and upper have {got} entries"
            raise _wrong(message, "prior")
        return self

    @property
    def neighbour_velocities(self) -> frozenset[str]:
        """Which velocities of other bodies the barriers look at: some of `none`, `current`, `previous`."""
        return frozenset(b.neighbour_velocity for b in self.barriers if b.kind == "avoidance")

    @property
    def uses_radius(self) -> bool:
        """Does a barrier need the radii of the bodies?"""
        return any(b.kind == "avoidance" and b.margin is not None for b in self.barriers)

    def robots(self, bodies: Sequence[str]) -> list[str]:
        """The bodies to infer: all but the obstacles and the leader of a formation, who has no offset to itself.

        Raises:
            ConfigError: the file names a body that is not there, or no robot is left.
        """
        for i, name in enumerate(self.obstacles):
            _require_body(f"obstacles[{i}]", name, bodies)
        leaders = (self.task.leader,) if self.task.kind == "formation" else ()
        robots = [body for body in bodies if body not in self.obstacles and body not in leaders]
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
        raise ConfigError(f"{path}: no body is called {name!r}, there are {reprlib.repr(list(bodies))}")


# Files.

Section = TypeVar("Section", bound=Strict)


class _Loader(yaml.SafeLoader):
    """YAML as `safe_load` reads it, except that a key may not be given twice, and that a whole number is one in plain
    decimal notation only: the body 010 is not number 8."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys = [(key.tag, key.value) for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                raise yaml.constructor.ConstructorError(None, None, f"key {key[1]!r} is given twice", node.start_mark)
        return super().construct_mapping(node, deep)

    def construct_plain_int(self, node: yaml.ScalarNode) -> int | str:
        text = self.construct_scalar(node)
        return int(text) if re.fullmatch(r"0|-?[1-9][0-9]*", text) else text


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_plain_int)
