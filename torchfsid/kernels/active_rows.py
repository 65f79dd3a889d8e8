r"""The searches of `active_rows`, where they are explained, in scalar code, item by item, compiled by numba.

    Q, R        the active rows made orthonormal one by one, a_s = sum_i R_is Q_i; what a row has beyond them is free
    inverse     by Gauss and Jordan with row exchanges

`active_rows` is the reference; tests compare the two. Every tolerance is an argument: numba's cache of compiled code
does not see what changes in another file.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

compiled = njit(cache=True, error_model="numpy", nogil=True)  # no_type_check: these must stay plain functions


@compiled
@no_type_check
def _dot(v, w):
    total = 0.0
    for i in range(len(v)):
        total += v[i] * w[i]
    return total


@compiled
@no_type_check
def _beyond(v, Q, k, share):
    """Take from v what lies in the span of the first k rows of Q, twice, so that round-off is gone; share_i of Q_i."""
    share[:k] = 0.0
    for _ in range(2):
        for i in range(k):
            part = _dot(Q[i], v)
            share[i] += part
            for j in range(len(v)):
                v[j] -= part * Q[i, j]


@compiled
@no_type_check
def _back(R, right, k, x):
    """R x = right, R upper triangular."""
    for i in range(k - 1, -1, -1):
        x[i] = right[i]
        for j in range(i + 1, k):
            x[i] -= R[i, j] * x[j]
        x[i] /= R[i, i]


@compiled
@no_type_check
def _orthonormal(A, rows, k, Q, R):
    for s in range(k):
        for j in range(A.shape[1]):
            Q[s, j] = A[rows[s], j]
        _beyond(Q[s], Q, s, R[:, s])
        R[s, s] = math.sqrt(_dot(Q[s], Q[s]))
        for j in range(A.shape[1]):
            Q[s, j] /= R[s, s]


@compiled
@no_type_check
def _most_violated(A, b, z, rise):
    """The row with the largest a.z + rise - b; rows without a bound never."""
    worst, row = -np.inf, -1
    for j in range(len(b)):
        over = _dot(A[j], z) + rise - b[j]
        if over > worst:
            worst, row = over, j
    return row, worst


@compiled
@no_type_check
def nearest_rows(A, b, parallel, epsilon, most_rounds, point, rows, count, multipliers, empty):
    """Into the last five; b infinite for rows to ignore."""
    B, _, p = A.shape
    Q, R = np.zeros((p, p)), np.zeros((p, p))
    y, c, e, held, d, z = np.zeros(p), np.zeros(p), np.zeros(p), np.zeros(p), np.zeros(p), np.zeros(p)
    for item in range(B):
        own, k, q, push = rows[item], 0, -1, 0.0
        empty[item] = True
        for _ in range(most_rounds):
            _orthonormal(A[item], own, k, Q, R)
            z[:] = 0.0
            for i in range(k):
                y[i] = b[item, own[i]]
                for j in range(i):
                    y[i] -= R[j, i] * y[j]
                y[i] /= R[i, i]
                for j in range(p):
                    z[j] += y[i] * Q[i, j]
            fresh = q < 0
            if fresh:
                q, worst = _most_violated(A[item], b[item], z, 0.0)
                if q < 0 or (k == 0 and worst <= 0.0):
                    empty[item] = False
                    break
            n, bound = A[item, q], b[item, q]
            for j in range(p):
                d[j] = n[j]
            _beyond(d, Q, k, e)
            _back(R, e, k, c)
            for j in range(p):
                z[j] -= push * d[j]
            for i in range(k):
                y[i] = -(y[i] + push * e[i])
            _back(R, y, k, held)
            over, slope = _dot(n, z) - bound, _dot(d, d)

            size, noise, coordinates = 0.0, 0.0, math.sqrt(slope)
            for j in range(p):
                size += abs(z[j])
            for i in range(k):
                noise += abs(c[i]) * (size + abs(b[item, own[i]]))
                coordinates += abs(c[i])
            noise += coordinates * push * slope + size + abs(bound)
            if fresh and over <= epsilon * noise:
                empty[item] = False
                break
            apart = slope > (parallel + epsilon * coordinates) ** 2
            full = max(over, 0.0) / slope if apart else np.inf
            short, slot = np.inf, -1
            for i in range(k):
                if c[i] > epsilon and max(held[i], 0.0) / c[i] < short:
                    short, slot = max(held[i], 0.0) / c[i], i
            if short < full:
                k -= 1
                own[slot] = own[k]
                push += short
            elif apart:
                own[k] = q
                k += 1
                q, push = -1, 0.0
            else:
                break
        if not empty[item]:
            count[item] = k
            for j in range(p):
                point[item, j] = z[j]
            for i in range(k):
                multipliers[item, i] = max(held[i], 0.0)


@compiled
@no_type_check
def solve_active(N, filled, pull, offsets, z, mu):
    """`programmes.solve_active`, into the last two: z in the span of the rows from the offsets, beyond it from pull."""
    B, p = offsets.shape
    Q, R, y, e, d = np.zeros((p, p)), np.zeros((p, p)), np.zeros(p), np.zeros(p), np.zeros(p)
    order = np.arange(p)
    for item in range(B):
        k = 0
        while k < p and filled[item, k]:
            k += 1
        _orthonormal(N[item], order, k, Q, R)
        for j in range(p):
            d[j] = pull[item, j]
        _beyond(d, Q, k, e)
        for j in range(p):
            z[item, j] = d[j]
        for i in range(k):
            y[i] = offsets[item, i]
            for j in range(i):
                y[i] -= R[j, i] * y[j]
            y[i] /= R[i, i]
            e[i] -= y[i]
            for j in range(p):
                z[item, j] += y[i] * Q[i, j]
        _back(R, e, k, mu[item])


@compiled
@no_type_check
def _invert(M, V):
    """V = M^-1; M is lost."""
    k = len(M)
    V[:] = 0.0
    for i in range(k):
        V[i, i] = 1.0
    for i in range(k):
        pivot = i
        for r in range(i + 1, k):
            if abs(M[r, i]) > abs(M[pivot, i]):
                pivot = r
        for j in range(k):
            M[i, j], M[pivot, j] = M[pivot, j], M[i, j]
            V[i, j], V[pivot, j] = V[pivot, j], V[i, j]
        scale = 1.0 / M[i, i]
        for j in range(k):
            M[i, j] *= scale
            V[i, j] *= scale
        for r in range(k):
            if r != i and M[r, i] != 0.0:
                factor = M[r, i]
                for j in range(k):
                    M[r, j] -= factor * M[i, j]
                    V[r, j] -= factor * V[i, j]


@compiled
@no_type_check
def inscribed_rows(A, b, simplex, tie, epsilon, most_rounds, ball, rows, open_centre, open_radius):
    """Into the last four; b infinite for rows to ignore."""
    B, m, p = A.shape
    M, V = np.zeros((p + 1, p + 1)), np.zeros((p + 1, p + 1))
    right, share, w, far = np.zeros(p + 1), np.zeros(p + 1), np.zeros(p + 1), np.zeros(p + 1)
    able = np.zeros(p + 1, dtype=np.bool_)
    for item in range(B):
        basis = rows[item]
        for s in range(p + 1):
            basis[s] = m + s
        for _ in range(most_rounds):
            is_open = False
            for s in range(p + 1):
                row = A[item, basis[s]] if basis[s] < m else simplex[basis[s] - m]
                right[s] = b[item, basis[s]] if basis[s] < m else 0.0
                is_open |= basis[s] >= m
                for j in range(p):
                    M[s, j] = row[j]
                M[s, p] = 1.0
            _invert(M, V)
            for i in range(p + 1):
                w[i], far[i] = _dot(V[i], right), 0.0
                for s in range(p + 1):
                    if basis[s] >= m:
                        far[i] += V[i, s]
            q, worst, fastest = -1, -np.inf, tie
            if is_open:  # infinitely violated rows come first, infinitely slack ones never
                for j in range(m):
                    if b[item, j] < np.inf:
                        rate = _dot(A[item, j], far[:p]) + far[p]
                        if rate > fastest:
                            q, worst, fastest = j, np.inf, rate
                        elif rate >= -tie and fastest == tie:
                            over = _dot(A[item, j], w[:p]) + w[p] - b[item, j]
                            if over > worst:
                                q, worst = j, over
            else:
                q, worst = _most_violated(A[item], b[item], w[:p], w[p])
            if q < 0:
                break
            n, bound = A[item, q], b[item, q]
            size, noise = 0.0, 0.0
            for i in range(p + 1):
                size += abs(w[i])
            for s in range(p + 1):
                share[s] = V[p, s]
                for j in range(p):
                    share[s] += n[j] * V[j, s]
                noise += abs(share[s]) * (size + abs(right[s]))
            if worst <= epsilon * (noise + size + abs(bound)):
                break
            # The first to lose its multiplier leaves; among those the first to let z_1 grow, and so on.
            for s in range(p + 1):
                able[s] = share[s] > tie
            for key in range(-1, p):
                lowest = np.inf
                for s in range(p + 1):
                    if able[s]:
                        lowest = min(lowest, (V[p, s] if key < 0 else -V[key, s]) / share[s])
                left = 0
                for s in range(p + 1):
                    able[s] = able[s] and (V[p, s] if key < 0 else -V[key, s]) / share[s] <= lowest + tie
                    left += able[s]
                if left == 1:
                    break
            slot = -1
            for s in range(p + 1):
                if able[s] and (slot < 0 or share[s] > share[slot]):
                    slot = s
            basis[slot] = q
        for s in range(p + 1):  # what round-off left of the rows
            row = A[item, basis[s]] if basis[s] < m else simplex[basis[s] - m]
            right[s] -= _dot(row, w[:p]) + w[p]
        for i in range(p + 1):
            ball[item, i] = w[i] + _dot(V[i], right)
        for i in range(p):
            open_centre[item] |= abs(far[i]) > tie
        open_radius[item] = far[p] > tie
