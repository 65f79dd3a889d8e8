"""The tasks in configuration files. Each builds an object of `robots.tasks`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from torchfsid.config.documents import Strict, wrong
from torchfsid.config.quantities import (
    BodyName,
    NonNegative,
    Number,
    Place,
    Positive,
    PositiveOrInterval,
    Units,
    as_interval,
    as_middle,
    require_body,
    require_interval,
)

if TYPE_CHECKING:
    from torchfsid.robots.tasks import Task


class NormSaturationConfig(Strict):
    """Norm saturation: |uhat| <= limit [m/s].

    Attributes:
        limit: the largest speed [m/s].
    """

    kind: Literal["norm"] = "norm"
    limit: Positive


class BoxSaturationConfig(Strict):
    """Box saturation: |uhat_i| <= limit_i [m/s] on each axis.

    Attributes:
        limit: the largest speed along each axis [m/s].
    """

    kind: Literal["box"] = "box"
    limit: Place

    @model_validator(mode="after")
    def _is_positive(self) -> BoxSaturationConfig:
        if min(self.limit) <= 0:
            raise wrong(f"limits must be greater than 0, got {min(self.limit)}", "limit")
        return self


SaturationConfig = Annotated[NormSaturationConfig | BoxSaturationConfig, Field(discriminator="kind")]


class _Task(Strict):
    """A task.

    Attributes:
        unit: the unit of all entries of theta; empty if they have different ones.
        is_place: theta is a place among the robots, if it has as many entries.
        suspects: the keys to look at where the nominal control contradicts a log.
    """

    unit: ClassVar[str] = "m"
    is_place: ClassVar[bool] = True
    suspects: ClassVar[tuple[str, ...]] = ("kind",)

    def parameters(self, dimension: int) -> int:
        """p, the number of entries of theta of robots in the plane (2) or in space (3)."""
        return dimension

    @property
    def dimensions(self) -> tuple[int, ...]:
        """Whether the robots may be in the plane (2), in space (3), or both."""
        return 2, 3

    @property
    def is_clipped(self) -> bool:
        """Does the nominal control differ from C theta + d somewhere?"""
        return False

    @property
    def narrowed(self) -> Units:
        """The numbers that may be given as [low, high]."""
        return {}

    @property
    def needs_velocity(self) -> str | None:
        """The key that makes the nominal control depend on the robot's velocity, if there is one."""
        return None

    @property
    def required(self) -> tuple[str, ...]:
        """The bodies without which a measurement says nothing about theta."""
        return ()


class GoalConfig(_Task):
    """`GoalTask`: go to a goal with a known gain, or at a constant speed until it is reached.

    The law `proportional` needs `gain`. The law `constant_speed`, uhat = speed (theta - x)/|theta - x| down to the
    distance `tolerance`, needs these two. It is the gain speed/tolerance, clipped to `speed`, with a dead zone of the
    size `tolerance`.

    Attributes:
        law: `proportional` or `constant_speed`.
        gain: gain of the nominal control [1/s], a number or bounds [low, high]. `torchfsid observe` narrows the bounds.
        saturation: how the nominal control is clipped. Default: not at all.
        dead_zone: distance from the goal within which the nominal control is zero [m].
        speed: the constant speed [m/s].
        tolerance: distance from the goal at which the robot stops [m].
        damping: of robots that are driven by accelerations [1/s]. Their gain is in [1/s2].
        velocity_loop: gain of a loop inside, by which they follow the task as a velocity [1/s]. The gain of the task is
            then in [1/s], limits are in [m/s].
    """

    kind: Literal["goal"] = "goal"
    law: Literal["proportional", "constant_speed"] = "proportional"
    gain: PositiveOrInterval | None = None
    saturation: SaturationConfig | None = None
    dead_zone: NonNegative = 0.0
    speed: Positive | None = None
    tolerance: Positive | None = None
    damping: Positive | None = None
    velocity_loop: Positive | None = None

    @model_validator(mode="after")
    def _has_what_its_law_needs(self) -> GoalConfig:
        needed, foreign = ("gain",), ("speed", "tolerance")
        if self.law == "constant_speed":
            needed, foreign = ("speed", "tolerance"), ("gain", "saturation", "dead_zone", "damping", "velocity_loop")
        for name in needed:
            if getattr(self, name) is None:
                raise wrong(f"required key is missing, for law '{self.law}'", name)
        for name in foreign:
            if getattr(self, name):
                raise wrong(f"a task with law '{self.law}' has none", name)
        return self

    @model_validator(mode="after")
    def _moves_at_all(self) -> GoalConfig:
        if self.gain is None:
            return self
        require_interval("gain", self.gain)
        if isinstance(self.gain, tuple) and self.dead_zone > 0:
            raise wrong("expected a known gain with a dead_zone", "gain")
        if self.damping is not None and self.velocity_loop is not None:
            raise wrong("expected damping or velocity_loop, got both", "velocity_loop")
        if self.damping is not None and self.dead_zone > 0:
            raise wrong("expected none with damping, which brakes in the dead zone, too", "dead_zone")
        if min(self._limits) <= max(as_interval(self.gain)) * self.dead_zone:
            at_edge = max(as_interval(self.gain)) * self.dead_zone
            raise wrong(f"at its edge the speed is {at_edge}, not below the limit", "dead_zone")
        return self

    @property
    def suspects(self) -> tuple[str, ...]:
        if self.law == "constant_speed":
            return ("speed", "tolerance")
        beside = [key for key in ("damping", "velocity_loop") if getattr(self, key) is not None]
        return ("gain", *beside, "saturation" if self.saturation is None else "saturation.limit")

    @property
    def narrowed(self) -> Units:
        """The unit of the gain of robots with damping is that of robots that are driven by accelerations."""
        return {("gain",): "1/s" if self.damping is None else "1/s2"}

    @property
    def needs_velocity(self) -> str | None:
        return "damping" if self.damping is not None else "velocity_loop" if self.velocity_loop is not None else None

    @property
    def is_clipped(self) -> bool:
        return self.saturation is not None or self.dead_zone > 0 or self.law == "constant_speed"

    @property
    def dimensions(self) -> tuple[int, ...]:
        limit = None if self.saturation is None else self.saturation.limit
        return (len(limit),) if isinstance(limit, tuple) else (2, 3)

    @property
    def _limits(self) -> tuple[float, ...]:
        """One limit per axis. A single one is for all."""
        limit = math.inf if self.saturation is None else self.saturation.limit
        return limit if isinstance(limit, tuple) else (limit,)

    def build(self, bodies: Sequence[str], dimension: int = 2) -> Task:
        """The `GoalTask` with these values."""
        from torchfsid.robots.tasks import GoalTask, Saturation

        if self.speed is not None and self.tolerance is not None:
            saturation = Saturation("norm", (self.speed,) * dimension, dead_speed=self.speed)
            return GoalTask(self.speed / self.tolerance, dimension, saturation)
        assert self.gain is not None
        gain, error = as_middle(self.gain)
        saturation = None
        if self.is_clipped:
            shape = "norm" if self.saturation is None else self.saturation.kind
            limits = self._limits if len(self._limits) > 1 else self._limits * dimension
            saturation = Saturation(shape, limits, gain * self.dead_zone)
        if self.velocity_loop is not None:
            return GoalTask.in_velocity_loop(gain, self.velocity_loop, saturation, error, dimension)
        return GoalTask(gain, dimension, saturation, error, self.damping or 0.0)


class UnknownGainGoalConfig(_Task):
    """`UnknownGainGoalTask`: theta = (k, k x_d)."""

    kind: Literal["goal_unknown_gain"] = "goal_unknown_gain"
    unit: ClassVar[str] = ""

    def parameters(self, dimension: int) -> int:
        return 1 + dimension

    def build(self, bodies: Sequence[str], dimension: int = 2) -> Task:
        """The `UnknownGainGoalTask`."""
        from torchfsid.robots.tasks import UnknownGainGoalTask

        return UnknownGainGoalTask(dimension)


class VelocityConfig(_Task):
    """`VelocityTask`: keep a constant velocity."""

    kind: Literal["velocity"] = "velocity"
    unit: ClassVar[str] = "m/s"
    is_place: ClassVar[bool] = False

    def build(self, bodies: Sequence[str], dimension: int = 2) -> Task:
        """The `VelocityTask`."""
        from torchfsid.robots.tasks import VelocityTask

        return VelocityTask(dimension)


class FormationConfig(_Task):
    """`FormationTask`: keep an offset to the body `leader`, with a known gain [1/s].

    Attributes:
        gain: gain of the nominal control [1/s].
        leader: the body whose position the offset is added to.
    """

    kind: Literal["formation"] = "formation"
    gain: Positive
    leader: BodyName
    is_place: ClassVar[bool] = False
    suspects: ClassVar[tuple[str, ...]] = ("gain", "leader")

    @property
    def required(self) -> tuple[str, ...]:
        return (self.leader,)

    def build(self, bodies: Sequence[str], dimension: int = 2) -> Task:
        """The `FormationTask` among these bodies.

        Raises:
            ConfigError: `leader` is not among them.
        """
        from torchfsid.robots.tasks import FormationTask

        require_body("task.leader", self.leader, bodies)
        return FormationTask(self.gain, list(bodies).index(self.leader), dimension)


class OrbitConfig(_Task):
    """`OrbitTask`: circle a centre at a known rate [rad/s], positive if anticlockwise.

    Attributes:
        rate: angular rate [rad/s], positive if anticlockwise.
    """

    kind: Literal["orbit"] = "orbit"
    rate: Number
    suspects: ClassVar[tuple[str, ...]] = ("rate",)

    @property
    def dimensions(self) -> tuple[int, ...]:
        return (2,)

    def build(self, bodies: Sequence[str], dimension: int = 2) -> Task:
        """The `OrbitTask` with these values."""
        from torchfsid.robots.tasks import OrbitTask

        return OrbitTask(self.rate)


class PatrolConfig(_Task):
    """`PatrolTask`: follow a closed path.

    Attributes:
        gain: gain of the nominal control [1/s].
        rate: angular rate of the first harmonic [rad/s].
        harmonics: number of harmonics of the path.
    """

    kind: Literal["patrol"] = "patrol"
    gain: Positive
    rate: Number
    harmonics: Annotated[int, Field(strict=True, ge=1)] = 1
    suspects: ClassVar[tuple[str, ...]] = ("gain", "rate", "harmonics")

    def parameters(self, dimension: int) -> int:
        return dimension * (1 + 2 * self.harmonics)

    def build(self, bodies: Sequence[str], dimension: int = 2) -> Task:
        """The `PatrolTask` with these values."""
        from torchfsid.robots.tasks import PatrolTask

        return PatrolTask(self.gain, self.rate, self.harmonics, dimension)


TaskConfig = Annotated[
    GoalConfig | UnknownGainGoalConfig | VelocityConfig | FormationConfig | OrbitConfig | PatrolConfig,
    Field(discriminator="kind"),
]
