"""Batches of simple polyhedra cut by half-spaces, and merged to fewer facets, one polyhedron at a time.

`cutting` says how one is cut, `roofs` how facets are merged, `simple_polyhedron` how a batch is stored.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, launcher
from torchfsid.kernels.cutting import EMPTY, cut_polyhedron, mark_cuts, marks_of
from torchfsid.kernels.roofs import merge, roof_of
from torchfsid.kernels.simple_polyhedron import copy, find_facets, graph_of, link, pad, widened
from torchfsid.kernels.solid import frame_of, volume_of
from torchfsid.tolerances import ROUND_OFF


@launcher
@no_type_check
def clip(polyhedra, A, b, stamp, source, first_label, most):
    """Cut all polyhedra by their rows A (B, R, 3), b and source (B, R), with the times `stamp` (B, R).

    New facets are labelled from `first_label` on, and `entered` lists their rows k R + r. A `first_label` of 0 means no
    labels. Polyhedra with more than `most` facets are merged. They stay as they were if merging costs what the cut has
    gained.

    Returns (polyhedra, outcome, shrunk, entered, contradiction). If none was cut, the polyhedra are not copied.
    """
    points, meets, _, own_b, time, own_source, _, count, reach = polyhedra
    (B, R), F = b.shape, own_b.shape[1]
    L = F + R  # lines: first the facets, then the rows
    tolerance, depth, cutting, box = np.empty(R), np.empty(R), np.empty(R, np.int64), np.empty((3, 2))
    lines, proof, far, centre = np.empty((L, 4)), np.full(4, -1), np.empty(3), np.empty(3)
    edges, at = np.full((L, L), -1), np.full(L, -1)
    graph, spare, marks = graph_of(2 * L), graph_of(2 * L), marks_of(2 * L, L)
    frame, roof = frame_of(2 * L), roof_of(L)
    outcome, shrunk = np.zeros(B, np.int64), np.zeros(B, np.bool_)
    lost = np.full((B, 4, 3), np.nan), np.full((B, 4), np.nan), np.full((B, 4), np.nan), np.full((B, 4), -1)
    result, slots, new = polyhedra, 0, 0
    entered = np.empty(B * R if first_label > 0 else 0, np.int64)
    for k in range(B):
        n = 2 * count[k] - 4
        cuts = mark_cuts(points, k, n, reach, A, b, box, tolerance, depth, cutting)
        if cuts > 0:
            _load(polyhedra, k, graph, lines, edges, far)
            for s in range(cuts):
                for j in range(3):
                    lines[F + cutting[s], j] = A[k, cutting[s], j]
                lines[F + cutting[s], 3] = b[k, cutting[s]]
            n, outcome[k], shrunk[k] = cut_polyhedron(
                graph, spare, n, lines, F, reach[k], tolerance, cutting, cuts, marks, proof
            )
        if outcome[k] == EMPTY:
            for i in range(4):
                e = proof[i]
                if e >= 0:
                    for j in range(3):
                        lost[0][k, i, j] = lines[e, j]
                    lost[1][k, i] = lines[e, 3]
                    lost[2][k, i] = time[k, e] if e < F else stamp[k, e - F]
                    lost[3][k, i] = own_source[k, e] if e < F else source[k, e - F]
        if shrunk[k] and (n + 4) // 2 > most:
            n = merge(graph, n, lines, most, far, at, frame, roof)
            larger = volume_of(frame.y, graph.meets, graph.near, at, 3, centre)
            # The volume before, in the same frame. Each volume carries the round-off of its sum.
            _to_frame(points, k, 2 * count[k] - 4, frame)
            link(meets[k], 2 * count[k] - 4, edges, spare.near)
            find_facets(meets[k], 2 * count[k] - 4, at)
            smaller = volume_of(frame.y, meets[k], spare.near, at, 3, centre)
            shrunk[k] = larger <= smaller * (1 - ROUND_OFF)
        if not shrunk[k]:
            if slots > 0:
                copy(polyhedra, k, result)
            continue
        if (n + 4) // 2 > slots:  # seldom: slots grow by eight, and the polyhedra before this one are copied
            slots = max(((n + 4) // 2 + 7) // 8 * 8, F)
            result = widened(result, k, slots)
        find_facets(graph.meets, n, at)
        new = _store(polyhedra, k, graph, n, lines, far, at, stamp, source, first_label, entered, new, result)
    return result, outcome, shrunk, entered[:new], lost


@launcher
@no_type_check
def merged(polyhedra, most):
    """The polyhedra with at most `most` facets, or as few as can be reached."""
    (B, F), count = polyhedra[3].shape, polyhedra[7]
    lines, far, edges, at = np.empty((F, 4)), np.empty(3), np.full((F, F), -1), np.full(F, -1)
    graph, frame, roof = graph_of(2 * F), frame_of(2 * F), roof_of(F)
    result, stamp, none = widened(polyhedra, 0, F), np.empty((B, 0)), np.empty((B, 0), np.int64)
    for k in range(B):
        _load(polyhedra, k, graph, lines, edges, far)
        n = merge(graph, 2 * count[k] - 4, lines, most, far, at, frame, roof)
        find_facets(graph.meets, n, at)
        _store(polyhedra, k, graph, n, lines, far, at, stamp, none, 0, none[0], 0, result)
    return result


@item
@no_type_check
def _load(polyhedra, k, graph, lines, edges, far):
    """Copy polyhedron k to a graph, its rows to the first lines, and its reach to `far`."""
    points, meets, A, b, _, _, _, count, reach = polyhedra
    n = 2 * count[k] - 4
    for v in range(n):
        for j in range(3):
            graph.points[v, j], graph.meets[v, j] = points[k, v, j], meets[k, v, j]
    for f in range(count[k]):
        for j in range(3):
            lines[f, j] = A[k, f, j]
        lines[f, 3] = b[k, f]
    for j in range(3):
        far[j] = reach[k, j]
    link(graph.meets, n, edges, graph.near)


@item
@no_type_check
def _store(polyhedra, k, graph, n, lines, far, at, stamp, source, first_label, entered, new, result):
    """Copy a graph to polyhedron k of `result`. Facets stand in the order of their lines, of which the first ones are
    those of polyhedron k before, and the others its new rows.

    Returns how many rows of the batch have entered so far. `at` is overwritten.
    """
    _, _, _, b, time, own_source, label, _, _ = polyhedra
    to_points, to_meets, to_A, to_b, to_time, to_source, to_label, to_count, to_reach = result
    F, R, f = b.shape[1], stamp.shape[1], 0
    for e in range(len(at)):
        if at[e] < 0:
            continue
        for j in range(3):
            to_A[k, f, j] = lines[e, j]
        to_b[k, f] = lines[e, 3]
        if e < F:
            to_time[k, f], to_source[k, f], to_label[k, f] = time[k, e], own_source[k, e], label[k, e]
        else:
            to_time[k, f], to_source[k, f], to_label[k, f] = stamp[k, e - F], source[k, e - F], 0
            if first_label > 0:
                to_label[k, f], entered[new] = first_label + new, k * R + e - F
                new += 1
        at[e] = f
        f += 1
    for v in range(n):
        for j in range(3):
            to_points[k, v, j], to_meets[k, v, j] = graph.points[v, j], at[graph.meets[v, j]]
    for j in range(3):
        to_reach[k, j] = far[j]
    to_count[k] = f
    pad(result, k, f)
    return new


@item
@no_type_check
def _to_frame(points, k, n, frame):
    """Fill y of a frame with the vertices of polyhedron k."""
    for v in range(n):
        for i in range(3):
            frame.y[v, i] = 0.0
            for j in range(3):
                frame.y[v, i] += (points[k, v, j] - frame.middle[j]) * frame.axes[i, j]
            frame.y[v, i] /= frame.scale[i]
