"""Derivatives at a corner in which more facets meet than dimensions: a row cuts the set through one of its vertices.

A quantity has one-sided derivatives in the bound of each row. Any gradient must lie between the two.
"""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.sets.feasible_set import FeasibleSet

STEP = 1e-6


def tensor(values: object) -> Tensor:
    return torch.as_tensor(np.asarray(values, dtype=float))


def intersected(A: Tensor, b: Tensor) -> FeasibleSet:
    corner = torch.full((*b.shape[:-1], A.shape[-1]), 9.0, dtype=torch.float64)
    return FeasibleSet.from_box(-corner, corner).intersect(Halfspaces(A, b))


def check(asked: Callable[[FeasibleSet], Tensor], A: np.ndarray, b: np.ndarray) -> None:
    """The gradient lies between the one-sided derivatives, row by row."""
    bound = tensor(b).requires_grad_()
    (slopes,) = torch.autograd.grad(asked(intersected(tensor(A), bound)), bound)

    def moved(step: float) -> np.ndarray:
        return asked(intersected(tensor(A), tensor(b + step * np.eye(len(b))))).numpy()

    now = float(asked(intersected(tensor(A), tensor(b))))
    inward, outward = (now - moved(-STEP)) / STEP, (moved(STEP) - now) / STEP
    found, room = slopes.numpy(), 2e-4 * (1 + np.abs(inward))
    assert (found >= np.minimum(inward, outward) - room).all(), (found, inward, outward)
    assert (found <= np.maximum(inward, outward) + room).all(), (found, inward, outward)


def rows_through(rng: np.random.Generator, A: np.ndarray, b: np.ndarray, corner: np.ndarray) -> tuple:
    """The rows and one or two more through a corner. Each keeps the origin and cuts off what is beyond."""
    more = rng.normal(size=(rng.integers(1, 3), A.shape[1]))
    more *= np.sign(more @ corner)[:, None]
    return np.vstack([A, more]), np.append(b, more @ corner)


@pytest.mark.parametrize("p", [2, 3, 4])
def test_support_and_diameter(p: int) -> None:
    """In directions from the normal cone of the corner, between some of its facets."""
    rng = np.random.default_rng(p)
    for _ in range({2: 10, 3: 20, 4: 5}[p]):
        A = rng.normal(size=(8, p))
        b = np.linalg.norm(A, axis=1) * rng.uniform(0.5, 1.5, 8)
        vertices = intersected(tensor(A), tensor(b)).vertices().numpy()
        apart = np.linalg.norm(vertices[:, None] - vertices, axis=-1)
        corner = vertices[apart.max(1).argmax()]
        A, b = rows_through(rng, A, b, corner)
        meeting = np.flatnonzero(np.abs(A @ corner - b) < 1e-9)
        some = rng.choice(meeting, size=min(p, len(meeting)), replace=False)
        direction = tensor(rng.exponential(size=len(some)) @ A[some])
        check(lambda sets, d=direction: sets.support(d.expand(*sets.batch_shape, p)), A, b)
        check(FeasibleSet.diameter, A, b)
