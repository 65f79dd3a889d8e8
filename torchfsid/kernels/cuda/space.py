"""Polyhedra and evidence in space on a GPU: the item functions of `polyhedron`, `solid` and `evidence_in_space`.

The scratch of an item grows with its facets and rows, too large for a thread's local memory. So it lies in arrays that
the caller allocates (`work`). Each of their entries belongs to a thread, which handles one item after the other. No
array has a size of its own in a kernel, so that a kernel is compiled once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import no_type_check

import numpy as np
from numba import cuda, float64, int64

from torchfsid.kernels import evidence_in_space as reading
from torchfsid.kernels.compiled import item
from torchfsid.kernels.cuda.launch import Arrays, launch
from torchfsid.kernels.polyhedron import EMPTY, cut_one, keep, keep_contradiction, merge_one
from torchfsid.kernels.saturation_in_space import NORMALS, unclipped_one
from torchfsid.kernels.scratch import entry
from torchfsid.kernels.simple_polyhedron import copy
from torchfsid.kernels.solid import extreme_of, measure_one, skeleton_one

NO_VALUES = (0,)
"""The values of a kernel that needs none: no argument of a kernel is empty."""


def clip(given: Sequence[Arrays], values: tuple[int, bool], results: Sequence[Arrays], stream: int = 0) -> None:
    """Cut all polyhedra by their rows, see `polyhedron.clip`.

    A polyhedron that has more facets than there are slots, since no facet can be merged, stays as it was.

    Args:
        given: polyhedra (points, meets, A, b, time, source, label, count, reach), and rows (A, b, time, source).
        values: the number of facets beyond which polyhedra are merged, and whether the label of a facet from row r of
            item k becomes -1 - (k R + r). Otherwise it becomes 0.
        results: to be filled: all polyhedra, of as many slots or more; outcome and shrunk; the rows (A, b, time,
            source) that contradict each other, NaN and -1 where there are none. Then the arrays `work`, see
            `scratch.places` for F facets and R rows.
        stream: the address of the stream to run on.
    """
    launch(_clip, len(results[-1][0]), given, (values[0], int(values[1])), results, stream)


def merged(given: Sequence[Arrays], values: tuple[int], results: Sequence[Arrays], stream: int = 0) -> None:
    """Merge all polyhedra to so many facets. `results` are the polyhedra, and `work` for F facets and no rows."""
    launch(_merged, len(results[-1][0]), given, values, results, stream)


def measures(given: Sequence[Arrays], values: tuple[()], results: Sequence[Arrays], stream: int = 0) -> None:
    """The results of `solid.measures` for points, meets, count and reach, and `work` for `solid.graph_places`."""
    launch(_measures, len(results[-1][0]), given, NO_VALUES, results, stream)


def skeleton(given: Sequence[Arrays], values: tuple[()], results: Sequence[Arrays], stream: int = 0) -> None:
    """The results of `solid.skeleton` for meets, count, wide and rows, and `work` for `solid.graph_places`."""
    launch(_skeleton, len(results[-1][0]), given, NO_VALUES, results, stream)


def extreme(given: Sequence[Arrays], values: tuple[()], results: Sequence[Arrays], stream: int = 0) -> None:
    """The result of `solid.extreme` for meets, vertices, y, rows and direction."""
    launch(_extreme, len(given[0][1]), given, NO_VALUES, results, stream)


def evidence(given: Sequence[Arrays], values: tuple[bool, float], results: Sequence[Arrays], stream: int = 0) -> None:
    """What a measurement says about theta, see `evidence_in_space`.

    Args:
        given: (A, b, hard), (C, d, u, usable), (bound, ball, drift), and the errors of directions (angles,) or ().
        values: `paper` and `active_tolerance`.
        results: the three parts of the result, to be filled. There are `evidence_in_space.rows_for` half-spaces. Then
            the arrays `work`, see `evidence_in_space.places`.
        stream: the address of the stream to run on.
    """
    rows, sample, bounds, angles = given
    given = rows, sample, bounds, angles or sample[2:3]  # an array in the place of one that is missing is not read
    flags = int(values[0]), int(len(angles) > 0)
    launch(_evidence, len(results[-1][0]), given, (*flags, values[1]), results, stream)


def unclipped(
    given: Sequence[Arrays], values: tuple[int, bool, float], results: Sequence[Arrays], stream: int = 0
) -> None:
    """The half-spaces of theta for clipped nominal controls, see `saturation_in_space.unclipped_in_space`.

    Args:
        given: Q (A, b, source), the cut (points, count, outcome, limits), the nominal controls (C, d, wishes, margin),
            and (informative,).
        values: the source of rows that repeat none of Q, whether controls are clipped by norm, and the dead speed.
        results: the half-spaces, to be filled. There are `saturation_in_space.rows_for`. Then the arrays `work`, see
            `saturation_in_space.places`.
        stream: the address of the stream to run on.
    """
    no_row, by_norm, dead_speed = values
    launch(_unclipped, len(results[-1][0]), given, (no_row, int(by_norm), dead_speed), results, stream)


@cuda.jit
@no_type_check
def _clip(polyhedra, rows, result, found, lost, work, values):
    t, threads = cuda.grid(1), work[0].shape[0]
    if t >= threads:
        return
    A, b, stamp, source = rows
    outcome, shrunk = found
    small = (
        cuda.local.array((3, 2), float64), cuda.local.array(4, int64), cuda.local.array(3, float64),
        cuda.local.array(3, float64), cuda.local.array((6, 3, 3), float64), cuda.local.array(3, float64),
        cuda.local.array((3, 3), float64), cuda.local.array(3, float64),
    )  # fmt: skip
    scratch = entry(work, t, polyhedra[3].shape[1], b.shape[1], small)
    for k in range(t, b.shape[0], threads):
        facets, outcome[k], smaller = cut_one(k, polyhedra, A, b, values[0], scratch)
        shrunk[k] = smaller and facets <= result[3].shape[1]
        for i in range(4):
            for j in range(3):
                lost[0][k, i, j] = np.nan
            lost[1][k, i], lost[2][k, i], lost[3][k, i] = np.nan, np.nan, -1
        if outcome[k] == EMPTY:
            keep_contradiction(k, polyhedra, stamp, source, scratch, lost)
        if shrunk[k]:
            keep(k, facets, polyhedra, stamp, source, scratch, values[1] != 0, result)
        else:
            copy(polyhedra, k, result)


@cuda.jit
@no_type_check
def _merged(polyhedra, result, work, values):
    t, threads = cuda.grid(1), work[0].shape[0]
    if t >= threads:
        return
    small = (
        cuda.local.array((3, 2), float64), cuda.local.array(4, int64), cuda.local.array(3, float64),
        cuda.local.array(3, float64), cuda.local.array((6, 3, 3), float64), cuda.local.array(3, float64),
        cuda.local.array((3, 3), float64), cuda.local.array(3, float64),
    )  # fmt: skip
    scratch = entry(work, t, polyhedra[3].shape[1], 0, small)
    stamp, none = polyhedra[4][:, :0], polyhedra[5][:, :0]
    for k in range(t, polyhedra[7].shape[0], threads):
        facets = merge_one(k, polyhedra, values[0], scratch)
        keep(k, facets, polyhedra, stamp, none, scratch, False, result)


@cuda.jit
@no_type_check
def _measures(polyhedra, result, work, values):
    t, threads = cuda.grid(1), work[0].shape[0]
    if t >= threads:
        return
    points, meets, count, reach = polyhedra
    graph = _graph(work, t)
    for k in range(t, count.shape[0], threads):
        measure_one(k, points, meets, count, reach, graph, result)


@cuda.jit
@no_type_check
def _skeleton(polyhedra, result, work, values):
    t, threads = cuda.grid(1), work[0].shape[0]
    if t >= threads:
        return
    meets, count, wide, rows = polyhedra
    small = cuda.local.array((3, 3), float64), cuda.local.array(3, float64), cuda.local.array(3, float64)
    graph = _graph(work, t)
    for k in range(t, count.shape[0], threads):
        skeleton_one(k, meets, count, wide, rows, graph, small, result)


@item
@no_type_check
def _graph(work, t):
    """Entry t of the arrays `work` as places for a graph."""
    edges, near, at = work
    for f in range(edges.shape[1]):
        for g in range(edges.shape[2]):
            edges[t, f, g] = -1
    return edges[t], near[t], at[t]


@cuda.jit
@no_type_check
def _extreme(given, result, values):
    k = cuda.grid(1)
    meets, vertices, y, rows, direction = given
    if k < vertices.shape[0]:
        for d in range(direction.shape[1]):
            result[0][k, d] = extreme_of(k, meets, vertices[k], y, rows, direction[k, d])


@cuda.jit
@no_type_check
def _evidence(rows, sample, bounds, errors, half_spaces, judged, kkt, work, values):
    t, threads = cuda.grid(1), work[0].shape[0]
    if t >= threads:
        return
    m, triples, reals = rows[1].shape[1], work[0], work[1]
    scratch = (
        triples[t, :m], reals[t, :m], work[3][t], triples[t, m : 2 * m], cuda.local.array((3, 3), float64),
        reals[t, m:], triples[t, 2 * m :], work[2][t], cuda.local.array((NORMALS, 3), float64),
        cuda.local.array(NORMALS, int64),
    )  # fmt: skip
    angles = errors[0] if values[1] != 0 else errors[0][:, :0]
    for k in range(t, rows[1].shape[0], threads):
        pad_one(k, half_spaces, kkt)
        reading.read_one(k, rows, sample, bounds, angles, values[0] != 0, values[2], scratch, half_spaces, judged, kkt)


@cuda.jit
@no_type_check
def _unclipped(admissible, cut, nominal, informative, rows, work, values):
    t, threads = cuda.grid(1), work[0].shape[0]
    if t >= threads:
        return
    (A, b, source), (no_row, by_norm, dead_speed) = admissible, values
    row_A, row_b, row_source = rows
    scratch = work[0][t], work[1][t], cuda.local.array((NORMALS, 3), float64), cuda.local.array(NORMALS, int64)
    for k in range(t, b.shape[0], threads):
        for n in range(row_b.shape[1]):
            row_b[k, n], row_source[k, n] = 1.0, -1
            for e in range(row_A.shape[2]):
                row_A[k, n, e] = 0.0
        if informative[0][k]:
            unclipped_one(k, (A, b, source, no_row), cut, nominal, (by_norm != 0, dead_speed), scratch, rows)


@item
@no_type_check
def pad_one(k, half_spaces, kkt):
    """Fill the places of robot k with padding and zeros."""
    row_A, row_b, row_source = half_spaces
    G, f, projector, free, offset = kkt[:5]
    for n in range(row_b.shape[1]):
        row_b[k, n], row_source[k, n] = 1.0, -1
        for e in range(row_A.shape[2]):
            row_A[k, n, e] = 0.0
    for i in range(3):
        f[k, i], offset[k, i] = 0.0, 0.0
        for e in range(G.shape[2]):
            G[k, i, e] = 0.0
        for j in range(3):
            projector[k, i, j], free[k, i, j] = 0.0, 0.0
