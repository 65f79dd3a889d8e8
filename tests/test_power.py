"""What a set is worth in the end: with clipped wishes and errors at the bound, 2.1 delta / k is left, and the truth."""

import math

import pytest
import torch

from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import Barrier, SpeedPolygon
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask, Saturation
from torchfsid.sets.feasible_set import FeasibleSet

GAIN, DELTA, ROBOTS = 0.8, 0.02, 4
CLIPPED = {
    "norm": Saturation("norm", (0.4, 0.4)),
    "box": Saturation("box", (0.4, 0.3)),
    "dead zone": Saturation("norm", (0.4, 0.4), dead_speed=0.03),
}
BARRIERS: dict[str, list[Barrier]] = {
    "joint": [CollisionAvoidance(ClassK(50.0, 3), 0.3, neighbour_velocity="current"), SpeedPolygon(8, 0.5)],
    "euclidean": [CollisionAvoidance(ClassK(1.0), 0.4, distance="euclidean", soft=True)],
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("clipped", "rows"), [("norm", "joint"), ("box", "euclidean"), ("dead zone", "joint")])
def test_robots_that_come_within_reach_of_their_goals_are_known(clipped: str, rows: str) -> None:
    generator = torch.Generator().manual_seed(4)
    turn = 2 * math.pi * (torch.arange(ROBOTS) + 0.3 * torch.rand(ROBOTS, generator=generator)).double() / ROBOTS
    start = 1.3 * torch.stack([turn.cos(), turn.sin()], dim=-1)
    goals = -start + 0.2 * torch.rand(ROBOTS, 2, generator=generator, dtype=torch.float64)
    task = GoalTask(GAIN, saturation=CLIPPED[clipped])
    run = simulate(CbfQpController(task, BARRIERS[rows]), goals, start, dt=0.1, steps=120)
    prior = FeasibleSet.from_box(torch.full((ROBOTS, 2), -3.0), torch.full((ROBOTS, 2), 3.0))
    noise = NoiseBound(DELTA, neighbour_velocity=DELTA)
    watching = SetMembershipObserver(task, BARRIERS[rows], prior, noise=noise)
    clipped_samples = 0
    for k, t in enumerate(run.t.tolist()):
        angle = 2 * math.pi * torch.rand(ROBOTS, generator=generator, dtype=torch.float64)
        error = DELTA * torch.stack([angle.cos(), angle.sin()], dim=-1)
        estimate = watching.update(Measurement.of_team(t, run.x[k], run.u[k] + error))
        assert estimate.feasible_set.contains(goals).all()
        clipped_samples += int((GAIN * (goals - run.x[k])).norm(dim=-1).gt(0.4).sum())
    assert clipped_samples > 0.2 * ROBOTS * len(run.t)
    assert watching.status.tolist() == [Status.OK] * ROBOTS
    arrived = (goals - run.x[-1]).norm(dim=-1) < 0.3 * 0.4 / GAIN
    assert arrived.sum() >= 3
    assert (watching.feasible_set.diameter()[arrived] <= 2.1 * DELTA / GAIN).all()
