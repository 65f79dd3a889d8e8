r"""The programmes of `exact`, and the first derivatives of `programmes`, in scalar code compiled by numba.

`exact` and the backward passes of `programmes` are the reference, in the same order and with the same names; tests
compare the two. On one item, where every operation of numpy or torch has its price, these are several times faster.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

from torchfsid.kernels.active_rows import inscribed_rows, nearest_rows, solve_active

compiled = njit(cache=True, error_model="numpy", nogil=True)  # no_type_check: these must stay plain functions

OK, EMPTY, UNBOUNDED, DEGENERATE, UNDEFINED = 0, 1, 2, 3, 4  # `exact.Status`


@compiled
@no_type_check
def _unit(A, b, y, unit, offsets, status):
    """Unit rows, and offsets from y; infinite for zero rows. The status says what is known already."""
    B, m, p = A.shape
    for item in range(B):
        total = 0.0
        for j in range(p):
            total += y[item, j]
        for r in range(m):
            total += b[item, r]
            for j in range(p):
                total += A[item, r, j]
        status[item] = OK if math.isfinite(total) else UNDEFINED
        for r in range(m):
            squared, offset = 0.0, b[item, r]
            for j in range(p):
                squared += A[item, r, j] ** 2
                offset -= A[item, r, j] * y[item, j]
            is_row = squared > 0 and math.isfinite(total)
            if squared == 0 and offset < 0:
                status[item] = EMPTY
            norm = math.sqrt(squared) if is_row else 1.0
            offsets[item, r] = offset / norm if is_row else np.inf
            for j in range(p):
                unit[item, r, j] = A[item, r, j] / norm if is_row else 0.0


@compiled
@no_type_check
def nearest_point(A, b, y, parallel, epsilon, most_rounds, z, mu, rows, filled, status):
    """Into the last five."""
    B, m, p = A.shape
    unit, offsets = np.empty((B, m, p)), np.empty((B, m))
    _unit(A, b, y, unit, offsets, status)
    step, count, empty = np.zeros((B, p)), np.zeros(B, dtype=np.int64), np.zeros(B, dtype=np.bool_)
    nearest_rows(unit, offsets, parallel, epsilon, most_rounds, step, rows, count, mu, empty)
    # Once more, as a correction: this removes the round-off of a distant y, and gives the given rows' own multipliers.
    N, right, pull, correction = np.zeros((B, p, p)), np.zeros((B, p)), np.zeros((B, p)), np.zeros((B, p))
    for item in range(B):
        if status[item] == OK and empty[item]:
            status[item] = EMPTY
        if status[item] != OK:
            continue
        for j in range(p):
            z[item, j] = y[item, j] + step[item, j]
            pull[item, j] = -step[item, j]
        for s in range(count[item]):
            filled[item, s] = True
            right[item, s] = b[item, rows[item, s]]
            for j in range(p):
                N[item, s, j] = A[item, rows[item, s], j]
                right[item, s] -= N[item, s, j] * z[item, j]
    mu[:] = 0.0
    solve_active(N, filled, pull, right, correction, mu)
    for item in range(B):
        for j in range(p):
            z[item, j] = z[item, j] + correction[item, j] if status[item] == OK else np.nan


@compiled
@no_type_check
def of_nearest_point(A, rows, filled, mu, z, status, of_z, of_mu, of_A, of_b, of_y):
    """The derivatives, into the last three."""
    B, p = z.shape
    N, pull, v = np.zeros((B, p, p)), np.zeros((B, p)), np.zeros((B, p))
    for item in range(B):
        for s in range(p):
            if status[item] == OK:
                pull[item, s] = of_z[item, s]
            for j in range(p):
                N[item, s, j] = A[item, rows[item, s], j]
    solve_active(N, filled, pull, of_mu, of_y, v)
    for item in range(B):
        for s in range(p):
            if filled[item, s]:
                of_b[item, rows[item, s]] += v[item, s]
                for j in range(p):
                    slope = mu[item, s] * of_y[item, j] + v[item, s] * z[item, j]
                    of_A[item, rows[item, s], j] -= slope


@compiled
@no_type_check
def inscribed_ball(A, b, simplex, tie, epsilon, most_rounds, centre, radius, rows, status):
    """Into the last four."""
    B, m, p = A.shape
    unit, offsets, ball = np.empty((B, m, p)), np.empty((B, m)), np.zeros((B, p + 1))
    open_centre, open_radius = np.zeros(B, dtype=np.bool_), np.zeros(B, dtype=np.bool_)
    _unit(A, b, np.zeros((B, p)), unit, offsets, status)
    inscribed_rows(unit, offsets, simplex, tie, epsilon, most_rounds, ball, rows, open_centre, open_radius)
    for item in range(B):
        radius[item], size, largest = ball[item, p], abs(ball[item, p]), 0.0
        for j in range(p):
            centre[item, j] = ball[item, j]
            size += abs(ball[item, j])
        for s in range(p + 1):
            if rows[item, s] < m:
                largest = max(largest, abs(offsets[item, rows[item, s]]))
        undecided = status[item] != OK or open_radius[item]
        if status[item] == UNDEFINED:
            radius[item] = np.nan
        elif status[item] == EMPTY:
            radius[item] = -np.inf
        elif open_radius[item]:
            radius[item], status[item] = np.inf, UNBOUNDED
        elif abs(radius[item]) <= epsilon * (size + largest):
            status[item] = DEGENERATE
        elif radius[item] < 0:
            status[item] = EMPTY
        elif open_centre[item]:
            status[item] = UNBOUNDED
        if undecided or open_centre[item]:
            centre[item, :] = np.nan
        if undecided:
            for s in range(p + 1):
                rows[item, s] = m + s


@compiled
@no_type_check
def of_inscribed_ball(A, centre, radius, rows, simplex, of_centre, of_radius, of_A, of_b):
    """The derivatives, into the last two."""
    B, m, p = A.shape
    M, pull, nothing = np.zeros((B, p + 1, p + 1)), np.zeros((B, p + 1)), np.zeros((B, p + 1))
    every, v, ignored = np.ones((B, p + 1), dtype=np.bool_), np.zeros((B, p + 1)), np.zeros((B, p + 1))
    for item in range(B):
        for s in range(p + 1):
            row = A[item, rows[item, s]] if rows[item, s] < m else simplex[rows[item, s] - m]
            squared = 0.0
            for j in range(p):
                M[item, s, j] = row[j]
                squared += row[j] ** 2
            M[item, s, p] = math.sqrt(squared)
        for j in range(p):
            pull[item, j] = of_centre[item, j] if math.isfinite(centre[item, j]) else 0.0
        pull[item, p] = of_radius[item] if math.isfinite(radius[item]) else 0.0
    solve_active(M, every, pull, nothing, ignored, v)
    for item in range(B):
        for s in range(p + 1):
            if rows[item, s] < m:
                of_b[item, rows[item, s]] += v[item, s]
                for j in range(p):
                    at = centre[item, j] if math.isfinite(centre[item, j]) else 0.0
                    if math.isfinite(radius[item]):
                        at += radius[item] * M[item, s, j] / M[item, s, p]
                    of_A[item, rows[item, s], j] -= v[item, s] * at
