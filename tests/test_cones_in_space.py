"""Outward normals in space against non-negative least squares, which gives the distance of a point to the cone."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from tests.scenes_in_space import cone, unit
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.inverse_optimal import normals_of
from torchfsid.identification.normals import outward_normals
from torchfsid.robots.bounds import RowErrors

LOOSE = 2e-12
"""A normal may leave the polar cone by this angle, so a point of the cone may be beyond it by this times the sum of its
multipliers."""

CLEAR = 1e-6
"""A point farther than this from the cone, relative to its length, is beyond a normal."""


def disagreements(seed: int, count: int) -> tuple[int, int, int]:
    """(points, of the cone and cut off, clear of the cone and not cut off) for `count` cones."""
    rng = np.random.default_rng(seed)
    cones = [cone(rng) for _ in range(count)]
    rows, present = torch.zeros(count, 12, 3, dtype=torch.float64), torch.zeros(count, 12, dtype=torch.bool)
    for i, of in enumerate(cones):
        rows[i, : len(of)], present[i, : len(of)] = torch.from_numpy(of), True
    normals = outward_normals(rows, present, 17).normals.numpy()
    points = cut = kept = 0
    for a, n in zip(cones, normals, strict=True):
        inside = (rng.exponential(size=(2, len(a))) * (rng.uniform(size=(2, len(a))) < 0.5)) @ a
        beside = inside[1] + 10.0 ** rng.uniform(-6, 0) * rng.normal(size=3)
        for w in (rng.normal(size=3), inside[0], beside):
            if (size := np.linalg.norm(w)) < 1e-9:
                continue
            multipliers, away = nnls(a.T, w / size, maxiter=1000)
            beyond, room = float((n @ w).max(initial=0.0)) / size, LOOSE * (1 + multipliers.sum())
            points, cut, kept = points + 1, cut + (beyond > away + room), kept + (away > CLEAR and beyond <= 0)
    return points, cut, kept


def test_normals_describe_the_cone() -> None:
    points, cut, kept = disagreements(0, 3000)
    assert points > 8000
    assert (cut, kept) == (0, 0)


@pytest.mark.parametrize("angle", [1e-4, 0.1, 0.7, 1.4, 1.6, 2.5])
def test_rows_of_uncertain_direction(angle: float) -> None:
    """Every row turned by up to the angle is in the cone of its normals, and from a right angle on all of space is."""
    rng = np.random.default_rng(1)
    a, towards = unit(rng.normal(size=(200, 3))), rng.normal(size=(200, 50, 3))
    aside = unit(towards - (towards * a[:, None]).sum(-1, keepdims=True) * a[:, None])
    turn = angle * np.maximum(rng.uniform(size=(200, 50, 1)), rng.uniform(size=(200, 50, 1)) < 0.5)
    turned = np.cos(turn) * a[:, None] + np.sin(turn) * aside
    rows = Halfspaces(torch.from_numpy(a)[:, None], torch.zeros(200, 1, dtype=torch.float64))
    told = RowErrors(torch.full((200, 1), angle, dtype=torch.float64), torch.zeros(200, 1, dtype=torch.float64))
    outward = normals_of(rows, torch.ones(200, 1, dtype=torch.bool), told)
    beyond = outward.normals.numpy() @ turned.transpose(0, 2, 1)
    assert beyond.max() < LOOSE
    assert bool((outward.normals == 0).all()) == (angle >= math.pi / 2)
    looser = math.atan(math.tan(angle) / math.cos(math.pi / 6)) if angle < math.pi / 2 else math.pi
    opposite = -np.cos(looser + 1e-6) * a - np.sin(looser + 1e-6) * aside[:, 0]
    if angle < math.pi / 2:
        assert (outward.normals.numpy() @ -opposite[..., None]).max(axis=(1, 2)).min() > 0


@pytest.mark.parametrize(
    ("rows", "opening"),
    [
        ([], 2 * math.pi),
        ([(0, 0, 1)], math.pi),
        ([(0, 0, 1), (0, 0, -1)], 0),
        ([(1, 0, 0), (0, 1, 0), (0, 0, 1)], 2 * math.asin(3**-0.5)),
    ],
)
def test_opening(rows: list[tuple[int, int, int]], opening: float) -> None:
    a = torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)
    found = float(outward_normals(a, torch.ones(len(a), dtype=torch.bool), 17).opening)
    assert found <= opening + 1e-9
    assert found >= 0.6 * opening


def test_gradients_of_normals() -> None:
    rng = np.random.default_rng(2)
    A = torch.from_numpy(rng.normal(size=(3, 3, 3))).requires_grad_()

    def normals(A: torch.Tensor) -> torch.Tensor:
        a = A / A.norm(dim=-1, keepdim=True)
        return outward_normals(a, torch.ones(3, 3, dtype=torch.bool), 17).normals

    assert torch.autograd.gradcheck(normals, A)
    assert torch.autograd.gradgradcheck(normals, A)
