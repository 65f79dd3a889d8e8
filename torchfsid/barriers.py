r"""What a robot must not do: rows A(x) u <= b(x) over its control, stacked from the barriers it uses.

Avoidance of body j, with dx = x - x_j and h >= 0 the safe side (G., Eq. (6), in the units of control barrier
functions):

    squared    h = |dx|^2 - Ds^2     -2 dx.u        <= alpha(h)  [- 2 dx.u_j]
    euclidean  h = |dx| - Ds         -(dx/|dx|).u   <= alpha(h)  [- (dx/|dx|).u_j]

The bracket is the neighbour's share: nothing (`none`, the paper), its velocity now (`current`: one joint QP over the
team) or one sample ago (`previous`). The paper's row, a = -dx, b = gamma/2 h, is `squared` with alpha(h) = gamma h,
halved: the same half-space, and nothing here depends on a row's scale.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.measurement import Measurement


@runtime_checkable
class Barrier(Protocol):
    """Rows over the control u. `soft` rows may be violated by their controller (a slack variable), so a violation
    of theirs is no alarm."""

    @property
    def soft(self) -> bool: ...

    def __call__(self, measurement: Measurement) -> Halfspaces: ...

    def labels(self, bodies: Sequence[str]) -> list[str]:
        """A name for each row, given the names of the bodies."""
        ...


def stack_barriers(barriers: Sequence[Barrier], measurement: Measurement) -> Halfspaces:
    """The safe controls: every barrier's rows, one below the other."""
    return Halfspaces.stack([barrier(measurement) for barrier in barriers])


@dataclass(frozen=True)
class ClassK:
    """alpha(h) = gain sign(h) |h|^power, an extended class-K function."""

    gain: float | Tensor
    power: float = 1.0

    def __post_init__(self) -> None:
        if not (bool(torch.as_tensor(self.gain) > 0) and self.power > 0):
            raise InputError("class_k", "gain > 0 and power > 0", (self.gain, self.power))

    def __call__(self, h: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        return self.gain * (h if self.power == 1 else h.sign() * h.abs() ** self.power)


@dataclass(frozen=True)
class CollisionAvoidance:
    """One row per body: stay `safety_distance` [m] away, or radius_i + radius_j + `margin` [m].

    Raises `InputError` unless exactly one of the two is given, and when `margin` meets a measurement without radii or
    `neighbour_velocity` one without the velocities it needs.
    """

    class_k: ClassK
    safety_distance: float | Tensor | None = None
    margin: float | None = None
    distance: Literal["squared", "euclidean"] = "squared"
    neighbour_velocity: Literal["none", "current", "previous"] = "none"
    soft: bool = False

    def __post_init__(self) -> None:
        if (self.safety_distance is None) == (self.margin is None):
            raise InputError("safety_distance, margin", "exactly one of them", (self.safety_distance, self.margin))
        if self.safety_distance is not None and not bool((torch.as_tensor(self.safety_distance) > 0).all()):
            raise InputError("safety_distance", "a positive distance [m]", self.safety_distance)

    def __call__(self, measurement: Measurement) -> Halfspaces:
        present = measurement.present
        away = measurement.x.unsqueeze(-2) - measurement.bodies
        # Slots that hold no body get a harmless vector, so that norms and their gradients stay finite.
        away = torch.where(present.unsqueeze(-1), away, 1.0)
        squared_distance = away.square().sum(-1)
        Ds = self._safety_distance(measurement)
        if self.distance == "squared":
            h, gradient = squared_distance - Ds**2, 2 * away
        else:
            distance = squared_distance.sqrt()
            h, gradient = distance - Ds, away / distance.unsqueeze(-1)
        b = self.class_k(h)
        if self.neighbour_velocity != "none":
            b = b - (gradient * self._neighbours(measurement)).sum(-1)
        return Halfspaces(-gradient, b).where(present)

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return [f"avoid {body}" for body in bodies]

    def _safety_distance(self, measurement: Measurement) -> Tensor | float:
        if self.margin is None:
            assert self.safety_distance is not None
            return self.safety_distance
        if measurement.radius is None or measurement.body_radii is None:
            raise InputError("measurement.radius", "radii, since the barrier is given by a margin", None)
        return measurement.radius.unsqueeze(-1) + measurement.body_radii + self.margin

    def _neighbours(self, measurement: Measurement) -> Tensor:
        current = self.neighbour_velocity == "current"
        velocities = measurement.body_velocities if current else measurement.previous_body_velocities
        if velocities is None:
            raise InputError("measurement", f"the {self.neighbour_velocity} velocities of the bodies", None)
        return velocities


@dataclass(frozen=True)
class SpeedBox:
    """|u_i| <= limit_i on every axis [m/s]: 2n rows."""

    limit: tuple[float, ...]
    soft: bool = False

    def __post_init__(self) -> None:
        if not all(limit > 0 for limit in self.limit):
            raise InputError("limit", "positive speeds [m/s]", self.limit)

    def __call__(self, measurement: Measurement) -> Halfspaces:
        identity = torch.eye(len(self.limit), dtype=torch.float64)
        return _constant(
            torch.cat([identity, -identity]), torch.tensor(self.limit * 2, dtype=torch.float64), measurement
        )

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return [f"speed {sign}{axis}" for sign in "+-" for axis in "xyz"[: len(self.limit)]]


@dataclass(frozen=True)
class SpeedPolygon:
    """u inside a regular polygon with a vertex on the first axis, whose circumradius is `limit` [m/s]."""

    sides: int
    limit: float
    soft: bool = False

    def __post_init__(self) -> None:
        if self.sides < 3 or not self.limit > 0:
            raise InputError("speed_polygon", "sides >= 3 and limit > 0", (self.sides, self.limit))

    def __call__(self, measurement: Measurement) -> Halfspaces:
        angles = (2 * torch.arange(self.sides, dtype=torch.float64) + 1) * (math.pi / self.sides)
        normals = torch.stack([angles.cos(), angles.sin()], dim=-1)
        apothem = self.limit * math.cos(math.pi / self.sides)
        return _constant(normals, torch.full((self.sides,), apothem, dtype=torch.float64), measurement)

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return [f"speed side {side}" for side in range(self.sides)]


@dataclass(frozen=True)
class Arena:
    """Stay `margin` [m] inside the box [lower, upper] [m]: h is the distance to each wall, +-u_i <= alpha(h)."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    class_k: ClassK
    margin: float = 0.0
    soft: bool = False

    def __post_init__(self) -> None:
        if len(self.lower) != len(self.upper) or not all(a < b for a, b in zip(self.lower, self.upper, strict=True)):
            raise InputError("arena", "lower < upper on every axis [m]", (self.lower, self.upper))

    def __call__(self, measurement: Measurement) -> Halfspaces:
        x = measurement.x
        identity = torch.eye(len(self.lower), dtype=torch.float64)
        to_upper = torch.tensor(self.upper, dtype=torch.float64) - self.margin - x
        to_lower = x - torch.tensor(self.lower, dtype=torch.float64) - self.margin
        h = torch.cat([to_upper, to_lower], dim=-1)
        return Halfspaces(torch.cat([identity, -identity]).expand(*h.shape, x.shape[-1]), self.class_k(h))

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return [f"wall {sign}{axis}" for sign in "+-" for axis in "xyz"[: len(self.lower)]]


def _constant(A: Tensor, b: Tensor, measurement: Measurement) -> Halfspaces:
    """The same rows for every robot of the batch."""
    batch = measurement.x.shape[:-1]
    return Halfspaces(A.expand(*batch, *A.shape), b.expand(*batch, *b.shape))
