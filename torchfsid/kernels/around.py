"""Half-spaces moved outward until they hold a polygon, one polygon at a time."""

from __future__ import annotations

from typing import no_type_check

from torchfsid.kernels.compiled import launcher
from torchfsid.kernels.polygon import box_of, most_beyond
from torchfsid.tolerances import ROUND_OFF


@launcher
@no_type_check
def moved_around(vertices, count, reach, A, b):
    """The bounds (B, R) of the rows A (B, R, 2), b, moved outward until row r of item k holds polygon k, rounded up."""
    moved = b.copy()
    for k in range(len(b)):
        n = count[k]
        x0, x1, y0, y1 = box_of(vertices, k, n)
        for r in range(b.shape[1]):
            p, q, c = A[k, r, 0], A[k, r, 1], b[k, r]
            round_off = ROUND_OFF * (abs(p) * reach[k, 0] + abs(q) * reach[k, 1] + abs(c))
            if p * (x1 if p > 0 else x0) + q * (y1 if q > 0 else y0) + round_off > c:
                moved[k, r] = max(c, c + most_beyond(vertices, k, n, p, q, c) + round_off)
    return moved
