"""Ellipsoids and buffered Voronoi cells: the test kit, the formulas, and what a sidestep spoils."""

from __future__ import annotations

import pytest
import torch

from torchfsid.errors import InputError
from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.buffered_voronoi import BufferedVoronoi
from torchfsid.robots.ellipsoid import Ellipsoid
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.second_order import SecondOrderAvoidance
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.testing import check_barrier, random_situations, second_order

AXES = (0.3, 0.3, 0.9)
BARRIERS = {
    "squared": Ellipsoid(CollisionAvoidance(ClassK(1.5), 1.0), AXES),
    "euclidean": Ellipsoid(CollisionAvoidance(ClassK(1.5, 2.0), 2.0, distance="euclidean"), AXES),
    "joint": Ellipsoid(CollisionAvoidance(ClassK(1.0), 1.0, neighbour_velocity="current"), AXES),
    "second order": Ellipsoid(SecondOrderAvoidance((1.5, 2.0), 1.0, neighbour_acceleration="current"), AXES),
    "voronoi": BufferedVoronoi(AXES, 1.0, 0.5, sidestep=0.0),
    "sidestep": BufferedVoronoi(AXES, 1.0, 0.5, sidestep=0.1),
}


@pytest.mark.parametrize("name", [name for name in BARRIERS if name not in ("voronoi", "sidestep")])
def test_the_kit_finds_nothing(name: str) -> None:
    barrier = BARRIERS[name]

    def h(measurement: Measurement) -> torch.Tensor:
        y = (measurement.x.unsqueeze(-2) - measurement.bodies) / torch.tensor(AXES, dtype=torch.float64)
        r = y.norm(dim=-1)
        return r - 2 if name == "euclidean" else r**2 - 1

    alphas = {"squared": ClassK(1.5), "euclidean": ClassK(1.5, 2.0), "joint": ClassK(1.0)}
    given = {"h": h, "alpha": alphas[name]} if name in alphas else {"motion": second_order}
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


def test_what_cannot_be() -> None:
    with pytest.raises(InputError, match="sidestep"):
        BufferedVoronoi(AXES, 0.5, 0.5)
    with pytest.raises(InputError, match="margin"):
        Ellipsoid(CollisionAvoidance(ClassK(1.0), margin=0.1), AXES)
    with pytest.raises(InputError, match="3 entries"):
        BARRIERS["squared"](random_situations(0))
