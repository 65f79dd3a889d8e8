r"""Bodies that did not move as their logged velocities say: simulators that resolve contacts push them.

A velocity u that is held from t to t_+ moves a body by (t_+ - t) u. Where the displacement contradicts this beyond the
bounds on errors, something pushed or stopped the body, and the velocity with which it arrives at t_+ is not u. A
contact projects velocities, so that it changes u by at most |u|. Two contacts in a step, 2 |u|, are allowed for. Rows
that use velocities one sample earlier (`previous`, ORCA) get this bound. The control at t itself is right.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from torchfsid.logs.log import Log

LEAST = 1e-4
"""Smaller differences between displacements and velocities are no contacts [m]."""


def arrival_errors(log: Log, position: float, velocity: float) -> Float[np.ndarray, "times bodies"]:
    """For each sample, how far the velocity on arrival at the next one may be from the logged one [m/s]; mostly 0.

    Args:
        log: a log with velocities.
        position: a bound on the errors of all positions [m].
        velocity: a bound on the errors of all velocities [m/s].
    """
    found = np.zeros(log.seen.shape)
    if log.u is None:
        return found
    step = np.diff(log.t)[:, None]
    known = log.seen[:-1] & log.seen[1:] & log.velocity_known[:-1]
    if log.bridged is not None:
        known = known & ~log.bridged[:-1] & ~log.bridged[1:]
    away = np.linalg.norm(np.diff(log.x, axis=0) - step[..., None] * log.u[:-1], axis=-1)
    allowed = 2 * position + step * velocity + LEAST
    if log.position_error is not None:
        allowed = allowed + log.position_error[:-1] + log.position_error[1:]
    if log.velocity_error is not None:
        allowed = allowed + step * log.velocity_error[:-1]
    found[:-1] = np.where(known & (away > allowed), 2 * np.linalg.norm(log.u[:-1], axis=-1), 0.0)
    return found
