r"""Avoidance of other bodies: one row A u <= b for each (G., Eq. (6), in the units of control barrier functions).

With dx = x - x_j and h >= 0 the safe side:

    squared    h = |dx|^2 - Ds^2     -2 dx.u        <= alpha(h)  [- 2 dx.u_j]
    euclidean  h = |dx| - Ds         -(dx/|dx|).u   <= alpha(h)  [- (dx/|dx|).u_j]

The bracket is the neighbour's share. It is absent (`none`, the paper), or uses the neighbour's velocity now (`current`:
one joint QP over the team) or one sample ago (`previous`). The paper's row, a = -dx, b = gamma/2 h, is half the row of
`squared` with alpha(h) = gamma h. It is the same half-space, and nothing here depends on the scale of a row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.device import all_seen
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, dot
from torchfsid.robots.arguments import for_samples, require_choice, require_each, require_numbers
from torchfsid.robots.bounds import ErrorBounds, RowErrors
from torchfsid.robots.measurement import Measurement
from torchfsid.tolerances import ROUND_OFF

NeighbourVelocity = Literal["none", "current", "previous"]


class Geometry(NamedTuple):
    """What the rows are made of.

    Attributes:
        squared: squared distances r^2 [m^2].
        gradient: dh/dx, of length 2 r or 1.
        share: dh/dx.u_j, the neighbours' shares; 0 if the rows do not use them.
    """

    squared: Float[Tensor, "*batch m"]
    gradient: Float[Tensor, "*batch m n"]
    share: Float[Tensor, "*batch m"]

    @property
    def r(self) -> Float[Tensor, "*batch m"]:
        """Distances [m]."""
        return torch.where(self.squared > 0, _root(self.squared), 0.0)


class Sight(NamedTuple):
    """How well bodies are seen, given bounds on the errors of positions.

    Attributes:
        r: distances [m]; 1 where not `clear`.
        e: bounds on their errors [m].
        clear: whether r > e, so that the direction is known.
        angle: bounds on the errors of the directions [rad].
        loose: bounds on the change of the slack by turning the row and by the neighbour's velocity error [m/s].
    """

    r: Float[Tensor, "*batch m"]
    e: Float[Tensor, "*batch m"]
    clear: Bool[Tensor, "*batch m"]
    angle: Float[Tensor, "*batch m"]
    loose: Float[Tensor, "*batch m"]


@dataclass(frozen=True)
class ClassK:
    """alpha(h) = gain sign(h) |h|^power, an extended class-K function. A gain (B, 1) is one for each robot.

    Raises:
        InputError: gain or power is not positive. When called: h is not that of B robots, or of several of their
            samples, concatenated.
    """

    gain: float | Tensor
    power: float = 1.0

    def __post_init__(self) -> None:
        require_numbers("class_k.gain", "a positive number", self.gain, lambda gain: gain > 0)
        require_numbers("class_k.power", "a positive number", self.power, lambda power: power > 0)

    def __call__(self, h: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        return self._gain_of(h) * (h if self.power == 1 else h.sign() * h.abs() ** self.power)

    def _gain_of(self, h: Tensor) -> float | Tensor:
        gain = self.gain
        if not isinstance(gain, Tensor) or gain.ndim != 2 or gain.shape[-1] != 1 or h.ndim not in (1, 2):
            return gain
        of_items = for_samples("class_k.gain", gain.squeeze(-1), h.shape[:1])
        return of_items.unsqueeze(-1) if isinstance(of_items, Tensor) and h.ndim == 2 else of_items


@dataclass(frozen=True)
class CollisionAvoidance:
    """One row per body: keep the distance `safety_distance`, or radius_i + radius_j + `margin`, both in [m].

    `safety_distance` may be a tensor (m,), one distance per body.

    Raises:
        InputError: not exactly one of the two is given, or an argument has a wrong type. When called: `margin` needs
            radii, or `neighbour_velocity` needs velocities, that the measurement does not have.
    """

    class_k: ClassK
    safety_distance: float | Tensor | None = None
    margin: float | None = None
    distance: Literal["squared", "euclidean"] = "squared"
    neighbour_velocity: NeighbourVelocity = "none"
    soft: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.class_k, ClassK):
            raise InputError("class_k", "a class-K function, e.g. ClassK(gain=1.0)", repr(self.class_k))
        require_distance(self.safety_distance, self.margin)
        require_choice("distance", self.distance, ("squared", "euclidean"))
        require_choice("neighbour_velocity", self.neighbour_velocity, get_args(NeighbourVelocity))

    def __call__(self, measurement: Measurement) -> Halfspaces:
        require_each("class_k.gain", self.class_k.gain, measurement)
        Ds = distance_kept(self.safety_distance, self.margin, measurement.radius, measurement.body_radii)
        if self.distance == "squared":  # the most frequent one needs no distances
            away = away_from_bodies(measurement)
            A, h = -2 * away, dot(away, away) - Ds**2
        else:
            seen = self.geometry(measurement)
            A, h = -seen.gradient, seen.r - Ds
        b = self.class_k(h)
        if self.neighbour_velocity != "none":
            b = b + dot(A, self._neighbours(measurement))
        return Halfspaces(A, b).where(measurement.present)

    def geometry(self, measurement: Measurement) -> Geometry:
        """Distances, gradients of h and the neighbours' shares, which depend on neither gain nor safety distance."""
        away = away_from_bodies(measurement)
        squared = dot(away, away)
        gradient = 2 * away
        if self.distance == "euclidean":  # at the place of a body itself the direction is unknown: the row is NaN
            gradient = torch.where((squared > 0).unsqueeze(-1), away / _root(squared).unsqueeze(-1), math.nan)
        share = torch.zeros_like(squared)
        if self.neighbour_velocity != "none":
            share = dot(gradient, self._neighbours(measurement))
        return Geometry(squared, gradient, share)

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        """Bounds on the errors of the rows, with r = |dx| known up to e.

        The boundary phi(r) = alpha(h)/|dh/dx| grows with r. It is wrong by at most phi(r) - phi(r - e) or
        phi(r + e) - phi(r), whichever is larger.

        Raises:
            InputError: class_k.power < 1/2 with squared distances: phi would not be monotone.
        """
        self.require_monotone("positions have errors")
        sight, present = self.sight(measurement, bounds, self.geometry(measurement)), measurement.present
        r = torch.where(sight.clear, sight.r, 1.0)
        Ds = distance_kept(self.safety_distance, self.margin, measurement.radius, measurement.body_radii)
        e = torch.where(sight.clear, sight.e, 0.0)
        nearer, here, further = (self._boundary(at, Ds) for at in ((r - e).clamp(min=1e-9), r, r + e))
        moved = torch.maximum(here - nearer, further - here)
        slack = torch.where(sight.clear, moved, math.inf) + sight.loose
        return RowErrors(torch.where(present, sight.angle, 0.0), torch.where(present, slack, 0.0))

    def sight(self, measurement: Measurement, bounds: ErrorBounds, seen: Geometry) -> Sight:
        """How well each body is seen.

        The direction is wrong by at most asin(e/r), and unknown if e >= r. Turning the row changes the slack by at most
        2 sin(angle/2) |u - u_j|.
        """
        e = bounds.position.unsqueeze(-1) + bounds.body_position
        clear = seen.squared > e.square()
        loose = torch.zeros_like(e) if self.neighbour_velocity == "none" else bounds.body_velocity
        if all_seen(clear & (e == 0)):
            return Sight(seen.r, e, clear, e, loose)
        r = torch.where(clear, seen.squared, 1.0).sqrt()
        angle = torch.where(clear, (torch.where(clear, e, 0.0) / r).clamp(max=1.0).arcsin(), math.pi)
        motion = torch.zeros_like(seen.gradient) if measurement.u is None else measurement.u.unsqueeze(-2)
        if self.neighbour_velocity != "none":
            motion = motion - self._neighbours(measurement)
        return Sight(r, e, clear, angle, 2 * (angle / 2).sin() * motion.norm(dim=-1) + loose)

    def slack_left_out(self, measurement: Measurement) -> Float[Tensor, "*batch"]:
        """phi(R) - |u| - V, the least slack that the row of a body without a slot can have [m/s].

        R is the least distance of these bodies. V is their largest speed, or 0 if the rows do not use it.

        Raises:
            InputError: class_k.power < 1/2 with squared distances: phi would not be monotone.
        """
        self.require_monotone("bodies are left out")
        left_out, u = measurement.left_out, measurement.u
        assert left_out is not None
        assert u is not None
        Ds = distance_kept(self.safety_distance, self.margin, measurement.radius, left_out.radius.unsqueeze(-1))
        largest = Ds.amax(-1) if isinstance(Ds, Tensor) and Ds.ndim > 0 else Ds
        nearest = torch.where(left_out.distance.isfinite(), left_out.distance, 1.0)
        phi = self._boundary((nearest * (1 - ROUND_OFF)).clamp(min=1e-9), largest)
        speed = u.norm(dim=-1)
        if self.neighbour_velocity != "none":
            speed = speed + left_out.speed
        return phi - speed - ROUND_OFF * (phi.abs() + speed)

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return [f"avoid {body}" for body in bodies]

    def require_monotone(self, where: str) -> None:
        """Check that phi grows with the distance."""
        if self.distance == "squared" and self.class_k.power < 0.5:
            raise InputError("class_k.power", f"at least 1/2 where {where}", self.class_k.power)

    def _boundary(self, r: Tensor, Ds: Tensor | float) -> Tensor:
        """phi(r): the largest speed at which the robot may approach a standing body at distance r [m/s]."""
        if self.distance == "squared":
            return self.class_k(r**2 - Ds**2) / (2 * r)
        return self.class_k(r - Ds)

    def _neighbours(self, measurement: Measurement) -> Tensor:
        current = self.neighbour_velocity == "current"
        velocities = measurement.body_velocities if current else measurement.previous_body_velocities
        if velocities is None:
            raise InputError("measurement", f"the {self.neighbour_velocity} velocities of the bodies", None)
        return velocities


def require_distance(distance: float | Tensor | None, margin: float | None) -> None:
    """Check that a barrier has exactly one of safety distance and margin.

    Raises:
        InputError: it has both or neither, or the safety distance is not positive.
    """
    if (distance is None) == (margin is None):
        raise InputError("safety_distance, margin", "exactly one of them", (distance, margin))
    if distance is not None:
        require_numbers("safety_distance", "a positive distance [m]", distance, lambda d: d > 0)
    if margin is not None:
        require_numbers("margin", "a finite distance [m]", margin, torch.isfinite)


def distance_kept(
    distance: float | Tensor | None,
    margin: float | None,
    radius: Float[Tensor, "*batch"] | None,
    body_radii: Float[Tensor, "*batch m"] | None,
) -> float | Tensor:
    """The distances Ds that the centres of robots and bodies keep [m]: `distance`, or with a margin between discs.

    Raises:
        InputError: there is a margin, and there are no radii.
    """
    if margin is None:
        assert distance is not None
        return distance
    if radius is None or body_radii is None:
        raise InputError("measurement.radius", "radii, since the barrier is given by a margin", None)
    return radius.unsqueeze(-1) + body_radii + margin


def away_from_bodies(measurement: Measurement) -> Float[Tensor, "*batch m n"]:
    """x - x_j [m]. Slots without a body get a nonzero vector, so that norms and their gradients are finite."""
    present, away = measurement.present, measurement.x.unsqueeze(-2) - measurement.bodies
    return away if all_seen(present) else torch.where(present.unsqueeze(-1), away, 1.0)


def _root(squared: Tensor) -> Tensor:
    """The root, and 1 for 0, so that its gradient is finite."""
    return torch.where(squared > 0, squared, 1.0).sqrt()
