r"""The inverse-optimal set: every theta for which the measured control is optimal, up to a bound on its error.

    { theta : C theta + d - u  in  cone{a_j : s_j <= slack} (+) ball(velocity) }

If |u - u*| <= `velocity` and the slack of every truly active row is measured below `slack`, the truth is inside: its
C theta + d - u* is in the cone of its active rows (KKT), these are among the generators, and exchanging u* for u moves
the vector by at most `velocity`. The slack test is one-sided, so violated (soft) rows count as active. Each outward
normal n of the cone gives one half-space n.(C theta + d - u) <= velocity; the corners of the sum are rounded off by a
fan of normals, an outer polygon. An intersection over time never forgives one wrong step: unlike the critical region,
this set is not wrong when a solver is inexact or a row is nearly active. (Not in the paper; see docs/theory.md.)
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.kkt import outward_normals

FAN = 17
"""Normals around a full turn, ends counted twice: 22.5 degrees apart, 1.3 % more area than the disc they replace."""


@dataclass(frozen=True)
class NoiseBound:
    """Bounds on the error of the measured control [m/s].

    Attributes:
        velocity: |u - u*|, the residual of stationarity.
        slack: how far from its boundary an active row may be measured; default: `velocity`.
    """

    velocity: float
    slack: float

    def __init__(self, velocity: float, slack: float | None = None):
        slack = velocity if slack is None else slack
        if not (velocity >= 0 and slack >= 0):
            raise InputError("noise", "bounds >= 0 [m/s]", (velocity, slack))
        object.__setattr__(self, "velocity", velocity)
        object.__setattr__(self, "slack", slack)


def inverse_optimal_set(
    safe_controls: Halfspaces,
    u: Float[Tensor, "*batch n"],
    C: Float[Tensor, "*batch n p"],
    d: Float[Tensor, "*batch n"],
    noise: NoiseBound,
) -> Halfspaces:
    """The set as half-spaces of theta, `FAN` + 1 rows, unneeded ones padded. Controls are planar (n = 2); p is any.

    `source` is m + j where a half-space comes from the multiplier of row j, 2 m where no row may be active.
    """
    u, C, d = u.to(torch.float64), C.to(torch.float64), d.to(torch.float64)
    is_row = (safe_controls.A != 0).any(-1)
    may_be_active = is_row & (safe_controls.slack(u) <= noise.slack)
    normals, generator = outward_normals(safe_controls.A, may_be_active, FAN)
    b = noise.velocity - (normals @ (d - u).unsqueeze(-1)).squeeze(-1)
    return Halfspaces(normals @ C, b, safe_controls.rows + generator).where((normals != 0).any(-1))
