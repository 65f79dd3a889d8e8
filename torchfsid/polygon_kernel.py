r"""Polygons in scalar code: what `clipping` and `polygon` do in torch, one polygon after the other, compiled by numba.

Of the rows that some vertex exceeds by more than round-off, the one that cuts deepest cuts next:

    kept vertices  a.v - c <= tolerance: one arc of the ring, closed where the ring crosses the line
    none kept      EMPTY: the row contradicts the two edges that meet at the vertex nearest to it
    none strictly  UNDECIDED: the row only touches, it is not used

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
def _any_cuts(vertices, k, n, reach, A, b, tolerance, cutting, epsilon):
    """Mark the rows that some vertex exceeds by more than round-off; the bounding box spares many of them the loop."""
    x0, x1, y0, y1 = _box(vertices, k, n)
    found = False
    for r in range(b.shape[1]):
        p, q, c = A[k, r, 0], A[k, r, 1], b[k, r]
        cutting[r] = False
        if p * (x1 if p > 0 else x0) + q * (y1 if q > 0 else y0) - c > 0:
            tolerance[r] = epsilon * (abs(p) * reach[k, 0] + abs(q) * reach[k, 1] + abs(c))
            cutting[r] = _beyond(vertices, k, n, p, q, c) > tolerance[r]
            found = found or cutting[r]
    return found


@compiled
@no_type_check
def _clip_ring(ring, edge, n, A, b, tolerance, cutting, first_row, over, spare, spare_edge):
    """Cut the ring of n vertices by the rows marked `cutting`, deepest first; row r makes the edge first_row + r.

    Returns (n, outcome, shrunk, and for EMPTY the row and the edges that contradict each other).
    """
    outcome, shrunk = NONEMPTY, False
    while True:
        row, deepest = -1, 0.0
        for r in range(len(b)):
            if cutting[r]:
                beyond = -np.inf
                for i in range(n):
                    beyond = max(beyond, A[r, 0] * ring[i, 0] + A[r, 1] * ring[i, 1] - b[r])
                cutting[r] = beyond > tolerance[r]
                depth = beyond / math.sqrt(A[r, 0] ** 2 + A[r, 1] ** 2)
                if cutting[r] and depth > deepest:
                    row, deepest = r, depth
        if row < 0:
            return n, outcome, shrunk, -1, -1, -1
        cutting[row] = False
        slack, inner = tolerance[row], 0
        for i in range(n):
            over[i] = A[row, 0] * ring[i, 0] + A[row, 1] * ring[i, 1] - b[row]
            if over[i] < over[inner]:
                inner = i
        if over[inner] > slack:
            return n, EMPTY, False, row, edge[(inner - 1) % n], edge[inner]
        if over[inner] >= -slack:
            outcome = UNDECIDED
            continue
        first = last = inner
        while over[(first - 1) % n] <= slack:
            first = (first - 1) % n
        while over[(last + 1) % n] <= slack:
            last = (last + 1) % n
        k = 0
        for i in range((last - first) % n + 1):
            j = (first + i) % n
            spare[k, 0], spare[k, 1], spare_edge[k] = ring[j, 0], ring[j, 1], edge[j]
            k += 1
        if over[last] < -slack:
            _cross(spare, k, ring, over, last, (last + 1) % n)
            k += 1
        spare_edge[k - 1] = first_row + row
        if over[first] < -slack:
            _cross(spare, k, ring, over, first, (first - 1) % n)
            spare_edge[k] = edge[(first - 1) % n]
            k += 1
        n, shrunk = k, True
        _copy(spare, spare_edge, n, ring, edge)


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
            before, after = edge[(i - 1) % n], edge[(i + 1) % n]
            p, q, r, s = lines[before, 0], lines[before, 1], lines[after, 0], lines[after, 1]
            turn = p * s - q * r
            if turn > parallel * math.sqrt(p * p + q * q) * math.sqrt(r * r + s * s):
                x, y = ring[(i + 1) % n, 0] - ring[i, 0], ring[(i + 1) % n, 1] - ring[i, 1]
                extended = (x * r + y * s) / turn
                added = -extended * (p * x + q * y)
                if added < best:
                    best, dropped = added, i
                    cx, cy = ring[i, 0] - extended * q, ring[i, 1] + extended * p
        if dropped < 0:
            return n
        n -= 1
        for i in range(n):
            old = (dropped + 1 + i) % (n + 1)
            spare[i, 0], spare[i, 1], spare_edge[i] = ring[old, 0], ring[old, 1], edge[old]
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
def _scratch(V, R):
    """Room to clip a ring of V vertices by R rows."""
    W = V + R + 1
    return (
        np.empty(R), np.empty(R, np.bool_), np.empty((W, 2)), np.empty(W, np.int64), np.empty(W), np.empty((W, 2)),
        np.empty(W, np.int64), np.empty((W, 2)),
    )  # fmt: skip


@compiled
@no_type_check
def _no_contradiction(B):
    return np.full((B, 3, 2), np.nan), np.full((B, 3), np.nan), np.full((B, 3), np.nan), np.full((B, 3), -1)


@compiled
@no_type_check
def _clip_one(k, given, result, fresh, A, b, stamp, source, most, epsilon, parallel, scratch, found):
    """Clip polygon k by the rows marked in the scratch and merge what is beyond `most` edges.

    `result` is `given` itself until the first polygon is really cut; then it is a `fresh` copy, which grows on demand.
    `found` = (A, b, time, source) takes the rows of a contradiction. Returns (result, outcome, shrunk).
    """
    vertices, ring_A, ring_b, time, ring_source, count, _ = given
    tolerance, cutting, ring, edge, over, spare, spare_edge, lines = scratch
    n, V, R = count[k], ring_b.shape[1], len(b)
    for i in range(n):
        ring[i, 0], ring[i, 1], edge[i] = vertices[k, i, 0], vertices[k, i, 1], i
    n, outcome, shrunk, row, before, after = _clip_ring(
        ring, edge, n, A, b, tolerance, cutting, V, over, spare, spare_edge
    )
    if outcome == EMPTY:
        for place, e in enumerate((V + row, before, after)):
            if e >= V:
                found[0][k, place, 0], found[0][k, place, 1], found[1][k, place] = A[e - V, 0], A[e - V, 1], b[e - V]
                found[2][k, place], found[3][k, place] = stamp, source[e - V]
            else:
                found[0][k, place, 0], found[0][k, place, 1] = ring_A[k, e, 0], ring_A[k, e, 1]
                found[1][k, place], found[2][k, place], found[3][k, place] = ring_b[k, e], time[k, e], ring_source[k, e]
    if shrunk and n > most:
        for i in range(V + R):
            old = i < V
            lines[i, 0], lines[i, 1] = (ring_A[k, i, 0], ring_A[k, i, 1]) if old else (A[i - V, 0], A[i - V, 1])
        n = _merge_ring(ring, edge, n, most, lines, parallel, spare, spare_edge)
        # Merging that would cost what the cut has gained is not worth it; the areas are sums in some order.
        shrunk = _area(ring, n) <= _area(vertices[k], count[k]) * (1 - epsilon)
    if not shrunk:
        return result, outcome, False
    if n > result[2].shape[1] or not fresh:
        result = _widened(result, max(n, result[2].shape[1]))
    new_vertices, new_A, new_b, new_time, new_source, new_count, _ = result
    new_count[k] = n
    for i in range(new_b.shape[1]):
        j, e = (i, edge[i]) if i < n else (0, -1)
        new_vertices[k, i, 0], new_vertices[k, i, 1] = ring[j, 0], ring[j, 1]
        if e >= V:
            new_A[k, i, 0], new_A[k, i, 1], new_b[k, i] = A[e - V, 0], A[e - V, 1], b[e - V]
            new_time[k, i], new_source[k, i] = stamp, source[e - V]
        elif e >= 0:
            new_A[k, i, 0], new_A[k, i, 1], new_b[k, i] = ring_A[k, e, 0], ring_A[k, e, 1], ring_b[k, e]
            new_time[k, i], new_source[k, i] = time[k, e], ring_source[k, e]
        else:
            new_A[k, i, 0], new_A[k, i, 1], new_b[k, i], new_time[k, i], new_source[k, i] = 0.0, 0.0, 1.0, np.nan, -1
    return result, outcome, True


@compiled
@no_type_check
def clip(polygons, A, b, stamp, source, most, epsilon, parallel):
    """All polygons (vertices, A, b, time, source, count, reach) by their rows A (B, R, 2), b and source (B, R).

    Returns (polygons, outcome, shrunk, contradiction): the same polygons, not copied, if none was cut.
    """
    B, R = b.shape
    result, scratch, found = polygons, _scratch(polygons[2].shape[1], R), _no_contradiction(B)
    outcome, shrunk, fresh = np.empty(B, np.int64), np.empty(B, np.bool_), False
    vertices, count, reach, tolerance, cutting = polygons[0], polygons[5], polygons[6], scratch[0], scratch[1]
    for k in range(B):
        outcome[k], shrunk[k] = NONEMPTY, False
        if _any_cuts(vertices, k, count[k], reach, A, b, tolerance, cutting, epsilon):
            result, outcome[k], shrunk[k] = _clip_one(
                k, polygons, result, fresh, A[k], b[k], stamp[k], source[k], most, epsilon, parallel, scratch, found
            )
            fresh = fresh or shrunk[k]
    return result, outcome, shrunk, found


@compiled
@no_type_check
def inscribed(vertices, A, b, count, epsilon):
    """A largest inscribed disc of each polygon, as in `Polygon.chebyshev`: its rows, centre and radius."""
    B, V = b.shape
    basis, centre, radius = np.empty((B, 3), np.int64), np.zeros((B, 2)), np.empty(B)
    row, right, inverse, solution = np.empty((V, 2)), np.empty(V), np.empty((3, 3)), np.empty(3)
    for k in range(B):
        n, half, scale = count[k], 1, 0.0
        for i in range(n):
            centre[k, 0] += vertices[k, i, 0] / n
            centre[k, 1] += vertices[k, i, 1] / n
        for i in range(n):
            norm = math.sqrt(A[k, i, 0] ** 2 + A[k, i, 1] ** 2)
            row[i, 0], row[i, 1] = A[k, i, 0] / norm, A[k, i, 1] / norm
            right[i] = b[k, i] / norm - (row[i, 0] * centre[k, 0] + row[i, 1] * centre[k, 1])
            scale = max(scale, abs(right[i]))
        while half < n - 2 and row[0, 0] * row[half + 1, 1] - row[0, 1] * row[half + 1, 0] >= 0:
            half += 1
        basis[k, 0], basis[k, 1], basis[k, 2] = 0, half, half + 1
        for _ in range(3 * V):
            _inverse_with_ones(row, basis[k], inverse)
            for i in range(3):
                solution[i] = 0.0
                for j in range(3):
                    solution[i] += inverse[i, j] * right[basis[k, j]]
            worst, entering = -np.inf, 0
            for i in range(n):
                violation = row[i, 0] * solution[0] + row[i, 1] * solution[1] + solution[2] - right[i]
                if violation > worst:
                    worst, entering = violation, i
            if not worst > epsilon * scale:
                break
            least, leaving = np.inf, 0
            for j in range(3):
                share = row[entering, 0] * inverse[0, j] + row[entering, 1] * inverse[1, j] + inverse[2, j]
                if share > epsilon and max(inverse[2, j], 0.0) / share < least:
                    least, leaving = max(inverse[2, j], 0.0) / share, j
            basis[k, leaving] = entering
        centre[k, 0] += solution[0]
        centre[k, 1] += solution[1]
        radius[k] = solution[2]
    return basis, centre, radius


@compiled
@no_type_check
def _inverse_with_ones(rows, basis, inverse):
    for i in range(3):
        p, q = basis[(i + 1) % 3], basis[(i + 2) % 3]
        inverse[0, i] = rows[p, 1] - rows[q, 1]
        inverse[1, i] = rows[q, 0] - rows[p, 0]
        inverse[2, i] = rows[p, 0] * rows[q, 1] - rows[p, 1] * rows[q, 0]
    determinant = rows[basis[0], 0] * inverse[0, 0] + rows[basis[0], 1] * inverse[1, 0] + inverse[2, 0]
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= determinant
