r"""Which rows are active at the solution: two convex programmes, searched for many items at once, without gradients.

    nearest point     min 1/2 |z|^2   s.t.  a_j.z <= b_j              at most p active rows
    inscribed ball    max r           s.t.  a_j.z + r <= b_j          p + 1 active rows, w = (z, r)

with unit rows a_j. Both by a dual active-set method: every iterate solves its own active rows exactly, and the row that
it violates most enters, until none is violated. The nearest point is after Goldfarb and Idnani (Math. Programming 27,
1983): with W the active rows, completed by an orthonormal basis of what they leave free, a row n has the coordinates c,
n = W'c; pushing it by t changes the multipliers by -t c and its violation by -t |c_free|^2; a multiplier that reaches
zero first leaves. The inscribed ball is the dual simplex method with lexicographic ratios, which cannot cycle and makes
the answer unique: of all centres, the one with the smallest z_1, among these the smallest z_2, and so on.

Everything is computed afresh from the active rows in each round, so that round-off does not accumulate; what it leaves
open about a violation counts as none. numpy, because on one item an operation costs a third of torch's.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchfsid.kernels.compiled import installed
from torchfsid.tolerances import MOST_ROUNDS, PARALLEL_ROWS, ROUND_OFF, TIE

CLEAR = 1e-3
"""Violations above this share of the sizes at hand are no round-off, whatever the rows."""

NEAR = 0.71
"""Cosine of the angle within which a row can stand in for a side of the simplex that a search begins with."""

FEW = 32
"""Matrices fewer than these are inverted by LAPACK."""

Reals = Indices = Mask = NDArray[Any]  # of float64, int64, bool


class NearestRows(NamedTuple):
    """Where the nearest point is, and why.

    Attributes:
        point: (B, p), nearest to the origin.
        rows: (B, p), the active rows in the first `count` places.
        count: (B,).
        multipliers: (B, p), -point = sum_s multipliers_s a_s, all >= 0; 0 behind the first `count`.
        empty: (B,), no point satisfies the rows (or the search gave up, which has not been seen).
    """

    point: Reals
    rows: Indices
    count: Indices
    multipliers: Reals
    empty: Mask


class InscribedRows(NamedTuple):
    """Which rows touch the largest inscribed ball.

    Attributes:
        ball: (B, p + 1), centre and radius; of an empty set the radius is minus its depth.
        rows: (B, p + 1), the rows that decide it; m and above: none of the rows, the set is open there.
        open_centre: (B,), there is no first centre. open_radius: (B,), there is no largest ball.
    """

    ball: Reals
    rows: Indices
    open_centre: Mask
    open_radius: Mask


def nearest_rows(A: Reals, b: Reals, parallel: float = PARALLEL_ROWS) -> NearestRows:
    """The point nearest to the origin in each {z : A z <= b}; unit rows A (B, m, p), or zero rows, which are ignored.

    Feasible sets whose corners are sharper than `parallel` [rad] may be called empty.
    """
    B, m, p = A.shape
    found = NearestRows(
        point=np.zeros((B, p)),
        rows=np.zeros((B, p), dtype=np.int64),
        count=np.zeros(B, dtype=np.int64),
        multipliers=np.zeros((B, p)),
        empty=np.zeros(B, dtype=bool),
    )
    b = np.where((A == 0).all(-1), np.inf, b)
    if installed():
        from torchfsid.kernels import active_rows as kernel

        kernel.nearest_rows(np.ascontiguousarray(A), b, parallel, ROUND_OFF, MOST_ROUNDS * (m + p), *found)
        return found
    items = np.flatnonzero((b < 0).any(-1))
    A, b = A[items], b[items]
    at, slots = np.arange(len(items)), np.arange(p)
    # Per item: the active rows, how many, the row that is being pushed (-1: none), its multiplier so far.
    rows: Indices = np.zeros((len(items), p), dtype=np.int64)
    count: Indices = np.zeros(len(items), dtype=np.int64)
    entering: Indices = np.full(len(items), -1)
    push: Reals = np.zeros(len(items))
    for _ in range(MOST_ROUNDS * (m + p)):
        if len(items) == 0:
            return found
        filled = slots < count[:, None]
        N, right = A[at[:, None], rows], np.where(filled, b[at[:, None], rows], 0.0)
        W = completed(N, filled)
        V = inverse(W)
        z = times(V, right)
        z = z + times(V, right - times(W, z))  # the rows of a sharp corner hold to round-off then
        fresh = entering < 0
        q = np.where(fresh, (times(A, z) - b).argmax(-1), entering)
        n, bound = A[at, q], b[at, q]
        c = (n[:, None] @ V)[:, 0]
        free = np.where(filled, 0.0, c)
        if not fresh.all():
            z = z - push[:, None] * times(V, free)
        held = -((z + push[:, None] * n)[:, None] @ V)[:, 0]
        over = (n * z).sum(-1) - bound

        size = np.abs(z).sum(-1, keepdims=True)
        done = fresh & (over <= CLEAR * (np.abs(bound) + size[:, 0]))
        if done.any():
            noise = (np.abs(c) * (size + np.abs(right))).sum(-1) + size[:, 0] + np.abs(bound)
            done = fresh & (over <= ROUND_OFF * noise)
        slope = (free * free).sum(-1)
        apart = slope > np.square(parallel + ROUND_OFF * np.abs(c).sum(-1))
        full = np.where(apart, over.clip(min=0) / np.where(apart, slope, 1.0), np.inf)
        able = filled & (c > ROUND_OFF)
        ratio = np.where(able, held.clip(min=0) / np.where(able, c, 1.0), np.inf)
        slot = ratio.argmin(-1)
        short = ratio[at, slot]
        blocked = (short < full) & ~done
        stopped = done | ~(apart | blocked)

        if stopped.any():
            found.empty[items[stopped]] = ~done[stopped]
            solved = items[done]
            found.point[solved], found.rows[solved], found.count[solved] = z[done], rows[done], count[done]
            found.multipliers[solved] = np.where(filled, held.clip(min=0), 0.0)[done]
        added = ~(blocked | stopped)
        count += added
        count -= blocked
        # The last of the active rows moves into the place of the one that leaves; the one that enters goes last.
        last = (count - added).clip(max=p - 1)
        to = np.where(blocked, slot, last)
        rows[at, to] = np.where(added, q, rows[at, last])
        entering, push = np.where(blocked, q, -1), np.where(blocked, push + short, 0.0)
        if stopped.any():
            on = ~stopped
            items, at = items[on], at[: on.sum()]
            A, b, rows, count, entering, push = _kept(on, A, b, rows, count, entering, push)
    found.empty[items] = True
    return found


def inscribed_rows(A: Reals, b: Reals) -> InscribedRows:
    """The largest ball in each {z : A z <= b}; unit rows A (B, m, p), or zero rows, which are ignored."""
    B, m, p = A.shape
    found = InscribedRows(
        ball=np.zeros((B, p + 1)),
        rows=np.zeros((B, p + 1), dtype=np.int64),
        open_centre=np.zeros(B, dtype=bool),
        open_radius=np.zeros(B, dtype=bool),
    )
    zero = (A == 0).all(-1)
    b, has_zero = np.where(zero, np.inf, b), zero.any()
    if installed():
        from torchfsid.kernels import active_rows as kernel

        most = MOST_ROUNDS * (m + p)
        kernel.inscribed_rows(np.ascontiguousarray(A), b, simplex_around(p), TIE, ROUND_OFF, most, *found)
        return found
    items, at = np.arange(B), np.arange(B)
    basis, M, right, far = _first_basis(A, b)
    for _ in range(MOST_ROUNDS * (m + p)):
        if len(items) == 0:
            break
        V = inverse(M)
        w = times(V, right)
        w = w + times(V, right - times(M, w))
        price = times(A, w[:, :p]) + w[:, p:] - b
        is_open = far.any()
        if is_open:  # infinitely violated rows come first, infinitely slack ones never
            w_far = times(V, far)
            rate = times(A, w_far[:, :p]) + w_far[:, p:]
            price = np.where(rate > TIE, rate * 1e300, np.where(rate < -TIE, -np.inf, price))
            if has_zero:
                price = np.where(zero[items], -np.inf, price)
        q = price.argmax(-1)
        n, bound = np.ones((len(items), p + 1)), b[at, q]
        n[:, :p] = A[at, q]
        share = (n[:, None] @ V)[:, 0]
        size, worst = np.abs(w).sum(-1, keepdims=True), price[at, q]
        done = worst <= CLEAR * np.where(np.isinf(bound), 0.0, np.abs(bound) + size[:, 0])
        if done.any():
            noise = (np.abs(share) * (size + np.abs(right))).sum(-1) + size[:, 0] + np.abs(bound)
            done = worst <= ROUND_OFF * noise
        if done.any():
            stopped = items[done]
            found.ball[stopped], found.rows[stopped] = w[done], basis[done]
            if is_open:
                found.open_centre[stopped] = (np.abs(w_far[done, :p]) > TIE).any(-1)
                found.open_radius[stopped] = w_far[done, p] > TIE
            on = ~done
            items, at = items[on], at[: on.sum()]
            A, b, basis, M, right, far, V, share, n, q, bound = _kept(
                on, A, b, basis, M, right, far, V, share, n, q, bound
            )
        slot = _leaving(V, share)
        basis[at, slot], M[at, slot], right[at, slot], far[at, slot] = q, n, bound, 0.0
    return found


def _first_basis(A: Reals, b: Reals) -> tuple[Indices, Reals, Reals, Reals]:
    """Rows, matrix and right-hand sides, right + infinity * far, with positive multipliers.

    For each side of a simplex around everything, infinitely far away, the nearest row that faces the same way; if these
    rows do not enclose a ball, the simplex.
    """
    B, m, p = A.shape
    simplex = simplex_around(p)
    offsets = np.where(A @ simplex.T > NEAR, b[..., None], np.inf)
    basis, far = offsets.argmin(1), np.zeros((B, p + 1))
    at = np.arange(B)[:, None]
    M, right = np.ones((B, p + 1, p + 1)), b[at, basis]
    M[:, :, :p] = A[at, basis]
    enclosed = np.isfinite(offsets.min(1)).all(-1) & (np.linalg.det(M) != 0)
    M[~enclosed, :, :p] = simplex
    enclosed &= (inverse(M)[:, p] > TIE).all(-1)
    if not enclosed.all():
        M[~enclosed, :, :p] = simplex
        basis[~enclosed], right[~enclosed], far[~enclosed] = np.arange(m, m + p + 1), 0.0, 1.0
    return basis, M, right, far


def _leaving(V: Reals, share: Reals) -> Indices:
    """The place in the basis that goes: the first to lose its multiplier, among those the first to let z_1 grow ..."""
    p = V.shape[1] - 1
    able = share > TIE
    divisor = np.where(able, share, 1.0)
    for key in (V[:, p], *(-V[:, k] for k in range(p))):
        ratio = np.where(able, key / divisor, np.inf)
        able = ratio <= ratio.min(-1, keepdims=True) + TIE
        if able.sum() == len(able):
            return able.argmax(-1)
    return np.where(able, share, -np.inf).argmax(-1)


@cache
def simplex_around(p: int) -> Reals:
    """Unit outward normals of the p + 1 sides of a simplex."""
    return np.concatenate([-np.eye(p), np.full((1, p), p**-0.5)])


def solve_active(N: Reals, filled: Mask, pull: Reals, offsets: Reals) -> tuple[Reals, Reals]:
    """z and mu with z + N' mu = pull, N z = offsets, for the first rows of N, `filled`; mu = 0 for the others."""
    if installed():
        from torchfsid.kernels import active_rows as kernel

        z, mu = np.zeros_like(pull), np.zeros_like(pull)
        kernel.solve_active(N, filled, pull, offsets, z, mu)
        return z, mu
    W = completed(N, filled)
    V = inverse(W)
    z = times(V, np.where(filled, offsets, times(W, pull)))
    return z, np.where(filled, ((pull - z)[:, None] @ V)[:, 0], 0.0)


def completed(N: Reals, filled: Mask) -> Reals:
    """The rows of N that are `filled`, the first ones, and behind them an orthonormal basis of what they leave free."""
    if N.shape[-1] == 2:
        W = np.empty_like(N)
        W[:, 0] = np.where(filled[:, :1], N[:, 0], (1.0, 0.0))
        W[:, 1, 0], W[:, 1, 1] = -W[:, 0, 1], W[:, 0, 0]
        W[:, 1] = np.where(filled[:, 1:], N[:, 1], W[:, 1])
        return W
    filled = filled[..., None]
    Q, _ = np.linalg.qr(np.where(filled, N, 0.0).swapaxes(-1, -2))
    return np.where(filled, N, Q.swapaxes(-1, -2))


def inverse(W: Reals) -> Reals:
    """Inverses of (B, k, k), by cofactors where that is quicker."""
    B, k, _ = W.shape
    if k > 3 or (k == 3 and B < FEW):
        return np.linalg.inv(W)
    V = np.empty_like(W)
    if k == 1:
        return 1.0 / W
    if k == 2:
        V[:, 0, 0], V[:, 1, 1] = W[:, 1, 1], W[:, 0, 0]
        V[:, 0, 1], V[:, 1, 0] = -W[:, 0, 1], -W[:, 1, 0]
        determinant = W[:, 0, 0] * W[:, 1, 1] - W[:, 0, 1] * W[:, 1, 0]
    else:
        x, y, z = np.ascontiguousarray(W.transpose(2, 1, 0))
        yz = y[[1, 2, 0]] * z[[2, 0, 1]] - y[[2, 0, 1]] * z[[1, 2, 0]]
        zx = z[[1, 2, 0]] * x[[2, 0, 1]] - z[[2, 0, 1]] * x[[1, 2, 0]]
        xy = x[[1, 2, 0]] * y[[2, 0, 1]] - x[[2, 0, 1]] * y[[1, 2, 0]]
        V[:, 0], V[:, 1], V[:, 2] = yz.T, zx.T, xy.T
        determinant = (x * yz).sum(0)
    return V / determinant[:, None, None]


def _kept(items: Mask, *arrays: Reals) -> tuple[Reals, ...]:
    return tuple(array[items] for array in arrays)


def times(M: Reals, v: Reals) -> Reals:
    return (M @ v[..., None])[..., 0]
