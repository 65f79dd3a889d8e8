"""One measurement of many planar robots in scalar code: slacks, KKT conditions (`kkt`) and half-spaces of theta.

This computes what `identification` computes in torch, one robot after the other. The theory is explained there, and
tests compare the two.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, item_in_place, launcher
from torchfsid.kernels.kkt import solve_one
from torchfsid.kernels.saturation import ROWS, clipped_inverse_optimal, workspace
from torchfsid.tolerances import (
    ANGLE_TOLERANCE,
    CRITICAL_NORMALS,
    NORMALS,
    RANK_TOLERANCE,
    RELAXED_OPENING,
    ROUND_OFF,
    SPREAD,
)

PI, TURN = math.pi, 2 * math.pi
DIRECTIONS, CRITICAL_DIRECTIONS = (
    np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    for turn in (np.linspace(0.0, TURN, NORMALS), np.linspace(0.0, TURN, CRITICAL_NORMALS))
)


@item_in_place
@no_type_check
def is_finite(k, C, d):
    """Is the nominal control of robot k finite?"""
    known = math.isfinite(d[k, 0]) and math.isfinite(d[k, 1])
    for e in range(C.shape[2]):
        known = known and math.isfinite(C[k, 0, e]) and math.isfinite(C[k, 1, e])
    return known


@item_in_place
@no_type_check
def judge(k, o, A, b, hard, relaxed, u, bound, angles, active_tolerance, unit, unit_b, slack, excess, active, near):
    """Fill the unit rows, the slacks, the active rows and those that may be active (`near`), at place o of the results.

    Returns:
        Four answers: whether all rows are finite, whether a hard row and whether a relaxed row is violated beyond its
        bound, and whether a row that may be active has no known direction.
    """
    known, broken, strained, blind, least = True, False, False, False, bound.shape[1] - 1
    of_bound, uncertain = min(k, len(bound) - 1), angles.shape[1] > 0
    for j in range(b.shape[1]):
        p, q, c = A[k, j, 0], A[k, j, 1], b[k, j]
        if not (math.isfinite(p) and math.isfinite(q) and math.isfinite(c)):
            known = False
            p, q, c = 0.0, 0.0, 1.0
        is_row = p != 0 or q != 0
        if is_row:
            size = p * p + q * q
            if not 1e-280 < size < 1e280:  # the squares over- or underflow
                large = max(abs(p), abs(q))
                p, q, c = p / large, q / large, c / large
                size = p * p + q * q
            scale = 1 / math.sqrt(size)
            p, q, c = p * scale, q * scale, c * scale
        unit[j, 0], unit[j, 1], unit_b[j] = p, q, c
        s = c - (p * u[k, 0] + q * u[k, 1])
        room = bound[of_bound, min(j, least)] + ROUND_OFF * (abs(p * u[k, 0]) + abs(q * u[k, 1]) + abs(c))
        over = -s - room
        slack[o, j], excess[o, j] = s, over
        active[o, j] = is_row and abs(s) < active_tolerance
        near[j] = is_row and s <= room
        broken, strained = broken or (hard[j] and over > 0), strained or (relaxed[j] and over > 0)
        if uncertain and s <= room:
            blind = blind or angles[k, j] >= PI or (angles[k, j] > 0 and not is_row)
    return known, broken, strained, blind


@item_in_place
@no_type_check
def direction_of(g, angle, unit, exact):
    """The direction of generator g: that of its row if it is `exact`, without sines."""
    return (unit[g, 0], unit[g, 1]) if exact else (math.cos(angle), math.sin(angle))


@item_in_place
@no_type_check
def outward_normals(unit, exact, angle, order, K, none, around, normals, generator):
    """Fill the normals of `identification.normals` for K generators given by their angles.

    Args:
        unit: the unit rows.
        exact: whether the generators are unit rows. Otherwise they are turned ones.
        angle: the generators' angles [rad], sorted here.
        order: the generators' names, sorted with the angles.
        K: the number of generators.
        none: the name for "no generator".
        around: the fan of a full turn.
        normals: to be filled with the normals.
        generator: to be filled with the name of the generator nearest to each normal.

    Returns:
        The number of normals, and the cone's `opening` [rad], as in `OutwardNormals`.
    """
    fan = len(around)
    if K == 0:
        for i in range(fan - 1):
            normals[i, 0], normals[i, 1], generator[i] = around[i, 0], around[i, 1], none
        return fan - 1, TURN
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
    opening, count = gap - PI, 0
    if opening >= -ANGLE_TOLERANCE:
        end, ray = widest + 1 if widest < K - 1 else 0, opening > ANGLE_TOLERANCE
        x, y = direction_of(order[widest], angle[widest], unit, exact)
        v, w = -y, x
        x, y = direction_of(order[end], angle[end], unit, exact)
        if fan == 3:  # half of the opening, by the sum and the difference of the two ends
            cos, sin = math.sqrt((v + y) ** 2 + (w - x) ** 2) / 2, math.sqrt((v - y) ** 2 + (w + x) ** 2) / 2
        else:
            cos, sin = math.cos(opening / (fan - 1)), math.sin(opening / (fan - 1))
        for i in range(fan if ray else 1):
            if ray and i == fan - 1:  # the two ends must be exact, those between them need not
                v, w = y, -x
            normals[i, 0], normals[i, 1] = v, w
            generator[i] = order[widest if 2 * i < fan - 1 else end]
            v, w = v * cos - w * sin, w * cos + v * sin
        count = fan if ray else 1
    if other >= PI - ANGLE_TOLERANCE:
        x, y = direction_of(order[second], angle[second], unit, exact)
        normals[count, 0], normals[count, 1], generator[count] = -y, x, order[second]
        count += 1
    return count, opening if opening > ANGLE_TOLERANCE else 0.0


@item_in_place
@no_type_check
def find_generators(k, unit, chosen, angles, angle, order):
    """Fill the angles and names of the chosen rows, each turned by the fractions `SPREAD` of its error.

    Returns:
        The number of generators.
    """
    K, m, uncertain = 0, len(unit), angles.shape[1] > 0
    for turn in range(len(SPREAD) if uncertain else 1):
        for j in range(m):
            if chosen[j]:
                angle[K], order[K] = math.atan2(unit[j, 1], unit[j, 0]), turn * m + j
                if uncertain:
                    angle[K] = (angle[K] + SPREAD[turn] * angles[k, j] + PI) % TURN - PI
                K += 1
    return K


@item_in_place
@no_type_check
def critical_region(
    k, o, unit, unit_b, C, d, G, f, P, offset, active, normals, generator, count, row_A, row_b, row_source
):
    """The rows of `identification.critical_region` that are not padding. Returns their number.

    The KKT conditions are those at place o.
    """
    m, R, least = len(unit_b), 0, RANK_TOLERANCE**2
    for j in range(m):
        p, q = unit[j, 0], unit[j, 1]
        across = (p - p * P[o, 0, 0] - q * P[o, 1, 0]) ** 2 + (q - p * P[o, 0, 1] - q * P[o, 1, 1]) ** 2
        if not active[o, j] and across > least:
            for i in range(C.shape[2]):
                row_A[k, R, i] = p * G[o, 0, i] + q * G[o, 1, i]
            row_b[k, R], row_source[k, R] = unit_b[j] - p * f[o, 0] - q * f[o, 1], j
            R += 1
    for n in range(count):
        v, w = normals[n, 0], normals[n, 1]
        p, q = v * P[o, 0, 0] + w * P[o, 1, 0], v * P[o, 0, 1] + w * P[o, 1, 1]
        if p * p + q * q > least:
            for i in range(C.shape[2]):
                row_A[k, R, i] = p * C[k, 0, i] + q * C[k, 1, i]
            row_b[k, R] = v * offset[o, 0] + w * offset[o, 1] - p * d[k, 0] - q * d[k, 1]
            row_source[k, R] = m + generator[n]
            R += 1
    return R


@item_in_place
@no_type_check
def inverse_optimal(k, m, u, ball, C, d, normals, generator, count, none, row_A, row_b, row_source):
    """The rows of `identification.inverse_optimal_set` that are not padding."""
    x, y = u[k, 0] - d[k, 0], u[k, 1] - d[k, 1]
    for n in range(count):
        p, q = normals[n, 0], normals[n, 1]
        for i in range(C.shape[2]):
            row_A[k, n, i] = p * C[k, 0, i] + q * C[k, 1, i]
        row_b[k, n] = p * x + q * y + ball
        row_source[k, n] = 2 * m if generator[n] == none else m + generator[n] % m


@item_in_place
@no_type_check
def read_one(k, o, rows, sample, angles, fan, around, relaxes, paper, active_tolerance, scratch, judged, kkt):
    """Fill what `evidence` returns of robot k but for half-spaces, and find its normals. Returns their number.

    It is -1 if the robot is not informative. Slacks and KKT conditions are those at place o. These are solved only for
    the critical region (`paper`).
    """
    A, b, hard, relaxed = rows
    C, d, u, usable, bound = sample
    unit, unit_b, near, angle, order, normals, generator = scratch
    informative, alarmed, infeasible, slack, excess = judged
    active = kkt[5]
    known, broken, strained, blind = judge(
        k, o, A, b, hard, relaxed, u, bound, angles, active_tolerance, unit, unit_b, slack, excess, active, near
    )
    wish_known = is_finite(k, C, d)
    usable_here = usable[k] and known and wish_known
    alarmed[k], informative[k] = usable_here and broken, usable_here and not broken and not blind
    infeasible[k] = False
    if not (informative[k] or (relaxes and usable_here and not broken)):
        return -1
    if paper:
        solve_one(k, o, C, d, wish_known, unit, unit_b, kkt)
    found = find_generators(k, unit, active[o] if paper else near, fan, angle, order)
    count, opening = outward_normals(
        unit, fan.shape[1] == 0, angle, order, found, len(order), around, normals, generator
    )
    if relaxes:
        pointed = opening > 0 and not blind
        alarmed[k] = strained and not blind and opening > RELAXED_OPENING
        informative[k] = pointed and not strained
        infeasible[k] = not alarmed[k] and not informative[k]
    return count if informative[k] else -1


@item_in_place
@no_type_check
def pad_rows(k, count, row_A, row_b, row_source):
    """Fill the half-spaces of robot k behind the first `count` with padding."""
    for n in range(count, row_b.shape[1]):
        row_b[k, n], row_source[k, n] = 1.0, -1
        for e in range(row_A.shape[2]):
            row_A[k, n, e] = 0.0


@item
@no_type_check
def rows_for(m, paper, clips):
    """The number of half-spaces, padding included, that follow from m rows."""
    return ROWS if clips else m + CRITICAL_NORMALS + 1 if paper else NORMALS + 1


@launcher
@no_type_check
def evidence(A, b, hard, relaxed, C, d, u, usable, bound, angles, ball, drift, clip, paper, active_tolerance):
    """What a measurement of B robots says about theta.

    Args:
        A: (B, m, 2), the rows over the control.
        b: (B, m), their bounds [m/s].
        hard: (m,), the rows that no controller may violate.
        relaxed: (m,), the rows of which the controller takes the least violation if they are infeasible.
        C: (B, 2, p), of the nominal control C theta + d. Where it is clipped, p = 2.
        d: (B, 2), of the nominal control [m/s].
        u: (B, 2), the measured controls [m/s].
        usable: (B,), whether the sample may be used.
        bound: (B or 1, m or 1), the largest slack of an active row [m/s].
        angles: (B, m), errors of the rows' directions [rad], or (B, 0) if there are none.
        ball: (B or 1,), a bound on the error of u [m/s].
        drift: (B or 1,), a bound on the error of C theta + d [m/s].
        clip: how the nominal control is clipped: (limits (2,), whether by norm, dead speed) as in `Saturation`, and the
            vertices of Theta (B, v, 2). No limits (0,) if it is not.
        paper: whether the half-spaces are those of the critical region.
        active_tolerance: the slack below which a row counts as active [m/s].

    Returns:
        Half-spaces (A, b, source), padded, and (informative, alarmed, infeasible), as in `Evidence`.
    """
    (B, m), fan, clips = b.shape, angles[:, :0] if paper else angles, len(clip[0]) > 0
    generators = m * len(SPREAD) if fan.shape[1] > 0 else m
    around, work = CRITICAL_DIRECTIONS if paper else DIRECTIONS, workspace(clip[3].shape[1])
    R = rows_for(m, paper, clips)
    half_spaces = np.empty((B, R, C.shape[2])), np.empty((B, R)), np.empty((B, R), np.int64)
    informative, alarmed, infeasible = np.empty(B, np.bool_), np.empty(B, np.bool_), np.empty(B, np.bool_)
    slack, excess, kkt = np.empty((1, m)), np.empty((1, m)), room_for_kkt(1, m, C.shape[2])
    judged = informative, alarmed, infeasible, slack, excess
    scratch = (
        np.zeros((m, 2)), np.empty(m), np.empty(m, np.bool_), np.empty(generators), np.empty(generators, np.int64),
        np.empty((len(around) + 1, 2)), np.empty(len(around) + 1, np.int64),
    )  # fmt: skip
    rows, sample, relaxes = (A, b, hard, relaxed), (C, d, u, usable, bound), relaxed.any()
    for k in range(B):
        count = read_one(
            k, 0, rows, sample, angles, fan, around, relaxes, paper, active_tolerance, scratch, judged, kkt
        )
        of, room, shift = (*scratch[5:], count), ball[min(k, len(ball) - 1)], drift[min(k, len(drift) - 1)]
        if count >= 0 and paper:
            count = critical_region(k, 0, *scratch[:2], C, d, *kkt[:3], *kkt[4:6], *of, *half_spaces)
        elif count >= 0 and clips:
            count = clipped_inverse_optimal(k, m, u, room, shift, C, d, clip, *of, generators, work, *half_spaces)
        elif count >= 0:
            inverse_optimal(k, m, u, room + shift, C, d, *of, generators, *half_spaces)
        pad_rows(k, max(count, 0), *half_spaces)
    return half_spaces, (informative, alarmed, infeasible)


@launcher
@no_type_check
def room_for_kkt(B, m, p):
    """Arrays (G, f, projector, free, offset, active, n_active, rank, case), as in `KktSolution`."""
    return (
        np.empty((B, 2, p)), np.empty((B, 2)), np.empty((B, 2, 2)), np.empty((B, 2, 2)), np.empty((B, 2)),
        np.empty((B, m), np.bool_), np.empty(B, np.int64), np.empty(B, np.int64), np.empty(B, np.int64),
    )  # fmt: skip


@launcher
@no_type_check
def details(A, b, hard, relaxed, C, d, u, bound, active_tolerance):
    """The slacks and KKT conditions of B robots, with the arguments of `evidence`.

    Returns:
        (slack, excess), as in `Evidence`, and (G, f, projector, free, offset, active, n_active, rank, case), as in
        `KktSolution`.
    """
    (B, m), exact = b.shape, u[:, :0]
    slack, excess, kkt = np.empty((B, m)), np.empty((B, m)), room_for_kkt(B, m, C.shape[2])
    unit, unit_b, near = np.empty((m, 2)), np.empty(m), np.empty(m, np.bool_)
    for k in range(B):
        judge(k, k, A, b, hard, relaxed, u, bound, exact, active_tolerance, unit, unit_b, slack, excess, kkt[5], near)
        solve_one(k, k, C, d, is_finite(k, C, d), unit, unit_b, kkt)
    return (slack, excess), kkt
