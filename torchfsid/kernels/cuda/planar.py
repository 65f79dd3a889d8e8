"""Polygons and evidence in the plane on a GPU: the item functions of `polygon` and `evidence`, one thread an item.

A kernel is compiled for each number of rows. An item's scratch lies in its thread's local memory. Arguments are tensors
or arrays whose first index has stride 1, as in Fortran.

The threads of a warp wait for the one with the most cuts. Most polygons are cut by few rows, and some by all. So a
polygon with more than `FEW` cuts is put on a list, and a second kernel cuts those on the list. The order in the list is
random, and the results do not depend on it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import no_type_check

import numpy as np
from numba import boolean, cuda, float64, int32, int64

from torchfsid.kernels import evidence as reading
from torchfsid.kernels.compiled import item
from torchfsid.kernels.cuda.arrays import real, short, truth, whole
from torchfsid.kernels.cuda.launch import Arrays, launch_by_address
from torchfsid.kernels.evidence import critical_region, inverse_optimal, is_finite, judge, pad_rows, read_one
from torchfsid.kernels.kkt import solve_one
from torchfsid.kernels.polygon import (
    EMPTY,
    OK,
    copy_polygon,
    cut_loaded,
    keep_contradiction,
    keep_ring,
    load_ring,
    mark_cuts,
)
from torchfsid.kernels.saturation import BOUNDS, POINTS, ROWS, TOUCHING, clipped_inverse_optimal
from torchfsid.tolerances import SPREAD

FEW = 4
"""Cuts of a polygon that does not keep others waiting."""


def clip(given: Sequence[Arrays], values: tuple[int, bool], results: Sequence[Arrays], stream: int = 0) -> None:
    """Cut all polygons by their rows, see `polygon.clip`.

    A polygon that has more edges than there are slots, since parallel edges cannot be merged, stays as it was.

    Args:
        given: polygons (vertices, A, b, time, source, label, count, reach), and rows (A, b, time, source), see
            `polygon.clip`.
        values: the number of edges beyond which polygons are merged, and whether the label of an edge from row r of
            item k becomes -1 - (k R + r). Otherwise it becomes 0.
        results: to be filled: all polygons, of as many slots or more; outcome and shrunk; the rows (A, b, time, source)
            that contradict each other, NaN and -1 where there are none; and the list, B + 1 numbers (int32) of which
            the first is zero.
        stream: the address of the stream to run on.
    """
    (B, R), V, most = given[1][1].shape, given[0][2].shape[1], values[0]
    sizes = B, V, results[0][2].shape[1], *given[1][2].shape
    for listed in (False, True):
        kernel = _clip(R, max(V, most) + R + 1, listed)
        launch_by_address(kernel, B, given, (most, int(values[1]), *sizes), results, stream)


def evidence(
    given: Sequence[Arrays],
    values: tuple[bool, float, tuple[float, float, bool, float] | None],
    results: Sequence[Arrays],
    stream: int = 0,
) -> None:
    """The half-spaces of `evidence.evidence`, and which samples are used.

    Args:
        given: (A, b, hard, relaxed), (C, d, u, usable), (bound, ball, drift), the errors of directions (angles,) or (),
            and the vertices of Theta (corners,), or () if nominal controls are not clipped.
        values: `paper`, `active_tolerance`, and of a clipped nominal control two limits, whether they are by norm, and
            the dead speed.
        results: to be filled: half-spaces, of which there are `evidence.rows_for`, and (informative, alarmed,
            infeasible).
        stream: the address of the stream to run on.
    """
    rows, sample, bounds, angles, corners = given
    (B, m), p, (paper, tolerance, clip) = rows[1].shape, sample[0].shape[2], values
    kernel = _evidence(m, p, paper, len(angles) > 0, corners[0].shape[1] if corners else 0)
    # Arrays in the place of those that are missing are not read.
    given = rows, sample, bounds, (angles[0] if angles else sample[2], corners[0] if corners else sample[0])
    first, second, by_norm, dead_speed = clip or (1.0, 1.0, False, 0.0)
    limits, sizes = (first, second, dead_speed, int(by_norm)), [extent for array in bounds for extent in array.shape]
    launch_by_address(kernel, B, given, (tolerance, *limits, B, *sizes), results, stream)


def details(given: Sequence[Arrays], values: tuple[float], results: Sequence[Arrays], stream: int = 0) -> None:
    """The slacks and KKT conditions, see `evidence.details`.

    Args:
        given: (A, b, hard, relaxed), (C, d, u) and (bound,).
        values: `active_tolerance`.
        results: to be filled: (slack, excess), and the KKT conditions as in `KktSolution`.
        stream: the address of the stream to run on.
    """
    (B, m), p = given[0][1].shape, given[1][0].shape[2]
    launch_by_address(_details(m, p), B, given, (*values, B, *given[2][0].shape), results, stream)


@item
@no_type_check
def polygons_of(at, B, V):
    return (
        real((at[0], B, V, 2)), real((at[1], B, V, 2)), real((at[2], B, V)), real((at[3], B, V)),
        whole((at[4], B, V)), whole((at[5], B, V)), whole((at[6], B)), real((at[7], B, 2)),
    )  # fmt: skip


@item
@no_type_check
def rows_of(at, B, R, times, stamps):
    return real((at[0], B, R, 2)), real((at[1], B, R)), real((at[2], times, stamps)), whole((at[3], B, R))


@cache
def _clip(R: int, W: int, listed: bool) -> Callable:
    """The kernel for R rows, and rings of fewer than W - R vertices: for those on the list, or for all others."""

    @no_type_check
    def clip_kernel(polygons, rows, result, found, lost, late, values):
        i, (most, marks, B, V, slots, times, stamps) = cuda.grid(1), values
        late, outcome, shrunk = short((late[0], B + 1)), whole((found[0], B)), truth((found[1], B))
        if i >= (late[0] if listed else B):
            return
        polygons, result = polygons_of(polygons, B, V), polygons_of(result, B, slots)
        rows, lost = rows_of(rows, B, R, times, stamps), rows_of(lost, B, 3, B, 3)
        A, b = rows[:2]
        k = int64(late[i + 1]) if listed else i
        ring, edge = cuda.local.array((1, W, 2), float64), cuda.local.array(W, int32)
        bound, tolerance = cuda.local.array(R, float64), cuda.local.array(R, float64)
        depth, cutting = cuda.local.array(R, float64), cuda.local.array(R, int32)
        scratch = ring, edge, bound, tolerance, depth, cutting
        n = load_ring(k, polygons, ring, edge)
        cuts = mark_cuts(k, n, polygons, A, b, scratch)
        if cuts > FEW and not listed:
            late[cuda.atomic.add(late, 0, 1) + 1] = k
            return
        state, smaller, row, before, after = OK, False, -1, -1, -1
        if cuts > 0:
            n, state, smaller, row, before, after = cut_loaded(k, n, cuts, polygons, A, most, scratch)
        smaller = smaller and n <= slots
        outcome[k], shrunk[k] = state, smaller
        for j in range(3):
            lost[0][k, j, 0], lost[0][k, j, 1], lost[1][k, j] = np.nan, np.nan, np.nan
            lost[2][k, j], lost[3][k, j] = np.nan, -1
        if state == EMPTY:
            keep_contradiction(k, (row, before, after), polygons, rows, scratch, lost)
        if smaller or cuts == 0:
            keep_ring(k, n, polygons, rows, scratch, marks != 0, result)
        else:
            copy_polygon(polygons, k, result)

    return cuda.jit(clip_kernel)


@cache
def _evidence(m: int, p: int, paper: bool, uncertain: bool, slots: int) -> Callable:
    """The kernel for m rows and p parameters, and for clipped nominal controls if sets have slots for vertices."""
    directions, clips = reading.CRITICAL_DIRECTIONS if paper else reading.DIRECTIONS, slots > 0
    R = reading.rows_for(m, paper, clips)
    normals_of, generators = len(directions) + 1, m * len(SPREAD) if uncertain and not paper else m
    corners_of, of_rows, of_Q, touching, most = (slots, ROWS, BOUNDS, TOUCHING, POINTS) if clips else (1, 1, 1, 1, 1)

    @no_type_check
    def evidence_kernel(rows, sample, bounds, errors, half_spaces, judged, values):
        k, (tolerance, first, second, dead_speed, by_norm, B, items, entries, balls, drifts) = cuda.grid(1), values
        if k >= B:
            return
        rows = real((rows[0], B, m, 2)), real((rows[1], B, m)), truth((rows[2], m)), truth((rows[3], m))
        around = cuda.const.array_like(directions)
        unit, unit_b = cuda.local.array((m, 2), float64), cuda.local.array(m, float64)
        near, angle = cuda.local.array(m, boolean), cuda.local.array(generators, float64)
        order, generator = cuda.local.array(generators, int32), cuda.local.array(normals_of, int32)
        normals = cuda.local.array((normals_of, 2), float64)
        scratch = unit, unit_b, near, angle, order, normals, generator
        C, d, u = real((sample[0], B, 2, p)), real((sample[1], B, 2)), real((sample[2], B, 2))
        usable = truth((sample[3], B))
        bound, ball, drift = real((bounds[0], items, entries)), real((bounds[1], balls)), real((bounds[2], drifts))
        angles = real((errors[0], B, m)) if uncertain else real((errors[0], B, m))[:, :0]
        fan = angles[:, :0] if paper else angles
        relaxed, relaxes = rows[3], False
        for j in range(m):
            relaxes = relaxes or relaxed[j]
        informative, alarmed, infeasible = truth((judged[0], B)), truth((judged[1], B)), truth((judged[2], B))
        slack, excess = cuda.local.array((1, m), float64), cuda.local.array((1, m), float64)
        G, f = cuda.local.array((1, 2, p), float64), cuda.local.array((1, 2), float64)
        projector, free = cuda.local.array((1, 2, 2), float64), cuda.local.array((1, 2, 2), float64)
        offset, active = cuda.local.array((1, 2), float64), cuda.local.array((1, m), boolean)
        n_active, rank, case = cuda.local.array(1, int32), cuda.local.array(1, int32), cuda.local.array(1, int32)
        count = read_one(
            k, 0, rows, (C, d, u, usable, bound), angles, fan, around, relaxes, paper, tolerance, scratch,
            (informative, alarmed, infeasible, slack, excess),
            (G, f, projector, free, offset, active, n_active, rank, case),
        )  # fmt: skip
        row_A, row_b = real((half_spaces[0], B, R, p)), real((half_spaces[1], B, R))
        row_source = whole((half_spaces[2], B, R))
        room, shift = ball[min(k, len(ball) - 1)], drift[min(k, len(drift) - 1)]
        if count >= 0 and paper:
            count = critical_region(
                k, 0, unit, unit_b, C, d, G, f, projector, offset, active, normals, generator, count,
                row_A, row_b, row_source,
            )  # fmt: skip
        elif count >= 0 and clips:
            found = (
                cuda.local.array((of_rows, 2), float64),
                cuda.local.array(of_rows, float64),
                cuda.local.array(of_rows, int64),
            )
            work = (
                cuda.local.array((corners_of, 2), float64),
                cuda.local.array(of_Q, float64),
                cuda.local.array((touching, 2), float64),
                cuda.local.array((most, 2), float64),
                found,
            )
            clip = (first, second), by_norm != 0, dead_speed, real((errors[1], B, slots, 2))
            count = clipped_inverse_optimal(
                k, m, u, room, shift, C, d, clip, normals, generator, count, len(order), work, row_A, row_b, row_source
            )
        elif count >= 0:
            inverse_optimal(
                k, m, u, room + shift, C, d, normals, generator, count, len(order), row_A, row_b, row_source
            )
        pad_rows(k, max(count, 0), row_A, row_b, row_source)

    return cuda.jit(evidence_kernel)


@cache
def _details(m: int, p: int) -> Callable:
    """The kernel for m rows and p parameters."""

    @no_type_check
    def details_kernel(rows, sample, bounds, slacks, kkt, values):
        k, (tolerance, B, items, entries) = cuda.grid(1), values
        if k >= B:
            return
        A, b, hard, relaxed = real((rows[0], B, m, 2)), real((rows[1], B, m)), truth((rows[2], m)), truth((rows[3], m))
        C, d, u = real((sample[0], B, 2, p)), real((sample[1], B, 2)), real((sample[2], B, 2))
        bound, slack, excess = real((bounds[0], items, entries)), real((slacks[0], B, m)), real((slacks[1], B, m))
        G, f, offset = real((kkt[0], B, 2, p)), real((kkt[1], B, 2)), real((kkt[4], B, 2))
        projector, free, active = real((kkt[2], B, 2, 2)), real((kkt[3], B, 2, 2)), truth((kkt[5], B, m))
        solved = G, f, projector, free, offset, active, whole((kkt[6], B)), whole((kkt[7], B)), whole((kkt[8], B))
        unit, unit_b = cuda.local.array((m, 2), float64), cuda.local.array(m, float64)
        near = cuda.local.array(m, boolean)
        judge(k, k, A, b, hard, relaxed, u, bound, u[:, :0], tolerance, unit, unit_b, slack, excess, active, near)
        solve_one(k, k, C, d, is_finite(k, C, d), unit, unit_b, solved)

    return cuda.jit(details_kernel)
