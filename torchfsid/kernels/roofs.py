r"""Fewer facets: the facet whose removal adds the least volume is dropped, one by one, so that the set only grows.

Without the row of a facet f, the set grows by the roof over f: its facets g_0, g_1, ... around f are extended until
they meet. Let the row of f move outward. The ring around f shrinks, and edge i is the first to vanish where the point

    z_i on g_i-1, g_i and g_i+1     has the least height a_f.z_i - c_f.

There a new vertex closes facet g_i, and g_i-1 and g_i+1 are neighbours from then on. The last three facets of the ring
meet in the last new vertex. The roof's triangles and a point of f span its volume. If some ring never closes, or closes
far away, f is kept: without it the set would be open. Everything is computed in the frame of the set.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, launcher
from torchfsid.kernels.ring import after_in, before_in
from torchfsid.kernels.simple_polyhedron import along, determinant, find_facets, take_out
from torchfsid.kernels.solid import to_axes
from torchfsid.tolerances import PARALLEL_ROWS, ROUND_OFF

FAR = 100.0
"""A set that grows to more than this many times its size without a facet is taken to be unbounded without it."""

CLOSE = 1e-11
"""Share of the set's size by which a new vertex may exceed another facet of the roof."""

SHARP = 1e-3
"""Determinant of three unit rows below which their point is refined."""

UNKNOWN = -1.0
"""The cost of a facet that has to be computed."""

CANDIDATES = 3
"""Of the facets that could be dropped, this many, the smallest, are compared by the volume that they keep out."""


class Roof(NamedTuple):
    """A roof over a facet, and what it is computed from. Each array has a place for each line.

    Attributes:
        framed: the unit row, bound and round-off of each facet in the frame.
        cost: the volume that each facet keeps out.
        area: its area.
        tried: whether it has been considered.
        around: the facets around the facet.
        corner: the vertices around it.
        ring: those facets that have not vanished yet.
        start: the point where the edge of each of them on the ring begins.
        gap: the outer end of the edge that leaves the ring there: 3 v + j for near[v, j].
        meet: the point where each of them meets its neighbours.
        height: its height.
        apex: the new vertices.
        of_apex: their facets.
        joined: the ends of edges that each new vertex is joined with, opposite to its facets; -1 if a later vertex is
            joined with it there. From 3 V on, ends belong to new vertices.
    """

    framed: Any
    cost: Any
    area: Any
    tried: Any
    around: Any
    corner: Any
    ring: Any
    start: Any
    gap: Any
    meet: Any
    height: Any
    apex: Any
    of_apex: Any
    joined: Any


@launcher
@no_type_check
def roof_of(L):
    return Roof(
        np.zeros((L, 5)), np.zeros(L), np.zeros(L), np.zeros(L, np.bool_), np.zeros(L, np.int64),
        np.zeros(L, np.int64), np.zeros(L, np.int64), np.zeros((L, 3)), np.zeros(L, np.int64), np.zeros((L, 3)),
        np.zeros(L), np.zeros((L, 3)), np.zeros((L, 3), np.int64), np.zeros((L, 3), np.int64),
    )  # fmt: skip


@item
@no_type_check
def merge(graph, n, lines, most, reach, at, frame, roof):
    """Drop facets until `most` are left or none can be dropped. `reach` is enlarged to that of the larger set.

    Returns the number of vertices.
    """
    to_axes(graph.points, n, reach, frame.y, frame.middle, frame.axes, frame.scale)
    find_facets(graph.meets, n, at)
    for f in range(len(at)):
        if at[f] >= 0:
            _to_frame(lines, f, reach, frame, roof.framed)
            roof.cost[f] = UNKNOWN
            roof.area[f] = _area(graph, f, at[f], frame.y)
    while (n + 4) // 2 > most:
        f = _cheapest(graph, at, frame.y, roof)
        if f < 0:
            break
        # From another vertex on, ties may be broken otherwise than when the cost was found.
        roof.cost[f], k = _raise(graph, f, at, frame.y, roof)
        if roof.cost[f] == np.inf:
            continue
        n = _build(graph, n, f, k, reach, at, frame, roof)
        for i in range(k):
            e = roof.around[i]
            roof.cost[e], roof.area[e] = UNKNOWN, _area(graph, e, at[e], frame.y)
    return n


@item
@no_type_check
def _cheapest(graph, at, y, roof):
    """Of the smallest facets the one that keeps out the least volume; -1 if none can be dropped."""
    best, tried = -1, 0
    for f in range(len(at)):
        roof.tried[f] = at[f] < 0
    while tried < CANDIDATES or best < 0:
        f = -1
        for e in range(len(at)):
            if not roof.tried[e] and (f < 0 or roof.area[e] < roof.area[f]):
                f = e
        if f < 0:
            break
        tried, roof.tried[f] = tried + 1, True
        if roof.cost[f] == UNKNOWN:
            roof.cost[f] = _raise(graph, f, at, y, roof)[0]
        if roof.cost[f] < np.inf and (best < 0 or roof.cost[f] < roof.cost[best]):
            best = f
    return best


@item
@no_type_check
def _area(graph, f, first, y):
    """Four times the square of the area of facet f in the frame, from one of its vertices on."""
    last = along(graph.meets, graph.near, first, -1, f)
    v = along(graph.meets, graph.near, last, first, f)
    a = b = c = 0.0
    while v != first:
        p, q, r = y[last, 0] - y[first, 0], y[last, 1] - y[first, 1], y[last, 2] - y[first, 2]
        s, t, u = y[v, 0] - y[first, 0], y[v, 1] - y[first, 1], y[v, 2] - y[first, 2]
        a, b, c = a + q * u - r * t, b + r * s - p * u, c + p * t - q * s
        v, last = along(graph.meets, graph.near, v, last, f), v
    return a * a + b * b + c * c


@item
@no_type_check
def _to_frame(lines, f, reach, frame, framed):
    """Fill framed[f] with the unit row, the bound and the round-off of a facet in the frame."""
    squared, bound, size = 0.0, lines[f, 3], abs(lines[f, 3])
    for i in range(3):
        framed[f, i] = 0.0
        for j in range(3):
            framed[f, i] += lines[f, j] * frame.axes[i, j]
        framed[f, i] *= frame.scale[i]
        squared += framed[f, i] ** 2
        bound -= lines[f, i] * frame.middle[i]
        size += abs(lines[f, i]) * reach[i]
    length = math.sqrt(squared)
    for i in range(3):
        framed[f, i] /= length
    framed[f, 3], framed[f, 4] = bound / length, ROUND_OFF * size / length


@item
@no_type_check
def _raise(graph, f, at, y, roof):
    """Find the roof over facet f.

    Returns six times the volume that it adds in the frame, infinite if it is open, and the number of facets around f.
    """
    ring, gap, start, meet, height = roof.ring, roof.gap, roof.start, roof.meet, roof.height
    size, k = len(graph.points), _ring_around(graph, f, at[f], y, roof)
    base0, base1, base2 = start[0, 0], start[0, 1], start[0, 2]
    total, level, left, new, changed, changes = 0.0, -roof.framed[f, 4] - CLOSE, k, 0, 0, k
    while True:
        for _ in range(changes):
            _find_meet(roof, changed, left, f)
            changed = after_in(changed, left)
        i = -1
        for e in range(left if left > 3 else 1):
            if level <= height[e] and (i < 0 or height[e] < height[i]):
                i = e
        if i < 0 or not _is_inside(roof, i, left):
            return np.inf, k
        level, before, after = max(level, height[i]), before_in(i, left), after_in(i, left)
        # Two facets of a polyhedron meet in one edge: round-off must not add another one.
        if left > 3 and _meet_already(graph, ring[before], ring[after], at):
            return np.inf, k
        for e, to in ((before, i), (i, after), (after, after_in(after, left))):
            total += _over_triangle(start[e], start[to], meet[i], base0, base1, base2)
        for j in range(3):
            roof.apex[new, j] = meet[i, j]
        roof.of_apex[new, 0], roof.of_apex[new, 1], roof.of_apex[new, 2] = ring[before], ring[i], ring[after]
        roof.joined[new, 2], roof.joined[new, 0], roof.joined[new, 1] = gap[i], gap[after], -1
        if left == 3:
            roof.joined[new, 1] = gap[before]
            return abs(total), k
        gap[after] = 3 * (size + new) + 1  # the new vertex is where the edge of the next facet begins
        for j in range(3):
            start[after, j] = meet[i, j]
        for e in range(i, left - 1):
            ring[e], gap[e], height[e] = ring[e + 1], gap[e + 1], height[e + 1]
            for j in range(3):
                start[e, j], meet[e, j] = start[e + 1, j], meet[e + 1, j]
        new, left, changes = new + 1, left - 1, 2
        changed = before_in(i, left)


@item
@no_type_check
def _meet_already(graph, f, other, at):
    """Do two facets have an edge in common?"""
    first, before, v = at[f], -1, at[f]
    while True:
        for j in range(3):
            if graph.meets[v, j] == other:
                return True
        v, before = along(graph.meets, graph.near, v, before, f), v
        if v == first:
            return False


@item
@no_type_check
def _ring_around(graph, f, first, y, roof):
    """Fill around, corner, ring, start and gap for facet f with the vertex `first`. Returns the ring's length."""
    meets, near = graph.meets, graph.near
    v, before, k = first, -1, 0
    while True:
        after = along(meets, near, v, before, f)
        roof.corner[k] = v
        for j in range(3):
            roof.start[k, j] = y[v, j]
            if meets[v, j] == f:
                w = near[v, j]
                for i in range(3):
                    if near[w, i] == v:
                        roof.gap[k] = 3 * w + i
            elif near[v, j] != after:
                roof.ring[k] = roof.around[k] = meets[v, j]
        v, before, k = after, v, k + 1
        if v == first:
            return k


@item
@no_type_check
def _find_meet(roof, i, k, f):
    """Find the point where facet i of the ring meets its neighbours, and its height over f; -inf if they do not meet.

    By Cramer's rule from where its edge starts, with a step of refinement where the facets are nearly dependent.
    """
    framed, ring, z = roof.framed, roof.ring, roof.meet[i]
    u, v, w = framed[ring[before_in(i, k)]], framed[ring[i]], framed[ring[after_in(i, k)]]
    det = determinant(u, v, w)
    roof.height[i] = -np.inf
    if abs(det) <= PARALLEL_ROWS:
        return
    for j in range(3):
        z[j] = roof.start[i, j]
    for _ in range(1 if abs(det) > SHARP else 2):
        p, q, r = _room(u, z) / det, _room(v, z) / det, _room(w, z) / det
        for j in range(3):
            a, b = after_in(j, 3), before_in(j, 3)
            z[j] += p * (v[a] * w[b] - v[b] * w[a]) + q * (w[a] * u[b] - w[b] * u[a]) + r * (u[a] * v[b] - u[b] * v[a])
    if max(abs(z[0]), abs(z[1]), abs(z[2])) <= FAR:
        roof.height[i] = -_room(framed[f], z)


@item
@no_type_check
def _room(row, z):
    return row[3] - row[0] * z[0] - row[1] * z[1] - row[2] * z[2]


@item
@no_type_check
def _is_inside(roof, i, k):
    """Is the meet of facet i within all facets of the ring?"""
    for e in range(k):
        row = roof.framed[roof.ring[e]]
        if _room(row, roof.meet[i]) < -4 * row[4] - CLOSE:
            return False
    return True


@item
@no_type_check
def _over_triangle(p, q, z, x0, x1, x2):
    """Six times the volume between a triangle and a point."""
    a, b, c = p[0] - x0, p[1] - x1, p[2] - x2
    d, e, f = q[0] - x0, q[1] - x1, q[2] - x2
    g, h, i = z[0] - x0, z[1] - x1, z[2] - x2
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


@item
@no_type_check
def _build(graph, n, f, k, reach, at, frame, roof):
    """Replace the k vertices around facet f by the k - 2 vertices of the roof found last. Returns the vertex count."""
    points, meets, near = graph
    size, at[f] = len(points), -1
    for t in range(k - 2):
        v = roof.corner[t]
        for j in range(3):
            frame.y[v, j], meets[v, j], at[roof.of_apex[t, j]] = roof.apex[t, j], roof.of_apex[t, j], v
            points[v, j] = frame.middle[j]
            for i in range(3):
                points[v, j] += roof.apex[t, i] * frame.scale[i] * frame.axes[i, j]
            reach[j] = max(reach[j], abs(points[v, j]))
    for t in range(k - 2):
        for j in range(3):
            end = roof.joined[t, j]
            if end >= 0:
                v, w = roof.corner[t], end // 3 if end < 3 * size else roof.corner[end // 3 - size]
                near[v, j], near[w, end % 3] = w, v
    for v in (max(roof.corner[k - 1], roof.corner[k - 2]), min(roof.corner[k - 1], roof.corner[k - 2])):
        n = take_out(graph, v, n)
        if v < n:
            for j in range(3):
                frame.y[v, j], at[meets[v, j]] = frame.y[n, j], v
    return n
