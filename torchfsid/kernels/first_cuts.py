"""The search for the next sample, among many, that cuts a set: a polygon, or the hull of corners in any dimension."""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import launcher
from torchfsid.kernels.polygon import box_of, exceeded
from torchfsid.tolerances import ROUND_OFF


@launcher
@no_type_check
def first_cuts(vertices, count, reach, A, b, start):
    """For each polygon k the first sample s >= start[k] of which a row (A[s, k], b[s, k]) cuts it. S if none does.

    `A` (S, B, R, 2) and `b` (S, B, R) are the rows of S samples.
    """
    S, B, R = b.shape
    found = np.full(B, S)
    for k in range(B):
        n, reach_x, reach_y = count[k], reach[k, 0], reach[k, 1]
        box = box_of(vertices, k, n)
        for s in range(start[k], S):
            for r in range(R):
                p, q, c = A[s, k, r, 0], A[s, k, r, 1], b[s, k, r]
                if exceeded(vertices, k, n, reach_x, reach_y, box, p, q, c)[0] > 0:
                    found[k] = s
                    break
            if found[k] < S:
                break
    return found


@launcher
@no_type_check
def first_cuts_of_hulls(corners, reach, A, b, start):
    """The same for the hulls of corners (B, V, p). A row cuts a hull if it may do so within round-off."""
    S, B, R = b.shape
    V, p = corners.shape[1:]
    found = np.full(B, S)
    for k in range(B):
        for s in range(start[k], S):
            for r in range(R):
                size, row = abs(b[s, k, r]), A[s, k, r]
                for i in range(p):
                    size += abs(row[i]) * reach[k, i]
                for v in range(V):
                    beyond = ROUND_OFF * size - b[s, k, r]
                    for i in range(p):
                        beyond += row[i] * corners[k, v, i]
                    if beyond > 0:
                        found[k] = s
                        break
                if found[k] < S:
                    break
            if found[k] < S:
                break
    return found
