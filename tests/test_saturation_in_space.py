"""Clipped nominal controls in space: no wish is lost, and where no row is active the set is as tight as it can be."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.scenes_in_space import unit
from tests.test_sets_in_space import unordered
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.identification.normals import outward_normals
from torchfsid.identification.saturation import unclipped
from torchfsid.robots.affine_barrier import AffineBarrier
from torchfsid.robots.bounds import NoiseBound, RowErrors
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import AffineTask, Saturation
from torchfsid.sets.feasible_set import FeasibleSet

SATURATIONS = {
    "norm": Saturation("norm", (0.5,) * 3),
    "box": Saturation("box", (0.5, 0.3, 0.4)),
    "lazy norm": Saturation("norm", (0.5,) * 3, dead_speed=0.1),
    "lazy box": Saturation("box", (0.5, 0.3, 0.4), dead_speed=0.1),
    "dead zone only": Saturation("norm", (np.inf,) * 3, dead_speed=0.1),
}


def scene(name: str, errors: bool, count: int = 60) -> tuple[ObservationModel, FeasibleSet, Measurement]:
    """Rows that hold u back, directions, u and C theta + d are all wrong by up to their bounds. The truth is zero."""
    rng, m, saturation = np.random.default_rng(7), 2, SATURATIONS[name]
    shift, turn = (0.05, rng.uniform(0, 0.2, (count, m))) if errors else (0.0, np.zeros((count, m)))
    delta, width = rng.uniform(1e-4, 0.03, count), np.exp(rng.uniform(np.log(0.02), np.log(3.0), (count, 1)))
    C, d = np.eye(3) + rng.uniform(-0.2, 0.2, (count, 3, 3)), rng.normal(size=(count, 3))
    A, may_hold = unit(rng.normal(size=(count, m, 3))), rng.uniform(size=(count, m)) < 0.4
    true_rows = unit(A + np.tan(turn)[..., None] * 0.99 * unit(np.cross(A, rng.normal(size=A.shape))))
    held = (rng.exponential(0.5, (count, m, 1)) * may_hold[..., None] * true_rows).sum(1)
    off = rng.uniform(size=(2, count, 1)) * unit(rng.normal(size=(2, count, 3)))
    u = saturation(torch.from_numpy(d + shift * off[0])).numpy() - held + delta[:, None] * off[1]
    b = (A * u[:, None]).sum(-1) + np.where(may_hold, rng.uniform(-1, 1, (count, m)) * delta[:, None], 1.0)
    told = RowErrors(torch.from_numpy(turn), torch.zeros(count, m, dtype=torch.float64))
    barrier = AffineBarrier(torch.from_numpy(A), torch.from_numpy(b), ("a", "b"), row_errors=lambda *_: told)
    task = AffineTask(torch.from_numpy(C), torch.from_numpy(d), ("p", "q", "r"), saturation, sensitivity=1.0)
    model = ObservationModel(task, [barrier], noise=NoiseBound(torch.from_numpy(delta), position=shift))
    middle = rng.uniform(-0.45, 0.45, (count, 3)) * width
    prior = FeasibleSet.from_box(torch.from_numpy(middle - width / 2), torch.from_numpy(middle + width / 2))
    nobody = torch.zeros(count, 0, 3, dtype=torch.float64)
    seen = Measurement(0.0, torch.zeros(count, 3, dtype=torch.float64), torch.from_numpy(u), nobody, nobody[..., 0] > 0)
    return model, prior, seen


@pytest.mark.parametrize("name", SATURATIONS)
@pytest.mark.parametrize("errors", [False, True], ids=["exact positions", "position errors"])
def test_the_truth_is_inside(name: str, errors: bool) -> None:
    """And compiled code finds what torch finds, also where the model is not finite."""
    model, prior, seen = scene(name, errors)
    task, (barrier,) = model.task, model.barriers
    assert isinstance(task, AffineTask)
    assert isinstance(barrier, AffineBarrier)
    barrier.b[0, 0], task.d[1, 1] = torch.nan, torch.inf
    reference, found = (evidence(model, prior, seen, compiled) for compiled in (False, True))
    assert int(found.informative.sum()) > len(seen.x) / 2
    assert found.omega.slack(torch.zeros_like(seen.x))[found.informative].min() > -1e-8
    assert int((found.omega.A != 0).any(-1).any(-1).sum()) > 0
    torch.testing.assert_close(found.informative, reference.informative)
    for part in ("G", "f", "rank", "case"):
        torch.testing.assert_close(getattr(found.kkt, part), getattr(reference.kkt, part), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(unordered(found.omega), unordered(reference.omega), rtol=1e-9, atol=1e-9)


def around(u: tuple[float, float, float], radius: float = 0.01) -> Halfspaces:
    centre = torch.tensor([u], dtype=torch.float64)
    none = torch.zeros(1, 1, dtype=torch.bool)
    normals = outward_normals(torch.ones(1, 1, 3, dtype=torch.float64), none, 17).normals
    return Halfspaces(normals, (normals @ centre.unsqueeze(-1)).squeeze(-1) + radius)


CUBE = torch.tensor([[[x, y, z] for x in (-4.0, 4.0) for y in (-4.0, 4.0) for z in (-4.0, 4.0)]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("name", "u", "point", "inside"),
    [
        ("norm", (0.5, 0.0, 0.0), (3.0, 0.0, 0.0), True),
        ("norm", (0.5, 0.0, 0.0), (3.0, 0.1, 0.1), False),
        ("norm", (0.5, 0.0, 0.0), (0.4, 0.0, 0.0), False),
        ("norm", (0.2, 0.1, 0.1), (0.24, 0.1, 0.1), False),
        ("box", (0.5, 0.1, 0.1), (3.0, 0.1, 0.1), True),
        ("box", (0.5, 0.1, 0.1), (3.0, 0.13, 0.1), False),
        ("box", (0.5, 0.1, 0.1), (0.45, 0.1, 0.1), False),
        ("lazy norm", (0.0, 0.0, 0.0), (0.0, 0.09, 0.0), True),
        ("lazy norm", (0.0, 0.0, 0.0), (0.0, 0.2, 0.0), False),
    ],
)
def test_no_row_is_active(name: str, u: tuple, point: tuple, inside: bool) -> None:
    rows = unclipped(around(u), SATURATIONS[name], CUBE, torch.zeros(1, dtype=torch.float64))
    assert bool(rows.contains(torch.tensor([point], dtype=torch.float64))) == inside
