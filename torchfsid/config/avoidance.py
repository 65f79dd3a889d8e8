"""Avoidance barriers in configuration files: `robots.avoidance`, and `robots.second_order` with `order: 2`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator, model_validator

from torchfsid.config.documents import Strict, wrong
from torchfsid.config.quantities import (
    BodyName,
    Flag,
    Lengths,
    NonNegativeOrInterval,
    Positive,
    PositiveOrInterval,
    Units,
    as_interval,
    as_middle,
    known,
    require_body,
    require_interval,
)
from torchfsid.errors import ConfigError

if TYPE_CHECKING:
    from torch import Tensor

    from torchfsid.robots.avoidance import ClassK
    from torchfsid.robots.barriers import Barrier
    from torchfsid.robots.unknown_avoidance import UnknownAvoidance


class UnknownClassKConfig(Strict):
    """`ClassKConfig` whose gain may be unknown within [low, high].

    Attributes:
        gain: gain of alpha, a number or bounds [low, high]. Its unit makes alpha(h) a rate of h: [1/s] with power 1.
        power: exponent of alpha.
    """

    gain: PositiveOrInterval
    power: Positive = 1.0

    @model_validator(mode="after")
    def _is_ordered(self) -> UnknownClassKConfig:
        require_interval("gain", self.gain)
        return self


class ClassKConfig(Strict):
    """`ClassK`: alpha(h) = gain sign(h) |h|^power.

    Attributes:
        gain: gain of alpha. Its unit makes alpha(h) a rate of h: [1/s] with power 1.
        power: exponent of alpha.
    """

    gain: Positive
    power: Positive = 1.0

    def build(self) -> ClassK:
        """The `ClassK` with these values."""
        from torchfsid.robots.avoidance import ClassK

        return ClassK(self.gain, self.power)


class _KeepsDistance(Strict):
    """A barrier between bodies, with a safety distance, a margin or an ellipsoid. Exactly one of them is given.

    Attributes:
        safety_distance: distance between centres [m].
        safety_distances: distances to single bodies that replace `safety_distance` [m].
        margin: distance between the discs of two bodies [m], if the log has radii.
        ellipsoid: semi-axes of the ellipsoid around a body that the centres of others keep out of [m]. h is then that
            of the coordinates divided by them, with the safety distance 1.
        soft: the controller may violate the rows.
    """

    safety_distance: PositiveOrInterval | None = None
    safety_distances: dict[BodyName, Positive] = Field(default_factory=dict)
    margin: NonNegativeOrInterval | None = None
    ellipsoid: Lengths | None = None
    soft: Flag = False

    @model_validator(mode="after")
    def _one_distance(self) -> _KeepsDistance:
        if self.ellipsoid is not None:
            if self.safety_distance is not None or self.margin is not None or self.safety_distances:
                raise wrong("expected no other distance beside it", "ellipsoid")
            return self
        if (self.safety_distance is None) == (self.margin is None):
            raise wrong(f"expected safety_distance or margin, got {'neither' if self.margin is None else 'both'}")
        if self.safety_distances and self.margin is not None:
            raise wrong(
                "bodies have a distance of their own beside a safety_distance, not a margin", "safety_distances"
            )
        require_interval("safety_distance", self.safety_distance)
        require_interval("margin", self.margin)
        return self

    @property
    def dimension(self) -> int | None:
        """The dimension in which the rows are, 2 or 3. None: in both."""
        return None if self.ellipsoid is None else len(self.ellipsoid)

    @property
    def uses_radius(self) -> bool:
        """Do the rows need the bodies' radii?"""
        return self.margin is not None

    @property
    def _distance(self) -> str:
        """The key of the distance that is kept."""
        return "safety_distance" if self.margin is None else "margin"

    def require_radii(self, radius: Sequence[float] | None) -> None:
        """Check that the log has the radii that the rows need [m].

        Raises:
            ConfigError: radii are missing, or are zero with a margin of zero.
        """
        if self.margin is not None and radius is None:
            raise ConfigError("barriers: a margin needs the radii, but the log has none (column radius, bag.radius)")
        if self.margin is not None and radius is not None and as_interval(self.margin)[0] + min(radius) <= 0:
            raise ConfigError("barriers: a margin of 0 needs positive radii")

    def _distances(self, bodies: Sequence[str]) -> float | Tensor | None:
        """The safety distances to these bodies [m]. They are known."""
        import torch

        for name in self.safety_distances:
            require_body(f"safety_distances.{name}", name, bodies)
        Ds = known(self.safety_distance)
        if not self.safety_distances:
            return Ds
        return torch.tensor([self.safety_distances.get(body, Ds) for body in bodies], dtype=torch.float64)


class AvoidanceConfig(_KeepsDistance):
    """`CollisionAvoidance`, by `safety_distance`, or by `margin` if the log has radii.

    Gain, safety distance and margin may be unknown within [low, high]. Then this is an `UnknownAvoidance`.

    Attributes:
        order: 1, of robots that are driven by velocities.
        distance: form of h, see `robots.avoidance`.
        class_k: the function alpha of the barrier.
        neighbour_velocity: which velocities of other bodies the rows use.
        shared: whether unknown values are those of the whole team, or of each robot.
    """

    kind: Literal["avoidance"] = "avoidance"
    order: Literal[1] = 1
    distance: Literal["squared", "euclidean"] = "squared"
    class_k: UnknownClassKConfig
    neighbour_velocity: Literal["none", "current", "previous"] = "none"
    shared: Literal["team", "robot"] | None = None
    is_second_order: ClassVar[bool] = False
    uncertain: ClassVar[bool] = False
    narrowed: ClassVar[Units] = {}

    @field_validator("class_k", mode="before")
    @classmethod
    def _has_one_gain(cls, value: Any) -> Any:
        if isinstance(value, list | tuple):
            raise wrong("expected keys and values, got a list (two gains need order: 2 and double integrators)")
        return value

    @model_validator(mode="after")
    def _is_known_or_shared(self) -> AvoidanceConfig:
        if self.safety_distances and self.is_unknown:
            raise wrong("bodies have no distances of their own where safety parameters are unknown", "safety_distances")
        if self.ellipsoid is not None and self.is_unknown:
            raise wrong("expected a known gain with an ellipsoid", "class_k.gain")
        if self.shared is not None and not self.is_unknown:
            raise wrong("expected an unknown gain or distance [low, high] to be shared", "shared")
        return self

    @property
    def suspects(self) -> tuple[str, ...]:
        """The keys to look at where a row of the barrier contradicts a log."""
        return ("class_k.gain", "class_k.power", self._distance, "neighbour_velocity")

    @property
    def is_unknown(self) -> bool:
        """Is a value given as [low, high]?"""
        return any(isinstance(value, tuple) for value in (self.class_k.gain, self.safety_distance, self.margin))

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier among these bodies. Its values are known.

        Raises:
            ConfigError: `safety_distances` names a body that is not there.
        """
        from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
        from torchfsid.robots.ellipsoid import Ellipsoid

        Ds, gain, margin = self._distances(bodies), known(self.class_k.gain), known(self.margin)
        assert gain is not None
        class_k = ClassK(gain, self.class_k.power)
        if self.ellipsoid is not None:
            ball = CollisionAvoidance(class_k, 1.0, None, self.distance, self.neighbour_velocity, self.soft)
            return Ellipsoid(ball, self.ellipsoid)
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


class SecondOrderAvoidanceConfig(_KeepsDistance):
    """`SecondOrderAvoidance`, of robots that are driven by accelerations.

    Gains, safety distance and margin may be unknown within [low, high].

    Attributes:
        order: 2.
        distance: form of h, see `robots.second_order`.
        class_k: the two gains k1, k2 [1/s].
        neighbour_acceleration: which accelerations of other bodies the rows use.
    """

    kind: Literal["avoidance"] = "avoidance"
    order: Literal[2]
    distance: Literal["squared"] = "squared"
    class_k: Annotated[tuple[UnknownClassKConfig, ...], Field(min_length=2, max_length=2)]
    neighbour_acceleration: Literal["none", "current"] = "none"
    is_unknown: ClassVar[bool] = False
    is_second_order: ClassVar[bool] = True
    narrowed: ClassVar[Units] = {
        ("class_k", 0, "gain"): "1/s",
        ("class_k", 1, "gain"): "1/s",
        ("safety_distance",): "m",
        ("margin",): "m",
    }

    @model_validator(mode="after")
    def _is_linear(self) -> SecondOrderAvoidanceConfig:
        for i, class_k in enumerate(self.class_k):
            if class_k.power != 1:
                raise wrong(f"expected 1 with order: 2, got {class_k.power:g}", f"class_k[{i}].power")
        if self.safety_distances and isinstance(self.safety_distance, tuple):
            raise wrong(
                "bodies have no distances of their own where the safety distance is unknown", "safety_distances"
            )
        return self

    @property
    def suspects(self) -> tuple[str, ...]:
        """The keys to look at where a row of the barrier contradicts a log."""
        return ("class_k.0.gain", "class_k.1.gain", self._distance, "neighbour_acceleration")

    @property
    def uncertain(self) -> bool:
        values = (*(class_k.gain for class_k in self.class_k), self.safety_distance, self.margin)
        return any(isinstance(value, tuple) for value in values)

    @property
    def neighbour_velocity(self) -> Literal["none", "current"]:
        """Which controls of other bodies the rows use."""
        return self.neighbour_acceleration

    def build(self, bodies: Sequence[str]) -> Barrier:
        """The barrier among these bodies.

        Raises:
            ConfigError: `safety_distances` names a body that is not there.
        """
        from torchfsid.robots.ellipsoid import Ellipsoid
        from torchfsid.robots.second_order import SecondOrderAvoidance

        (k1, of_1), (k2, of_2) = (as_middle(class_k.gain) for class_k in self.class_k)
        margin, error = None, 0.0
        if self.margin is not None:
            Ds, (margin, error) = None, as_middle(self.margin)
        elif isinstance(self.safety_distance, tuple):
            Ds, error = as_middle(self.safety_distance)
        else:
            Ds = 1.0 if self.ellipsoid is not None else self._distances(bodies)
        barrier = SecondOrderAvoidance(
            (k1, k2), Ds, margin, self.neighbour_acceleration, self.soft, (of_1, of_2), distance_error=error
        )
        return barrier if self.ellipsoid is None else Ellipsoid(barrier, self.ellipsoid)


def _commonest_sum(radius: Sequence[float]) -> float:
    """The sum of radii that most pairs of bodies have [m]."""
    pairs = Counter(sum(pair) for pair in combinations(radius, 2)) or Counter([2 * radius[0]])
    return max(pairs, key=lambda total: (pairs[total], total))
