"""Nothing on a device is mixed with what is on the CPU. A test for a process with NUMBA_ENABLE_CUDASIM=1."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import Any

import pytest
import torch
from torch import Tensor

from benchmarks import cuda_layers
from benchmarks.scenario import BARRIER, TASK, Fleet, measured
from tests.far_device import FAR, Far, far_device
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.barriers import Arena, Barrier, SpeedBox
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import LeftOut, Measurement
from torchfsid.robots.tasks import Saturation
from torchfsid.sets.feasible_set import FeasibleSet

pytestmark = pytest.mark.filterwarnings("ignore:divide by zero")  # in Python, a row 0.z <= -1 is noticed

EXACT, ERRORS = NoiseBound(5e-3), NoiseBound(5e-3, position=1e-3, neighbour_velocity=1e-3)
BARRIERS: list[Barrier] = [BARRIER, SpeedBox((9.0, 9.0)), Arena((-9.0, -9.0), (9.0, 9.0), BARRIER.class_k)]


def there(value: Any) -> Any:
    if isinstance(value, LeftOut):
        return LeftOut(*map(there, value))
    return value.to(FAR) if isinstance(value, Tensor) else value


def fleet(robots: int = 5) -> tuple[Tensor, FeasibleSet, list[Measurement]]:
    """Goals, priors and measurements on the device."""
    robots_of = Fleet(robots, noisy=True)
    seen = [measured(*moment) for moment in islice(robots_of, 3)]
    goals = robots_of.goals.to(FAR)
    corner = torch.full_like(goals, robots_of.half + 1)
    parts = [replace(part, **{name: there(value) for name, value in vars(part).items()}) for part in seen]
    return goals, FeasibleSet.from_box(-corner, corner), parts


def answers(sets: FeasibleSet, point: Tensor) -> list[Tensor]:
    metric = torch.diag_embed(point.detach() ** 2 + 1)
    return [
        sets.volume(), sets.vertices(), *sets.chebyshev(), sets.centroid(), sets.diameter(), sets.support(point),
        sets.project(point), sets.project(point, metric),
    ]  # fmt: skip


def test_mixing_is_noticed() -> None:
    with far_device():
        one = torch.ones(2, device=FAR)
        assert (one + torch.tensor(1.0)).tolist() == [2.0, 2.0]
        with pytest.raises(RuntimeError, match="mixes"):
            one.add(torch.ones(2))


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"kind": "critical_region", "noise": None},
        {"noise": ERRORS, "windows": (0.05,)},
        {"task": replace(TASK, saturation=Saturation("box", (3.0, 3.0)))},
        {"outliers": 1, "noise": NoiseBound(1e-9)},
        {"on_inconsistent": "reset", "noise": NoiseBound(1e-9)},
    ],
    ids=["plain", "paper", "windows", "clipped", "outliers", "reset"],
)
def test_observers(changed: dict) -> None:
    with far_device():
        goals, prior, seen = fleet()
        arguments = {"task": TASK, "barriers": BARRIERS, "noise": EXACT, **changed}
        watching = SetMembershipObserver(feasible_set=prior, **arguments)
        for measurement in seen:
            estimate = watching.update(measurement)
        sets = estimate.feasible_set
        found = [*answers(sets, goals), sets.contains(goals), estimate.evidence.slack, estimate.kkt.G, estimate.status]
        assert all(isinstance(part, Far) for part in (*found, sets.facets().time, sets.emptiness().outcome))


def test_gradients() -> None:
    with far_device():
        goals, prior, seen = fleet()
        x = seen[0].x.clone().requires_grad_()
        watching = SetMembershipObserver(TASK, [BARRIER], prior, noise=EXACT)
        for measurement in seen:
            estimate = watching.update(replace(measurement, x=measurement.x + (x - x.detach())))
        total = torch.stack([part.sum() for part in answers(estimate.feasible_set, goals + 1)]).sum()
        (gradient,) = torch.autograd.grad(total, x, create_graph=True)
        (second,) = torch.autograd.grad(gradient.sum(), x)
        assert isinstance(second, Far)


def test_layers() -> None:
    with far_device():
        for layer in (cuda_layers.projection, cuda_layers.chebyshev):
            given = [part.to(FAR) for part in cuda_layers.workload(3, 8, 2)]
            assert all(isinstance(part, Far) for part in cuda_layers.with_gradients(layer, given))
