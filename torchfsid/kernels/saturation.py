r"""Half-spaces of an unclipped nominal control in scalar code, one robot after the other.

This computes what `identification.saturation` computes in torch. The theory is explained there, and tests compare the
two. Torch cuts P out of a box, here no polygon is cut. The set Q of the inverse-optimal set holds u, and all its rows
are tangents of the ball of radius r around u:

    Q = {z : n_i.(z - u) <= r}       neighbouring rows meet in   u + r (n_i + n_j)/(1 + n_i.n_j)

If Q does not touch the limit, all of Q is on the same side of it as u. If it does, P is the hull of the vertices of Q
within the limit and of the points where the limit enters Q: the ends of arcs of a circle, or of parts of a box's faces.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.compiled import item, item_of_ordered, launcher
from torchfsid.tolerances import ANGLE_TOLERANCE, CRITICAL_NORMALS, NORMALS, ON_LIMIT, SAMPLED

AROUND = np.stack([f(np.linspace(0.0, 2 * math.pi, SAMPLED, endpoint=False)) for f in (np.cos, np.sin)], axis=-1)
"""The directions in which a circle is sampled."""

AXES = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
"""The outward normals of the faces of a box."""

ROWS = CRITICAL_NORMALS + NORMALS
"""The largest number of half-spaces of y: around a cone, and those of Q."""


BOUNDS = NORMALS + 1
"""The largest number of rows of Q."""

TOUCHING = SAMPLED + 2 * BOUNDS
"""The largest number of directions in which Q touches the limit."""

POINTS = TOUCHING + BOUNDS
"""The largest number of points of P."""


@launcher
@no_type_check
def workspace(slots):
    """Arrays for one robot with `slots` vertices of Theta: C theta + d at these; the bounds of Q; the directions in
    which Q touches the limit; the points of P; the half-spaces of y."""
    rows = np.empty((ROWS, 2)), np.empty(ROWS), np.empty(ROWS, np.int64)
    return np.empty((slots, 2)), np.empty(BOUNDS), np.empty((TOUCHING, 2)), np.empty((POINTS, 2)), rows


@item
@no_type_check
def number_of_corners(k, corners):
    """The number of vertices of Theta. The slots behind them repeat the first."""
    n = corners.shape[1]
    while n > 1 and corners[k, n - 1, 0] == corners[k, 0, 0] and corners[k, n - 1, 1] == corners[k, 0, 1]:
        n -= 1
    return n


@item_of_ordered
@no_type_check
def nominal_controls(k, C, d, corners, wishes, n):
    """Fill `wishes` with C theta + d at n vertices of Theta. Returns their ranges and extreme squared lengths."""
    x0, y0, x1, y1, least, most = np.inf, np.inf, -np.inf, -np.inf, np.inf, 0.0
    for i in range(n):
        v, w = corners[k, i, 0], corners[k, i, 1]
        x = C[k, 0, 0] * v + C[k, 0, 1] * w + d[k, 0]
        y = C[k, 1, 0] * v + C[k, 1, 1] * w + d[k, 1]
        wishes[i, 0], wishes[i, 1] = x, y
        size = x * x + y * y
        x0, x1 = x if x < x0 else x0, x if x > x1 else x1
        y0, y1 = y if y < y0 else y0, y if y > y1 else y1
        least, most = size if size < least else least, size if size > most else most
    return x0, x1, y0, y1, least, most


@item
@no_type_check
def is_beyond(wishes, n, distance):
    """Is there a sampled direction in which all n `wishes` are farther than `distance` from the origin?"""
    for i in range(SAMPLED):
        j = 0
        while j < n and AROUND[i, 0] * wishes[j, 0] + AROUND[i, 1] * wishes[j, 1] > distance:
            j += 1
        if j == n:
            return True
    return False


@item
@no_type_check
def is_admissible(normals, b, count, x, y, tolerance):
    i = 0
    while i < count and normals[i, 0] * x + normals[i, 1] * y - b[i] <= tolerance:
        i += 1
    return i == count


@item
@no_type_check
def touch_circle(normals, b, count, v, outward, points):
    """Fill the directions in which the circle of radius v is admissible, and its points there. Returns their number."""
    K = 0
    for i in range(SAMPLED):
        if is_admissible(normals, b, count, v * AROUND[i, 0], v * AROUND[i, 1], ON_LIMIT * v):
            outward[K, 0], outward[K, 1] = AROUND[i, 0], AROUND[i, 1]
            K += 1
    for i in range(count):
        cos = min(max(b[i] / v, -1.0), 1.0)
        sin = math.sqrt(1 - cos * cos)
        for _ in range(2):
            p, q = cos * normals[i, 0] - sin * normals[i, 1], cos * normals[i, 1] + sin * normals[i, 0]
            if is_admissible(normals, b, count, v * p, v * q, ON_LIMIT * v):
                outward[K, 0], outward[K, 1] = p, q
                K += 1
            sin = -sin
    for i in range(K):
        points[i, 0], points[i, 1] = v * outward[i, 0], v * outward[i, 1]
    return K


@item
@no_type_check
def touch_face(normals, b, count, p, q, v, half):
    """The part of the face (p, q).z = v of a box, 2 `half` long, that is admissible: its least and largest coordinate.

    It is admissible nowhere if the first is larger.
    """
    least, most, tolerance = -half, half, ON_LIMIT * v
    i = 0
    while i < count and least <= most:
        along = normals[i, 1] * p - normals[i, 0] * q
        room = b[i] + tolerance - v * (normals[i, 0] * p + normals[i, 1] * q)
        if along > 0:
            most = min(most, room / along)
        elif along < 0:
            least = max(least, room / along)
        elif room < 0:
            most = -np.inf
        i += 1
    return least, most


@item
@no_type_check
def add_vertices(x, y, r, v, w, by_norm, normals, count, is_bounded, points, n):
    """Add the vertices of Q around u = (x, y) that are within the limits v, w to n points. Returns their number.

    All neighbouring rows of Q are the same angle apart.
    """
    cos = normals[0, 0] * normals[1, 0] + normals[0, 1] * normals[1, 1]
    if count < 2 or cos <= 0:  # a half-plane, or a strip
        return n
    share = r / (1 + cos)
    for i in range(count if is_bounded else count - 1):
        j = i + 1 if i < count - 1 else 0
        p, q = x + share * (normals[i, 0] + normals[j, 0]), y + share * (normals[i, 1] + normals[j, 1])
        if is_within(p, q, v, w, by_norm):
            points[n, 0], points[n, 1] = p, q
            n += 1
    return n


@item
@no_type_check
def is_within(x, y, v, w, by_norm):
    return x * x + y * y <= v * v if by_norm else abs(x) <= v and abs(y) <= w


@item_of_ordered
@no_type_check
def support(points, n, p, q):
    most = -np.inf
    for i in range(n):
        along = p * points[i, 0] + q * points[i, 1]
        most = along if along > most else most
    return most


@item
@no_type_check
def is_polar(outward, K, p, q):
    i = 0
    while i < K and p * outward[i, 0] + q * outward[i, 1] <= ANGLE_TOLERANCE:
        i += 1
    return i == K


@item
@no_type_check
def around_cone(outward, K, row_A):
    """Fill the two ends of the polar cone of K directions, and the direction between them. Returns the number of rows.

    The ends are orthogonal to the first and the last direction. A half-plane has one end, and a whole plane none.
    """
    R, first, last = 0, -1, -1
    for i in range(K):
        p, q = outward[i, 0], outward[i, 1]
        first = i if first < 0 and is_polar(outward, K, q, -p) else first
        last = i if last < 0 and is_polar(outward, K, -q, p) else last
    if first >= 0:
        row_A[0, 0], row_A[0, 1], R = outward[first, 1], -outward[first, 0], 1
    if first >= 0 and last >= 0:
        p, q = -outward[first, 0] - outward[last, 0], -outward[first, 1] - outward[last, 1]
        size = math.sqrt(p * p + q * q)
        if size > ANGLE_TOLERANCE:
            row_A[1, 0], row_A[1, 1], R = -outward[last, 1], outward[last, 0], 2
            if is_polar(outward, K, p / size, q / size):
                row_A[2, 0], row_A[2, 1], R = p / size, q / size, 3
    return R


@item
@no_type_check
def unclipped(k, C, d, u, r, margin, clip, normals, count, is_bounded, work):
    """Fill the half-spaces of y for robot k (`identification.saturation.unclipped`).

    Args:
        k: the robot.
        C: of the nominal control C theta + d.
        d: of the nominal control [m/s].
        u: the measured controls [m/s].
        r: a bound on the error of u [m/s].
        margin: the largest distance of y from C Theta + d [m/s].
        clip: see `evidence`.
        normals: the rows of Q, in the order of their angles.
        count: the number of the rows of Q.
        is_bounded: whether the first row of Q is also the neighbour of the last.
        work: a `workspace`. Its last part is filled with the half-spaces: their rows and bounds, and the row of Q that
            each repeats, or -1.

    Returns:
        The number of half-spaces.
    """
    limits, by_norm, dead_speed, corners = clip
    wishes, b, outward, points, (row_A, row_b, row_of) = work
    x, y = u[k, 0], u[k, 1]
    for i in range(count):
        b[i] = normals[i, 0] * x + normals[i, 1] * y + r
    nominal = number_of_corners(k, corners)
    x0, x1, y0, y1, least, most = nominal_controls(k, C, d, corners, wishes, nominal)
    far = math.sqrt(most) + margin
    v, w, K, n = min(limits[0], 2 * far), min(limits[1], 2 * far), 0, 0
    if by_norm:
        can_clip = far > v
        if can_clip:
            n = K = touch_circle(normals, b, count, v, outward, points)
    else:
        beyond = x1 + margin - v, y1 + margin - w, -x0 + margin - v, -y0 + margin - w
        can_clip = max(beyond) > 0
        for i in range(4 if can_clip else 0):
            p, q = AXES[i, 0], AXES[i, 1]
            face, half = (w, v) if i % 2 else (v, w)
            first, last = touch_face(normals, b, count, p, q, face, half)
            if first <= last:
                points[n, 0], points[n, 1] = face * p - first * q, face * q + first * p
                points[n + 1, 0], points[n + 1, 1] = face * p - last * q, face * q + last * p
                n += 2
                if beyond[i] > 0:
                    outward[K, 0], outward[K, 1] = p, q
                    K += 1

    row_A[0, 0], row_A[0, 1], row_b[0], row_of[0] = 0.0, 0.0, -1.0, -1
    if can_clip and n == 0 and not is_within(x, y, v, w, by_norm):
        return 1  # Q does not meet the admissible speeds
    R = 0
    if K > 0:
        surely_clipped = by_norm and least > (v + margin) ** 2 and is_beyond(wishes, nominal, v + margin)
        if not surely_clipped:
            n = add_vertices(x, y, r, v, w, by_norm, normals, count, is_bounded, points, n)
        R = around_cone(outward, K, row_A)
        for i in range(R):
            row_b[i], row_of[i] = support(points, n, row_A[i, 0], row_A[i, 1]), -1
    for i in range(count):
        if is_polar(outward, K, normals[i, 0], normals[i, 1]):
            row_A[R, 0], row_A[R, 1], row_b[R], row_of[R] = normals[i, 0], normals[i, 1], b[i], i
            R += 1
    idle = dead_speed > 0 and is_admissible(normals, b, count, 0.0, 0.0, ON_LIMIT * dead_speed)
    if idle and not is_beyond(wishes, nominal, dead_speed + margin):
        for i in range(R):
            row_b[i] = max(row_b[i], dead_speed)
    return R


@item
@no_type_check
def clipped_inverse_optimal(
    k, m, u, ball, drift, C, d, clip, normals, generator, count, none, work, row_A, row_b, row_source
):
    """The rows of `identification.inverse_optimal_set` for a clipped nominal control that are not padding.

    Returns their number.
    """
    found_A, found_b, found_of = work[-1]
    is_bounded = count > 0 and generator[0] == none
    found = unclipped(k, C, d, u, ball, drift, clip, normals, count, is_bounded, work)
    for n in range(found):
        p, q, of = found_A[n, 0], found_A[n, 1], found_of[n]
        for i in range(2):
            row_A[k, n, i] = p * C[k, 0, i] + q * C[k, 1, i]
        room = drift if p != 0 or q != 0 else 0.0
        row_b[k, n] = found_b[n] + room - p * d[k, 0] - q * d[k, 1]
        row_source[k, n] = 2 * m if of < 0 or generator[of] == none else m + generator[of] % m
    return found
