r"""Which rows of A z <= b are active at the solution of two convex programmes: the searches, for one item each.

    nearest point     min 1/2 |z|^2   s.t.  a_j.z <= b_j              at most p active rows
    inscribed ball    max r           s.t.  a_j.z + r <= b_j          p + 1 active rows, w = (z, r)

The rows a_j have unit length. Both searches are dual active-set methods: every iterate solves its own active rows
exactly, and the row that it violates most enters, until none is violated.

The nearest point is found by the method of Goldfarb and Idnani (Math. Programming 27, 1983). The active rows are made
orthogonal one by one, a_s = Q_s + sum_i<s T_si Q_i. An entering row n is n = sum_s c_s a_s + d, d orthogonal to all of
them. A step of length t changes the multipliers by -t c and the row's violation by -t |d|^2. The row whose multiplier
reaches zero first leaves. If d = 0 and no row can leave, then n - sum_s c_s a_s = 0 combines rows with weights >= 0
whose bounds contradict each other: the set is empty.

The inscribed ball is found by the dual simplex method with lexicographic ratios. These prevent cycles and make the
answer unique: of all centres, the one with the smallest z_1, among these the one with the smallest z_2, and so on. The
search starts from a simplex around all points, infinitely far away. Its sides are replaced at once by rows that face
the same way, where there are any. So every number has two parts: a finite one, and a rate at which it grows with the
distance of the simplex.

A pivot that round-off cannot tell from zero is never taken. `epsilon` is the round-off of the arithmetic: `ROUND_OFF`
for floating point, 0 for exact rationals. For rationals the same functions are called uncompiled
(`programmes.rational`). Therefore they take no square root, and their sums start from an integer.
"""

from __future__ import annotations

from functools import cache
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, item_in_place
from torchfsid.kernels.linear import invert, on_rows, orthogonalise, solve_upper
from torchfsid.outcome import Status
from torchfsid.tolerances import CLEARLY_EMPTY, MOST_ROUNDS, ROUND_OFF

FACING = 0.71
"""Cosine of the angle up to which a row can stand in for a side of the simplex that a search begins with."""

OK, EMPTY, UNSOLVED = int(Status.OK), int(Status.EMPTY), int(Status.UNSOLVED)


@item_in_place
@no_type_check
def excess(A, b, row, z):
    """The value a.z - b of one row."""
    over = -b[row]
    for j in range(len(z)):
        over += A[row, j] * z[j]
    return over


@item_in_place
@no_type_check
def most_violated(A, b, z):
    """The row with the largest a.z - b, and that value. Rows with an infinite bound are ignored."""
    worst, row = -np.inf, -1
    for j in range(len(b)):
        over = excess(A, b, j, z)
        if over > worst:
            worst, row = over, j
    return row, worst


@item
@no_type_check
def nearest_rows(A, b, sizes, epsilon, rows, Q, D, T, work, z):
    """The point z nearest to the origin, and its active rows.

    Args:
        A: (m, p), unit rows.
        b: (m,), infinite for rows to ignore.
        sizes: (m,), the size of the numbers that each b was computed from. Its round-off is ROUND_OFF times that.
        epsilon: the round-off of the arithmetic.
        rows: (p,), to be filled with the active rows.
        Q: (p, p), scratch.
        D: (p,), scratch.
        T: (p, p), scratch.
        work: (6, p), scratch.
        z: (p,), to be filled with the point.

    Returns:
        The number of active rows, and the status OK, EMPTY or UNSOLVED.
    """
    m, p = A.shape
    y, c, e, d, held, right = work[0], work[1], work[2], work[3], work[4], work[5]
    k, q, push = 0, -1, 0
    for _ in range(MOST_ROUNDS * (m + p)):
        for s in range(k):
            right[s] = b[rows[s]]
        on_rows(right, Q, D, T, k, y, z)
        fresh = q < 0
        if fresh:
            q, _ = most_violated(A, b, z)
            push = 0
            if q < 0:
                return k, OK
        # The entering row n = sum_s c_s a_s + d, pushed by `push` so far.
        for j in range(p):
            d[j] = A[q, j]
        slope = orthogonalise(d, Q, D, k, e)
        solve_upper(T, e, k, c)
        for j in range(p):
            z[j] -= push * d[j]
        for s in range(k):
            y[s] = -(y[s] + push * e[s])
        solve_upper(T, y, k, held)
        over = excess(A, b, q, z)

        size, coordinates, propagated = 0, 1, push * slope
        for j in range(p):
            size += abs(z[j])
        for s in range(k):
            coordinates += abs(c[s])
            propagated += abs(c[s]) * (size + sizes[rows[s]])
        noise = ROUND_OFF * (size + sizes[q]) + epsilon * propagated
        if fresh and over <= noise:
            return k, OK
        apart = slope > (epsilon * coordinates) ** 2
        full = max(over, 0) / slope if apart else np.inf
        short, slot = np.inf, -1
        for s in range(k):
            if c[s] > epsilon * coordinates and max(held[s], 0) < short * c[s]:
                short, slot = max(held[s], 0) / c[s], s
        if short < full:
            push += short
            k -= 1
            for s in range(slot, k):
                rows[s] = rows[s + 1]
                for j in range(p):
                    Q[s, j] = A[rows[s], j]
                D[s] = 1 / orthogonalise(Q[s], Q, D, s, T[s])
        elif apart:
            rows[k], D[k] = q, 1 / slope
            for j in range(p):
                Q[k, j] = d[j]
            for s in range(k):
                T[k, s] = e[s]
            k += 1
            q = -1
        elif over > noise and (epsilon == 0 or over > CLEARLY_EMPTY * noise):
            return k, EMPTY
        else:
            break
    return k, UNSOLVED


@cache
def simplex_around(p: int) -> np.ndarray:
    """Rows (a, 1) with the unit outward normals a of the p + 1 sides of a simplex."""
    normals = np.concatenate([-np.eye(p), np.full((1, p), p**-0.5)])
    return np.column_stack([normals, np.ones(p + 1)])


@item
@no_type_check
def facing_rows(A, b, simplex, basis):
    """Fill `basis`: for each side of the simplex the nearest row that faces the same way, or the side if none does."""
    m, n = A.shape
    for s in range(n):
        basis[s], nearest = m + s, np.inf
        for j in range(m):
            if b[j] < nearest:
                cosine = 0
                for i in range(n - 1):
                    cosine += A[j, i] * simplex[s, i]
                if cosine > FACING:
                    basis[s], nearest = j, b[j]


@item
@no_type_check
def inscribed_rows(A, b, simplex, epsilon, basis, M, V, work, able):
    """The largest ball w = (z, r), the rate `far` at which it grows with the simplex, and the rows that decide it.

    Args:
        A: (m, p + 1), the rows (a_j, 1), a_j of unit length.
        b: (m,), infinite for rows to ignore.
        simplex: (p + 1, p + 1), the rows of the simplex.
        epsilon: the round-off of the arithmetic.
        basis: (p + 1,), to be filled with the rows. Indices from m on stand for sides of the simplex.
        M: (p + 1, p + 1), scratch.
        V: (p + 1, p + 1), to be filled with the inverse of the rows (a, 1). Its last row holds the multipliers.
        work: (5, p + 1), to be filled with right, share, w, far and scratch.
        able: (p + 1,), scratch of booleans.

    Returns:
        Whether the search has ended.
    """
    m, n = A.shape
    right, share, w, far, noise = work[0], work[1], work[2], work[3], work[4]
    facing_rows(A, b, simplex, basis)
    for count in range(MOST_ROUNDS * (m + n)):
        is_open = False
        for s in range(n):
            row = A[basis[s]] if basis[s] < m else simplex[basis[s] - m]
            right[s] = b[basis[s]] if basis[s] < m else 0
            is_open |= basis[s] >= m
            for j in range(n):
                M[s, j] = row[j]
        regular, enclosed = invert(M, V), True
        for s in range(n):
            enclosed = enclosed and V[n - 1, s] > ROUND_OFF
        if count == 0 and not (regular and enclosed):  # these rows bound no ball: start from the simplex
            for s in range(n):
                basis[s] = m + s
            continue
        if not regular:
            return False
        for i in range(n):
            w[i], far[i] = 0, 0
            for s in range(n):
                w[i] += V[i, s] * right[s]
                if basis[s] >= m:
                    far[i] += V[i, s]
        for s in range(n):  # one correction, so that the rows of a sharp corner hold to round-off
            share[s] = right[s]
            for i in range(n):
                share[s] -= (A[basis[s], i] if basis[s] < m else simplex[basis[s] - m, i]) * w[i]
        for i in range(n):
            for s in range(n):
                w[i] += V[i, s] * share[s]
        q, worst = -1, -np.inf
        if is_open:  # infinitely violated rows come first, infinitely slack ones never
            reach, fastest = 0, 0
            for i in range(n):
                reach += abs(far[i])
            for j in range(m):
                if b[j] < np.inf:
                    rate = 0
                    for i in range(n):
                        rate += A[j, i] * far[i]
                    if rate > ROUND_OFF * reach and rate > fastest:
                        q, worst, fastest = j, np.inf, rate
                    elif fastest == 0 and rate >= -ROUND_OFF * reach:
                        over = excess(A, b, j, w)
                        if over > worst:
                            q, worst = j, over
        else:
            q, worst = most_violated(A, b, w)
        if q < 0:
            return True
        size, spread, propagated = 0, 0, 0
        for i in range(n):
            size += abs(w[i])
        for s in range(n):
            share[s], largest = 0, 0
            for j in range(n):
                part, entry = A[q, j] * V[j, s], abs(V[j, s])
                share[s] += part
                spread += abs(part)
                largest = entry if entry > largest else largest
            noise[s] = largest
            propagated += abs(share[s]) * (size + abs(right[s]))
        if worst <= ROUND_OFF * (size + abs(b[q])) + epsilon * propagated:
            return True
        for s in range(n):
            able[s] = share[s] > epsilon * spread * noise[s]
        slot = leaving(V, share, able, epsilon)
        if slot < 0:
            return False
        basis[slot] = q
    return False


@item
@no_type_check
def leaving(V, share, able, tie):
    """The place in the basis that leaves, among those that are `able` to; -1 if none is.

    It is the first whose multiplier reaches zero. Ties are broken by z_1, then by z_2, and so on, and last by the
    largest pivot.
    """
    n = len(share)
    for key in range(-1, n - 1):
        lowest, left, size = np.inf, 0, 0
        for s in range(n):
            size += abs(V[key, s])
            if able[s]:
                ratio = (V[key, s] if key < 0 else -V[key, s]) / share[s]
                lowest = ratio if ratio < lowest else lowest
        for s in range(n):
            if able[s]:
                beyond = (V[key, s] if key < 0 else -V[key, s]) - lowest * share[s]
                able[s] = beyond <= tie * size
                left += able[s]
        if left <= 1:
            break
    slot = -1
    for s in range(n):
        if able[s] and (slot < 0 or share[s] > share[slot]):
            slot = s
    return slot
