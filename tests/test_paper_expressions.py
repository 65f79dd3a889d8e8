"""Check 2: the critical region is the paper's Omega, case by case, and in C and E for the eta that is quantified away.

Two independent comparisons: membership of sampled thetas, "exists eta" decided by a linear programme per theta; and the
supports of both sets in random directions, by linear programmes over (theta, eta).
"""

import numpy as np
import pytest
import torch

from tests.paper_expressions import BOX, Lifted, omega
from tests.problems import CASES, Scene, paper_case
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.critical_region import critical_region
from torchfsid.identification.kkt import CASES as LETTERS
from torchfsid.identification.kkt import solve_kkt

MARGIN = 1e-7
"""A theta nearer to a boundary than this is left to round-off (HiGHS is accurate to about 1e-9)."""


def papers_omega(scene: Scene) -> Lifted:
    return omega(scene.A, scene.b, scene.active, scene.C, scene.d)


def as_lifted(region: Halfspaces) -> Lifted:
    return Lifted(region.A.numpy(), np.zeros((region.rows, 0)), region.b.numpy())


@pytest.mark.parametrize("case", CASES)
def test_case_letter(case: str):
    scene = paper_case(case, np.random.default_rng(1))
    assert LETTERS[int(solve_kkt(*scene.tensors).case)] == case[0]


@pytest.mark.parametrize("case", CASES)
def test_same_members_as_the_papers_expression(case: str):
    """6 scenes x 60 thetas per case; in case C opposite and E, half of them are decided by eta alone."""
    rng = np.random.default_rng(CASES.index(case))
    inside = left_out = 0
    for _ in range(6):
        scene = paper_case(case, rng)
        paper = papers_omega(scene)
        thetas = scene.theta + rng.normal(size=(60, 2)) * rng.choice([0.3, 3.0], size=(60, 1))
        depth = np.array([paper.depth(theta) for theta in thetas])
        ours = critical_region(*scene.tensors).slack(torch.from_numpy(thetas)).amin(-1).numpy()
        clear = (np.abs(depth) > MARGIN) & (np.abs(ours) > MARGIN)
        assert np.array_equal((depth > 0)[clear], (ours > 0)[clear])
        inside += int((ours > 0).sum())
        left_out += int((~clear).sum())
    assert left_out <= 1
    assert inside == 360 if case == "E three whole plane" else 36 < inside < 324


@pytest.mark.parametrize("case", CASES)
def test_same_support_as_the_papers_expression(case: str):
    """4 scenes x 24 directions per case, within a box because the sets are unbounded."""
    rng = np.random.default_rng(50 + CASES.index(case))
    for _ in range(4):
        scene = paper_case(case, rng)
        paper, ours = papers_omega(scene), as_lifted(critical_region(*scene.tensors))
        angles = rng.uniform(0, 2 * np.pi, 24)
        for direction in np.stack([np.cos(angles), np.sin(angles)], axis=-1):
            expected = paper.support(direction, scene.theta)
            assert ours.support(direction, scene.theta) == pytest.approx(expected, abs=1e-7 * BOX)


def test_minimum_norm_multipliers_are_not_the_set():
    """Normals (1,0), (0,1), (1,1) and w = (1,0): mu = (1,0,0) is valid, but A^T+ w (eta = 0) has a negative entry."""
    normals, w = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]), np.array([1.0, 0.0])
    scene = Scene(normals, np.zeros(3), np.eye(2), np.zeros(2), w, np.zeros(2), np.ones(3, dtype=bool))
    minimum_norm = np.linalg.pinv(normals.T) @ w
    assert minimum_norm.min() < -0.3
    paper = papers_omega(scene)
    assert paper.depth(w) == pytest.approx(0, abs=1e-9)  # inside, on the boundary of the first quadrant
    without_eta = Lifted(paper.T, np.zeros((len(paper.r), 0)), paper.r)
    assert without_eta.depth(w) < -0.3
    region = critical_region(*scene.tensors)
    assert bool(region.contains(torch.from_numpy(w), tolerance=1e-12))
    # Of a fan of directions over the true set, the first quadrant, eta = 0 keeps the middle and loses the rest.
    angles = np.linspace(0.01, np.pi / 2 - 0.01, 99)
    fan = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    assert bool(region.contains(torch.from_numpy(fan)).all())
    kept = np.mean([without_eta.depth(theta) >= 0 for theta in fan])
    assert 0.3 < kept < 0.5
