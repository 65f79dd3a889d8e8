"""The fleet of the benchmarks `fleet` and `observer`: robots on a square, 4 m^2 each, going to goals past each other.

Each robot avoids its 8 nearest bodies by the paper's rows (gain 1.5, Ds 0.4 m), and its control solves its QP exactly.
The declared bound is 5 mm/s. `noisy` controls have an error in a disc of this radius, and sets are cut at most steps.
Other controls are exact, as in a simulator's log, and sets are cut at the first steps only. Every 40 steps of 0.05 s
all robots are moved to new places while their goals stay, so that a run can be of any length. `clip` limits the nominal
controls by norm or by axis, at a speed that about half of the robots exceed at their new places. Everything is seeded.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.neighbours import nearest_bodies
from torchfsid.robots.tasks import GoalTask, Saturation
from torchfsid.sets.feasible_set import FeasibleSet

NEIGHBOURS, STEP, EPISODE, ERROR = 8, 0.05, 40, 5e-3
TASK, BARRIER = GoalTask(0.9), CollisionAvoidance(ClassK(1.5), safety_distance=0.4)
SHARES = {"norm": 0.9, "box": 0.8}
"""The limits of clipped nominal controls, for a square of 2 m [m/s]."""

Clip = Literal["norm", "box"]


def solve_qp(A: Tensor, b: Tensor, nominal: Tensor) -> Tensor:
    """argmin |u - nominal|^2 s.t. A u <= b, row by row.

    It is the best of the feasible projections onto no row, one row, two rows. Where there is none it is zero, as
    controllers do.
    """
    m = b.shape[1]
    i, j = torch.triu_indices(m, m, 1)
    beyond = (A @ nominal.unsqueeze(-1)).squeeze(-1) - b
    one = nominal.unsqueeze(1) - A * (beyond / A.square().sum(-1)).unsqueeze(-1)
    (p, q), (r, s) = A[:, i].unbind(-1), A[:, j].unbind(-1)
    two = torch.stack([b[:, i] * s - b[:, j] * q, p * b[:, j] - r * b[:, i]], dim=-1) / (p * s - q * r).unsqueeze(-1)
    candidates = torch.cat([nominal.unsqueeze(1), one, two.nan_to_num(torch.inf)], dim=1)
    feasible = (candidates @ A.mT <= b.unsqueeze(1) + 1e-9).all(-1)
    apart = torch.where(feasible, (candidates - nominal.unsqueeze(1)).square().sum(-1), torch.inf)
    best, which = apart.min(-1, keepdim=True)
    u = candidates.gather(1, which.unsqueeze(-1).expand(-1, -1, 2)).squeeze(1)
    return torch.where(best.isfinite(), u, 0.0)


class Fleet:
    """The robots. Iterating gives time, positions and measured controls, without end."""

    def __init__(self, robots: int, noisy: bool = False, seed: int = 0, clip: Clip | None = None) -> None:
        self.error = ERROR if noisy else 0.0
        self.rng, self.half = np.random.default_rng(seed), float(np.ceil(np.sqrt(robots)))
        limit = None if clip is None else SHARES[clip] * self.half
        self.task = TASK if limit is None else replace(TASK, saturation=Saturation(clip, (limit, limit)))
        self.goals = self._places(robots)

    def _places(self, robots: int) -> Tensor:
        """One place in each cell of a grid of 2 m, in random order. No two are closer than 0.5 m."""
        side = int(self.half)
        cell = self.rng.permutation(side * side)[:robots]
        corner = np.stack([cell % side, cell // side], axis=-1) * 2.0 - self.half
        return torch.from_numpy(corner + self.rng.uniform(0.25, 1.75, (robots, 2)))

    def __iter__(self) -> Iterator[tuple[float, Tensor, Tensor]]:
        step, robots = 0, len(self.goals)
        while True:
            if step % EPISODE == 0:
                x = self._places(robots)
            rows = BARRIER(nearest_bodies(0.0, x, count=NEIGHBOURS))
            wish = 0.9 * (self.goals - x)
            wish = wish if self.task.saturation is None else self.task.saturation(wish)
            u = solve_qp(rows.A, rows.b.masked_fill((rows.A == 0).all(-1), torch.inf).nan_to_num(1e9), wish)
            angle, size = self.rng.uniform(0, 2 * np.pi, robots), self.error * np.sqrt(self.rng.uniform(0, 1, robots))
            error = torch.from_numpy(size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
            yield STEP * step, x, torch.where((u == 0).all(-1, keepdim=True), u, u + error)
            x, step = x + STEP * u, step + 1

    def prior(self) -> FeasibleSet:
        """The prior sets of all robots."""
        corner = torch.full_like(self.goals, self.half + 1)
        return FeasibleSet.from_box(-corner, corner)


def observer(prior: FeasibleSet, compiled: bool, task: GoalTask = TASK) -> SetMembershipObserver:
    """The observer of the sets, compiled or in torch."""
    return SetMembershipObserver(task, [BARRIER], prior, noise=NoiseBound(ERROR), compiled=compiled)


def measured(t: float, x: Tensor, u: Tensor, robots: range | None = None, neighbours: int = NEIGHBOURS) -> Measurement:
    """The measurement of these robots among their nearest neighbours."""
    return nearest_bodies(t, x, u, count=neighbours, robots=robots)
