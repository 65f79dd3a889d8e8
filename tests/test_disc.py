"""The largest disc in sets whose edges are nearly parallel: parallelograms, slabs, needles, far from the origin too.

The radius is compared with the exact one.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.problems import exact_inscribed_radius
from torchfsid.halfspaces import Halfspaces
from torchfsid.kernels import disc
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.tolerances import ROUND_OFF

HALF = 5.0


def inside(rows: np.ndarray, bounds: np.ndarray, offset: np.ndarray) -> FeasibleSet:
    """The sets {z : rows (z - offset) <= bounds} in boxes around the offsets."""
    centre = torch.tensor(offset)
    b = bounds + (rows * offset[:, None]).sum(-1)
    return FeasibleSet.from_box(centre - HALF, centre + HALF).intersect(
        Halfspaces(torch.from_numpy(rows), torch.from_numpy(b))
    )


def shapes(kind: str, angle: float, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    turn = rng.uniform(0, 2 * np.pi, count)
    one, other = (np.stack([np.cos(t), np.sin(t)], axis=-1) for t in (turn, turn + angle))
    across, share = one[:, ::-1] * [-1, 1], rng.uniform(0.3, 0.7, (count, 4))
    if kind == "rhombus":
        return np.stack([one, other, -one, -other], axis=1), np.full((count, 4), 0.5)
    if kind == "parallelogram":
        return np.stack([one, other, -one, -other], axis=1), share
    if kind == "slab":
        return np.stack([one, -other, one, -other], axis=1), share * angle
    if kind == "needle":
        return np.stack([one, -other, across, -across], axis=1), share * [angle, angle, 1, 1]
    if kind == "duplicates":
        A = np.stack([one, one, -one, other, -other, -other], axis=1) * 10 ** rng.uniform(-2, 2, (count, 6, 1))
        return A, 0.4 * np.linalg.norm(A, axis=-1)
    size = min(1 / angle, 1e7)  # integer rows, each pair exactly opposite
    first = np.round(size * one + [1.0, 2.0])
    A = np.stack([first, first + rng.integers(-1, 2, (count, 2)), -first, -first], axis=1)
    A[:, 3] = -A[:, 1]
    return A, np.round(np.linalg.norm(A, axis=-1) * 0.5) + rng.integers(0, 3, (count, 4))


@pytest.mark.parametrize("kind", ["rhombus", "parallelogram", "slab", "needle", "duplicates", "integers"])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (448262.0, 5411932.0)], ids=["origin", "far"])
def test_radius_is_exact_and_the_centre_inside(kind: str, offset: tuple[float, float]) -> None:
    rng, count = np.random.default_rng(0), 60
    for angle in (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12):
        A, b = shapes(kind, angle, count, rng)
        place = np.broadcast_to(np.array(offset), (count, 2))
        shift = (A * rng.uniform(-1, 1, (count, 1, 2))).sum(-1) if kind != "integers" else 0.0
        sets = inside(A, b + shift, place)
        assert not sets.any_empty
        centre, radius = sets.chebyshev()
        noise = 64 * ROUND_OFF * (HALF + max(offset))
        assert torch.isfinite(radius).all()
        assert (radius >= 0).all()
        assert sets.contains(centre).all()
        depth = sets.facets().halfspaces.slack(centre).masked_fill((sets.body.A == 0).all(-1), torch.inf).amin(-1)
        assert (depth - radius).abs().max() <= noise
        for item in range(0, count, 6):
            n = int(sets.body.count[item])
            assert float(radius[item]) == pytest.approx(
                exact_inscribed_radius(sets.body.A[item, :n].numpy(), sets.body.b[item, :n].numpy()), abs=noise
            )


@pytest.mark.parametrize(
    ("rows", "bounds", "expected"),
    [
        ([[10.0, 7], [9, 6], [-10, -7], [-9, -6]], [22.0, 17, 26, 23], 1.8490006540840973),
        ([[42.0, 31], [41, 30], [-42, -31], [-41, -30]], [81.0, 78, 33, 24], 1.0038669904531696),
    ],
)
def test_two_pairs_of_opposite_edges(rows: list, bounds: list, expected: float) -> None:
    sets = inside(np.array([rows]), np.array([bounds]), np.zeros((1, 2)))
    assert sets.chebyshev()[1].item() == pytest.approx(expected, rel=1e-14)
    verdict = sets.emptiness()
    assert verdict.outcome.item() == Status.OK
    assert sets.contains(verdict.witness).all()


def test_the_general_programme_takes_over_where_the_search_gives_up(monkeypatch: pytest.MonkeyPatch) -> None:
    A, b = shapes("parallelogram", 0.5, 20, np.random.default_rng(3))
    sets = inside(A, b, np.zeros((20, 2)))
    _, radius = sets.chebyshev()
    search = disc.inscribed
    monkeypatch.setattr(
        disc, "inscribed", lambda *rows: (*(0 * part for part in search(*rows)[:3]), np.zeros(20, bool))
    )
    other_centre, other_radius = sets.chebyshev()
    torch.testing.assert_close(other_radius, radius, rtol=1e-12, atol=0)
    assert sets.contains(other_centre).all()


def test_a_robot_jammed_between_two_bodies_has_a_disc() -> None:
    """The line through the bodies turns by about 1e-5 rad between the samples: 500 robots."""
    rng, count = np.random.default_rng(1), 500
    turn = rng.uniform(0, np.pi, count)
    corner = torch.full((count, 2), HALF, dtype=torch.float64)
    watching = SetMembershipObserver(
        GoalTask(1.0),
        [CollisionAvoidance(ClassK(1.0), safety_distance=0.5)],
        FeasibleSet.from_box(-corner, corner),
        noise=NoiseBound(0.02),
    )
    for sample in range(3):
        angle = turn + 1e-4 * rng.uniform(-1, 1, count) * sample
        body = 0.505 * np.stack([np.cos(angle), np.sin(angle)], axis=-1).round(6)
        bodies, still = torch.from_numpy(np.stack([body, -body], axis=1)), torch.zeros(count, 2, dtype=torch.float64)
        present = torch.ones(count, 2, dtype=torch.bool)
        sets = watching.update(Measurement(float(sample), still, still, bodies, present)).feasible_set
    centre, radius = sets.chebyshev()
    assert (sets.outcome == Status.OK).all()
    assert (radius > 0).all()
    assert torch.isfinite(radius).all()
    assert sets.contains(centre).all()
