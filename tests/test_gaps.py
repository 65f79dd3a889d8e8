"""Rows that are missing from a log: no truth is lost, and what was provably far away costs nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from torchfsid.logs.gaps import bridged
from torchfsid.logs.log import Log
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet

ROBOTS, TASK = 4, GoalTask(0.9)
BODIES = ("a", "b", "c", "d", "pillar")


def crossing(barrier: CollisionAvoidance) -> tuple[Trajectory, Tensor]:
    """Four robots change places around a pillar."""
    turn = torch.arange(ROBOTS) * (torch.pi / 2)
    start = 2 * torch.stack([turn.cos(), turn.sin()], dim=-1).to(torch.float64)
    goals = -start + torch.tensor([[0.1, 0.3], [-0.2, 0.1], [0.2, -0.2], [0.3, 0.1]], dtype=torch.float64)
    pillar = torch.tensor([[0.5, 0.9]], dtype=torch.float64)
    return simulate(CbfQpController(TASK, [barrier]), goals, start, dt=0.05, steps=80, obstacles=pillar), goals


def log_of(run: Trajectory, seen: np.ndarray) -> Log:
    where = seen[..., None]
    x, u = run.x.numpy(), run.u.numpy()
    return Log("run", BODIES, run.t.numpy(), np.where(where, x, 0.0), np.where(where, u, 0.0), seen, seen)


def observed(log: Log, barrier: CollisionAvoidance) -> SetMembershipObserver:
    prior = FeasibleSet.from_box(torch.full((ROBOTS, 2), -6.0), torch.full((ROBOTS, 2), 6.0))
    watching = SetMembershipObserver(TASK, [barrier], prior, noise=NoiseBound(1e-4))
    for measurement in log.measurements(BODIES[:ROBOTS], {barrier.neighbour_velocity}):
        watching.update(measurement)
    return watching


@pytest.mark.parametrize("neighbour_velocity", ["none", "current", "previous"])
def test_missing_rows_lose_no_truth(neighbour_velocity: str) -> None:
    barrier = CollisionAvoidance(ClassK(2.0), safety_distance=0.6, neighbour_velocity=neighbour_velocity)
    run, goals = crossing(barrier)
    seen = np.random.default_rng(0).random(run.x.shape[:2]) > 0.15
    seen[0] = seen[-1] = True
    log = log_of(run, seen)
    filled = bridged(log)
    assert filled.seen.all()
    assert filled.position_error is not None
    off = np.linalg.norm(filled.x - run.x.numpy(), axis=-1)
    assert (off <= filled.position_error + 1e-12).all()
    assert off.max() > 0

    watching = observed(filled, barrier)
    assert watching.status.tolist() == [Status.OK] * ROBOTS
    assert watching.feasible_set.contains(goals).all()
    assert (watching.feasible_set.diameter() < 0.05).all()
    ignoring = observed(log, barrier)
    assert not (ignoring.feasible_set.contains(goals) & (ignoring.status == Status.OK)).all()


def test_a_body_that_is_far_away_is_not_missed() -> None:
    barrier = CollisionAvoidance(ClassK(2.0), safety_distance=0.6)
    run, _ = crossing(barrier)
    seen = np.ones(run.x.shape[:2], dtype=bool)
    seen[1:6, 1] = False  # all are still 2 m and more apart
    filled = observed(bridged(log_of(run, seen)), barrier)
    whole = observed(log_of(run, np.ones_like(seen)), barrier)
    assert filled.skipped.tolist() == [0, 5, 0, 0]
    others = [0, 2, 3]
    expected = whole.feasible_set.diameter()[others]
    torch.testing.assert_close(filled.feasible_set.diameter()[others], expected, rtol=1e-6, atol=0)


def test_bodies_come_and_go() -> None:
    """Before its first row and after its last one a body is not there, and a log without gaps stays as it is."""
    run, _ = crossing(CollisionAvoidance(ClassK(2.0), safety_distance=0.6))
    seen = np.ones(run.x.shape[:2], dtype=bool)
    seen[:9, 2] = seen[70:, 3] = False
    log = log_of(run, seen)
    assert bridged(log) is log
    lost = replace(log_of(run, seen & (np.arange(seen.shape[0])[:, None] != 30)), lost=~seen)
    assert bridged(lost) is lost
