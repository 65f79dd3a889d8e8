"""What the tests of the filter share: two closed loops, a robot with nothing in its way, and measurements that fail."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from torchfsid.observers.ukf import ParameterUkf
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask

# Two pairs of obstacles, one pair active until 1.1 s and the other until 2.1 s, then none.
TASK = GoalTask(1.8605)
BARRIERS = [CollisionAvoidance(ClassK(1.1544), safety_distance=0.3688)]
GOAL = torch.tensor([[3.5250, -0.0689]], dtype=torch.float64)
OBSTACLES = torch.tensor([[0.9215, 0.6738], [0.9215, -0.6738], [2.5677, 1.2122], [2.5677, -1.2122]])
# Four robots that cross each other's way.
TEAM_TASK = GoalTask(0.8434)
TEAM_BARRIERS = [CollisionAvoidance(ClassK(1.5704), safety_distance=0.3515)]
TEAM_GOALS = torch.tensor([[-1.7208, 0.0952], [0.1176, -1.671], [1.6816, -0.2556], [0.0068, 1.6019]]).double()
TEAM_STARTS = torch.tensor([[0.6138, -0.5031], [0.1617, 1.0376], [-0.9789, 0.0649], [0.3538, -1.0515]])


@cache
def two_pairs_run() -> Trajectory:
    start = torch.zeros(1, 2)
    return simulate(CbfQpController(TASK, BARRIERS), GOAL, start, obstacles=OBSTACLES, dt=0.05, steps=52)


@cache
def team_run() -> Trajectory:
    return simulate(CbfQpController(TEAM_TASK, TEAM_BARRIERS), TEAM_GOALS, TEAM_STARTS, dt=0.05, steps=50)


def box(robots: int, half: float = 6.0, p: int = 2) -> tuple[Tensor, Tensor]:
    upper = torch.full((robots, p), half, dtype=torch.float64)
    return -upper, upper


def lost(measurement: Measurement, robots: Sequence[int]) -> Measurement:
    """The measurement without some robots, as a log gives it: zeros, never NaN."""
    assert measurement.u is not None
    observed = torch.ones(len(measurement.x), dtype=torch.bool)
    observed[list(robots)] = False
    keep = observed.unsqueeze(-1)
    return replace(measurement, x=measurement.x * keep, u=measurement.u * keep, observed=observed)


def free_run(steps: int, dt: float = 0.02, goal: Tensor | None = None) -> Iterator[Measurement]:
    """A robot, or one for each goal, with nothing in its way."""
    goal = torch.tensor([[2.0, -1.0]], dtype=torch.float64) if goal is None else goal
    x = torch.zeros_like(goal)
    for k in range(steps):
        u = goal - x
        yield Measurement(k * dt, x, u, torch.full((len(x), 1, 2), 50.0).double(), torch.ones(len(x), 1).bool())
        x = x + dt * u


def free_ukf(**settings: float | bool) -> ParameterUkf:
    return ParameterUkf.from_prior(GoalTask(1.0), BARRIERS, *box(1), **settings)
