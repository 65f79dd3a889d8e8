"""Clipped nominal controls: the set of wishes is an outer set, and no larger than it has to be."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

import torchfsid as fsid
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.normals import outward_normals
from torchfsid.identification.saturation import unclipped
from torchfsid.robots.tasks import Saturation
from torchfsid.tolerances import NORMALS

CORNERS = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]], dtype=torch.float64) / 2
NORM, BOX = Saturation("norm", (0.5, 0.5)), Saturation("box", (0.5, 0.3))
LAZY = Saturation("norm", (0.5, 0.5), dead_speed=0.05)
CONSTANT = Saturation("norm", (0.5, 0.5), dead_speed=0.5)
ONLY_LAZY = Saturation("norm", (float("inf"), float("inf")), dead_speed=0.05)


def ball(u: torch.Tensor, delta: float) -> Halfspaces:
    """uhat within delta of u, as the inverse-optimal set hands it over when no row may be active."""
    none = torch.zeros(*u.shape[:-1], 1, dtype=torch.bool)
    normals = outward_normals(torch.ones(*u.shape[:-1], 1, 2, dtype=torch.float64), none, NORMALS).normals
    return Halfspaces(normals, (normals @ u.unsqueeze(-1)).squeeze(-1) + delta).where((normals != 0).any(-1))


CLIPS = {"norm": NORM, "box": BOX, "dead zone": LAZY, "dead zone only": ONLY_LAZY, "constant speed": CONSTANT}


@pytest.mark.parametrize("saturation", CLIPS.values(), ids=CLIPS)
def test_every_wish_is_inside(saturation: Saturation) -> None:
    """20 000 wishes, with up to three active rows, errors at their bound, and priors from narrow to wide."""
    generator = torch.Generator().manual_seed(1)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    for rows in (1, 2, 3):
        for delta in (1e-6, 1e-2):
            B = 3334
            middle, width = normal(B, 2), 0.02 + 2 * uniform(B, 1)
            y = middle + (uniform(B, 2) - 0.5) * width
            possible = middle.unsqueeze(1) + CORNERS * width.unsqueeze(1)
            a, may_be_active = normal(B, rows, 2), uniform(B, rows) < 0.5
            multipliers = 0.5 * uniform(B, rows) * may_be_active * (uniform(B, rows) < 0.8)
            u = saturation(y) - (multipliers.unsqueeze(-1) * a).sum(1)
            error = normal(B, 2)
            u = u + error / error.norm(dim=-1, keepdim=True) * delta
            normals = outward_normals(a, may_be_active, NORMALS).normals
            offsets = (normals @ u.unsqueeze(-1)).squeeze(-1) + delta
            admissible = Halfspaces(normals, offsets).where((normals != 0).any(-1))
            assert (
                unclipped(admissible, saturation, possible, torch.zeros(B, dtype=torch.float64)).slack(y).min() > -1e-9
            )


def test_far_inside_the_limit_it_is_the_linear_set() -> None:
    admissible = ball(torch.tensor([[0.2, 0.1]], dtype=torch.float64), 0.01)
    possible = 4 * CORNERS.unsqueeze(0)
    rows = unclipped(admissible, NORM, possible, torch.zeros(1, dtype=torch.float64))
    angles = torch.linspace(0, 6.28, 100, dtype=torch.float64)
    ring = torch.tensor([0.2, 0.1]) + 0.0104 * torch.stack([angles.cos(), angles.sin()], dim=-1)
    assert not any(bool(rows.contains(point.unsqueeze(0))) for point in ring)


def test_on_the_limit_it_is_a_cone_beyond_the_chord() -> None:
    """Clipped for sure, towards (1, 0) up to 0.01/0.5 rad: the wish is ahead, neither aside nor within the limit."""
    admissible = ball(torch.tensor([[0.5, 0.0]], dtype=torch.float64), 0.01)
    possible = torch.tensor([[[2.0, -1.0], [4.0, -1.0], [4.0, 1.0], [2.0, 1.0]]], dtype=torch.float64)
    rows = unclipped(admissible, NORM, possible, torch.zeros(1, dtype=torch.float64))
    for inside, point in [(True, (3.0, 0.0)), (True, (3.0, 0.055)), (False, (3.0, 0.07)), (False, (0.49, 0.0))]:
        assert bool(rows.contains(torch.tensor([point], dtype=torch.float64))) == inside


def test_the_box_clips_each_axis_for_itself() -> None:
    """u = (0.5, 0.1): the first axis is clipped, the second is not and stays measured."""
    admissible = ball(torch.tensor([[0.5, 0.1]], dtype=torch.float64), 0.01)
    rows = unclipped(admissible, BOX, 8 * CORNERS.unsqueeze(0), torch.zeros(1, dtype=torch.float64))
    for inside, point in [(True, (3.0, 0.1)), (True, (0.5, 0.1)), (False, (0.45, 0.1)), (False, (3.0, 0.13))]:
        assert bool(rows.contains(torch.tensor([point], dtype=torch.float64))) == inside


def test_a_control_beyond_the_limit_contradicts() -> None:
    admissible = ball(torch.tensor([[0.8, 0.0]], dtype=torch.float64), 0.01)
    rows = unclipped(admissible, NORM, 8 * CORNERS.unsqueeze(0), torch.zeros(1, dtype=torch.float64))
    assert not rows.contains(torch.tensor([[0.8, 0.0]], dtype=torch.float64)).any()
    assert not rows.contains(torch.tensor([[2.0, 0.0]], dtype=torch.float64)).any()


def test_standing_still_in_a_dead_zone() -> None:
    admissible = ball(torch.zeros(1, 2, dtype=torch.float64), 0.001)
    rows = unclipped(admissible, LAZY, 8 * CORNERS.unsqueeze(0), torch.zeros(1, dtype=torch.float64))
    assert rows.contains(torch.tensor([[0.049, 0.0]], dtype=torch.float64)).all()
    assert not rows.contains(torch.tensor([[0.06, 0.0]], dtype=torch.float64)).any()


@pytest.mark.parametrize("shape", ["norm", "box"])
def test_a_limit_out_of_reach_has_no_gradient_and_spoils_none(shape: Any) -> None:
    """No wish in the prior comes near the limit: as with a wide prior, whose set is the same."""

    def gradient(half: float) -> Tensor:
        gain = torch.tensor(0.9, dtype=torch.float64, requires_grad=True)
        task = fsid.GoalTask(gain, saturation=Saturation(shape, (0.5, 0.5)))
        x = torch.tensor([[0.0, 0.0], [3.0, 3.0]], dtype=torch.float64)
        u = torch.tensor([[0.02, 0.03], [0.01, -0.02]], dtype=torch.float64)
        avoidance = fsid.CollisionAvoidance(fsid.ClassK(1.5), safety_distance=0.4)
        prior = fsid.FeasibleSet.from_box(x - half, x + half)
        watching = fsid.SetMembershipObserver(task, [avoidance], prior, noise=fsid.NoiseBound(1e-2))
        volume = watching.update(fsid.Measurement.of_team(0.0, x, u)).feasible_set.volume().sum()
        return torch.autograd.grad(volume, gain)[0]

    torch.testing.assert_close(gradient(0.1), gradient(5.0), rtol=1e-9, atol=0.0)


def test_a_dead_zone_without_a_limit_is_differentiable() -> None:
    wish = torch.tensor([[0.3, 0.4], [0.01, 0.02]], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(Saturation("norm", (math.inf, math.inf), 0.05)(wish).sum(), wish)
    assert slope.tolist() == [[1.0, 1.0], [0.0, 0.0]]
