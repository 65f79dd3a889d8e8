r"""The two programmes of `programmes`, solved on numpy arrays (B, ...), with what their derivatives need. No gradients.

Rows are normalised, the point becomes the origin and the metric the identity; `active_rows` then finds the active rows.
"""

from __future__ import annotations

import numpy as np

from torchfsid.outcome import ProgrammeStatus
from torchfsid.programmes import active_rows
from torchfsid.programmes.active_rows import Indices, Mask, Reals, inscribed_rows, nearest_rows, simplex_around, times
from torchfsid.tolerances import MOST_ROUNDS, PARALLEL_ROWS, ROUND_OFF, TIE


def nearest_point(A: Reals, b: Reals, y: Reals, metric: Reals | None = None, parallel: float = PARALLEL_ROWS) -> tuple:
    """Point, multipliers, active rows, the places they fill, status."""
    B, m, p = A.shape
    if active_rows.installed() and metric is None:
        from torchfsid.kernels import programmes as kernel

        z, mu, at = np.zeros((B, p)), np.zeros((B, p)), np.zeros((B, p), dtype=np.int64)
        filled, status = np.zeros((B, p), dtype=bool), np.zeros(B, dtype=np.int64)
        most = MOST_ROUNDS * (m + p)
        kernel.nearest_point(A, b, y, parallel, ROUND_OFF, most, z, mu, at, filled, status)
        return z, mu, at, filled, status
    finite = np.isfinite(A.sum((1, 2)) + b.sum(-1) + y.sum(-1))
    rows = A
    if metric is not None:
        root, definite = _roots(metric)
        finite &= definite & np.isfinite(metric.sum((1, 2)))
        rows = _whitened(A, root)
    unit, offsets, impossible = _unit(rows, b - times(A, y), finite)
    found = nearest_rows(unit, offsets, parallel)
    ok = finite & ~found.empty & ~impossible
    filled = ok[:, None] & (np.arange(p) < found.count[:, None])
    z = found.point if metric is None else np.linalg.solve(root.swapaxes(-1, -2), found.point[..., None])[..., 0]
    # Once more, as a correction: this removes the round-off of a distant y, and gives the given rows' own multipliers.
    z, pull = np.where(ok[:, None], y + z, 0.0), np.where(ok[:, None], -z, 0.0)
    pull = pull if metric is None else times(metric, pull)
    at = np.arange(B)[:, None]
    N = np.where(filled[..., None], A[at, found.rows], 0.0)
    correction, mu = solve_active(N, filled, pull, np.where(filled, b[at, found.rows], 0.0) - times(N, z), metric)
    status = np.where(finite, np.where(ok, ProgrammeStatus.OK, ProgrammeStatus.EMPTY), ProgrammeStatus.UNDEFINED)
    return np.where(ok[:, None], z + correction, np.nan), mu, found.rows, filled, status


def solve_active(N: Reals, filled: Mask, pull: Reals, offsets: Reals, metric: Reals | None = None) -> tuple:
    """z and mu with H z + N' mu = pull, N z = offsets, for the first rows of N, `filled`."""
    if metric is None:
        return active_rows.solve_active(N, filled, pull, offsets)
    root, _ = _roots(metric)
    pull = np.linalg.solve(root, pull[..., None])[..., 0]
    z, mu = active_rows.solve_active(_whitened(N, root), filled, pull, offsets)
    return np.linalg.solve(root.swapaxes(-1, -2), z[..., None])[..., 0], mu


def inscribed_ball(A: Reals, b: Reals) -> tuple:
    """Centre, radius, the rows that decide them (m and above: at infinity), status."""
    B, m, p = A.shape
    if active_rows.installed():
        from torchfsid.kernels import programmes as kernel

        centre, radius = np.zeros((B, p)), np.zeros(B)
        rows, status = np.zeros((B, p + 1), dtype=np.int64), np.zeros(B, dtype=np.int64)
        most = MOST_ROUNDS * (m + p)
        kernel.inscribed_ball(A, b, simplex_around(p), TIE, ROUND_OFF, most, centre, radius, rows, status)
        return centre, radius, rows, status
    finite = np.isfinite(A.sum((1, 2)) + b.sum(-1))
    unit, offsets, impossible = _unit(A, b, finite)
    found = inscribed_rows(unit, offsets)
    ball, radius = found.ball, found.ball[:, p]
    size = np.abs(offsets[np.arange(B)[:, None], found.rows.clip(max=m - 1)]).max(-1) + np.abs(ball).sum(-1)
    thin = np.abs(radius) <= ROUND_OFF * size
    undecided = ~finite | impossible | found.open_radius
    status = np.where(thin, ProgrammeStatus.DEGENERATE, np.where(radius < 0, ProgrammeStatus.EMPTY, ProgrammeStatus.OK))
    status[found.open_centre & (status == ProgrammeStatus.OK)] = ProgrammeStatus.UNBOUNDED
    ball[:, :p][found.open_centre | undecided] = np.nan
    for mask, value, what in (
        (found.open_radius, np.inf, ProgrammeStatus.UNBOUNDED),
        (impossible, -np.inf, ProgrammeStatus.EMPTY),
        (~finite, np.nan, ProgrammeStatus.UNDEFINED),
    ):
        radius[mask], status[mask] = value, what
    return ball[:, :p], radius, np.where(undecided[:, None], m + np.arange(p + 1), found.rows), status


def of_nearest_point(
    A: Reals, rows: Indices, filled: Mask, mu: Reals, z: Reals, status: Indices, of_z: Reals, of_mu: Reals
) -> tuple:
    """The derivative with respect to A, b and y of a sum weighted by of_z and of_mu, compiled."""
    from torchfsid.kernels import programmes as kernel

    of_A, of_b, of_y = np.zeros_like(A), np.zeros(A.shape[:2]), np.zeros_like(z)
    kernel.of_nearest_point(A, rows, filled, mu, z, status, of_z, of_mu, of_A, of_b, of_y)
    return of_A, of_b, of_y


def of_inscribed_ball(
    A: Reals, centre: Reals, radius: Reals, rows: Indices, of_centre: Reals, of_radius: Reals
) -> tuple:
    """The derivative with respect to A and b of a sum weighted by of_centre and of_radius, compiled."""
    from torchfsid.kernels import programmes as kernel

    of_A, of_b = np.zeros_like(A), np.zeros(A.shape[:2])
    kernel.of_inscribed_ball(A, centre, radius, rows, simplex_around(A.shape[2]), of_centre, of_radius, of_A, of_b)
    return of_A, of_b


def _roots(metric: Reals) -> tuple[Reals, Mask]:
    """Cholesky factors, the identity where a matrix is not positive definite; is it?"""
    p = metric.shape[-1]
    root, definite = np.zeros_like(metric), np.ones(len(metric), dtype=bool)
    for j in range(p):
        column = metric[:, j:, j] - (root[:, j:, :j] @ root[:, j, :j, None])[..., 0]
        definite &= column[:, 0] > 0
        root[:, j:, j] = column / np.sqrt(np.where(definite, column[:, 0], 1.0))[:, None]
    definite &= np.isfinite(root).all((-1, -2))
    return np.where(definite[:, None, None], root, np.eye(p)), definite


def _whitened(rows: Reals, root: Reals) -> Reals:
    """Rows as functions of root' z."""
    return np.linalg.solve(root, rows.swapaxes(-1, -2)).swapaxes(-1, -2)


def _unit(A: Reals, b: Reals, finite: Mask) -> tuple[Reals, Reals, Mask]:
    """Unit rows and their offsets (zero rows for items that are not finite); does some row 0.z <= b have b < 0?"""
    if not finite.all():
        A, b = np.where(finite[:, None, None], A, 0.0), np.where(finite[:, None], b, 1.0)
    norms = np.sqrt(np.einsum("bmp,bmp->bm", A, A))
    is_row = norms > 0
    norms = np.where(is_row, norms, 1.0)
    return A / norms[..., None], b / norms, (~is_row & (b < 0)).any(-1)
