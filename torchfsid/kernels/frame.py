r"""The frame in which a programme over {z : A z <= b} is solved: origin at the point y, metric I, unit rows.

    x = L'(z - y),   H = L L',   rows w_j = L^-1 a_j / |L^-1 a_j|

Rows so long or short that their squares over- or underflow are first scaled by powers of two.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, item_in_place
from torchfsid.kernels.linear import dot
from torchfsid.outcome import Status

OK, EMPTY, UNDEFINED = int(Status.OK), int(Status.EMPTY), int(Status.UNDEFINED)

SHORT, LONG = 1e-100, 1e100
"""Largest numbers that need no scaling."""


@item_in_place
@no_type_check
def power_of_two(largest):
    """The power of two that scales numbers up to `largest` exactly, so that their squares do not over- or underflow.

    It is 1 for most numbers.
    """
    if SHORT < largest < LONG or largest == 0.0 or not largest < np.inf:
        return 1.0
    _, exponent = math.frexp(largest)
    return math.ldexp(1.0, min(1 - exponent, 1023))


@item_in_place
@no_type_check
def scale_of(A, row):
    """The `power_of_two` of a row."""
    largest = 0.0
    for j in range(A.shape[1]):
        largest = max(largest, abs(A[row, j]))
    return power_of_two(largest)


@item
@no_type_check
def cholesky(H, L):
    """Fill L of H = L L'. Returns whether H is symmetric and positive definite."""
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
    """Replace v by L^-1 v."""
    for i in range(len(v)):
        for j in range(i):
            v[i] -= L[i, j] * v[j]
        v[i] /= L[i, i]


@item
@no_type_check
def unwhiten(L, x):
    """Replace x by L'^-1 x."""
    for i in range(len(x) - 1, -1, -1):
        for j in range(i + 1, len(x)):
            x[i] -= L[j, i] * x[j]
        x[i] /= L[i, i]


@item_in_place
@no_type_check
def to_frame(A, b, y, L, metric, unit, offsets, sizes, lengths):
    """Fill the rows in the frame of the point y and the metric L L'.

    Args:
        A: (m, p), the rows.
        b: (m,), their bounds.
        y: (p,), the point.
        L: (p, p), the Cholesky factor of the metric; not read without a `metric`.
        metric: whether there is a metric; without one it is the identity.
        unit: (m, p), to be filled with unit rows, 0 for zero rows.
        offsets: (m,), to be filled with bounds, infinite for zero rows.
        sizes: (m,), to be filled with the sizes of the numbers behind the offsets.
        lengths: (m, 2), to be filled with each row's power of two and the length of the scaled row in the frame.

    Returns:
        UNDEFINED if a number is not finite, EMPTY if a row 0.z <= b has b < 0, OK otherwise.
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


@item_in_place
@no_type_check
def from_frame(L, metric, y, z, x):
    """Fill the point z of x = L'(z - y). Returns the size of the numbers that z was computed from."""
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


@item_in_place
@no_type_check
def distance(A, b, row, z, lengths):
    """The value (a.z - b) / |a| of one row, with the lengths from `to_frame`."""
    scale = lengths[row, 0]
    over = -b[row] * scale
    for j in range(len(z)):
        over += A[row, j] * scale * z[j]
    return over / lengths[row, 1]
