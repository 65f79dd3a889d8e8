r"""Simple polyhedra in R^3: in every vertex exactly three facets meet.

    points[v]     the vertex v
    meets[v, j]   its three facets, as numbers of lines (a, c): the facet lies on a.z = c
    near[v, j]    the vertex at the other end of the edge that is not on facet meets[v, j]

F facets have V = 2 F - 4 vertices. Where more than three facets meet in a point, several vertices are at this point. So
the graph of vertices and edges is always that of a polyhedron, whatever round-off does to the points. `near` follows
from `meets`: two vertices are the ends of an edge if they share two facets.

A batch of B polyhedra is a tuple of arrays (points, meets, A, b, time, source, label, count, reach), as in
`sets.Polyhedron`: points and meets (B, 2 F - 4, 3), A (B, F, 3), the next four (B, F), count (B,), reach (B, 3).
"""

from __future__ import annotations

from typing import Any, NamedTuple, no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, launcher


class Graph(NamedTuple):
    """A polyhedron with as many places as it may need: `points`, `meets` and `near`, each (V, 3)."""

    points: Any
    meets: Any
    near: Any


@launcher
@no_type_check
def graph_of(V):
    return Graph(np.zeros((V, 3)), np.zeros((V, 3), np.int64), np.zeros((V, 3), np.int64))


@item
@no_type_check
def link(meets, n, edges, near):
    """Fill `near` for n vertices. All entries of `edges` (lines, lines) are -1, before and after."""
    for v in range(n):
        for j in range(3):
            p, q = meets[v, (j + 1) % 3], meets[v, (j + 2) % 3]
            low, high = min(p, q), max(p, q)
            end = edges[low, high]
            if end < 0:
                edges[low, high] = 3 * v + j
            else:
                w, i = end // 3, end % 3
                near[v, j], near[w, i] = w, v
                edges[low, high] = -1


@item
@no_type_check
def find_facets(meets, n, at):
    """Fill at[f] with a vertex of each facet f, and with -1 for the other lines."""
    for f in range(len(at)):
        at[f] = -1
    for v in range(n):
        for j in range(3):
            at[meets[v, j]] = v


@item
@no_type_check
def along(meets, near, v, before, facet):
    """The vertex next to v around a facet, on the other side of v than `before`."""
    for j in range(3):
        if meets[v, j] != facet and near[v, j] != before:
            return near[v, j]
    return before


@item
@no_type_check
def take_out(graph, v, n):
    """Take one of n vertices out: the last one gets its number. Returns the number of vertices that are left."""
    points, meets, near = graph
    last = n - 1
    if v != last:
        for j in range(3):
            points[v, j], meets[v, j], near[v, j] = points[last, j], meets[last, j], near[last, j]
            w = near[last, j]
            for i in range(3):
                near[w, i] = v if near[w, i] == last else near[w, i]
    return last


@item
@no_type_check
def determinant(u, v, w):
    return u[0] * (v[1] * w[2] - v[2] * w[1]) - u[1] * (v[0] * w[2] - v[2] * w[0]) + u[2] * (v[0] * w[1] - v[1] * w[0])


@launcher
@no_type_check
def widened(polyhedra, done, slots):
    """New arrays with `slots` slots for facets, and the first `done` polyhedra in them."""
    B, count, reach = len(polyhedra[3]), polyhedra[7], polyhedra[8]
    wide = (
        np.empty((B, 2 * slots - 4, 3)), np.empty((B, 2 * slots - 4, 3), np.int64), np.empty((B, slots, 3)),
        np.empty((B, slots)), np.empty((B, slots)), np.empty((B, slots), np.int64), np.empty((B, slots), np.int64),
        count.copy(), reach.copy(),
    )  # fmt: skip
    for k in range(done):
        copy(polyhedra, k, wide)
    return wide


@item
@no_type_check
def copy(polyhedra, k, wide):
    """Copy polyhedron k to arrays with as many slots or more."""
    points, meets, A, b, time, source, label, count, reach = polyhedra
    to_points, to_meets, to_A, to_b, to_time, to_source, to_label, to_count, to_reach = wide
    for v in range(2 * count[k] - 4):
        for j in range(3):
            to_points[k, v, j], to_meets[k, v, j] = points[k, v, j], meets[k, v, j]
    for f in range(count[k]):
        for j in range(3):
            to_A[k, f, j] = A[k, f, j]
        to_b[k, f], to_time[k, f], to_source[k, f], to_label[k, f] = b[k, f], time[k, f], source[k, f], label[k, f]
    to_count[k] = count[k]
    for j in range(3):
        to_reach[k, j] = reach[k, j]
    pad(wide, k, count[k])


@item
@no_type_check
def pad(polyhedra, k, facets):
    """Fill the slots of polyhedron k behind its facets and vertices: copies of the first vertex, and padding rows."""
    points, meets, A, b, time, source, label, _, _ = polyhedra
    for v in range(2 * facets - 4, points.shape[1]):
        for j in range(3):
            points[k, v, j], meets[k, v, j] = points[k, 0, j], meets[k, 0, j]
    for f in range(facets, b.shape[1]):
        for j in range(3):
            A[k, f, j] = 0.0
        b[k, f], time[k, f], source[k, f], label[k, f] = 1.0, np.nan, -1, 0
