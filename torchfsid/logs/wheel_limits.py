"""Wheel limits that nobody declared, seen in exact motions of unicycles.

No motion has |v| + |w| b/2 > limit, and those with a wheel at its limit are equal: they lie on an edge of the convex
hull of all motions (|v|, |w|). On any other edge there are two motions, by chance hardly ever more. So edges with more
than two are taken for limits. This may set aside a few motions too many. It does not see a limit that was reached once
or twice, and none if the errors of motions are larger than the width of an edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from torchfsid.logs.unicycles import Motion, WheelLimit

BASES = 0.01, 2.0
"""Distances of wheels from each other that are looked for [m]."""

ON_EDGE = 1e-8
"""Motions this close to an edge of their hull, relative to the speed, are on it."""


def limits_seen(motions: Sequence[Motion]) -> list[WheelLimit] | None:
    """The wheel limits that are seen, that of most motions first. None if motions are not exact enough to see one."""
    v, w, errors = (
        np.concatenate([getattr(motion, name)[motion.known] for motion in motions]) for name in ("v", "w", "v_error")
    )
    errors = errors + np.concatenate([motion.w_error[motion.known] for motion in motions])
    points = np.abs([v, w]).T
    if len(points) == 0 or errors.max() > ON_EDGE * points[:, 0].max():
        return None
    found = []
    for (fast, little), (slow, much) in pairwise(_hull(points)):
        half = (fast - slow) / (much - little) if much > little else 0.0
        if BASES[0] <= 2 * half <= BASES[1]:
            speed = float(fast + half * little)
            count = int((points @ [1.0, half] >= (1 - ON_EDGE) * speed).sum())
            found += [(count, WheelLimit(speed, float(2 * half), ON_EDGE * speed))] if count > 2 else []
    return [limit for _, limit in sorted(found, reverse=True)]


def _hull(points: np.ndarray) -> list[list[float]]:
    """The upper right part of the convex hull, from the largest |v| to the largest |w|."""
    hull: list[list[float]] = []
    for point in points[np.lexsort((-points[:, 1], -points[:, 0]))].tolist():
        while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        hull.append(point)
    return hull


def _turn(a: Sequence[float], b: Sequence[float], c: Sequence[float]) -> float:
    return (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])
