r"""One measurement of many robots in scalar code: slacks, KKT conditions and half-spaces, compiled by numba.

What `observer.read`, `kkt`, `critical_region` and `inverse_optimal` do in torch, one robot after the other; they are the
reference, tests compare the two. The active rows are solved as there: with V a rotation to the principal axes of the
unit active rows A_a, the columns of A_a V = [y z] are orthogonal up to round-off, w = z - y (y.z)/(y.y) has the length
of the second singular value, and

    A_a^+ b_a = V [c1, c2],    c2 = w.b/w.w,   c1 = (y.b - c2 y.z)/y.y        (rank 2; at rank 1 only y counts).

Every tolerance is an argument: numba's cache of compiled code does not see what changes in another file.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

compiled = njit(cache=True, error_model="numpy", nogil=True)  # no_type_check: these must stay plain functions

TURN = 2 * math.pi


@compiled
@no_type_check
def _solve_active(A, b, active, rank_tolerance, offset, projector):
    """A_a^+ b_a and A_a^+ A_a of the unit rows marked `active`; returns (K, rank)."""
    K, p, q, r = 0, 0.0, 0.0, 0.0
    for j in range(len(b)):
        if active[j]:
            K += 1
            p, q, r = p + A[j, 0] ** 2, q + A[j, 0] * A[j, 1], r + A[j, 1] ** 2
    if K == 0:
        return 0, 0
    turn = math.atan2(2 * q, p - r) / 2
    cos, sin = math.cos(turn), math.sin(turn)
    yy = yz = yb = ww = wb = v0 = v1 = 0.0
    for j in range(len(b)):
        if active[j]:
            y, z = cos * A[j, 0] + sin * A[j, 1], cos * A[j, 1] - sin * A[j, 0]
            yy, yz, yb = yy + y * y, yz + y * z, yb + y * b[j]
            v0, v1 = v0 + y * A[j, 0], v1 + y * A[j, 1]
    for j in range(len(b)):
        if active[j]:
            y, z = cos * A[j, 0] + sin * A[j, 1], cos * A[j, 1] - sin * A[j, 0]
            w = z - y * yz / yy
            ww, wb = ww + w * w, wb + w * b[j]
    if ww > rank_tolerance**2 * yy:
        second = wb / ww
        first = (yb - yz * second) / yy
        offset[0], offset[1] = cos * first - sin * second, sin * first + cos * second
        projector[0, 0] = projector[1, 1] = 1.0
        return K, 2
    length = math.sqrt(v0 * v0 + v1 * v1)
    v0, v1 = v0 / length, v1 / length
    yy = yb = 0.0
    for j in range(len(b)):
        if active[j]:
            y = A[j, 0] * v0 + A[j, 1] * v1
            yy, yb = yy + y * y, yb + y * b[j]
    offset[0], offset[1] = v0 * yb / yy, v1 * yb / yy
    projector[0, 0], projector[0, 1], projector[1, 0], projector[1, 1] = v0 * v0, v0 * v1, v0 * v1, v1 * v1
    return K, 1


@compiled
@no_type_check
def _outward_normals(angle, order, K, none, around, flat, normals, generator):
    """`kkt.outward_normals` of K generators given by their angles; returns how many normals there are.

    `order` names the generators (sorted here, with the angles), `none` stands for no generator, `around` is the fan of
    a full turn, `flat` the round-off of 180 degrees.
    """
    fan = len(around)
    if K == 0:
        for i in range(fan - 1):
            normals[i, 0], normals[i, 1], generator[i] = around[i, 0], around[i, 1], none
        return fan - 1
    for i in range(1, K):
        a, g, j = angle[i], order[i], i - 1
        while j >= 0 and angle[j] > a:
            angle[j + 1], order[j + 1] = angle[j], order[j]
            j -= 1
        angle[j + 1], order[j + 1] = a, g
    widest, second, gap, other = 0, 0, -np.inf, -np.inf
    for i in range(K):
        following = (angle[i + 1] if i < K - 1 else angle[0] + TURN) - angle[i]
        if following > gap:
            second, other = widest, gap
            widest, gap = i, following
        elif following > other:
            second, other = i, following
    opening, count = gap - math.pi, 0
    if opening >= -flat:
        end = widest + 1 if widest < K - 1 else 0
        for i in range(fan if opening > flat else 1):
            step = i / (fan - 1)
            direction = angle[widest] + math.pi / 2 + step * max(opening, 0.0)
            normals[count, 0], normals[count, 1] = math.cos(direction), math.sin(direction)
            generator[count] = order[widest if step < 0.5 else end]
            count += 1
    if other >= math.pi - flat:
        direction = angle[second] + math.pi / 2
        normals[count, 0], normals[count, 1], generator[count] = math.cos(direction), math.sin(direction), order[second]
        count += 1
    return count


@compiled
@no_type_check
def _critical_region(unit, bound, active, C, d, kkt, normals, generator, count, rank_tolerance, rows):
    """`critical_region`: the rows that say something."""
    G, f, P, offset = kkt
    row_A, row_b, row_source = rows
    m, R, least = len(bound), 0, rank_tolerance**2
    for j in range(m):
        p, q = unit[j, 0], unit[j, 1]
        across = (p - p * P[0, 0] - q * P[1, 0]) ** 2 + (q - p * P[0, 1] - q * P[1, 1]) ** 2
        if not active[j] and across > least:
            row_A[R, 0], row_A[R, 1] = p * G[0, 0] + q * G[1, 0], p * G[0, 1] + q * G[1, 1]
            row_b[R], row_source[R] = bound[j] - p * f[0] - q * f[1], j
            R += 1
    for i in range(count):
        n0, n1 = normals[i, 0], normals[i, 1]
        p, q = n0 * P[0, 0] + n1 * P[1, 0], n0 * P[0, 1] + n1 * P[1, 1]
        if p * p + q * q > least:
            row_A[R, 0], row_A[R, 1] = p * C[0, 0] + q * C[1, 0], p * C[0, 1] + q * C[1, 1]
            row_b[R], row_source[R] = n0 * offset[0] + n1 * offset[1] - p * d[0] - q * d[1], m + generator[i]
            R += 1


@compiled
@no_type_check
def _inverse_optimal(m, u, ball, C, d, normals, generator, count, none, rows):
    """`inverse_optimal_set`."""
    row_A, row_b, row_source = rows
    for i in range(count):
        p, q = normals[i, 0], normals[i, 1]
        row_A[i, 0], row_A[i, 1] = p * C[0, 0] + q * C[1, 0], p * C[0, 1] + q * C[1, 1]
        row_b[i] = p * (u[0] - d[0]) + q * (u[1] - d[1]) + ball
        row_source[i] = 2 * m if generator[i] == none else m + generator[i] % m


@compiled
@no_type_check
def read(
    A, b, hard, C, d, u, observed, bound, angles, ball, spread, around, paper, active_tolerance, epsilon,
    rank_tolerance, flat,
):  # fmt: skip
    """What a measurement of B robots says about theta, and their KKT conditions.

    `observed` marks the measurements that can be used at all. `bound` (B, m) is the slack of an active row, `ball` (B,)
    bounds the error of C theta + d - u.
    `angles` (B, m), errors of the rows' directions, turn each row by the fractions `spread`; (B, 0): there are none.
    `around` is the fan of a full turn, `paper` asks for the critical region.

    Returns half-spaces (A, b, source), padded; (informative, alarmed, slack, excess), as in `observer.Reading`; and
    (G, f, projector, free, offset, active, n_active, rank, case), as in `kkt.KktSolution`.
    """
    B, m = b.shape
    turned = angles.shape[1] > 0 and not paper
    generators = m * len(spread) if turned else m
    R = (m if paper else 0) + len(around) + 1
    row_A, row_b, row_source = np.zeros((B, R, 2)), np.ones((B, R)), np.full((B, R), -1)
    informative, alarmed = np.empty(B, np.bool_), np.empty(B, np.bool_)
    slack, excess = np.empty((B, m)), np.empty((B, m))
    G, f, projector, free = np.zeros((B, 2, 2)), np.zeros((B, 2)), np.zeros((B, 2, 2)), np.zeros((B, 2, 2))
    offset, active = np.zeros((B, 2)), np.empty((B, m), np.bool_)
    n_active, rank, case = np.empty(B, np.int64), np.empty(B, np.int64), np.empty(B, np.int64)
    unit, unit_b, near = np.zeros((m, 2)), np.empty(m), np.empty(m, np.bool_)
    angle, order = np.empty(generators), np.empty(generators, np.int64)
    normals, generator = np.empty((len(around) + 1, 2)), np.empty(len(around) + 1, np.int64)
    for k in range(B):
        usable, violated, broken = observed[k], False, False
        for j in range(m):
            p, q, c = A[k, j, 0], A[k, j, 1], b[k, j]
            if not (math.isfinite(p) and math.isfinite(q) and math.isfinite(c)):
                usable, p, q, c = False, 0.0, 0.0, 1.0
            is_row = p != 0 or q != 0
            norm = math.sqrt(p * p + q * q) if is_row else 1.0
            unit[j, 0], unit[j, 1], unit_b[j] = p / norm, q / norm, c / norm
            s = (c - (p * u[k, 0] + q * u[k, 1])) / norm
            room = bound[k, j] + epsilon * (abs(p * u[k, 0]) + abs(q * u[k, 1]) + abs(c)) / norm
            slack[k, j], excess[k, j] = s, -s - room
            active[k, j] = is_row and abs(s) < active_tolerance
            near[j] = is_row and s <= room
            violated = violated or s < 0
            broken = broken or (hard[j] and -s > room)
        usable = usable and not (u[k, 0] == 0 and u[k, 1] == 0 and violated)
        alarmed[k], informative[k] = usable and broken, usable and not broken

        n_active[k], rank[k] = _solve_active(unit, unit_b, active[k], rank_tolerance, offset[k], projector[k])
        K = n_active[k]
        case[k] = K if K < 2 else 2 if rank[k] < 2 else 3 if K == 2 else 4
        if rank[k] < 2:
            free[k, 0, 0], free[k, 1, 1] = 1 - projector[k, 0, 0], 1 - projector[k, 1, 1]
            free[k, 0, 1], free[k, 1, 0] = -projector[k, 0, 1], -projector[k, 1, 0]
        for i in range(2):
            f[k, i] = offset[k, i] + free[k, i, 0] * d[k, 0] + free[k, i, 1] * d[k, 1]
            for j in range(2):
                G[k, i, j] = free[k, i, 0] * C[k, 0, j] + free[k, i, 1] * C[k, 1, j]
        if not informative[k]:
            continue

        K = 0
        for turn in range(len(spread) if turned else 1):
            for j in range(m):
                if active[k, j] if paper else near[j]:
                    angle[K], order[K] = math.atan2(unit[j, 1], unit[j, 0]), turn * m + j
                    if turned:
                        angle[K] = (angle[K] + spread[turn] * angles[k, j] + math.pi) % TURN - math.pi
                    K += 1
        count = _outward_normals(angle, order, K, generators, around, flat, normals, generator)
        rows = row_A[k], row_b[k], row_source[k]
        if paper:
            kkt = G[k], f[k], projector[k], offset[k]
            _critical_region(unit, unit_b, active[k], C[k], d[k], kkt, normals, generator, count, rank_tolerance, rows)
        else:
            _inverse_optimal(m, u[k], ball[k], C[k], d[k], normals, generator, count, generators, rows)
    return (
        (row_A, row_b, row_source),
        (informative, alarmed, slack, excess),
        (G, f, projector, free, offset, active, n_active, rank, case),
    )
