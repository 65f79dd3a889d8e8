"""Polytopes for the tests: boxes, random and thin sets, what they consist of, and their exact vertices."""

import itertools
import math
from fractions import Fraction

import numpy as np
import torch
from torch import Tensor

from torchfsid.outcome import Status
from torchfsid.sets.body import Clipped
from torchfsid.sets.polyhedron import Polyhedron
from torchfsid.sets.polytope import Polytope

Solid = Polyhedron | Polytope

BOX = 10.0
"""Half the side of the boxes that the sets begin with: the size their round-off is measured against."""

DIMENSIONS = [1, 3, 4, 5]


def tensor(values: object) -> Tensor:
    return torch.as_tensor(np.asarray(values, dtype=float))


def kind_for(p: int) -> type[Polyhedron] | type[Polytope]:
    return Polyhedron if p == 3 else Polytope


def box(p: int, half: float = BOX, count: int = 1) -> Solid:
    return kind_for(p).from_box(tensor(np.full((count, p), -half)), tensor(np.full((count, p), half)))


def cut(polytope: Solid, A: np.ndarray, b: np.ndarray, time: float = 0.0) -> Clipped:
    """Clip by rows (R, p), the same for every item, or (B, R, p)."""
    B = len(polytope.count)
    rows, right = tensor(A).expand(B, *A.shape[-2:]), tensor(b).expand(B, b.shape[-1])
    stamp = torch.full_like(right, time)
    return polytope.clip(rows, right, stamp, torch.arange(b.shape[-1]).expand(right.shape), 1000)


def rows_of(polytope: Solid, item: int = 0) -> tuple[np.ndarray, np.ndarray]:
    count = int(polytope.count[item])
    return polytope.A[item, :count].numpy(), polytope.b[item, :count].numpy()


def points_of(polytope: Solid, item: int = 0) -> np.ndarray:
    return polytope.vertices[item, : int(polytope.vertex_count[item])].numpy()


def rows_around(rng: np.random.Generator, truth: np.ndarray, rows: int, slack: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of all scales that hold at `truth`, their boundaries at about `slack` from it."""
    A = rng.normal(size=(rows, len(truth))) * np.exp(rng.normal(size=(rows, 1)))
    return A, A @ truth + slack * rng.exponential(size=rows) * np.linalg.norm(A, axis=1)


def random_set(
    rng: np.random.Generator, p: int, rows: int = 8, width: float = 1.0
) -> tuple[Solid, np.ndarray, np.ndarray]:
    """A set, and all the rows that made it; below width 1, two rows close in on it to about `width`."""
    truth = rng.uniform(-0.6 * BOX, 0.6 * BOX, p)
    A, b = rows_around(rng, truth, rows, 3.0)
    if width < 1:
        A[1] = -A[0] + 0.01 * width * np.linalg.norm(A[0]) * rng.normal(size=p)
        b[:2] = A[:2] @ truth + width / 2 * np.linalg.norm(A[:2], axis=1)
    before = box(p)
    after = cut(before, A, b)
    assert after.outcome == Status.OK
    sides, ends = rows_of(before)
    return after.body, np.vstack([A, sides]), np.append(b, ends)


def frame(body: Solid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre, axes (in rows) and scale: z = centre + (y * scale) axes."""
    points, centre = points_of(body), body.centroid()[0].numpy()
    _, spread, axes = np.linalg.svd(points - centre, full_matrices=False)
    return centre, axes, spread / math.sqrt(len(points))


def width_along(points: np.ndarray, direction: np.ndarray) -> float:
    return float(np.ptp(points @ direction))


def solve_exactly(matrix: list[list[Fraction]]) -> list[Fraction] | None:
    """Gauss-Jordan on (p, p + 1); None if singular."""
    rows, p = [list(row) for row in matrix], len(matrix)
    for k in range(p):
        pivot = next((i for i in range(k, p) if rows[i][k] != 0), None)
        if pivot is None:
            return None
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [entry / rows[k][k] for entry in rows[k]]
        for i in range(p):
            if i != k and rows[i][k] != 0:
                factor = rows[i][k]
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[-1] for row in rows]


def exact_vertices(A: np.ndarray, b: np.ndarray) -> list[list[Fraction]]:
    """All vertices of {z : A z <= b}, each float taken as the rational number that it is."""
    rows = [[Fraction(x) for x in row] + [Fraction(c)] for row, c in zip(A.tolist(), b.tolist(), strict=True)]
    found = []
    for chosen in itertools.combinations(rows, A.shape[1]):
        z = solve_exactly(list(chosen))
        if z is not None and all(sum(a * x for a, x in zip(row, z, strict=False)) <= row[-1] for row in rows):
            found.append(z)
    return found
