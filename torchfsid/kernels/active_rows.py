r"""Which rows of A z <= b are active at the solution of two convex programmes: the searches, for one item each.

    nearest point     min 1/2 |z|^2   s.t.  a_j.z <= b_j              at most p active rows
    inscribed ball    max r           s.t.  a_j.z + r <= b_j          p + 1 active rows, w = (z, r)

The rows a_j are unit ones. Both are dual active-set methods: every iterate solves its own active rows exactly, and the
row that it violates most enters, until none is violated.

The nearest point is found after Goldfarb and Idnani (Math. Programming 27, 1983). The active rows are made orthogonal
one by one, a_s = Q_s + sum_i<s T_si Q_i. An entering row n is n = sum_s c_s a_s + d, d orthogonal to all of them.
Pushing it by t changes the multipliers by -t c and its violation by -t |d|^2. A multiplier that reaches zero first
leaves. If d = 0 and no multiplier can leave, then n - sum_s c_s a_s = 0 is a combination of rows with weights >= 0 whose
bounds contradict each other: the set is empty.

The inscribed ball is found by the dual simplex method with lexicographic ratios. They cannot cycle, and they make the
answer unique: of all centres, the one with the smallest z_1, among these the one with the smallest z_2, and so on. It
starts from a simplex around everything, infinitely far away: a number is then a finite part, and a rate at which it
grows with the distance of the simplex.

A pivot that round-off cannot tell from zero is never taken. `epsilon` is the round-off of the arithmetic: `ROUND_OFF`
for floating point; 0 for exact rationals, for which the same functions are called without being compiled
(`programmes.rational`). That is why there is no square root here, and why sums start from an integer.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item
from torchfsid.outcome import ProgrammeStatus
from torchfsid.tolerances import CLEARLY_EMPTY, MOST_ROUNDS, ROUND_OFF

OK, EMPTY, UNSOLVED = int(ProgrammeStatus.OK), int(ProgrammeStatus.EMPTY), int(ProgrammeStatus.UNSOLVED)


@item
@no_type_check
def dot(v, w):
    total = 0
    for i in range(len(v)):
        total += v[i] * w[i]
    return total


@item
@no_type_check
def orthogonalise(v, Q, D, k, share):
    """Take from v what lies in the span of the first k rows of Q: v loses share_i Q_i. D_i = 1 / |Q_i|^2.

    Twice, if little is left, so that what is left is orthogonal to round-off.

    Returns:
        |v|^2, of what is left.
    """
    square, left = 0, 0
    for j in range(len(v)):
        square += v[j] * v[j]
    for i in range(k):
        share[i] = 0
    for _ in range(2):
        for i in range(k):
            part = 0
            for j in range(len(v)):
                part += Q[i, j] * v[j]
            part *= D[i]
            share[i] += part
            for j in range(len(v)):
                v[j] -= part * Q[i, j]
        left = 0
        for j in range(len(v)):
            left += v[j] * v[j]
        if k == 0 or 4 * left > square:
            break
    return left


@item
@no_type_check
def solve_upper(T, right, k, x):
    """sum_s x_s a_s = sum_i right_i Q_i for the k rows a_s = Q_s + sum_i<s T_si Q_i."""
    for i in range(k - 1, -1, -1):
        x[i] = right[i]
        for j in range(i + 1, k):
            x[i] -= T[j, i] * x[j]


@item
@no_type_check
def on_rows(b, Q, D, T, k, y, z):
    """z = sum_i y_i Q_i with a_s.z = b_s for the k rows a_s = Q_s + sum_i<s T_si Q_i."""
    for j in range(len(z)):
        z[j] = 0
    for s in range(k):
        c = b[s]  # y_s |Q_s|^2
        for i in range(s):
            c -= T[s, i] * y[i]
        y[s] = c
    for s in range(k):
        y[s] *= D[s]
        for j in range(len(z)):
            z[j] += y[s] * Q[s, j]


@item
@no_type_check
def excess(A, b, row, z):
    """a.z - b of a row."""
    over = -b[row]
    for j in range(len(z)):
        over += A[row, j] * z[j]
    return over


@item
@no_type_check
def most_violated(A, b, z):
    """The row with the largest a.z - b; rows without a bound never."""
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
        sizes: (m,), the size of the numbers that each b was computed from: its round-off is ROUND_OFF times that.
        epsilon: the round-off of the arithmetic.
        rows: (p,), to be filled with the active rows.
        Q, T: (p, p), scratch.
        D: (p,), scratch.
        work: (6, p), scratch.
        z: (p,), to be filled with the point.

    Returns:
        How many rows are active, and OK, EMPTY or UNSOLVED.
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


@item
@no_type_check
def invert(M, V):
    """V = M^-1 by Gauss and Jordan with row exchanges; M is lost. Is M regular?"""
    k = len(M)
    for i in range(k):
        for j in range(k):
            V[i, j] = 1 if i == j else 0
    for i in range(k):
        pivot = i
        for r in range(i + 1, k):
            if abs(M[r, i]) > abs(M[pivot, i]):
                pivot = r
        if M[pivot, i] == 0:
            return False
        for j in range(k):
            M[i, j], M[pivot, j] = M[pivot, j], M[i, j]
            V[i, j], V[pivot, j] = V[pivot, j], V[i, j]
        scale = 1 / M[i, i]
        for j in range(k):
            M[i, j] *= scale
            V[i, j] *= scale
        for r in range(k):
            if r != i and M[r, i] != 0:
                factor = M[r, i]
                for j in range(k):
                    M[r, j] -= factor * M[i, j]
                    V[r, j] -= factor * V[i, j]
    return True


@item
@no_type_check
def inscribed_rows(A, b, simplex, epsilon, basis, M, V, work, able):
    """The largest ball, w = (z, r) and the rate `far` at which it grows with the simplex, and the rows that decide it.

    Args:
        A: (m, p + 1), the rows (a_j, 1), a_j of unit length.
        b: (m,), infinite for rows to ignore.
        simplex: (p + 1, p + 1), the rows of the simplex.
        epsilon: the round-off of the arithmetic.
        basis: (p + 1,), to be filled with the rows; m and above: sides of the simplex.
        M, V: (p + 1, p + 1), to be filled; V is the inverse of the rows (a, 1), its last row the multipliers.
        work: (5, p + 1), to be filled: right, share, w, far, scratch.
        able: (p + 1,), scratch of booleans.

    Returns:
        Did the search end?
    """
    m, n = A.shape
    right, share, w, far, noise = work[0], work[1], work[2], work[3], work[4]
    for s in range(n):
        basis[s] = m + s
    for _ in range(MOST_ROUNDS * (m + n)):
        is_open = False
        for s in range(n):
            row = A[basis[s]] if basis[s] < m else simplex[basis[s] - m]
            right[s] = b[basis[s]] if basis[s] < m else 0
            is_open |= basis[s] >= m
            for j in range(n):
                M[s, j] = row[j]
        if not invert(M, V):
            return False
        for i in range(n):
            w[i], far[i] = dot(V[i], right), 0
            if is_open:
                for s in range(n):
                    if basis[s] >= m:
                        far[i] += V[i, s]
        for s in range(n):  # one correction: the rows of a sharp corner hold to round-off then
            share[s] = right[s] - dot(A[basis[s]] if basis[s] < m else simplex[basis[s] - m], w)
        for i in range(n):
            w[i] += dot(V[i], share)
        q, worst = -1, -np.inf
        if is_open:  # infinitely violated rows come first, infinitely slack ones never
            reach, fastest = 0, 0
            for i in range(n):
                reach += abs(far[i])
            for j in range(m):
                if b[j] < np.inf:
                    rate = dot(A[j], far)
                    if rate > epsilon * reach and rate > fastest:
                        q, worst, fastest = j, np.inf, rate
                    elif fastest == 0 and rate >= -epsilon * reach:
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
    """The place in the basis that goes, among those `able` to: the first to lose its multiplier, among those the first
    to let z_1 grow, and so on, among those the largest pivot; -1: none is able to."""
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
