"""The sections of the configuration files, and the objects of the package that they stand for.

Nothing here imports torch before something is built, so that a wrong file is refused at once.

`ObserveConfig` is the file of `torchfsid observe`. Other files' models are made of the same pieces: `Strict`,
`TaskConfig`, `BarrierConfig`, `PriorConfig`, `NoiseConfig`, `UkfConfig`.
"""

from __future__ import annotations

import reprlib
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, field_validator, model_validator

from torchfsid.config.bags import BagConfig
from torchfsid.config.documents import Strict, wrong
from torchfsid.config.quantities import BodyName, Flag, NonNegative, PlanarVector, Positive, Vector, as_number
from torchfsid.config.tasks import TaskConfig, require_body
from torchfsid.errors import ConfigError

if TYPE_CHECKING:
    from torchfsid.robots.barriers import Barrier
    from torchfsid.robots.bounds import NoiseBound


class ClassKConfig(Strict):
    """`ClassK`: gain sign(h) |h|^power."""

    gain: Positive
    power: Positive = 1.0


class AvoidanceConfig(Strict):
    """`CollisionAvoidance`, with `safety_distance` [m] or, when the radii are known, a `margin` [m] beyond them.

    `safety_distances` names bodies that have a distance of their own [m].
    """

    kind: Literal["avoidance"] = "avoidance"
    distance: Literal["squared", "euclidean"] = "squared"
    safety_distance: Positive | None = None
    safety_distances: dict[BodyName, Positive] = Field(default_factory=dict)
    margin: NonNegative | None = None
    class_k: ClassKConfig
    neighbour_velocity: Literal["none", "current", "previous"] = "none"
    soft: Flag = False

    @model_validator(mode="after")
    def _one_distance(self) -> AvoidanceConfig:
        if (self.safety_distance is None) == (self.margin is None):
            raise wrong(f"expected safety_distance or margin, got {'neither' if self.margin is None else 'both'}")
        if self.safety_distances and self.margin is not None:
            raise wrong(
                "bodies have a distance of their own beside a safety_distance, not a margin", "safety_distances"
            )
        return self

    def build(self, bodies: Sequence[str]) -> Barrier:
        import torch

        from torchfsid.robots.barriers import ClassK, CollisionAvoidance

        for name in self.safety_distances:
            require_body(f"safety_distances.{name}", name, bodies)
        Ds = self.safety_distance
        if self.safety_distances:
            Ds = torch.tensor([self.safety_distances.get(body, Ds) for body in bodies], dtype=torch.float64)
        class_k = ClassK(self.class_k.gain, self.class_k.power)
        return CollisionAvoidance(class_k, Ds, self.margin, self.distance, self.neighbour_velocity, self.soft)


class SpeedBoxConfig(Strict):
    """`SpeedBox`: a limit per axis [m/s]."""

    kind: Literal["speed_box"] = "speed_box"
    limit: Annotated[tuple[Positive, ...], Field(min_length=2, max_length=2)]
    soft: Flag = False

    def build(self, bodies: Sequence[str]) -> Barrier:
        from torchfsid.robots.barriers import SpeedBox

        return SpeedBox(self.limit, self.soft)


class SpeedPolygonConfig(Strict):
    """`SpeedPolygon`: a regular polygon of circumradius `limit` [m/s]."""

    kind: Literal["speed_polygon"] = "speed_polygon"
    sides: Annotated[int, Field(strict=True, ge=3, le=360)]
    limit: Positive
    soft: Flag = False

    def build(self, bodies: Sequence[str]) -> Barrier:
        from torchfsid.robots.barriers import SpeedPolygon

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

    def build(self, bodies: Sequence[str]) -> Barrier:
        from torchfsid.robots.barriers import Arena, ClassK

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


class _Noise(Strict):
    slack: NonNegative | None = None
    position: NonNegative = 0.0
    neighbour_velocity: NonNegative = 0.0


class NoiseConfig(_Noise):
    """`NoiseBound`: bounds on errors of controls and slacks [m/s], positions [m], other bodies' velocities [m/s]."""

    velocity: NonNegative

    def build(self) -> NoiseBound:
        from torchfsid.robots.bounds import NoiseBound

        return NoiseBound(self.velocity, self.slack, self.position, self.neighbour_velocity)


class ObservedNoiseConfig(_Noise):
    """`NoiseConfig` for a log, which may itself say how large the errors in it must be: `velocity: auto`."""

    velocity: float | Literal["auto"]

    @field_validator("velocity", mode="plain")
    @classmethod
    def _is_bound_or_auto(cls, value: object) -> float | Literal["auto"]:
        if value == "auto":
            return "auto"
        bound = as_number(value)
        if not isinstance(bound, int | float) or isinstance(bound, bool) or not 0 <= bound <= sys.float_info.max:
            raise wrong(f"expected a bound of at least 0 m/s or 'auto', got {reprlib.repr(value)}")
        return float(bound)

    def build(self) -> NoiseBound:
        """Raises `ConfigError` for `auto`: someone has to find the bound first."""
        if self.velocity == "auto":
            raise ConfigError("noise.velocity: expected a number, got 'auto'")
        return NoiseConfig(**self.model_dump()).build()


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
        active_tolerance: distance [m/s] to its boundary below which a row counts as active (G., Eqs. (11), (12), (17)).
        velocity: take velocities from the log, or from differences of its positions.
        obstacles: bodies of the log that are avoided but not inferred.
        on_inconsistent: what an empty intersection does to a set: `hold` it, `reset` it to the prior, or `raise`.
        bag: where in a ROS bag the bodies are; logs of other kinds do not look at it.
    """

    task: TaskConfig
    barriers: Annotated[tuple[BarrierConfig, ...], Field(min_length=1)]
    prior: PriorConfig
    noise: ObservedNoiseConfig
    set: Literal["inverse_optimal", "critical_region"] = "inverse_optimal"
    active_tolerance: Positive = 1e-3
    velocity: Literal["logged", "differentiated"] = "logged"
    obstacles: tuple[BodyName, ...] = ()
    on_inconsistent: Literal["hold", "reset", "raise"] = "hold"
    bag: BagConfig | None = None
    ukf: UkfConfig = UkfConfig()

    @model_validator(mode="after")
    def _fits_together(self) -> ObserveConfig:
        expected, got = self.task.parameters, len(self.prior.lower)
        if got != expected:
            raise wrong(f"task '{self.task.kind}' has {expected} parameters, lower and upper have {got}", "prior")
        if self.set == "critical_region" and self.task.kind == "goal" and (self.task.saturation or self.task.dead_zone):
            raise wrong("critical_region knows no saturation or dead zone, take inverse_optimal", "set")
        if self.noise.velocity == "auto" and self.on_inconsistent == "reset":
            raise wrong("auto takes a change of goal for noise, give a number or take on_inconsistent: hold", "noise")
        return self

    def with_velocity_bound(self, bound: float) -> ObserveConfig:
        """The configuration with another `noise.velocity` [m/s]."""
        return self.model_copy(update={"noise": self.noise.model_copy(update={"velocity": bound})})

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
            require_body(f"obstacles[{i}]", name, bodies)
        robots = [body for body in bodies if body not in self.obstacles and body not in self.required]
        if not robots:
            raise ConfigError("obstacles: no robot is left to infer")
        return robots


def _require_box(lower: Sequence[float], upper: Sequence[float]) -> None:
    if len(lower) != len(upper):
        raise wrong(f"lower has {len(lower)} entries, upper has {len(upper)}")
    for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
        if not low < high:
            raise wrong(f"lower[{i}] must be less than upper[{i}], got {low} and {high}")
