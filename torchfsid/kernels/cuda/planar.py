"""Polygons and evidence in the plane on a GPU: the item functions of `polygon` and `evidence`, one thread an item.

A kernel is compiled for each number of rows. An item's scratch lies in its thread's local memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import no_type_check

import numpy as np
from numba import boolean, cuda, float64, int64

from torchfsid.kernels import evidence as reading
from torchfsid.kernels.compiled import item
from torchfsid.kernels.cuda.launch import Arrays, launch
from torchfsid.kernels.evidence import critical_region, inverse_optimal, read_one
from torchfsid.kernels.polygon import EMPTY, copy_polygon, cut_one, keep_contradiction, keep_ring
from torchfsid.kernels.saturation import BOUNDS, POINTS, ROWS, TOUCHING, clipped_inverse_optimal
from torchfsid.tolerances import SPREAD


def clip(given: Sequence[Arrays], values: tuple[int, bool], results: Sequence[Arrays], stream: int = 0) -> None:
    """Cut all polygons by their rows, see `polygon.clip`.

    A polygon that has more edges than there are slots, since parallel edges cannot be merged, stays as it was.

    Args:
        given: polygons (vertices, A, b, time, source, label, count, reach), and rows (A, b, time, source).
        values: the number of edges beyond which polygons are merged, and whether the label of an edge from row r of
            item k becomes -1 - (k R + r). Otherwise it becomes 0.
        results: to be filled: all polygons, of as many slots or more; outcome and shrunk; the rows (A, b, time, source)
            that contradict each other, NaN and -1 where there are none.
        stream: the address of the stream to run on.
    """
    (B, R), slots = given[1][1].shape, max(given[0][2].shape[1], values[0])
    launch(_clip(R, slots + R + 1), B, given, (values[0], int(values[1])), results, stream)


def evidence(
    given: Sequence[Arrays],
    values: tuple[bool, float, tuple[float, float, bool, float] | None],
    results: Sequence[Arrays],
    stream: int = 0,
) -> None:
    """What a measurement says about theta, see `evidence.evidence`.

    Args:
        given: (A, b, hard, relaxed), (C, d, u, usable), (bound, ball, drift), the errors of directions (angles,) or (),
            and the vertices of Theta (corners,), or () if nominal controls are not clipped.
        values: `paper`, `active_tolerance`, and of a clipped nominal control two limits, whether they are by norm, and
            the dead speed.
        results: the three parts of the result, to be filled. There are `evidence.rows_for` half-spaces.
        stream: the address of the stream to run on.
    """
    rows, sample, bounds, angles, corners = given
    (B, m), (paper, tolerance, clip) = rows[1].shape, values
    kernel = _evidence(m, paper, len(angles) > 0, corners[0].shape[1] if corners else 0)
    # Arrays in the place of those that are missing are not read.
    given = rows, sample, bounds, (angles[0] if angles else sample[2], corners[0] if corners else sample[0])
    first, second, by_norm, dead_speed = clip or (1.0, 1.0, False, 0.0)
    launch(kernel, B, given, (tolerance, first, second, dead_speed, int(by_norm)), results, stream)


def _around(paper: bool) -> np.ndarray:
    return reading.CRITICAL_DIRECTIONS if paper else reading.DIRECTIONS


@cache
def _clip(R: int, W: int) -> Callable:
    """The kernel for R rows, and rings of fewer than W - R vertices."""

    @no_type_check
    def clip_kernel(polygons, rows, result, found, lost, values):
        k = cuda.grid(1)
        A, b, stamp, source = rows
        outcome, shrunk = found
        if k >= b.shape[0]:
            return
        ring, spare = cuda.local.array((W, 2), float64), cuda.local.array((W, 2), float64)
        edge, spare_edge = cuda.local.array(W, int64), cuda.local.array(W, int64)
        lines, over = cuda.local.array((W, 3), float64), cuda.local.array(W, float64)
        tolerance, depth = cuda.local.array(R, float64), cuda.local.array(R, float64)
        cutting = cuda.local.array(R, int64)
        scratch = ring, edge, lines, tolerance, depth, cutting, over, spare, spare_edge
        n, state, smaller, row, before, after = cut_one(k, polygons, A, b, values[0], scratch)
        outcome[k], shrunk[k] = state, smaller and n <= result[2].shape[1]
        for i in range(3):
            lost[0][k, i, 0], lost[0][k, i, 1], lost[1][k, i] = np.nan, np.nan, np.nan
            lost[2][k, i], lost[3][k, i] = np.nan, -1
        if state == EMPTY:
            keep_contradiction(k, (row, before, after), polygons, stamp, source, lines, lost)
        if shrunk[k]:
            keep_ring(k, n, polygons, stamp, source, scratch, values[1] != 0, result)
        else:
            copy_polygon(polygons, k, result)

    return cuda.jit(clip_kernel)


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
    for i in range(2):
        f[k, i], offset[k, i] = 0.0, 0.0
        for e in range(G.shape[2]):
            G[k, i, e] = 0.0
        for j in range(2):
            projector[k, i, j], free[k, i, j] = 0.0, 0.0


@cache
def _evidence(m: int, paper: bool, uncertain: bool, slots: int) -> Callable:
    """The kernel for m rows, and for clipped nominal controls if sets have slots for vertices."""
    directions, clips = _around(paper), slots > 0
    normals_of, generators = len(directions) + 1, m * len(SPREAD) if uncertain and not paper else m
    corners_of, of_rows, of_Q, touching, most = (slots, ROWS, BOUNDS, TOUCHING, POINTS) if clips else (1, 1, 1, 1, 1)

    @no_type_check
    def evidence_kernel(rows, sample, bounds, errors, half_spaces, judged, kkt, values):
        k = cuda.grid(1)
        if k >= rows[1].shape[0]:
            return
        around = cuda.const.array_like(directions)
        unit, unit_b = cuda.local.array((m, 2), float64), cuda.local.array(m, float64)
        near, angle = cuda.local.array(m, boolean), cuda.local.array(generators, float64)
        order, generator = cuda.local.array(generators, int64), cuda.local.array(normals_of, int64)
        normals = cuda.local.array((normals_of, 2), float64)
        scratch = unit, unit_b, near, angle, order, normals, generator
        (C, d, u, usable), (bound, ball, drift), infeasible = sample, bounds, judged[2]
        angles = errors[0] if uncertain else errors[0][:, :0]
        fan = angles[:, :0] if paper else angles
        relaxed, relaxes = rows[3], False
        for j in range(m):
            relaxes = relaxes or relaxed[j]
        infeasible[k] = False
        pad_one(k, half_spaces, kkt)
        count = read_one(
            k, rows, (C, d, u, usable, bound), angles, fan, around, relaxes, paper, values[0], scratch, judged, kkt
        )
        if count < 0:
            return
        row_A, row_b, row_source = half_spaces
        room, shift = ball[min(k, len(ball) - 1)], drift[min(k, len(drift) - 1)]
        if paper:
            critical_region(
                k, unit, unit_b, C, d, kkt[0], kkt[1], kkt[2], kkt[4], kkt[5], normals, generator, count,
                row_A, row_b, row_source,
            )  # fmt: skip
        elif clips:
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
            clip = (values[1], values[2]), values[4] != 0, values[3], errors[1]
            clipped_inverse_optimal(
                k, m, u, room, shift, C, d, clip, normals, generator, count, len(order), work, row_A, row_b, row_source
            )
        else:
            inverse_optimal(
                k, m, u, room + shift, C, d, normals, generator, count, len(order), row_A, row_b, row_source
            )

    return cuda.jit(evidence_kernel)
