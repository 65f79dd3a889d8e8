"""The closed loop by the batch, and among bodies that move."""

import itertools

import numpy as np
import pytest
import torch

from torchfsid.errors import InputError
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import closed_loop, simulate
from torchfsid.robots.tasks import GoalTask


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def goal_controller(gain, Ds, gamma):
    return CbfQpController(GoalTask(gain), [CollisionAvoidance(ClassK(gamma), safety_distance=Ds)])


@pytest.mark.parametrize("neighbour_velocity", ["none", "previous"])
def test_a_batch_of_teams_is_one_team_after_the_other(neighbour_velocity):
    """Two by three teams of two robots and an obstacle, each by its own radius."""
    rng = np.random.default_rng(2)
    controller = CbfQpController(
        GoalTask(1.0), [CollisionAvoidance(ClassK(1.4), margin=0.05, neighbour_velocity=neighbour_velocity)]
    )
    shape = (2, 3, 2, 2)
    start = torch.from_numpy(rng.uniform(-0.2, 0.2, shape)) + tensor([-1.0, 0.0], [1.0, 0.0])
    theta, obstacles = torch.from_numpy(rng.uniform(-0.5, 0.5, shape)), torch.from_numpy(rng.normal(size=(3, 1, 2)))
    obstacles, radius = (
        1.5 * obstacles / obstacles.norm(dim=-1, keepdim=True),
        torch.from_numpy(rng.uniform(0.1, 0.3, 3)),
    )
    runs = simulate(controller, theta, start, dt=0.05, steps=40, obstacles=obstacles, radius=radius)
    assert runs.active.any(-1).any(0).all(-1).any()
    for i, j in itertools.product(range(2), range(3)):
        one = simulate(controller, theta[i, j], start[i, j], dt=0.05, steps=40, obstacles=obstacles[j], radius=radius)
        for name in ("x", "u", "nominal", "active", "feasible"):
            torch.testing.assert_close(getattr(runs, name)[:, i, j], getattr(one, name), rtol=0, atol=1e-12)
        torch.testing.assert_close(runs.deadlocked_since[i, j], one.deadlocked_since, equal_nan=True)
        ours, theirs = runs.measurement(3), one.measurement(3)
        for name in ("x", "u", "bodies", "present", "body_velocities", "previous_body_velocities", "body_radii"):
            torch.testing.assert_close(getattr(ours, name)[i, j], getattr(theirs, name), rtol=0, atol=1e-12)


def test_a_measurement_of_a_run_is_that_of_its_team():
    controller = goal_controller(1.0, 0.5, 2.0)
    run = simulate(controller, tensor([3.0, 0.0]), tensor([0.0, 0.0]), dt=0.1, steps=3, obstacles=tensor([1.0, 0.4]))
    seen = run.measurement(2)
    team = Measurement.of_team(float(run.t[2]), run.x[2], run.u[2], robots=[0], previous_u=run.u[1])
    for name in ("x", "u", "bodies", "present", "body_velocities", "previous_body_velocities"):
        assert torch.equal(getattr(seen, name), getattr(team, name)), name


def test_a_loop_among_moving_bodies_under_a_disturbance_by_hand():
    """A robot without anything in its way goes where its task and the disturbance take it."""
    rng = np.random.default_rng(3)
    push = torch.from_numpy(rng.normal(size=(20, 1, 2)))

    def surroundings(t, x, previous_u):
        beside = (x + tensor([0.0, 9.0 + t])).unsqueeze(-2)
        return Measurement(t, x, None, beside, torch.ones(1, 1, dtype=torch.bool))

    goal, x = tensor([1.0, -1.0]), tensor([0.2, 0.1])
    loop = closed_loop(goal_controller(0.8, 0.5, 1.0), goal, x, surroundings, dt=0.1, samples=20, disturbance=push)
    for k, sample in enumerate(loop):
        u = 0.8 * (goal - x) + push[k]
        torch.testing.assert_close(sample.measurement.x, x)
        torch.testing.assert_close(sample.measurement.u, u)
        torch.testing.assert_close(sample.control.u, sample.control.nominal)
        assert sample.measurement.t == pytest.approx(0.1 * k)
        assert not sample.still.any()
        x = x + 0.1 * u


@pytest.mark.usefixtures("unchecked")
def test_batches_that_do_not_fit_are_refused():
    controller, goal, start = goal_controller(1.0, 0.5, 2.0), tensor([3.0, 0.0]), tensor([0.0, 0.0])
    pair = start.expand(2, 1, 2)
    with pytest.raises(InputError, match="obstacles"):
        simulate(controller, goal.expand(2, 1, 2), pair, dt=0.1, steps=1, obstacles=start.expand(3, 1, 2))
    with pytest.raises(InputError, match="theta"):
        simulate(controller, goal.expand(2, 1, 2), start, dt=0.1, steps=1)
    joint = [CollisionAvoidance(ClassK(1.0), safety_distance=0.5, neighbour_velocity="current")]
    of_one = Measurement(0.0, start, None, start.expand(1, 1, 2), torch.zeros(1, 1, dtype=torch.bool))
    with pytest.raises(InputError, match="for a joint QP"):
        CbfQpController(GoalTask(1.0), joint)(of_one, goal.expand(2, 1, 2))
