"""The barriers in configuration files. Each builds an object of `robots`.

Each barrier says what it needs from a log: the bodies' radii, and their velocities now or one sample earlier. It also
says whether its rows are uncertain even if all but the controls is exact (`Barrier.uncertain`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from torchfsid.config.avoidance import AvoidanceConfig, ClassKConfig, SecondOrderAvoidanceConfig
from torchfsid.config.documents import Strict, wrong
from torchfsid.config.quantities import (
    Flag,
    Lengths,
    NonNegative,
    NonNegativeOrInterval,
    Place,
    Positive,
    PositiveOrInterval,
    Units,
    as_interval,
    as_middle,
    require_box,
    require_interval,
)
from torchfsid.errors import ConfigError

if TYPE_CHECKING:
    from torchfsid.robots.barriers import Barrier


class _RobotsOwn(Strict):
    """A barrier whose rows do not depend on other bodies.

    Attributes:
        suspects: the keys to look at where a row of the barrier contradicts a log.
    """

    suspects: ClassVar[tuple[str, ...]] = ("limit",)
    is_unknown: ClassVar[bool] = False
    is_second_order: ClassVar[bool] = False
    uncertain: ClassVar[bool] = False
    narrowed: ClassVar[Units] = {}

    @property
    def dimension(self) -> int | None:
        """The dimension in which the rows are, 2 or 3. None: in both."""
        return None

    @property
    def uses_radius(self) -> bool:
        return False

    def require_radii(self, radius: Sequence[float] | None) -> None:
        pass

    @property
    def neighbour_velocity(self) -> Literal["none"]:
        return "none"


class SpeedBoxConfig(_RobotsOwn):
    """`SpeedBox`: a limit per axis [m/s].

    Attributes:
        limit: the largest speed along each axis [m/s].
        soft: the controller may violate the rows.
    """

    kind: Literal["speed_box"] = "speed_box"
    limit: Lengths
    soft: Flag = False

    @property
    def dimension(self) -> int:
        return len(self.limit)

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier. It does not depend on the bodies."""
        from torchfsid.robots.barriers import SpeedBox

        return SpeedBox(self.limit, self.soft)


class AccelerationBoxConfig(_RobotsOwn):
    """`SpeedBox` of robots that are driven by accelerations: a limit per axis [m/s2].

    Attributes:
        limit: the largest acceleration along each axis [m/s2].
        soft: the controller may violate the rows.
    """

    kind: Literal["acceleration_box"] = "acceleration_box"
    limit: Lengths
    soft: Flag = False
    is_second_order: ClassVar[bool] = True

    @property
    def dimension(self) -> int:
        return len(self.limit)

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier. It does not depend on the bodies."""
        from torchfsid.robots.barriers import SpeedBox

        return SpeedBox(self.limit, self.soft, "acceleration")


class SpeedPolygonConfig(_RobotsOwn):
    """`SpeedPolygon`: a regular polygon of circumradius `limit` [m/s].

    Attributes:
        sides: number of sides. A side, not a corner, crosses the first axis.
        limit: circumradius: the corners have this speed [m/s].
        soft: the controller may violate the rows.
    """

    kind: Literal["speed_polygon"] = "speed_polygon"
    sides: Annotated[int, Field(strict=True, ge=3, le=360)]
    limit: Positive
    soft: Flag = False

    @property
    def dimension(self) -> int:
        return 2

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier. It does not depend on the bodies."""
        from torchfsid.robots.barriers import SpeedPolygon

        return SpeedPolygon(self.sides, self.limit, self.soft)


class ArenaConfig(_RobotsOwn):
    """`Arena`: keep a distance `margin` [m] from the walls of a box [m].

    Attributes:
        lower: lower corner of the box [m].
        upper: upper corner of the box [m].
        margin: distance that is kept from the walls [m].
        class_k: the function alpha of the barrier.
        soft: the controller may violate the rows.
    """

    kind: Literal["arena"] = "arena"
    lower: Place
    upper: Place
    margin: NonNegative = 0.0
    class_k: ClassKConfig
    soft: Flag = False
    suspects: ClassVar[tuple[str, ...]] = ("class_k.gain", "margin", "lower", "upper")

    @property
    def dimension(self) -> int:
        return len(self.lower)

    @model_validator(mode="after")
    def _is_a_box(self) -> ArenaConfig:
        require_box(self.lower, self.upper)
        return self

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier. It does not depend on the bodies."""
        from torchfsid.robots.barriers import Arena

        return Arena(self.lower, self.upper, self.class_k.build(), self.margin, self.soft)


class SpeedDiscConfig(_RobotsOwn):
    """`SpeedDisc`: |u| <= limit [m/s].

    Attributes:
        limit: the largest speed [m/s].
        soft: the controller may violate the rows.
    """

    kind: Literal["speed_disc"] = "speed_disc"
    limit: Positive
    soft: Flag = False
    uncertain: ClassVar[bool] = True

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier. It does not depend on the bodies."""
        from torchfsid.robots.speed_disc import SpeedDisc

        return SpeedDisc(self.limit, self.soft)


class NeighboursConfig(Strict):
    """Which bodies an ORCA controller avoids: the `count` nearest ones nearer than `distance` [m].

    Attributes:
        count: the largest number of bodies.
        distance: distance beyond which bodies are not avoided [m].
    """

    count: Annotated[int, Field(strict=True, ge=1)]
    distance: Positive


class OrcaConfig(Strict):
    """`Orca`. Radii are those of the log.

    Attributes:
        time_horizon: horizon of the controller [s].
        time_step: its time step [s].
        max_speed: its speed limit [m/s].
        neighbours: the bodies that it avoids.
        margin: distance that is added to the sum of two radii [m]. Like the horizon it may be unknown, [low, high].
        push_away: a neighbour nearer than the radii and this counts as being there [m].
    """

    kind: Literal["orca"] = "orca"
    time_horizon: PositiveOrInterval
    time_step: Positive
    max_speed: Positive
    neighbours: NeighboursConfig
    margin: NonNegativeOrInterval = 0.0
    push_away: NonNegative = 0.0
    is_unknown: ClassVar[bool] = False
    is_second_order: ClassVar[bool] = False
    uncertain: ClassVar[bool] = True
    suspects: ClassVar[tuple[str, ...]] = ("time_horizon", "margin", "max_speed", "time_step")
    narrowed: ClassVar[Units] = {("time_horizon",): "s", ("margin",): "m"}

    @model_validator(mode="after")
    def _is_ordered(self) -> OrcaConfig:
        require_interval("time_horizon", self.time_horizon)
        require_interval("margin", self.margin)
        if as_interval(self.margin)[0] < 0:
            raise wrong(f"expected distances >= 0, got {self.margin}", "margin")
        if self.push_away and isinstance(self.margin, tuple):
            raise wrong("expected a known margin with push_away", "margin")
        return self

    @property
    def dimension(self) -> int:
        return 2

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
        if as_interval(self.margin)[0] + min(radius) <= 0:
            raise ConfigError("barriers: orca needs positive radii, or a margin")

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier. It does not depend on the bodies' names."""
        from torchfsid.robots.orca import Orca

        low, high = as_interval(self.time_horizon)
        rate, rate_error = as_middle((1 / high, 1 / low))
        margin, margin_error = as_middle(self.margin)
        return Orca(
            1 / rate if low < high else low,
            self.time_step,
            self.max_speed,
            self.neighbours.count,
            self.neighbours.distance,
            margin,
            self.push_away,
            rate_error,
            margin_error,
        )


class BufferedVoronoiConfig(_RobotsOwn):
    """`BufferedVoronoi`: the cells of the Crazyflie's firmware.

    Attributes:
        ellipsoid: radii of one robot's ellipsoid [m].
        horizon: the time for which a velocity is kept [s].
        max_speed: the largest speed on every axis [m/s].
        sidestep: distance of a wall below which the firmware may turn the command [m]; 0 if it was switched off.
        soft: the controller may violate the rows.
    """

    kind: Literal["buffered_voronoi"] = "buffered_voronoi"
    ellipsoid: Lengths
    horizon: Positive
    max_speed: Positive
    sidestep: NonNegative = 0.25
    soft: Flag = False
    uncertain: ClassVar[bool] = True

    @model_validator(mode="after")
    def _can_move(self) -> BufferedVoronoiConfig:
        if self.horizon * self.max_speed <= self.sidestep:
            reach = f"horizon * max_speed = {self.horizon * self.max_speed:g} m"
            raise wrong(f"expected less than {reach}: every command could be turned", "sidestep")
        return self

    @property
    def dimension(self) -> int:
        return len(self.ellipsoid)

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier. It does not depend on the bodies' names."""
        from torchfsid.robots.buffered_voronoi import BufferedVoronoi

        return BufferedVoronoi(self.ellipsoid, self.horizon, self.max_speed, self.sidestep, self.soft)


SECOND_ORDER = "avoidance, order: 2"


def _kind(value: Any) -> str | None:
    if not isinstance(value, Mapping):  # a record, or no section at all, which any of the classes refuses
        value = {"kind": getattr(value, "kind", "avoidance"), "order": getattr(value, "order", 2)}
    kind = value.get("kind")
    if kind == "avoidance" and value.get("order") == 2:
        return SECOND_ORDER
    return kind if kind is None or isinstance(kind, str) else ""


BarrierConfig = Annotated[
    Annotated[AvoidanceConfig, Tag("avoidance")]
    | Annotated[SecondOrderAvoidanceConfig, Tag(SECOND_ORDER)]
    | Annotated[OrcaConfig, Tag("orca")]
    | Annotated[SpeedDiscConfig, Tag("speed_disc")]
    | Annotated[SpeedBoxConfig, Tag("speed_box")]
    | Annotated[AccelerationBoxConfig, Tag("acceleration_box")]
    | Annotated[SpeedPolygonConfig, Tag("speed_polygon")]
    | Annotated[ArenaConfig, Tag("arena")]
    | Annotated[BufferedVoronoiConfig, Tag("buffered_voronoi")],
    Discriminator(_kind),
]
