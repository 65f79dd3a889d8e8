r"""The largest disc in a polygon, one polygon at a time: max r s.t. n_i.z + r <= c_i, unit rows n_i.

The dual simplex method, in the form that the plane allows. A basis is three rows in counter-clockwise order whose
normals span the plane; with the weights w_i = n_j x n_k >= 0 (j, k the two rows after i) and their sum W,

    w_0 n_0 + w_1 n_1 + w_2 n_2 = 0,      r = (w_0 c_0 + w_1 c_1 + w_2 c_2) / W      (an upper bound of every radius).

The row that the disc violates most enters. Its normal lies between two normals of the basis, and one of these two
leaves, such that the remaining three span the plane. If both choices do (the third normal is opposite), the choice with
the larger W is taken. So no basis is singular unless all normals of the polygon are parallel to round-off.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, launcher
from torchfsid.tolerances import ROUND_OFF


@item
@no_type_check
def _turn(rows, i, j):
    """The product n_i x n_j with a small relative error: n_j - n_i or n_j + n_i is exact for nearly parallel rows."""
    p, q, r, s = rows[i, 0], rows[i, 1], rows[j, 0], rows[j, 1]
    if p * r + q * s > 0:
        return p * (s - q) - q * (r - p)
    return p * (s + q) - q * (r + p)


@item
@no_type_check
def inscribed_in(rows, right, n, basis, weight, turned):
    """A largest disc as (x, y, r, found). `basis` is filled with the three rows that decide it."""
    half = 1
    while half < n - 2 and _turn(rows, 0, half + 1) >= 0:
        half += 1
    basis[0], basis[1], basis[2] = 0, half, half + 1
    x = y = r = 0.0
    for _ in range(3 * n):
        x, y, r, scale = _touching(rows, right, basis, weight)
        worst, entering = -np.inf, 0
        for i in range(n):
            violation = rows[i, 0] * x + rows[i, 1] * y + r - right[i]
            if violation > worst:
                worst, entering = violation, i
        if not worst > ROUND_OFF * scale:
            # This is False also if the normals are parallel and the numbers are not finite.
            return x, y, r, worst <= ROUND_OFF * scale
        for s in range(3):
            turned[s] = _turn(rows, basis[s], entering)
        best, leaving = -1.0, -1
        for s in range(3):
            j, k = (s + 1) % 3, (s + 2) % 3
            if turned[s] >= 0 and turned[j] <= 0:  # it lies between these two
                if turned[k] >= 0 and weight[s] + turned[k] - turned[j] > best:
                    best, leaving = weight[s] + turned[k] - turned[j], s
                if turned[k] <= 0 and weight[j] - turned[k] + turned[s] > best:
                    best, leaving = weight[j] - turned[k] + turned[s], j
        if leaving < 0:
            break
        basis[leaving] = entering
    return x, y, r, False


@item
@no_type_check
def _touching(rows, right, basis, weight):
    """The disc that touches three rows, as (x, y, r, size) with the size of the numbers in it. Fills `weight`."""
    total = r = largest = scale = 0.0
    one = other = basis[0]
    for s in range(3):
        j, k = basis[(s + 1) % 3], basis[(s + 2) % 3]
        weight[s] = _turn(rows, j, k)
        total += weight[s]
        r += weight[s] * right[basis[s]]
        scale = max(scale, abs(right[basis[s]]))
        if weight[s] >= largest:  # the centre is computed from the two rows with the largest turn
            largest, one, other = weight[s], j, k
    r /= total
    # Solve across and along the first of them: then both hold to round-off, however small the turn.
    across, along = right[one] - r, rows[one, 0] * rows[other, 0] + rows[one, 1] * rows[other, 1]
    along = (right[other] - r - across * along) / largest
    x, y = across * rows[one, 0] - along * rows[one, 1], across * rows[one, 1] + along * rows[one, 0]
    return x, y, r, max(scale, abs(x) + abs(y) + abs(r))


@item
@no_type_check
def disc_one(k, vertices, A, b, count, scratch, centre, radius, basis, found):
    """A largest disc of polygon k, see `inscribed`. Scratch: (V, 2), (V,), (3,), (3,)."""
    rows, right, weight, turned = scratch
    n, x, y = count[k], 0.0, 0.0
    for i in range(n):  # relative to a point of the set, so that small sets far from the origin lose no digits
        x += vertices[k, i, 0] / n
        y += vertices[k, i, 1] / n
    for i in range(n):
        norm = math.sqrt(A[k, i, 0] ** 2 + A[k, i, 1] ** 2)
        if not 1e-150 < norm < 1e150:  # the squares have lost digits
            norm = math.hypot(A[k, i, 0], A[k, i, 1])
        rows[i, 0], rows[i, 1] = A[k, i, 0] / norm, A[k, i, 1] / norm
        right[i] = (b[k, i] - A[k, i, 0] * x - A[k, i, 1] * y) / norm
    step_x, step_y, r, found[k] = inscribed_in(rows, right, n, basis[k], weight, turned)
    radius[k] = max(r, 0.0)  # that of a flat set may be negative by round-off
    centre[k, 0], centre[k, 1] = x + step_x, y + step_y


@launcher
@no_type_check
def inscribed(vertices, A, b, count):
    """A largest inscribed disc of each polygon.

    Args:
        vertices: (B, V, 2).
        A: (B, V, 2), the rows of the edges.
        b: (B, V), their bounds.
        count: (B,), the number of edges.

    Returns:
        The centre (B, 2), the radius (B,), the rows that decide them (B, 3), and whether they were found (B,).
    """
    B, V = b.shape
    basis, centre, radius, found = np.zeros((B, 3), np.int64), np.zeros((B, 2)), np.zeros(B), np.zeros(B, np.bool_)
    scratch = np.empty((V, 2)), np.empty(V), np.empty(3), np.empty(3)
    for k in range(B):
        disc_one(k, vertices, A, b, count, scratch, centre, radius, basis, found)
    return centre, radius, basis, found
