r"""The inverse-optimal set: every theta for which the measured control is optimal, up to bounds on all errors.

    { theta : C theta + d - u  in  cone{a_j : s_j <= slack} (+) ball(velocity) }

If |u - u*| <= `velocity` and the slack of every truly active row is measured below `slack`, the truth is inside: its
C theta + d - u* is in the cone of its active rows (KKT), these are among the generators, and exchanging u* for u moves
the vector by at most `velocity`. The slack test is one-sided, so violated (soft) rows count as active. Each outward
normal n of the cone gives one half-space n.(C theta + d - u) <= velocity; the corners of the sum are rounded off by a
fan of normals, an outer polygon. An intersection over time never forgives one wrong step: unlike the critical region,
this set is not wrong when a solver is inexact or a row is nearly active.

Positions that are known up to a bound turn the rows, move their boundaries and shift C theta + d: the generators become
fans, the slack test and the ball grow (`Uncertainty`). A clipped nominal control opens the set in the directions of
saturation (`saturation`). Each widening is an outer one. (Not in the paper; proofs in docs/theory.md.)
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.kkt import outward_normals
from torchfsid.identification.saturation import unclipped
from torchfsid.robots.bounds import NoiseBound, Uncertainty
from torchfsid.robots.tasks import Saturation

FAN = 17
"""Normals around a full turn, ends counted twice: 22.5 degrees apart, 1.3 % more area than the disc they replace."""

SPREAD = (-1.0, -1 / 3, 1 / 3, 1.0)
"""A row of uncertain direction is a fan of generators at these fractions of its angle: dense enough for any angle."""


def inverse_optimal_set(
    safe_controls: Halfspaces,
    u: Float[Tensor, "*batch n"],
    C: Float[Tensor, "*batch n p"],
    d: Float[Tensor, "*batch n"],
    noise: NoiseBound,
    *,
    uncertainty: Uncertainty | None = None,
    saturation: Saturation | None = None,
    possible: Float[Tensor, "*batch v n"] | None = None,
) -> Halfspaces:
    """The set as half-spaces of theta, unneeded rows padded. Controls are planar (n = 2); p is any.

    `source` is m + j where a half-space comes from the multiplier of row j, 2 m where no single row is to blame.

    Args:
        uncertainty: what position errors and the like add to `noise`; its own `position` and `neighbour_velocity` are
            not looked at here, the observer turns them into this.
        saturation: the nominal control is clipped. possible: points whose convex hull holds every C theta + d that is
            still possible [m/s], required with a saturation.

    Raises:
        InputError: a saturation without `possible`, or controls that are not planar.
    """
    u, C, d = u.to(torch.float64), C.to(torch.float64), d.to(torch.float64)
    m, generators = safe_controls.rows, safe_controls.A
    slack, ball = per_row(noise.slack, u), per_row(noise.velocity, u).squeeze(-1)
    drift = u.new_zeros(())
    if uncertainty is not None:
        slack, ball, drift = slack + uncertainty.slack, ball + uncertainty.velocity, uncertainty.drift
    near = safe_controls.slack(u) <= slack + safe_controls.round_off(u)
    may_be_active = (generators != 0).any(-1) & near
    if uncertainty is not None:
        generators = torch.cat([_turned(generators, fraction * uncertainty.angle) for fraction in SPREAD], dim=-2)
        may_be_active = torch.cat([may_be_active] * len(SPREAD), dim=-1)

    normals, generator = outward_normals(generators, may_be_active, FAN)
    source = m + torch.where(generator < generators.shape[-2], generator % max(m, 1), m)
    needed = (normals != 0).any(-1)
    room = (ball + drift).unsqueeze(-1)
    if saturation is None:
        return Halfspaces(normals @ C, torch.where(needed, _along(normals, u - d) + room, 1.0), source)
    if possible is None:
        raise InputError("possible", "the nominal controls that are still possible, for a saturation", None)
    nominal = Halfspaces(normals, _along(normals, u) + ball.unsqueeze(-1), source).where(needed)
    nominal = unclipped(nominal, saturation, possible, drift)
    is_row = (nominal.A != 0).any(-1)
    return Halfspaces(nominal.A, nominal.b + drift.unsqueeze(-1) * is_row, nominal.source).pullback(C, d)


def _along(normals: Float[Tensor, "*batch k n"], v: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch k"]:
    return (normals @ v.unsqueeze(-1)).squeeze(-1)


def per_row(bound: float | Float[Tensor, "*batch"], like: Tensor) -> Float[Tensor, "*batch 1"]:
    """A bound of `NoiseBound` as a tensor that goes with the rows of a batch."""
    return torch.as_tensor(bound, dtype=like.dtype, device=like.device).unsqueeze(-1)


def _turned(rows: Float[Tensor, "*batch m 2"], angle: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m 2"]:
    cos, sin = angle.cos(), angle.sin()
    x, y = rows.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)
