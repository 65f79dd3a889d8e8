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
from torchfsid.kernels.ring import after_in, area_of, before_in, copy_ring, merge_ring
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
def exceeded(vertices, k, n, reach, box, p, q, c):
    """How far the vertices of polygon k exceed the line (p, q).z = c, and its round-off. Zeros if not by more.

    The bounding box rules out many lines without a loop. The arrays of the batch are indexed, since views cost more.
    """
    x0, x1, y0, y1 = box
    if p * (x1 if p > 0 else x0) + q * (y1 if q > 0 else y0) - c > 0:
        tolerance = ROUND_OFF * (abs(p) * reach[k, 0] + abs(q) * reach[k, 1] + abs(c))
        beyond = most_beyond(vertices, k, n, p, q, c)
        if beyond > tolerance:
            return beyond, tolerance
    return 0.0, 0.0


@item
@no_type_check
def mark_cuts(vertices, k, n, reach, A, b, tolerance, depth, cutting):
    """Fill `cutting` with the rows that some vertex of polygon k exceeds by more than round-off, the deepest first.

    Returns the number of these rows.
    """
    box = box_of(vertices, k, n)
    found = 0
    for r in range(b.shape[1]):
        p, q = A[k, r, 0], A[k, r, 1]
        beyond, slack = exceeded(vertices, k, n, reach, box, p, q, b[k, r])
        if beyond > 0:
            tolerance[r], depth[r] = slack, beyond / math.sqrt(p * p + q * q)
            s = found
            while s > 0 and depth[cutting[s - 1]] < depth[r]:
                cutting[s] = cutting[s - 1]
                s -= 1
            cutting[s] = r
            found += 1
    return found


@item_of_ordered
@no_type_check
def _excess(ring, n, p, q, c, over):
    """Fill `over` with (p, q).v - c of each vertex. Returns the largest of them."""
    most = -np.inf
    for i in range(n):
        beyond = p * ring[i, 0] + q * ring[i, 1] - c
        over[i] = beyond
        most = beyond if beyond > most else most
    return most


@item
@no_type_check
def cut_ring(ring, edge, n, lines, first_row, reach, tolerance, cutting, cuts, over, spare, spare_edge):
    """Cut the ring of n vertices by the first `cuts` rows of `cutting`, in this order.

    `edge` holds indices of lines (p, q, c). Row r is line first_row + r. A row is moved outward by changing its line.

    Returns (n, outcome, whether the ring is smaller, and three lines that contradict each other if it is EMPTY).
    """
    outcome, shrunk = OK, False
    for s in range(cuts):
        row = cutting[s]
        line, slack, inner = first_row + row, tolerance[row], 0
        most = _excess(ring, n, lines[line, 0], lines[line, 1], lines[line, 2], over)
        if most <= slack:  # an earlier cut has made it redundant
            continue
        least = over[0]
        for i in range(1, n):
            if over[i] < least:
                least, inner = over[i], i
        if least >= -slack:
            before, after = edge[before_in(inner, n)], edge[inner]
            if least > slack and _contradict(lines, line, before, after, reach):
                return n, EMPTY, False, line, before, after
            outcome = UNDECIDED
        outward = least + 2 * slack
        if outward > 0:
            lines[line, 2] += outward
            for i in range(n):
                over[i] -= outward
            if most - outward <= slack:  # the ring is as narrow as round-off
                continue
            slack = 0.0
        n = _keep_arc(ring, edge, n, line, inner, slack, over, spare, spare_edge)
        shrunk = True
    return n, outcome, shrunk, -1, -1, -1


@item
@no_type_check
def _keep_arc(ring, edge, n, line, inner, slack, over, spare, spare_edge):
    """Keep the arc around the vertex `inner` with a.v - c <= slack, closed along the line. Returns its vertex count."""
    first = last = inner
    while over[before_in(first, n)] <= slack:
        first = before_in(first, n)
    while over[after_in(last, n)] <= slack:
        last = after_in(last, n)
    new, j = 0, first
    for _ in range((last - first if last >= first else last - first + n) + 1):
        spare[new, 0], spare[new, 1], spare_edge[new] = ring[j, 0], ring[j, 1], edge[j]
        new += 1
        j = after_in(j, n)
    if over[last] < -slack:
        _cross(spare, new, ring, over, last, after_in(last, n))
        new += 1
    spare_edge[new - 1] = line
    if over[first] < -slack:
        _cross(spare, new, ring, over, first, before_in(first, n))
        spare_edge[new] = edge[before_in(first, n)]
        new += 1
    copy_ring(spare, spare_edge, new, ring, edge)
    return new


@item
@no_type_check
def _contradict(lines, row, first, second, reach):
    """Is it proven that no point within `reach` satisfies three lines? All vertices are beyond the first of them. The
    others are the edges at the nearest vertex.

    The proof is a y >= 0 with y_row = 1 and y'c + |y'A| reach < 0 by more than round-off. It is the y with y'A = 0, or
    the y with the least |y'A| if one edge suffices.
    """
    p, q, c = lines[row, 0], lines[row, 1], lines[row, 2]
    p1, q1, c1 = lines[first, 0], lines[first, 1], lines[first, 2]
    p2, q2, c2 = lines[second, 0], lines[second, 1], lines[second, 2]
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
        noise = abs(p + y * p1 + z * p2) * reach[0] + abs(q + y * q1 + z * q2) * reach[1]
        noise += ROUND_OFF * (abs(p) * reach[0] + abs(q) * reach[1] + abs(c))
        noise += ROUND_OFF * y * (abs(p1) * reach[0] + abs(q1) * reach[1] + abs(c1))
        noise += ROUND_OFF * z * (abs(p2) * reach[0] + abs(q2) * reach[1] + abs(c2))
        if c + y * c1 + z * c2 < -noise:
            return True
    return False


@item
@no_type_check
def _cross(points, k, ring, over, inner, outer):
    share = over[inner] / (over[inner] - over[outer])
    for i in range(2):
        points[k, i] = ring[inner, i] + share * (ring[outer, i] - ring[inner, i])


@item
@no_type_check
def cut_one(k, polygons, A, b, most, scratch):
    """Cut polygon k by its rows, as `cut_ring` does. The new ring, its edges and their lines are in `scratch`."""
    vertices, ring_A, ring_b, _, _, _, count, reach = polygons
    ring, edge, lines, tolerance, depth, cutting, over, spare, spare_edge = scratch
    n, V = count[k], ring_b.shape[1]
    cuts = mark_cuts(vertices, k, n, reach, A, b, tolerance, depth, cutting)
    if cuts == 0:
        return n, OK, False, -1, -1, -1
    for i in range(n):
        ring[i, 0], ring[i, 1], edge[i] = vertices[k, i, 0], vertices[k, i, 1], i
        lines[i, 0], lines[i, 1], lines[i, 2] = ring_A[k, i, 0], ring_A[k, i, 1], ring_b[k, i]
    for s in range(cuts):
        r = cutting[s]
        lines[V + r, 0], lines[V + r, 1], lines[V + r, 2] = A[k, r, 0], A[k, r, 1], b[k, r]
    n, outcome, shrunk, row, before, after = cut_ring(
        ring, edge, n, lines, V, reach[k], tolerance, cutting, cuts, over, spare, spare_edge
    )
    if shrunk and n > most:
        n = merge_ring(ring, edge, n, most, lines, spare, spare_edge)
        # Each area carries the round-off of its sum.
        shrunk = area_of(ring, n) <= area_of(vertices[k], count[k]) * (1 - ROUND_OFF)
    return n, outcome, shrunk, row, before, after


@item
@no_type_check
def keep_ring(k, n, polygons, stamp, source, scratch, marks, result):
    """Write the ring that `cut_one` left in `scratch` to polygon k of `result`.

    With `marks`, the label of an edge from row r is -1 - (k R + r) until it gets its own. Otherwise it is 0.
    """
    (time, ring_source, label), (ring, edge, lines) = polygons[3:6], scratch[:3]
    to_vertices, to_A, to_b, to_time, to_source, to_label, to_count, _ = result
    V, R = time.shape[1], stamp.shape[1]
    to_count[k] = n
    for i in range(n):
        to_vertices[k, i, 0], to_vertices[k, i, 1] = ring[i, 0], ring[i, 1]
        e = edge[i]
        to_A[k, i, 0], to_A[k, i, 1], to_b[k, i] = lines[e, 0], lines[e, 1], lines[e, 2]
        if e < V:
            to_time[k, i], to_source[k, i], to_label[k, i] = time[k, e], ring_source[k, e], label[k, e]
        else:
            to_time[k, i], to_source[k, i] = stamp[k, e - V], source[k, e - V]
            to_label[k, i] = -1 - (k * R + e - V) if marks else 0
    _pad(result, k, n)


@item
@no_type_check
def keep_contradiction(k, found, polygons, stamp, source, lines, lost):
    """Write the three lines `found` that contradict each other to item k of `lost`: A, b, time and source."""
    time, ring_source = polygons[3], polygons[4]
    lost_A, lost_b, lost_time, lost_source = lost
    V = time.shape[1]
    for i, e in enumerate(found):
        lost_A[k, i, 0], lost_A[k, i, 1], lost_b[k, i] = lines[e, 0], lines[e, 1], lines[e, 2]
        lost_time[k, i] = time[k, e] if e < V else stamp[k, e - V]
        lost_source[k, i] = ring_source[k, e] if e < V else source[k, e - V]


@launcher
@no_type_check
def clip(polygons, A, b, stamp, source, first_label, most):
    """Cut all polygons by their rows A (B, R, 2), b and source (B, R), with the times `stamp` (B, R).

    `polygons` are (vertices, A, b, time, source, label, count, reach), as in `Polygon`. New edges are labelled from
    `first_label` on, and `entered` lists their rows k R + r. A `first_label` of 0 means no labels. Polygons with more
    than `most` edges are merged. They stay as they were if merging costs what the cut has gained.

    Returns (polygons, outcome, shrunk, entered, contradiction). If none was cut, the polygons are not copied.
    """
    (B, R), V = b.shape, polygons[2].shape[1]
    W = V + R + 1
    scratch = (
        np.empty((W, 2)), np.empty(W, np.int64), np.empty((W, 3)),
        np.empty(R), np.empty(R), np.empty(R, np.int64), np.empty(W), np.empty((W, 2)), np.empty(W, np.int64),
    )  # fmt: skip
    result, slots, new = polygons, 0, 0
    entered = np.empty(B * R if first_label > 0 else 0, np.int64)
    outcome, shrunk = np.zeros(B, np.int64), np.zeros(B, np.bool_)
    lost = np.full((B, 3, 2), np.nan), np.full((B, 3), np.nan), np.full((B, 3), np.nan), np.full((B, 3), -1)
    for k in range(B):
        n, outcome[k], shrunk[k], row, before, after = cut_one(k, polygons, A, b, most, scratch)
        if outcome[k] == EMPTY:
            keep_contradiction(k, (row, before, after), polygons, stamp, source, scratch[2], lost)
        if not shrunk[k]:
            if slots > 0:
                copy_polygon(polygons, k, result)
            continue
        if n > slots:  # seldom: slots grow by eight, and the polygons before this one are copied
            slots = max((n + 7) // 8 * 8, V)
            result = _widened(result, k, slots)
        keep_ring(k, n, polygons, stamp, source, scratch, first_label > 0, result)
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
