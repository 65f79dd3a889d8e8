"""The inverse-optimal set: sound for every error within its bound, and no larger than it must be.

Soundness by sampling, errors at the bound included; tightness against the Minkowski sum cone (+) ball, whose distance
function is computed here by brute force.
"""

import math
from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.problems import CASES, Scene, batch, exact, paper_case, random_scene, rotated, slack, true_thetas
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.critical_region import critical_region
from torchfsid.identification.inverse_optimal import inverse_optimal_set
from torchfsid.robots.bounds import NoiseBound
from torchfsid.sets.polygon import Polygon

FAN_EXCESS = 1 / math.cos(math.pi / 16)
"""A disc's polygon of 16 sides reaches this much further."""

ROWS = 8


def measured(scene: Scene, u: np.ndarray, noise: NoiseBound) -> Halfspaces:
    """The sets for many measured controls u (K, 2) of one scene, rows padded to `ROWS`."""
    count, m = len(u), len(scene.b)
    A, b = torch.zeros(count, ROWS, 2, dtype=torch.float64), torch.ones(count, ROWS, dtype=torch.float64)
    A[:, :m], b[:, :m] = torch.from_numpy(scene.A), torch.from_numpy(scene.b)
    C, d = torch.from_numpy(scene.C).expand(count, -1, -1), torch.from_numpy(scene.d).expand(count, -1)
    return inverse_optimal_set(Halfspaces(A, b), torch.from_numpy(u), C, d, noise)


def errors(scene: Scene, rng: np.random.Generator, count: int) -> np.ndarray:
    """Vectors of length at most 1: a third anywhere, two thirds of length 1, half of these straight at or off a row."""
    angles = rng.uniform(0, 2 * np.pi, count)
    e = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    e[::3] *= np.sqrt(rng.uniform(0, 1, len(e[::3])))[:, None]
    normals = scene.A / np.linalg.norm(scene.A, axis=-1, keepdims=True)
    first = np.flatnonzero(scene.active)[:1] if scene.active.any() else [0]
    chosen = rng.choice(np.concatenate([np.repeat(first, len(normals)), np.arange(len(normals))]), len(e[1::3]))
    e[1::3] = normals[chosen] * rng.choice([-1, 1], (len(chosen), 1))
    return e


def lost(scene: Scene, u: np.ndarray, noise: NoiseBound) -> int:
    """For how many of the measured controls the set does not hold the truth, but for round-off."""
    theta = measured(scene, u, noise)
    return int((~theta.contains(torch.from_numpy(scene.theta).expand(len(u), -1), tolerance=1e-9)).sum())


# Sound --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delta", [0.3, 1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("p", [2, 3])
def test_truth_is_inside_for_every_error_within_the_bound(delta: float, p: int):
    """8 x 100 scenes x 30 errors: 24 000 checks. u* is daqp's, to 1e-12, which is left of the bound."""
    rng, total = np.random.default_rng([p, round(1 / delta)]), 0
    for k in range(100):
        scene = random_scene(rng, 1 + k % ROWS, p)
        total += lost(scene, scene.u + (delta - 1e-12) * errors(scene, rng, 30), NoiseBound(delta))
    assert total == 0


@pytest.mark.parametrize("case", CASES)
def test_truth_is_inside_for_errors_as_large_as_the_bound(case: str):
    """9 x 30 scenes x 30 errors. u* is exact here, and |u - u*| <= delta is decided in rationals: nothing of the bound
    is left, and a row that the error has moved off by all of it must not be missed by round-off."""
    rng, delta, checked, total = np.random.default_rng(CASES.index(case)), 0.1, 0, 0
    for _ in range(30):
        scene = paper_case(case, rng)
        u = scene.u + delta * errors(scene, rng, 30)
        u = u[
            [
                sum((p - q) ** 2 for p, q in zip(exact(row), exact(scene.u), strict=True)) <= Fraction(delta) ** 2
                for row in u
            ]
        ]
        checked += len(u)
        total += lost(scene, u, NoiseBound(delta))
    assert checked > 500
    assert total == 0


@pytest.mark.parametrize("case", CASES)
def test_exact_measurement_needs_no_bound(case: str):
    """`NoiseBound(0)`: an exact control on a row's boundary touches it, whatever side round-off puts it on."""
    rng = np.random.default_rng(80 + CASES.index(case))
    scenes = [rotated(paper_case(case, rng), rng.uniform(0, 2 * np.pi)) for _ in range(30)]
    assert sum(lost(scene, scene.u[None], NoiseBound(0.0)) for scene in scenes) == 0


def test_slack_has_a_bound_of_its_own():
    """A solver that keeps 0.2 m/s off a row it should touch; the rest of the control is exact."""
    a, u = np.array([3.0, 4.0]), np.array([0.48, 0.64])
    scene = Scene(a[None], np.array([5.0]), np.eye(2), np.zeros(2), a, u, np.array([True]))
    assert slack(scene.A, scene.b, u) == pytest.approx(0.2)
    assert lost(scene, u[None], NoiseBound(0.01, slack=0.21)) == 0
    assert lost(scene, u[None], NoiseBound(0.01, slack=0.19)) == 1
    assert NoiseBound(0.01) == NoiseBound(0.01, slack=0.01)


def test_violated_soft_rows_count_as_active():
    """min |u - uhat|^2 + weight max(0, a.u - b)^2 over-steps its row, and uhat - u is still along a."""
    rng = np.random.default_rng(9)
    for _ in range(50):
        angle, weight, depth = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 20), rng.uniform(0.5, 5)
        a, theta = np.array([np.cos(angle), np.sin(angle)]), rng.normal(size=2)
        u = theta - weight / (1 + weight) * depth * a
        scene = Scene(a[None], np.array([a @ theta - depth]), np.eye(2), np.zeros(2), theta, u, np.array([True]))
        assert slack(scene.A, scene.b, u) < -0.02
        assert lost(scene, u[None], NoiseBound(1e-6)) == 0


@pytest.mark.parametrize("bounds", [(-1e-3,), (1e-3, -1e-3), (math.nan,)])
def test_bounds_are_not_negative(bounds: tuple[float, ...]):
    with pytest.raises(InputError, match="noise"):
        NoiseBound(*bounds)


# Tight --------------------------------------------------------------------------------------------------------------


def test_without_noise_it_is_inside_the_critical_region():
    """Exact data, bound 1e-6: no further outside than the bound, stretched by the fan, is in theta (C = gain I)."""
    rng, delta = np.random.default_rng(10), 1e-6
    scenes = [paper_case(case, rng) for case in CASES for _ in range(10)]
    scenes += [random_scene(rng, 1 + k % ROWS) for k in range(200)]
    for scene in scenes:
        assert (scene.active | (slack(scene.A, scene.b, scene.u) > 2 * delta)).all()
    safe_controls, active, u, C, d = batch(scenes)
    polygon = clipped(inverse_optimal_set(safe_controls, u, C, d, NoiseBound(delta)), true_thetas(scenes), 5.0)
    region = critical_region(safe_controls, active, C, d).normalised()
    outside = (region.A @ polygon.vertices.transpose(1, 2) - region.b.unsqueeze(-1)).amax((1, 2))
    assert (outside < FAN_EXCESS * delta / C[:, 0, 0] + 1e-12).all()


def clipped(theta: Halfspaces, around: Tensor, half: float) -> Polygon:
    box, time = Polygon.from_box(around - half, around + half), torch.zeros_like(theta.b)
    return box.clip(theta.A, theta.b, time, torch.zeros_like(theta.b).long(), most=theta.rows + 4).body


CONES = {
    "none": [],
    "ray": [(2.0, 1.0)],
    "ray, twice": [(2.0, 1.0), (6.0, 3.0)],
    "pointed, narrow": [(1.0, 0.0), (1.0, 0.2)],
    "pointed, wide": [(1.0, 0.0), (-1.0, 0.5)],
    "pointed, of three": [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0)],
    "half-plane": [(1.0, 2.0), (-2.0, 1.0), (2.0, -1.0)],
    "line": [(1.0, 2.0), (-3.0, -6.0)],
    "plane": [(1.0, 0.0), (-1.0, 2.0), (-1.0, -3.0)],
}


def distance_to_cone(generators: np.ndarray, y: np.ndarray) -> np.ndarray:
    """0 where y is a combination of two generators; else the distance to the nearest ray, or to the origin."""
    distance = np.linalg.norm(y, axis=-1)
    for ray in generators / np.linalg.norm(generators, axis=-1, keepdims=True):
        along = np.maximum(y @ ray, 0)
        distance = np.minimum(distance, np.linalg.norm(y - along[:, None] * ray, axis=-1))
    for v, w in combinations(generators, 2):
        determinant = v[0] * w[1] - v[1] * w[0]
        if determinant != 0:
            first = (y[:, 0] * w[1] - y[:, 1] * w[0]) / determinant
            second = (v[0] * y[:, 1] - v[1] * y[:, 0]) / determinant
            distance[(first >= 0) & (second >= 0)] = 0
    return distance


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.5])
@pytest.mark.parametrize("kind", CONES)
def test_outer_polygon_of_the_minkowski_sum(kind: str, angle: float):
    """On a grid of 200 x 200 points over a box of 6 bounds: contains the sum, and reaches out of it by at most 2 %."""
    delta, half = 0.1, 0.3
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    generators = np.array(CONES[kind]).reshape(-1, 2) @ turn.T
    scene = Scene(generators, np.zeros(len(generators)), np.eye(2), np.zeros(2), np.zeros(2), np.zeros(2), np.ones(0))
    theta = measured(scene, np.zeros((1, 2)), NoiseBound(delta))
    axis = (np.arange(200) + 0.5) / 200 * 2 * half - half
    y = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    distance = distance_to_cone(generators, y)
    inside = contained(theta, y)
    assert inside[distance <= delta].all()
    assert (distance[inside] <= FAN_EXCESS * delta * (1 + 1e-12)).all()
    area = float(clipped(theta, torch.zeros(1, 2, dtype=torch.float64), half).volume())
    exact = (distance <= delta).mean() * (2 * half) ** 2
    assert area <= 1.03 * exact
    assert area == pytest.approx(inside.mean() * (2 * half) ** 2, rel=0.01)


def contained(theta: Halfspaces, y: np.ndarray) -> np.ndarray:
    return (torch.from_numpy(y) @ theta.A[0].T <= theta.b[0]).all(-1).numpy()
