r"""A simple polyhedron cut by half-spaces a.z <= c: the search for the facets that are left.

The rows are treated as in `polygon`. A row cuts if some vertex exceeds it by more than round-off. The rows cut in the
order of their depth in the polyhedron as it was at first, deepest first. Let v be the vertices, m = min a.v - c, and t
the round-off of a.v - c:

    m < -2t   the row cuts
    m > t     every vertex is beyond. EMPTY, if the row provably contradicts the facets at the nearest vertex
    else      the row only touches, or nothing is proven. It is moved outward until the nearest vertex is 2t inside,
              and then it cuts. An outer sliver is left. UNDECIDED where -t <= m.

A cut divides the graph of vertices and edges in two connected parts (Sugihara, 1994). Dropped is the part around the
farthest vertex with a.v - c >= -t, kept is the part around the nearest vertex. The edges between them form a ring, and
so do their new ends, around the new facet. An edge that ends on the row within round-off keeps its end:

    new end of the edge from v (kept) to w (dropped) = w if s_w <= t, else v + s_v / (s_v - s_w) (w - v),   s = a.z - c

So no equation is solved, the ends lie on their facets however thin the set is, and the graph stays that of a
polyhedron whatever round-off does. No row is ever forgotten, and none is applied tighter than it was given.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, item_of_ordered, launcher
from torchfsid.kernels.linear import solve_rows
from torchfsid.kernels.simple_polyhedron import take_out
from torchfsid.outcome import Status
from torchfsid.tolerances import ROUND_OFF

NONEMPTY, UNDECIDED, EMPTY = int(Status.OK), int(Status.UNDECIDED), int(Status.EMPTY)

INSIDE, BEYOND, DROPPED, KEPT = 0, 1, 2, 3

SUBSETS = np.array([[0, 1, 2], [0, 1, -1], [0, 2, -1], [1, 2, -1], [0, -1, -1], [1, -1, -1], [2, -1, -1], [-1, -1, -1]])
"""The facets at a vertex that may contradict a row, as a part of the three."""


class Marks(NamedTuple):
    """Places for cuts: for each vertex a.z - c and its state, for each new vertex the end of the edge that it closes, a
    stack of vertices, for each line an open end of an edge on it (all -1), and small systems (6, 3, 3)."""

    over: Any
    state: Any
    place: Any
    stack: Any
    half: Any
    small: Any


@launcher
@no_type_check
def marks_of(V, L):
    i, j, k = np.zeros(V, np.int64), np.zeros(V, np.int64), np.zeros(V, np.int64)
    return Marks(np.zeros(V), i, j, k, np.full(L, -1), np.zeros((6, 3, 3)))


@item_of_ordered
@no_type_check
def _box(points, k, n, box):
    """Fill `box` (3, 2) with the least and largest coordinates of polyhedron k."""
    for j in range(3):
        low = high = points[k, 0, j]
        for i in range(1, n):
            low, high = min(low, points[k, i, j]), max(high, points[k, i, j])
        box[j, 0], box[j, 1] = low, high


@item_of_ordered
@no_type_check
def _beyond(points, k, n, p, q, r, c):
    """The largest a.v - c of the vertices, a = (p, q, r)."""
    most = -np.inf
    for i in range(n):
        most = max(most, p * points[k, i, 0] + q * points[k, i, 1] + r * points[k, i, 2] - c)
    return most


@item
@no_type_check
def mark_cuts(points, k, n, reach, A, b, box, tolerance, depth, cutting):
    """Fill `cutting` with the rows that some vertex of polyhedron k exceeds by more than round-off, the deepest first.

    Returns the number of these rows.
    """
    _box(points, k, n, box)
    found = 0
    for row in range(b.shape[1]):
        p, q, r, c = A[k, row, 0], A[k, row, 1], A[k, row, 2], b[k, row]
        bound = p * box[0, 1 if p > 0 else 0] + q * box[1, 1 if q > 0 else 0] + r * box[2, 1 if r > 0 else 0]
        if bound - c > 0:
            size = abs(p) * reach[k, 0] + abs(q) * reach[k, 1] + abs(r) * reach[k, 2] + abs(c)
            tolerance[row] = ROUND_OFF * size
            beyond = _beyond(points, k, n, p, q, r, c)
            if beyond > tolerance[row]:
                depth[row] = beyond / math.sqrt(p * p + q * q + r * r)
                s = found
                while s > 0 and depth[cutting[s - 1]] < depth[row]:
                    cutting[s] = cutting[s - 1]
                    s -= 1
                cutting[s] = row
                found += 1
    return found


@item_of_ordered
@no_type_check
def _excess(points, n, lines, line, over):
    """Fill `over` with a.v - c of each vertex. Returns the largest of them."""
    p, q, r, c = lines[line, 0], lines[line, 1], lines[line, 2], lines[line, 3]
    most = -np.inf
    for i in range(n):
        over[i] = p * points[i, 0] + q * points[i, 1] + r * points[i, 2] - c
        most = max(most, over[i])
    return most


@item
@no_type_check
def cut_polyhedron(graph, spare, n, lines, first_row, reach, tolerance, cutting, cuts, marks, proof):
    """Cut a polyhedron of n vertices by the first `cuts` rows of `cutting`, in order.

    Row r is line first_row + r of `lines` (a, c). A row is moved outward by changing its line.

    Returns (n, outcome, whether it is smaller). If it is EMPTY, `proof` holds up to four lines that contradict each
    other, and -1 behind them.
    """
    points, meets, _ = graph
    over, outcome, shrunk = marks.over, NONEMPTY, False
    for s in range(cuts):
        line, slack = first_row + cutting[s], tolerance[cutting[s]]
        most = _excess(points, n, lines, line, over)
        if most <= slack:  # an earlier cut has made it redundant
            continue
        inner = outer = 0
        for i in range(1, n):
            inner = i if over[i] < over[inner] else inner
            outer = i if over[i] > over[outer] else outer
        least = over[inner]
        if least >= -slack:
            if least > slack and _contradict(meets, n, lines, line, over, least + slack, reach, marks, proof):
                return n, EMPTY, False
            outcome = UNDECIDED
        outward = least + 2 * slack
        if outward > 0:
            lines[line, 3] += outward
            for i in range(n):
                over[i] -= outward
            if most - outward <= slack:  # the set is as narrow as round-off
                continue
        n = _drop(graph, spare, n, line, slack, inner, outer, marks)
        shrunk = True
    return n, outcome, shrunk


@item
@no_type_check
def _drop(graph, spare, n, line, slack, inner, outer, marks):
    """Drop the vertices beyond the row `line` and close the polyhedron along it. Returns its vertex count."""
    points, meets, near = graph
    over, state, place, stack = marks.over, marks.state, marks.place, marks.stack
    for v in range(n):
        state[v] = BEYOND if over[v] >= -slack else INSIDE
    _spread(near, outer, state, BEYOND, DROPPED, stack)
    _spread(near, inner, state, INSIDE, KEPT, stack)
    gone = new = 0
    for v in range(n):
        if state[v] != KEPT:
            stack[gone] = v
            gone += 1
    for s in range(gone):
        w = stack[s]
        for e in range(3):
            v = near[w, e]
            if state[v] != KEPT:
                continue
            j = 0 if near[v, 0] == w else 1 if near[v, 1] == w else 2
            share = 1.0 if over[w] <= slack else 0.0 if over[v] >= 0 else over[v] / (over[v] - over[w])
            for i in range(3):
                end = points[w, i] if share == 1.0 else points[v, i] + share * (points[w, i] - points[v, i])
                spare.points[new, i] = end
            p, q = meets[v, (j + 1) % 3], meets[v, (j + 2) % 3]
            spare.meets[new, 0], spare.meets[new, 1], spare.meets[new, 2] = line, p, q
            _join(marks.half, p, 3 * new + 2, spare.near)
            _join(marks.half, q, 3 * new + 1, spare.near)
            place[new] = 3 * v + j
            new += 1
    # The new vertices take the numbers of the dropped ones, and then those after the last one.
    for t in range(gone, new):
        stack[t] = n + t - gone
    for t in range(new):
        v, kept = stack[t], place[t]
        for j in range(3):
            points[v, j], meets[v, j] = spare.points[t, j], spare.meets[t, j]
        near[v, 0], near[v, 1], near[v, 2] = kept // 3, stack[spare.near[t, 1]], stack[spare.near[t, 2]]
        near[kept // 3, kept % 3] = v
    n += max(new - gone, 0)
    for s in range(gone - 1, new - 1, -1):
        n = take_out(graph, stack[s], n)
    return n


@item
@no_type_check
def _spread(near, start, state, lowest, mark, stack):
    """Mark `start` and the vertices connected to it by vertices in states from `lowest` to BEYOND."""
    state[start], stack[0], top = mark, start, 1
    while top > 0:
        top -= 1
        v = stack[top]
        for j in range(3):
            w = near[v, j]
            if lowest <= state[w] <= BEYOND:
                state[w], stack[top] = mark, w
                top += 1


@item
@no_type_check
def _join(half, facet, slot, near):
    """The new facet's edge on a facet has two ends: keep the first one, and link the second one with it."""
    other = half[facet]
    if other < 0:
        half[facet] = slot
    else:
        near[slot // 3, slot % 3], near[other // 3, other % 3] = other // 3, slot // 3
        half[facet] = -1


@item
@no_type_check
def _contradict(meets, n, lines, row, over, most, reach, marks, proof):
    """Is it proven that no point within `reach` satisfies the line `row` and some facets? All vertices are beyond it.
    The facets are those at a vertex with over <= most, one of the nearest. Fills `proof` with these lines.

    The proof is a y >= 0 with y_row = 1 and y'c + |y'A| reach < 0 by more than round-off. It is the y with the least
    |y'A|, which is zero where the three facets are independent.
    """
    N, Q, T, small = marks.small[0], marks.small[1], marks.small[2], marks.small[3]
    pull, zero, z = marks.small[4, 0], marks.small[4, 1], marks.small[4, 2]
    y, D = marks.small[5, 0], marks.small[5, 1]
    for chosen in range(len(SUBSETS)):
        for v in range(n):
            if over[v] > most:
                continue
            k = 0
            for i in range(3):
                zero[i], pull[i] = 0.0, -lines[row, i]
                if SUBSETS[chosen, i] >= 0:
                    proof[k + 1] = meets[v, SUBSETS[chosen, i]]
                    for j in range(3):
                        N[k, j] = lines[proof[k + 1], j]
                    k += 1
            proof[0] = row
            solve_rows(N, k, pull, zero, Q, D, T, small, z, y)
            bound, noise, used = lines[row, 3], 0.0, 1
            for j in range(3):
                left = lines[row, j]
                for i in range(k):
                    left += max(y[i], 0.0) * N[i, j]
                noise += abs(left) * reach[j]
            noise += _round_off(lines, row, reach)
            for i in range(k):
                if y[i] > 0:
                    bound += y[i] * lines[proof[i + 1], 3]
                    noise += y[i] * _round_off(lines, proof[i + 1], reach)
                    proof[used] = proof[i + 1]
                    used += 1
            if bound < -noise:
                for i in range(used, 4):
                    proof[i] = -1
                return True
    return False


@item
@no_type_check
def _round_off(lines, line, reach):
    """A bound on the rounding error of a.z - c within reach."""
    size = abs(lines[line, 3])
    for j in range(3):
        size += abs(lines[line, j]) * reach[j]
    return ROUND_OFF * size
