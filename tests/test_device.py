"""Nothing in the torch path assumes a device: it runs where the data are (`devices`)."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

import torchfsid as fsid
from tests.devices import ElsewhereMode
from torchfsid.robots.avoidance import ClassK
from torchfsid.robots.barriers import Arena, Barrier, SpeedBox, SpeedPolygon
from torchfsid.robots.tasks import Saturation

GOALS = torch.tensor([[2.0, 0.1], [-2.0, 0.0], [0.1, -1.5]], dtype=torch.float64)
STARTS = torch.tensor([[-2.0, 0.0], [2.0, 0.3], [0.0, 1.5]], dtype=torch.float64)
AVOIDANCE = fsid.CollisionAvoidance(ClassK(1.5), safety_distance=0.5)
WALLS: list[Barrier] = [SpeedBox((9.0, 9.0)), SpeedPolygon(8, 9.0), Arena((-9.0, -9.0), (9.0, 9.0), ClassK(2.0))]


def crossing(barriers: list[Barrier]) -> list[fsid.Measurement]:
    run = fsid.simulate(fsid.CbfQpController(fsid.GoalTask(0.9), barriers), GOALS, STARTS, dt=0.1, steps=12)
    return list(run.measurements())


def prior() -> fsid.FeasibleSet:
    corner = torch.full((3, 2), 5.0, dtype=torch.float64)
    return fsid.FeasibleSet.from_box(-corner, corner)


def answers(sets: fsid.FeasibleSet, point: Tensor) -> list[Tensor]:
    facets = sets.facets()
    metric = torch.diag_embed(torch.stack([point[:, 0] ** 2 + 1, point[:, 1] ** 2 + 2], dim=-1))
    return [
        sets.volume(), sets.vertices(), *sets.chebyshev(), sets.centroid(), sets.diameter(), sets.support(point),
        sets.project(point), sets.project(point, metric), sets.contains(point), facets.halfspaces.A, facets.time,
        *sets.emptiness()[:2],
    ]  # fmt: skip


def test_the_mode_notices() -> None:
    data = torch.ones(3)
    with ElsewhereMode(), pytest.raises(RuntimeError):
        data + torch.arange(3)


@pytest.mark.parametrize(
    ("kind", "noise"),
    [
        ("critical_region", None),
        ("inverse_optimal", fsid.NoiseBound(1e-3)),
        ("inverse_optimal", fsid.NoiseBound(1e-3, position=1e-3)),
    ],
    ids=["critical region", "inverse-optimal", "position errors"],
)
@pytest.mark.parametrize("gradient", [False, True], ids=["values", "gradients"])
def test_an_observer_runs_where_its_data_are(kind: Any, noise: fsid.NoiseBound | None, gradient: bool) -> None:
    measurements, sets = crossing([AVOIDANCE, *WALLS]), prior()
    x = STARTS.clone().requires_grad_(gradient)
    with ElsewhereMode():
        watching = fsid.SetMembershipObserver(
            fsid.GoalTask(0.9), [AVOIDANCE, *WALLS], sets, kind=kind, noise=noise, compiled=False
        )
        for measurement in measurements:
            estimate = watching.update(measurement)
        for answer in answers(estimate.feasible_set, x):
            assert answer.device == GOALS.device
        if gradient:
            estimate.feasible_set.project(x).sum().backward()
            assert x.grad is not None


def test_a_clipped_controller_is_observed_where_its_data_are() -> None:
    task, sets = fsid.GoalTask(0.9, saturation=Saturation("norm", (0.6, 0.6))), prior()
    run = fsid.simulate(fsid.CbfQpController(task, [AVOIDANCE]), GOALS, STARTS, dt=0.1, steps=12)
    measurements = list(run.measurements())
    with ElsewhereMode():
        watching = fsid.SetMembershipObserver(task, [AVOIDANCE], sets, noise=fsid.NoiseBound(1e-3), compiled=False)
        for measurement in measurements:
            estimate = watching.update(measurement)
        assert estimate.feasible_set.volume().device == GOALS.device


def test_robots_move_where_their_goals_are() -> None:
    controller = fsid.CbfQpController(fsid.GoalTask(0.9), [AVOIDANCE, *WALLS])
    with ElsewhereMode():
        run = fsid.simulate(controller, GOALS, STARTS, dt=0.1, steps=5)
        assert run.x.device == GOALS.device
        measurement = fsid.nearest_bodies(0.0, run.x[-1], run.u[-1], count=2)
        assert measurement.bodies.device == GOALS.device


def test_layers_run_where_their_rows_are() -> None:
    generator = torch.Generator().manual_seed(0)
    A = torch.randn(5, 12, 2, dtype=torch.float64, generator=generator).requires_grad_()
    b = 1 + torch.rand(5, 12, dtype=torch.float64, generator=generator)
    point = 3 * torch.randn(5, 2, dtype=torch.float64, generator=generator)
    metric = torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=torch.float64)
    with ElsewhereMode():
        rows = fsid.Halfspaces(A, b)
        centre, radius, _ = fsid.ChebyshevCentre("exact")(rows)
        near, _ = fsid.ProjectOnto(backend="exact")(rows, point)
        weighted, _ = fsid.ProjectOnto(metric, backend="exact")(rows, point)
        (centre.sum() + radius.sum() + near.sum() + weighted.sum()).backward()
    assert A.grad is not None
    assert bool(A.grad.isfinite().all())


def test_constants_outlive_no_transform() -> None:
    """The limits of a speed box are kept, but not those that were made within a transform."""
    box, x = SpeedBox((1.25, 1.5)), torch.zeros(2, dtype=torch.float64)

    def largest(x: Tensor) -> Tensor:
        rows = box(fsid.Measurement(t=0.0, x=x, u=None, bodies=x.new_zeros(0, 2), present=x.new_zeros(0).bool()))
        return (rows.A @ x - rows.b).sum()

    torch.func.grad(largest)(x)
    assert float(largest(x)) == -5.5
    assert torch.equal(torch.func.grad(largest)(x), torch.zeros_like(x))
