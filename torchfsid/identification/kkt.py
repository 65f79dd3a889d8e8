r"""The KKT conditions of the safety QP, solved once for all of the paper's cases A-E.

    u* = argmin |u - uhat|^2  s.t.  A u <= b,       uhat = C theta + d,
    uhat - u* = 1/2 sum_active mu_j a_j,  mu >= 0                                     (G., Eqs. (7)-(10), (15))

With A_a, b_a the active rows (the others zeroed by a mask, so that it batches) and P = A_a^+ A_a,

    u*(theta) = G theta + f,   G = (I - P) C,   f = A_a^+ b_a + (I - P) d             (G., Eqs. (25), (36), (45), (48))

In the plane A_a^+ has a closed form. Let the columns of W be an orthonormal basis of the row space, each divided by its
singular value: the columns of A_a W are orthonormal up to round-off, S = (A_a W)'(A_a W) = I + E with E small, and

    A_a^+ b_a = W S^-1 (A_a W)' b_a,     S^-1 = I - E + E^2          (the first and second derivatives are exact, too)

This keeps the digits that the Gram matrix of nearly parallel rows loses. At rank 2 it holds for any W, so W is found
without gradients. So orthogonal rows of equal length, where the derivative of an SVD does not exist, need no special
treatment. At rank 1, W is the rows' direction.

The multipliers exist exactly where  C theta + d - u*(theta)  lies in  cone{a_j : j active}. In the plane this cone is
described by outward normals. The generators are sorted by angle. If there is an angular gap of at least 180 degrees,
the polar cone opens in it, from one end + 90 degrees to the other - 90. Otherwise the cone is the whole plane.
The letters A-E are names for (K, rank). They are computed for tables only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, dot
from torchfsid.tolerances import ANGLE_TOLERANCE, RANK_TOLERANCE

CASES = "ABCDE"
"""Table I of the paper: A none active; B one; C several, rank 1; D two, rank 2; E three or more, rank 2."""


@dataclass(frozen=True)
class KktSolution:
    """The control as a function of the parameter while the active set stays as it is.

    Attributes:
        G: of u*(theta) = G theta + f.
        f: of u*(theta) = G theta + f [m/s].
        projector: P = A_a^+ A_a, onto the span of the active rows.
        free: I - P, exactly zero at full rank.
        offset: A_a^+ b_a, the part of u* that the active rows decide [m/s].
        active: the active rows.
        n_active: K, the number of active rows.
        rank: the rank of A_a.
        case: the index of the case in `CASES`.
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

    def select(self, items: Int[Tensor, "k"]) -> KktSolution:
        """The solutions at the places `items` of a batch (B,)."""
        return KktSolution(*(getattr(self, part.name)[items] for part in fields(self)))


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
    return solve_unit(safe_controls.normalised(), active, C.to(torch.float64), d.to(torch.float64))


def solve_unit(
    unit: Halfspaces,
    active: Bool[Tensor, "*batch m"],
    C: Float[Tensor, "*batch n p"],
    d: Float[Tensor, "*batch n"],
) -> KktSolution:
    """`solve_kkt` for unit rows."""
    n, p = unit.dim, C.shape[-1]
    A, b = unit.A.masked_fill(~active.unsqueeze(-1), 0.0), unit.b.masked_fill(~active, 0.0)

    offset, projector, rank = _solve_planar(A, b) if n == 2 else _solve(A, b)
    identity = torch.eye(n, dtype=A.dtype, device=A.device)
    # At full rank u* does not depend on theta. G is then exactly zero, not a rounding error of I - P.
    free = (identity - projector).masked_fill((rank == n)[..., None, None], 0.0)
    through = free @ torch.cat([C, d.unsqueeze(-1)], dim=-1)

    n_active = active.sum(-1)
    several = torch.where(rank < n, 2, torch.where(n_active == n, 3, 4))
    return KktSolution(
        G=through[..., :p],
        f=offset + through[..., p],
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
    y, size, across, rank = _principal_axes(A.detach())
    full = (rank == 2)[..., None, None]
    # Rank 1: the rows' direction. One step of the converged power iteration gives it with its gradient.
    direction = (A.mT @ y.unsqueeze(-1)).squeeze(-1)
    length = dot(direction, direction).masked_fill(rank == 0, 1.0).sqrt()
    direction = direction / length.unsqueeze(-1)
    along = direction / size.unsqueeze(-1)
    W = torch.stack([torch.where(full[..., 0], along.detach(), along), across], dim=-1)

    identity = torch.eye(2, dtype=A.dtype, device=A.device)
    columns = A @ W
    square, right = (columns.mT @ torch.cat([columns, b.unsqueeze(-1)], dim=-1)).split([2, 1], dim=-1)
    off = square - identity  # E
    correction = off @ right
    offset = (W @ (right - correction + off @ correction)).squeeze(-1)
    line = direction.unsqueeze(-1) * direction.unsqueeze(-2)
    return offset, torch.where(full, identity, line), rank


@torch.no_grad()
def _principal_axes(A: Float[Tensor, "*batch m 2"]) -> tuple[Tensor, Tensor, Tensor, Int[Tensor, "*batch"]]:
    """The principal axes of rows A.

    Returns:
        y = A v_1 with v_1 the first axis, the first singular value |y| (1 without rows), the second axis divided by
        its singular value (zero at a lower rank), and the rank.
    """
    first, second = A.unbind(-1)
    turn = torch.atan2(2 * (first * second).sum(-1), ((first + second) * (first - second)).sum(-1)) / 2
    cos, sin = turn.cos().unsqueeze(-1), turn.sin().unsqueeze(-1)
    y, z = cos * first + sin * second, cos * second - sin * first
    yy = y.square().sum(-1, keepdim=True)
    none = yy == 0
    share = (y * z).sum(-1, keepdim=True) / torch.where(none, 1.0, yy)
    ww = (z - y * share).square().sum(-1, keepdim=True)  # orthogonal to y, and as long as the second singular value
    full = ww > RANK_TOLERANCE**2 * yy
    across = torch.cat([-sin - cos * share, cos - sin * share], dim=-1) * torch.where(full, ww, 1.0).rsqrt()
    rank = torch.where(full, 2, torch.where(none, 0, 1)).squeeze(-1)
    return y, yy.masked_fill(none, 1.0).sqrt().squeeze(-1), across.masked_fill(~full, 0.0), rank


class OutwardNormals(NamedTuple):
    """Outward normals of a cone.

    Attributes:
        normals: unit vectors, zero where not needed.
        generator: the generator nearest to each; m for none.
        opening: by how much the widest angle without generators exceeds 180 degrees [rad]; 2 pi without generators. If
            it is positive, the cone contains no line: no positive combination of its generators is zero. Else it is 0.
    """

    normals: Float[Tensor, "*batch k 2"]
    generator: Int[Tensor, "*batch k"]
    opening: Float[Tensor, "*batch"]


def outward_normals(
    generators: Float[Tensor, "*batch m 2"], present: Bool[Tensor, "*batch m"], fan: int
) -> OutwardNormals:
    """Outward normals of cone{a_j : j present} in the plane: w is in the cone iff n.w <= 0 for all of them.

    Up to `fan` normals are spread evenly over the polar cone, both ends included. The two ends suffice for a pointed
    cone. A ray needs a cap as well. More normals round off the corners of a widened cone. One additional normal is for
    a line, so k = fan + 1. Without generators the cone is the origin, and the fan is a full turn.

    Raises:
        InputError: the generators are not planar, or `fan` < 3.
    """
    if generators.shape[-1] != 2:
        raise InputError("generators", "planar controls, (*batch, m, 2)", tuple(generators.shape))
    if fan < 3:
        raise InputError("fan", "at least 3 normals (two ends and a cap)", fan)
    m, shape = generators.shape[-2], present.shape[:-1]
    if m == 0:  # a generator that is never present
        generators, present = generators.new_zeros(*shape, 1, 2), present.new_zeros(*shape, 1)
    generators = generators.expand(*shape, max(m, 1), 2)
    gaps = _gaps(generators.detach(), present)

    # The rows at the ends of the gaps were found without gradients. Their normals are computed with gradients.
    ends = generators.gather(-2, gaps.ends.unsqueeze(-1).expand(*shape, 3, 2))
    none = ~gaps.some
    ends = ends.masked_fill(none.unsqueeze(-1), 1.0)
    first, last, second = torch.atan2(ends[..., 1], ends[..., 0]).unsqueeze(-1).unbind(-2)
    opening = (last - first + (gaps.turns - math.pi)).masked_fill(none, 2 * math.pi)
    start = (first + math.pi / 2).masked_fill(none, 0.0)
    step = torch.linspace(0.0, 1.0, fan, dtype=generators.dtype, device=generators.device)
    angles = torch.cat([start + step * opening.clamp(min=0), second + math.pi / 2], dim=-1)
    normals = torch.stack([angles.cos(), angles.sin()], dim=-1)

    inner = torch.where(gaps.some, gaps.is_wide | (gaps.is_open & (step == 0)), step < 1)
    needed = torch.cat([inner, gaps.is_line], dim=-1)
    from_first, from_last, from_second = gaps.ends.unsqueeze(-1).unbind(-2)
    near = torch.cat([torch.where(step < 0.5, from_first, from_last), from_second], dim=-1)
    opening = opening.detach().masked_fill(~(none | gaps.is_wide), 0.0).squeeze(-1)
    return OutwardNormals(normals.masked_fill(~needed.unsqueeze(-1), 0.0), near.masked_fill(none, m), opening)


class _Gaps(NamedTuple):
    """The widest angular gap between generators, and the second widest.

    Attributes:
        ends: the generators where the widest gap begins and ends, and the one where the second begins.
        turns: 2 pi where the widest gap contains the angle pi, at which angles wrap; 0 elsewhere.
        some: whether there are generators.
        is_open: whether the widest gap is at least 180 degrees.
        is_wide: whether the widest gap is more than 180 degrees.
        is_line: whether both gaps are 180 degrees.
    """

    ends: Int[Tensor, "*batch 3"]
    turns: Float[Tensor, "*batch 1"]
    some: Bool[Tensor, "*batch 1"]
    is_open: Bool[Tensor, "*batch 1"]
    is_wide: Bool[Tensor, "*batch 1"]
    is_line: Bool[Tensor, "*batch 1"]


@torch.no_grad()
def _gaps(generators: Float[Tensor, "*batch m 2"], present: Bool[Tensor, "*batch m"]) -> _Gaps:
    count = present.sum(-1, keepdim=True)
    angles = torch.atan2(generators[..., 1], generators[..., 0])
    angles, order = angles.masked_fill(~present, math.inf).sort(-1)
    slot = torch.arange(angles.shape[-1], device=angles.device)
    following = torch.where(slot == count - 1, angles[..., :1] + 2 * math.pi, angles.roll(-1, -1))
    gaps = torch.where(slot < count, following - angles, -math.inf)
    widest = gaps.argmax(-1, keepdim=True)
    opening = gaps.gather(-1, widest) - math.pi
    others = gaps.scatter(-1, widest, -math.inf)
    second = others.argmax(-1, keepdim=True)
    wraps = widest >= count - 1
    places = torch.cat([widest, torch.where(wraps, 0, widest + 1), second], dim=-1)
    return _Gaps(
        order.gather(-1, places),
        2 * math.pi * wraps.to(generators.dtype),
        count > 0,
        opening >= -ANGLE_TOLERANCE,
        opening > ANGLE_TOLERANCE,
        others.gather(-1, second) >= math.pi - ANGLE_TOLERANCE,
    )
