"""Rings of vertices, counter-clockwise, with the line of each edge: steps around one, its area, fewer edges."""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item
from torchfsid.tolerances import PARALLEL_EDGES


@item
@no_type_check
def after_in(i, n):
    return i + 1 if i < n - 1 else 0


@item
@no_type_check
def before_in(i, n):
    return i - 1 if i > 0 else n - 1


@item
@no_type_check
def copy_ring(spare, spare_edge, n, ring, edge):
    for i in range(n):
        ring[i, 0], ring[i, 1], edge[i] = spare[i, 0], spare[i, 1], spare_edge[i]


@item
@no_type_check
def merge_ring(ring, edge, n, most, lines, spare, spare_edge):
    """Drop the edge whose removal adds least area, until `most` edges are left or none can be dropped.

    The neighbours of a dropped edge are extended until they meet. An edge with parallel neighbours cannot be dropped.
    """
    while n > most:
        best, dropped, cx, cy = np.inf, -1, 0.0, 0.0
        for i in range(n):
            end = after_in(i, n)
            before, after = edge[before_in(i, n)], edge[end]
            p, q, r, s = lines[before, 0], lines[before, 1], lines[after, 0], lines[after, 1]
            turn = p * s - q * r
            if turn > PARALLEL_EDGES * math.sqrt(p * p + q * q) * math.sqrt(r * r + s * s):
                x, y = ring[end, 0] - ring[i, 0], ring[end, 1] - ring[i, 1]
                extended = (x * r + y * s) / turn
                added = -extended * (p * x + q * y)
                if added < best:
                    best, dropped = added, i
                    cx, cy = ring[i, 0] - extended * q, ring[i, 1] + extended * p
        if dropped < 0:
            return n
        old = dropped
        for i in range(n - 1):
            old = after_in(old, n)
            spare[i, 0], spare[i, 1], spare_edge[i] = ring[old, 0], ring[old, 1], edge[old]
        n -= 1
        spare[0, 0], spare[0, 1] = cx, cy
        copy_ring(spare, spare_edge, n, ring, edge)
    return n


@item
@no_type_check
def area_of(ring, n):
    """The area by the shoelace formula about the first vertex."""
    total = 0.0
    for i in range(1, n - 1):
        p, q = ring[i, 0] - ring[0, 0], ring[i, 1] - ring[0, 1]
        total += (p * (ring[i + 1, 1] - ring[0, 1]) - q * (ring[i + 1, 0] - ring[0, 0])) / 2
    return total
