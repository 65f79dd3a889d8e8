"""A simulated run as a log, without a file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from torchfsid.errors import InputError
from torchfsid.logs.log import Log

if TYPE_CHECKING:
    from torchfsid.robots.simulation import Trajectory


def log_of(run: Trajectory, names: Sequence[str]) -> Log:
    """The run of one team as `read_log` reads its file (`Trajectory.save`), without gradients.

    Raises:
        InputError: it is a batch of teams.
    """
    if run.x.ndim != 3:
        raise InputError("run", "one team (samples, bodies, n)", tuple(run.x.shape))
    x, u = run.x.numpy(force=True), run.u.numpy(force=True)
    everywhere = np.ones(x.shape[:2], dtype=np.bool_)
    velocity = None if run.velocity is None else run.velocity.numpy(force=True)
    return Log(
        source="the simulated run",
        bodies=tuple(names),
        t=run.t.numpy(force=True),
        x=x,
        u=u if velocity is None else velocity,
        seen=everywhere,
        velocity_known=everywhere,
        radius=None if run.radius is None else run.radius.expand(x.shape[1]).double().numpy(force=True),
        a=None if velocity is None else u,
        acceleration_known=None if velocity is None else everywhere,
    )
