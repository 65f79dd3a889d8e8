"""Closed loops and the probe design, for a process with NUMBA_ENABLE_CUDASIM=1. See `tests.test_cuda` and `_both`."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from experiments.design.probe import Probing
from tests.on_simulator._both import both, launched, same
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.tasks import GoalTask

__all__ = ["launched"]


def corridor(avoidance: CollisionAvoidance) -> Probing:
    def tensor(values: list) -> Tensor:
        return torch.tensor(values, dtype=torch.float64)

    obstacles, boxes = tensor([[0.6, 0.7], [0.6, -0.7]]), tensor([[[2.5, -0.5], [3.5, 0.5]], [[-0.5, -1], [3.5, 1]]])
    return Probing(GoalTask(1.0), avoidance, obstacles, tensor([0.0, 0.0]), *boxes, 0.05, 5, active_tolerance=1e-6)


BARRIERS = [
    CollisionAvoidance(ClassK(1.0), 0.4),
    CollisionAvoidance(ClassK(20.0, 3.0), 0.35, distance="euclidean"),
]
PATHS = torch.tensor([[[0.62, 0.05], [0.7, -0.1]], [[0.0, 0.5], [0.3, 0.42]], [[0.0, 0.0], [0.7, 0.1]]]).double()


@pytest.mark.parametrize("barrier", BARRIERS)
def test_runs_and_their_gradients_are_alike(barrier: CollisionAvoidance) -> None:
    scene = corridor(barrier)
    goals = scene.draw_goals(2, seed=5)

    def found() -> list[Tensor]:
        placements = PATHS.clone().requires_grad_()
        runs = scene.run(placements, goals)
        x, u = runs.along(scene.path(placements, scene.steps))
        return [*runs[3:], *torch.autograd.grad((x * u.cos()).sum(), placements)]

    one, other = both(found)
    assert (one[-1] != 0).any()
    for mine, theirs in zip(one[:-1], other[:-1], strict=True):
        same(mine, theirs)
    torch.testing.assert_close(one[-1], other[-1], rtol=1e-12, atol=1e-15)


def test_a_gradient_step_is_alike() -> None:
    scene = corridor(BARRIERS[0])
    goals = scene.draw_goals(2, seed=3)

    def found() -> tuple[Tensor, Tensor]:
        placements = PATHS[:1].clone().requires_grad_()
        area = scene.left(placements, goals).area
        return area.detach(), *torch.autograd.grad(area.log().sum(), placements)

    one, other = both(found)
    assert (one[0] < scene.prior_area).all()
    assert (one[1] != 0).any()
    for mine, theirs in zip(one, other, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-12)
