"""Samples that break the model: sets that may leave q of them unexplained hold the truth, and say which they are."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from torchfsid.errors import InconsistentError, InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.observers.hybrid import HybridObserver
from torchfsid.observers.outliers import Levels, narrowed
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.observers.ukf import ParameterUkf
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.around import moved_around, reach
from torchfsid.sets.feasible_set import FeasibleSet

TASK, AVOIDANCE = GoalTask(0.9), CollisionAvoidance(ClassK(1.5), safety_distance=0.4)
BOUND, ROBOTS, SAMPLES = 5e-3, 4, 50


def box(batch: int, p: int = 2, facets: int = 200) -> FeasibleSet:
    return FeasibleSet.from_box(torch.full((batch, p), -5.0), torch.full((batch, p), 5.0), facets)


def random_omegas(rng: np.random.Generator, samples: int, batch: int, p: int) -> list[Halfspaces]:
    """Three half-spaces around the origin per sample, with outliers among them, some of which are empty."""
    found = []
    for _ in range(samples):
        A, b = rng.normal(size=(batch, 3, p)), rng.uniform(0.1, 2.0, (batch, 3))
        wrong = rng.uniform(size=batch) < 0.25
        b -= np.where(wrong, rng.uniform(0.5, 4.0, batch), 0.0)[:, None] * np.linalg.norm(A, axis=-1)
        empty = wrong & (rng.uniform(size=batch) < 0.3)
        A[empty], b[empty] = 0.0, -1.0
        found.append(Halfspaces(torch.from_numpy(A), torch.from_numpy(b)))
    return found


def all_levels(omegas: list[Halfspaces], prior: FeasibleSet, q: int) -> list[Levels]:
    levels, history = (prior,) * (q + 1), []
    for t, omega in enumerate(omegas):
        levels, _ = narrowed(levels, omega, float(t))
        history.append(levels)
    return history


@pytest.mark.parametrize(("p", "samples"), [(2, 9), (3, 6)])
def test_levels_hold_every_parameter_that_leaves_so_many_samples_unexplained(p: int, samples: int) -> None:
    """All subsets of the samples are tried. The levels are nested."""
    rng, q, batch = np.random.default_rng(p), 2, 12
    omegas = random_omegas(rng, samples, batch, p)
    levels = all_levels(omegas, box(batch, p), q)[-1]
    emptied = torch.zeros(q + 1)
    for j, level in enumerate(levels):
        emptied[j] = level.is_empty.sum()
        for skipped in itertools.combinations(range(samples), j):
            rest = box(batch, p)
            for t in set(range(samples)) - set(skipped):
                rest = rest.intersect(omegas[t])
            corners = rest.vertices().transpose(0, 1)
            assert (level.contains(corners.nan_to_num()) | rest.is_empty).all()
        if j > 0:
            below = levels[j - 1]
            inside = level.contains(below.vertices().transpose(0, 1).nan_to_num())
            assert (inside | below.is_empty).all()
            assert (level.volume() >= below.volume() * (1 - 1e-9)).all()
    assert 0 < emptied[1] < emptied[0]  # the samples tell the levels apart


def test_a_gross_outlier_costs_nothing_but_a_skip() -> None:
    """The set that may leave one sample out is then the set of the others."""
    omegas = [omega for omega in random_omegas(np.random.default_rng(3), 20, 1, 2) if bool((omega.b > 0).all())]
    plain = all_levels(omegas, box(1), 0)[-1][0]
    far = Halfspaces(torch.tensor([[[-1.0, 0.0]]]), torch.tensor([[-4.9]]))
    *_, (none, one) = all_levels([*omegas, far], box(1), 1)
    assert none.is_empty
    assert torch.equal(one.vertices(), plain.vertices())
    assert one.last_cut.item() == len(omegas)


def test_volumes_never_grow() -> None:
    history = all_levels(random_omegas(np.random.default_rng(4), 30, 20, 2), box(20, facets=32), 2)
    for before, after in itertools.pairwise(history):
        for old, new in zip(before, after, strict=True):
            assert (new.volume() <= old.volume() * (1 + 1e-12)).all()


def test_rows_moved_around_a_set() -> None:
    """Compiled, they are those of torch, and rows of a set that reach nowhere stay."""
    omegas = random_omegas(np.random.default_rng(5), 12, 30, 2)
    sets = all_levels(omegas[:6], box(30), 0)[-1][0]
    assert 0 < sets.is_empty.sum() < 30
    for rows in omegas[6:]:
        moved, support = moved_around(rows, sets), reach(rows, sets)
        assert torch.allclose(moved.b, torch.maximum(rows.b, support), rtol=0, atol=1e-12)
        assert torch.equal(moved.b[sets.is_empty], rows.b[sets.is_empty])
        corners = sets.vertices().nan_to_num()
        assert (rows.A @ corners.mT <= moved.b.unsqueeze(-1) + sets.is_empty[:, None, None] * 1e9).all()


def test_gradients_reach_the_rows_of_all_levels() -> None:
    omegas = random_omegas(np.random.default_rng(8), 5, 1, 2)

    def volumes(*bounds: Tensor) -> Tensor:
        rows = [Halfspaces(omega.A, b) for omega, b in zip(omegas, bounds, strict=True)]
        return torch.stack([level.volume() for level in all_levels(rows, box(1), 2)[-1]])

    bounds = [omega.b.clone().requires_grad_() for omega in omegas]
    assert torch.autograd.gradcheck(volumes, bounds)
    volumes(*bounds).sum().backward()
    assert any(bool((b.grad != 0).any()) for b in bounds[1:] if b.grad is not None)


# Teams --------------------------------------------------------------------------------------------------------------


class Spoilt:
    """Four robots with errors within the bound, and gross errors of 1 to 3 m or m/s in some samples of some robots."""

    def __init__(self, seed: int, outliers: int, samples: int = SAMPLES):
        rng = np.random.default_rng(seed)
        places = rng.permutation(16)[: 2 * ROBOTS]
        spots = torch.from_numpy(np.stack([places % 4, places // 4], -1) * 1.2 + rng.uniform(0, 0.5, (2 * ROBOTS, 2)))
        self.goals = spots[:ROBOTS] - 2.0
        run = simulate(CbfQpController(TASK, [AVOIDANCE]), self.goals, spots[ROBOTS:] - 2.0, dt=0.05, steps=samples - 1)
        turn = torch.from_numpy(rng.uniform(0, 2 * np.pi, run.u.shape[:2]))
        self.t, self.x = run.t.tolist(), run.x.clone()
        self.u = run.u + BOUND * torch.stack([turn.cos(), turn.sin()], -1)
        self.spoilt = set()
        for k in rng.permutation(samples)[:outliers].tolist():
            robot, angle, size = int(rng.integers(ROBOTS)), rng.uniform(0, 2 * np.pi), rng.uniform(1, 3)
            (self.x if rng.integers(2) else self.u)[k, robot] += size * torch.tensor([np.cos(angle), np.sin(angle)])
            self.spoilt.add((robot, self.t[k]))

    def __iter__(self):
        return (Measurement.of_team(*sample) for sample in zip(self.t, self.x, self.u, strict=True))

    def observer(self, outliers: int, robots: int = ROBOTS, **options) -> SetMembershipObserver:
        prior = box(robots, facets=32)
        return SetMembershipObserver(TASK, [AVOIDANCE], prior, noise=NoiseBound(BOUND), outliers=outliers, **options)


@pytest.mark.parametrize("seed", range(4))
def test_gross_outliers_are_named_and_the_truth_is_inside(seed: int) -> None:
    team = Spoilt(seed, outliers=2)
    today, relaxed, clean = team.observer(0), team.observer(2), team.observer(0)
    for measurement in team:
        today.update(measurement)
        estimate = relaxed.update(measurement)
        assert estimate.feasible_set.contains(team.goals).all()
        if not any(t == measurement.t for _, t in team.spoilt):
            clean.update(measurement)
    assert bool((today.status != Status.OK).any())
    assert relaxed.status.tolist() == [Status.OK] * ROBOTS
    assert relaxed.events == []
    aside = relaxed.set_aside()
    assert team.spoilt <= {(sample.robot, sample.t) for sample in aside if sample.is_certain}
    # A wrong position is also wrong for those that see the robot.
    assert {sample.t for sample in aside if sample.is_certain} == {t for _, t in team.spoilt}
    assert (relaxed.feasible_set.volume() >= clean.feasible_set.volume() * (1 - 1e-9)).all()
    assert relaxed.feasible_set.diameter().median() < 2 * BOUND / TASK.gain


def test_without_outliers_a_set_is_the_intersection_of_all_samples() -> None:
    team = Spoilt(11, outliers=0)
    model, sets = ObservationModel(TASK, [AVOIDANCE], noise=NoiseBound(BOUND)), box(ROBOTS, facets=32)
    watching = team.observer(0)
    for measurement in team:
        sets = sets.intersect(evidence(model, sets, measurement).omega, measurement.time)
        assert torch.equal(watching.update(measurement).feasible_set.vertices(), sets.vertices())
    assert watching.set_aside() == []
    assert watching.unexplained.tolist() == [0] * ROBOTS


def test_batch_is_loop_and_compiled_is_torch() -> None:
    team = Spoilt(2, outliers=2)
    together, in_torch = team.observer(2), team.observer(2, compiled=False)
    alone = [team.observer(2, robots=1) for _ in range(ROBOTS)]
    for measurement in team:
        together.update(measurement)
        in_torch.update(measurement)
        for robot, watching in enumerate(alone):
            watching.update(measurement.select(torch.tensor([robot])))
    volume = together.feasible_set.volume()
    assert torch.allclose(volume, in_torch.feasible_set.volume(), rtol=1e-6)
    assert torch.equal(volume, torch.cat([watching.feasible_set.volume() for watching in alone]))
    assert together.set_aside() == in_torch.set_aside()
    assert together.set_aside() == [
        replace(sample, robot=robot) for robot, watching in enumerate(alone) for sample in watching.set_aside()
    ]


def spoil(measurement: Measurement, robot: int, u: tuple[float, float]) -> Measurement:
    assert measurement.u is not None
    return replace(measurement, u=measurement.u.index_copy(0, torch.tensor([robot]), torch.tensor([u]).double()))


def test_one_outlier_more_than_declared_is_reported_as_ever() -> None:
    team = Spoilt(1, outliers=0)
    watching, strict = team.observer(1), team.observer(1, on_inconsistent="raise")
    for k, sample in enumerate(team):
        measurement = spoil(sample, 0, (0.5, 0.0)) if k in (20, 30) else sample
        estimate = watching.update(measurement)
        assert bool(estimate.informative[0]) == (k not in (20, 30))
        if k < 30:
            assert (watching.status == Status.OK).all()
            strict.update(measurement)
        elif k == 30:
            with pytest.raises(InconsistentError):
                strict.update(measurement)
    assert watching.status.tolist() == [Status.INCONSISTENT] + [Status.OK] * 3
    assert [event.t for event in watching.events] == [team.t[30]]
    assert [(sample.robot, sample.t) for sample in watching.set_aside()] == [(0, team.t[20])]
    assert watching.feasible_set.contains(team.goals).all()


def test_alarms_are_outliers() -> None:
    """Robots that touch, and drive into each other: each has one such sample to spare."""
    team = Spoilt(1, outliers=0, samples=20)
    watching = team.observer(1)
    for k, measurement in enumerate(team):
        if k in (8, 14):
            bodies = measurement.bodies.clone()
            bodies[0, 1] = measurement.x[0] + torch.tensor([0.1, 0.0])
            measurement = spoil(replace(measurement, bodies=bodies), 0, (2.0, 0.0))
            assert evidence(watching.model, watching.feasible_set, measurement).alarmed.tolist() == [True] + 3 * [False]
        watching.update(measurement)
        assert watching.status[0] == (Status.OK if k < 14 else Status.ALARM)
    (aside,) = watching.set_aside()
    assert (aside.t, aside.robot, aside.sources, aside.is_certain) == (team.t[8], 0, (1,), True)
    assert [(event.t, event.status) for event in watching.events] == [(team.t[14], Status.ALARM)]
    assert watching.feasible_set.contains(team.goals).all()


def test_two_samples_that_contradict_each_other() -> None:
    """Nothing says which of the two is wrong, until a third one does."""
    team = Spoilt(1, outliers=0)
    watching, samples = team.observer(1), iter(team)
    first, second = spoil(next(samples), 0, (-2.0, 1.0)), next(samples)
    watching.update(first)
    watching.update(second)
    of_first = [sample for sample in watching.set_aside() if sample.robot == 0]
    assert [sample.t for sample in of_first] == [first.t, second.t]
    assert not any(sample.is_certain for sample in of_first)
    watching.update(next(samples))
    assert [(sample.t, sample.is_certain) for sample in watching.set_aside()] == [(first.t, True)]


def test_hybrid_projects_onto_the_set() -> None:
    team = Spoilt(3, outliers=2)
    ukf = ParameterUkf(TASK, [AVOIDANCE], torch.zeros(ROBOTS, 2).double(), spread=3.0, active_tolerance=BOUND)
    watching = HybridObserver(team.observer(2), ukf)
    for measurement in team:
        estimate = watching.update(measurement)
        assert estimate.set_estimate.feasible_set.contains(estimate.theta, 1e-6).all()


@pytest.mark.parametrize(
    "options",
    [{"outliers": -1}, {"outliers": 1, "on_inconsistent": "reset"}, {"outliers": 1, "windows": (0.5,)}],
)
def test_refusals(options: dict) -> None:
    with pytest.raises(InputError, match="outliers"):
        SetMembershipObserver(TASK, [AVOIDANCE], box(1), noise=NoiseBound(BOUND), **options)
