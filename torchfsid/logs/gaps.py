r"""Bodies that are missing from a log for a while: where they can have been.

A body that was seen at s and at s + h, h seconds later, and not in between, is somewhere. Assumption: during the gap no
body is faster than v, the largest speed that the log shows of any. Then at s + l h, with 0 < l < 1,

    x = (1 - l) x(s) + l x(s + h)       error <= 2 l (1 - l) h v
    u = 0                               error <= v

Proof: x - x_true = (1 - l) (x(s) - x_true) + l (x(s + h) - x_true), and x_true is at most l h v away from x(s) and
(1 - l) h v from x(s + h).

So a row of such a body is a row like the others, of wider bounds: it is left out where it is provably inactive, and
counts as active in every direction where the body may be anywhere around the robot. Of the missing robot itself the
sample says nothing. A body that has not come yet, or never comes back, is not there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchfsid.logs.log import Log


def bridged(log: Log) -> Log:
    """The log in which bodies that are missing for a while are where they can be; others are as they were."""
    earlier = np.maximum.accumulate(np.where(log.seen, np.arange(len(log.t))[:, None], -1), axis=0)
    later = np.minimum.accumulate(np.where(log.seen, np.arange(len(log.t))[:, None], len(log.t))[::-1], axis=0)[::-1]
    gap = ~log.seen & (earlier >= 0) & (later < len(log.t))
    if log.lost is not None or not gap.any():
        return log
    k, j = np.nonzero(gap)
    before, after = earlier[k, j], later[k, j]
    h = log.t[after] - log.t[before]
    part = (log.t[k] - log.t[before]) / h
    fastest = _fastest(log)

    x, position_error, velocity_error = log.x.copy(), np.zeros(gap.shape), np.zeros(gap.shape)
    x[k, j] = (1 - part[:, None]) * log.x[before, j] + part[:, None] * log.x[after, j]
    position_error[k, j] = 2 * part * (1 - part) * h * fastest
    velocity_error[k, j] = fastest
    return replace(
        log,
        x=x,
        seen=log.seen | gap,
        velocity_known=log.velocity_known | gap,
        position_error=position_error if log.position_error is None else log.position_error + position_error,
        velocity_error=velocity_error if log.velocity_error is None else log.velocity_error + velocity_error,
        bridged=gap,
    )


def _fastest(log: Log) -> float:
    """The largest speed in the log, logged or needed to get from one row of a body to its next [m/s]."""
    speeds = [0.0] if log.u is None else [float(np.linalg.norm(log.u[log.velocity_known], axis=-1).max(initial=0.0))]
    for j in range(len(log.bodies)):
        rows = np.flatnonzero(log.seen[:, j])
        moved = np.linalg.norm(np.diff(log.x[rows, j], axis=0), axis=-1)
        speeds.append(float((moved / np.diff(log.t[rows])).max(initial=0.0)))
    return max(speeds)
