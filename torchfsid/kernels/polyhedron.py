"""Batches of simple polyhedra cut by half-spaces, and merged to fewer facets, one polyhedron at a time.

`cutting` says how one is cut, `roofs` how facets are merged, `simple_polyhedron` how a batch is stored.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, launcher
from torchfsid.kernels.cutting import EMPTY, NONEMPTY, cut_polyhedron, mark_cuts
from torchfsid.kernels.roofs import merge
from torchfsid.kernels.scratch import scratch_of
from torchfsid.kernels.simple_polyhedron import copy, find_facets, link, pad, widened
from torchfsid.kernels.solid import volume_of
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
    (B, R), F = b.shape, polyhedra[3].shape[1]
    scratch = scratch_of(F, R)
    outcome, shrunk = np.zeros(B, np.int64), np.zeros(B, np.bool_)
    lost = np.full((B, 4, 3), np.nan), np.full((B, 4), np.nan), np.full((B, 4), np.nan), np.full((B, 4), -1)
    result, slots, new = polyhedra, 0, 0
    entered = np.empty(B * R if first_label > 0 else 0, np.int64)
    for k in range(B):
        facets, outcome[k], shrunk[k] = cut_one(k, polyhedra, A, b, most, scratch)
        if outcome[k] == EMPTY:
            keep_contradiction(k, polyhedra, stamp, source, scratch, lost)
        if not shrunk[k]:
            if slots > 0:
                copy(polyhedra, k, result)
            continue
        if facets > slots:  # seldom: slots grow by eight, and the polyhedra before this one are copied
            slots = max((facets + 7) // 8 * 8, F)
            result = widened(result, k, slots)
        keep(k, facets, polyhedra, stamp, source, scratch, first_label > 0, result)
        if first_label > 0:
            label = result[6]
            for f in range(facets):
                if label[k, f] < 0:
                    label[k, f], entered[new] = first_label + new, -1 - label[k, f]
                    new += 1
    return result, outcome, shrunk, entered[:new], lost


@launcher
@no_type_check
def merged(polyhedra, most):
    """The polyhedra with at most `most` facets, or as few as can be reached."""
    B, F = polyhedra[3].shape
    scratch, result = scratch_of(F, 0), widened(polyhedra, 0, F)
    stamp, none = np.empty((B, 0)), np.empty((B, 0), np.int64)
    for k in range(B):
        facets = merge_one(k, polyhedra, most, scratch)
        keep(k, facets, polyhedra, stamp, none, scratch, False, result)
    return result


@item
@no_type_check
def cut_one(k, polyhedra, A, b, most, scratch):
    """Cut polyhedron k, and merge what is left to `most` facets. It is left in `scratch`.

    Returns:
        Its number of facets, the outcome, and whether it is smaller.
    """
    points, meets, _, own_b, _, _, _, count, reach = polyhedra
    cutting, lines, at, graph, frame = scratch.cutting, scratch.lines, scratch.at, scratch.graph, scratch.frame
    F, n = own_b.shape[1], 2 * count[k] - 4
    cuts = mark_cuts(points, k, n, reach, A, b, scratch.box, scratch.tolerance, scratch.depth, cutting)
    if cuts == 0:
        return count[k], NONEMPTY, False
    _load(polyhedra, k, scratch)
    for s in range(cuts):
        for j in range(3):
            lines[F + cutting[s], j] = A[k, cutting[s], j]
        lines[F + cutting[s], 3] = b[k, cutting[s]]
    n, outcome, shrunk = cut_polyhedron(
        graph, scratch.spare, n, lines, F, reach[k], scratch.tolerance, cutting, cuts, scratch.marks, scratch.proof
    )
    if shrunk and (n + 4) // 2 > most:
        n = merge(graph, n, lines, most, scratch.far, at, frame, scratch.roof)
        larger = volume_of(frame.y, graph.meets, graph.near, at, 3, scratch.centre)
        # The volume before, in the same frame. Each volume carries the round-off of its sum.
        _to_frame(points, k, 2 * count[k] - 4, frame)
        link(meets[k], 2 * count[k] - 4, scratch.edges, scratch.spare.near)
        find_facets(meets[k], 2 * count[k] - 4, at)
        smaller = volume_of(frame.y, meets[k], scratch.spare.near, at, 3, scratch.centre)
        shrunk = larger <= smaller * (1 - ROUND_OFF)
    return (n + 4) // 2, outcome, shrunk


@item
@no_type_check
def merge_one(k, polyhedra, most, scratch):
    """Merge polyhedron k to `most` facets. It is left in `scratch`. Returns its number of facets."""
    _load(polyhedra, k, scratch)
    n = 2 * polyhedra[7][k] - 4
    n = merge(scratch.graph, n, scratch.lines, most, scratch.far, scratch.at, scratch.frame, scratch.roof)
    return (n + 4) // 2


@item
@no_type_check
def _load(polyhedra, k, scratch):
    """Copy polyhedron k to the graph, its rows to the first lines, and its reach to `far`."""
    points, meets, A, b, _, _, _, count, reach = polyhedra
    graph, lines = scratch.graph, scratch.lines
    n = 2 * count[k] - 4
    for v in range(n):
        for j in range(3):
            graph.points[v, j], graph.meets[v, j] = points[k, v, j], meets[k, v, j]
    for f in range(count[k]):
        for j in range(3):
            lines[f, j] = A[k, f, j]
        lines[f, 3] = b[k, f]
    for j in range(3):
        scratch.far[j] = reach[k, j]
    link(graph.meets, n, scratch.edges, graph.near)


@item
@no_type_check
def keep(k, facets, polyhedra, stamp, source, scratch, marks, result):
    """Write the polyhedron that is left in `scratch` to polyhedron k of `result`.

    Facets stand in the order of their lines. With `marks`, the label of a facet from row r is -1 - (k R + r) until it
    gets its own. Otherwise it is 0.
    """
    _, _, _, b, time, own_source, label, _, _ = polyhedra
    to_points, to_meets, to_A, to_b, to_time, to_source, to_label, to_count, to_reach = result
    graph, lines, at, n = scratch.graph, scratch.lines, scratch.at, 2 * facets - 4
    F, R, f = b.shape[1], stamp.shape[1], 0
    find_facets(graph.meets, n, at)
    for e in range(len(at)):
        if at[e] < 0:
            continue
        for j in range(3):
            to_A[k, f, j] = lines[e, j]
        to_b[k, f] = lines[e, 3]
        if e < F:
            to_time[k, f], to_source[k, f], to_label[k, f] = time[k, e], own_source[k, e], label[k, e]
        else:
            to_time[k, f], to_source[k, f] = stamp[k, e - F], source[k, e - F]
            to_label[k, f] = -1 - (k * R + e - F) if marks else 0
        at[e] = f
        f += 1
    for v in range(n):
        for j in range(3):
            to_points[k, v, j], to_meets[k, v, j] = graph.points[v, j], at[graph.meets[v, j]]
    for j in range(3):
        to_reach[k, j] = scratch.far[j]
    to_count[k] = facets
    pad(result, k, facets)


@item
@no_type_check
def keep_contradiction(k, polyhedra, stamp, source, scratch, lost):
    """Write the lines of the proof to item k of `lost`: A, b, time and source."""
    time, own_source = polyhedra[4], polyhedra[5]
    lost_A, lost_b, lost_time, lost_source = lost
    F = time.shape[1]
    for i in range(4):
        e = scratch.proof[i]
        if e >= 0:
            for j in range(3):
                lost_A[k, i, j] = scratch.lines[e, j]
            lost_b[k, i] = scratch.lines[e, 3]
            lost_time[k, i] = time[k, e] if e < F else stamp[k, e - F]
            lost_source[k, i] = own_source[k, e] if e < F else source[k, e - F]


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
