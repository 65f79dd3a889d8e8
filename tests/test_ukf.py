"""The unscented Kalman filter on [x; theta]: against a plain Kalman filter, with the QP inside, and its interface."""

from __future__ import annotations

import math
import pickle
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.filters import (
    BARRIERS,
    GOAL,
    TASK,
    TEAM_BARRIERS,
    TEAM_TASK,
    box,
    free_run,
    free_ukf,
    team_run,
    two_pairs_run,
)
from torchfsid.errors import InputError, SolverError
from torchfsid.observers.ukf import FLOOR, ParameterUkf
from torchfsid.outcome import Status
from torchfsid.robots.barriers import SpeedBox
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask, UnknownGainGoalTask, VelocityTask


@pytest.fixture(scope="module")
def two_pairs() -> Trajectory:
    return two_pairs_run()


@pytest.fixture(scope="module")
def team() -> Trajectory:
    return team_run()


def kalman_filter(
    team: Trajectory, robot: int, samples: Sequence[int], spread: float, noises: dict[str, float]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Theta's mean and covariance by the textbook's five equations; active sets from the simulation itself."""
    R, walk, drift = (noises[f"{name}_noise"] ** 2 for name in ("position", "motion", "process"))
    H, identity = np.eye(2, 4), np.eye(4)
    state = np.concatenate([team.x[samples[0], robot].numpy(), np.zeros(2)])
    P = np.diag([R, R, spread**2, spread**2])
    history = [(state[2:], P[2:, 2:])]
    for k, following in pairwise(samples):
        dt = float(team.t[following] - team.t[k])
        x, u = team.x[k, robot].numpy(), team.u[k, robot].numpy()
        rows = team.x[k, team.active[k, robot]].numpy() - x
        span = np.linalg.pinv(rows) @ rows
        free = (np.eye(2) - span) * TEAM_TASK.gain
        F = identity.copy()
        F[:2, 2:] = dt * free
        state = F @ state + np.concatenate([dt * (span @ u - free @ x), np.zeros(2)])
        P = F @ P @ F.T + dt * np.diag([walk, walk, drift, drift])
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R * np.eye(2))
        state = state + K @ (team.x[following, robot].numpy() - H @ state)
        P = (identity - K @ H) @ P
        history.append((state[2:], P[2:, 2:]))
    return history


# The linear model ---------------------------------------------------------------------------------------------------


def test_equals_a_plain_kalman_filter(team: Trajectory) -> None:
    """At irregular times, through all active sets of four robots."""
    assert len(team.active.flatten(0, 1).unique(dim=0)) > 5
    samples = sorted(np.random.default_rng(1).choice(51, 35, replace=False).tolist())
    noises = {"position_noise": 0.02, "motion_noise": 0.003, "process_noise": 0.01}
    ukf = ParameterUkf(TEAM_TASK, TEAM_BARRIERS, torch.zeros(4, 2), 3.0, **noises)
    estimates = [ukf.update(team.measurement(k)) for k in samples]
    assert all(bool((estimate.status == Status.OK).all()) for estimate in estimates[1:])
    for robot in range(4):
        history = kalman_filter(team, robot, samples, 3.0, noises)
        for estimate, (theta, covariance) in zip(estimates, history, strict=True):
            np.testing.assert_allclose(estimate.theta[robot], theta, atol=1e-8)
            np.testing.assert_allclose(estimate.covariance[robot], covariance, atol=1e-8)


def test_learns_nothing_while_two_rows_are_active(two_pairs: Trajectory) -> None:
    """G = 0: the mean stands still, the covariance grows by the drift, until the robot is free."""
    ukf = ParameterUkf.from_prior(TASK, BARRIERS, *box(1), process_noise=0.1)
    for measurement in two_pairs.measurements():
        estimate = ukf.update(measurement)
        if measurement.t < 2.0:
            drift = 0.1**2 * measurement.t
            torch.testing.assert_close(estimate.theta, torch.zeros(1, 2).double(), atol=1e-12, rtol=0)
            expected = (12**2 / 12 + drift) * torch.eye(2).double().unsqueeze(0)
            torch.testing.assert_close(estimate.covariance, expected, atol=1e-12, rtol=1e-12)
    assert (estimate.theta - GOAL).norm() < 1e-3


def test_without_process_noise_only_the_floor_is_added(two_pairs: Trajectory) -> None:
    ukf = ParameterUkf.from_prior(TASK, BARRIERS, *box(1), process_noise=0.0, motion_noise=0.0)
    for k in range(40):
        estimate = ukf.update(two_pairs.measurement(k))
    assert estimate.covariance[0].diagonal().sub(12.0).abs().max() < 12.0 * (51 * FLOOR**2 + 1e-13)


@pytest.mark.parametrize("qp_inside", [False, True])
def test_converges_where_nothing_is_active(qp_inside: bool) -> None:
    ukf = free_ukf(qp_inside=qp_inside)
    errors = [(ukf.update(measurement).theta - torch.tensor([[2.0, -1.0]])).norm() for measurement in free_run(40)]
    assert errors[0] > 2.0
    assert errors[5] < 1e-2
    assert errors[-1] < 1e-4


def test_the_covariance_means_what_it_says() -> None:
    """With goals and noises as declared, the normalised error squared averages p = 2."""
    generator = torch.Generator().manual_seed(3)
    robots, dt = 100, 0.05
    noises = {"position_noise": 0.01, "motion_noise": 0.005, "process_noise": 0.0}
    ukf = ParameterUkf(GoalTask(1.0), BARRIERS, torch.zeros(robots, 2), 3.0, **noises)
    goals = 3.0 * torch.randn(robots, 2, generator=generator, dtype=torch.float64)
    x = torch.zeros(robots, 2).double()
    far_away = torch.full((robots, 1, 2), 90.0).double(), torch.ones(robots, 1, dtype=torch.bool)
    for k in range(6):
        z = x + 0.01 * torch.randn(robots, 2, generator=generator, dtype=torch.float64)
        estimate = ukf.update(Measurement(k * dt, z, goals - z, *far_away))
        walk = 0.005 * math.sqrt(dt) * torch.randn(robots, 2, generator=generator, dtype=torch.float64)
        x = x + dt * (goals - z) + walk
    error = (estimate.theta - goals).unsqueeze(-1)
    squared = (error.mT @ torch.linalg.inv(estimate.covariance) @ error).flatten()
    assert 1.5 < squared.mean() < 2.5


def test_unknown_gain() -> None:
    """Three parameters, bilinear in the goal and the gain: (k, k x_d)."""
    truth = torch.tensor([[0.8, 1.6, -0.8]], dtype=torch.float64)
    task = UnknownGainGoalTask()
    run = simulate(CbfQpController(task, [SpeedBox((9.0, 9.0))]), truth, torch.tensor([[-1.0, 0.5]]), dt=0.05, steps=80)
    ukf = ParameterUkf.from_prior(task, [SpeedBox((9.0, 9.0))], *box(1, 4.0, p=3))
    for measurement in run.measurements():
        estimate = ukf.update(measurement)
    torch.testing.assert_close(estimate.theta, truth, atol=1e-2, rtol=0)


# The QP inside ------------------------------------------------------------------------------------------------------


def test_qp_inside_learns_through_changes_of_the_active_set(two_pairs: Trajectory) -> None:
    """Before the robot is free, when the other mode has learned nothing (see above), and after."""
    assert len(two_pairs.active.unique(dim=0)) > 2
    ukf = ParameterUkf.from_prior(TASK, BARRIERS, *box(1), qp_inside=True)
    estimates = [ukf.update(two_pairs.measurement(k)) for k in range(53)]
    assert all(estimate.status.item() == Status.OK for estimate in estimates[1:])
    assert (estimates[20].theta - GOAL).norm() < 0.5 * GOAL.norm()
    assert estimates[20].covariance[0].diagonal().amin() < 0.5 * 12
    assert (estimates[-1].theta - GOAL).norm() < 0.05


def test_a_solver_that_fails_leaves_the_motion_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    ukf = free_ukf(qp_inside=True)
    first, second, third = free_run(3)
    before = ukf.update(first)

    def fails(*_: object) -> None:
        raise SolverError("no solution, no certificate")

    with monkeypatch.context() as patch:
        patch.setattr("torchfsid.observers.motions.solve_safe_qp", fails)
        estimate = ukf.update(second)
    assert estimate.status.item() == Status.PREDICTED
    torch.testing.assert_close(estimate.theta, before.theta, atol=0, rtol=0)
    assert ukf.update(third).status.item() == Status.OK


# Interface ----------------------------------------------------------------------------------------------------------


def test_batch_equals_loop(team: Trajectory) -> None:
    robots = [0, 1, 2, 3]
    together = ParameterUkf.from_prior(TEAM_TASK, TEAM_BARRIERS, *box(4))
    alone = [ParameterUkf.from_prior(TEAM_TASK, TEAM_BARRIERS, *box(1)) for _ in robots]
    for k in range(0, 50, 3):
        measurement = team.measurement(k)
        estimate = together.update(measurement)
        for i in robots:
            u = None if measurement.u is None else measurement.u[[i]]
            of_one = Measurement(
                measurement.t, measurement.x[[i]], u, measurement.bodies[[i]], measurement.present[[i]]
            )
            torch.testing.assert_close(alone[i].update(of_one).theta[0], estimate.theta[i], atol=1e-10, rtol=0)


@pytest.mark.parametrize("qp_inside", [False, True])
def test_a_pickled_observer_goes_on(team: Trajectory, qp_inside: bool) -> None:
    ukf = ParameterUkf.from_prior(TEAM_TASK, TEAM_BARRIERS, *box(4), qp_inside=qp_inside)
    for k in range(5):
        ukf.update(team.measurement(k))
    copy = pickle.loads(pickle.dumps(ukf))
    for k in range(5, 10):
        mine, theirs = ukf.update(team.measurement(k)), copy.update(team.measurement(k))
        torch.testing.assert_close(mine.theta, theirs.theta, atol=0, rtol=0)
        torch.testing.assert_close(mine.covariance, theirs.covariance, atol=0, rtol=0)


def test_estimates_do_not_change_afterwards() -> None:
    ukf = free_ukf()
    run = free_run(10)
    first = [ukf.update(next(run)) for _ in range(3)][-1]
    theta, covariance = first.theta.clone(), first.covariance.clone()
    for measurement in run:
        ukf.update(measurement)
    ukf.correct(torch.ones(1, 2))
    torch.testing.assert_close(first.theta, theta, atol=0, rtol=0)
    torch.testing.assert_close(first.covariance, covariance, atol=0, rtol=0)


def test_prior_of_a_box() -> None:
    lower, upper = torch.tensor([[-1.0, 2.0]]), torch.tensor([[3.0, 2.6]])
    ukf = ParameterUkf.from_prior(TASK, BARRIERS, lower, upper)
    first = ukf.update(next(free_run(1)))
    torch.testing.assert_close(first.theta, torch.tensor([[1.0, 2.3]]).double(), atol=1e-6, rtol=0)
    expected = torch.diag(torch.tensor([16.0, 0.36]) / 12).double()
    torch.testing.assert_close(first.covariance[0], expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("spread", [2.0, torch.tensor([2.0, 2.0]), torch.full((1, 2), 2.0)])
def test_spread_of_any_shape(spread: float | Tensor) -> None:
    first = ParameterUkf(TASK, BARRIERS, torch.zeros(1, 2), spread).update(next(free_run(1)))
    torch.testing.assert_close(first.covariance[0], 4 * torch.eye(2).double())


def test_correct_moves_the_position_along() -> None:
    """The corrected state is the one with this theta that is nearest in the metric of the whole covariance."""
    ukf = free_ukf()
    run = free_run(20)
    for _ in range(4):
        ukf.update(next(run))
    kalman = ukf.filters[0]
    assert kalman is not None
    before, P = kalman.x.copy(), kalman.P.copy()
    theta = torch.tensor([[1.0, 1.0]]).double()
    ukf.correct(theta)
    np.testing.assert_allclose(kalman.x[2:], theta[0], atol=0)
    np.testing.assert_allclose(kalman.P, P, atol=0)
    # Optimal: the information matrix times the change pushes on theta alone.
    push = np.linalg.solve(P, kalman.x - before)
    np.testing.assert_allclose(push[:2], 0.0, atol=1e-9 * np.abs(push[2:]).max())


def test_correct_before_anything_is_seen() -> None:
    ukf = free_ukf()
    theta = torch.tensor([[1.0, 1.5]]).double()
    ukf.correct(theta)
    torch.testing.assert_close(ukf.update(next(free_run(1))).theta, theta)


def test_time_has_to_increase() -> None:
    ukf = free_ukf()
    first, second = free_run(2)
    ukf.update(second)
    for late in (first, second, replace(second, t=math.nan), replace(second, t=math.inf)):
        with pytest.raises(InputError, match=r"measurement\.t"):
            ukf.update(late)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"mean": torch.zeros(1, 3)}, "mean"),
        ({"mean": torch.full((1, 2), math.nan)}, "mean"),
        ({"spread": 0.0}, "spread"),
        ({"spread": torch.ones(5, 2)}, "spread"),
        ({"position_noise": 0.0}, "noises"),
        ({"process_noise": -1.0}, "noises"),
        ({"motion_noise": math.nan}, "noises"),
        ({"active_tolerance": 0.0}, "noises"),
    ],
)
def test_wrong_settings_are_named(change: dict[str, object], name: str) -> None:
    settings: dict = {"mean": torch.zeros(1, 2), "spread": 1.0} | change
    with pytest.raises(InputError, match=name):
        ParameterUkf(TASK, BARRIERS, **settings)


def test_wrong_measurements_are_named(team: Trajectory) -> None:
    ukf = free_ukf()
    with pytest.raises(InputError, match="measurement"):
        ukf.update(replace(next(free_run(1)), u=None))
    with pytest.raises(InputError, match="measurement"):
        ukf.update(team.measurement(0))
    for theta in (torch.zeros(2, 2), torch.full((1, 2), math.nan)):
        with pytest.raises(InputError, match="theta"):
            ukf.correct(theta)


@pytest.mark.parametrize("qp_inside", [False, True])
def test_single_precision_and_no_bodies(qp_inside: bool) -> None:
    ukf, goal, x = free_ukf(qp_inside=qp_inside), torch.tensor([[2.0, -1.0]]), torch.zeros(1, 2)
    for k in range(20):
        nobody = torch.zeros(1, 0, 2)
        estimate = ukf.update(Measurement(0.05 * k, x, goal - x, nobody, nobody.bool().all(-1)))
        x = x + 0.05 * (goal - x)
    torch.testing.assert_close(estimate.theta, goal.double(), atol=1e-3, rtol=0)


def test_no_gradient_leaks(two_pairs: Trajectory) -> None:
    measurement = two_pairs.measurement(0)
    ukf = ParameterUkf(VelocityTask(), BARRIERS, torch.zeros(1, 2, requires_grad=True), 1.0)
    estimate = ukf.update(replace(measurement, x=measurement.x.clone().requires_grad_()))
    assert not estimate.theta.requires_grad
