"""Whatever data may bring, the filter answers with a status, and the set beside it goes on."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.filters import BARRIERS, TASK, TEAM_BARRIERS, TEAM_TASK, box, free_run, free_ukf, lost, team_run
from torchfsid.observers.hybrid import HybridObserver
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.observers.ukf import ParameterUkf
from torchfsid.outcome import Status
from torchfsid.robots.barriers import SpeedBox
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Trajectory
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet


@pytest.fixture(scope="module")
def team() -> Trajectory:
    return team_run()


def test_a_lost_measurement_says_nothing(team: Trajectory) -> None:
    """Theta's mean stays and its covariance drifts, at the loss and at the next position, whose past is unknown."""
    ukf = ParameterUkf.from_prior(TEAM_TASK, TEAM_BARRIERS, *box(4), process_noise=0.1)
    for k in range(10):
        before = ukf.update(team.measurement(k))
    missed = ukf.update(lost(team.measurement(10), [1]))
    again = ukf.update(team.measurement(11))
    resumed = ukf.update(team.measurement(12))
    assert missed.status.tolist() == again.status.tolist() == [0, Status.PREDICTED, 0, 0]
    assert resumed.status.tolist() == [0, 0, 0, 0]
    for steps, estimate in enumerate((missed, again), start=1):
        torch.testing.assert_close(estimate.theta[1], before.theta[1], atol=0, rtol=0)
        expected = before.covariance[1] + steps * 0.05 * 0.1**2 * torch.eye(2).double()
        torch.testing.assert_close(estimate.covariance[1], expected, atol=1e-12, rtol=1e-12)


def test_learns_between_losses() -> None:
    ukf = free_ukf()
    for k, measurement in enumerate(free_run(60)):
        estimate = ukf.update(lost(measurement, [0]) if k % 3 == 0 else measurement)
        assert estimate.status.item() == (Status.OK if k % 3 == 2 else Status.PREDICTED)
    torch.testing.assert_close(estimate.theta, torch.tensor([[2.0, -1.0]]).double(), atol=1e-3, rtol=0)


def test_a_robot_that_appears_late() -> None:
    ukf = free_ukf(process_noise=0.5)
    estimates = [ukf.update(lost(m, [0]) if k < 5 else m) for k, m in enumerate(free_run(30))]
    statuses = [estimate.status.item() for estimate in estimates]
    assert statuses == [Status.PREDICTED] * 6 + [Status.OK] * 24
    torch.testing.assert_close(estimates[4].covariance[0], (12 + 0.5**2 * 0.08) * torch.eye(2).double())
    assert (estimates[-1].theta - torch.tensor([[2.0, -1.0]])).norm() < 0.2


def unreadable(kind: str, measurement: Measurement) -> Measurement:
    assert measurement.u is not None
    zero = torch.zeros_like(measurement.bodies)
    if kind == "neighbour's velocity unknown":
        return replace(measurement, previous_body_velocities=zero.fill_(math.nan))
    measurement = replace(measurement, previous_body_velocities=zero)
    near = measurement.x.unsqueeze(1) + torch.tensor([0.3, 0.0])
    if kind == "row violated":
        return replace(measurement, bodies=near)
    if kind == "controller failed":
        return replace(measurement, bodies=near, u=torch.zeros_like(measurement.u))
    if kind == "velocity not finite":
        return replace(measurement, u=measurement.u * math.nan)
    return measurement


@pytest.mark.parametrize("qp_inside", [False, True])
@pytest.mark.parametrize(
    "kind", ["neighbour's velocity unknown", "row violated", "controller failed", "velocity not finite"]
)
def test_an_unreadable_motion_says_nothing(kind: str, qp_inside: bool) -> None:
    """The position itself counts still; it is the next one whose motion is not known."""
    barriers = [replace(BARRIERS[0], neighbour_velocity="previous")]
    ukf = ParameterUkf.from_prior(GoalTask(1.0), barriers, *box(1), qp_inside=qp_inside)
    estimates = [
        ukf.update(unreadable(kind if k == 3 else "none", measurement)) for k, measurement in enumerate(free_run(8))
    ]
    statuses = [estimate.status.item() for estimate in estimates]
    assert Status.names(statuses) == ["predicted", "ok", "ok", "ok", "predicted", "ok", "ok", "ok"]
    torch.testing.assert_close(estimates[4].theta, estimates[3].theta, atol=0, rtol=0)


@pytest.mark.parametrize("broken", [-np.eye(4), np.diag([1.0, 1.0, 1.0, -1e-3]), np.ones((4, 4)), np.zeros((4, 4))])
def test_a_covariance_that_is_not_definite_is_repaired(broken: np.ndarray) -> None:
    ukf = free_ukf()
    run = free_run(60)
    for _ in range(3):
        ukf.update(next(run))
    kalman = ukf.filters[0]
    assert kalman is not None
    kalman.P = broken
    estimate = ukf.update(next(run))
    assert estimate.status.item() == Status.REPAIRED
    torch.linalg.cholesky(estimate.covariance)
    assert ukf.update(next(run)).status.item() == Status.OK


def test_a_covariance_lost_to_round_off_is_repaired() -> None:
    """A position noise of 1e-9 m against a prior of 1e6 m: the first update cancels all digits of the covariance."""
    ukf = ParameterUkf(GoalTask(1.0), BARRIERS, torch.zeros(1, 2), 1e6, position_noise=1e-9, motion_noise=0.0)
    estimates = [ukf.update(measurement) for measurement in free_run(20)]
    assert any(estimate.status.item() == Status.REPAIRED for estimate in estimates)
    for estimate in estimates:
        torch.linalg.cholesky(estimate.covariance)
    assert (estimates[-1].theta - torch.tensor([[2.0, -1.0]])).norm() < 1e-3


@pytest.mark.parametrize("qp_inside", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_no_data_make_it_raise(qp_inside: bool, seed: int) -> None:
    """Garbage in positions and velocities: the estimates stay finite and their covariances definite."""
    rng = np.random.default_rng([seed, 7])
    barriers = [*BARRIERS, replace(BARRIERS[0], distance="euclidean"), SpeedBox((5.0, 5.0))]
    ukf = ParameterUkf.from_prior(TASK, barriers, *box(3), qp_inside=qp_inside, process_noise=0.0)
    garbage = np.array([0.0, math.nan, math.inf, -math.inf, 1e300, 1e160, -1e99, 1e30, 1e-300])

    def drawn(*shape: int) -> Tensor:
        values = np.where(rng.random(shape) < 0.08, rng.choice(garbage, shape), rng.normal(size=shape))
        return torch.from_numpy(values)

    t = 0.0
    for _ in range(40):
        t += rng.choice([1e-9, 0.02, 3.0, 1e6])
        present = torch.from_numpy(rng.random((3, 4)) < 0.8)
        observed = torch.from_numpy(rng.random(3) < 0.8)
        estimate = ukf.update(Measurement(t, drawn(3, 2), drawn(3, 2), drawn(3, 4, 2), present, observed=observed))
        assert bool(estimate.theta.isfinite().all())
        torch.linalg.cholesky(estimate.covariance)


# A filter that fails ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.parametrize(
    ("half", "dt", "spread"),
    [(half, 0.05, None) for half in (1e7, 1e8, 1e9, 1e100, 1e300)]
    + [(6.0, dt, spread) for dt in (0.05, 5e7, 1e12) for spread in (None, 1e12)],
)
def test_a_filter_out_of_proportion_does_not_end_anything(
    half: float, dt: float, spread: float | None, feedback: bool
) -> None:
    """Priors and time steps that leave no digits to a covariance: the set is as it is alone, the filter says what it is
    worth, and the hybrid stays inside the set."""
    lower, upper = box(1, half)
    alone, beside = (
        SetMembershipObserver(GoalTask(1.0), BARRIERS, FeasibleSet.from_box(lower, upper), noise=NoiseBound(1e-3))
        for _ in range(2)
    )
    ukf = (
        ParameterUkf.from_prior(GoalTask(1.0), BARRIERS, lower, upper)
        if spread is None
        else ParameterUkf(GoalTask(1.0), BARRIERS, torch.zeros(1, 2), spread)
    )
    hybrid = HybridObserver(beside, ukf, feedback)
    for k, measurement in enumerate(free_run(15)):
        late = replace(measurement, t=k * dt)
        estimate, expected = hybrid.update(late), alone.update(late)
        assert torch.equal(estimate.set_estimate.feasible_set.vertices(), expected.feasible_set.vertices())
        assert estimate.set_estimate.feasible_set.contains(torch.tensor([[2.0, -1.0]])).all()
        assert bool(estimate.ukf_estimate.theta.isfinite().all())
        assert bool(estimate.theta.isfinite().all())
        assert estimate.set_estimate.feasible_set.contains(estimate.theta).all()
    assert beside.status.tolist() == [Status.OK]


def test_a_filter_that_failed_starts_again_from_its_prior(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of two robots fails: it forgets everything but its prior, learns again, and the other does not notice."""
    lower, upper = box(2)
    ukf, undisturbed = (ParameterUkf.from_prior(GoalTask(1.0), BARRIERS, lower, upper) for _ in range(2))
    goals = torch.tensor([[2.0, -1.0], [1.0, 1.0]], dtype=torch.float64)
    for k, measurement in enumerate(free_run(30, goal=goals)):
        expected = undisturbed.update(measurement)
        if k == 6:
            kalman = ukf.filters[0]
            assert kalman is not None
            kalman.P = np.full((4, 4), np.nan)
        estimate = ukf.update(measurement)
        torch.testing.assert_close(estimate.theta[1], expected.theta[1], rtol=0, atol=0)
        if k == 6:
            assert estimate.status.tolist() == [Status.FAILED, Status.OK]
            assert estimate.theta[0].tolist() == [0.0, 0.0]
            torch.testing.assert_close(estimate.covariance[0], 12 * torch.eye(2, dtype=torch.float64))
    assert estimate.status.tolist() == [Status.OK] * 2
    assert (estimate.theta - goals).abs().max() < 1e-3


@pytest.mark.parametrize(
    ("covariance", "expected"),
    [
        (torch.eye(2), Status.OK),
        (torch.full((2, 2), math.nan), Status.EUCLIDEAN),
        (torch.full((2, 2), math.inf), Status.EUCLIDEAN),
        (-torch.eye(2), Status.EUCLIDEAN),
        (torch.zeros(2, 2), Status.EUCLIDEAN),
        (torch.diag(torch.tensor([1.0, -1.0])), Status.EUCLIDEAN),
    ],
)
def test_a_broken_covariance_is_no_metric(covariance: Tensor, expected: Status) -> None:
    """The nearest point of the box in the Euclidean norm; another robot's covariance is as good as it was."""
    prior = FeasibleSet.from_box(*box(2, 1.0))
    observer = SetMembershipObserver(GoalTask(1.0), BARRIERS, prior, noise=NoiseBound(1e-3))
    ukf = ParameterUkf(GoalTask(1.0), BARRIERS, torch.tensor([[3.0, 0.25], [0.5, -4.0]]), 1.0)
    ukf._covariance[0] = covariance.numpy()
    unseen = replace(next(free_run(1)).select(torch.tensor([0, 0])), observed=torch.zeros(2, dtype=torch.bool))
    estimate = HybridObserver(observer, ukf).update(unseen)
    assert estimate.status.tolist() == [expected, Status.OK]
    torch.testing.assert_close(estimate.theta, torch.tensor([[1.0, 0.25], [0.5, -1.0]]).double(), rtol=0, atol=1e-7)


def test_an_estimate_that_is_no_number_gives_way_to_the_centroid() -> None:
    prior = FeasibleSet.from_box(torch.tensor([[0.0, 1.0]]), torch.tensor([[1.0, 4.0]]))
    observer = SetMembershipObserver(GoalTask(1.0), BARRIERS, prior, noise=NoiseBound(1e-3))
    ukf = ParameterUkf(GoalTask(1.0), BARRIERS, torch.zeros(1, 2), 1.0)
    ukf._theta[0] = math.nan
    unseen = replace(next(free_run(1)), observed=torch.zeros(1, dtype=torch.bool))
    estimate = HybridObserver(observer, ukf, feedback=True).update(unseen)
    assert estimate.status.tolist() == [Status.CENTROID]
    torch.testing.assert_close(estimate.theta, torch.tensor([[0.5, 2.5]]).double())
