r"""Small linear systems in scalar code: orthogonalisation row by row, and inverses.

The rows a_s are written as a_s = Q_s + sum_i<s T_si Q_i, with orthogonal Q_i and D_i = 1 / |Q_i|^2. The functions take
no square root, and their sums start from an integer. So they also compute with exact rationals, called uncompiled.
"""

from __future__ import annotations

from typing import no_type_check

from torchfsid.kernels.compiled import item, item_in_place
from torchfsid.tolerances import ROUND_OFF


@item_in_place
@no_type_check
def dot(v, w):
    total = 0
    for i in range(len(v)):
        total += v[i] * w[i]
    return total


@item_in_place
@no_type_check
def orthogonalise(v, Q, D, k, share):
    """Subtract from v its component in the span of the first k rows of Q, the sum of share_i Q_i.

    It is done twice if little is left, so that the remainder is orthogonal to round-off.

    Returns:
        |v|^2 of the remainder.
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


@item_in_place
@no_type_check
def solve_upper(T, right, k, x):
    """Solve sum_s x_s a_s = sum_i right_i Q_i for x, with the k rows a_s = Q_s + sum_i<s T_si Q_i."""
    for i in range(k - 1, -1, -1):
        x[i] = right[i]
        for j in range(i + 1, k):
            x[i] -= T[j, i] * x[j]


@item_in_place
@no_type_check
def on_rows(b, Q, D, T, k, y, z):
    """Find z = sum_i y_i Q_i with a_s.z = b_s for the k rows a_s = Q_s + sum_i<s T_si Q_i."""
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


@item_in_place
@no_type_check
def solve_rows(N, k, pull, offsets, Q, D, T, work, z, mu):
    """Solve z + N' mu = pull, N z = offsets for the first k rows of N.

    In the span of the rows, z follows from the offsets. Orthogonal to it, z follows from the pull. A row that depends
    linearly on earlier ones is ignored.
    """
    p = len(z)
    y, e, d = work[0], work[1], work[2]
    for s in range(k):
        for j in range(p):
            Q[s, j] = N[s, j]
        square = orthogonalise(Q[s], Q, D, s, T[s])
        D[s] = 1.0 / square if square > ROUND_OFF**2 * dot(N[s], N[s]) else 0.0
    on_rows(offsets, Q, D, T, k, y, z)
    for j in range(p):
        d[j] = pull[j]
    orthogonalise(d, Q, D, k, e)
    for s in range(k):
        e[s] -= y[s]
    for j in range(p):
        z[j] += d[j]
    solve_upper(T, e, k, mu)


@item
@no_type_check
def invert(M, V):
    """Fill V = M^-1 by Gauss-Jordan elimination with row exchanges. M is overwritten. Returns whether M is regular."""
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
