r"""One measurement of many robots in scalar code: slacks, KKT conditions and half-spaces, compiled by numba.

What `reading`, `kkt`, `critical_region` and `inverse_optimal` do in torch, one robot after the other; they are the
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
def _solve_active(k, A, b, active, rank_tolerance, offset, projector):
    """A_a^+ b_a and A_a^+ A_a of the unit rows marked `active[k]`; returns (K, rank)."""
    K, p, q, r = 0, 0.0, 0.0, 0.0
    for j in range(len(b)):
        if active[k, j]:
            K += 1
            p, q, r = p + A[j, 0] ** 2, q + A[j, 0] * A[j, 1], r + A[j, 1] ** 2
    if K == 0:
        return 0, 0
    turn = math.atan2(2 * q, p - r) / 2
    cos, sin = math.cos(turn), math.sin(turn)
    yy = yz = yb = ww = wb = v0 = v1 = 0.0
    for j in range(len(b)):
        if active[k, j]:
            y, z = cos * A[j, 0] + sin * A[j, 1], cos * A[j, 1] - sin * A[j, 0]
            yy, yz, yb = yy + y * y, yz + y * z, yb + y * b[j]
            v0, v1 = v0 + y * A[j, 0], v1 + y * A[j, 1]
    for j in range(len(b)):
        if active[k, j]:
            y, z = cos * A[j, 0] + sin * A[j, 1], cos * A[j, 1] - sin * A[j, 0]
            w = z - y * yz / yy
            ww, wb = ww + w * w, wb + w * b[j]
    if ww > rank_tolerance**2 * yy:
        second = wb / ww
        first = (yb - yz * second) / yy
        offset[k, 0], offset[k, 1] = cos * first - sin * second, sin * first + cos * second
        projector[k, 0, 0] = projector[k, 1, 1] = 1.0
        return K, 2
    length = math.sqrt(v0 * v0 + v1 * v1)
    v0, v1 = v0 / length, v1 / length
    yy = yb = 0.0
    for j in range(len(b)):
        if active[k, j]:
            y = A[j, 0] * v0 + A[j, 1] * v1
            yy, yb = yy + y * y, yb + y * b[j]
    offset[k, 0], offset[k, 1] = v0 * yb / yy, v1 * yb / yy
    projector[k, 0, 0], projector[k, 1, 1] = v0 * v0, v1 * v1
    projector[k, 0, 1] = projector[k, 1, 0] = v0 * v1
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
        end, ray = widest + 1 if widest < K - 1 else 0, opening > flat
        first, turn = angle[widest] + math.pi / 2, max(opening, 0.0)
        v, w, cos, sin = math.cos(first), math.sin(first), math.cos(turn / (fan - 1)), math.sin(turn / (fan - 1))
        for i in range(fan if ray else 1):
            if ray and i == fan - 1:  # the two ends must be exact, those between only lie there
                v, w = math.cos(first + turn), math.sin(first + turn)
            normals[i, 0], normals[i, 1] = v, w
            generator[i] = order[widest if 2 * i < fan - 1 else end]
            v, w = v * cos - w * sin, w * cos + v * sin
        count = fan if ray else 1
    if other >= math.pi - flat:
        direction = angle[second] + math.pi / 2
        normals[count, 0], normals[count, 1], generator[count] = math.cos(direction), math.sin(direction), order[second]
        count += 1
    return count


@compiled
@no_type_check
def _critical_region(k, unit, unit_b, C, d, kkt, normals, generator, count, rank_tolerance, row_A, row_b, row_source):
    """`critical_region`: the rows that say something."""
    G, f, P, offset, active = kkt
    m, R, least = len(unit_b), 0, rank_tolerance**2
    for j in range(m):
        p, q = unit[j, 0], unit[j, 1]
        across = (p - p * P[k, 0, 0] - q * P[k, 1, 0]) ** 2 + (q - p * P[k, 0, 1] - q * P[k, 1, 1]) ** 2
        if not active[k, j] and across > least:
            for i in range(2):
                row_A[k, R, i] = p * G[k, 0, i] + q * G[k, 1, i]
            row_b[k, R], row_source[k, R] = unit_b[j] - p * f[k, 0] - q * f[k, 1], j
            R += 1
    for n in range(count):
        v, w = normals[n, 0], normals[n, 1]
        p, q = v * P[k, 0, 0] + w * P[k, 1, 0], v * P[k, 0, 1] + w * P[k, 1, 1]
        if p * p + q * q > least:
            for i in range(2):
                row_A[k, R, i] = p * C[k, 0, i] + q * C[k, 1, i]
            row_b[k, R] = v * offset[k, 0] + w * offset[k, 1] - p * d[k, 0] - q * d[k, 1]
            row_source[k, R] = m + generator[n]
            R += 1


@compiled
@no_type_check
def _inverse_optimal(k, m, u, ball, C, d, normals, generator, count, none, row_A, row_b, row_source):
    """`inverse_optimal_set`."""
    x, y, room = u[k, 0] - d[k, 0], u[k, 1] - d[k, 1], ball[min(k, len(ball) - 1)]
    for n in range(count):
        p, q = normals[n, 0], normals[n, 1]
        for i in range(2):
            row_A[k, n, i] = p * C[k, 0, i] + q * C[k, 1, i]
        row_b[k, n] = p * x + q * y + room
        row_source[k, n] = 2 * m if generator[n] == none else m + generator[n] % m


@compiled
@no_type_check
def read(
    A, b, hard, C, d, u, observed, bound, angles, ball, spread, around, paper, active_tolerance, epsilon,
    rank_tolerance, flat,
):  # fmt: skip
    """What a measurement of B robots says about theta, and their KKT conditions.

    `bound` (B or 1, m or 1) is the slack of an active row, `ball` (B or 1,) bounds the error of C theta + d - u.
    `angles` (B, m), errors of the rows' directions, turn each row by the fractions `spread`; (B, 0): there are none.
    `around` is the fan of a full turn, `paper` asks for the critical region.

    Returns half-spaces (A, b, source), padded; (informative, alarmed, slack, excess), as in `reading.Reading`; (G,
    f, projector, free, offset, active, n_active, rank, case), as in `kkt.KktSolution`; and whether all rows, C and d
    are finite.
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
    all_known = True
    for k in range(B):
        usable, broken = observed[k], False
        c0, c1, c2, c3, d0, d1 = C[k, 0, 0], C[k, 0, 1], C[k, 1, 0], C[k, 1, 1], d[k, 0], d[k, 1]
        known = math.isfinite(c0) and math.isfinite(c1) and math.isfinite(c2) and math.isfinite(c3)
        if not (known and math.isfinite(d0) and math.isfinite(d1)):
            usable = all_known = False
            c0 = c1 = c2 = c3 = d0 = d1 = 0.0
        for j in range(m):
            p, q, c = A[k, j, 0], A[k, j, 1], b[k, j]
            if not (math.isfinite(p) and math.isfinite(q) and math.isfinite(c)):
                usable = all_known = False
                p, q, c = 0.0, 0.0, 1.0
            is_row = p != 0 or q != 0
            scale = 1 / math.sqrt(p * p + q * q) if is_row else 1.0
            unit[j, 0], unit[j, 1], unit_b[j] = p * scale, q * scale, c * scale
            s = (c - (p * u[k, 0] + q * u[k, 1])) * scale
            room = bound[min(k, len(bound) - 1), min(j, bound.shape[1] - 1)]
            room += epsilon * (abs(p * u[k, 0]) + abs(q * u[k, 1]) + abs(c)) * scale
            slack[k, j], excess[k, j] = s, -s - room
            active[k, j] = is_row and abs(s) < active_tolerance
            near[j] = is_row and s <= room
            broken = broken or (hard[j] and -s > room)
        alarmed[k], informative[k] = usable and broken, usable and not broken

        n_active[k], rank[k] = _solve_active(k, unit, unit_b, active, rank_tolerance, offset, projector)
        K = n_active[k]
        case[k] = K if K < 2 else 2 if rank[k] < 2 else 3 if K == 2 else 4
        if rank[k] < 2:
            free[k, 0, 0], free[k, 1, 1] = 1 - projector[k, 0, 0], 1 - projector[k, 1, 1]
            free[k, 0, 1], free[k, 1, 0] = -projector[k, 0, 1], -projector[k, 1, 0]
        for i in range(2):
            f[k, i] = offset[k, i] + free[k, i, 0] * d0 + free[k, i, 1] * d1
            G[k, i, 0] = free[k, i, 0] * c0 + free[k, i, 1] * c2
            G[k, i, 1] = free[k, i, 0] * c1 + free[k, i, 1] * c3
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
        rows = row_A, row_b, row_source
        if paper:
            kkt = G, f, projector, offset, active
            _critical_region(k, unit, unit_b, C, d, kkt, normals, generator, count, rank_tolerance, *rows)
        else:
            _inverse_optimal(k, m, u, ball, C, d, normals, generator, count, generators, *rows)
    return (
        (row_A, row_b, row_source),
        (informative, alarmed, slack, excess),
        (G, f, projector, free, offset, active, n_active, rank, case),
        all_known,
    )
