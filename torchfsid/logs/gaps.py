r"""Bodies that are missing from a log for a while: bounds on where they were.

A body is seen at s and at s + h, h seconds later, and not in between. Assumption: during the gap the body is not faster
than v, the largest speed of any body in the log. Then at s + l h, with 0 < l < 1,

    x = (1 - l) x(s) + l x(s + h)       error <= 2 l (1 - l) h v
    u = 0                               error <= v

Robots that are driven by accelerations have velocities that change continuously. With w the largest acceleration of any
body in the log, in place of v,

    u = (1 - l) u(s) + l u(s + h)       error <= 2 l (1 - l) h w
    a = 0                               error <= w

Proof: x - x_true = (1 - l) (x(s) - x_true) + l (x(s + h) - x_true), and x_true is at most l h v away from x(s) and (1 -
l) h v from x(s + h). The same holds for u.

A body that is seen at s but not at the next sample has no velocity from differences of positions. Its velocity is then
0 with an error of v as well, while its position is that of the sample. Commands of unicycles that poses do not show
stay unknown: they may be larger than all others.

Errors of the samples are interpolated and added, with the same weights as the samples. Where the velocity of a robot
that is driven by accelerations is unknown at one end of a gap, it is unknown in the gap.

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
    goes_on = np.arange(len(log.t))[:, None] < earlier[-1]
    leaves = log.seen & ~np.concatenate([log.seen[1:], log.seen[-1:]])
    unknown = leaves & ~log.velocity_known & goes_on & (log.u is not None and log.a is None)
    if log.lost is not None or not (gap | unknown).any():
        return log
    k, j = np.nonzero(gap)
    before, after = earlier[k, j], later[k, j]
    h = log.t[after] - log.t[before]
    part = (log.t[k] - log.t[before]) / h

    def between(values: np.ndarray) -> np.ndarray:
        filled = values.copy()
        weight = part if values.ndim == 2 else part[:, None]
        filled[k, j] = (1 - weight) * values[before, j] + weight * values[after, j]
        return filled

    def in_gaps(error: np.ndarray | float, declared: np.ndarray | None) -> np.ndarray:
        errors = np.zeros(gap.shape)
        errors[k, j] = error
        return errors if declared is None else between(declared) + errors

    fastest, spread = _fastest(log.t, log.x, log.seen, log.u, log.velocity_known), 2 * part * (1 - part) * h
    filled = replace(
        log,
        x=between(log.x),
        seen=log.seen | gap,
        velocity_known=log.velocity_known | gap | unknown,
        position_error=in_gaps(spread * fastest, log.position_error) if gap.any() else log.position_error,
        velocity_error=in_gaps(fastest, log.velocity_error) + fastest * unknown,
        bridged=gap | unknown,
    )
    if log.a is None or log.acceleration_known is None or log.u is None:
        return filled
    torn = np.zeros_like(gap)
    torn[k, j] = ~(log.velocity_known[before, j] & log.velocity_known[after, j])
    strongest = _fastest(log.t, log.u, log.velocity_known, log.a, log.acceleration_known)
    return replace(
        filled,
        u=between(log.u),
        velocity_known=filled.velocity_known & ~torn,
        velocity_error=in_gaps(spread * strongest, log.velocity_error),
        acceleration_known=log.acceleration_known | gap,
        acceleration_error=in_gaps(strongest, log.acceleration_error),
    )


def _fastest(t: np.ndarray, x: np.ndarray, seen: np.ndarray, rate: np.ndarray | None, known: np.ndarray) -> float:
    """The largest rate of change of x, logged or needed to get from one sample of a body to its next."""
    rates = [0.0] if rate is None else [float(np.linalg.norm(rate[known], axis=-1).max(initial=0.0))]
    for j in range(x.shape[1]):
        rows = np.flatnonzero(seen[:, j])
        moved = np.linalg.norm(np.diff(x[rows, j], axis=0), axis=-1)
        rates.append(float((moved / np.diff(t[rows])).max(initial=0.0)))
    return max(rates)
