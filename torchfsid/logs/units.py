"""Do the units of a log fit each other? A velocity u that is held from t to t_+ moves a body by (t_+ - t) |u|.

Times in milliseconds make all steps of time a thousand times as long, and the observer would take them for seconds. So
a log is refused if nearly all ways of its moving bodies differ from (t_+ - t) |u| by a factor of a thousand.
"""

from __future__ import annotations

import numpy as np

from torchfsid.errors import LogError
from torchfsid.logs.log import Log

MOVING = 0.1
"""Share of the longest way between two samples from which on a body moves."""

FEWEST = 10
"""Fewer ways say nothing."""

NEARLY_ALL = 0.9
"""Share of the ways that have to agree, each by a factor of two."""

SUSPECTS = {1: "t in milliseconds", -1: "positions in millimetres"}
"""By powers of a thousand. Shorter units of time are found by the steps alone (`quantities`)."""


def require_units(log: Log) -> None:
    """Check times and positions against velocities, if the log has any.

    Raises:
        LogError: a unit is wrong. The message names the one to suspect.
    """
    if log.u is None:
        return
    known = log.seen[:-1] & log.seen[1:] & log.velocity_known[:-1]
    way = np.linalg.norm(np.diff(log.x, axis=0), axis=-1)[known]
    expected = (np.diff(log.t)[:, None] * np.linalg.norm(log.u[:-1], axis=-1))[known]
    moving = (expected > 0) & (way > MOVING * way.max(initial=0.0))
    if moving.sum() < FEWEST:
        return
    thousands = np.log10(expected[moving] / way[moving]) / 3
    power = round(float(np.median(thousands)))
    if power not in SUSPECTS or np.mean(np.abs(thousands - power) < np.log10(2) / 3) < NEARLY_ALL:
        return
    raise LogError(
        f"{log.source}: expected t in s, positions in m, velocities in m/s; but velocities times the steps of t are "
        f"{1000.0**power:g} times the ways between positions: {SUSPECTS[power]}?"
    )
