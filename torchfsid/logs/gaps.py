r"""Bodies that are missing from a log for a while: bounds on where they were.

A body is seen at s and at s + h, h seconds later, and not in between. Assumption: during the gap the body is not faster
than v, the largest speed of any body in the log. Then at s + l h, with 0 < l < 1,

    x = (1 - l) x(s) + l x(s + h)       error <= 2 l (1 - l) h v
    u = 0                               error <= v

Proof: x - x_true = (1 - l) (x(s) - x_true) + l (x(s + h) - x_true), and x_true is at most l h v away from x(s) and (1 -
l) h v from x(s + h).

A row of such a body is an ordinary row with wider bounds. It is left out where it is provably inactive. It counts as
active in every direction where the body may be anywhere around the robot. The sample says nothing about the missing
robot itself. Before its first and after its last sample a body is not there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchfsid.logs.log import Log


def bridged(log: Log) -> Log:
    """The log with gaps filled by interpolation, with the bounds above. Bodies without gaps are unchanged."""
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
    """The largest speed in the log [m/s], logged or needed to get from one sample of a body to its next."""
    speeds = [0.0] if log.u is None else [float(np.linalg.norm(log.u[log.velocity_known], axis=-1).max(initial=0.0))]
    for j in range(len(log.bodies)):
        rows = np.flatnonzero(log.seen[:, j])
        moved = np.linalg.norm(np.diff(log.x[rows, j], axis=0), axis=-1)
        speeds.append(float((moved / np.diff(log.t[rows])).max(initial=0.0)))
    return max(speeds)
