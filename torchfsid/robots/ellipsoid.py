r"""Avoidance of ellipsoids instead of balls: a linear change of coordinates, y = S x with S = diag(1/e_1, .., 1/e_n).

Rotors blow downward, so drones keep further apart above each other than aside. In the coordinates y the ellipsoid with
semi-axes e_i around a body is the ball of radius 1. A barrier over y has rows A_y (S u) <= b over the control:

    A = A_y S,   unchanged b.

**Errors.** Let n be a measured and n* a true unit row over y, at most the angle alpha apart, and s and s* their slacks
at the measured S u, at most e apart (`Barrier.errors` in these coordinates, where an error r of a position is at most
r/min e_i). With m = |S n| and D = 2 sin(alpha/2)/min e_i, |S n - S n*| <= D. So the row S n/m is turned by at most
asin(D/m), and its slack s/m is off by at most

    |s/m - s*/m*|  <=  e/(m - D) + |s| D/(m (m - D)).

Where D >= m, nothing is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.device import constant
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, dot
from torchfsid.robots.avoidance import CollisionAvoidance, NeighbourVelocity
from torchfsid.robots.bounds import ErrorBounds, RowErrors
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.second_order import SecondOrderAvoidance


@dataclass(frozen=True)
class Ellipsoid:
    """A barrier between bodies in coordinates in which an ellipsoid is a ball.

    Attributes:
        barrier: the barrier in these coordinates. Its distances have no unit: a safety distance of 1 keeps the centre
            of another body out of the ellipsoid, 2 keeps two ellipsoids apart.
        semi_axes: the e_i, one per axis [m].

    Raises:
        InputError: a semi-axis is not positive, or the barrier keeps a margin between radii. When called: there are as
            many semi-axes as positions have entries.
    """

    barrier: CollisionAvoidance | SecondOrderAvoidance
    semi_axes: tuple[float, ...]

    def __post_init__(self) -> None:
        if not (len(self.semi_axes) > 0 and min(self.semi_axes) > 0):
            raise InputError("semi_axes", "positive lengths [m]", self.semi_axes)
        if self.barrier.margin is not None:
            raise InputError("barrier", "a safety distance without unit, not a margin between radii", self.barrier)

    @property
    def soft(self) -> bool:
        return self.barrier.soft

    @property
    def order(self) -> int:
        return getattr(self.barrier, "order", 1)

    @property
    def uncertain(self) -> bool:
        return getattr(self.barrier, "uncertain", False)

    @property
    def neighbour_velocity(self) -> NeighbourVelocity:
        return self.barrier.neighbour_velocity

    def __call__(self, measurement: Measurement) -> Halfspaces:
        rows = self.barrier(self._stretched(measurement))
        return Halfspaces(rows.A * self._stretch(measurement.x), rows.b)

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        """The bounds of the module's docstring."""
        seen, largest = self._stretched(measurement), 1 / min(self.semi_axes)
        stretched = ErrorBounds(*(largest * bound for bound in bounds))
        told, unit = self.barrier.errors(seen, stretched), self.barrier(seen).normalised()
        is_row = (unit.A != 0).any(-1)
        m = torch.where(is_row, (unit.A * self._stretch(measurement.x)).norm(dim=-1), 1.0)
        D = 2 * largest * (told.angle.clamp(max=math.pi) / 2).sin()
        clear = (m > D) & (told.angle < math.pi / 2)
        left = torch.where(clear, m - D, 1.0)
        s = torch.zeros_like(unit.b) if seen.u is None else (unit.b - dot(unit.A, seen.u.unsqueeze(-2))).abs()
        slack = told.slack / left + torch.where(is_row & (D > 0), s, 0.0) * D / (m * left)
        angle = torch.where(clear, (D / m).clamp(max=1.0), 0.0).arcsin()
        present = measurement.present
        return RowErrors(
            torch.where(present, torch.where(clear, angle, math.pi), 0.0),
            torch.where(present, torch.where(clear, slack, math.inf), 0.0),
        )

    def slack_left_out(self, measurement: Measurement) -> Float[Tensor, "*batch"]:
        """The slack of the other coordinates, divided by the |S n| that makes it least."""
        assert measurement.left_out is not None
        least = self.barrier.slack_left_out(self._stretched(measurement))
        return least * torch.where(least > 0, min(self.semi_axes), max(self.semi_axes))

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return self.barrier.labels(bodies)

    def _stretch(self, like: Float[Tensor, "*batch n"]) -> Float[Tensor, "n"]:
        if like.shape[-1] != len(self.semi_axes):
            raise InputError("measurement.x", f"positions with {len(self.semi_axes)} entries", tuple(like.shape))
        return 1 / constant(tuple(self.semi_axes), like.device)

    def _stretched(self, measurement: Measurement) -> Measurement:
        """The measurement in the other coordinates: vectors are multiplied by S, bounds by its norm."""
        S, largest = self._stretch(measurement.x), 1 / min(self.semi_axes)
        vectors = (
            "x", "u", "bodies", "body_velocities", "previous_body_velocities", "velocity", "body_accelerations",
        )  # fmt: skip
        bounds = (
            "position_error", "body_position_error", "velocity_error", "body_velocity_error", "arrival_error",
            "body_acceleration_error",
        )  # fmt: skip
        changed = {name: (S, getattr(measurement, name)) for name in vectors}
        changed |= {name: (largest, getattr(measurement, name)) for name in bounds}
        found = {name: factor * value for name, (factor, value) in changed.items() if value is not None}
        left_out = measurement.left_out
        if left_out is not None:
            found["left_out"] = left_out._replace(
                distance=left_out.distance / max(self.semi_axes),
                speed=largest * left_out.speed,
                acceleration=largest * left_out.acceleration,
            )
        return replace(measurement, **found)
