"""Rings of vertices, counter-clockwise, with the line of each edge: steps around one, cuts, its area, fewer edges.

A ring is cut and merged where it lies, without spare memory: a GPU's threads have little that is fast. `ring` holds its
n vertices, and `edge` the line of the edge from each of them to the next. A line is an edge of the polygon before the
cuts, or a row that cuts it. `lines` says which: (k, A, b, rows, bound), with A (B, V, 2) and b (B, V) of the edges,
rows (B, R, 2), and the bounds (R,) of polygon k's rows.
"""

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
def line_of(e, lines):
    """Line e as (p, q, c): an edge e < V, or row e - V."""
    k, A, b, rows, bound = lines
    V = b.shape[1]
    if e < V:
        return A[k, e, 0], A[k, e, 1], b[k, e]
    return rows[k, e - V, 0], rows[k, e - V, 1], bound[e - V]


@item
@no_type_check
def range_beyond(ring, n, p, q, c):
    """The least and the largest (p, q).v - c of the vertices, and the vertex with the least."""
    least = most = p * ring[0, 0] + q * ring[0, 1] - c
    inner = 0
    for i in range(1, n):
        beyond = p * ring[i, 0] + q * ring[i, 1] - c
        most = beyond if beyond > most else most
        if beyond < least:
            least, inner = beyond, i
    return least, most, inner


@item
@no_type_check
def _last_kept(ring, n, p, q, c, slack, inner, forward):
    """The last vertex with (p, q).v - c <= slack from `inner` on, and (p, q).v - c of it and of the next one."""
    last = inner
    within = p * ring[last, 0] + q * ring[last, 1] - c
    beyond = within
    for _ in range(n):
        following = after_in(last, n) if forward else before_in(last, n)
        beyond = p * ring[following, 0] + q * ring[following, 1] - c
        if beyond > slack:
            break
        last, within = following, beyond
    return last, within, beyond


@item
@no_type_check
def _crossing(ring, inner, outer, within, beyond):
    share = within / (within - beyond)
    x, y = ring[inner, 0], ring[inner, 1]
    return x + share * (ring[outer, 0] - x), y + share * (ring[outer, 1] - y)


@item
@no_type_check
def _move(ring, edge, source, target, count):
    """Move `count` vertices from one place to another, which may overlap."""
    for step in range(count if source != target else 0):
        i = step if target < source else count - 1 - step
        ring[target + i, 0], ring[target + i, 1] = ring[source + i, 0], ring[source + i, 1]
        edge[target + i] = edge[source + i]


@item
@no_type_check
def keep_arc(ring, edge, n, line, p, q, c, inner, slack):
    """Keep the arc around the vertex `inner` with (p, q).v - c <= slack, closed along the line.

    Returns its vertex count.
    """
    first, within_first, beyond_first = _last_kept(ring, n, p, q, c, slack, inner, False)
    last, within_last, beyond_last = _last_kept(ring, n, p, q, c, slack, inner, True)
    if not (beyond_first > slack and beyond_last > slack):  # a GPU may round the same product in several ways
        return n
    x0 = y0 = x1 = y1 = 0.0
    enters, leaves, incoming = within_first < -slack, within_last < -slack, edge[before_in(first, n)]
    if leaves:
        x0, y0 = _crossing(ring, last, after_in(last, n), within_last, beyond_last)
    if enters:
        x1, y1 = _crossing(ring, first, before_in(first, n), within_first, beyond_first)
    new = (1 if leaves else 0) + (1 if enters else 0)
    if first <= last:
        kept = last - first + 1
        _move(ring, edge, first, 0, kept)
        end, n = kept, kept + new
    else:  # the new vertices take the place of those between
        end = last + 1
        _move(ring, edge, first, end + new, n - first)
        n += end + new - first
    if leaves:
        ring[end, 0], ring[end, 1] = x0, y0
        end += 1
    edge[end - 1] = line
    if enters:
        ring[end, 0], ring[end, 1], edge[end] = x1, y1, incoming
    return n


@item
@no_type_check
def merge_ring(ring, edge, n, most, lines):
    """Drop the edge whose removal adds least area, until `most` edges are left or none can be dropped.

    The neighbours of a dropped edge are extended until they meet. An edge with parallel neighbours cannot be dropped.
    """
    while n > most:
        best, dropped, cx, cy = np.inf, -1, 0.0, 0.0
        for i in range(n):
            end = after_in(i, n)
            p, q, _ = line_of(edge[before_in(i, n)], lines)
            r, s, _ = line_of(edge[end], lines)
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
        end = after_in(dropped, n)
        ring[end, 0], ring[end, 1] = cx, cy
        _move(ring, edge, dropped + 1, dropped, n - 1 - dropped)
        n -= 1
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
