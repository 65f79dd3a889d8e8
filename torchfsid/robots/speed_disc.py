r"""A limit on the speed, |u| <= limit: the barrier as an observer sees it, and the QP within the disc.

For an observer the disc is one row through the measured control, (u/|u|).u <= limit. The true row's direction is that
of the true control, so it is wrong by at most asin(delta/|u|), with delta the bound on the error of u. No polygon would
do: its multipliers point in other directions.

For a controller the disc is a constraint of its QP. The optimum u* is

    the nearest point of the rows alone, if that is within the disc,
    else a point of the circle: limit uhat/|uhat|, or where a row's boundary meets the circle.

If the rows and the disc have no common point, some controllers (ORCA) take the control within the disc that minimises
the largest violation max_j a_j.u - b_j (unit rows). It is the centre of the rows' inscribed ball, whose radius is then
negative, if that is within the disc. Else it is a point of the circle: opposite to a row's normal, or where two rows
are violated by the same amount.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.halfspaces import Halfspaces, dot
from torchfsid.programmes.differentiable import inscribed_ball
from torchfsid.robots.arguments import require_numbers
from torchfsid.robots.avoidance import NeighbourVelocity
from torchfsid.robots.bounds import ErrorBounds, RowErrors
from torchfsid.robots.measurement import Measurement

WITHIN = 1e-10
"""A control is within the disc and keeps the rows if it does up to this, relative to the limit."""


@dataclass(frozen=True)
class SpeedDisc:
    """|u| <= limit [m/s]: one row through the measured control. Where no control is known yet it is padding.

    Attributes:
        limit: the largest speed [m/s].
        soft: the controller may violate the limit.
    """

    limit: float
    soft: bool = False
    uncertain: ClassVar[bool] = True
    neighbour_velocity: ClassVar[NeighbourVelocity] = "none"

    def __post_init__(self) -> None:
        require_numbers("limit", "a positive speed [m/s]", self.limit, lambda limit: limit > 0)

    @property
    def speed_limit(self) -> float:
        """The radius of the disc, for controllers [m/s]."""
        return self.limit

    def __call__(self, measurement: Measurement) -> Halfspaces:
        if measurement.u is None:
            return Halfspaces(torch.zeros_like(measurement.x).unsqueeze(-2), torch.ones_like(measurement.x[..., :1]))
        speed = measurement.u.norm(dim=-1, keepdim=True)
        moves = speed > 0
        direction = torch.where(moves, measurement.u / torch.where(moves, speed, 1.0), 0.0)
        return Halfspaces(direction.unsqueeze(-2), torch.ones_like(speed).masked_fill(moves, self.limit))

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        """asin(delta/|u|), or unknown for |u| <= delta. The slack itself, limit - |u|, is as exact as u."""
        assert measurement.u is not None
        speed = measurement.u.norm(dim=-1, keepdim=True)
        error = bounds.control.unsqueeze(-1)
        clear = speed > error
        angle = torch.where(clear, error / torch.where(clear, speed, 1.0), 0.0).arcsin()
        return RowErrors(torch.where(clear, angle, math.pi), torch.zeros_like(speed))

    def slack_left_out(self, measurement: Measurement) -> Float[Tensor, "*batch"]:
        return torch.full_like(measurement.x[..., 0], math.inf)

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return ["speed"]


def nearest_in_disc(
    rows: Halfspaces, uhat: Float[Tensor, "*batch 2"], limit: float
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch m"], Bool[Tensor, "*batch"]]:
    """The point of a circle that is nearest to `uhat` among those that keep the rows, where the disc is active.

    Returns:
        The points, the row whose boundary each lies on, if any, and whether there is such a point.
    """
    unit = rows.normalised()
    is_row = (unit.A != 0).any(-1)
    size = uhat.norm(dim=-1, keepdim=True)
    ahead = limit * uhat / torch.where(size > 0, size, 1.0)
    half = (limit**2 - unit.b.square()).clamp(min=0.0)
    chord = torch.where(half > 0, half, 1.0).sqrt() * (half > 0)  # no infinite derivative where they only touch
    foot = unit.A * unit.b.unsqueeze(-1)
    along = torch.stack([-unit.A[..., 1], unit.A[..., 0]], dim=-1) * chord.unsqueeze(-1)
    points = torch.cat([ahead.unsqueeze(-2), foot + along, foot - along], dim=-2)
    meets = is_row & (unit.b.abs() <= limit)
    exists = torch.cat([size > 0, meets, meets], dim=-1)
    over = (points @ unit.A.mT - unit.b.unsqueeze(-2)).amax(-1) if unit.rows else torch.zeros_like(points[..., 0])
    keeps = exists & (over <= WITHIN * limit)
    away = (points - uhat.unsqueeze(-2)).square().sum(-1).masked_fill(~keeps, math.inf)
    best = away.detach().argmin(-1, keepdim=True)
    m = unit.rows
    on = (torch.arange(m, device=best.device) == (best - 1) % max(m, 1)) & (best > 0)
    return _taken(points, best), on, keeps.any(-1)


def least_violation(rows: Halfspaces, limit: float) -> tuple[Float[Tensor, "B 2"], Bool[Tensor, "B m"]]:
    """The control within the disc that minimises the largest violation of the rows, and the rows that decide it.

    Args:
        rows: rows (B, m, 2) without a common point in the disc.
        limit: the radius of the disc [m/s].
    """
    unit = rows.normalised()
    is_row = (unit.A != 0).any(-1)
    m = int(is_row.sum(-1).max()) if len(is_row) else 0
    chosen = is_row.to(torch.int8).argsort(dim=-1, descending=True, stable=True)[:, :m]
    real = is_row.gather(-1, chosen)
    A = unit.A.gather(-2, chosen.unsqueeze(-1).expand(-1, -1, 2))
    b = torch.where(real, unit.b.gather(-1, chosen), math.inf)
    first, second = torch.triu_indices(m, m, 1, device=A.device)
    # Two rows are violated by the same amount on the line (a_i - a_j).u = b_i - b_j. It may meet the circle twice.
    across = A[:, first] - A[:, second]
    size = across.norm(dim=-1)
    both = real[:, first] & real[:, second] & (size > 0)
    scale = torch.where(both, size, 1.0)
    across = across / scale.unsqueeze(-1)
    level = torch.where(both, b[:, first] - b[:, second], 0.0) / scale
    half = (limit**2 - level.square()).clamp(min=0.0)
    chord = torch.where(half > 0, half, 1.0).sqrt() * (half > 0)
    along = torch.stack([-across[..., 1], across[..., 0]], dim=-1) * chord.unsqueeze(-1)
    foot = across * level.unsqueeze(-1)
    centre, _, _ = inscribed_ball(Halfspaces(A, torch.where(real, b, 1.0)))
    points = torch.cat([torch.nan_to_num(centre).unsqueeze(-2), -limit * A, foot + along, foot - along], dim=-2)
    meets = both & (level.abs() <= limit)
    inside = (centre.isfinite().all(-1) & (centre.norm(dim=-1) <= limit)).unsqueeze(-1)
    exists = torch.cat([inside, real, meets, meets], dim=-1)
    violation = (points @ A.mT - b.unsqueeze(-2)).amax(-1).masked_fill(~exists, math.inf)
    best = violation.detach().argmin(-1, keepdim=True)
    u = _taken(points, best)
    worst = violation.detach().gather(-1, best)
    decides = unit.b - dot(unit.A, u.detach().unsqueeze(-2)) <= WITHIN * limit - worst
    return u, decides & is_row


def _taken(points: Float[Tensor, "*batch k 2"], place: Int[Tensor, "*batch 1"]) -> Float[Tensor, "*batch 2"]:
    return points.gather(-2, place.unsqueeze(-1).expand(*place.shape, 2)).squeeze(-2)
