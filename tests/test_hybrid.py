"""The hybrid observer: the filter's estimate projected onto the set, in the metric of the filter's covariance."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.observers.hybrid import CONDITION, HybridObserver
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.observers.ukf import ParameterUkf, UkfEstimate
from torchfsid.observers.ukf_estimates import UkfEstimates
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import AffineTask, GoalTask
from torchfsid.sets.feasible_set import FeasibleSet

TASK = GoalTask(0.8434)
BARRIERS = [CollisionAvoidance(ClassK(1.5704), safety_distance=0.3515)]
GOALS = torch.tensor([[-1.7208, 0.0952], [0.1176, -1.671], [1.6816, -0.2556], [0.0068, 1.6019]]).double()
STARTS = torch.tensor([[0.6138, -0.5031], [0.1617, 1.0376], [-0.9789, 0.0649], [0.3538, -1.0515]])


@pytest.fixture(scope="module")
def team() -> Trajectory:
    """Four robots in each other's way, most of the time with two rows active."""
    return simulate(CbfQpController(TASK, BARRIERS), GOALS, STARTS, dt=0.05, steps=50)


def hybrid(feedback: bool = False, kind: str = "inverse_optimal", qp_inside: bool = False) -> HybridObserver:
    upper = torch.full((4, 2), 3.0).double()
    sets = SetMembershipObserver(TASK, BARRIERS, FeasibleSet.from_box(-upper, upper), kind, NoiseBound(1e-6))
    return HybridObserver(sets, ParameterUkf(TASK, BARRIERS, GOALS.new_zeros(4, 2), 3.0, qp_inside=qp_inside), feedback)


@dataclass
class Dictated(ParameterUkf):
    """A filter that says what it is told to."""

    says: UkfEstimate = field(kw_only=True)

    def read(self, samples: Measurement) -> UkfEstimates:
        said = self.says
        return UkfEstimates(torch.tensor([said.t]).double(), said.theta[None], said.covariance[None], said.status[None])


def projected(sets: FeasibleSet, theta: Tensor, covariance: Tensor) -> Tensor:
    """What the hybrid observer makes of a filter's estimate, with a measurement that tells the sets nothing."""
    robots, p = theta.shape
    task = GoalTask(1.0) if p == 2 else AffineTask(torch.ones(2, p), torch.zeros(2), tuple("abcdef"[:p]))
    observer = SetMembershipObserver(task, BARRIERS, sets, noise=NoiseBound(1e-3))
    estimate = UkfEstimate(0.0, theta, covariance, torch.zeros(robots).long())
    ukf = Dictated(task, BARRIERS, theta.new_zeros(robots, p), 1.0, says=estimate)
    x, bodies = torch.zeros(robots, 2).double(), torch.zeros(robots, 1, 2).double()
    none = torch.zeros(robots, dtype=torch.bool)
    answer = HybridObserver(observer, ukf).update(Measurement(0.0, x, x, bodies, none.unsqueeze(-1), observed=none))
    assert torch.equal(answer.ukf_estimate.theta, theta)
    return answer.theta


def random_sets(rng: np.random.Generator, robots: int) -> FeasibleSet:
    """Polygons about the origin, some of them thin."""
    upper = torch.full((robots, 2), 2.0).double()
    angles, offsets = torch.from_numpy(rng.uniform(0, 2 * np.pi, (robots, 6))), rng.uniform(1e-3, 1.5, (robots, 6))
    rows = torch.stack([angles.cos(), angles.sin()], dim=-1)
    return FeasibleSet.from_box(-upper, upper).intersect(Halfspaces(rows, torch.from_numpy(offsets)))


def random_covariances(rng: np.random.Generator, robots: int, condition: float, p: int = 2) -> Tensor:
    """Of any size, from 1e-14 to 1e4."""
    axes = np.linalg.qr(rng.normal(size=(robots, p, p)))[0]
    variances = condition ** -rng.uniform(0, 1, (robots, p)) * 10.0 ** rng.uniform(-14, 4, (robots, 1))
    return torch.from_numpy((axes * variances[:, None]) @ axes.swapaxes(1, 2))


def squared(z: Tensor, covariance: Tensor) -> Tensor:
    """z' P^-1 z."""
    return (z * torch.linalg.solve(covariance, z)).sum(-1)


# The projection -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("condition", [1.0, 1e3, 1e6])
def test_the_projection_is_the_nearest_point(condition: float) -> None:
    """Inside, and optimal: no vertex of the set lies on the filter's side of it, in the metric of P^-1."""
    rng = np.random.default_rng(int(condition))
    sets, covariance = random_sets(rng, 200), random_covariances(rng, 200, condition)
    theta = torch.from_numpy(rng.normal(scale=2.0, size=(200, 2)))
    point = projected(sets, theta, covariance)
    assert bool(sets.contains(point).all())
    whiten = torch.linalg.inv(torch.linalg.cholesky(covariance))
    outward = (whiten @ (theta - point).unsqueeze(-1)).squeeze(-1)
    inward = (whiten @ (sets.vertices() - point.unsqueeze(1)).mT).mT
    size = inward.norm(dim=-1).amax(-1) * outward.norm(dim=-1)
    assert bool(((inward * outward.unsqueeze(1)).sum(-1).amax(-1) <= 1e-12 * condition**0.5 * size).all())


def test_an_estimate_inside_is_left_alone() -> None:
    rng = np.random.default_rng(1)
    sets, covariance = random_sets(rng, 100), random_covariances(rng, 100, 1e4)
    vertices = sets.vertices()
    weights = torch.from_numpy(rng.dirichlet(np.ones(vertices.shape[1]), 100))
    inside = 0.999 * (weights.unsqueeze(-1) * vertices).sum(1)
    torch.testing.assert_close(projected(sets, inside, covariance), inside, atol=0, rtol=0)


def test_comes_closer_to_every_point_of_the_set() -> None:
    """In the metric of P^-1, wherever the truth is in the set."""
    rng = np.random.default_rng(2)
    sets, covariance = random_sets(rng, 300), random_covariances(rng, 300, 1e4)
    theta = torch.from_numpy(rng.normal(scale=2.0, size=(300, 2)))
    point = projected(sets, theta, covariance)
    for truth in sets.vertices().unbind(1):
        before, after = squared(theta - truth, covariance), squared(point - truth, covariance)
        assert bool((after <= before * (1 + 1e-9)).all())


def test_the_size_of_the_covariance_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    sets, covariance = random_sets(rng, 50), random_covariances(rng, 50, 1e4)
    theta = torch.from_numpy(rng.normal(scale=2.0, size=(50, 2)))
    expected = projected(sets, theta, covariance)
    for factor in (1e-60, 1e-9, 1e30):
        torch.testing.assert_close(projected(sets, theta, factor * covariance), expected, atol=1e-9, rtol=0)


def test_the_metric_is_the_covariances() -> None:
    """By hand: the filter is sure of the first parameter and not of the second, so the second gives way."""
    sets = FeasibleSet.from_box(torch.zeros(1, 2), torch.ones(1, 2))
    sets = sets.intersect(Halfspaces(torch.tensor([[1.0, 1.0]]), torch.tensor([1.0])))
    sure_of_first = torch.diag(torch.tensor([1e-6, 1.0])).double().unsqueeze(0)
    point = projected(sets, torch.tensor([[0.5, 0.9]]).double(), sure_of_first)
    torch.testing.assert_close(point, torch.tensor([[0.5, 0.5]]).double(), atol=1e-5, rtol=0)


def test_inside_however_bad_the_covariance() -> None:
    rng = np.random.default_rng(4)
    sets = random_sets(rng, 100)
    theta = torch.from_numpy(rng.normal(scale=2.0, size=(100, 2)))
    for condition in (CONDITION, 1e16, 1e30):
        assert bool(sets.contains(projected(sets, theta, random_covariances(rng, 100, condition))).all())


@pytest.mark.parametrize("p", [1, 3])
def test_other_numbers_of_parameters(p: int) -> None:
    """A box and a diagonal metric: every parameter is clamped by itself."""
    rng = np.random.default_rng(p)
    sets = FeasibleSet.from_box(-torch.ones(5, p), torch.ones(5, p))
    theta = torch.from_numpy(rng.normal(scale=2.0, size=(5, p)))
    covariance = torch.diag_embed(torch.from_numpy(10.0 ** rng.uniform(-4, 0, (5, p))))
    torch.testing.assert_close(projected(sets, theta, covariance), theta.clamp(-1, 1), atol=1e-6, rtol=0)


# Over time ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("feedback", "qp_inside"), [(False, False), (True, False), (False, True)])
def test_never_further_from_the_truth_than_the_filter(team: Trajectory, feedback: bool, qp_inside: bool) -> None:
    observer = hybrid(feedback, qp_inside=qp_inside)
    helped = 0
    for measurement in team.measurements():
        estimate = observer.update(measurement)
        sets, ukf = estimate.set_estimate.feasible_set, estimate.ukf_estimate
        assert bool(sets.contains(GOALS).all())
        assert bool(sets.contains(estimate.theta).all())
        before, after = squared(ukf.theta - GOALS, ukf.covariance), squared(estimate.theta - GOALS, ukf.covariance)
        assert bool((after <= before * (1 + 1e-6)).all())
        helped += int((after < 0.99 * before).sum())
    assert helped > 10
    assert bool(((estimate.theta - GOALS).norm(dim=-1) < 0.05).all())


def test_without_feedback_both_observers_run_as_if_alone(team: Trajectory) -> None:
    observer, alone = hybrid(), hybrid()
    for k in range(20):
        measurement = team.measurement(k)
        estimate = observer.update(measurement)
        ukf, sets = alone.ukf.update(measurement), alone.sets.update(measurement)
        torch.testing.assert_close(estimate.ukf_estimate.theta, ukf.theta, atol=0, rtol=0)
        torch.testing.assert_close(estimate.set_estimate.theta, sets.theta, atol=0, rtol=0)


def test_feedback_moves_the_mean_and_keeps_the_covariance(team: Trajectory) -> None:
    """In a linear model the covariances do not depend on the means: both modes have the same ones."""
    without, fed = hybrid(), hybrid(feedback=True)
    moved = 0.0
    for k in range(20):
        measurement = team.measurement(k)
        own, kept = without.update(measurement).ukf_estimate, fed.update(measurement)
        torch.testing.assert_close(kept.ukf_estimate.covariance, own.covariance, rtol=1e-6, atol=1e-9)
        for kalman, theta in zip(fed.ukf.filters, kept.theta, strict=True):
            assert kalman is not None
            np.testing.assert_array_equal(kalman.x[2:], theta)
        moved = max(moved, (kept.ukf_estimate.theta - own.theta).abs().max().item())
    assert moved > 0.1


def test_works_on_the_papers_set(team: Trajectory) -> None:
    observer = hybrid(kind="critical_region")
    for k in range(20):
        estimate = observer.update(team.measurement(k))
        assert bool(estimate.set_estimate.feasible_set.contains(estimate.theta).all())


def test_a_pickled_observer_goes_on(team: Trajectory) -> None:
    observer = hybrid(feedback=True)
    for k in range(5):
        observer.update(team.measurement(k))
    copy = pickle.loads(pickle.dumps(observer))
    for k in range(5, 10):
        mine, theirs = observer.update(team.measurement(k)), copy.update(team.measurement(k))
        torch.testing.assert_close(mine.theta, theirs.theta, atol=0, rtol=0)


def test_the_observers_have_to_match() -> None:
    observer = hybrid()
    other = ParameterUkf(TASK, BARRIERS, torch.zeros(3, 2), 1.0)
    with pytest.raises(InputError, match="ukf"):
        HybridObserver(observer.sets, other)
