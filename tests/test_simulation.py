"""The closed loop: the paper's timelines, hand-written loops with closed-form controls, deadlock, gradients."""

import itertools

import numpy as np
import pytest
import torch

from torchfsid.errors import InputError
from torchfsid.identification.active_set import active_set
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import SpeedBox, stack_barriers
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import STILL, simulate
from torchfsid.robots.tasks import GoalTask


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def goal_controller(gain, Ds, gamma, **options):
    return CbfQpController(GoalTask(gain), [CollisionAvoidance(ClassK(gamma), safety_distance=Ds, **options)])


def timelines(controller, trajectory):
    """For each robot [(time from which, rows that the observer sees active), ...]."""
    intervals = [[] for _ in range(trajectory.robots)]
    for measurement in trajectory.measurements():
        active = active_set(stack_barriers(controller.barriers, measurement), measurement.u)
        for of_robot, rows in zip(intervals, active, strict=True):
            names = set(rows.nonzero().flatten().tolist())
            if not of_robot or of_robot[-1][1] != names:
                of_robot.append((measurement.t, names))
    return intervals


def counts(intervals):
    """The same for one robot, with the number of rows only."""
    merged = []
    for t, rows in intervals:
        if not merged or merged[-1][1] != len(rows):
            merged.append((t, len(rows)))
    return merged


# ---------------------------------------------------------------- the paper's experiments


def test_two_pairs_follow_the_paper():
    """Obstacles 1, 2 both active until 1.1 s, then 3, 4 until 2.1 s, then none."""
    controller = goal_controller(1.8605, 0.3688, 1.1544)
    obstacles = tensor([0.9215, 0.6738], [0.9215, -0.6738], [2.5677, 1.2122], [2.5677, -1.2122])
    trajectory = simulate(
        controller, tensor([3.5250, -0.0689]), tensor([0.0, 0.0]), dt=0.02, steps=115, obstacles=obstacles
    )
    (intervals,) = timelines(controller, trajectory)
    assert [rows for _, rows in intervals if len(rows) != 1] == [{1, 2}, {3, 4}, set()]
    start_of = {frozenset(rows): t for t, rows in intervals}
    assert start_of[frozenset({1, 2})] == 0
    assert start_of[frozenset({3, 4})] == pytest.approx(1.1, abs=0.04)
    assert start_of[frozenset()] == pytest.approx(2.1, abs=0.04)
    # One row alone is active at most in passing: the paper's two switches take a step or so.
    for (t, rows), (until, _) in itertools.pairwise(intervals):
        assert len(rows) == 2 or until - t < 0.04
    assert trajectory.feasible.all()
    assert trajectory.deadlocked_since.isnan().all()


def test_mixed_active_follows_the_paper():
    """One active until 0.38 s, exactly two until 2.08 s, one until 3.68 s, then none."""
    controller = goal_controller(0.9752, 0.7357, 3.3569)
    obstacles = tensor([2.6327, 0.8492], [4.5638, 0.3118], [2.2581, 0.5677], [2.9713, -0.7943], [3.4355, 0.7297])
    trajectory = simulate(
        controller, tensor([5.7256, 0.1281]), tensor([0.0, 0.0]), dt=0.02, steps=190, obstacles=obstacles
    )
    (of_robot,) = timelines(controller, trajectory)
    intervals = counts(of_robot)
    assert [count for _, count in intervals] == [1, 2, 1, 0]
    assert [t for t, _ in intervals] == pytest.approx([0.0, 0.38, 2.08, 3.68], abs=0.04)


def test_four_robots_each_have_two_active_neighbours_for_most_of_the_way():
    """Each in case D from .02-.08 s to .78-2.04 s, then one neighbour, then none; no deadlock."""
    controller = goal_controller(0.8434, 0.3515, 1.5704)
    trajectory = simulate(
        controller,
        tensor([-1.7208, 0.0952], [0.1176, -1.671], [1.6816, -0.2556], [0.0068, 1.6019]),
        tensor([0.6138, -0.5031], [0.1617, 1.0376], [-0.9789, 0.0649], [0.3538, -1.0515]),
        dt=0.02,
        steps=130,
    )
    intervals = [counts(of_robot) for of_robot in timelines(controller, trajectory)]
    assert [[count for _, count in of_robot] for of_robot in intervals] == [[1, 2, 1, 0]] * 4
    assert [of_robot[1][0] for of_robot in intervals] == pytest.approx([0.02, 0.02, 0.06, 0.08], abs=1e-9)
    assert [of_robot[2][0] for of_robot in intervals] == pytest.approx([2.04, 0.78, 1.78, 1.54], abs=1e-9)
    assert trajectory.feasible.all()
    assert trajectory.deadlocked_since.isnan().all()


def test_what_the_observer_sees_active_is_what_was_active():
    """The rows within 1e-3 m/s of the control contain the support of the multipliers, and on these data equal it."""
    controller = goal_controller(0.8434, 0.3515, 1.5704)
    theta, start = tensor([2.0, 0.1], [-2.0, -0.1], [0.1, 2.0]), tensor([-1.0, 0.0], [1.0, 0.0], [0.0, -1.0])
    trajectory = simulate(controller, theta, start, dt=0.02, steps=60)
    agree = []
    for k, measurement in enumerate(trajectory.measurements()):
        seen = active_set(stack_barriers(controller.barriers, measurement), measurement.u)
        assert not (trajectory.active[k] & ~seen).any()
        agree.append(torch.equal(seen, trajectory.active[k]))
    assert np.mean(agree) > 0.95
    assert trajectory.active.any()


# ---------------------------------------------------------------- by hand


def one_row_control(x, goal, other, velocity, gain, Ds, gamma):
    """uhat, pushed back onto the one half-plane it violates."""
    dx, uhat = x - other, gain * (goal - x)
    a, b = -2 * dx, gamma * (dx @ dx - Ds**2) - 2 * dx @ velocity
    return uhat - max(0.0, a @ uhat - b) / (a @ a) * a


def test_one_robot_and_one_obstacle_by_hand():
    gain, Ds, gamma, dt = 0.9, 0.5, 1.3, 0.05
    goal, obstacle = np.array([2.0, 0.1]), np.array([1.0, 0.0])
    trajectory = simulate(
        goal_controller(gain, Ds, gamma),
        tensor([2.0, 0.1]),
        tensor([0.0, 0.0]),
        dt=dt,
        steps=60,
        obstacles=tensor([1.0, 0.0]),
    )
    x = np.zeros(2)
    assert trajectory.t.tolist() == pytest.approx([0.05 * k for k in range(61)])
    for k in range(61):
        u = one_row_control(x, goal, obstacle, np.zeros(2), gain, Ds, gamma)
        np.testing.assert_allclose(trajectory.x[k].numpy(), [x, obstacle], atol=1e-12)
        np.testing.assert_allclose(trajectory.u[k].numpy(), [u, [0, 0]], atol=1e-12)
        np.testing.assert_allclose(trajectory.nominal[k, 0].numpy(), gain * (goal - x), atol=1e-12)
        x = x + dt * u
    assert trajectory.active[:, 0, 1].any()
    assert not trajectory.active[:, 0, 1].all()


@pytest.mark.parametrize("neighbour_velocity", ["none", "previous"])
def test_two_robots_by_hand(neighbour_velocity):
    """Both compute from the same positions, and know of each other what the barrier says."""
    gain, Ds, gamma, dt = 0.9, 0.5, 1.3, 0.05
    goals = np.array([[2.0, 0.1], [-1.0, 0.05]])
    x, u = np.array([[0.0, 0.0], [1.5, 0.2]]), np.zeros((2, 2))
    trajectory = simulate(
        goal_controller(gain, Ds, gamma, neighbour_velocity=neighbour_velocity),
        torch.tensor(goals),
        torch.tensor(x),
        dt=dt,
        steps=40,
    )
    for k in range(41):
        known = u if neighbour_velocity == "previous" else np.zeros((2, 2))
        u = np.stack([one_row_control(x[i], goals[i], x[1 - i], known[1 - i], gain, Ds, gamma) for i in range(2)])
        np.testing.assert_allclose(trajectory.x[k].numpy(), x, atol=1e-11)
        np.testing.assert_allclose(trajectory.u[k].numpy(), u, atol=1e-11)
        x = x + dt * u
    assert trajectory.active.any()


@pytest.mark.parametrize("neighbour_velocity", ["none", "previous", "current"])
def test_the_measurements_explain_the_controls(neighbour_velocity):
    """What the observer is told is enough to compute each robot's control from its own rows, to round-off."""
    rng = np.random.default_rng(4)
    avoid = CollisionAvoidance(ClassK(1.4), margin=0.05, neighbour_velocity=neighbour_velocity)
    controller = CbfQpController(GoalTask(1.0), [avoid, SpeedBox((1.0, 0.8))])
    angles = np.linspace(0, 2 * np.pi, 4, endpoint=False) + rng.uniform(-0.3, 0.3, size=4)
    start = 1.5 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    theta = torch.tensor(-start + rng.normal(size=(4, 2)) * 0.1)
    trajectory = simulate(
        controller,
        theta,
        torch.tensor(start),
        dt=0.05,
        steps=40,
        obstacles=tensor([0.2, 0.1]),
        radius=tensor(0.1, 0.15, 0.2, 0.1, 0.1),
    )
    for k, measurement in enumerate(trajectory.measurements()):
        control = controller(measurement, theta)
        assert torch.equal(control.feasible, trajectory.feasible[k])
        of_feasible = trajectory.feasible[k]
        torch.testing.assert_close(
            control.u[of_feasible], trajectory.u[k, :4][of_feasible], atol=1e-9, rtol=0, msg=f"sample {k}"
        )
        assert measurement.t == pytest.approx(0.05 * k)
        assert measurement.bodies.shape == (4, 5, 2)
        assert not measurement.present.diagonal().any()
    assert trajectory.active[:, :, :5].any()
    assert trajectory.active[:, :, 5:].any()


# ---------------------------------------------------------------- what goes wrong in a run


def test_a_head_on_deadlock_is_detected():
    """Goal exactly behind the obstacle: the robot creeps up to the safety distance and stays there."""
    trajectory = simulate(
        goal_controller(1.0, 0.5, 2.0),
        tensor([3.0, 0.0], [0.0, 5.0], [0.0, -5.0]),
        tensor([0.0, 0.0], [0.0, 4.0], [0.0, -5.0]),
        dt=0.05,
        steps=120,
        obstacles=tensor([1.5, 0.0]),
    )
    since = trajectory.deadlocked_since
    assert since.isnan().tolist() == [False, True, True]  # to arrive, or to be there already, is no deadlock
    speed, nominal = trajectory.u[:, 0].norm(dim=-1).numpy(), trajectory.nominal[:, 0].norm(dim=-1).numpy()
    first = round(float(since[0]) / 0.05)
    assert 0 < first < 120
    assert (speed[first:] <= STILL * nominal[first:]).all()
    assert speed[first - 1] > STILL * nominal[first - 1]
    assert trajectory.feasible.all()
    np.testing.assert_allclose(trajectory.x[-1, 0].numpy(), [1.0, 0.0], atol=1e-3)


def test_a_robot_that_waits_and_goes_on_is_not_deadlocked():
    """Head-on again, but the obstacle is off the line by a hundredth of a millimetre: it stands, then gets around."""
    trajectory = simulate(
        goal_controller(1.0, 0.5, 6.0),
        tensor([3.0, 0.0]),
        tensor([0.0, 0.0]),
        dt=0.1,
        steps=100,
        obstacles=tensor([1.5, 1e-5]),
    )
    speed, nominal = trajectory.u[:, 0].norm(dim=-1), trajectory.nominal[:, 0].norm(dim=-1)
    assert (speed < STILL * nominal).any()
    assert trajectory.deadlocked_since.isnan().all()
    np.testing.assert_allclose(trajectory.x[-1, 0].numpy(), [3.0, 0.0], atol=0.02)


def test_an_infeasible_robot_stops_and_the_run_goes_on():
    """The first robot starts too close to two obstacles on either side of it; the second has nothing to do with it."""
    trajectory = simulate(
        goal_controller(1.0, 0.5, 2.0),
        tensor([3.0, 0.0], [3.0, 5.0]),
        tensor([0.0, 0.0], [0.0, 5.0]),
        dt=0.05,
        steps=30,
        obstacles=tensor([0.3, 0.0], [-0.3, 0.0]),
    )
    assert not trajectory.feasible[:, 0].any()
    assert trajectory.feasible[:, 1].all()
    assert (trajectory.x[:, 0] == 0).all()
    assert trajectory.deadlocked_since[0] == 0
    np.testing.assert_allclose(trajectory.x[-1, 1].numpy(), [3.0 * (1 - 0.95**30), 5.0], atol=1e-12)


def test_what_simulate_refuses():
    controller = goal_controller(1.0, 0.5, 2.0)
    goal, start = tensor([3.0, 0.0]), tensor([0.0, 0.0])
    with pytest.raises(InputError, match="dt"):
        simulate(controller, goal, start, dt=0.0, steps=10)
    with pytest.raises(InputError, match="steps"):
        simulate(controller, goal, start, dt=0.1, steps=0)
    with pytest.raises(InputError, match="start"):
        simulate(controller, goal, tensor([0.0, float("inf")]), dt=0.1, steps=1)
    with pytest.raises(InputError, match="obstacles"):
        simulate(controller, goal, start, dt=0.1, steps=1, obstacles=tensor([0.0, float("nan")]))
    with pytest.raises(InputError, match="radius"):
        simulate(controller, goal, start, dt=0.1, steps=1, radius=tensor(0.1, 0.2, 0.3))
    with pytest.raises(InputError, match="theta"):
        simulate(controller, tensor([3.0, 0.0, 1.0]), start, dt=0.1, steps=1)


# ---------------------------------------------------------------- gradients


@pytest.mark.parametrize("neighbour_velocity", ["none", "previous", "current"])
def test_gradients_of_the_closed_loop(neighbour_velocity):
    """Final positions against central finite differences, in everything the run depends on, away from switches."""
    values = {
        "theta": tensor([3.0, 0.3], [-1.0, 0.4]),
        "start": tensor([0.0, 0.0], [2.0, 0.3]),
        "obstacles": tensor([0.6, 1.1], [3.0, -1.2]),
        "gain": torch.tensor(1.1, dtype=torch.float64),
        "Ds": torch.tensor(0.5, dtype=torch.float64),
        "gamma": torch.tensor(1.3, dtype=torch.float64),
    }

    def run(theta, start, obstacles, gain, Ds, gamma):
        controller = goal_controller(gain, Ds, gamma, neighbour_velocity=neighbour_velocity)
        return simulate(controller, theta, start, dt=0.05, steps=5, obstacles=obstacles)

    final = run(**values)
    assert final.active[:-1].sum(-1).max() == 2  # avoiding, with one row and with two
    assert final.active[:-1].any(-1).all()
    weight = tensor([1.0, -0.7], [0.4, 1.3])

    inputs = {name: value.clone().requires_grad_() for name, value in values.items()}
    (run(**inputs).x[-1, :2] * weight).sum().backward()
    step = 1e-6
    for name, value in values.items():
        gradient = inputs[name].grad
        assert gradient is not None
        assert gradient.abs().sum() > 1e-3, name
        for index in range(value.numel()):
            shift = torch.zeros(value.numel(), dtype=torch.float64)
            shift[index] = step
            plus, minus = (run(**{**values, name: value + sign * shift.reshape(value.shape)}) for sign in (1, -1))
            assert torch.equal(plus.active, final.active)  # no switch in between
            assert torch.equal(minus.active, final.active)
            difference = ((plus.x[-1, :2] - minus.x[-1, :2]) * weight).sum() / (2 * step)
            assert gradient.flatten()[index] == pytest.approx(float(difference), rel=1e-6, abs=1e-6), (name, index)
