"""Polyhedra and evidence in space on a GPU: the item functions of `polyhedron`, `solid` and `evidence_in_space`.

The scratch of an item grows with its facets and rows, too large for a thread's local memory. So it lies in arrays that
the caller allocates (`work`). Each of their entries belongs to a thread, which handles one item after the other.
Sizes are handed to a kernel as numbers, so that it is compiled once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import no_type_check

import numpy as np
from numba import cuda, float64, int64

from torchfsid.kernels import evidence_in_space as reading
from torchfsid.kernels.compiled import item
from torchfsid.kernels.cuda.arrays import real, short, truth, whole
from torchfsid.kernels.cuda.launch import Arrays, launch_by_address
from torchfsid.kernels.polyhedron import EMPTY, cut_one, keep, keep_contradiction, merge_one
from torchfsid.kernels.saturation_in_space import NORMALS, unclipped_one
from torchfsid.kernels.scratch import entry
from torchfsid.kernels.simple_polyhedron import copy
from torchfsid.kernels.solid import extreme_of, measure_one, skeleton_one

Groups = Sequence[Arrays]


def clip(given: Groups, values: tuple[int, bool], results: Groups, stream: int = 0) -> None:
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
    (B, R), threads, (most, marks) = given[1][1].shape, len(results[-1][0]), values
    sizes = threads, B, given[0][3].shape[1], R, results[0][3].shape[1]
    launch_by_address(_clip, threads, given, (most, int(marks), *sizes), results, stream)


def merged(given: Groups, values: tuple[int], results: Groups, stream: int = 0) -> None:
    """Merge all polyhedra to so many facets. `results` are the polyhedra, and `work` for F facets and no rows."""
    threads = len(results[-1][0])
    launch_by_address(_merged, threads, given, (*values, threads, *given[0][3].shape), results, stream)


def measures(given: Groups, values: tuple[()], results: Groups, stream: int = 0) -> None:
    """The results of `solid.measures` for points, meets, count and reach, and `work` for `solid.graph_places`."""
    threads, (B, V, _) = len(results[-1][0]), given[0][0].shape
    launch_by_address(_measures, threads, given, (threads, B, V), results, stream)


def skeleton(given: Groups, values: tuple[()], results: Groups, stream: int = 0) -> None:
    """The results of `solid.skeleton` for meets, count, wide and rows, and `work` for `solid.graph_places`."""
    threads, (B, F, _) = len(results[-1][0]), given[0][3].shape
    launch_by_address(_skeleton, threads, given, (threads, B, F), results, stream)


def extreme(given: Groups, values: tuple[()], results: Groups, stream: int = 0) -> None:
    """The result of `solid.extreme` for meets, vertices, y, rows and direction."""
    (B, F, _), D = given[0][3].shape, given[0][4].shape[1]
    launch_by_address(_extreme, B, given, (B, F, D), results, stream)


def evidence(given: Groups, values: tuple[bool, float], results: Groups, stream: int = 0) -> None:
    """What a measurement says about theta, see `evidence_in_space`.

    Args:
        given: (A, b, hard), (C, d, u, usable), (bound, ball, drift), and the errors of directions (angles,) or ().
        values: `paper` and `active_tolerance`.
        results: the three parts of the result, to be filled. There are `evidence_in_space.rows_for` half-spaces. Then
            the arrays `work`, see `evidence_in_space.places`.
        stream: the address of the stream to run on.
    """
    (rows, sample, bounds, angles), (paper, tolerance) = given, values
    given = rows, sample, bounds, angles or sample[2:3]  # an array in the place of one that is missing is not read
    (B, m), threads, generators = rows[1].shape, len(results[-1][0]), results[-1][2].shape[1]
    sizes = threads, B, m, sample[0].shape[2], results[0][1].shape[1], generators
    of_bounds = *bounds[0].shape, len(bounds[1]), len(bounds[2])
    flags = int(paper), int(len(angles) > 0)
    launch_by_address(_evidence, threads, given, (tolerance, *flags, *sizes, *of_bounds), results, stream)


def unclipped(given: Groups, values: tuple[int, bool, float], results: Groups, stream: int = 0) -> None:
    """The half-spaces of theta for clipped nominal controls, see `saturation_in_space.unclipped_in_space`.

    Args:
        given: Q (A, b, source), the cut (points, count, outcome, limits), the nominal controls (C, d, wishes, margin),
            and (informative,).
        values: the source of rows that repeat none of Q, whether controls are clipped by norm, and the dead speed.
        results: the half-spaces, to be filled. There are `saturation_in_space.rows_for`. Then the arrays `work`, see
            `saturation_in_space.places`.
        stream: the address of the stream to run on.
    """
    (no_row, by_norm, dead_speed), (C, _, wishes, margin), threads = values, given[2], len(results[-1][0])
    sizes = threads, *given[0][1].shape, C.shape[2], results[0][1].shape[1], given[1][0].shape[1], wishes.shape[1]
    numbers = no_row, int(by_norm), dead_speed, *sizes, len(margin), results[-1][1].shape[1]
    launch_by_address(_unclipped, threads, given, numbers, results, stream)


@item
@no_type_check
def polyhedra_of(at, B, F):
    V = 2 * F - 4
    return (
        real((at[0], B, V, 3)), whole((at[1], B, V, 3)), real((at[2], B, F, 3)), real((at[3], B, F)),
        real((at[4], B, F)), whole((at[5], B, F)), whole((at[6], B, F)), whole((at[7], B)), real((at[8], B, 3)),
    )  # fmt: skip


@item
@no_type_check
def rows_of(at, B, R):
    return real((at[0], B, R, 3)), real((at[1], B, R)), real((at[2], B, R)), whole((at[3], B, R))


@item
@no_type_check
def work_of(at, T, F, R):
    """The arrays of `scratch.places` for T threads."""
    L = F + R
    return (
        real((at[0], T, 9 * L, 3)), short((at[1], T, 10 * L, 3)), real((at[2], T, 5 * L + 2 * R)),
        short((at[3], T, 13 * L + R)), real((at[4], T, 2 * L, 5)), short((at[5], T, F, F)),
    )  # fmt: skip


@item
@no_type_check
def graph_of_thread(at, t, T, F, V):
    """The part of thread t of the arrays of `solid.graph_places`."""
    edges, near, at = short((at[0], T, F, F)), short((at[1], T, V, 3)), short((at[2], T, F))
    for f in range(F):
        for g in range(F):
            edges[t, f, g] = -1
    return edges[t], near[t], at[t]


@cuda.jit
@no_type_check
def _clip(polyhedra, rows, result, found, lost, work, values):
    t, (most, marks, threads, B, F, R, slots) = cuda.grid(1), values
    if t >= threads:
        return
    polyhedra, result, lost = polyhedra_of(polyhedra, B, F), polyhedra_of(result, B, slots), rows_of(lost, B, 4)
    A, b, stamp, source = rows_of(rows, B, R)
    outcome, shrunk = whole((found[0], B)), truth((found[1], B))
    small = (
        cuda.local.array((3, 2), float64), cuda.local.array(4, int64), cuda.local.array(3, float64),
        cuda.local.array(3, float64), cuda.local.array((6, 3, 3), float64), cuda.local.array(3, float64),
        cuda.local.array((3, 3), float64), cuda.local.array(3, float64),
    )  # fmt: skip
    scratch = entry(work_of(work, threads, F, R), t, F, R, small)
    for k in range(t, B, threads):
        facets, outcome[k], smaller = cut_one(k, polyhedra, A, b, most, scratch)
        shrunk[k] = smaller and facets <= slots
        for i in range(4):
            for j in range(3):
                lost[0][k, i, j] = np.nan
            lost[1][k, i], lost[2][k, i], lost[3][k, i] = np.nan, np.nan, -1
        if outcome[k] == EMPTY:
            keep_contradiction(k, polyhedra, stamp, source, scratch, lost)
        if shrunk[k]:
            keep(k, facets, polyhedra, stamp, source, scratch, marks != 0, result)
        else:
            copy(polyhedra, k, result)


@cuda.jit
@no_type_check
def _merged(polyhedra, result, work, values):
    t, (most, threads, B, F) = cuda.grid(1), values
    if t >= threads:
        return
    polyhedra, result = polyhedra_of(polyhedra, B, F), polyhedra_of(result, B, F)
    small = (
        cuda.local.array((3, 2), float64), cuda.local.array(4, int64), cuda.local.array(3, float64),
        cuda.local.array(3, float64), cuda.local.array((6, 3, 3), float64), cuda.local.array(3, float64),
        cuda.local.array((3, 3), float64), cuda.local.array(3, float64),
    )  # fmt: skip
    scratch = entry(work_of(work, threads, F, 0), t, F, 0, small)
    stamp, none = polyhedra[4][:, :0], polyhedra[5][:, :0]
    for k in range(t, B, threads):
        facets = merge_one(k, polyhedra, most, scratch)
        keep(k, facets, polyhedra, stamp, none, scratch, False, result)


@cuda.jit
@no_type_check
def _measures(given, found, work, values):
    t, (threads, B, V) = cuda.grid(1), values
    if t >= threads:
        return
    points, meets = real((given[0], B, V, 3)), whole((given[1], B, V, 3))
    count, reach = whole((given[2], B)), real((given[3], B, 3))
    result = (
        real((found[0], B, V, 3)), real((found[1], B, 3)), real((found[2], B, 3, 3)), real((found[3], B, 3)),
        whole((found[4], B)), real((found[5], B)), real((found[6], B, 3)),
    )  # fmt: skip
    graph = graph_of_thread(work, t, threads, (V + 4) // 2, V)
    for k in range(t, B, threads):
        measure_one(k, points, meets, count, reach, graph, result)


@cuda.jit
@no_type_check
def _skeleton(given, found, work, values):
    t, (threads, B, F) = cuda.grid(1), values
    if t >= threads:
        return
    V, triangles = 2 * F - 4, 4 * F - 12
    meets, count, wide = whole((given[0], B, V, 3)), whole((given[1], B)), whole((given[2], B))
    rows = real((given[3], B, F, 3))
    result = whole((found[0], B, triangles, 3)), whole((found[1], B, triangles)), truth((found[2], B, V))
    small = cuda.local.array((3, 3), float64), cuda.local.array(3, float64), cuda.local.array(3, float64)
    graph = graph_of_thread(work, t, threads, F, V)
    for k in range(t, B, threads):
        skeleton_one(k, meets, count, wide, rows, graph, small, result)


@cuda.jit
@no_type_check
def _extreme(given, found, values):
    k, (B, F, D) = cuda.grid(1), values
    if k >= B:
        return
    V = 2 * F - 4
    meets, vertices, y = whole((given[0], B, V, 3)), whole((given[1], B)), real((given[2], B, V, 3))
    rows, direction, result = real((given[3], B, F, 3)), real((given[4], B, D, 3)), whole((found[0], B, D))
    for d in range(D):
        result[k, d] = extreme_of(k, meets, vertices[k], y, rows, direction[k, d])


@cuda.jit
@no_type_check
def _evidence(rows, sample, bounds, errors, half_spaces, judged, kkt, work, values):
    tolerance, paper, uncertain, threads, B, m, p, R, generators, items, entries, balls, drifts = values
    t = cuda.grid(1)
    if t >= threads:
        return
    rows = real((rows[0], B, m, 3)), real((rows[1], B, m)), truth((rows[2], m))
    sample = real((sample[0], B, 3, p)), real((sample[1], B, 3)), real((sample[2], B, 3)), truth((sample[3], B))
    bounds = real((bounds[0], items, entries)), real((bounds[1], balls)), real((bounds[2], drifts))
    angles = real((errors[0], B, m))[:, : m if uncertain != 0 else 0]
    half_spaces = real((half_spaces[0], B, R, p)), real((half_spaces[1], B, R)), whole((half_spaces[2], B, R))
    judged = (
        truth((judged[0], B)), truth((judged[1], B)), truth((judged[2], B)), real((judged[3], B, m)),
        real((judged[4], B, m)),
    )  # fmt: skip
    kkt = (
        real((kkt[0], B, 3, p)), real((kkt[1], B, 3)), real((kkt[2], B, 3, 3)), real((kkt[3], B, 3, 3)),
        real((kkt[4], B, 3)), truth((kkt[5], B, m)), whole((kkt[6], B)), whole((kkt[7], B)), whole((kkt[8], B)),
    )  # fmt: skip
    triples, reals = real((work[0], threads, 2 * m + generators, 3)), real((work[1], threads, 2 * m))
    order, near = whole((work[2], threads, generators)), truth((work[3], threads, m))
    scratch = (
        triples[t, :m], reals[t, :m], near[t], triples[t, m : 2 * m], cuda.local.array((3, 3), float64),
        reals[t, m:], triples[t, 2 * m :], order[t], cuda.local.array((NORMALS, 3), float64),
        cuda.local.array(NORMALS, int64),
    )  # fmt: skip
    for k in range(t, B, threads):
        pad_rows(k, half_spaces)
        pad_kkt(k, kkt)
        reading.read_one(k, rows, sample, bounds, angles, paper != 0, tolerance, scratch, half_spaces, judged, kkt)


@cuda.jit
@no_type_check
def _unclipped(admissible, cut, nominal, informative, rows, work, values):
    no_row, by_norm, dead_speed, threads, B, own, p, R, V, v, margins, most = values
    t = cuda.grid(1)
    if t >= threads:
        return
    admissible = real((admissible[0], B, own, 3)), real((admissible[1], B, own)), whole((admissible[2], B, own)), no_row
    cut = real((cut[0], B, V, 3)), whole((cut[1], B)), whole((cut[2], B)), real((cut[3], B, 3))
    nominal = (
        real((nominal[0], B, 3, p)), real((nominal[1], B, 3)), real((nominal[2], B, v, 3)), real((nominal[3], margins)),
    )  # fmt: skip
    rows = real((rows[0], B, R, p)), real((rows[1], B, R)), whole((rows[2], B, R))
    informative = truth((informative[0], B))
    outward, order = real((work[0], threads, most, 3)), whole((work[1], threads, most))
    scratch = outward[t], order[t], cuda.local.array((NORMALS, 3), float64), cuda.local.array(NORMALS, int64)
    for k in range(t, B, threads):
        pad_rows(k, rows)
        if informative[k]:
            unclipped_one(k, admissible, cut, nominal, (by_norm != 0, dead_speed), scratch, rows)


@item
@no_type_check
def pad_rows(k, half_spaces):
    """Fill the half-spaces of robot k with padding."""
    row_A, row_b, row_source = half_spaces
    for n in range(row_b.shape[1]):
        row_b[k, n], row_source[k, n] = 1.0, -1
        for e in range(row_A.shape[2]):
            row_A[k, n, e] = 0.0


@item
@no_type_check
def pad_kkt(k, kkt):
    """Fill the sums of robot k with zeros."""
    G, f, projector, free, offset = kkt[:5]
    for i in range(3):
        f[k, i], offset[k, i] = 0.0, 0.0
        for e in range(G.shape[2]):
            G[k, i, e] = 0.0
        for j in range(3):
            projector[k, i, j], free[k, i, j] = 0.0, 0.0
