r"""Critical regions of planar robots, and their vector-Jacobian products, one item after the other.

This computes what `identification.critical_region` computes in torch. With P = A_a^+ A_a, the offset x = A_a^+ b_a
and an outward normal n of the cone of the active rows, its half-spaces are

    w.(C theta + d) <= b_j - a_j.x,   w = (I - P) a_j       row j stays inactive
    w.(C theta + d) <= n.x,           w = P n               a multiplier stays non-negative

As long as the rank stays, with M = (A_a' A_a)^+, r = b_a - A_a x and dP = S + S' (Golub and Pereyra, 1973),

    dx = M A_a' (db - dA x) + M dA' r + (I - P) dA' A_a M x,     S = M A_a' dA (I - P).
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item_in_place, launcher
from torchfsid.kernels.evidence import CRITICAL_DIRECTIONS, find_generators, outward_normals
from torchfsid.kernels.frame import scale_of
from torchfsid.kernels.kkt import principal_axes, solve_active
from torchfsid.tolerances import RANK_TOLERANCE

FAN = len(CRITICAL_DIRECTIONS)
LEAST = RANK_TOLERANCE**2


@item_in_place
@no_type_check
def to_unit(k, A, b, active, unit, unit_b, length, on):
    """Fill the unit rows of item k, the lengths of the rows and the active rows. Zero rows are never active."""
    for j in range(len(unit_b)):
        scale = scale_of(A[k], j)
        p, q = A[k, j, 0] * scale, A[k, j, 1] * scale
        size = math.sqrt(p * p + q * q)
        on[0, j] = active[k, j] and size > 0.0
        size, scale = (size, scale) if size > 0.0 else (1.0, 1.0)
        unit[j, 0], unit[j, 1], unit_b[j], length[j] = p / size, q / size, b[k, j] * scale / size, size / scale


@item_in_place
@no_type_check
def solve(unit, unit_b, on, offset, P, angle, order, normals, generator):
    """Fill offset, P and the normals with their generators. Returns the rank and the number of normals."""
    for i in range(2):
        offset[0, i], P[0, i, 0], P[0, i, 1] = 0.0, 0.0, 0.0
    _, rank = solve_active(0, unit, unit_b, on, offset, P)
    found = find_generators(0, unit, on[0], unit[:, :0], angle, order)
    count, _ = outward_normals(unit, True, angle, order, found, len(order), CRITICAL_DIRECTIONS, normals, generator)
    return rank, count


@item_in_place
@no_type_check
def place_of(n, count):
    """The place of the n-th normal, as in `identification.normals`: behind the fan comes that of a line."""
    return FAN if n == count - 1 and (count == 2 or count == FAN + 1) else n


@item_in_place
@no_type_check
def across(P, v, w):
    """(I - P) (v, w)."""
    return v - P[0, 0, 0] * v - P[0, 0, 1] * w, w - P[0, 1, 0] * v - P[0, 1, 1] * w


@launcher
@no_type_check
def critical_regions(A, b, active, C, d):
    """The half-spaces of each item.

    Args:
        A: (B, m, 2), the rows.
        b: (B, m), their bounds.
        active: (B, m), the active rows.
        C: (B, 2, p), of the nominal control C theta + d.
        d: (B, 2), of the nominal control.

    Returns:
        A, b and source of the half-spaces, m for the rows and then `FAN` + 1 for the normals. Others are padding.
    """
    (B, m), p = b.shape, C.shape[2]
    shape = B, m + FAN + 1
    row_A, row_b, source = np.zeros((*shape, p)), np.ones(shape), np.empty(shape, np.int64)
    unit, unit_b, length, angle, order = np.empty((m, 2)), np.empty(m), np.empty(m), np.empty(m), np.empty(m, np.int64)
    offset, P, on = np.empty((1, 2)), np.empty((1, 2, 2)), np.empty((1, m), np.bool_)
    normals, generator = np.empty((FAN + 1, 2)), np.empty(FAN + 1, np.int64)
    for k in range(B):
        to_unit(k, A, b, active, unit, unit_b, length, on)
        rank, count = solve(unit, unit_b, on, offset, P, angle, order, normals, generator)
        x, y = offset[0]
        for j in range(m + FAN + 1):
            source[k, j] = j if j < m else 2 * m
        for j in range(m + count):
            if j < m:
                v, w = across(P, unit[j, 0], unit[j, 1])
                place, kept = j, not on[0, j] and rank < 2
                bound = unit_b[j] - unit[j, 0] * x - unit[j, 1] * y
            else:
                first, second = normals[j - m]
                v, w = P[0, 0, 0] * first + P[0, 0, 1] * second, P[0, 1, 0] * first + P[0, 1, 1] * second
                place, kept, bound = m + place_of(j - m, count), True, first * x + second * y
                source[k, place] = m + generator[j - m]
            if kept and v * v + w * w > LEAST:
                for e in range(p):
                    row_A[k, place, e] = v * C[k, 0, e] + w * C[k, 1, e]
                row_b[k, place] = bound - v * d[k, 0] - w * d[k, 1]
    return row_A, row_b, source


@launcher
@no_type_check
def critical_regions_vjp(A, b, active, C, d, grad_A, grad_b):
    """The vector-Jacobian products of `critical_regions` with respect to A, b, C and d."""
    (B, m), p = b.shape, C.shape[2]
    to_A, to_b, to_C, to_d = np.zeros((B, m, 2)), np.zeros((B, m)), np.zeros((B, 2, p)), np.zeros((B, 2))
    unit, unit_b, length, angle, order = np.empty((m, 2)), np.empty(m), np.empty(m), np.empty(m), np.empty(m, np.int64)
    offset, P, on = np.empty((1, 2)), np.empty((1, 2, 2)), np.empty((1, m), np.bool_)
    normals, generator = np.empty((FAN + 1, 2)), np.empty(FAN + 1, np.int64)
    of_unit, of_bound = np.empty((m, 2)), np.empty(m)
    for k in range(B):
        to_unit(k, A, b, active, unit, unit_b, length, on)
        rank, count = solve(unit, unit_b, on, offset, P, angle, order, normals, generator)
        x, y = offset[0]
        of_unit[:], of_bound[:] = 0.0, 0.0
        of_x = of_y = 0.0
        H00 = H01 = H10 = H11 = 0.0  # the derivative with respect to P
        for j in range(m + count):
            place = j if j < m else m + place_of(j - m, count)
            one, two = unit[j] if j < m else normals[j - m]
            v, w = across(P, one, two)
            if j >= m:
                v, w = one - v, two - w
            if not (v * v + w * w > LEAST and (j >= m or (not on[0, j] and rank < 2))):
                continue
            bound = grad_b[k, place]
            g, h = -bound * d[k, 0], -bound * d[k, 1]  # the derivative with respect to w
            to_d[k, 0], to_d[k, 1] = to_d[k, 0] - bound * v, to_d[k, 1] - bound * w
            for e in range(p):
                along = grad_A[k, place, e]
                g, h = g + C[k, 0, e] * along, h + C[k, 1, e] * along
                to_C[k, 0, e] += v * along
                to_C[k, 1, e] += w * along
            through, beside = across(P, g, h)
            if j < m:
                of_unit[j, 0], of_unit[j, 1] = of_unit[j, 0] + through - bound * x, of_unit[j, 1] + beside - bound * y
                of_bound[j] += bound
                of_x, of_y, g, h = of_x - bound * one, of_y - bound * two, -g, -h
            else:
                of_x, of_y = of_x + bound * one, of_y + bound * two
                turn = one * (h - beside + bound * y) - two * (g - through + bound * x)
                share = 0.0 if place == m + FAN or count < FAN else (place - m) / (FAN - 1)
                for end in range(2):
                    start = generator[j - m] if place == m + FAN else generator[0] if end == 0 else generator[FAN - 1]
                    part = turn * (1.0 - share) if end == 0 else turn * share
                    if part != 0.0:
                        of_unit[start, 0] -= part * unit[start, 1]
                        of_unit[start, 1] += part * unit[start, 0]
            H00, H01, H10, H11 = H00 + g * one, H01 + g * two, H10 + h * one, H11 + h * two
        solve_vjp(on, unit, unit_b, offset, P, rank, of_x, of_y, (H00, H01, H10, H11), of_unit, of_bound)
        for j in range(m):
            radial = of_unit[j, 0] * unit[j, 0] + of_unit[j, 1] * unit[j, 1] + of_bound[j] * unit_b[j]
            is_row = unit[j, 0] != 0.0 or unit[j, 1] != 0.0
            radial = radial if is_row else 0.0
            to_b[k, j] = of_bound[j] / length[j]
            for i in range(2):
                to_A[k, j, i] = (of_unit[j, i] - radial * unit[j, i]) / length[j]
    return to_A, to_b, to_C, to_d


@item_in_place
@no_type_check
def solve_vjp(on, unit, unit_b, offset, P, rank, of_x, of_y, of_P, of_unit, of_bound):
    """Add the derivatives of the active rows that pass through their offset and, at rank 1, through P."""
    if rank == 0:
        return
    # M by the principal axes of the active rows, as in `kkt.solve_active`.
    one = two = three = yy = yz = ww = 0.0
    for j in range(len(unit_b)):
        if on[0, j]:
            v, w = unit[j, 0], unit[j, 1]
            one, two, three = one + v * v, two + v * w, three + w * w
    cos, sin = principal_axes(one, two, three)
    for j in range(len(unit_b)):
        if on[0, j]:
            y, z = cos * unit[j, 0] + sin * unit[j, 1], cos * unit[j, 1] - sin * unit[j, 0]
            yy, yz = yy + y * y, yz + y * z
    share = yz / yy
    for j in range(len(unit_b)):
        if on[0, j]:
            y, z = cos * unit[j, 0] + sin * unit[j, 1], cos * unit[j, 1] - sin * unit[j, 0]
            ww += (z - y * share) ** 2
    M00, M01, M11 = cos * cos / yy, cos * sin / yy, sin * sin / yy
    if rank == 2:
        v, w = -sin - share * cos, cos - share * sin
        M00, M01, M11 = M00 + v * v / ww, M01 + v * w / ww, M11 + w * w / ww
    v, w = M00 * of_x + M01 * of_y, M01 * of_x + M11 * of_y
    x, y = offset[0]
    K00 = K01 = K10 = K11 = 0.0
    if rank == 1:  # M (x s' + (H + H') (I - P)), s = (I - P) g
        s, t = across(P, of_x, of_y)
        H00, H01, H10, H11 = of_P
        K00, K01 = across(P, 2 * H00, H01 + H10)
        K10, K11 = across(P, H01 + H10, 2 * H11)
        K00, K01, K10, K11 = K00 + x * s, K01 + x * t, K10 + y * s, K11 + y * t
        K00, K01, K10, K11 = (
            M00 * K00 + M01 * K10, M00 * K01 + M01 * K11, M01 * K00 + M11 * K10, M01 * K01 + M11 * K11,
        )  # fmt: skip
    for j in range(len(unit_b)):
        if on[0, j]:
            p, q = unit[j, 0], unit[j, 1]
            along, left = p * v + q * w, unit_b[j] - p * x - q * y
            of_bound[j] += along
            of_unit[j, 0] += left * v - along * x + p * K00 + q * K10
            of_unit[j, 1] += left * w - along * y + p * K01 + q * K11
