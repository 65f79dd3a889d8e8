r"""A Kalman filter on [x; theta] for many robots, one robot after the other through many samples.

    x(t + dt) = x(t) + dt (G theta + f) + w_x,   theta(t + dt) = theta(t) + w_theta,   z = x + v

The unscented transform of a linear function is exact. So this is the unscented filter of `observers.ukf` in fewer
operations, while it works: where a covariance is no longer definite or a number not finite, the filter stops.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, launcher
from torchfsid.outcome import Status

OK, PREDICTED = int(Status.OK), int(Status.PREDICTED)


@item
@no_type_check
def factor(M, n, L):
    """Fill the lower triangle of L with the Cholesky factor of the n x n block of M. Returns whether it exists."""
    for i in range(n):
        for j in range(i + 1):
            rest = M[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = rest / L[j, j]
            elif rest > 0 and math.isfinite(rest):
                L[i, i] = math.sqrt(rest)
            else:
                return False
    return True


@item
@no_type_check
def predict(x, P, n, dt, G, f, walk, drift, mean, M, L):
    """Fill mean and M with the predicted mean and covariance. Returns whether M is definite."""
    N = len(x)
    for i in range(N):
        mean[i] = x[i]
        for j in range(N):
            M[i, j] = P[i, j]
    for i in range(n):
        rate = f[i]
        for k in range(N - n):
            rate += G[i, k] * x[n + k]
        mean[i] += dt * rate
    for i in range(n):  # M = P F', then M = F M
        for j in range(N):
            for k in range(N - n):
                M[j, i] += dt * G[i, k] * P[j, n + k]
    for j in range(N):
        for i in range(n):
            for k in range(N - n):
                M[i, j] += dt * G[i, k] * M[n + k, j]
    for i in range(N):
        M[i, i] += walk if i < n else drift[i - n]
    return factor(M, N, L)


@item
@no_type_check
def correct(z, n, noise, mean, M, L, gain, before, error):
    """Correct mean and M by the position z, whose variance is `noise`. Returns whether M is definite and mean finite.

    `gain` = M[:, :n] (M[:n, :n] + noise)^-1. `before` (n, N) and `error` (n,) are workspace.
    """
    N = len(mean)
    for i in range(n):
        error[i] = z[i] - mean[i]
        for j in range(N):
            before[i, j] = M[i, j]
        M[i, i] += noise
    if not factor(M, n, L):
        return False
    for r in range(N):  # L L' gain[r] = before[:, r]
        for i in range(n):
            rest = before[i, r]
            for k in range(i):
                rest -= L[i, k] * gain[r, k]
            gain[r, i] = rest / L[i, i]
        for i in range(n - 1, -1, -1):
            rest = gain[r, i]
            for k in range(i + 1, n):
                rest -= L[k, i] * gain[r, k]
            gain[r, i] = rest / L[i, i]
    known = True
    for i in range(n):
        M[i, i] = before[i, i]
    for r in range(N):
        for i in range(n):
            mean[r] += gain[r, i] * error[i]
        known = known and math.isfinite(mean[r])
        for c in range(r + 1):
            for i in range(n):
                M[r, c] -= gain[r, i] * before[i, c]
            M[c, r] = M[r, c]
    return known and factor(M, N, L)


@launcher
@no_type_check
def advance(
    start, running, x, P, theta, covariance, dt, z, seen, moved, goes_on, G, f, noise, walk, drift,
    thetas, covariances, status,
):  # fmt: skip
    """Bring the filters of B robots through S samples. All state is changed in place.

    Args:
        start: (B,), the first sample of each robot.
        running: (B,), whether its position is known. Otherwise it starts again at the next measured one.
        x: (B, N), means of [x; theta] where it runs.
        P: (B, N, N), their covariances.
        theta: (B, p), means of theta.
        covariance: (B, p, p), their covariances.
        dt: (S,), the times since the sample before [s].
        z: (S, B, n), measured positions.
        seen: (S, B), where there are any.
        moved: (S, B), whether (G, f) up to this sample is known.
        goes_on: (S, B), whether (G, f) from this sample on is known.
        G: (S, B, n, p), of the motion up to this sample.
        f: (S, B, n), of the motion up to this sample.
        noise: variance of a measured position.
        walk: (S,), variances of w_x.
        drift: (S, B, p), variances of w_theta.
        thetas: (S, B, p), to be filled with theta after each sample.
        covariances: (S, B, p, p), to be filled with its covariance.
        status: (S, B), to be filled with a `Status`.

    Returns:
        The sample at which each robot's filter failed, S if none. Its state is then that before the sample.
    """
    (S, B, n), p = z.shape, theta.shape[1]
    N = n + p
    mean, M, L = np.empty(N), np.empty((N, N)), np.empty((N, N))
    gain, before, error = np.empty((N, n)), np.empty((n, N)), np.empty(n)
    stop = np.full(B, S)
    for k in range(B):
        for s in range(start[k], S):
            if running[k] and moved[s, k] and seen[s, k]:
                works = s > start[k] or factor(P[k], N, L)  # later ones have been found to be definite
                works = works and predict(x[k], P[k], n, dt[s], G[s, k], f[s, k], walk[s], drift[s, k], mean, M, L)
                if not (works and correct(z[s, k], n, noise, mean, M, L, gain, before, error)):
                    stop[k] = s
                    break
                x[k], P[k] = mean, M
                theta[k], covariance[k] = mean[n:], M[n:, n:]
                status[s, k] = OK
            else:
                if dt[s] > 0:
                    for i in range(p):
                        covariance[k, i, i] += drift[s, k, i]
                if seen[s, k]:
                    x[k, :n], x[k, n:] = z[s, k], theta[k]
                    P[k] = 0.0
                    P[k, n:, n:] = covariance[k]
                    for i in range(n):
                        P[k, i, i] = noise
                running[k], status[s, k] = seen[s, k], PREDICTED
            running[k] = running[k] and goes_on[s, k]
            thetas[s, k], covariances[s, k] = theta[k], covariance[k]
    return stop
