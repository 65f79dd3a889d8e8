r"""One measurement of many robots in space in scalar code: slacks, KKT conditions and half-spaces of theta.

This is `evidence` for controls in R^3 and any number p of parameters. It computes what `identification` computes in
torch, one robot after the other. Tests compare the two. The active rows A_a, of unit length, are turned by a rotation V
until the columns y_i of A_a V are orthogonal (one-sided Jacobi). The lengths of these are the singular values, and

    A_a^+ b_a = sum_i v_i (y_i.b_a)/(y_i.y_i),   A_a^+ A_a = sum_i v_i v_i^T     (over the i of a rank that counts).
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, launcher
from torchfsid.kernels.cones import EDGES, FAN, RING, normals_in_space
from torchfsid.tolerances import RANK_TOLERANCE, ROUND_OFF

SWEEPS = 12
"""Most sweeps over the three pairs of columns. Convergence is quadratic."""

CIRCUMSCRIBED = 1 / math.cos(math.pi / RING)
"""Radius of the corners of a regular polygon of `RING` sides around the unit circle."""


@item
@no_type_check
def judge(k, A, b, hard, u, bound, angles, active_tolerance, unit, unit_b, slack, excess, active, near):
    """Fill the unit rows, the slacks, the active rows and those that may be active (`near`).

    Returns:
        Three answers: whether all rows are finite, whether a hard row is violated beyond its bound, and whether a row
        that may be active has no known direction.
    """
    known, broken, blind, least = True, False, False, bound.shape[1] - 1
    of_bound, uncertain = min(k, len(bound) - 1), angles.shape[1] > 0
    for j in range(b.shape[1]):
        p, q, r, c = A[k, j, 0], A[k, j, 1], A[k, j, 2], b[k, j]
        if not (math.isfinite(p) and math.isfinite(q) and math.isfinite(r) and math.isfinite(c)):
            known = False
            p, q, r, c = 0.0, 0.0, 0.0, 1.0
        is_row = p != 0 or q != 0 or r != 0
        if is_row:
            large = max(abs(p), abs(q), abs(r))
            if not 1e-140 < large < 1e140:  # the squares over- or underflow
                p, q, r, c = p / large, q / large, r / large, c / large
            scale = 1 / math.sqrt(p * p + q * q + r * r)
            p, q, r, c = p * scale, q * scale, r * scale, c * scale
        unit[j, 0], unit[j, 1], unit[j, 2], unit_b[j] = p, q, r, c
        x, y, z = p * u[k, 0], q * u[k, 1], r * u[k, 2]
        s = c - (x + y + z)
        room = bound[of_bound, min(j, least)] + ROUND_OFF * (abs(x) + abs(y) + abs(z) + abs(c))
        slack[k, j], excess[k, j] = s, -s - room
        active[k, j] = is_row and abs(s) < active_tolerance
        near[j] = is_row and s <= room
        broken = broken or (hard[j] and excess[k, j] > 0)
        if uncertain and s <= room:
            blind = blind or angles[k, j] >= math.pi or (angles[k, j] > 0 and not is_row)
    return known, broken, blind


@item
@no_type_check
def turn_columns(Y, K, V, p, q):
    """Rotate the columns p and q of Y (K, 3) and of V until they are orthogonal. Returns whether they were not."""
    a = b = c = 0.0
    for i in range(K):
        a, b, c = a + Y[i, p] * Y[i, p], b + Y[i, q] * Y[i, q], c + Y[i, p] * Y[i, q]
    if abs(c) <= 2.0**-52 * math.sqrt(a * b):
        return False
    turn = math.atan2(2 * c, a - b) / 2
    cos, sin = math.cos(turn), math.sin(turn)
    for i in range(K):
        Y[i, p], Y[i, q] = cos * Y[i, p] + sin * Y[i, q], cos * Y[i, q] - sin * Y[i, p]
    for i in range(3):
        V[i, p], V[i, q] = cos * V[i, p] + sin * V[i, q], cos * V[i, q] - sin * V[i, p]
    return True


@item
@no_type_check
def solve_active(k, unit, unit_b, active, Y, V, right, offset, projector):
    """Fill A_a^+ b_a and A_a^+ A_a for the active rows. Returns their number K and their rank."""
    K = 0
    for j in range(len(unit_b)):
        if active[k, j]:
            Y[K, 0], Y[K, 1], Y[K, 2], right[K] = unit[j, 0], unit[j, 1], unit[j, 2], unit_b[j]
            K += 1
    if K == 0:
        return 0, 0
    for i in range(3):
        for j in range(3):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        first, second = turn_columns(Y, K, V, 0, 1), turn_columns(Y, K, V, 0, 2)
        if not (turn_columns(Y, K, V, 1, 2) or first or second):
            break
    largest, rank = 0.0, 0
    for c in range(3):
        size = 0.0
        for i in range(K):
            size += Y[i, c] * Y[i, c]
        largest = max(largest, size)
    for c in range(3):
        size = along = 0.0
        for i in range(K):
            size, along = size + Y[i, c] * Y[i, c], along + Y[i, c] * right[i]
        if size > RANK_TOLERANCE**2 * largest:
            rank += 1
            for i in range(3):
                offset[k, i] += V[i, c] * along / size
                for j in range(3):
                    projector[k, i, j] += V[i, c] * V[j, c]
    return K, rank


@item
@no_type_check
def solve_motion(k, C, d, wish_known, rank, offset, projector, free, G, f):
    """Fill G and f of u* = G theta + f, and free = I - P, which is exactly zero at full rank."""
    for i in range(3):
        f[k, i] = offset[k, i]
        for j in range(3):
            if rank < 3:
                free[k, i, j] = (1.0 if i == j else 0.0) - projector[k, i, j]
            if wish_known:
                f[k, i] += free[k, i, j] * d[k, j]
                for e in range(C.shape[2]):
                    G[k, i, e] += free[k, i, j] * C[k, j, e]


@item
@no_type_check
def find_generators(k, unit, chosen, angles, a, order):
    """Fill the generators and names of the chosen rows, each with the pyramid of its error (`inverse_optimal`).

    Returns:
        The number of generators.
    """
    K, m, uncertain = 0, len(unit), angles.shape[1] > 0
    for edge in range(RING if uncertain else 1):
        turn = 2 * math.pi * edge / RING
        for j in range(m):
            if not chosen[j] or (edge > 0 and angles[k, j] == 0):
                continue
            x, y, z = unit[j, 0], unit[j, 1], unit[j, 2]
            order[K] = edge * m + j
            if not uncertain or angles[k, j] == 0:
                a[K, 0], a[K, 1], a[K, 2] = x, y, z
                K += 1
                continue
            steep = angles[k, j] >= math.pi / 2
            slope = math.sqrt(3.0) if steep else math.tan(angles[k, j]) * CIRCUMSCRIBED
            cos = 1 / math.sqrt(1 + slope * slope)
            sin = cos * slope
            cos = -cos if steep and edge % 2 == 1 else cos
            if abs(x) <= abs(y) and abs(x) <= abs(z):
                p, q, r = 0.0, z, -y
            elif abs(y) <= abs(z):
                p, q, r = -z, 0.0, x
            else:
                p, q, r = y, -x, 0.0
            size = math.sqrt(p * p + q * q + r * r)
            p, q, r = p / size, q / size, r / size
            v, w = sin * math.cos(turn), sin * math.sin(turn)
            a[K, 0] = cos * x + v * p + w * (y * r - z * q)
            a[K, 1] = cos * y + v * q + w * (z * p - x * r)
            a[K, 2] = cos * z + v * r + w * (x * q - y * p)
            K += 1
    return K


@item
@no_type_check
def critical_region(
    k, unit, unit_b, C, d, G, f, P, offset, active, normals, generator, count, row_A, row_b, row_source
):
    """The rows of `identification.critical_region` that are not padding. Returns their number."""
    m, R, least = len(unit_b), 0, RANK_TOLERANCE**2
    for j in range(m):
        size = 0.0
        for i in range(3):
            across = unit[j, i]
            for c in range(3):
                across -= unit[j, c] * P[k, c, i]
            size += across * across
        if not active[k, j] and size > least:
            row_b[k, R], row_source[k, R] = unit_b[j], j
            for i in range(3):
                row_b[k, R] -= unit[j, i] * f[k, i]
                for e in range(C.shape[2]):
                    row_A[k, R, e] += unit[j, i] * G[k, i, e]
            R += 1
    for n in range(count):
        size = right = 0.0
        for i in range(3):
            along = 0.0
            for c in range(3):
                along += normals[n, c] * P[k, c, i]
            size, right = size + along * along, right + normals[n, i] * offset[k, i] - along * d[k, i]
            for e in range(C.shape[2]):
                row_A[k, R, e] += along * C[k, i, e]
        if size > least:
            row_b[k, R], row_source[k, R] = right, m + generator[n]
            R += 1
        else:
            for e in range(C.shape[2]):
                row_A[k, R, e] = 0.0
    return R


@item
@no_type_check
def inverse_optimal(k, m, u, ball, C, d, normals, generator, count, none, row_A, row_b, row_source):
    """The rows of `identification.inverse_optimal_set` that are not padding."""
    for n in range(count):
        right = ball
        for i in range(3):
            right += normals[n, i] * (u[k, i] - d[k, i])
            for e in range(C.shape[2]):
                row_A[k, n, e] += normals[n, i] * C[k, i, e]
        row_b[k, n] = right
        row_source[k, n] = 2 * m if generator[n] == none else m + generator[n] % m


@item
@no_type_check
def is_finite(k, C, d):
    """Is the nominal control of robot k finite?"""
    known = True
    for i in range(3):
        known = known and math.isfinite(d[k, i])
        for e in range(C.shape[2]):
            known = known and math.isfinite(C[k, i, e])
    return known


@item
@no_type_check
def read_one(k, rows, sample, bounds, angles, paper, active_tolerance, scratch, half_spaces, judged, kkt):
    """Fill the places of robot k in the results of `evidence_in_space`, which hold padding and zeros.

    Returns the number of half-spaces.
    """
    (A, b, hard), (C, d, u, usable), (bound, ball, drift) = rows, sample, bounds
    unit, unit_b, near, Y, V, right, a, order, normals, generator = scratch
    (row_A, row_b, row_source), (informative, alarmed, infeasible, slack, excess) = half_spaces, judged
    G, f, projector, free, offset, active, n_active, rank, case = kkt
    known, broken, blind = judge(
        k, A, b, hard, u, bound, angles, active_tolerance, unit, unit_b, slack, excess, active, near
    )
    wish_known = is_finite(k, C, d)
    usable_here = usable[k] and known and wish_known
    alarmed[k], informative[k], infeasible[k] = usable_here and broken, usable_here and not broken and not blind, False
    K, rank[k] = solve_active(k, unit, unit_b, active, Y, V, right, offset, projector)
    n_active[k], case[k] = K, K if K < 2 else 2 if rank[k] < 2 else 3 if rank[k] == K else 4
    solve_motion(k, C, d, wish_known, rank[k], offset, projector, free, G, f)
    if not informative[k]:
        return 0
    m, none = len(unit_b), len(order)
    found = find_generators(k, unit, active[k] if paper else near, angles[:, :0] if paper else angles, a, order)
    count = normals_in_space(a, order, found, none, normals, generator)
    if paper:
        return critical_region(
            k, unit, unit_b, C, d, G, f, projector, offset, active, normals, generator, count, row_A, row_b, row_source
        )
    room = ball[min(k, len(ball) - 1)] + drift[min(k, len(drift) - 1)]
    inverse_optimal(k, m, u, room, C, d, normals, generator, count, none, row_A, row_b, row_source)
    return count


@item
@no_type_check
def rows_for(m, paper):
    """The largest number of half-spaces that follow from m rows."""
    return (m if paper else 0) + len(FAN) + EDGES


def places(m: int, generators: int) -> list[tuple[tuple[int, ...], type]]:
    """On a GPU: the shape and the type of a thread's entry in each array of scratch, for m rows."""
    return [((2 * m + generators, 3), np.float64), ((2 * m,), np.float64), ((generators,), np.int64), ((m,), np.bool_)]


@launcher
@no_type_check
def evidence_in_space(A, b, hard, C, d, u, usable, bound, angles, ball, drift, paper, active_tolerance):
    """What a measurement of B robots in space says about theta, and their KKT conditions.

    Arguments and results are those of `evidence`, with A (B, m, 3) and C (B, 3, p), without rows that are relaxed and
    without limits on the nominal control.
    """
    (B, m), p, most = b.shape, C.shape[2], 1  # a row of padding, where nothing is said
    generators, R = m * RING if angles.shape[1] > 0 and not paper else m, rows_for(m, paper)
    half_spaces = np.zeros((B, R, p)), np.ones((B, R)), np.full((B, R), -1)
    judged = np.empty(B, np.bool_), np.empty(B, np.bool_), np.empty(B, np.bool_), np.empty((B, m)), np.empty((B, m))
    kkt = (
        np.zeros((B, 3, p)), np.zeros((B, 3)), np.zeros((B, 3, 3)), np.zeros((B, 3, 3)), np.zeros((B, 3)),
        np.empty((B, m), np.bool_), np.empty(B, np.int64), np.empty(B, np.int64), np.empty(B, np.int64),
    )  # fmt: skip
    scratch = (
        np.zeros((m, 3)), np.empty(m), np.empty(m, np.bool_), np.empty((m, 3)), np.empty((3, 3)), np.empty(m),
        np.empty((generators, 3)), np.empty(generators, np.int64),
        np.empty((len(FAN) + EDGES, 3)), np.empty(len(FAN) + EDGES, np.int64),
    )  # fmt: skip
    rows, sample, bounds = (A, b, hard), (C, d, u, usable), (bound, ball, drift)
    for k in range(B):
        count = read_one(k, rows, sample, bounds, angles, paper, active_tolerance, scratch, half_spaces, judged, kkt)
        most = max(most, count)
    row_A, row_b, row_source = half_spaces
    return (row_A[:, :most].copy(), row_b[:, :most].copy(), row_source[:, :most].copy()), judged, kkt
