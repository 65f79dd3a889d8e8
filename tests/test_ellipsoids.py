"""Ellipsoids and buffered Voronoi cells: the test kit, the formulas, and what a sidestep spoils."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.problems import solve_qp
from torchfsid.errors import InputError
from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.buffered_voronoi import BufferedVoronoi
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.ellipsoid import Ellipsoid
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.second_order import SecondOrderAvoidance
from torchfsid.robots.speed_disc import SpeedDisc
from torchfsid.robots.tasks import GoalTask, VelocityTask
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.testing import check_barrier, random_situations

AXES = (0.3, 0.3, 0.9)
BARRIERS = {
    "squared": Ellipsoid(CollisionAvoidance(ClassK(1.5), 1.0), AXES),
    "euclidean": Ellipsoid(CollisionAvoidance(ClassK(1.5, 2.0), 2.0, distance="euclidean"), AXES),
    "joint": Ellipsoid(CollisionAvoidance(ClassK(1.0), 1.0, neighbour_velocity="current"), AXES),
    "second order": Ellipsoid(SecondOrderAvoidance((1.5, 2.0), 1.0, neighbour_acceleration="current"), AXES),
    "voronoi": BufferedVoronoi(AXES, 1.0, 0.5, sidestep=0.0),
    "sidestep": BufferedVoronoi(AXES, 1.0, 0.5, sidestep=0.1),
}


@pytest.mark.parametrize("name", BARRIERS)
def test_the_kit_finds_nothing(name: str) -> None:
    barrier = BARRIERS[name]

    def h(measurement: Measurement) -> torch.Tensor:
        y = (measurement.x.unsqueeze(-2) - measurement.bodies) / torch.tensor(AXES, dtype=torch.float64)
        r = y.norm(dim=-1)
        return r - 2 if name == "euclidean" else r**2 - 1

    alphas = {"squared": ClassK(1.5), "euclidean": ClassK(1.5, 2.0), "joint": ClassK(1.0)}
    given = {"h": h, "alpha": alphas[name]} if name in alphas else {}
    check_barrier(barrier, random_situations(0, robots=25, n=3), **given)


def test_a_ball_is_an_ellipsoid() -> None:
    seen = random_situations(1, n=3)
    ball = Ellipsoid(CollisionAvoidance(ClassK(1.5, 1.0), 1.0), (0.4,) * 3)(seen).normalised()
    plain = CollisionAvoidance(ClassK(1.5), 0.4)(seen).normalised()
    torch.testing.assert_close(ball.A, plain.A)
    torch.testing.assert_close(ball.b, plain.b)


def one_pair(distance: float, u: tuple[float, float, float]) -> Measurement:
    x = torch.tensor([[0.0, 0.0, 0.0], [distance, 0.0, 0.0]], dtype=torch.float64)
    return Measurement.of_team(0.0, x, torch.tensor([u, (0.0, 0.0, 0.0)], dtype=torch.float64), robots=[0])


def test_the_cell_ends_halfway_less_the_radius() -> None:
    rows = BufferedVoronoi(AXES, 2.0, 0.5)(one_pair(1.4, (0.1, 0.0, 0.0))).normalised()
    torch.testing.assert_close(rows.A[0, 1], torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    assert float(rows.b[0, 1]) == pytest.approx((0.7 - 0.3) / 2)
    assert rows.rows == 2 + 6


@pytest.mark.parametrize(
    ("distance", "u", "sidestep", "informative"),
    [
        (1.4, (0.1, 0.0, 0.0), 0.25, True),
        (1.0, (0.1, 0.0, 0.0), 0.25, False),
        (1.0, (0.1, 0.0, 0.0), 0.0, True),
        (0.55, (-0.1, 0.0, 0.0), 0.0, False),
        (1.4, (0.0, 0.0, 0.0), 0.0, False),
    ],
    ids=["clear", "a wall is near", "no sidestep", "outside of the cell", "stopped"],
)
def test_what_is_no_projection_says_nothing(
    distance: float, u: tuple[float, float, float], sidestep: float, informative: bool
) -> None:
    model = ObservationModel(GoalTask(0.5, 3), [BufferedVoronoi(AXES, 1.0, 0.5, sidestep)], noise=NoiseBound(1e-3))
    corner = torch.full((1, 3), 3.0, dtype=torch.float64)
    for compiled in (False, True):
        found = evidence(model, FeasibleSet.from_box(-corner, corner), one_pair(distance, u), compiled)
        assert bool(found.informative) == informative


@pytest.mark.parametrize("declared", [0.25, 0.0])
def test_the_firmwares_sidestep(declared: float) -> None:
    """Drones that turn their command to the right before a near wall, as the firmware does, and are then projected.

    The truth stays inside where the sidestep is declared. Where it is said to be off, it is lost: the rule matters.
    """
    rng, threshold, horizon, speed = np.random.default_rng(4), 0.25, 1.0, 0.5
    radii, turned, wishes, controls, places = np.array(AXES), 0, [], [], []
    for _ in range(600):
        away = rng.normal(size=(3, 3))
        others = away / np.linalg.norm(away / radii, axis=-1, keepdims=True) * rng.uniform(2.05, 5, (3, 1))
        reach = np.linalg.norm(others / radii, axis=-1)
        A = np.vstack([others / radii**2 / reach[:, None], np.eye(3), -np.eye(3)])
        b = np.concatenate([reach / 2 - 1, np.full(6, horizon * speed)])
        wish = rng.normal(size=3) * rng.uniform(0.05, 0.8)
        goal, ahead = horizon * wish, A @ (horizon * wish)
        wall = np.min(b[ahead > 0] / ahead[ahead > 0]) * np.linalg.norm(goal)
        if wall <= threshold:
            goal, turned = goal + (1 - wall / threshold) ** 2 * np.cross(goal, [0.0, 0.0, 1.0]), turned + 1
        wishes.append(wish)
        controls.append(solve_qp(A, b, goal) / horizon)
        places.append(others)
    wish, u, bodies = (torch.from_numpy(np.stack(of)) for of in (wishes, controls, places))
    seen = Measurement(0.0, torch.zeros_like(u), u, bodies, torch.ones(len(u), 3, dtype=torch.bool))
    corner = torch.full((len(u), 3), 3.0, dtype=torch.float64)
    model = ObservationModel(VelocityTask(3), [BufferedVoronoi(AXES, horizon, speed, declared)], noise=NoiseBound(1e-7))
    found = evidence(model, FeasibleSet.from_box(-corner, corner), seen)
    lost = found.informative & ~found.omega.contains(wish, 1e-6)
    assert turned > 100
    assert int(found.informative.sum()) > 50
    assert bool(lost.any()) == (declared == 0)


def test_controllers_keep_no_ball() -> None:
    nobody = torch.zeros(1, 0, 3, dtype=torch.float64)
    seen = Measurement(0.0, torch.zeros(1, 3, dtype=torch.float64), None, nobody, nobody[..., 0] > 0)
    with pytest.raises(InputError, match="speed box"):
        CbfQpController(VelocityTask(3), [SpeedDisc(1.0)])(seen, torch.ones(1, 3, dtype=torch.float64))


@pytest.mark.parametrize("compiled", [False, True])
def test_a_speed_ball_for_observers(compiled: bool) -> None:
    """The wish is clipped by the ball alone: it is ahead of u, which is wrong by the whole bound."""
    rng, count = np.random.default_rng(5), 500
    wish = 2 * rng.normal(size=(count, 3))
    size, off = np.linalg.norm(wish, axis=-1, keepdims=True), rng.normal(size=(count, 3))
    u = torch.from_numpy(wish * np.minimum(1, 1 / size) + 0.02 * off / np.linalg.norm(off, axis=-1, keepdims=True))
    nobody = torch.zeros(count, 0, 3, dtype=torch.float64)
    seen = Measurement(0.0, torch.zeros(count, 3, dtype=torch.float64), u, nobody, nobody[..., 0] > 0)
    corner = torch.full((count, 3), 20.0, dtype=torch.float64)
    model = ObservationModel(VelocityTask(3), [SpeedDisc(1.0)], noise=NoiseBound(0.02 + 1e-9))
    found = evidence(model, FeasibleSet.from_box(-corner, corner), seen, compiled)
    assert int((size > 1).sum()) > count / 2
    assert bool(found.informative.all())
    assert float(found.omega.slack(torch.from_numpy(wish)).min()) > -1e-9


def test_what_cannot_be() -> None:
    with pytest.raises(InputError, match="sidestep"):
        BufferedVoronoi(AXES, 0.5, 0.5)
    with pytest.raises(InputError, match="margin"):
        Ellipsoid(CollisionAvoidance(ClassK(1.0), margin=0.1), AXES)
    with pytest.raises(InputError, match="3 entries"):
        BARRIERS["squared"](random_situations(0))
