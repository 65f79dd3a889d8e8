r"""Two convex programmes over half-spaces {z : A z <= b}, item by item, and their vector-Jacobian products.

    nearest point     min 1/2 (z - y)' H (z - y)   s.t.  A z <= b                 H z + N' mu = H y,  N z = b
    inscribed ball    max r                        s.t.  a_j.z + |a_j| r <= b_j   (a_j, |a_j|) w = b_j

N are the active rows. They are searched for (`active_rows`) in a frame in which the rows are unit ones, the point is the
origin and the metric H = L L' is the identity: x = L'(z - y). The solution of the active rows is then corrected once with
the given rows, which removes the round-off of the frame, and verified: a_j.z <= b_j for all rows, equality for the active
ones, mu >= 0, and stationarity, each up to `VERIFIED` times the sizes of the numbers that meet there. What fails has the
status UNSOLVED; `programmes.exact` then asks `programmes.rational`.

Rows are scaled by powers of two before anything is squared, so that rows of any length are right.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.active_rows import dot, excess, inscribed_rows, nearest_rows, on_rows, orthogonalise, solve_upper
from torchfsid.kernels.compiled import item, launcher
from torchfsid.outcome import ProgrammeStatus
from torchfsid.tolerances import ROUND_OFF, VERIFIED

OK, EMPTY, UNBOUNDED = int(ProgrammeStatus.OK), int(ProgrammeStatus.EMPTY), int(ProgrammeStatus.UNBOUNDED)
DEGENERATE, UNDEFINED = int(ProgrammeStatus.DEGENERATE), int(ProgrammeStatus.UNDEFINED)
UNSOLVED = int(ProgrammeStatus.UNSOLVED)
SHORT, LONG = 1e-100, 1e100
IMPOSSIBLE, BOUNDLESS = -1, -2  # EMPTY by a row 0.z <= b < 0, and UNBOUNDED for want of a largest ball: no finite radius


@item
@no_type_check
def scale_of(A, row):
    """1 for ordinary rows; for rows so long or short that their squares leave the floating-point numbers, the power of
    two by which they are multiplied before (exactly)."""
    largest = 0.0
    for j in range(A.shape[1]):
        largest = max(largest, abs(A[row, j]))
    if SHORT < largest < LONG or largest == 0.0 or not largest < np.inf:
        return 1.0
    _, exponent = math.frexp(largest)
    return math.ldexp(1.0, min(1 - exponent, 1023))


@item
@no_type_check
def cholesky(H, L):
    """H = L L'. Is H symmetric and positive definite?"""
    p = len(H)
    for j in range(p):
        for i in range(p):
            if not (math.isfinite(H[i, j]) and H[i, j] == H[j, i]):
                return False
            L[i, j] = 0.0
    for j in range(p):
        square = H[j, j]
        for k in range(j):
            square -= L[j, k] ** 2
        if not square > 0.0:
            return False
        L[j, j] = math.sqrt(square)
        for i in range(j + 1, p):
            total = H[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total / L[j, j]
    return True


@item
@no_type_check
def whiten(L, v):
    """v becomes L^-1 v."""
    for i in range(len(v)):
        for j in range(i):
            v[i] -= L[i, j] * v[j]
        v[i] /= L[i, i]


@item
@no_type_check
def unwhiten(L, x):
    """x becomes L'^-1 x."""
    for i in range(len(x) - 1, -1, -1):
        for j in range(i + 1, len(x)):
            x[i] -= L[j, i] * x[j]
        x[i] /= L[i, i]


@item
@no_type_check
def to_frame(A, b, y, L, metric, unit, offsets, sizes, lengths):
    """The rows in the frame of the point y and the metric L L' (`metric`: is there one?).

    Args:
        unit: (m, p), to be filled with unit rows, 0 for zero rows.
        offsets: (m,), to be filled with bounds, infinite for zero rows.
        sizes: (m,), to be filled with the sizes of the numbers behind the offsets.
        lengths: (m, 2), to be filled: a row's power of two, and what is left of its length in the frame.

    Returns:
        UNDEFINED if a number is not finite, EMPTY if a row 0.z <= b has b < 0, else OK.
    """
    m, p = A.shape
    status = OK
    for j in range(p):
        if not math.isfinite(y[j]):
            status = UNDEFINED
    for r in range(m):
        scale = scale_of(A, r)
        offset, square, finite = b[r] * scale, 0.0, math.isfinite(b[r])
        size = abs(offset)
        for j in range(p):
            part = A[r, j] * scale
            unit[r, j] = part
            offset -= part * y[j]
            size += abs(part * y[j])
            square += part * part
        if metric:
            whiten(L, unit[r])
            square = dot(unit[r], unit[r])
        lengths[r, 0], lengths[r, 1] = scale, math.sqrt(square)
        if not (finite and square < np.inf):
            status, square = UNDEFINED, 0.0
        elif square == 0.0 and b[r] < 0.0 and status == OK:
            status = EMPTY
        inverse = 1.0 / lengths[r, 1] if square > 0.0 else 0.0
        offsets[r] = offset * inverse if square > 0.0 else np.inf
        sizes[r] = size * inverse
        for j in range(p):
            unit[r, j] *= inverse
    return status


@item
@no_type_check
def distance(A, b, row, z, lengths):
    """(a.z - b) / |a| of a row, with the lengths as `to_frame` gives them."""
    scale = lengths[row, 0]
    over = -b[row] * scale
    for j in range(len(z)):
        over += A[row, j] * scale * z[j]
    return over / lengths[row, 1]


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
def finish_nearest(A, b, y, L, metric, unit, sizes, lengths, rows, k, Q, D, T, work, N, x, z, mu):
    """From the active rows and the point x in the frame: the point z, the multipliers mu of the given rows, verified.

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
def from_frame(L, metric, y, z, x):
    """x = L'(z - y). Returns the size of the numbers that it was computed from."""
    size = 0.0
    for i in range(len(x)):
        x[i] = z[i] - y[i]
        size += abs(z[i]) + abs(y[i])
    if metric:
        size = 0.0
        for i in range(len(x)):
            total = 0.0
            for j in range(i, len(x)):
                total += L[j, i] * x[j]
                size += abs(L[j, i]) * (abs(z[j]) + abs(y[j]))
            x[i] = total
    return size


@launcher
@no_type_check
def nearest_point(A, b, y, H, z, mu, rows, filled, status):
    """Fills the last five. H: (B, p, p), or (0, p, p) for the identity."""
    B, m, p = A.shape
    metric = len(H) > 0
    unit, offsets, sizes, lengths = np.empty((m, p)), np.empty(m), np.empty(m), np.empty((m, 2))
    L, Q, T, N = np.zeros((p, p)), np.zeros((p, p)), np.zeros((p, p)), np.zeros((p, p))
    D, work, x = np.zeros(p), np.zeros((6, p)), np.zeros(p)
    for i in range(B):
        state = OK
        if metric and not cholesky(H[i], L):
            state = UNDEFINED
        else:
            state = to_frame(A[i], b[i], y[i], L, metric, unit, offsets, sizes, lengths)
        k = 0
        if state == OK:
            k, state = nearest_rows(unit, offsets, sizes, ROUND_OFF, rows[i], Q, D, T, work, x)
        if state == OK:
            state = finish_nearest(
                A[i], b[i], y[i], L, metric, unit, sizes, lengths, rows[i], k, Q, D, T, work, N, x, z[i], mu[i]
            )
        status[i] = state
        for s in range(p):
            filled[i, s] = state == OK and s < k
            if not filled[i, s]:
                mu[i, s], rows[i, s] = 0.0, 0
            if state != OK:
                z[i, s] = np.nan


@item
@no_type_check
def has_multipliers(A, simplex, basis, V, least, N, Q, D, T, work):
    """Is (0, .., 0, 1) a combination with weights >= 0 of those rows of the basis whose multiplier is above `least`?"""
    m, n = A.shape
    pull, offsets, left, mu, k = work[3], work[4], work[5], V[n - 1], 0
    for s in range(n):
        pull[s], offsets[s] = 1.0 if s == n - 1 else 0.0, 0.0
        if mu[s] > least or least == 0.0:
            for j in range(n):
                N[k, j] = A[basis[s], j] if basis[s] < m else simplex[basis[s] - m, j]
            k += 1
    solve_rows(N, k, pull, offsets, Q, D, T, work, left, pull)
    for j in range(n):
        if not (abs(left[j]) <= VERIFIED and (j >= k or pull[j] >= -VERIFIED)):
            return False
    return True


@item
@no_type_check
def finish_ball(A, b, simplex, basis, V, w, far, N, Q, D, T, work):
    """From the rows that decide the largest ball, in the frame, to its status, verified.

    Args:
        A: (m, p + 1), the rows (a_j, 1).
        b: (m,), their bounds.
        simplex, basis, V, w, far: see `inscribed_rows`.
        N, Q, T: (p + 1, p + 1), scratch.
        D: (p + 1,), scratch.
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

    if not (
        has_multipliers(A, simplex, basis, V, 0.0, N, Q, D, T, work)
        or has_multipliers(A, simplex, basis, V, ROUND_OFF * spread, N, Q, D, T, work)
    ):
        return UNSOLVED
    for j in range(m):
        if b[j] < np.inf:
            rate = dot(A[j], far) if is_open else 0.0
            if not rate <= VERIFIED * reach:
                return UNSOLVED
            if not open_radius and rate >= -VERIFIED * reach:
                if not excess(A, b, j, w) <= VERIFIED * (size + abs(b[j])):
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
    """The centre, NaN if there is none, and the rows, none of them real if the radius does not follow from any.

    Returns:
        The radius, and the status without its private values.
    """
    p, radius, is_open = len(centre), w[len(centre)], False
    for s in range(p + 1):
        is_open |= rows[s] >= m
    if status == UNDEFINED or status == UNSOLVED:
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
    if status == IMPOSSIBLE or status == BOUNDLESS:
        status = EMPTY if status == IMPOSSIBLE else UNBOUNDED
    return radius, status


@launcher
@no_type_check
def inscribed_ball(A, b, simplex, centre, radius, rows, status):
    """Fills the last four."""
    B, m, p = A.shape
    unit, offsets, sizes, lengths = np.ones((m, p + 1)), np.empty(m), np.empty(m), np.empty((m, 2))
    M, V, work, able = np.zeros((p + 1, p + 1)), np.zeros((p + 1, p + 1)), np.zeros((5, p + 1)), np.zeros(p + 1, np.bool_)
    origin, L = np.zeros(p), np.zeros((p, p))
    Q, D, T, scratch = np.zeros((p + 1, p + 1)), np.zeros(p + 1), np.zeros((p + 1, p + 1)), np.zeros((6, p + 1))
    w, far = work[2], work[3]
    for i in range(B):
        state = to_frame(A[i], b[i], origin, L, False, unit[:, :p], offsets, sizes, lengths)
        if state == EMPTY:
            state = IMPOSSIBLE
        elif state == OK:
            state = UNSOLVED
            if inscribed_rows(unit, offsets, simplex, ROUND_OFF, rows[i], M, V, work, able):
                state = finish_ball(unit, offsets, simplex, rows[i], V, w, far, M, Q, D, T, scratch)
        radius[i], status[i] = write_ball(w, m, state, centre[i], rows[i])


@item
@no_type_check
def solve_given(N, k, pull, offsets, L, metric, rows, Q, D, T, work, z, mu):
    """H z + N' mu = pull, N z = offsets, for the first k rows of N, of any length: fills the last two. Scratch before."""
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
    """H z + N' mu = pull, N z = offsets, for the first rows of N, `filled`: fills the last two.
    H: (B, p, p), or (0, p, p) for the identity."""
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
    """The vector-Jacobian products of the nearest point in the metric I: fills the last three, which are zero before."""
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
    """The vector-Jacobian products of the largest ball: fills the last two, which are zero before."""
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
