r"""How far a set reaches: its two farthest vertices, and whether points are inside, one set at a time.

A point z is inside where (a_j.z - b_j) / |a_j| is at most round-off plus a share of the diameter, for every row j. The
diameter is computed only for a set that has a point outside by more than round-off.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, launcher
from torchfsid.kernels.frame import power_of_two, scale_of
from torchfsid.tolerances import ROUND_OFF


@item
@no_type_check
def farthest_apart(vertices):
    """The first pair of vertices with the largest distance, as (vertex, vertex, distance)."""
    V, p = vertices.shape
    largest = 0.0
    for i in range(1, V):
        for j in range(p):
            largest = max(largest, abs(vertices[i, j] - vertices[0, j]))
    scale = power_of_two(largest)
    one, other, most = 0, 0, 0.0
    for i in range(V):
        for k in range(i + 1, V):
            squared = 0.0
            for j in range(p):
                squared += ((vertices[i, j] - vertices[k, j]) * scale) ** 2
            if squared > most:
                one, other, most = i, k, squared
    return one, other, math.sqrt(most) / scale


@item
@no_type_check
def outside_by(A, b, z):
    """The largest (a_j.z - b_j) / |a_j| of the rows; NaN if a number is not finite."""
    most = -np.inf
    for r in range(len(b)):
        scale, squared = scale_of(A, r), 0.0
        over = -b[r] * scale
        for j in range(len(z)):
            over += A[r, j] * scale * z[j]
            squared += (A[r, j] * scale) ** 2
        distance = over / math.sqrt(squared) if squared > 0.0 else over
        if not math.isfinite(distance):
            return np.nan
        most = max(most, distance)
    return most


@item
@no_type_check
def farthest_one(i, vertices, ends, distance):
    """The two farthest vertices of set i, see `farthest`."""
    ends[i, 0], ends[i, 1], distance[i] = farthest_apart(vertices[i])


@item
@no_type_check
def contains_one(i, vertices, A, b, reach, points, tolerance, inside):
    """Whether points are in set i, see `contains`."""
    K, p = points.shape[1], points.shape[2]
    diameter, size = -1.0, 0.0
    for j in range(p):
        size += 2.0 * reach[i, j]
    for k in range(K):
        largest = 0.0
        for j in range(p):
            largest = max(largest, abs(points[i, k, j]))
        over, margin = outside_by(A[i], b[i], points[i, k]), ROUND_OFF * (largest + size)
        if over > margin:
            if diameter < 0.0:
                _, _, diameter = farthest_apart(vertices[i])
            margin += tolerance * diameter
        inside[i, k] = over <= margin


@launcher
@no_type_check
def farthest(vertices):
    """The numbers (B, 2) of the two farthest vertices of each set and their distance (B,), from vertices (B, V, p)."""
    ends, distance = np.empty((len(vertices), 2), np.int64), np.empty(len(vertices))
    for i in range(len(vertices)):
        farthest_one(i, vertices, ends, distance)
    return ends, distance


@launcher
@no_type_check
def contains(vertices, A, b, reach, points, tolerance):
    """Whether points are in sets, up to round-off and `tolerance` times the diameter of the set.

    Args:
        vertices: (B, V, p).
        A: (B, F, p), the rows of the sets.
        b: (B, F), their bounds.
        reach: (B, p), the largest |coordinates| that the set ever had.
        points: (B, K, p), K points for each set.
        tolerance: the share of the diameter.

    Returns:
        (inside,): a mask (B, K).
    """
    inside = np.empty(points.shape[:2], np.bool_)
    for i in range(len(inside)):
        contains_one(i, vertices, A, b, reach, points, tolerance, inside)
    return (inside,)
