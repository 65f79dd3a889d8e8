r"""The paper's instantaneous feasible set Omega: every theta whose QP has the observed active set (G., Eq. (13)).

    inactive rows:  A_in (G theta + f) <= b_in                   (the paper's strict < is closed, here and only here)
    multipliers:    C theta + d - (G theta + f)  in  cone{a_j : j active}

One formula covers cases A-E (G., Eqs. (19), (29), (44), (47), (54)). The "floating" eta of cases C and E, quantified by
"if there exists eta", is exactly membership in this cone. The set depends on the active rows only, not on the measured
control. It equals the critical region of multiparametric quadratic programming.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.halfspaces import Halfspaces, dot
from torchfsid.identification.kkt import KktSolution, solve_kkt
from torchfsid.identification.normals import outward_normals
from torchfsid.tolerances import CRITICAL_NORMALS, RANK_TOLERANCE


def critical_region(
    safe_controls: Halfspaces,
    active: Bool[Tensor, "*batch m"],
    C: Float[Tensor, "*batch n p"],
    d: Float[Tensor, "*batch n"],
) -> Halfspaces:
    """Omega as half-spaces of theta: rows 0..m-1 keep row j inactive, the others keep the multipliers non-negative.

    Rows that do not restrict theta are padding. `source` is j where row j must stay inactive, and m + j where its
    multiplier must not be negative. Controls are in the plane or in space, p is any.

    Raises:
        InputError: shapes do not fit, or controls are neither in the plane nor in space.
    """
    C, d = C.to(torch.float64), d.to(torch.float64)
    return region_of(safe_controls.normalised(), solve_kkt(safe_controls, active, C, d), C, d)


def region_of(
    unit: Halfspaces, kkt: KktSolution, C: Float[Tensor, "*batch n p"], d: Float[Tensor, "*batch n"]
) -> Halfspaces:
    """`critical_region` for unit rows whose KKT conditions are solved already."""
    # A row in the span of the active rows does not restrict theta: u* does not move along it.
    across = unit.A.detach() @ kkt.free.detach()
    sees_theta = dot(across, across) > RANK_TOLERANCE**2
    # C theta + d - u* = P (C theta + d - A_a^+ b_a) lies in the span of the active rows: normals across it do not
    # matter.
    normals, generator, _ = outward_normals(unit.A, kkt.active, CRITICAL_NORMALS)
    along = normals @ kkt.projector
    j = torch.arange(unit.rows, device=generator.device).expand(kkt.active.shape)
    motion = torch.cat([kkt.G, kkt.f.unsqueeze(-1)], dim=-1)
    push = torch.cat([C, (d - kkt.offset).unsqueeze(-1)], dim=-1)
    rows = torch.cat([unit.A @ motion, along @ push], dim=-2)
    bounds = torch.nn.functional.pad(unit.b, (0, along.shape[-2]))
    return Halfspaces(rows[..., :-1], bounds - rows[..., -1], torch.cat([j, unit.rows + generator], dim=-1)).where(
        torch.cat([sees_theta & ~kkt.active, dot(along, along) > RANK_TOLERANCE**2], dim=-1)
    )
