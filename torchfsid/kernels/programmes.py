r"""Two convex programmes over half-spaces {z : A z <= b}, item by item.

    nearest point     min 1/2 (z - y)' H (z - y)   s.t.  A z <= b                 H z + N' mu = H y,  N z = b
    inscribed ball    max r                        s.t.  a_j.z + |a_j| r <= b_j   (a_j, |a_j|) w = b_j

N are the active rows. They are searched for (`active_rows`) in the frame of the point and the metric (`frame`). The
solution of the active rows is corrected once with the given rows, which removes the round-off of the frame. Then it is
verified: a_j.z <= b_j for all rows, equality for the active ones, mu >= 0, and stationarity. Each condition must hold
up to `VERIFIED` times the size of its terms. Otherwise the status is UNSOLVED, and `programmes.exact` solves the item
in rational arithmetic (`programmes.rational`).
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.active_rows import excess, inscribed_rows, nearest_rows
from torchfsid.kernels.compiled import item, item_in_place, launcher
from torchfsid.kernels.frame import cholesky, distance, from_frame, to_frame, unwhiten
from torchfsid.kernels.linear import dot, solve_rows
from torchfsid.outcome import Status
from torchfsid.tolerances import ROUND_OFF, VERIFIED

OK, EMPTY, UNBOUNDED = int(Status.OK), int(Status.EMPTY), int(Status.UNBOUNDED)
DEGENERATE, UNDEFINED = int(Status.DEGENERATE), int(Status.UNDEFINED)
UNSOLVED = int(Status.UNSOLVED)
IMPOSSIBLE, BOUNDLESS = -1, -2
"""EMPTY by a row 0.z <= b < 0, and UNBOUNDED for want of a largest ball: there is no finite radius."""


@item_in_place
@no_type_check
def finish_nearest(A, b, y, L, metric, unit, sizes, lengths, rows, k, Q, D, T, work, N, x, z, mu):
    """Fill the point z and the multipliers mu of the given rows, from the active rows and the point x in the frame.

    Both are verified.

    Returns:
        OK or UNSOLVED.
    """
    m, p = A.shape
    right, pull, correction = work[3], work[4], work[5]
    if metric:
        unwhiten(L, x)
    for j in range(p):
        z[j] = y[j] + x[j]
    for s in range(k):
        for j in range(p):
            N[s, j] = unit[rows[s], j]
        right[s] = -distance(A, b, rows[s], z, lengths)
    size = from_frame(L, metric, y, z, x)
    for j in range(p):
        pull[j] = -x[j]
    solve_rows(N, k, pull, right, Q, D, T, work, correction, mu)
    if metric:
        unwhiten(L, correction)
    for j in range(p):
        z[j] += correction[j]

    size = from_frame(L, metric, y, z, x)
    verified, total = True, size
    for s in range(k):
        mu[s] = max(mu[s], 0.0)
        total += mu[s]
    for j in range(p):
        left = x[j]
        for s in range(k):
            left += mu[s] * N[s, j]
        verified = verified and abs(left) <= VERIFIED * total
    for r in range(m):
        if lengths[r, 1] > 0.0 and not distance(A, b, r, z, lengths) <= VERIFIED * (size + sizes[r]):
            verified = False
    for s in range(k):
        r = rows[s]
        verified = verified and distance(A, b, r, z, lengths) >= -VERIFIED * (size + sizes[r])
    for s in range(k):
        mu[s] = mu[s] / lengths[rows[s], 1] * lengths[rows[s], 0]
    return OK if verified else UNSOLVED


@item
@no_type_check
def nearest_one(i, A, b, y, H, metric, frame, scratch, z, mu, rows, filled, status):
    """The nearest point of item i, in the metric H[i] if there is a `metric`.

    Args:
        i: the item.
        A: (B, m, p), the rows.
        b: (B, m), their bounds.
        y: (B, p), the points.
        H: (B, p, p), the metrics; not read without a `metric`.
        metric: whether there is a metric; without one it is the identity.
        frame: scratch for the rows in the frame: (m, p), (m,), (m,), (m, 2).
        scratch: L, Q, T, N: (p, p) each, D: (p,), work: (6, p), x: (p,).
        z: (B, p), filled with the point, NaN if there is none.
        mu: (B, p), filled with the multipliers.
        rows: (B, p), filled with the active rows.
        filled: (B, p), filled with a mask of the places in `rows` that hold one.
        status: (B,), filled with the status.
    """
    unit, offsets, sizes, lengths = frame
    L, Q, T, N, D, work, x = scratch
    state, k = OK, 0
    if metric and not cholesky(H[i], L):
        state = UNDEFINED
    else:
        state = to_frame(A[i], b[i], y[i], L, metric, unit, offsets, sizes, lengths)
    if state == OK:
        k, state = nearest_rows(unit, offsets, sizes, ROUND_OFF, rows[i], Q, D, T, work, x)
    if state == OK:
        state = finish_nearest(
            A[i], b[i], y[i], L, metric, unit, sizes, lengths, rows[i], k, Q, D, T, work, N, x, z[i], mu[i]
        )
    status[i] = state
    for s in range(z.shape[1]):
        filled[i, s] = state == OK and s < k
        if not filled[i, s]:
            mu[i, s], rows[i, s] = 0.0, 0
        if state != OK:
            z[i, s] = np.nan


@launcher
@no_type_check
def nearest_point(A, b, y, H, z, mu, rows, filled, status):
    """The nearest point of each item, see `nearest_one`. H is (B, p, p), or (0, p, p) for the identity."""
    B, m, p = A.shape
    frame = np.empty((m, p)), np.empty(m), np.empty(m), np.empty((m, 2))
    L, Q, T, N = np.zeros((p, p)), np.zeros((p, p)), np.zeros((p, p)), np.zeros((p, p))
    scratch = L, Q, T, N, np.zeros(p), np.zeros((6, p)), np.zeros(p)
    for i in range(B):
        nearest_one(i, A, b, y, H, len(H) > 0, frame, scratch, z, mu, rows, filled, status)


@item
@no_type_check
def has_multipliers(A, simplex, basis, V, least, N, Q, D, T, work):
    """Is (0, .., 0, 1) a combination with weights >= 0 of those rows of the basis whose multiplier is above `least`?

    The weights are computed anew. Those in V suffer from nearly parallel rows that do not matter here.
    """
    m, n = A.shape
    pull, offsets, left, mu, k = work[3], work[4], work[5], V[n - 1], 0
    for s in range(n):
        pull[s], offsets[s] = 1.0 if s == n - 1 else 0.0, 0.0
        if mu[s] > least:
            for j in range(n):
                N[k, j] = A[basis[s], j] if basis[s] < m else simplex[basis[s] - m, j]
            k += 1
    solve_rows(N, k, pull, offsets, Q, D, T, work, left, pull)
    found = True
    for j in range(n):
        found = found and abs(left[j]) <= VERIFIED and (j >= k or pull[j] >= -VERIFIED)
    return found


@item
@no_type_check
def finish_ball(A, b, simplex, basis, V, w, far, N, Q, D, T, work):
    """The verified status of the largest ball, given the rows that decide it, in the frame.

    Args:
        A: (m, p + 1), the rows (a_j, 1).
        b: (m,), their bounds.
        simplex: see `inscribed_rows`.
        basis: see `inscribed_rows`.
        V: see `inscribed_rows`.
        w: see `inscribed_rows`.
        far: see `inscribed_rows`.
        N: (p + 1, p + 1), scratch.
        Q: (p + 1, p + 1), scratch.
        D: (p + 1,), scratch.
        T: (p + 1, p + 1), scratch.
        work: (6, p + 1), scratch.
    """
    m, n = A.shape
    size, reach, largest, spread, is_open = 0.0, 0.0, 0.0, 0.0, False
    for i in range(n):
        for s in range(n):
            spread += abs(V[i, s])
        size += abs(w[i])
        reach += abs(far[i])
        is_open |= basis[i] >= m
        if basis[i] < m:
            largest = max(largest, abs(b[basis[i]]))
    open_radius = is_open and far[n - 1] > ROUND_OFF * reach

    balanced = True
    for j in range(n):
        left = -1.0 if j == n - 1 else 0.0
        for s in range(n):
            left += V[n - 1, s] * (A[basis[s], j] if basis[s] < m else simplex[basis[s] - m, j])
        balanced = balanced and abs(left) <= VERIFIED and V[n - 1, j] >= -VERIFIED
    if not (balanced or has_multipliers(A, simplex, basis, V, ROUND_OFF * spread, N, Q, D, T, work)):
        return UNSOLVED
    for j in range(m):
        if b[j] < np.inf:
            rate = dot(A[j], far) if is_open else 0.0
            if not rate <= VERIFIED * reach:
                return UNSOLVED
            over = excess(A, b, j, w)
            if not (open_radius or rate < -VERIFIED * reach or over <= VERIFIED * (size + abs(b[j]))):
                return UNSOLVED
    for s in range(n):
        r = basis[s]
        if r < m and not excess(A, b, r, w) >= -VERIFIED * (size + abs(b[r])):
            return UNSOLVED
    if open_radius:
        return BOUNDLESS
    if abs(w[n - 1]) <= ROUND_OFF * (size + largest):
        return DEGENERATE
    if w[n - 1] < 0.0:
        return EMPTY
    return UNBOUNDED if is_open else OK


@item
@no_type_check
def write_ball(w, m, status, centre, rows):
    """Fill the centre and the rows. The centre is NaN if there is none. No row is real if none decides the radius.

    Returns:
        The radius, and the public status.
    """
    p, radius, is_open = len(centre), w[len(centre)], False
    for s in range(p + 1):
        is_open |= rows[s] >= m
    if status in (UNDEFINED, UNSOLVED):
        radius = np.nan
    elif status == IMPOSSIBLE:
        radius = -np.inf
    elif status == BOUNDLESS:
        radius = np.inf
    for j in range(p):
        centre[j] = w[j] if math.isfinite(radius) and not is_open else np.nan
    if not math.isfinite(radius):
        for s in range(p + 1):
            rows[s] = m + s
    if status in (IMPOSSIBLE, BOUNDLESS):
        status = EMPTY if status == IMPOSSIBLE else UNBOUNDED
    return radius, status


@item
@no_type_check
def ball_one(i, A, b, simplex, frame, scratch, centre, radius, rows, status):
    """The largest ball of item i, n = p + 1.

    Args:
        i: the item.
        A: (B, m, p), the rows.
        b: (B, m), their bounds.
        simplex: (n, n), see `inscribed_rows`.
        frame: scratch for the rows in the frame: (m, n), (m,), (m,), (m, 2).
        scratch: M, V, Q, T: (n, n) each, D: (n,), search: (5, n), work: (6, n), able: (n,) of booleans.
        centre: (B, p), filled with the centre.
        radius: (B,), filled with the radius.
        rows: (B, n), filled with the rows that decide them.
        status: (B,), filled with the status.
    """
    unit, offsets, sizes, lengths = frame
    M, V, Q, T, D, search, work, able = scratch
    m, p = A.shape[1], A.shape[2]
    origin, w, far = work[0], search[2], search[3]
    for j in range(p + 1):
        origin[j] = 0.0
    for r in range(m):
        unit[r, p] = 1.0
    state = to_frame(A[i], b[i], origin[:p], M, False, unit[:, :p], offsets, sizes, lengths)
    if state == EMPTY:
        state = IMPOSSIBLE
    elif state == OK:
        state = UNSOLVED
        if inscribed_rows(unit, offsets, simplex, ROUND_OFF, rows[i], M, V, search, able):
            state = finish_ball(unit, offsets, simplex, rows[i], V, w, far, M, Q, D, T, work)
    radius[i], status[i] = write_ball(w, m, state, centre[i], rows[i])


@launcher
@no_type_check
def inscribed_ball(A, b, simplex, centre, radius, rows, status):
    """The largest ball of each item, see `ball_one`."""
    B, m, p = A.shape
    n = p + 1
    frame = np.empty((m, n)), np.empty(m), np.empty(m), np.empty((m, 2))
    M, V, Q, T = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    scratch = M, V, Q, T, np.zeros(n), np.zeros((5, n)), np.zeros((6, n)), np.zeros(n, np.bool_)
    for i in range(B):
        ball_one(i, A, b, simplex, frame, scratch, centre, radius, rows, status)
