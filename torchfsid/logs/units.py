"""Do the units of a log fit each other? A velocity u that is held from t to t_+ moves a body by (t_+ - t) u.

Times in milliseconds make all steps of time a thousand times as long, and the observer would take them for seconds. So
a log is refused if nearly all ways of its moving bodies are (t_+ - t) u by a factor of a thousand, in direction, too.
Errors, and bodies that are put back or held, have ways that are as short or as long, but not in that direction.
"""

from __future__ import annotations

import numpy as np

from torchfsid.errors import LogError
from torchfsid.logs.log import Log

MOVING = 0.1
"""Share of the greatest speed from which on a body moves."""

FEWEST = 10
"""Fewer ways say nothing."""

NEARLY_ALL = 0.9
"""Share of the ways that have to agree, each by half the length of (t_+ - t) u."""

SUSPECTS = {1: "t in milliseconds", -1: "positions in millimetres"}
"""By powers of a thousand. Shorter units of time are found by the steps alone (`quantities`)."""


def require_units(log: Log) -> None:
    """Check times and positions against velocities, if the log has any.

    Raises:
        LogError: a unit is wrong. The message names the one to suspect.
    """
    if log.u is None:
        return
    u, speed = log.u[:-1], np.linalg.norm(log.u[:-1], axis=-1)
    known = log.seen[:-1] & log.seen[1:] & log.velocity_known[:-1]
    moving = known & (speed > MOVING * speed.max(initial=0.0, where=known))
    if moving.sum() < FEWEST:
        return
    way, expected = np.diff(log.x, axis=0)[moving], (np.diff(log.t)[:, None, None] * u)[moving]
    for power, suspect in SUSPECTS.items():
        away = np.linalg.norm(1000.0**power * way - expected, axis=-1)
        if np.mean(away <= np.linalg.norm(expected, axis=-1) / 2) >= NEARLY_ALL:
            raise LogError(
                f"{log.source}: expected t in s, positions in m, velocities in m/s; but velocities times the steps of "
                f"t are {1000.0**power:g} times the ways between positions: {suspect}?"
            )
