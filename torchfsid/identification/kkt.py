r"""The KKT conditions of the safety QP, solved once for all of the paper's cases A-E.

    u* = argmin |u - uhat|^2  s.t.  A u <= b,       uhat = C theta + d,
    uhat - u* = 1/2 sum_active mu_j a_j,  mu >= 0                                     (G., Eqs. (7)-(10), (15))

With A_a, b_a the active rows (the others zeroed by a mask, so that it batches) and P = A_a^+ A_a,

    u*(theta) = G theta + f,   G = (I - P) C,   f = A_a^+ b_a + (I - P) d             (G., Eqs. (25), (36), (45), (48))

In the plane A_a^+ has a closed form. With V a rotation to the principal axes of the unit rows, the columns of
A_a V = [y z] are orthogonal up to round-off, w = z - y (y.z)/(y.y) has the length of the second singular value, and

    A_a^+ b_a = V [c1, c2],    c2 = w.b/w.w,   c1 = (y.b - c2 y.z)/y.y      (rank 2; at rank 1 y alone counts)

which keeps the digits that the Gram matrix of nearly parallel rows loses, and holds for any V: so V needs no gradient,
and orthogonal equal rows, where that of an SVD does not exist, are nothing special.

The multipliers exist exactly where  C theta + d - u*(theta)  lies in  cone{a_j : j active}. In the plane this cone
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
from torchfsid.tolerances import ANGLE_TOLERANCE, RANK_TOLERANCE

CASES = "ABCDE"
"""Table I of the paper: A none active; B one; C several, rank 1; D two, rank 2; E three or more, rank 2."""


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

    offset, projector, rank = _solve_planar(A, b) if n == 2 else _solve(A, b)
    identity = torch.eye(n, dtype=A.dtype, device=A.device)
    # At full rank nothing of theta gets through: exactly nothing, not a rounding error of I - P.
    free = torch.where((rank == n)[..., None, None], 0.0, identity - projector)

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


def _solve(A: Float[Tensor, "*batch m n"], b: Float[Tensor, "*batch m"]) -> tuple[Tensor, Tensor, Tensor]:
    """A^+ b, A^+ A and the rank."""
    pinv = torch.linalg.pinv(A, rtol=RANK_TOLERANCE)
    projector = pinv @ A
    return (pinv @ b.unsqueeze(-1)).squeeze(-1), projector, projector.diagonal(dim1=-2, dim2=-1).sum(-1).round().long()


def _solve_planar(A: Float[Tensor, "*batch m 2"], b: Float[Tensor, "*batch m"]) -> tuple[Tensor, Tensor, Tensor]:
    """A^+ b, A^+ A and the rank; the rows are unit rows or zero."""
    first, second = A.unbind(-1)
    with torch.no_grad():
        turn = torch.atan2(2 * (first * second).sum(-1), (first * first - second * second).sum(-1)) / 2
        cos, sin = turn.cos(), turn.sin()
    y = cos.unsqueeze(-1) * first + sin.unsqueeze(-1) * second
    z = cos.unsqueeze(-1) * second - sin.unsqueeze(-1) * first
    yy, yz, yb = (y * y).sum(-1), (y * z).sum(-1), (y * b).sum(-1)
    none = yy == 0
    yy = torch.where(none, 1.0, yy)
    w = z - y * (yz / yy).unsqueeze(-1)
    ww, wb = (w * w).sum(-1), (w * b).sum(-1)
    full = ww > RANK_TOLERANCE**2 * yy
    c2 = wb / torch.where(full, ww, 1.0)
    c1 = (yb - yz * c2) / yy
    vertex = torch.stack([cos * c1 - sin * c2, sin * c1 + cos * c2], dim=-1)

    # Rank 1: the rows' direction, by a step of the power iteration from where it has converged, which has its gradient.
    direction = (y.detach().unsqueeze(-1) * A).sum(-2)
    length = torch.where(none, 1.0, direction.square().sum(-1)).sqrt()
    direction = direction / length.unsqueeze(-1)
    along = (A * direction.unsqueeze(-2)).sum(-1)
    share = (along * b).sum(-1) / torch.where(none, 1.0, along.square().sum(-1))
    line = direction.unsqueeze(-1) * direction.unsqueeze(-2)
    identity = torch.eye(2, dtype=A.dtype, device=A.device)
    return (
        torch.where(full.unsqueeze(-1), vertex, share.unsqueeze(-1) * direction),
        torch.where(full[..., None, None], identity, line),
        torch.where(full, 2, torch.where(none, 0, 1)),
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
    m, shape = generators.shape[-2], present.shape[:-1]
    step = torch.arange(fan, dtype=generators.dtype, device=generators.device) / (fan - 1)
    around = _directions(2 * math.pi * step[:-1])
    some = present.any(-1).reshape(-1).nonzero().squeeze(-1)
    cones = math.prod(shape)
    normals = torch.nn.functional.pad(around, (0, 0, 0, 2)).expand(cones, fan + 1, 2)
    nearest = torch.full((cones, fan + 1), m, device=present.device)
    if len(some) > 0:
        present, generators = present.reshape(-1, m)[some], generators.expand(*shape, m, 2).reshape(-1, m, 2)[some]
        of_cones, near = _normals_of_cones(generators, present, step)
        normals, nearest = normals.index_put((some,), of_cones), nearest.index_put((some,), near)
    return OutwardNormals(normals.reshape(*shape, fan + 1, 2), nearest.reshape(*shape, fan + 1))


def _normals_of_cones(
    generators: Float[Tensor, "k m 2"], present: Bool[Tensor, "k m"], step: Float[Tensor, "fan"]
) -> tuple[Float[Tensor, "k fan+1 2"], Int[Tensor, "k fan+1"]]:
    """`outward_normals` of cones that have a generator."""
    count = present.sum(-1, keepdim=True)
    safe = torch.where(present.unsqueeze(-1), generators, 1.0)
    angles, order = torch.where(present, torch.atan2(safe[..., 1], safe[..., 0]), math.inf).sort(-1)
    slot = torch.arange(angles.shape[-1], device=angles.device)
    following = torch.where(slot == count - 1, angles[..., :1] + 2 * math.pi, angles.roll(-1, -1))
    gaps = torch.where(slot < count, following - angles, -math.inf)

    widest = gaps.argmax(-1, keepdim=True)
    start, opening = angles.gather(-1, widest) + math.pi / 2, gaps.gather(-1, widest) - math.pi
    needed = (opening >= -ANGLE_TOLERANCE) & ((step == 0) | (opening > ANGLE_TOLERANCE))

    # Two gaps of 180 degrees: the cone is a line, and the second gap gives its other side.
    others = gaps.scatter(-1, widest, -math.inf)
    second = others.argmax(-1, keepdim=True)
    is_line = others.gather(-1, second) >= math.pi - ANGLE_TOLERANCE
    other_side = torch.where(is_line, angles.gather(-1, second) + math.pi / 2, 0.0)

    normals = _directions(
        torch.cat([torch.where(needed, start + step * opening.clamp(min=0), 0.0), other_side], dim=-1)
    )
    end = torch.where(widest == count - 1, 0, widest + 1)
    near = torch.cat([torch.where(step < 0.5, widest, end), second], dim=-1)
    needed = torch.cat([needed, is_line], dim=-1).unsqueeze(-1)
    return torch.where(needed, normals, 0.0), order.gather(-1, near)


def _directions(angles: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape 2"]:
    return torch.stack([angles.cos(), angles.sin()], dim=-1)
