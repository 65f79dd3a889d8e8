"""The barriers in configuration files. Each builds an object of `robots.avoidance` or `robots.barriers`.

Each barrier says what it needs from a log: the bodies' radii, and their velocities now or one sample earlier.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, model_validator

from torchfsid.config.documents import Strict, wrong
from torchfsid.config.quantities import (
    BodyName,
    Flag,
    NonNegative,
    PlanarVector,
    Positive,
    require_body,
    require_box,
)
from torchfsid.errors import ConfigError

if TYPE_CHECKING:
    from torchfsid.robots.avoidance import ClassK
    from torchfsid.robots.barriers import Barrier


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

    Attributes:
        distance: form of h, see `robots.avoidance`.
        safety_distance: distance between centres [m].
        safety_distances: distances to single bodies that replace `safety_distance` [m].
        margin: distance between the discs of two bodies [m].
        class_k: the function alpha of the barrier.
        neighbour_velocity: which velocities of other bodies the rows use.
        soft: the controller may violate the rows.
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
        if self.margin is not None and radius is not None and self.margin + min(radius) <= 0:
            raise ConfigError("barriers: a margin of 0 needs positive radii")

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier among these bodies.

        Raises:
            ConfigError: `safety_distances` names a body that is not there.
        """
        import torch

        from torchfsid.robots.avoidance import CollisionAvoidance

        for name in self.safety_distances:
            require_body(f"safety_distances.{name}", name, bodies)
        Ds = self.safety_distance
        if self.safety_distances:
            Ds = torch.tensor([self.safety_distances.get(body, Ds) for body in bodies], dtype=torch.float64)
        return CollisionAvoidance(
            self.class_k.build(), Ds, self.margin, self.distance, self.neighbour_velocity, self.soft
        )


class _RobotsOwn(Strict):
    """A barrier whose rows do not depend on other bodies."""

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


BarrierConfig = Annotated[
    AvoidanceConfig | SpeedBoxConfig | SpeedPolygonConfig | ArenaConfig, Field(discriminator="kind")
]
