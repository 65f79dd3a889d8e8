r"""Half-spaces of an unclipped nominal control in space in scalar code, one robot after the other.

This computes what `identification.saturation` computes in torch for controls in R^3. The theory is explained there, and
tests compare the two. P is cut out of the box of the limits before (`polyhedron.clip`).
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, launcher
from torchfsid.kernels.cones import EDGES, FAN, normals_in_space
from torchfsid.outcome import Status
from torchfsid.tolerances import ANGLE_TOLERANCE, ON_LIMIT

EMPTY = int(Status.EMPTY)
NORMALS = len(FAN) + EDGES
"""The largest number of normals of a cone."""


@item
@no_type_check
def highest(points, n, x, y, z):
    """The largest (x, y, z).v of n points; -inf if there are none."""
    most = -np.inf
    for i in range(n):
        most = max(most, x * points[i, 0] + y * points[i, 1] + z * points[i, 2])
    return most


@item
@no_type_check
def nearest_of(wishes, k, margin):
    """How far the hull of the possible nominal controls of robot k is from the origin at least, in sampled directions.

    These are the corners of an icosahedron, and the direction of the middle.
    """
    v, x, y, z, most = wishes.shape[1], 0.0, 0.0, 0.0, -np.inf
    for i in range(v):
        x, y, z = x + wishes[k, i, 0], y + wishes[k, i, 1], z + wishes[k, i, 2]
    size = math.sqrt(x * x + y * y + z * z)
    for e in range(len(FAN) + 1):
        if e < len(FAN):
            p, q, r = FAN[e, 0], FAN[e, 1], FAN[e, 2]
        else:
            p, q, r = (x / size, y / size, z / size) if size > 0 else (0.0, 0.0, 0.0)
        least = np.inf
        for i in range(v):
            least = min(least, p * wishes[k, i, 0] + q * wishes[k, i, 1] + r * wishes[k, i, 2])
        most = max(most, least)
    return most - margin


@item
@no_type_check
def touch_sphere(points, n, v, can_clip, outward):
    """Fill the directions of n vertices of P, if one of them is on the sphere of radius v. Returns their number."""
    largest, K = 0.0, 0
    for i in range(n if can_clip else 0):
        largest = max(largest, math.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2 + points[i, 2] ** 2))
    if not can_clip or n == 0 or largest < v * (1 - ON_LIMIT):
        return 0
    for i in range(n):
        size = math.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2 + points[i, 2] ** 2)
        if size > ON_LIMIT * v:
            outward[K, 0], outward[K, 1], outward[K, 2] = points[i, 0] / size, points[i, 1] / size, points[i, 2] / size
            K += 1
    return K


@item
@no_type_check
def touch_box(points, n, limits, wishes, k, margin, outward):
    """Fill the outward normals of the faces of a box that P touches, and beyond which some possible control is.

    Returns their number, and whether some possible control is beyond a face.
    """
    K, can_clip = 0, False
    for face in range(6):
        axis, sign, beyond, reached = face % 3, 1.0 if face < 3 else -1.0, -np.inf, -np.inf
        for i in range(wishes.shape[1]):
            beyond = max(beyond, sign * wishes[k, i, axis])
        if beyond + margin > limits[k, axis]:
            can_clip = True
            for i in range(n):
                reached = max(reached, sign * points[i, axis])
            if reached >= limits[k, axis] * (1 - ON_LIMIT):
                for j in range(3):
                    outward[K, j] = sign if j == axis else 0.0
                K += 1
    return K, can_clip


@item
@no_type_check
def unclipped_one(k, admissible, cut, nominal, clip, scratch, rows):
    """Fill the half-spaces of robot k in the results of `unclipped_in_space`. Returns their number."""
    own_A, own_b, own_source, no_row = admissible
    points, count, outcome, limits = cut
    C, d, wishes, margins = nominal
    by_norm, dead_speed = clip
    outward, order, normals, of = scratch
    _, row_b, row_source = rows
    margin, corners = margins[min(k, len(margins) - 1)], points[k]
    n = 0 if outcome[k] == EMPTY else 2 * count[k] - 4

    v, far = limits[k, 0], 0.0
    for i in range(wishes.shape[1]):
        far = max(far, math.sqrt(wishes[k, i, 0] ** 2 + wishes[k, i, 1] ** 2 + wishes[k, i, 2] ** 2))
    if by_norm:
        can_clip = far + margin > v
        K = touch_sphere(corners, n, v, can_clip, outward)
    else:
        K, can_clip = touch_box(corners, n, limits, wishes, k, margin, outward)
    if can_clip and K == 0 and n == 0:  # Q does not meet the admissible controls
        row_b[k, 0], row_source[k, 0] = -1.0, no_row
        return 1

    nearest = nearest_of(wishes, k, margin)
    idle = dead_speed > 0 and nearest <= dead_speed
    for i in range(own_b.shape[1]):
        idle = idle and own_b[k, i] >= -ON_LIMIT * dead_speed
    R = 0
    if K > 0:
        for i in range(K):
            order[i] = i
        for i in range(normals_in_space(outward, order, K, K, normals, of)):
            x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
            offset = highest(corners, n, x, y, z)
            if by_norm:
                on_limit = v * highest(outward, K, x, y, z)
                offset = on_limit if nearest > v else max(on_limit, offset)
            R = _add(k, R, x, y, z, max(offset, dead_speed) if idle else offset, margin, C, d, no_row, rows)
    for i in range(own_b.shape[1]):
        x, y, z = own_A[k, i, 0], own_A[k, i, 1], own_A[k, i, 2]
        if (x != 0 or y != 0 or z != 0) and highest(outward, K, x, y, z) <= ANGLE_TOLERANCE:
            offset = max(own_b[k, i], dead_speed) if idle else own_b[k, i]
            R = _add(k, R, x, y, z, offset, margin, C, d, own_source[k, i], rows)
    return R


@item
@no_type_check
def _add(k, R, x, y, z, offset, margin, C, d, of, rows):
    """Add the row (x, y, z).y <= offset + margin of y = C theta + d, over theta. Returns the number of rows."""
    row_A, row_b, row_source = rows
    for e in range(C.shape[2]):
        row_A[k, R, e] = x * C[k, 0, e] + y * C[k, 1, e] + z * C[k, 2, e]
    row_b[k, R] = offset + margin - x * d[k, 0] - y * d[k, 1] - z * d[k, 2]
    row_source[k, R] = of
    return R + 1


@item
@no_type_check
def rows_for(own):
    """The largest number of half-spaces, for so many rows of Q."""
    return NORMALS + own


def places(V: int) -> list[tuple[tuple[int, ...], type]]:
    """On a GPU: the shape and the type of a thread's entry in each array of scratch, for V vertices."""
    return [((max(V, 6), 3), np.float64), ((max(V, 6),), np.int64)]


@launcher
@no_type_check
def unclipped_in_space(admissible, cut, nominal, clip, informative):
    """The half-spaces of theta that follow from half-spaces of clipped nominal controls.

    Args:
        admissible: Q as unit rows A (B, R, 3), b (B, R) and their sources (B, R), and the source of all other rows.
        cut: Q within the box of the limits: the vertices (B, V, 3), the number of facets (B,) and the outcome (B,), as
            from `polyhedron.clip`, and the limits (B, 3).
        nominal: C (B, 3, p) and d (B, 3) of the nominal control, C theta + d at the vertices of Theta (B, v, 3), and
            the largest distance of the nominal control from their hull (B or 1,).
        clip: whether controls are clipped by norm, and the dead speed.
        informative: (B,), for which robots there are half-spaces.

    Returns:
        Half-spaces (A, b, source), padded.
    """
    (B, own), p, V, most = admissible[1].shape, nominal[0].shape[2], max(cut[0].shape[1], 6), 1
    R = rows_for(own)
    rows = np.zeros((B, R, p)), np.ones((B, R)), np.full((B, R), -1)
    scratch = np.empty((V, 3)), np.empty(V, np.int64), np.empty((NORMALS, 3)), np.empty(NORMALS, np.int64)
    for k in range(B):
        if informative[k]:
            most = max(most, unclipped_one(k, admissible, cut, nominal, clip, scratch, rows))
    row_A, row_b, row_source = rows
    return row_A[:, :most].copy(), row_b[:, :most].copy(), row_source[:, :most].copy()
