"""Sets on which active-set searches lose their way: nearly parallel rows, slabs, needles, prisms, ties."""

import numpy as np
from numpy.typing import NDArray

Rows = tuple[NDArray[np.float64], NDArray[np.float64]]


def in_box(A: NDArray[np.float64], b: NDArray[np.float64], half: float = 5.0) -> Rows:
    p = A.shape[1]
    return np.concatenate([A, np.eye(p), -np.eye(p)]), np.concatenate([b, np.full(2 * p, half)])


def parallelogram(rng: np.random.Generator, p: int, angle: float, integers: bool) -> Rows:
    """Pairs of opposite rows, half a unit from the centre, with `angle` between the pairs; a third of the sets lacks a
    row, a third has one twice."""
    centre, first = rng.uniform(-2, 2, p), rng.normal(size=p)
    first /= np.linalg.norm(first)
    if integers:
        first = np.round(3 * first / max(angle, 1e-6)) + (np.arange(p) == 0)
    rows, bounds = [], []
    for k in range(max(2, int(rng.integers(2, p + 1)) if p > 1 else 2)):
        n = first if k == 0 else first + (rng.integers(-1, 2, p) if integers else angle * rng.normal(size=p))
        n = n if n.any() else np.ones(p)
        half = 0.5 * rng.uniform(0.9, 1.1) * np.linalg.norm(n)
        rows += [n, -n]
        bounds += [v.round() if integers else v for v in (n @ centre + half, half - n @ centre)]
    A, b = np.array(rows), np.array(bounds)
    kind, one = rng.integers(3), rng.integers(len(b))
    if kind == 0 and p > 1:
        A, b = np.delete(A, one, axis=0), np.delete(b, one)
    if kind == 1:
        A, b = np.concatenate([A, 3.7 * A[one : one + 1]]), np.append(b, 3.7 * b[one])
    return in_box(A, b)


def needle(rng: np.random.Generator, p: int, width: float, far: float) -> Rows:
    """A bounded set of size 1 in one direction and `width` in the others, turned, about `far` from the origin."""
    turn, _ = np.linalg.qr(rng.normal(size=(p, p)))
    squeeze = np.diag(1 / np.where(np.arange(p) < max(1, p - 1), width, 1.0)) @ turn.T
    A = np.concatenate([rng.normal(size=(3, p)), np.eye(p), -np.eye(p)]) @ squeeze
    return A, rng.uniform(0.3, 1, 3 + 2 * p) + A @ (far * rng.choice([-1.0, 1.0], p))


def prism(rng: np.random.Generator, p: int, sides: int, far: float) -> Rows:
    """A regular polygon, the same everywhere along the other directions, turned: many centres, many ties."""
    turn, _ = np.linalg.qr(rng.normal(size=(p, p)))
    angles = 2 * np.pi * np.arange(sides) / sides
    A = np.zeros((sides, p))
    A[:, 0] = np.cos(angles)
    A[:, 1 % p] = np.sin(angles) if p > 1 else np.cos(angles)
    A, b = in_box(A, np.ones(sides), 2.0)
    A = A @ turn.T
    return A, b + A @ (far * rng.choice([-1.0, 1.0], p))


def hard_sets(p: int, each: int, seed: int = 0) -> list[Rows]:
    """`each` sets of every kind."""
    rng = np.random.default_rng([p, seed])
    sets = []
    for angle in (1e-1, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8, 1e-10, 1e-12):
        sets += [parallelogram(rng, p, angle, integers) for integers in (True, False) for _ in range(each)]
    for width in (1e-2, 1e-4, 1e-6):
        sets += [needle(rng, p, width, far) for far in (0.0, 1e3) for _ in range(each)]
    return sets + [prism(rng, p, int(rng.integers(3, 12)), far) for far in (0.0, 1e3, 1e6) for _ in range(each)]


def padded(sets: list[Rows]) -> Rows:
    """One batch of them, short ones filled up with rows 0.z <= 1."""
    m = max(len(b) for _, b in sets)
    fill = [(np.pad(A, ((0, m - len(b)), (0, 0))), np.pad(b, (0, m - len(b)), constant_values=1.0)) for A, b in sets]
    return np.stack([A for A, _ in fill]), np.stack([b for _, b in fill])
