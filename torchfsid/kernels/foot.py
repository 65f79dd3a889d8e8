r"""The point of a polygon nearest to a given one in the norm sqrt(z' H z), and the rows active there."""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, launcher
from torchfsid.kernels.ring import after_in, before_in


@item
@no_type_check
def foot_on(vertices, A, b, n, x, y, metric):
    """The nearest of the feet on all edges as (x, y, row, row), with the active rows. A missing row is -1."""
    inside = True
    for i in range(n):
        inside = inside and A[i, 0] * x + A[i, 1] * y <= b[i]
    if inside:
        return x, y, -1, -1
    nearest, foot_x, foot_y, first, second = False, x, y, -1, -1
    for i in range(n):
        j = after_in(i, n)
        along_x, along_y = vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1]
        away_x, away_y = vertices[i, 0] - x, vertices[i, 1] - y
        p = metric[0, 0] * along_x + metric[0, 1] * along_y
        q = metric[1, 0] * along_x + metric[1, 1] * along_y
        squared = p * along_x + q * along_y
        share = min(max(-(p * away_x + q * away_y) / squared, 0.0), 1.0) if squared > 0 else 0.0
        new_x, new_y = vertices[i, 0] + share * along_x, vertices[i, 1] + share * along_y
        # |f - z|^2 - |g - z|^2 = (f - g)'H(f - z + g - z): squares of far distances would tie, or overflow.
        step_x, step_y = new_x - foot_x, new_y - foot_y
        both_x, both_y = (new_x - x) + (foot_x - x), (new_y - y) + (foot_y - y)
        p = metric[0, 0] * step_x + metric[0, 1] * step_y
        q = metric[1, 0] * step_x + metric[1, 1] * step_y
        if not nearest or p * both_x + q * both_y < 0:
            nearest, foot_x, foot_y = True, new_x, new_y
            first = before_in(i, n) if share <= 0 else i
            second = -1 if 0 < share < 1 else i if share <= 0 else j
    return foot_x, foot_y, first, second


@item
@no_type_check
def foot_one(k, vertices, A, b, count, point, metric, foot, active):
    """The nearest point of polygon k, see `feet`."""
    foot[k, 0], foot[k, 1], active[k, 0], active[k, 1] = foot_on(
        vertices[k], A[k], b[k], count[k], point[k, 0], point[k, 1], metric[k]
    )


@launcher
@no_type_check
def feet(vertices, A, b, count, point, metric):
    """The point of each polygon nearest to `point` in the norm sqrt(z' metric z), and its active rows.

    Args:
        vertices: (B, V, 2).
        A: (B, V, 2), the rows of the edges.
        b: (B, V), their bounds.
        count: (B,), the number of edges.
        point: (B, 2).
        metric: (B, 2, 2).

    Returns:
        The nearest points (B, 2) and their active rows (B, 2), a missing one being -1. Without a row it is the point
        itself, with one the foot on an edge, with two a vertex.
    """
    foot, active = np.empty((len(count), 2)), np.empty((len(count), 2), np.int64)
    for k in range(len(count)):
        foot_one(k, vertices, A, b, count, point, metric, foot, active)
    return foot, active
