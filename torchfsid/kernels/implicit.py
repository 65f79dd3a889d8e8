r"""Implicit differentiation of the two programmes: the active rows' linear system, and vector-Jacobian products.

    H z + N' mu = pull,   N z = offsets

The matrix of this system is symmetric. So the derivative of a solution and its adjoint solve the same system with
another right-hand side. For the inscribed ball, N is square with the rows (a_j, |a_j|), and there is no metric.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, launcher
from torchfsid.kernels.frame import cholesky, scale_of, unwhiten, whiten
from torchfsid.kernels.linear import solve_rows
from torchfsid.outcome import Status

OK = int(Status.OK)


@item
@no_type_check
def solve_given(N, k, pull, offsets, L, metric, rows, Q, D, T, work, z, mu):
    """Solve H z + N' mu = pull, N z = offsets for the first k rows of N, which may have any length.

    Args:
        N: (k or more, p), the rows.
        k: the number of rows that are used.
        pull: (p,), the right-hand side of stationarity.
        offsets: (k or more,), the bounds.
        L: (p, p), the Cholesky factor of H = L L'.
        metric: whether there is a metric; without one, H is the identity.
        rows: scratch.
        Q: scratch.
        D: scratch.
        T: scratch.
        work: scratch.
        z: (p,), to be filled.
        mu: (k or more,), to be filled.
    """
    right, given = work[3], work[4]
    for s in range(k):
        scale = scale_of(N, s)
        for j in range(len(z)):
            rows[s, j] = N[s, j] * scale
        right[s] = offsets[s] * scale
        if metric:
            whiten(L, rows[s])
    for j in range(len(z)):
        given[j] = pull[j]
    if metric:
        whiten(L, given)
    solve_rows(rows, k, given, right, Q, D, T, work, z, mu)
    if metric:
        unwhiten(L, z)
    for s in range(k):
        mu[s] *= scale_of(N, s)


@launcher
@no_type_check
def solve_active(N, filled, pull, offsets, H, z, mu):
    """Solve H z + N' mu = pull, N z = offsets for each item, with the rows of N that are `filled`, its first ones.

    H is (B, p, p), or (0, p, p) for the identity. The results z and mu are filled.
    """
    B, n, p = N.shape
    metric = len(H) > 0
    L, Q, T, rows = np.zeros((p, p)), np.zeros((n, p)), np.zeros((n, n)), np.zeros((n, p))
    D, work = np.zeros(n), np.zeros((6, max(n, p)))
    for i in range(B):
        k = 0
        while k < n and filled[i, k]:
            k += 1
        if metric and not cholesky(H[i], L):
            for j in range(p):
                z[i, j] = np.nan
        else:
            solve_given(N[i], k, pull[i], offsets[i], L, metric, rows, Q, D, T, work, z[i], mu[i])


@launcher
@no_type_check
def nearest_point_vjp(A, rows, filled, mu, z, status, grad_z, grad_mu, grad_A, grad_b, grad_y):
    """The vector-Jacobian products of the Euclidean nearest point.

    They are added to `grad_A`, `grad_b` and `grad_y`, which have to be zero before.
    """
    B, p = z.shape
    L, Q, T, N, scaled = np.zeros((p, p)), np.zeros((p, p)), np.zeros((p, p)), np.zeros((p, p)), np.zeros((p, p))
    D, work, u, v = np.zeros(p), np.zeros((6, p)), np.zeros(p), np.zeros(p)
    for i in range(B):
        if status[i] != OK:
            continue
        k = 0
        while k < p and filled[i, k]:
            for j in range(p):
                N[k, j] = A[i, rows[i, k], j]
            k += 1
        solve_given(N, k, grad_z[i], grad_mu[i], L, False, scaled, Q, D, T, work, u, v)
        for j in range(p):
            grad_y[i, j] = u[j]
        for s in range(k):
            grad_b[i, rows[i, s]] += v[s]
            for j in range(p):
                grad_A[i, rows[i, s], j] -= mu[i, s] * u[j] + v[s] * z[i, j]


@launcher
@no_type_check
def inscribed_ball_vjp(A, centre, radius, rows, simplex, grad_centre, grad_radius, grad_A, grad_b):
    """The vector-Jacobian products of the largest ball. They are added to `grad_A` and `grad_b`, zero before."""
    B, m, p = A.shape
    n = p + 1
    L, Q, T, N, scaled = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    D, work, nothing, v, u = np.zeros(n), np.zeros((6, n)), np.zeros(n), np.zeros(n), np.zeros(n)
    pull = np.zeros(n)
    for i in range(B):
        if not math.isfinite(radius[i]):
            continue
        has_centre = math.isfinite(centre[i, 0])
        for s in range(n):
            real = rows[i, s] < m
            scale, square = scale_of(A[i], rows[i, s]) if real else 1.0, 0.0
            for j in range(p):
                N[s, j] = A[i, rows[i, s], j] if real else simplex[rows[i, s] - m, j]
                square += (N[s, j] * scale) ** 2
            N[s, p] = math.sqrt(square) / scale
        for j in range(p):
            pull[j] = grad_centre[i, j] if has_centre else 0.0
        pull[p] = grad_radius[i]
        solve_given(N, n, pull, nothing, L, False, scaled, Q, D, T, work, u, v)
        for s in range(n):
            if rows[i, s] < m:
                grad_b[i, rows[i, s]] += v[s]
                for j in range(p):
                    at = centre[i, j] if has_centre else 0.0
                    grad_A[i, rows[i, s], j] -= v[s] * (at + radius[i] * (N[s, j] / N[s, p]))
