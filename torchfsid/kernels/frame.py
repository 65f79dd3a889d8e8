r"""The frame in which a programme over {z : A z <= b} is solved: unit rows, the point y is the origin, the metric I.

    x = L'(z - y),   H = L L',   rows w_j = L^-1 a_j / |L^-1 a_j|

Rows so long or short that their squares leave the floating-point numbers are scaled by powers of two before.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item
from torchfsid.kernels.linear import dot
from torchfsid.outcome import ProgrammeStatus

OK, EMPTY, UNDEFINED = int(ProgrammeStatus.OK), int(ProgrammeStatus.EMPTY), int(ProgrammeStatus.UNDEFINED)

SHORT, LONG = 1e-100, 1e100
"""Largest entries of rows that need no scaling."""


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
def from_frame(L, metric, y, z, x):
    """x = L'(z - y). Returns the size of the numbers that it was computed from."""
    p, size = len(x), 0.0
    for i in range(p):
        x[i] = z[i] - y[i]
        if not metric:
            size += abs(z[i]) + abs(y[i])
    if metric:
        for i in range(p):
            total = 0.0
            for j in range(i, p):
                total += L[j, i] * x[j]
                size += abs(L[j, i]) * (abs(z[j]) + abs(y[j]))
            x[i] = total
    return size


@item
@no_type_check
def distance(A, b, row, z, lengths):
    """(a.z - b) / |a| of a row, with the lengths as `to_frame` gives them."""
    scale = lengths[row, 0]
    over = -b[row] * scale
    for j in range(len(z)):
        over += A[row, j] * scale * z[j]
    return over / lengths[row, 1]
