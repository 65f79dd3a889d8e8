r"""Polygons in scalar code: what `clipping` and `polygon` do in torch, one polygon after the other, compiled by numba.

Of the rows that some vertex exceeds by more than round-off, the one that cut deepest at first cuts next:

    kept vertices  a.v - c <= tolerance: one arc of the ring, closed where the ring crosses the line
    none kept      EMPTY, if the row provably contradicts the two edges that meet at the vertex nearest to it
    none strictly  UNDECIDED: the row only touches, it is not used; likewise if nothing is proven

`clipping` is the reference; tests compare the two. Every tolerance is an argument: numba's cache of compiled code does
not see what changes in another file.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

compiled = njit(cache=True, error_model="numpy", nogil=True)  # no_type_check: these must stay plain functions
# Minima and maxima of finite numbers, in any order.
ordered = njit(cache=True, error_model="numpy", nogil=True, fastmath={"nnan", "nsz"})

NONEMPTY, UNDECIDED, EMPTY = 0, 1, 2  # `clipping.Outcome`


@ordered
@no_type_check
def _box(vertices, k, n):
    x0 = x1 = vertices[k, 0, 0]
    y0 = y1 = vertices[k, 0, 1]
    for i in range(1, n):
        x, y = vertices[k, i, 0], vertices[k, i, 1]
        x0, x1 = x if x < x0 else x0, x if x > x1 else x1
        y0, y1 = y if y < y0 else y0, y if y > y1 else y1
    return x0, x1, y0, y1


@ordered
@no_type_check
def _beyond(vertices, k, n, p, q, c):
    """How far the vertices reach beyond the line (p, q).z = c."""
    most = -np.inf
    for i in range(n):
        beyond = p * vertices[k, i, 0] + q * vertices[k, i, 1] - c
        most = beyond if beyond > most else most
    return most


@compiled
@no_type_check
def _any_cuts(vertices, k, n, reach, A, b, tolerance, depth, cutting, epsilon):
    """Mark the rows that some vertex exceeds by more than round-off; the bounding box spares many of them the loop."""
    x0, x1, y0, y1 = _box(vertices, k, n)
    found = False
    for r in range(b.shape[1]):
        p, q, c = A[k, r, 0], A[k, r, 1], b[k, r]
        cutting[r] = False
        if p * (x1 if p > 0 else x0) + q * (y1 if q > 0 else y0) - c > 0:
            tolerance[r] = epsilon * (abs(p) * reach[k, 0] + abs(q) * reach[k, 1] + abs(c))
            beyond = _beyond(vertices, k, n, p, q, c)
            cutting[r], depth[r] = beyond > tolerance[r], beyond / math.sqrt(p * p + q * q)
            found = found or cutting[r]
    return found


@compiled
@no_type_check
def _clip_ring(
    k, ring, edge, n, A, b, tolerance, depth, cutting, ring_A, ring_b, reach, epsilon, over, spare, spare_edge
):
    """Cut the ring of n vertices by the rows marked `cutting`, by their `depth`. Edges are numbered by the slots of
    `ring_A`, then by the rows.

    Returns (n, outcome, shrunk, and for EMPTY the row and the edges that contradict each other).
    """
    outcome, shrunk, first_row = NONEMPTY, False, ring_A.shape[1]
    while True:
        row = -1
        for r in range(b.shape[1]):
            if cutting[r] and (row < 0 or depth[r] > depth[row]):
                row = r
        if row < 0:
            return n, outcome, shrunk, -1, -1, -1
        cutting[row] = False
        slack, inner, outer = tolerance[row], 0, 0
        for i in range(n):
            over[i] = A[k, row, 0] * ring[i, 0] + A[k, row, 1] * ring[i, 1] - b[k, row]
            inner = i if over[i] < over[inner] else inner
            outer = i if over[i] > over[outer] else outer
        if over[outer] <= slack:  # an earlier cut has made it redundant
            continue
        if over[inner] > slack:
            before, after = edge[_before(inner, n)], edge[inner]
            first, second = _line(k, before, ring_A, ring_b, A, b), _line(k, after, ring_A, ring_b, A, b)
            if _contradict((A[k, row, 0], A[k, row, 1], b[k, row]), first, second, reach[k, 0], reach[k, 1], epsilon):
                return n, EMPTY, False, row, before, after
        if over[inner] >= -slack:
            outcome = UNDECIDED
            continue
        first = last = inner
        while over[_before(first, n)] <= slack:
            first = _before(first, n)
        while over[_after(last, n)] <= slack:
            last = _after(last, n)
        new, j = 0, first
        while True:
            spare[new, 0], spare[new, 1], spare_edge[new] = ring[j, 0], ring[j, 1], edge[j]
            new += 1
            if j == last:
                break
            j = _after(j, n)
        if over[last] < -slack:
            _cross(spare, new, ring, over, last, _after(last, n))
            new += 1
        spare_edge[new - 1] = first_row + row
        if over[first] < -slack:
            _cross(spare, new, ring, over, first, _before(first, n))
            spare_edge[new] = edge[_before(first, n)]
            new += 1
        n, shrunk = new, True
        _copy(spare, spare_edge, n, ring, edge)


@compiled
@no_type_check
def _line(k, e, ring_A, ring_b, A, b):
    """The line of an edge, by its number."""
    V = ring_A.shape[1]
    if e < V:
        return ring_A[k, e, 0], ring_A[k, e, 1], ring_b[k, e]
    return A[k, e - V, 0], A[k, e - V, 1], b[k, e - V]


@compiled
@no_type_check
def _contradict(row, first, second, reach_x, reach_y, epsilon):
    """`clipping._contradict`, of three lines (p, q, c)."""
    turn = first[0] * second[1] - first[1] * second[0]
    along = row[0] * first[0] + row[1] * first[1], row[0] * second[0] + row[1] * second[1]
    for proof in range(3):
        y = z = 0.0
        if proof == 0 and turn != 0:
            y = (second[0] * row[1] - second[1] * row[0]) / turn
            z = (row[0] * first[1] - row[1] * first[0]) / turn
        elif proof == 1:
            y = -along[0] / (first[0] * first[0] + first[1] * first[1])
        elif proof == 2:
            z = -along[1] / (second[0] * second[0] + second[1] * second[1])
        y, z = max(y, 0.0), max(z, 0.0)
        p, q = row[0] + y * first[0] + z * second[0], row[1] + y * first[1] + z * second[1]
        noise = abs(p) * reach_x + abs(q) * reach_y
        for weight, line in ((1.0, row), (y, first), (z, second)):
            noise += epsilon * weight * (abs(line[0]) * reach_x + abs(line[1]) * reach_y + abs(line[2]))
        if row[2] + y * first[2] + z * second[2] < -noise:
            return True
    return False


@compiled
@no_type_check
def _after(i, n):
    return i + 1 if i < n - 1 else 0


@compiled
@no_type_check
def _before(i, n):
    return i - 1 if i > 0 else n - 1


@compiled
@no_type_check
def _copy(spare, spare_edge, n, ring, edge):
    for i in range(n):
        ring[i, 0], ring[i, 1], edge[i] = spare[i, 0], spare[i, 1], spare_edge[i]


@compiled
@no_type_check
def _cross(points, k, ring, over, inner, outer):
    share = over[inner] / (over[inner] - over[outer])
    for i in range(2):
        points[k, i] = ring[inner, i] + share * (ring[outer, i] - ring[inner, i])


@compiled
@no_type_check
def _merge_ring(ring, edge, n, most, lines, parallel, spare, spare_edge):
    """Drop the edge whose removal adds least area until `most` are left, or none can be dropped."""
    while n > most:
        best, dropped, cx, cy = np.inf, -1, 0.0, 0.0
        for i in range(n):
            end = _after(i, n)
            before, after = edge[_before(i, n)], edge[end]
            p, q, r, s = lines[before, 0], lines[before, 1], lines[after, 0], lines[after, 1]
            turn = p * s - q * r
            if turn > parallel * math.sqrt(p * p + q * q) * math.sqrt(r * r + s * s):
                x, y = ring[end, 0] - ring[i, 0], ring[end, 1] - ring[i, 1]
                extended = (x * r + y * s) / turn
                added = -extended * (p * x + q * y)
                if added < best:
                    best, dropped = added, i
                    cx, cy = ring[i, 0] - extended * q, ring[i, 1] + extended * p
        if dropped < 0:
            return n
        old = dropped
        for i in range(n - 1):
            old = _after(old, n)
            spare[i, 0], spare[i, 1], spare_edge[i] = ring[old, 0], ring[old, 1], edge[old]
        n -= 1
        spare[0, 0], spare[0, 1] = cx, cy
        _copy(spare, spare_edge, n, ring, edge)
    return n


@compiled
@no_type_check
def _area(ring, n):
    total = 0.0
    for i in range(1, n - 1):
        p, q = ring[i, 0] - ring[0, 0], ring[i, 1] - ring[0, 1]
        total += (p * (ring[i + 1, 1] - ring[0, 1]) - q * (ring[i + 1, 0] - ring[0, 0])) / 2
    return total


@compiled
@no_type_check
def _widened(polygons, slots):
    """A copy with room for `slots` vertices; new slots repeat the first vertex and carry padding rows."""
    vertices, A, b, time, source, count, reach = polygons
    B, V = b.shape
    wide_vertices, wide_A, wide_b = np.empty((B, slots, 2)), np.empty((B, slots, 2)), np.empty((B, slots))
    wide_time, wide_source, wide_count = np.empty((B, slots)), np.empty((B, slots), np.int64), np.empty(B, np.int64)
    for k in range(B):
        wide_count[k] = count[k]
        for i in range(slots):
            j = i if i < V else 0
            wide_vertices[k, i, 0], wide_vertices[k, i, 1] = vertices[k, j, 0], vertices[k, j, 1]
            if i < V:
                wide_A[k, i, 0], wide_A[k, i, 1], wide_b[k, i] = A[k, i, 0], A[k, i, 1], b[k, i]
                wide_time[k, i], wide_source[k, i] = time[k, i], source[k, i]
            else:
                wide_A[k, i, 0], wide_A[k, i, 1], wide_b[k, i] = 0.0, 0.0, 1.0
                wide_time[k, i], wide_source[k, i] = np.nan, -1
    return wide_vertices, wide_A, wide_b, wide_time, wide_source, wide_count, reach


@compiled
@no_type_check
def _small(k, ring, edge, n, ring_A, A, most, parallel, lines, spare, spare_edge):
    """Merge a ring that has more than `most` edges."""
    V, R = ring_A.shape[1], A.shape[1]
    for i in range(V):
        lines[i, 0], lines[i, 1] = ring_A[k, i, 0], ring_A[k, i, 1]
    for i in range(R):
        lines[V + i, 0], lines[V + i, 1] = A[k, i, 0], A[k, i, 1]
    return _merge_ring(ring, edge, n, most, lines, parallel, spare, spare_edge)


@compiled
@no_type_check
def clip(polygons, A, b, stamp, source, most, epsilon, parallel):
    """All polygons (vertices, A, b, time, source, count, reach) by their rows A (B, R, 2), b and source (B, R).

    Returns (polygons, outcome, shrunk, contradiction): the same polygons, not copied, if none was cut. Those that have
    more than `most` edges then are merged, or stay as they were if that costs what the cut has gained.
    """
    vertices, ring_A, ring_b, time, ring_source, count, reach = polygons
    (B, R), V = b.shape, ring_b.shape[1]
    W = V + R + 1
    tolerance, depth, cutting, over = np.empty(R), np.empty(R), np.empty(R, np.bool_), np.empty(W)
    ring, spare, lines = np.empty((W, 2)), np.empty((W, 2)), np.empty((W, 2))
    edge, spare_edge = np.empty(W, np.int64), np.empty(W, np.int64)
    result, slots = polygons, 0
    to_vertices, to_A, to_b, to_time, to_source, to_count, _ = polygons
    outcome, shrunk = np.zeros(B, np.int64), np.zeros(B, np.bool_)
    lost_A, lost_b = np.full((B, 3, 2), np.nan), np.full((B, 3), np.nan)
    lost_time, lost_source = np.full((B, 3), np.nan), np.full((B, 3), -1)
    for k in range(B):
        n = count[k]
        if not _any_cuts(vertices, k, n, reach, A, b, tolerance, depth, cutting, epsilon):
            continue
        for i in range(n):
            ring[i, 0], ring[i, 1], edge[i] = vertices[k, i, 0], vertices[k, i, 1], i
        n, outcome[k], shrunk[k], row, before, after = _clip_ring(
            k, ring, edge, n, A, b, tolerance, depth, cutting, ring_A, ring_b, reach, epsilon, over, spare, spare_edge
        )
        if outcome[k] == EMPTY:
            for i, e in enumerate((V + row, before, after)):
                if e >= V:
                    lost_A[k, i, 0], lost_A[k, i, 1], lost_b[k, i] = A[k, e - V, 0], A[k, e - V, 1], b[k, e - V]
                    lost_time[k, i], lost_source[k, i] = stamp[k], source[k, e - V]
                else:
                    lost_A[k, i, 0], lost_A[k, i, 1], lost_b[k, i] = ring_A[k, e, 0], ring_A[k, e, 1], ring_b[k, e]
                    lost_time[k, i], lost_source[k, i] = time[k, e], ring_source[k, e]
        if shrunk[k] and n > most:
            n = _small(k, ring, edge, n, ring_A, A, most, parallel, lines, spare, spare_edge)
            # The areas are sums in some order.
            shrunk[k] = _area(ring, n) <= _area(vertices[k], count[k]) * (1 - epsilon)
        if not shrunk[k]:
            continue
        if n > slots:  # seldom: room grows by eight, and all polygons are copied
            slots = max((n + 7) // 8 * 8, V)
            result = _widened(result, slots)
            to_vertices, to_A, to_b, to_time, to_source, to_count, _ = result
        to_count[k] = n
        for i in range(slots):
            j = i if i < n else 0
            to_vertices[k, i, 0], to_vertices[k, i, 1] = ring[j, 0], ring[j, 1]
        for i in range(max(n, count[k])):
            e = edge[i] if i < n else -1
            if e >= V:
                to_A[k, i, 0], to_A[k, i, 1], to_b[k, i] = A[k, e - V, 0], A[k, e - V, 1], b[k, e - V]
                to_time[k, i], to_source[k, i] = stamp[k], source[k, e - V]
            elif e >= 0:
                to_A[k, i, 0], to_A[k, i, 1], to_b[k, i] = ring_A[k, e, 0], ring_A[k, e, 1], ring_b[k, e]
                to_time[k, i], to_source[k, i] = time[k, e], ring_source[k, e]
            else:
                to_A[k, i, 0], to_A[k, i, 1], to_b[k, i], to_time[k, i], to_source[k, i] = 0.0, 0.0, 1.0, np.nan, -1
    return result, outcome, shrunk, (lost_A, lost_b, lost_time, lost_source)
