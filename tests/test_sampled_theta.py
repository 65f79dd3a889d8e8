"""Check 1: theta is inside the critical region exactly if the QP solved at theta (daqp) has the region's active set.

Thetas so near a boundary that round-off decides are left out, by an explicit margin, counted, and few.
"""

import numpy as np
import pytest
import torch

from tests.problems import ACTIVE, CASES, Scene, paper_case, random_scene, slack, solve_qp
from torchfsid.identification.critical_region import critical_region

MARGIN = 1e-7
"""A theta nearer to a half-space's boundary, or a row nearer to its own [m/s], is left to round-off."""


def agreement(scene: Scene, thetas: np.ndarray) -> tuple[int, int, int]:
    """(mismatches, left out, inside) over the thetas, each solved by daqp."""
    region = critical_region(*scene.tensors)
    to_boundary = region.slack(torch.from_numpy(thetas)).numpy()
    inside = (to_boundary >= 0).all(-1)
    u = np.array([solve_qp(scene.A, scene.b, nominal) for nominal in scene.nominal(thetas)])
    to_row = np.abs(slack(scene.A, scene.b, u))
    same = ((to_row < ACTIVE) == scene.active).all(-1)
    unclear = (np.abs(to_boundary) < MARGIN).any(-1) | ((to_row >= ACTIVE) & (to_row < MARGIN)).any(-1)
    return int(((inside != same) & ~unclear).sum()), int(unclear.sum()), int((inside & same).sum())


def thetas_around(scene: Scene, rng: np.random.Generator, count: int) -> np.ndarray:
    """Half of them near the true theta, so that both answers are common; half all over the place."""
    p = len(scene.theta)
    scale = np.where(np.arange(count) % 2 == 0, 0.4, 4.0)
    return scene.theta + scale[:, None] * rng.normal(size=(count, p))


def check(scenes: list[Scene], rng: np.random.Generator, per_scene: int, everywhere: bool = False) -> None:
    counts = np.array([agreement(scene, thetas_around(scene, rng, per_scene)) for scene in scenes])
    samples = len(scenes) * per_scene
    mismatches, left_out, inside = counts.sum(0)
    assert mismatches == 0
    assert left_out < 1e-4 * samples + 1
    if everywhere:
        assert inside == samples
    else:
        assert 0.1 * samples < inside < 0.9 * samples  # neither answer is rare, so the check could have failed


@pytest.mark.parametrize("rows", range(1, 9))
def test_critical_region_is_where_the_qp_has_its_active_set(rows: int):
    """8 x 50 scenes of the goal task, 20 000 samples, up to 8 obstacles."""
    rng = np.random.default_rng(rows)
    check([random_scene(rng, rows) for _ in range(50)], rng, per_scene=50)


@pytest.mark.parametrize("p", [1, 3, 5])
def test_with_parameters_of_another_dimension(p: int):
    """3 x 3 000 samples; p = 3 is the goal task with unknown gain."""
    rng = np.random.default_rng(100 + p)
    check([random_scene(rng, int(rng.integers(1, 9)), p) for _ in range(60)], rng, per_scene=50)


@pytest.mark.parametrize("case", CASES)
def test_in_each_of_the_papers_cases(case: str):
    """9 x 1 000 samples; in C and E, which random scenes never reach, rows really meet in one line or point."""
    rng = np.random.default_rng(CASES.index(case))
    scenes = [paper_case(case, rng) for _ in range(20)]
    for scene in scenes:
        assert np.allclose(solve_qp(scene.A, scene.b, scene.nominal(scene.theta)), scene.u, atol=1e-9)
    # Three rows whose cone is the plane leave a single safe control: every theta has this active set.
    check(scenes, rng, per_scene=50, everywhere=case == "E three whole plane")


@pytest.mark.parametrize("turn", [0.0, np.pi], ids=["same side", "opposite"])
@pytest.mark.parametrize("angle", 10.0 ** -np.arange(2, 13))
def test_truth_is_inside_for_rows_at_any_angle(angle: float, turn: float):
    """Two active rows, down to angles where their intersection is lost in round-off and they had better be one."""
    rng = np.random.default_rng(5)
    for _ in range(100):
        first = rng.uniform(0, 2 * np.pi)
        directions = np.array([first, first + turn + angle, rng.uniform(0, 2 * np.pi)])
        A = rng.uniform(0.5, 3, (3, 1)) * np.stack([np.cos(directions), np.sin(directions)], axis=-1)
        u, multipliers = rng.normal(size=2), rng.uniform(0.1, 1, 2)
        theta, active = u + multipliers @ A[:2], np.array([True, True, False])
        scene = Scene(A, A @ u + np.array([0, 0, 1.0]), np.eye(2), np.zeros(2), theta, u, active)
        assert bool(critical_region(*scene.tensors).contains(torch.from_numpy(theta), tolerance=1e-9))
