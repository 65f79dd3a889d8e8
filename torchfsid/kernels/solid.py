r"""Principal axes, volume, centroid and extreme vertices of simple polyhedra, and the triangles that fill their facets.

The frame of a set is z = middle + (y * scale) axes, with the principal axes of its vertices. In it a thin set is as
wide as it is long, and so its measure does not suffer from round-off. The pyramids from the middle over the facets fill
the set, and the triangles from a facet's first vertex fill the facet:

    V = sum_f |sum det(y_0, y_i, y_i+1)| / 6,     centroid = sum_f |det| (y_0 + y_i + y_i+1) / (24 V)
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, launcher
from torchfsid.kernels.frame import power_of_two
from torchfsid.kernels.linear import orthogonalise
from torchfsid.kernels.simple_polyhedron import along, determinant, find_facets, link
from torchfsid.tolerances import FLAT, PARALLEL_ROWS, ROUND_OFF

SWEEPS = 30
"""Sweeps of rotations after which the principal axes are taken as they are. Two to four are usual."""

TILTED = 1e-3
"""Cosine of the angle between two columns of coordinates below which the axes are principal axes, well enough."""

TIED = 1e-9
"""Share of the set's size by which vertices may be less far than the farthest one and still be compared with it."""


class Frame(NamedTuple):
    """The vertices in the frame, y (V, 3), and the frame: middle (3,), axes (3, 3) and scale (3,)."""

    y: Any
    middle: Any
    axes: Any
    scale: Any


@launcher
@no_type_check
def frame_of(V):
    return Frame(np.zeros((V, 3)), np.zeros(3), np.zeros((3, 3)), np.zeros(3))


@item
@no_type_check
def to_axes(points, n, reach, y, middle, axes, scale):
    """Fill y (n, 3), middle, axes and scale of the frame. The axes are found by Jacobi's rotations of the columns of y.

    Returns the number of directions in which the set is thicker than round-off. They come first.
    """
    size = 0.0
    for j in range(3):
        middle[j] = 0.0
        for v in range(n):
            y[v, j] = points[v, j] - points[0, j]
            middle[j] += y[v, j] / n
        for v in range(n):
            y[v, j] -= middle[j]
            size = max(size, abs(y[v, j]))
        middle[j] += points[0, j]
        for i in range(3):
            axes[i, j] = 1.0 if i == j else 0.0
    unit = power_of_two(size)
    for v in range(n):
        for j in range(3):
            y[v, j] *= unit
    for _ in range(SWEEPS):
        if not _rotate_all(y, n, axes):
            break
    largest, floor, wide = max(reach[0], reach[1], reach[2]), 0.0, 0
    floor = ROUND_OFF / 8 * largest
    for j in range(3):
        total = 0.0
        for v in range(n):
            total += y[v, j] * y[v, j]
        scale[j] = math.sqrt(total / n) / unit
        if scale[j] > FLAT * largest:
            if wide < j:
                _swap(y, n, axes, scale, wide, j)
            wide += 1
    for j in range(3):
        scale[j] = max(scale[j], floor)
        for v in range(n):
            y[v, j] /= unit * scale[j]
    return wide


@item
@no_type_check
def _swap(y, n, axes, scale, i, j):
    for v in range(n):
        y[v, i], y[v, j] = y[v, j], y[v, i]
    for k in range(3):
        axes[i, k], axes[j, k] = axes[j, k], axes[i, k]
    scale[i], scale[j] = scale[j], scale[i]


@item
@no_type_check
def _rotate_all(y, n, axes):
    """One sweep: make each pair of columns of y orthogonal. Returns whether a pair was not."""
    turned = False
    for i in range(2):
        for j in range(i + 1, 3):
            a = b = c = 0.0
            for v in range(n):
                a += y[v, i] * y[v, i]
                b += y[v, j] * y[v, j]
                c += y[v, i] * y[v, j]
            if abs(c) <= TILTED * math.sqrt(a) * math.sqrt(b):
                continue
            turned = True
            half = (b - a) / (2 * c)
            t = math.copysign(1.0, half) / (abs(half) + math.sqrt(1 + half * half))
            cosine = 1 / math.sqrt(1 + t * t)
            sine = t * cosine
            for v in range(n):
                y[v, i], y[v, j] = cosine * y[v, i] - sine * y[v, j], sine * y[v, i] + cosine * y[v, j]
            for k in range(3):
                axes[i, k], axes[j, k] = (
                    cosine * axes[i, k] - sine * axes[j, k],
                    sine * axes[i, k] + cosine * axes[j, k],
                )
    return turned


@item
@no_type_check
def volume_of(y, meets, near, at, wide, centre):
    """The volume in the frame. Fills `centre` with the centroid in the frame, that of a flat set in its `wide` axes.

    A flat set is covered twice by the shadows of its facets. For a segment the centre is its middle, for a point 0.
    """
    total, shade = 0.0, 0.0
    m0 = m1 = m2 = s0 = s1 = 0.0
    for f in range(len(at)):
        if at[f] < 0:
            continue
        first = at[f]
        last = along(meets, near, first, -1, f)
        v = along(meets, near, last, first, f)
        part = p0 = p1 = p2 = dark = d0 = d1 = 0.0
        while v != first:
            share = determinant(y[first], y[last], y[v])
            part += share
            p0 += share * (y[first, 0] + y[last, 0] + y[v, 0])
            p1 += share * (y[first, 1] + y[last, 1] + y[v, 1])
            p2 += share * (y[first, 2] + y[last, 2] + y[v, 2])
            if wide == 2:
                share = (y[last, 0] - y[first, 0]) * (y[v, 1] - y[first, 1])
                share -= (y[last, 1] - y[first, 1]) * (y[v, 0] - y[first, 0])
                dark += share
                d0 += share * (y[first, 0] + y[last, 0] + y[v, 0])
                d1 += share * (y[first, 1] + y[last, 1] + y[v, 1])
            v, last = along(meets, near, v, last, f), v
        sign, shadow = math.copysign(1.0, part), math.copysign(1.0, dark)
        total, m0, m1, m2 = total + sign * part, m0 + sign * p0, m1 + sign * p1, m2 + sign * p2
        shade, s0, s1 = shade + shadow * dark, s0 + shadow * d0, s1 + shadow * d1
    centre[0] = centre[1] = centre[2] = 0.0
    if wide == 3 and total > 0:
        centre[0], centre[1], centre[2] = m0 / total / 4, m1 / total / 4, m2 / total / 4
    elif wide == 2 and shade > 0:
        centre[0], centre[1] = s0 / shade / 3, s1 / shade / 3
    return total / 6


@launcher
@no_type_check
def measures(points, meets, count, reach):
    """Frames and measures of polyhedra with vertices `points` (B, V, 3), as in `polyhedron.clip`.

    Returns:
        The frame as y (B, V, 3), middle (B, 3), axes (B, 3, 3), scale (B, 3) and the number of directions in which the
        set is thicker than round-off (B,), its first axes. Then the volume (B,) and the centroid (B, 3) in the frame.
    """
    (B, V, _), F = points.shape, (points.shape[1] + 4) // 2
    result = (
        np.zeros((B, V, 3)), np.empty((B, 3)), np.empty((B, 3, 3)), np.empty((B, 3)), np.empty(B, np.int64),
        np.empty(B), np.empty((B, 3)),
    )  # fmt: skip
    graph = graph_of_one(F, V)
    for k in range(B):
        measure_one(k, points, meets, count, reach, graph, result)
    return result


@launcher
@no_type_check
def graph_of_one(F, V):
    """Scratch for the graph of one polyhedron: edges (all -1), near and at (`simple_polyhedron`)."""
    return np.full((F, F), -1), np.empty((V, 3), np.int64), np.empty(F, np.int64)


def graph_places(F: int, V: int) -> list[tuple[tuple[int, ...], type]]:
    """On a GPU: the shape and the type of a thread's entry in each of these arrays."""
    return [((F, F), np.int32), ((V, 3), np.int32), ((F,), np.int32)]


@item
@no_type_check
def measure_one(k, points, meets, count, reach, graph, result):
    """Fill the places of polyhedron k in the results of `measures`."""
    y, middle, axes, scale, wide, volume, centre = result
    edges, near, at = graph
    n = 2 * count[k] - 4
    link(meets[k], n, edges, near)
    find_facets(meets[k], n, at)
    wide[k] = to_axes(points[k], n, reach[k], y[k], middle[k], axes[k], scale[k])
    volume[k] = volume_of(y[k], meets[k], near, at, wide[k], centre[k])
    if wide[k] == 1:
        low = high = y[k, 0, 0]
        for v in range(n):
            low, high = min(low, y[k, v, 0]), max(high, y[k, v, 0])
        centre[k, 0] = (low + high) / 2
    for v in range(n, y.shape[1]):
        for j in range(3):
            y[k, v, j] = y[k, 0, j]


@launcher
@no_type_check
def skeleton(meets, count, wide, rows):
    """What derivatives need, from the facets' unit rows (B, F, 3) in the frame.

    Returns:
        The triangles that fill the facets, as vertices (B, 4 F - 12, 3) and facets (B, 4 F - 12), padded with triangles
        that repeat a vertex. A flat set has only such ones. And whether the three facets of each vertex are
        independent (B, V).
    """
    (B, V, _), F = meets.shape, rows.shape[1]
    triangles = max(4 * F - 12, 0)
    result = np.empty((B, triangles, 3), np.int64), np.empty((B, triangles), np.int64), np.empty((B, V), np.bool_)
    graph, small = graph_of_one(F, V), (np.empty((3, 3)), np.empty(3), np.empty(3))
    for k in range(B):
        skeleton_one(k, meets, count, wide, rows, graph, small, result)
    return result


@item
@no_type_check
def skeleton_one(k, meets, count, wide, rows, graph, small, result):
    """Fill the places of polyhedron k in the results of `skeleton`. `small` are places (3, 3), (3,) and (3,)."""
    corners, facet, independent = result
    (edges, near, at), (Q, D, share) = graph, small
    n, new = 2 * count[k] - 4, 0
    link(meets[k], n, edges, near)
    find_facets(meets[k], n, at)
    for f in range(count[k] if wide[k] == 3 else 0):
        first = at[f]
        last = along(meets[k], near, first, -1, f)
        v = along(meets[k], near, last, first, f)
        while v != first:
            corners[k, new, 0], corners[k, new, 1], corners[k, new, 2], facet[k, new] = first, last, v, f
            new += 1
            v, last = along(meets[k], near, v, last, f), v
    for t in range(new, facet.shape[1]):
        corners[k, t, 0], corners[k, t, 1], corners[k, t, 2], facet[k, t] = 0, 0, 0, 0
    for v in range(independent.shape[1]):
        independent[k, v] = v < n
        for s in range(3 if v < n else 0):
            for j in range(3):
                Q[s, j] = rows[k, meets[k, v, s], j]
            squared = orthogonalise(Q[s], Q, D, s, share)
            D[s] = 1 / squared if squared > 0 else 0.0
            independent[k, v] &= squared > PARALLEL_ROWS**2


@launcher
@no_type_check
def extreme(meets, vertices, y, rows, direction):
    """For each direction (B, D, 3) in the frame the number (B, D) of a vertex that is extreme there.

    Of the vertices tied for it, it is the one whose facets' unit rows (B, F, 3) combine to the direction with weights
    >= 0, or are nearest to that. `vertices` (B,) is the number of vertices.
    """
    B, D, _ = direction.shape
    found = np.empty((B, D), np.int64)
    for k in range(B):
        for d in range(D):
            found[k, d] = extreme_of(k, meets, vertices[k], y, rows, direction[k, d])
    return found


@item
@no_type_check
def extreme_of(k, meets, n, y, rows, g):
    """The vertex of polyhedron k, of n, that is extreme in the direction g."""
    most, size, best, found = -np.inf, 0.0, -np.inf, 0
    for v in range(n):
        reached = y[k, v, 0] * g[0] + y[k, v, 1] * g[1] + y[k, v, 2] * g[2]
        most, size = max(most, reached), max(size, abs(reached))
    for v in range(n):
        if y[k, v, 0] * g[0] + y[k, v, 1] * g[1] + y[k, v, 2] * g[2] < most - TIED * size:
            continue
        p, q, r = rows[k, meets[k, v, 0]], rows[k, meets[k, v, 1]], rows[k, meets[k, v, 2]]
        det = determinant(p, q, r)
        weight = -np.inf
        if abs(det) > PARALLEL_ROWS:
            s, t, u = determinant(g, q, r) / det, determinant(p, g, r) / det, determinant(p, q, g) / det
            weight = min(s, t, u) / max(abs(s), abs(t), abs(u))
        if best == -np.inf or weight > best:
            found, best = v, weight
    return found
