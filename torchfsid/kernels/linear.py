r"""Small linear systems in scalar code: rows made orthogonal one by one, and inverses.

The rows a_s are written as a_s = Q_s + sum_i<s T_si Q_i, with orthogonal Q_i and D_i = 1 / |Q_i|^2. There is no square
root, and sums start from an integer: called as plain Python, the functions compute with exact rationals as well.
"""

from __future__ import annotations

from typing import no_type_check

from torchfsid.kernels.compiled import item
from torchfsid.tolerances import ROUND_OFF


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
def solve_rows(N, k, pull, offsets, Q, D, T, work, z, mu):
    """z + N' mu = pull, N z = offsets for the first k rows of N: in the span of the rows z follows from the offsets,
    beyond it from the pull. A row that depends on those before it counts for nothing."""
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
