"""The barriers in configuration files. Each builds an object of `robots.avoidance` or `robots.barriers`.

Each barrier says what it needs from a log: the bodies' radii, and their velocities now or one sample earlier.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from torchfsid.config.documents import Strict, wrong
from torchfsid.config.quantities import (
    BodyName,
    Flag,
    NonNegative,
    NonNegativeOrInterval,
    PlanarVector,
    Positive,
    PositiveOrInterval,
    as_interval,
    known,
    require_body,
    require_box,
    require_interval,
)
from torchfsid.errors import ConfigError

if TYPE_CHECKING:
    from torchfsid.robots.avoidance import ClassK
    from torchfsid.robots.barriers import Barrier
    from torchfsid.robots.unknown_avoidance import UnknownAvoidance


class UnknownClassKConfig(Strict):
    """`ClassKConfig` whose gain may be unknown within [low, high]."""

    gain: PositiveOrInterval
    power: Positive = 1.0

    @model_validator(mode="after")
    def _is_ordered(self) -> UnknownClassKConfig:
        require_interval("gain", self.gain)
        return self


class ClassKConfig(Strict):
    """`ClassK`: alpha(h) = gain sign(h) |h|^power."""

    gain: Positive
    power: Positive = 1.0

    def build(self) -> ClassK:
        """The `ClassK` with these values."""
        from torchfsid.robots.avoidance import ClassK

        return ClassK(self.gain, self.power)


class AvoidanceConfig(Strict):
    """`CollisionAvoidance`, by `safety_distance`, or by `margin` if the log has radii. Exactly one of the two is given.

    Gain, safety distance and margin may be unknown within [low, high]. Then this is an `UnknownAvoidance`.

    Attributes:
        distance: form of h, see `robots.avoidance`.
        safety_distance: distance between centres [m].
        safety_distances: distances to single bodies that replace `safety_distance` [m].
        margin: distance between the discs of two bodies [m].
        class_k: the function alpha of the barrier.
        neighbour_velocity: which velocities of other bodies the rows use.
        soft: the controller may violate the rows.
        shared: whether unknown values are those of the whole team, or of each robot.
    """

    kind: Literal["avoidance"] = "avoidance"
    distance: Literal["squared", "euclidean"] = "squared"
    safety_distance: PositiveOrInterval | None = None
    safety_distances: dict[BodyName, Positive] = Field(default_factory=dict)
    margin: NonNegativeOrInterval | None = None
    class_k: UnknownClassKConfig
    neighbour_velocity: Literal["none", "current", "previous"] = "none"
    soft: Flag = False
    shared: Literal["team", "robot"] | None = None

    @model_validator(mode="after")
    def _one_distance(self) -> AvoidanceConfig:
        if (self.safety_distance is None) == (self.margin is None):
            raise wrong(f"expected safety_distance or margin, got {'neither' if self.margin is None else 'both'}")
        if self.safety_distances and self.margin is not None:
            raise wrong(
                "bodies have a distance of their own beside a safety_distance, not a margin", "safety_distances"
            )
        require_interval("safety_distance", self.safety_distance)
        require_interval("margin", self.margin)
        if self.safety_distances and self.is_unknown:
            raise wrong("bodies have no distances of their own where safety parameters are unknown", "safety_distances")
        if self.shared is not None and not self.is_unknown:
            raise wrong("expected an unknown gain or distance [low, high] to be shared", "shared")
        return self

    @property
    def is_unknown(self) -> bool:
        """Is a value given as [low, high]?"""
        return any(isinstance(value, tuple) for value in (self.class_k.gain, self.safety_distance, self.margin))

    @property
    def uses_radius(self) -> bool:
        """Do the rows need the bodies' radii?"""
        return self.margin is not None

    def require_radii(self, radius: Sequence[float] | None) -> None:
        """Check that the log has the radii that the rows need [m].

        Raises:
            ConfigError: radii are missing, or are zero with a margin of zero.
        """
        if self.margin is not None and radius is None:
            raise ConfigError("barriers: a margin needs the radii, but the log has none (column radius, bag.radius)")
        if self.margin is not None and radius is not None and as_interval(self.margin)[0] + min(radius) <= 0:
            raise ConfigError("barriers: a margin of 0 needs positive radii")

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier among these bodies. Its values are known.

        Raises:
            ConfigError: `safety_distances` names a body that is not there.
        """
        import torch

        from torchfsid.robots.avoidance import ClassK, CollisionAvoidance

        for name in self.safety_distances:
            require_body(f"safety_distances.{name}", name, bodies)
        gain, Ds, margin = (known(value) for value in (self.class_k.gain, self.safety_distance, self.margin))
        assert gain is not None
        if self.safety_distances:
            Ds = torch.tensor([self.safety_distances.get(body, Ds) for body in bodies], dtype=torch.float64)
        class_k = ClassK(gain, self.class_k.power)
        return CollisionAvoidance(class_k, Ds, margin, self.distance, self.neighbour_velocity, self.soft)

    def build_unknown(self, radius: Sequence[float] | None) -> UnknownAvoidance:
        """The barrier with intervals for all values, among bodies with these radii [m]."""
        from torchfsid.robots.unknown_avoidance import UnknownAvoidance

        between = None if self.safety_distance is None else as_interval(self.safety_distance)
        margin = None if self.margin is None else as_interval(self.margin)
        return UnknownAvoidance(
            as_interval(self.class_k.gain),
            between,
            margin,
            self.class_k.power,
            self.distance,
            self.neighbour_velocity,
            self.soft,
            self.shared or "team",
            _commonest_sum(radius) if margin is not None and radius is not None else 0.0,
        )


def _commonest_sum(radius: Sequence[float]) -> float:
    """The sum of radii that most pairs of bodies have [m]."""
    pairs = Counter(sum(pair) for pair in combinations(radius, 2)) or Counter([2 * radius[0]])
    return max(pairs, key=lambda total: (pairs[total], total))


class _RobotsOwn(Strict):
    """A barrier whose rows do not depend on other bodies."""

    is_unknown: ClassVar[bool] = False

    @property
    def uses_radius(self) -> bool:
        return False

    def require_radii(self, radius: Sequence[float] | None) -> None:
        pass

    @property
    def neighbour_velocity(self) -> Literal["none"]:
        return "none"


class SpeedBoxConfig(_RobotsOwn):
    """`SpeedBox`: a limit per axis [m/s]."""

    kind: Literal["speed_box"] = "speed_box"
    limit: Annotated[tuple[Positive, ...], Field(min_length=2, max_length=2)]
    soft: Flag = False

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier. It does not depend on the bodies."""
        from torchfsid.robots.barriers import SpeedBox

        return SpeedBox(self.limit, self.soft)


class SpeedPolygonConfig(_RobotsOwn):
    """`SpeedPolygon`: a regular polygon of circumradius `limit` [m/s]."""

    kind: Literal["speed_polygon"] = "speed_polygon"
    sides: Annotated[int, Field(strict=True, ge=3, le=360)]
    limit: Positive
    soft: Flag = False

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier. It does not depend on the bodies."""
        from torchfsid.robots.barriers import SpeedPolygon

        return SpeedPolygon(self.sides, self.limit, self.soft)


class ArenaConfig(_RobotsOwn):
    """`Arena`: keep a distance `margin` [m] from the walls of a box [m]."""

    kind: Literal["arena"] = "arena"
    lower: PlanarVector
    upper: PlanarVector
    margin: NonNegative = 0.0
    class_k: ClassKConfig
    soft: Flag = False

    @model_validator(mode="after")
    def _is_a_box(self) -> ArenaConfig:
        require_box(self.lower, self.upper)
        return self

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier. It does not depend on the bodies."""
        from torchfsid.robots.barriers import Arena

        return Arena(self.lower, self.upper, self.class_k.build(), self.margin, self.soft)


class SpeedDiscConfig(_RobotsOwn):
    """`SpeedDisc`: |u| <= limit [m/s]."""

    kind: Literal["speed_disc"] = "speed_disc"
    limit: Positive
    soft: Flag = False

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier. It does not depend on the bodies."""
        from torchfsid.robots.speed_disc import SpeedDisc

        return SpeedDisc(self.limit, self.soft)


class NeighboursConfig(Strict):
    """Which bodies an ORCA controller avoids: the `count` nearest ones nearer than `distance` [m]."""

    count: Annotated[int, Field(strict=True, ge=1)]
    distance: Positive


class OrcaConfig(Strict):
    """`Orca`. Radii are those of the log.

    Attributes:
        time_horizon: horizon of the controller [s].
        time_step: its time step [s].
        max_speed: its speed limit [m/s].
        neighbours: the bodies that it avoids.
        margin: distance that is added to the sum of two radii [m].
        push_away: a neighbour nearer than the radii and this counts as being there [m].
    """

    kind: Literal["orca"] = "orca"
    time_horizon: Positive
    time_step: Positive
    max_speed: Positive
    neighbours: NeighboursConfig
    margin: NonNegative = 0.0
    push_away: NonNegative = 0.0
    is_unknown: ClassVar[bool] = False

    @property
    def uses_radius(self) -> bool:
        return True

    @property
    def neighbour_velocity(self) -> Literal["previous"]:
        return "previous"

    def require_radii(self, radius: Sequence[float] | None) -> None:
        """Check that the log has the radii that the rows need [m].

        Raises:
            ConfigError: radii are missing, or are zero without a margin.
        """
        if radius is None:
            raise ConfigError("barriers: orca needs the radii, but the log has none (column radius, bag.radius)")
        if self.margin + min(radius) <= 0:
            raise ConfigError("barriers: orca needs positive radii, or a margin")

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier. It does not depend on the bodies' names."""
        from torchfsid.robots.orca import Orca

        return Orca(
            self.time_horizon,
            self.time_step,
            self.max_speed,
            self.neighbours.count,
            self.neighbours.distance,
            self.margin,
            self.push_away,
        )


BarrierConfig = Annotated[
    AvoidanceConfig | OrcaConfig | SpeedDiscConfig | SpeedBoxConfig | SpeedPolygonConfig | ArenaConfig,
    Field(discriminator="kind"),
]
