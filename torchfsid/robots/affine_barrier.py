"""A barrier for the user's own rows, given as a matrix and a vector, with the properties that the user declares."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import get_args

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.robots.arguments import require_choice, require_names
from torchfsid.robots.avoidance import NeighbourVelocity
from torchfsid.robots.bounds import ErrorBounds, RowErrors
from torchfsid.robots.measurement import Measurement


@dataclass(frozen=True)
class AffineBarrier:
    """Any rows A u <= b, with A (m, n) and b (m,) given as tensors or as functions of the measurement.

    Rows given as tensors are constant. A function sees the batch of robots: for a measurement with x (B, n) it returns
    A (B, m, n), or b (B, m). About functions, only what the other arguments declare is known. A sample is skipped if
    something unknown could matter for it.

    One row for a disc of radius r around the origin, h = |x|^2 - r^2 and -2 x.u <= gain h, with its errors where
    positions are wrong by at most e = `bounds.position`: the direction by asin(e / |x|), and the slack by the change of
    the boundary gain h / (2 |x|), which grows with |x|, and by the turn of the row:

        def row_errors(measurement, bounds):                                    # (B, m) each, here m = 1
            x, e, speed = measurement.x.norm(dim=-1), bounds.position, measurement.u.norm(dim=-1)
            angle = (e / x).clamp(max=1.0).arcsin()
            nearest = (x - e).clamp(min=1e-9)
            slack = boundary(x + e) - boundary(nearest) + angle * speed         # boundary(s) = gain (s^2 - r^2) / (2 s)
            return RowErrors(angle.unsqueeze(-1), slack.unsqueeze(-1))

    Attributes:
        names: a name for each row.
        soft: the controller may violate the rows.
        row_errors: a function (measurement, `ErrorBounds`) -> `RowErrors` that bounds the errors of the rows. It is
            needed only for functions, and if positions have errors.
        depends_on_bodies: False if the functions use the robot's own state only. Then no body without a slot has a
            row, and neighbours' velocities do not matter.
        neighbour_velocity: see `Barrier`; None if unknown.
        left_out: see `Barrier.slack_left_out`; None if unknown.
    """

    A: Tensor | Callable[[Measurement], Tensor]
    b: Tensor | Callable[[Measurement], Tensor]
    names: tuple[str, ...]
    soft: bool = False
    row_errors: Callable[[Measurement, ErrorBounds], RowErrors] | None = None
    depends_on_bodies: bool = True
    neighbour_velocity: NeighbourVelocity | None = None
    left_out: Callable[[Measurement], Float[Tensor, "*batch"]] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", require_names("names", self.names))
        if self.neighbour_velocity is not None:
            require_choice("neighbour_velocity", self.neighbour_velocity, get_args(NeighbourVelocity))
        if not (callable(self.A) or callable(self.b)):
            object.__setattr__(self, "depends_on_bodies", False)
        if not self.depends_on_bodies:
            object.__setattr__(self, "neighbour_velocity", "none")

    def __call__(self, measurement: Measurement) -> Halfspaces:
        A = self.A(measurement) if callable(self.A) else self.A
        b = self.b(measurement) if callable(self.b) else self.b
        m, (*batch, n) = len(self.names), measurement.x.shape
        if A.shape[-2:] != (m, n) or b.shape[-1:] != (m,):
            expected = f"A (*batch, {m}, {n}) and b (*batch, {m})"
            raise InputError("AffineBarrier(A, b)", expected, (tuple(A.shape), tuple(b.shape)))
        return Halfspaces(A.to(torch.float64).expand(*batch, m, n), b.to(torch.float64).expand(*batch, m))

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        if self.row_errors is not None:
            return self.row_errors(measurement, bounds)
        if (callable(self.A) or callable(self.b)) and not bounds.exact:
            expected = "a function that bounds the errors of the rows, since positions have errors (see AffineBarrier)"
            raise InputError("AffineBarrier.row_errors", expected, None)
        return RowErrors.none(self(measurement).b)

    def slack_left_out(self, measurement: Measurement) -> Float[Tensor, "*batch"]:
        if self.left_out is not None:
            return self.left_out(measurement)
        return torch.full_like(measurement.x[..., 0], -math.inf if self.depends_on_bodies else math.inf)

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return list(self.names)
