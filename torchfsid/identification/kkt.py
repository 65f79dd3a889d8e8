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

The multipliers exist exactly where  C theta + d - u*(theta)  lies in  cone{a_j : j active} (`normals`).
The letters A-E are names for (K, rank). They are computed for tables only.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, dot
from torchfsid.tolerances import RANK_TOLERANCE

CASES = "ABCDE"
"""Table I of the paper: A none active; B one; C several, rank 1; D two, rank 2; E three or more, rank 2.

In space the rank may be 3, and the letters ask the same: is any row active (A), are the active rows independent (B one,
D several), are they dependent (C of rank 1, E of a higher rank)? Rank 2 leaves theta free along a line, rank 3 nowhere.
"""


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
    require_fit(safe_controls, active, C, d)
    return solve_unit(safe_controls.normalised(), active, C.to(torch.float64), d.to(torch.float64))


def require_fit(safe_controls: Halfspaces, active: Tensor, C: Tensor, d: Tensor) -> None:
    """Check the shapes of the arguments of `solve_kkt`.

    Raises:
        InputError: they do not fit the rows.
    """
    m, n = safe_controls.rows, safe_controls.dim
    if active.shape[-1] != m:
        raise InputError("active", f"(*batch, {m})", tuple(active.shape))
    if C.shape[-2] != n or d.shape[-1] != n:
        raise InputError("C, d", f"C (*batch, {n}, p) and d (*batch, {n})", (tuple(C.shape), tuple(d.shape)))


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
    several = torch.where(rank < 2, 2, torch.where(n_active == rank, 3, 4))
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
