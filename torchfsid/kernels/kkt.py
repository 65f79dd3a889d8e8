r"""The KKT conditions of one planar robot in scalar code, see `identification.kkt`.

The active rows A_a, of unit length, are solved along their principal axes. Let V be the rotation to these axes. The
columns of A_a V = [y z] are orthogonal up to round-off, and w = z - y (y.z)/(y.y) has the length of the second singular
value. Then

    A_a^+ b_a = V [c1, c2],    c2 = w.b/w.w,   c1 = (y.b - c2 y.z)/y.y        (rank 2; at rank 1, y alone is used).

Results are written at a place o. It is the robot's own place, or a thread's only one.
"""

from __future__ import annotations

import math
from typing import no_type_check

from torchfsid.kernels.compiled import item_in_place
from torchfsid.tolerances import RANK_TOLERANCE


@item_in_place
@no_type_check
def principal_axes(p, q, r):
    """The first principal axis (cos, sin) of rows with the Gram matrix [[p, q], [q, r]], cos >= 0."""
    difference, size = p - r, math.sqrt((p - r) ** 2 + 4 * q * q)
    if size == 0.0:
        return 1.0, 0.0
    longer = math.sqrt((1 + abs(difference) / size) / 2)
    shorter = abs(q) / (size * longer)
    cos, sin = (longer, shorter) if difference >= 0 else (shorter, longer)
    return cos, math.copysign(sin, q)


@item_in_place
@no_type_check
def solve_active(o, unit, unit_b, active, offset, projector):
    """Fill A_a^+ b_a and A_a^+ A_a for the active rows. Returns their number K and their rank."""
    K, p, q, r = 0, 0.0, 0.0, 0.0
    for j in range(len(unit_b)):
        if active[o, j]:
            K += 1
            p, q, r = p + unit[j, 0] ** 2, q + unit[j, 0] * unit[j, 1], r + unit[j, 1] ** 2
    if K == 0:
        return 0, 0
    cos, sin = principal_axes(p, q, r)
    yy = yz = yb = ww = wb = v0 = v1 = 0.0
    for j in range(len(unit_b)):
        if active[o, j]:
            y, z = cos * unit[j, 0] + sin * unit[j, 1], cos * unit[j, 1] - sin * unit[j, 0]
            yy, yz, yb = yy + y * y, yz + y * z, yb + y * unit_b[j]
            v0, v1 = v0 + y * unit[j, 0], v1 + y * unit[j, 1]
    share = yz / yy
    for j in range(len(unit_b)):
        if active[o, j]:
            y, z = cos * unit[j, 0] + sin * unit[j, 1], cos * unit[j, 1] - sin * unit[j, 0]
            w = z - y * share
            ww, wb = ww + w * w, wb + w * unit_b[j]
    if ww > RANK_TOLERANCE**2 * yy:
        second = wb / ww
        first = (yb - yz * second) / yy
        offset[o, 0], offset[o, 1] = cos * first - sin * second, sin * first + cos * second
        projector[o, 0, 0] = projector[o, 1, 1] = 1.0
        return K, 2
    length = math.sqrt(v0 * v0 + v1 * v1)
    v0, v1 = v0 / length, v1 / length
    yy = yb = 0.0
    for j in range(len(unit_b)):
        if active[o, j]:
            y = unit[j, 0] * v0 + unit[j, 1] * v1
            yy, yb = yy + y * y, yb + y * unit_b[j]
    offset[o, 0], offset[o, 1] = v0 * yb / yy, v1 * yb / yy
    projector[o, 0, 0], projector[o, 1, 1] = v0 * v0, v1 * v1
    projector[o, 0, 1] = projector[o, 1, 0] = v0 * v1
    return K, 1


@item_in_place
@no_type_check
def solve_motion(k, o, C, d, wish_known, rank, offset, projector, free, G, f):
    """Fill G and f of u* = G theta + f, and free = I - P, which is exactly zero at full rank, at place o."""
    if rank < 2:
        free[o, 0, 0], free[o, 1, 1] = 1 - projector[o, 0, 0], 1 - projector[o, 1, 1]
        free[o, 0, 1], free[o, 1, 0] = -projector[o, 0, 1], -projector[o, 1, 0]
    for i in range(2):
        f[o, i] = offset[o, i]
        if wish_known:
            f[o, i] += free[o, i, 0] * d[k, 0] + free[o, i, 1] * d[k, 1]
            for e in range(C.shape[2]):
                G[o, i, e] = free[o, i, 0] * C[k, 0, e] + free[o, i, 1] * C[k, 1, e]


@item_in_place
@no_type_check
def solve_one(k, o, C, d, wish_known, unit, unit_b, kkt):
    """Fill the KKT conditions of robot k, from its unit rows and the active ones, at place o of `kkt`."""
    G, f, projector, free, offset, active, n_active, rank, case = kkt
    for i in range(2):
        f[o, i], offset[o, i] = 0.0, 0.0
        for e in range(C.shape[2]):
            G[o, i, e] = 0.0
        for e in range(2):
            projector[o, i, e], free[o, i, e] = 0.0, 0.0
    K, rank[o] = solve_active(o, unit, unit_b, active, offset, projector)
    n_active[o], case[o] = K, K if K < 2 else 2 if rank[o] < 2 else 3 if K == 2 else 4
    solve_motion(k, o, C, d, wish_known, rank[o], offset, projector, free, G, f)
