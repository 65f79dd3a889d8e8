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
from tests.problems import CASES, Scene, exact, paper_case, random_scene, rotated, slack
from torch import Tensor

from torchfsid.clipping import clip
from torchfsid.critical_region import critical_region
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.inverse_optimal import NoiseBound, inverse_optimal_set
from torchfsid.polygon import Polygon

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
    """Vectors of length at most 1: a third anywhere, a third of length 1, a third of length 1 straight at or off a row."""
    angles = rng.uniform(0, 2 * np.pi, count)
    e = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    e[::3] *= np.sqrt(rng.uniform(0, 1, len(e[::3])))[:, None]
    normals = scene.A / np.linalg.norm(scene.A, axis=-1, keepdims=True)
    first = np.flatnonzero(scene.active)[:1] if scene.active.any() else [0]
    chosen = rng.choice(np.concatenate([np.repeat(first, len(normals)), np.arange(len(normals))]), len(e[1::3]))
    e[1::3] = normals[chosen] * rng.choice([-1, 1], (len(chosen), 1))
    return e


# Sound --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delta", [0.3, 1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("p", [2, 3])
def test_truth_is_inside_for_every_error_within_the_bound(delta: float, p: int):
    """8 x 100 scenes x 30 errors: 24 000 checks. u* is daqp's, to 1e-12, which is left of the bound."""
    rng = np.random.default_rng([p, round(1 / delta)])
    lost = 0
    for k in range(100):
        scene = random_scene(rng, 1 + k % ROWS, p)
        theta = measured(scene, scene.u + (delta - 1e-12) * errors(scene, rng, 30), NoiseBound(delta))
        lost += int((~theta.contains(torch.from_numpy(scene.theta), tolerance=1e-9)).sum())
    assert lost == 0


@pytest.mark.parametrize("case", CASES)
def test_truth_is_inside_for_errors_as_large_as_the_bound(case: str):
    """9 x 30 scenes x 30 errors. u* is exact here, and |u - u*| <= delta is decided in rationals: nothing is left of the
    bound, and a row that the error has moved off by all of it must not be missed by round-off."""
    rng, delta, checked, lost = np.random.default_rng(CASES.index(case)), 0.1, 0, 0
    for _ in range(30):
        scene = paper_case(case, rng)
        u = scene.u + delta * errors(scene, rng, 30)
        within = [(x - p) ** 2 + (y - q) ** 2 <= Fraction(delta) ** 2 for (x, y), (p, q) in
                  ((exact(row), exact(scene.u)) for row in u)]  # fmt: skip
        theta = measured(scene, u[within], NoiseBound(delta))
        lost += int((~theta.contains(torch.from_numpy(scene.theta), tolerance=1e-9)).sum())
        checked += sum(within)
    assert checked > 500
    assert lost == 0


@pytest.mark.parametrize("case", CASES)
def test_exact_measurement_needs_no_bound(case: str):
    """`NoiseBound(0)`: an exact control on a row's boundary touches it, whatever side round-off puts it on."""
    rng = np.random.default_rng(80 + CASES.index(case))
    scenes = [rotated(paper_case(case, rng), rng.uniform(0, 2 * np.pi)) for _ in range(30)]
    sets = [measured(scene, scene.u[None], NoiseBound(0.0)) for scene in scenes]
    lost = [not theta.contains(torch.from_numpy(scene.theta), tolerance=1e-9) for scene, theta in zip(scenes, sets, strict=True)]
    assert sum(lost) == 0


def test_slack_has_a_bound_of_its_own():
    """A solver that keeps 0.2 m/s off a row it should touch; the rest of the control is exact."""
    scene = Scene(np.array([[3.0, 4.0]]), np.array([5.0]), np.eye(2), np.zeros(2), np.array([3.0, 4.0]), np.array([0.48, 0.64]),
                  np.array([True]))  # fmt: skip
    assert slack(scene.A, scene.b, scene.u) == pytest.approx(0.2)
    truth = torch.from_numpy(scene.theta)
    assert measured(scene, scene.u[None], NoiseBound(0.01, slack=0.21)).contains(truth).all()
    assert not measured(scene, scene.u[None], NoiseBound(0.01, slack=0.19)).contains(truth).any()
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
        assert measured(scene, u[None], NoiseBound(1e-6)).contains(torch.from_numpy(theta)).all()


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
        clear = slack(scene.A, scene.b, scene.u) > 2 * delta
        assert (clear | scene.active).all()
        around = torch.from_numpy(scene.theta).unsqueeze(0)
        polygon = clipped(measured(scene, scene.u[None], NoiseBound(delta)), around, 5.0)
        outside = -critical_region(*scene.tensors).slack(polygon.vertices[0])
        assert outside.max() < FAN_EXCESS * delta / scene.C[0, 0] + 1e-12


def clipped(theta: Halfspaces, around: Tensor, half: float) -> Polygon:
    b = theta.b
    return clip(Polygon.from_box(around - half, around + half), theta.A, b, b.new_zeros(1), torch.zeros_like(b).long()).body


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
            first, second = (y[:, 0] * w[1] - y[:, 1] * w[0]) / determinant, (v[0] * y[:, 1] - v[1] * y[:, 0]) / determinant
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
