"""The tolerances that several files share, each with its unit. The kernels read them, so this file needs no torch."""

from __future__ import annotations

ROUND_OFF = 8 * 2.0**-52
"""Relative error to allow for in a row's product with a point."""

FLAT = 8 * ROUND_OFF
"""A set is flat where its half width is below this share of the largest coordinate that it ever had: rows that only
touch leave a sliver which is no wider."""

PARALLEL_ROWS = 1e-12
"""Angle [rad] below which rows count as parallel."""

VERIFIED = 16 * ROUND_OFF
"""Relative residual up to which the conditions of a solution hold: feasibility, stationarity, complementarity."""

CLEARLY_EMPTY = 1e5
"""Bounds that contradict each other by more than this times their round-off also contradict in exact arithmetic."""

MOST_ROUNDS = 50
"""Rounds per row and dimension after which a search gives up. A few rounds per dimension are usual."""

PARALLEL_EDGES = 1e-14
"""Sine of the angle below which two edges are not extended to their intersection."""

RANK_TOLERANCE = 1e-7
"""Relative singular value: unit rows less than twice this apart [rad] count as parallel. Below it round-off decides."""

ANGLE_TOLERANCE = 1e-12
"""Round-off allowed when an angular gap is compared with 180 degrees [rad]."""

RELAXED_OPENING = 0.5
"""A violation of relaxed rows is an alarm only if they could all be violated less, and the directions for that open by
more than this [rad]. Where two rows are nearly opposite, controllers in single precision miss the least violation:
along them by 2e-7 |u| / opening^2, and RVO2 by any amount where they are parallel up to 1e-5."""

ACTIVE_TOLERANCE = 1e-3
"""Default distance to a row's boundary below which the row counts as active [m/s]."""

NORMALS = 17
"""Outward normals of the inverse-optimal set around a full turn, both ends counted: 22.5 degrees apart, 1.3 % more
area than the disc they replace."""

CRITICAL_NORMALS = 3
"""Outward normals of a ray in the critical region: two sides and a cap."""

SPREAD = (-1.0, -1 / 3, 1 / 3, 1.0)
"""A row of uncertain direction is a fan of generators at these fractions of its angle: dense enough for any angle."""

SAMPLED = 32
"""Directions in which the circle of a speed limit is sampled."""

ON_LIMIT = 1e-9
"""A control this close to its limit, relative to it, touches it. A dead zone is touched alike."""
