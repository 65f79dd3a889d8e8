r"""The KKT conditions of the safety QP, solved once for all of the paper's cases A-E.

    u* = argmin |u - uhat|^2  s.t.  A u <= b,       uhat = C theta + d,
    uhat - u* = 1/2 sum_active mu_j a_j,  mu >= 0                                     (G., Eqs. (7)-(10), (15))

With A_a, b_a the active rows (the others zeroed by a mask, so that it batches) and P = A_a^+ A_a,

    u*(theta) = G theta + f,   G = (I - P) C,   f = A_a^+ b_a + (I - P) d             (G., Eqs. (25), (36), (45), (48))

and the multipliers exist exactly where  C theta + d - u*(theta)  lies in  cone{a_j : j active}. In the plane this cone
is written by outward normals: sort the generators by angle; an angular gap of at least 180 degrees is the polar cone's
opening, from one end + 90 degrees to the other - 90; without such a gap the cone is the whole plane.
The letters A-E are names for (K, rank), computed for tables and nothing else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces

CASES = "ABCDE"
"""Table I of the paper: A none active; B one; C several, rank 1; D two, rank 2; E three or more, rank 2."""

RANK_TOLERANCE = 1e-7
"""Relative singular value: unit rows less than twice this apart [rad] count as parallel. Below it round-off decides."""

ANGLE_TOLERANCE = 1e-12
"""Round-off allowed when an angular gap is compared with 180 degrees [rad]."""


@dataclass(frozen=True)
class KktSolution:
    """The control as a function of the parameter while the active set stays as it is.

    Attributes:
        G, f: u*(theta) = G theta + f.
        projector: P = A_a^+ A_a, onto the span of the active rows. free: I - P, exactly zero at full rank.
        offset: A_a^+ b_a, the part of u* that the active rows decide [m/s].
        active: the active rows. n_active: K, their number. rank: of A_a.
        case: index into `CASES`.
    """

    G: Float[Tensor, "*batch n p"]
    f: Float[Tensor, "*batch n"]
    projector: Float[Tensor, "*batch n n"]
    free: Float[Tensor, "*batch n n"]
    offset: Float[Tensor, "*batch n"]
    active: Bool[Tensor, "*batch m"]
    n_active: Int[Tensor, "*batch"]
    rank: Int[Tensor, "*batch"]
    case: Int[Tensor, "*batch"]


def solve_kkt(
    safe_controls: Halfspaces,
    active: Bool[Tensor, "*batch m"],
    C: Float[Tensor, "*batch n p"],
    d: Float[Tensor, "*batch n"],
) -> KktSolution:
    """Solve the KKT conditions for a known active set, any number of rows and any rank.

    Raises:
        InputError: shapes of `active`, `C`, `d` do not fit the rows.
    """
    m, n = safe_controls.rows, safe_controls.dim
    if active.shape[-1] != m:
        raise InputError("active", f"(*batch, {m})", tuple(active.shape))
    if C.shape[-2] != n or d.shape[-1] != n:
        raise InputError("C, d", f"C (*batch, {n}, p) and d (*batch, {n})", (tuple(C.shape), tuple(d.shape)))
    C, d = C.to(torch.float64), d.to(torch.float64)
    unit = safe_controls.normalised()
    A = torch.where(active.unsqueeze(-1), unit.A, 0.0)
    b = torch.where(active, unit.b, 0.0)

    pinv = torch.linalg.pinv(A, rtol=RANK_TOLERANCE)
    projector = pinv @ A
    rank = projector.diagonal(dim1=-2, dim2=-1).sum(-1).round().long()
    identity = torch.eye(n, dtype=A.dtype, device=A.device)
    # At full rank nothing of theta gets through: exactly nothing, not a rounding error of I - P.
    free = torch.where((rank == n)[..., None, None], 0.0, identity - projector)
    offset = (pinv @ b.unsqueeze(-1)).squeeze(-1)

    n_active = active.sum(-1)
    several = torch.where(rank < n, 2, torch.where(n_active == n, 3, 4))
    return KktSolution(
        G=free @ C,
        f=offset + (free @ d.unsqueeze(-1)).squeeze(-1),
        projector=projector,
        free=free,
        offset=offset,
        active=active,
        n_active=n_active,
        rank=rank,
        case=torch.where(n_active < 2, n_active, several),
    )


class OutwardNormals(NamedTuple):
    """Unit outward normals of a cone (zero: not needed), and for each the generator it is nearest to (m: none)."""

    normals: Float[Tensor, "*batch k 2"]
    generator: Int[Tensor, "*batch k"]


def outward_normals(
    generators: Float[Tensor, "*batch m 2"], present: Bool[Tensor, "*batch m"], fan: int
) -> OutwardNormals:
    """Outward normals of cone{a_j : j present} in the plane: w is in the cone iff n.w <= 0 for all of them.

    Up to `fan` normals are spread evenly over the polar cone, both ends included (the ends alone describe a pointed
    cone; a ray needs its cap too; a widened cone is rounded off by more of them), and one more serves a line. No
    generator: the cone is the origin and the fan goes all around. k = fan + 1.

    Raises:
        InputError: the generators are not planar, or `fan` < 3.
    """
    if generators.shape[-1] != 2:
        raise InputError("generators", "planar controls, (*batch, m, 2)", tuple(generators.shape))
    if fan < 3:
        raise InputError("fan", "at least 3 normals (two ends and a cap)", fan)
    m = generators.shape[-2]
    if m == 0:  # nothing to sort: one slot that holds no generator says the same
        generators, present = (
            generators.new_zeros(*generators.shape[:-2], 1, 2),
            present.new_zeros(*present.shape[:-1], 1),
        )
    count = present.sum(-1, keepdim=True)
    safe = torch.where(present.unsqueeze(-1), generators, 1.0)
    angles, order = torch.where(present, torch.atan2(safe[..., 1], safe[..., 0]), math.inf).sort(-1)
    slot = torch.arange(angles.shape[-1], device=angles.device)
    following = torch.where(slot == count - 1, angles[..., :1] + 2 * math.pi, angles.roll(-1, -1))
    gaps = torch.where(slot < count, following - angles, -math.inf)

    widest = gaps.argmax(-1, keepdim=True)
    none = count == 0
    start = torch.where(none, 0.0, angles.gather(-1, widest) + math.pi / 2)
    opening = torch.where(none, 2 * math.pi, gaps.gather(-1, widest) - math.pi)
    step = torch.arange(fan, dtype=angles.dtype, device=angles.device) / (fan - 1)
    needed = (opening >= -ANGLE_TOLERANCE) & ((step == 0) | (opening > ANGLE_TOLERANCE)) & ~(none & (step == 1))

    # Two gaps of 180 degrees: the cone is a line, and the second gap gives its other side.
    others = gaps.scatter(-1, widest, -math.inf)
    second = others.argmax(-1, keepdim=True)
    is_line = others.gather(-1, second) >= math.pi - ANGLE_TOLERANCE
    other_side = torch.where(is_line, angles.gather(-1, second) + math.pi / 2, 0.0)

    directions = torch.cat([torch.where(needed, start + step * opening.clamp(min=0), 0.0), other_side], dim=-1)
    normals = torch.stack([directions.cos(), directions.sin()], dim=-1)
    needed = torch.cat([needed, is_line], dim=-1)
    end = torch.where(widest == count - 1, 0, widest + 1)
    near = torch.cat([torch.where(step < 0.5, widest, end.clamp(max=len(slot) - 1)), second], dim=-1)
    return OutwardNormals(torch.where(needed.unsqueeze(-1), normals, 0.0), torch.where(none, m, order.gather(-1, near)))
