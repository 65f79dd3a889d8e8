"""Fleets among their nearest bodies: the right ones are found, and no row left out can have mattered."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.neighbours import left_out_inactive, nearest_bodies
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet

TASK = GoalTask(0.8)


def places(seed: int, bodies: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-3, 3, (bodies, 2)))


@pytest.mark.parametrize(("count", "within"), [(3, math.inf), (3, 1.5), (30, math.inf), (30, 2.0)])
def test_the_nearest_are_found(count: int, within: float) -> None:
    """Against all distances, sorted; two bodies stand in the same place."""
    x = places(0, 20)
    x[7] = x[3]
    u = 2 * x + 1
    measurement = nearest_bodies(0.5, x, u, count=count, within=within, robots=range(15))
    assert measurement.left_out is not None
    assert measurement.body_velocities is not None
    for robot in range(15):
        apart = (x - x[robot]).norm(dim=-1)
        apart[robot] = torch.inf
        expected = apart.sort().values
        shown = measurement.present[robot]
        assert int(shown.sum()) == min(count, int((expected[:-1] <= within).sum()))
        found = (measurement.bodies[robot] - x[robot]).norm(dim=-1)[shown]
        torch.testing.assert_close(found, expected[: len(found)], rtol=0, atol=1e-15)
        next_one = expected[count] if count < 20 else torch.tensor(torch.inf)
        assert measurement.left_out.distance[robot].item() == pytest.approx(min(float(next_one), within), rel=1e-15)
        for body, velocity in zip(
            measurement.bodies[robot][shown], measurement.body_velocities[robot][shown], strict=True
        ):
            assert ((x == body) & (u == velocity)).all(-1).any()
    assert (measurement.left_out.speed == u.norm(dim=-1).max()).all()


def test_wrong_use_is_refused() -> None:
    x = places(1, 4)
    barrier = CollisionAvoidance(ClassK(1.0, power=0.3), safety_distance=0.3)
    with pytest.raises(InputError, match="power"):
        left_out_inactive([barrier], nearest_bodies(0.0, x, x, count=2), torch.tensor(0.1), torch.tensor(0.0))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"count": 0}, "count"),
        ({"count": 2.5}, "count"),
        ({"count": True}, "count"),
        ({"count": "2"}, "count"),
        ({"within": 0.0}, "within"),
        ({"within": math.nan}, "within"),
        ({"robots": [99]}, "robots: .* got 99"),
        ({"robots": [-1]}, "robots: .* got -1"),
        ({"robots": [1.5]}, "robots"),
        ({"u": torch.zeros(3, 2)}, "u"),
        ({"previous_u": torch.zeros(4)}, "previous_u"),
        ({"radius": torch.zeros(3)}, "radius"),
        ({"radius": "large"}, "radius"),
        ({"position_error": torch.zeros(5)}, "position_error"),
        ({"position_error": torch.tensor([0.0, -1.0, 0.0, 0.0])}, "position_error"),
        ({"velocity_error": torch.zeros(4, 2)}, "velocity_error"),
        ({"seen": torch.ones(4)}, "seen"),
        ({"seen": torch.ones(3, dtype=torch.bool)}, "seen"),
        ({"x": torch.tensor([[0.0, 0.0], [1.0, math.nan], [2.0, 0.0], [3.0, 0.0]])}, "x: .* of body 1"),
        ({"x": np.zeros(4)}, "x"),
        ({"x": [["a", "b"]]}, "x"),
    ],
)
def test_wrong_arguments_are_named(wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(InputError, match=f"^{named}"):
        nearest_bodies(**{"t": 0.0, "x": places(1, 4), "count": 2} | wrong)


def test_arrays_are_as_good_as_tensors() -> None:
    x, radius = places(1, 6), torch.rand(6, dtype=torch.float64)
    seen = torch.tensor([True, True, False, True, True, True])
    names = "x", "bodies", "present", "observed", "body_radii", "body_velocities"
    of_tensors = nearest_bodies(0.0, x, 2 * x, count=2, radius=radius, seen=seen)
    of_arrays = nearest_bodies(0.0, x.numpy(), 2 * x.numpy(), count=2, radius=radius.numpy(), seen=seen.numpy())
    for name in names:
        assert torch.equal(getattr(of_tensors, name), getattr(of_arrays, name)), name


def test_bodies_that_were_not_seen_are_no_obstacles() -> None:
    """As in `Measurement.of_team`; their numbers may be anything."""
    x, u, errors = places(2, 12), places(3, 12), 0.1 * torch.rand(12, dtype=torch.float64)
    seen = torch.arange(12) % 3 != 1
    x[~seen], u[~seen] = torch.nan, torch.inf
    few = nearest_bodies(0.0, x, u, count=11, seen=seen, position_error=errors, velocity_error=2 * errors)
    team = Measurement.of_team(0.0, x, u, seen=seen, position_error=errors, velocity_error=2 * errors)
    assert few.observed is not None
    assert torch.equal(few.observed, seen)
    assert few.body_position_error is not None
    assert few.body_velocity_error is not None
    for robot in seen.nonzero().flatten().tolist():
        shown, there = few.present[robot], team.present[robot]
        assert int(shown.sum()) == int(there.sum()) == 7
        mine = torch.cat([few.bodies[robot], few.body_position_error[robot, :, None]], -1)[shown]
        other = torch.cat([team.bodies[robot], errors[:, None]], -1)[there]
        assert torch.equal(mine[mine[:, 0].argsort()], other[other[:, 0].argsort()])
        assert torch.equal(few.body_velocity_error[robot], 2 * few.body_position_error[robot])
    assert torch.equal(few.position_error[seen], errors[seen])  # type: ignore[index]
    nobody = nearest_bodies(0.0, x, u, count=2, seen=torch.zeros(12, dtype=torch.bool))
    assert not nobody.present.any()


@pytest.mark.parametrize("distance", ["squared", "euclidean"])
@pytest.mark.parametrize("neighbour_velocity", ["none", "current"])
def test_errors_bring_bodies_nearer(distance: str, neighbour_velocity: str) -> None:
    """60 random fleets, moved by their errors: where the rule holds, the true rows of bodies without a slot are off."""
    rng, proven, bound = np.random.default_rng(4), 0, 0.05
    for _ in range(60):
        x, u = torch.from_numpy(rng.uniform(-2, 2, (12, 2))), torch.from_numpy(rng.normal(size=(12, 2)) * 0.3)
        errors = torch.from_numpy(rng.uniform(0, 0.15, 12))
        barrier = CollisionAvoidance(
            ClassK(float(rng.uniform(0.3, 3))), 0.3, distance=distance, neighbour_velocity=neighbour_velocity
        )
        few = nearest_bodies(0.0, x, u, count=3, position_error=errors, velocity_error=errors)
        sure = left_out_inactive([barrier], few, bound + errors, errors)
        moved = x + errors.unsqueeze(-1) * torch.from_numpy(_directions(rng, 12))
        truth = Measurement.of_team(0.0, moved, u + errors.unsqueeze(-1) * torch.from_numpy(_directions(rng, 12)))
        assert few.left_out is not None
        has_slot = torch.zeros(12, 12, dtype=torch.bool)
        for i in range(12):
            has_slot[i] = (x.unsqueeze(0) == few.bodies[i].unsqueeze(1)).all(-1).any(0)
        slack = barrier(truth).slack(truth.u).masked_fill(has_slot | ~truth.present, torch.inf)  # type: ignore[arg-type]
        assert (slack[sure] > bound).all()
        proven += int(sure.sum())
    assert 20 < proven < 700


def _directions(rng: np.random.Generator, count: int) -> np.ndarray:
    angle = rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


@pytest.mark.parametrize("distance", ["squared", "euclidean"])
@pytest.mark.parametrize("neighbour_velocity", ["none", "current", "previous"])
@pytest.mark.parametrize("sizes", ["one distance", "margin"])
def test_rows_left_out_are_inactive(distance: str, neighbour_velocity: str, sizes: str) -> None:
    """60 random fleets: where the rule holds, every body without a slot has a row with more slack than the bound."""
    rng, proven, bound = np.random.default_rng(2), 0, 0.05
    for _ in range(60):
        x, u = torch.from_numpy(rng.uniform(-2, 2, (12, 2))), torch.from_numpy(rng.normal(size=(12, 2)) * 0.3)
        radius = torch.from_numpy(rng.uniform(0.05, 0.2, 12))
        size = {"margin": 0.1} if sizes == "margin" else {"safety_distance": 0.3}
        class_k = ClassK(float(rng.uniform(0.3, 3)), float(rng.choice([0.5, 1.0, 3.0])))
        barrier = CollisionAvoidance(class_k, distance=distance, neighbour_velocity=neighbour_velocity, **size)  # type: ignore[arg-type]
        among_few = nearest_bodies(0.0, x, u, count=3, within=2.5, previous_u=-u, radius=radius)
        sure = left_out_inactive([barrier], among_few, torch.tensor(bound), torch.tensor(0.0))
        among_all = Measurement.of_team(0.0, x, u, previous_u=-u, radius=radius)
        assert among_few.left_out is not None
        apart = (among_all.bodies - among_all.x.unsqueeze(1)).norm(dim=-1)
        has_slot = apart < among_few.left_out.distance.unsqueeze(-1)
        slack = barrier(among_all).slack(u).masked_fill(has_slot | ~among_all.present, torch.inf)
        assert (slack[sure] > bound).all()
        proven += int(sure.sum())
    assert 20 < proven < 700


@pytest.fixture(scope="module")
def crowd() -> Trajectory:
    """Twelve robots cross a square past each other."""
    start = places(3, 12)
    controller = CbfQpController(TASK, [CollisionAvoidance(ClassK(1.0), safety_distance=0.4)])
    return simulate(controller, -start, start, dt=0.05, steps=40)


@pytest.mark.parametrize(("count", "within"), [(2, math.inf), (4, math.inf), (11, 1.0)])
def test_the_truth_is_kept_with_few_slots(crowd: Trajectory, count: int, within: float) -> None:
    """Every sample that is used gives the set that all bodies would have given; the others are counted."""
    barriers = [CollisionAvoidance(ClassK(1.0), safety_distance=0.4)]
    corner = torch.full((12, 2), 6.0, dtype=torch.float64)
    few, everybody = (
        SetMembershipObserver(TASK, barriers, FeasibleSet.from_box(-corner, corner), noise=NoiseBound(1e-6))
        for _ in range(2)
    )
    goals, left_out = -crowd.x[0], 0
    for k in range(40):
        measurement = nearest_bodies(float(crowd.t[k]), crowd.x[k], crowd.u[k], count=count, within=within)
        estimate, reference = few.update(measurement), everybody.update(crowd.measurement(k))
        assert estimate.feasible_set.contains(goals).all()
        left_out += int((~estimate.informative).sum())
        always = few.skipped == 0
        torch.testing.assert_close(
            estimate.feasible_set.volume()[always], reference.feasible_set.volume()[always], rtol=1e-6, atol=1e-15
        )
    assert 0 < left_out < 40 * 12
    assert int(few.skipped.sum()) == left_out
