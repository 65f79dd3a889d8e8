"""Rows that only touch: they are moved outward by round-off and applied, so that flat sets are flat in every order.

Points and segments of exact data: nothing is lost, a smaller bound never gives a larger set, every question has an
answer.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import SpeedBox
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet

ANGLES = torch.arange(16, dtype=torch.float64) * math.pi / 8
DIRECTIONS = torch.stack([ANGLES.cos(), ANGLES.sin()], dim=-1)


def box(count: int, offset: float = 0.0, half: float = 5.0, **options: int) -> FeasibleSet:
    centre = torch.full((count, 2), offset, dtype=torch.float64)
    return FeasibleSet.from_box(centre - half, centre + half, **options)


def supports(sets: FeasibleSet) -> Tensor:
    return torch.stack([sets.support(way.expand(*sets.batch_shape, 2)) for way in DIRECTIONS], dim=-1)


@pytest.mark.parametrize("flipped", [False, True])
def test_two_opposite_rows_leave_a_segment(flipped: bool) -> None:
    A, b = torch.tensor([[1.0, 0.0], [-1.0, 0.0]], dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    if flipped:
        A = A.flip(0)
    segment = box(1).intersect(Halfspaces(A, b), time=1.0)
    assert segment.outcome.tolist() == [Status.UNDECIDED]
    assert segment.last_cut.tolist() == [1.0]
    assert 0 <= segment.volume().item() < 1e-12
    assert segment.diameter().item() == pytest.approx(10.0)
    assert segment.centroid()[0].tolist() == pytest.approx([0.0, 0.0], abs=1e-13)
    assert 0 <= segment.chebyshev()[1].item() < 1e-13
    assert segment.support(torch.tensor([[0.6, 0.8]])).item() == pytest.approx(4.0)
    assert segment.project(torch.tensor([[3.0, 2.0]]))[0].tolist() == pytest.approx([0.0, 2.0], abs=1e-13)
    for point, expected in (([0.0, 3.0], True), ([0.0, -5.0], True), ([-3.0, 0.0], False), ([3.0, 0.0], False)):
        assert segment.contains(torch.tensor([point], dtype=torch.float64)).item() is expected


def scattered(kind: str, count: int, rows: int, offset: float, rng: np.random.Generator) -> tuple:
    """Points, and rows of all scales through them; for segments two face each other, and the rest hold clearly."""
    angle = rng.uniform(0, 2 * np.pi, (count, rows))
    A = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * 10 ** rng.uniform(-2, 2, (count, rows, 1))
    point = rng.uniform(-4, 4, (count, 2)) + offset
    if kind == "segments":
        A[:, 1] = -A[:, 0] * 10 ** rng.uniform(-1, 1, (count, 1))
    if kind == "integers":
        A, point = rng.integers(-4, 5, (count, rows, 2)) + 0.0, rng.integers(-32, 33, (count, 2)) / 8 + offset
        A[(A == 0).all(-1)] = (1.0, 2.0)
    b = (A * point[:, None]).sum(-1)
    if kind == "segments":
        b[:, 2:] += np.linalg.norm(A[:, 2:], axis=-1) * rng.uniform(0.5, 2, (count, rows - 2))
    return point, A, b


@pytest.mark.parametrize("kind", ["points", "segments", "integers"])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_order_does_not_matter_and_every_answer_is_inside(kind: str, offset: float) -> None:
    """Corners as sharp as 1e-3 rad make a thousand times the round-off of coordinates of this size."""
    rng, count, rows = np.random.default_rng(0), 200, 8
    point, A, b = scattered(kind, count, rows, offset, rng)
    order, scale = rng.permuted(np.tile(np.arange(rows), (count, 1)), axis=1), 10 ** rng.uniform(-2, 2, (count, rows))
    items, prior = np.arange(count)[:, None], box(count, offset)
    shuffled = (A[items, order] * scale[..., None], b[items, order] * scale)
    at_once, mixed = (prior.intersect(Halfspaces(*map(torch.from_numpy, rows))) for rows in ((A, b), shuffled))
    one_by_one = prior
    for r in range(rows):
        one_by_one = one_by_one.intersect(Halfspaces(torch.from_numpy(A[:, [r]]), torch.from_numpy(b[:, [r]])))
    truth, noise = torch.from_numpy(point), 1e-12 * (10 + offset)
    for sets in (at_once, mixed, one_by_one):
        assert not sets.any_empty
        assert sets.contains(truth).all()
        centre, radius = sets.chebyshev()
        assert (radius >= 0).all()
        for answer in (centre, sets.centroid(), sets.project(truth + 1.0), sets.vertices()[:, 0]):
            assert sets.contains(answer).all()
        torch.testing.assert_close(supports(sets), supports(at_once), rtol=0, atol=noise)
    again = at_once.intersect(Halfspaces(torch.from_numpy(A), torch.from_numpy(b)))
    torch.testing.assert_close(supports(again), supports(at_once), rtol=0, atol=noise)


@pytest.mark.parametrize("kind", ["points", "integers"])
def test_merging_does_not_blow_up_a_flat_set(kind: str) -> None:
    point, A, b = scattered(kind, 300, 8, 0.0, np.random.default_rng(1))
    rows = Halfspaces(torch.from_numpy(A), torch.from_numpy(b))
    free, merged = box(300).intersect(rows), box(300, max_facets=4).intersect(rows)
    assert int(merged.body.count.max()) == 4 < int(free.body.count.max())
    assert (merged.diameter() <= 1.1 * free.diameter() + 1e-13).all()
    assert merged.contains(torch.from_numpy(point)).all()


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_a_smaller_bound_never_gives_a_larger_set(offset: float) -> None:
    """Exact controls among three bodies, bounds from 0 to 1e-6 m/s."""
    rng, count = np.random.default_rng(2), 100
    x, goal = (torch.from_numpy(offset + np.round(rng.uniform(-4, 4, (count, 2)) * 16) / 16) for _ in range(2))
    bodies = x.unsqueeze(1) + 1.2 * torch.from_numpy(rng.normal(size=(count, 3, 2)))
    present = torch.ones(count, 3, dtype=torch.bool)
    task, barriers = GoalTask(1.0), [CollisionAvoidance(ClassK(1.5), safety_distance=0.3)]
    u = CbfQpController(task, barriers)(Measurement(0.0, x, None, bodies, present), goal).u
    smaller = None
    for bound in (0.0, 1e-16, 1e-14, 1e-12, 1e-9, 1e-6):
        watching = SetMembershipObserver(task, barriers, box(count, offset), noise=NoiseBound(bound))
        sets = watching.update(Measurement(0.0, x, u, bodies, present)).feasible_set
        assert sets.contains(goal).all()
        reach = supports(sets)
        assert smaller is None or (smaller - reach).max() < 1e-14 * (10 + offset)
        smaller = reach
    assert (sets.diameter() < 1e-5).sum() > 10


@pytest.mark.parametrize("bound", [0.0, 1e-16, 1e-14, 1e-9])
def test_exact_data_of_a_free_robot_leave_its_goal(bound: float) -> None:
    measurement = Measurement.of_team(0.0, torch.zeros(1, 2).double(), torch.tensor([[1.0, 2.0]]).double())
    watching = SetMembershipObserver(GoalTask(1.0), [SpeedBox((9.0, 9.0))], box(1), noise=NoiseBound(bound))
    estimate = watching.update(measurement)
    assert estimate.feasible_set.volume().item() < 1e-16
    assert estimate.theta[0].tolist() == pytest.approx([1.0, 2.0], abs=1e-9)
    assert estimate.status.item() == 0


def test_what_cannot_be_decided_leaves_a_sliver_that_holds_the_apex() -> None:
    """Two rows 1e-11 rad apart and a third one through their exact apex, which no float can tell from beyond it."""
    A = torch.tensor([[[1e-11, 1.0], [1e-11, -1.0], [-1.0, 0.0]]], dtype=torch.float64)
    b = torch.tensor([[1e-11, 1e-11, -1.0 - 1e-6]], dtype=torch.float64)
    sets = box(1, half=2.0).intersect(Halfspaces(A, b))
    assert sets.outcome.tolist() == [Status.UNDECIDED]
    assert sets.volume().item() < 1e-12
    assert sets.diameter().item() < 1e-3


def test_gradients_of_flat_sets_are_finite() -> None:
    A = torch.tensor([[[1.0, 0.0], [-1.0, 0.0], [0.3, 1.0], [-0.3, -1.0]]] * 2, dtype=torch.float64)
    b = torch.zeros(2, 4, dtype=torch.float64)
    b[1, 2:] = 1.0  # a point and a segment
    A.requires_grad_(), b.requires_grad_()
    sets = box(2).intersect(Halfspaces(A, b))
    away = torch.tensor([[3.0, 1.0], [0.5, 0.2]], dtype=torch.float64, requires_grad=True)
    asked = (
        sets.volume(), sets.centroid(), *sets.chebyshev(), sets.diameter(), sets.support(away), sets.project(away),
        sets.vertices(),
    )  # fmt: skip
    for answer in asked:
        slopes = torch.autograd.grad(answer.sum(), (A, b, away), retain_graph=True, materialize_grads=True)
        assert all(slope.isfinite().all() for slope in slopes)


@pytest.mark.parametrize("far", [1e6, 1e10, 1e160])
def test_the_nearest_point_from_far_away(far: float):
    """Squared distances to the candidates tie, or overflow."""
    square = FeasibleSet.from_box(torch.tensor([-5.0, -5.0]), torch.tensor([5.0, 5.0]))
    point = torch.tensor([far, 3.0], dtype=torch.float64, requires_grad=True)
    nearest = square.project(point)
    torch.testing.assert_close(nearest.detach(), torch.tensor([5.0, 3.0], dtype=torch.float64))
    assert torch.autograd.grad(nearest.sum(), point)[0].tolist() == [0.0, 1.0]
