r"""Polygons cut by half-spaces a.z <= c: the search for the rows that form the ring, one polygon at a time.

A row cuts if some vertex exceeds it by more than round-off. The rows cut in the order of their depth in the polygon as
it was at first, deepest first. Let v be the vertices, m = min a.v - c, and t the round-off of a.v - c:

    m < -2t   the row cuts: the vertices with a.v - c <= t are kept, one arc of the ring, and the arc is closed where
              the ring crosses the line
    m > t     every vertex is beyond. EMPTY, if the row provably contradicts the two edges at the nearest vertex
    else      the row only touches, or nothing is proven. It is moved outward until the nearest vertex is 2t inside,
              and then it cuts. An outer sliver is left. UNDECIDED where -t <= m.

So no row is ever forgotten, and none is applied tighter than it was given.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, item_of_ordered, launcher
from torchfsid.kernels.ring import area_of, before_in, keep_arc, line_of, merge_ring, range_beyond
from torchfsid.outcome import Status
from torchfsid.tolerances import ROUND_OFF

OK, UNDECIDED, EMPTY = int(Status.OK), int(Status.UNDECIDED), int(Status.EMPTY)


@item_of_ordered
@no_type_check
def box_of(vertices, k, n):
    x0 = x1 = vertices[k, 0, 0]
    y0 = y1 = vertices[k, 0, 1]
    for i in range(1, n):
        x, y = vertices[k, i, 0], vertices[k, i, 1]
        x0, x1 = x if x < x0 else x0, x if x > x1 else x1
        y0, y1 = y if y < y0 else y0, y if y > y1 else y1
    return x0, x1, y0, y1


@item_of_ordered
@no_type_check
def most_beyond(vertices, k, n, p, q, c):
    """The largest distance by which a vertex exceeds the line (p, q).z = c."""
    most = -np.inf
    for i in range(n):
        beyond = p * vertices[k, i, 0] + q * vertices[k, i, 1] - c
        most = beyond if beyond > most else most
    return most


@item
@no_type_check
def exceeded(vertices, k, n, reach_x, reach_y, box, p, q, c):
    """How far the vertices of polygon k exceed the line (p, q).z = c, and its round-off. Zeros if not by more.

    The bounding box rules out many lines without a loop. The arrays of the batch are indexed, since views cost more.
    """
    x0, x1, y0, y1 = box
    if p * (x1 if p > 0 else x0) + q * (y1 if q > 0 else y0) - c > 0:
        tolerance = ROUND_OFF * (abs(p) * reach_x + abs(q) * reach_y + abs(c))
        beyond = most_beyond(vertices, k, n, p, q, c)
        if beyond > tolerance:
            return beyond, tolerance
    return 0.0, 0.0


@item
@no_type_check
def load_ring(k, polygons, ring, edge):
    """Copy polygon k. Returns the number of its vertices."""
    vertices, n = polygons[0], polygons[6][k]
    for i in range(n):
        ring[0, i, 0], ring[0, i, 1], edge[i] = vertices[k, i, 0], vertices[k, i, 1], i
    return n


@item
@no_type_check
def mark_cuts(k, n, polygons, A, b, scratch):
    """Find the rows that some vertex of the loaded polygon exceeds by more than round-off, the deepest first.

    Returns the number of these rows.
    """
    ring, _, bound, tolerance, depth, cutting = scratch
    reach, box, found = polygons[7], box_of(ring, 0, n), 0
    reach_x, reach_y = reach[k, 0], reach[k, 1]
    for r in range(b.shape[1]):
        p, q, c = A[k, r, 0], A[k, r, 1], b[k, r]
        beyond, slack = exceeded(ring, 0, n, reach_x, reach_y, box, p, q, c)
        if beyond > 0:
            bound[r], tolerance[r], depth[r] = c, slack, beyond / math.sqrt(p * p + q * q)
            s = found
            while s > 0 and depth[cutting[s - 1]] < depth[r]:
                cutting[s] = cutting[s - 1]
                s -= 1
            cutting[s] = r
            found += 1
    return found


@item
@no_type_check
def cut_ring(k, ring, edge, n, lines, first_row, reach, tolerance, cutting, cuts):
    """Cut the ring of n vertices by the first `cuts` rows of `cutting`, in this order. Row r is line first_row + r.

    A row is moved outward by changing its bound.

    Returns (n, outcome, whether the ring is smaller, and three lines that contradict each other if it is EMPTY).
    """
    outcome, shrunk, bound = OK, False, lines[4]
    for s in range(cuts):
        row = cutting[s]
        line, slack = first_row + row, tolerance[row]
        p, q, c = line_of(line, lines)
        least, most, inner = range_beyond(ring, n, p, q, c)
        if most <= slack:  # an earlier cut has made it redundant
            continue
        if least >= -slack:
            before, after = edge[before_in(inner, n)], edge[inner]
            if least > slack and _contradict(lines, line, before, after, reach[k, 0], reach[k, 1]):
                return n, EMPTY, False, line, before, after
            outcome = UNDECIDED
        outward = least + 2 * slack
        if outward > 0:
            c += outward
            bound[row] = c
            if most - outward <= slack:  # the ring is as narrow as round-off
                continue
            slack = 0.0
        n = keep_arc(ring, edge, n, line, p, q, c, inner, slack)
        shrunk = True
    return n, outcome, shrunk, -1, -1, -1


@item
@no_type_check
def _contradict(lines, row, first, second, reach_x, reach_y):
    """Is it proven that no point within `reach` satisfies three lines? All vertices are beyond the first of them. The
    others are the edges at the nearest vertex.

    The proof is a y >= 0 with y_row = 1 and y'c + |y'A| reach < 0 by more than round-off. It is the y with y'A = 0, or
    the y with the least |y'A| if one edge suffices.
    """
    p, q, c = line_of(row, lines)
    p1, q1, c1 = line_of(first, lines)
    p2, q2, c2 = line_of(second, lines)
    turn = p1 * q2 - q1 * p2
    for proof in range(3):
        y = z = 0.0
        if proof == 0 and turn != 0:
            y, z = (p2 * q - q2 * p) / turn, (p * q1 - q * p1) / turn
        elif proof == 1:
            y = -(p * p1 + q * q1) / (p1 * p1 + q1 * q1)
        elif proof == 2:
            z = -(p * p2 + q * q2) / (p2 * p2 + q2 * q2)
        y, z = max(y, 0.0), max(z, 0.0)
        noise = abs(p + y * p1 + z * p2) * reach_x + abs(q + y * q1 + z * q2) * reach_y
        noise += ROUND_OFF * (abs(p) * reach_x + abs(q) * reach_y + abs(c))
        noise += ROUND_OFF * y * (abs(p1) * reach_x + abs(q1) * reach_y + abs(c1))
        noise += ROUND_OFF * z * (abs(p2) * reach_x + abs(q2) * reach_y + abs(c2))
        if c + y * c1 + z * c2 < -noise:
            return True
    return False


@item
@no_type_check
def cut_loaded(k, n, cuts, polygons, A, most, scratch):
    """Cut the loaded polygon k by the `cuts` rows that `mark_cuts` found, as `cut_ring` does, and merge its edges."""
    (rings, edge, bound, tolerance, _, cutting), (vertices, ring_A, ring_b) = scratch, polygons[:3]
    ring, lines = rings[0], (k, ring_A, ring_b, A, bound)
    n, outcome, shrunk, row, before, after = cut_ring(
        k, ring, edge, n, lines, ring_b.shape[1], polygons[7], tolerance, cutting, cuts
    )
    if shrunk and n > most:
        n = merge_ring(ring, edge, n, most, lines)
        # Each area carries the round-off of its sum.
        shrunk = area_of(ring, n) <= area_of(vertices[k], polygons[6][k]) * (1 - ROUND_OFF)
    return n, outcome, shrunk, row, before, after


@item
@no_type_check
def keep_ring(k, n, polygons, rows, scratch, marks, result):
    """Write the loaded ring to polygon k of `result`. `rows` are (A, b, time, source).

    With `marks`, the label of an edge from row r is -1 - (k R + r) until it gets its own. Otherwise it is 0.
    """
    (_, ring_A, ring_b, time, ring_source, label), (A, b, stamp, source) = polygons[:6], rows
    (rings, edge, bound), (V, R) = scratch[:3], (ring_b.shape[1], b.shape[1])
    to_vertices, to_A, to_b, to_time, to_source, to_label, to_count, _ = result
    lines = k, ring_A, ring_b, A, bound
    to_count[k] = n
    for i in range(n):
        e = edge[i]
        to_vertices[k, i, 0], to_vertices[k, i, 1] = rings[0, i, 0], rings[0, i, 1]
        to_A[k, i, 0], to_A[k, i, 1], to_b[k, i] = line_of(e, lines)
        if e < V:
            to_time[k, i], to_source[k, i], to_label[k, i] = time[k, e], ring_source[k, e], label[k, e]
        else:
            to_time[k, i], to_source[k, i] = stamp_of(k, e - V, stamp), source[k, e - V]
            to_label[k, i] = -1 - (k * R + e - V) if marks else 0
    _pad(result, k, n)


@item
@no_type_check
def stamp_of(k, r, stamp):
    """The time of row r of item k, of all rows or all items if there is one."""
    return stamp[min(k, len(stamp) - 1), min(r, stamp.shape[1] - 1)]


@item
@no_type_check
def keep_contradiction(k, found, polygons, rows, scratch, lost):
    """Write the three lines `found` that contradict each other to item k of `lost`: A, b, time and source."""
    (_, ring_A, ring_b, time, ring_source), (A, _, stamp, source) = polygons[:5], rows
    lost_A, lost_b, lost_time, lost_source = lost
    V, lines = ring_b.shape[1], (k, ring_A, ring_b, A, scratch[2])
    for i, e in enumerate(found):
        lost_A[k, i, 0], lost_A[k, i, 1], lost_b[k, i] = line_of(e, lines)
        lost_time[k, i] = time[k, e] if e < V else stamp_of(k, e - V, stamp)
        lost_source[k, i] = ring_source[k, e] if e < V else source[k, e - V]


@launcher
@no_type_check
def clip(polygons, A, b, stamp, source, first_label, most):
    """Cut all polygons by their rows A (B, R, 2), b and source (B, R), with the times `stamp` (B or 1, R or 1).

    `polygons` are (vertices, A, b, time, source, label, count, reach), as in `Polygon`. New edges are labelled from
    `first_label` on, and `entered` lists their rows k R + r. A `first_label` of 0 means no labels. Polygons with more
    than `most` edges are merged. They stay as they were if merging costs what the cut has gained.

    Returns (polygons, outcome, shrunk, entered, contradiction). If none was cut, the polygons are not copied.
    """
    (B, R), V = b.shape, polygons[2].shape[1]
    W = V + R + 1
    scratch = np.empty((1, W, 2)), np.empty(W, np.int64), np.empty(R), np.empty(R), np.empty(R), np.empty(R, np.int64)
    rows = A, b, stamp, source
    result, slots, new = polygons, 0, 0
    entered = np.empty(B * R if first_label > 0 else 0, np.int64)
    outcome, shrunk = np.zeros(B, np.int64), np.zeros(B, np.bool_)
    lost = np.full((B, 3, 2), np.nan), np.full((B, 3), np.nan), np.full((B, 3), np.nan), np.full((B, 3), -1)
    for k in range(B):
        n = load_ring(k, polygons, scratch[0], scratch[1])
        cuts = mark_cuts(k, n, polygons, A, b, scratch)
        if cuts > 0:
            n, outcome[k], shrunk[k], row, before, after = cut_loaded(k, n, cuts, polygons, A, most, scratch)
            if outcome[k] == EMPTY:
                keep_contradiction(k, (row, before, after), polygons, rows, scratch, lost)
        if not shrunk[k]:
            if slots > 0:
                copy_polygon(polygons, k, result)
            continue
        if n > slots:  # seldom: slots grow by eight, and the polygons before this one are copied
            slots = max((n + 7) // 8 * 8, V)
            result = _widened(result, k, slots)
        keep_ring(k, n, polygons, rows, scratch, first_label > 0, result)
        if first_label > 0:
            label = result[5]
            for i in range(n):
                if label[k, i] < 0:
                    label[k, i], entered[new] = first_label + new, -1 - label[k, i]
                    new += 1
    return result, outcome, shrunk, entered[:new], lost


@launcher
@no_type_check
def _widened(polygons, done, slots):
    """New arrays with `slots` slots for vertices, and the first `done` polygons in them."""
    _, _, b, _, _, _, count, reach = polygons
    B = len(b)
    wide = (
        np.empty((B, slots, 2)), np.empty((B, slots, 2)), np.empty((B, slots)), np.empty((B, slots)),
        np.empty((B, slots), np.int64), np.empty((B, slots), np.int64), count.copy(), reach,
    )  # fmt: skip
    for k in range(done):
        copy_polygon(polygons, k, wide)
    return wide


@item
@no_type_check
def copy_polygon(polygons, k, wide):
    """Copy polygon k to arrays with as many slots or more."""
    vertices, A, b, time, source, label, count, _ = polygons
    to_vertices, to_A, to_b, to_time, to_source, to_label, to_count, _ = wide
    for i in range(count[k]):
        to_vertices[k, i, 0], to_vertices[k, i, 1] = vertices[k, i, 0], vertices[k, i, 1]
        to_A[k, i, 0], to_A[k, i, 1], to_b[k, i] = A[k, i, 0], A[k, i, 1], b[k, i]
        to_time[k, i], to_source[k, i], to_label[k, i] = time[k, i], source[k, i], label[k, i]
    to_count[k] = count[k]
    _pad(wide, k, count[k])


@item
@no_type_check
def _pad(polygons, k, n):
    """Fill the slots of polygon k behind its n vertices: they repeat the first vertex and hold padding rows."""
    vertices, A, b, time, source, label, _, _ = polygons
    for i in range(n, b.shape[1]):
        vertices[k, i, 0], vertices[k, i, 1] = vertices[k, 0, 0], vertices[k, 0, 1]
        A[k, i, 0], A[k, i, 1], b[k, i] = 0.0, 0.0, 1.0
        time[k, i], source[k, i], label[k, i] = np.nan, -1, 0
