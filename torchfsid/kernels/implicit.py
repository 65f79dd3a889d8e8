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
        L: (p, p), the Cholesky factor of H = L L'; not read without a `metric`.
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


@item
@no_type_check
def solve_one(i, N, filled, pull, offsets, H, metric, scratch, z, mu):
    """Solve H z + N' mu = pull, N z = offsets for item i, with the n rows of N that are `filled`, its first ones.

    The results z and mu are filled, mu at these rows. H is not read without a `metric`, and z is NaN if H[i] is not
    positive definite.

    Scratch: L: (p, p), Q, rows: (n, p) each, T: (n, n), D: (n,), work: (6, max(n, p)).
    """
    L, Q, rows, T, D, work = scratch
    k = 0
    while k < N.shape[1] and filled[i, k]:
        k += 1
    if metric and not cholesky(H[i], L):
        for j in range(z.shape[1]):
            z[i, j] = np.nan
    else:
        solve_given(N[i], k, pull[i], offsets[i], L, metric, rows, Q, D, T, work, z[i], mu[i])


@launcher
@no_type_check
def solve_active(N, filled, pull, offsets, H, z, mu):
    """Solve H z + N' mu = pull, N z = offsets for each item, see `solve_one`.

    H is (B, p, p), or (0, p, p) for the identity.
    """
    B, n, p = N.shape
    L, Q, rows, T = np.zeros((p, p)), np.zeros((n, p)), np.zeros((n, p)), np.zeros((n, n))
    scratch = L, Q, rows, T, np.zeros(n), np.zeros((6, max(n, p)))
    for i in range(B):
        solve_one(i, N, filled, pull, offsets, H, len(H) > 0, scratch, z, mu)


@item
@no_type_check
def nearest_vjp_one(i, A, rows, filled, mu, z, status, grad_z, grad_mu, scratch, grad_A, grad_b, grad_y):
    """The vector-Jacobian products of the Euclidean nearest point of item i.

    They are added to `grad_A`, `grad_b` and `grad_y`, which have to be zero before.

    Scratch: Q, T, N, scaled: (p, p) each, D, u, v: (p,) each, work: (6, p).
    """
    if status[i] != OK:
        return
    Q, T, N, scaled, D, u, v, work = scratch
    p, k = z.shape[1], 0
    while k < p and filled[i, k]:
        for j in range(p):
            N[k, j] = A[i, rows[i, k], j]
        k += 1
    solve_given(N, k, grad_z[i], grad_mu[i], N, False, scaled, Q, D, T, work, u, v)
    for j in range(p):
        grad_y[i, j] = u[j]
    for s in range(k):
        grad_b[i, rows[i, s]] += v[s]
        for j in range(p):
            grad_A[i, rows[i, s], j] -= mu[i, s] * u[j] + v[s] * z[i, j]


@launcher
@no_type_check
def nearest_point_vjp(A, rows, filled, mu, z, status, grad_z, grad_mu, grad_A, grad_b, grad_y):
    """The vector-Jacobian products of the Euclidean nearest point of each item, see `nearest_vjp_one`."""
    B, p = z.shape
    Q, T, N, scaled = np.zeros((p, p)), np.zeros((p, p)), np.zeros((p, p)), np.zeros((p, p))
    scratch = Q, T, N, scaled, np.zeros(p), np.zeros(p), np.zeros(p), np.zeros((6, p))
    for i in range(B):
        nearest_vjp_one(i, A, rows, filled, mu, z, status, grad_z, grad_mu, scratch, grad_A, grad_b, grad_y)


@item
@no_type_check
def ball_vjp_one(i, A, centre, radius, rows, simplex, grad_centre, grad_radius, scratch, grad_A, grad_b):
    """The vector-Jacobian products of the largest ball of item i, n = p + 1.

    They are added to `grad_A` and `grad_b`, which have to be zero before.

    Scratch: Q, T, N, scaled: (n, n) each, D, u, v, pull, nothing: (n,) each, work: (6, n).
    """
    if not math.isfinite(radius[i]):
        return
    Q, T, N, scaled, D, u, v, pull, nothing, work = scratch
    m, p = A.shape[1], A.shape[2]
    has_centre = math.isfinite(centre[i, 0])
    for s in range(p + 1):
        real = rows[i, s] < m
        scale, square = scale_of(A[i], rows[i, s]) if real else 1.0, 0.0
        for j in range(p):
            N[s, j] = A[i, rows[i, s], j] if real else simplex[rows[i, s] - m, j]
            square += (N[s, j] * scale) ** 2
        N[s, p] = math.sqrt(square) / scale
        nothing[s] = 0.0
    for j in range(p):
        pull[j] = grad_centre[i, j] if has_centre else 0.0
    pull[p] = grad_radius[i]
    solve_given(N, p + 1, pull, nothing, N, False, scaled, Q, D, T, work, u, v)
    for s in range(p + 1):
        if rows[i, s] < m:
            grad_b[i, rows[i, s]] += v[s]
            for j in range(p):
                at = centre[i, j] if has_centre else 0.0
                grad_A[i, rows[i, s], j] -= v[s] * (at + radius[i] * (N[s, j] / N[s, p]))


@launcher
@no_type_check
def inscribed_ball_vjp(A, centre, radius, rows, simplex, grad_centre, grad_radius, grad_A, grad_b):
    """The vector-Jacobian products of the largest ball of each item, see `ball_vjp_one`."""
    n = A.shape[2] + 1
    Q, T, N, scaled = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    D, u, v, pull, nothing = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    scratch = Q, T, N, scaled, D, u, v, pull, nothing, np.zeros((6, n))
    for i in range(len(A)):
        ball_vjp_one(i, A, centre, radius, rows, simplex, grad_centre, grad_radius, scratch, grad_A, grad_b)
