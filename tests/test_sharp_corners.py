"""Corners too sharp for floating point: a set that holds a point in exact arithmetic is never called empty."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch

from torchfsid.halfspaces import Halfspaces
from torchfsid.outcome import Status
from torchfsid.sets.feasible_set import FeasibleSet

Rows = tuple[np.ndarray, np.ndarray]


def exactly_at(row: np.ndarray, point: np.ndarray) -> float:
    """The least float b with row.point <= b, in rational arithmetic."""
    value = sum(Fraction(a) * Fraction(z) for a, z in zip(row.tolist(), point.tolist(), strict=True))
    b = float(value)
    while Fraction(b) < value:
        b = float(np.nextafter(b, np.inf))
    return b


def needle(rng: np.random.Generator, half: float) -> tuple[np.ndarray, Rows]:
    """A truth at the apex of two rows, `half` [rad] from opposite ones, and on a third one across them."""
    truth, turn = rng.uniform(-1, 1, 2), rng.uniform(0, 2 * np.pi)
    angle = turn + np.array([np.pi / 2 - half, -np.pi / 2 + half, np.pi + rng.uniform(-1, 1) * half])
    A = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return truth, (A, np.array([exactly_at(row, truth) for row in A]))


@pytest.mark.parametrize("half", [1e-1, 1e-3, 1e-5, 1e-8, 1e-11])
def test_a_truth_at_the_apex_is_not_refuted(half: float) -> None:
    rng = np.random.default_rng(7)
    truths, rows = zip(*(needle(rng, half) for _ in range(300)), strict=True)
    A, b = (torch.from_numpy(np.stack(part)) for part in zip(*rows, strict=True))
    corner = torch.full((300, 2), 2.0, dtype=torch.float64)
    after = FeasibleSet.from_box(-corner, corner).intersect(Halfspaces(A, b))
    assert not bool((after.outcome == Status.EMPTY).any())
    assert bool(after.contains(torch.from_numpy(np.stack(truths))).all())


@pytest.mark.parametrize("half", [1e-1, 1e-3, 1e-5])
def test_what_is_surely_beyond_the_apex_is_refuted(half: float) -> None:
    """By a hundred times what the apex may be off; the rows are those given, and a combination of them proves it."""
    rng = np.random.default_rng(8)
    _, rows = zip(*(needle(rng, half) for _ in range(100)), strict=True)
    A, b = (torch.from_numpy(np.stack(part)) for part in zip(*rows, strict=True))
    b[:, 2] -= 1e-13 / half
    corner = torch.full((100, 2), 2.0, dtype=torch.float64)
    after = FeasibleSet.from_box(-corner, corner).intersect(Halfspaces(A, b))
    assert bool(after.is_empty.all())
    assert after.contradiction.source.sort(-1).values.tolist() == [[0, 1, 2]] * 100
