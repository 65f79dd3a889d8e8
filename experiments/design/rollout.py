r"""Closed loops by the batch: every item is a robot with its own bodies around it, and all move at once.

    x(t + dt) = x(t) + dt (u*(x(t), bodies(t); theta) + w(t))         (G., Eqs. (4), (5); w a disturbance, or nothing)

What `torchfsid.simulate` does for one team, for a batch of scenes, differentiably in theta, in the places of the bodies
and in all that the rows depend on. The safe control is the projection of the nominal one onto the safe controls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.outcome import ProgrammeStatus
from torchfsid.programmes.layers import ProjectOnto
from torchfsid.robots.barriers import Barrier, stack_barriers
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Task

Bodies = Callable[[int, Tensor], Tensor]
"""Where the bodies around each robot are at sample k, given where the robots are: (B, 2) -> (B, m, 2) [m]."""


class Seen(NamedTuple):
    """A sample: what is measured, and whether the QP of each robot had a solution (without one it stands still)."""

    measurement: Measurement
    feasible: Bool[Tensor, "B"]


def closed_loop(
    task: Task,
    barriers: Sequence[Barrier],
    theta: Float[Tensor, "B 2"],
    start: Float[Tensor, "B 2"],
    bodies: Bodies,
    present: Bool[Tensor, "B m"],
    *,
    dt: float,
    steps: int,
    disturbance: Float[Tensor, "steps B 2"] | None = None,
) -> Iterator[Seen]:
    """`steps` samples, `dt` [s] apart, the first at `start`; the velocity measured is the one executed."""
    x, safe = start, ProjectOnto()
    for k in range(steps):
        before = Measurement(t=k * dt, x=x, u=None, bodies=bodies(k, x), present=present)
        C, d = task(before)
        wish = (C @ theta.unsqueeze(-1)).squeeze(-1) + d
        control, status = safe(stack_barriers(barriers, before), wish)
        feasible = status == ProgrammeStatus.OK
        u = torch.where(feasible.unsqueeze(-1), control, 0.0)
        u = u if disturbance is None else u + disturbance[k]
        yield Seen(replace(before, u=u), feasible)
        x = x + dt * u
