r"""Outward normals of cones in space, one cone after the other (`identification.normals` has the theory).

This finds what `identification.normals` finds in torch, and tests compare the two.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item
from torchfsid.tolerances import ANGLE_TOLERANCE, PARALLEL_ROWS

_GOLDEN = (1 + math.sqrt(5)) / 2
FAN = np.array(
    [np.roll([0.0, one, other * _GOLDEN], shift) for shift in range(3) for one in (1, -1) for other in (1, -1)]
) / math.hypot(1, _GOLDEN)
"""The corners of an icosahedron, (12, 3). No direction is farther than 37.4 degrees from one of them."""

RING = 6
"""Generators around a row of uncertain direction."""

EDGES = 32
"""Largest number of edges of a polar cone that become normals. Without the others the cone is a larger one."""

SAME_EDGE = 1e-9
"""Distance of two unit normals below which one of them is enough."""

NARROW = 1e-6
"""Sine of the angle between a direction of the fan and a generator below which the projection has no digits left."""


@item
@no_type_check
def is_polar(a, K, x, y, z, tolerance):
    """Is (x, y, z) within `tolerance` of the polar cone of the K generators a?"""
    j = 0
    while j < K and x * a[j, 0] + y * a[j, 1] + z * a[j, 2] <= tolerance:
        j += 1
    return j == K


@item
@no_type_check
def add_normal(x, y, z, of, normals, generator, count):
    normals[count, 0], normals[count, 1], normals[count, 2], generator[count] = x, y, z, of
    return count + 1


@item
@no_type_check
def add_edge(a, K, x, y, z, of, normals, generator, first, count):
    """Add an edge of the polar cone, if it is one and is not there yet. Returns the number of normals."""
    if count - first == EDGES or not is_polar(a, K, x, y, z, ANGLE_TOLERANCE):
        return count
    for k in range(first, count):
        p, q, r = x - normals[k, 0], y - normals[k, 1], z - normals[k, 2]
        if p * p + q * q + r * r < SAME_EDGE**2:
            return count
    return add_normal(x, y, z, of, normals, generator, count)


@item
@no_type_check
def normals_in_space(a, order, K, none, normals, generator):
    """Fill the normals of the cone of K unit generators.

    Args:
        a: the generators (at least K, 3).
        order: the generators' names.
        K: the number of generators.
        none: the name for "no generator".
        normals: to be filled with the normals (at least 12 + `EDGES`, 3).
        generator: to be filled with the name of a generator near each normal.

    Returns:
        The number of normals.
    """
    count = 0
    for i in range(len(FAN)):
        x, y, z = FAN[i, 0], FAN[i, 1], FAN[i, 2]
        highest, nearest = -np.inf, -1
        for j in range(K):
            along = x * a[j, 0] + y * a[j, 1] + z * a[j, 2]
            if along > highest:
                highest, nearest = along, j
        if highest <= ANGLE_TOLERANCE:
            count = add_normal(x, y, z, order[nearest] if K > 0 else none, normals, generator, count)
            continue
        for j in range(K):
            along = x * a[j, 0] + y * a[j, 1] + z * a[j, 2]
            size = math.sqrt(max(1 - along * along, 0.0))
            if along > ANGLE_TOLERANCE and size > NARROW:
                p, q, r = (x - along * a[j, 0]) / size, (y - along * a[j, 1]) / size, (z - along * a[j, 2]) / size
                if is_polar(a, K, p, q, r, ANGLE_TOLERANCE):
                    count = add_normal(p, q, r, order[j], normals, generator, count)
                    break
    first = count
    for i in range(K):
        for j in range(i + 1, K):
            x = a[i, 1] * a[j, 2] - a[i, 2] * a[j, 1]
            y = a[i, 2] * a[j, 0] - a[i, 0] * a[j, 2]
            z = a[i, 0] * a[j, 1] - a[i, 1] * a[j, 0]
            size = math.sqrt(x * x + y * y + z * z)
            if size > PARALLEL_ROWS:
                x, y, z = x / size, y / size, z / size
                along = x * a[i, 0] + y * a[i, 1] + z * a[i, 2]
                x, y, z = x - along * a[i, 0], y - along * a[i, 1], z - along * a[i, 2]
                count = add_edge(a, K, x, y, z, order[i], normals, generator, first, count)
                count = add_edge(a, K, -x, -y, -z, order[i], normals, generator, first, count)
    return count
