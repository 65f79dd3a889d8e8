"""Robots in space at one instant, with QPs whose answers are known: `tests.problems` in three dimensions."""

from __future__ import annotations

import numpy as np

from tests.problems import Scene, is_active, solve_qp

DEPENDENT = {
    # Small integers: with u in eighths, a.u is exact, so that dependent rows really meet.
    "A": [],
    "B": [(3, 1, 2)],
    "C same side": [(2, -1, 1), (4, -2, 2)],
    "C opposite": [(2, -1, 1), (-4, 2, -2)],
    "D rank 2": [(3, 1, 0), (-1, 2, 1)],
    "D rank 3": [(3, 1, 0), (-1, 2, 1), (1, 0, 2)],
    "E wedge": [(1, 0, 2), (0, 1, 1), (1, 1, 3)],
    "E plane": [(1, 0, 1), (-1, 2, -1), (0, -1, 0), (-1, 0, -1)],
    "E half-plane": [(1, 0, 1), (-1, 0, -1), (0, 1, 1)],
    "E half-space": [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (1, 1, 2)],
    "E pointed": [(1, 0, 2), (0, 1, 2), (-1, 0, 2), (0, -1, 2)],
    "E space": [(1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, -2, -1)],
}
"""Active rows by case and cone, in R^3."""


def random_scene(rng: np.random.Generator, rows: int, p: int = 3, crowded: float = 1.0) -> Scene:
    """A robot among `rows` obstacles, the paper's rows; standing still is safe.

    p = 3: the goal task. p = 4: unknown gain. Any other p: a random linear task.
    """
    x, gain = rng.normal(size=3), rng.uniform(0.5, 2.0)
    direction = rng.normal(size=(rows, 3))
    distance = 0.3 + rng.exponential(crowded, rows)
    A = distance[:, None] * direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    b = rng.uniform(0.5, 3.0) / 2 * (distance**2 - 0.25**2)
    if p == 3:
        C, d, theta = gain * np.eye(3), -gain * x, x + rng.normal(scale=3.0, size=3)
    elif p == 4:
        goal = x + rng.normal(scale=3.0, size=3)
        C, d, theta = np.column_stack([-x, np.eye(3)]), np.zeros(3), np.array([gain, *(gain * goal)])
    else:
        C, d, theta = rng.normal(size=(3, p)), rng.normal(size=3), rng.normal(scale=3.0, size=p)
    u = solve_qp(A, b, C @ theta + d)
    return Scene(A, b, C, d, theta, u, is_active(A, b, u))


def scene_of(name: str, rng: np.random.Generator, inactive: int = 3) -> Scene:
    """A scene with the active rows of one of `DEPENDENT`, and `inactive` others clear of the control."""
    active_rows = np.array(DEPENDENT[name], dtype=float).reshape(-1, 3)
    u = rng.integers(-8, 9, 3) / 8
    others = rng.normal(size=(inactive, 3))
    A = np.concatenate([active_rows, others])
    b = A @ u
    b[len(active_rows) :] += rng.uniform(0.3, 1.5, inactive) * np.linalg.norm(others, axis=-1)
    multipliers = rng.uniform(0.1, 1.0, len(active_rows))
    gain, x = rng.uniform(0.5, 2.0), rng.normal(size=3)
    theta = x + (u + multipliers @ active_rows) / gain
    active = np.arange(len(A)) < len(active_rows)
    order = rng.permutation(len(A))
    return Scene(A[order], b[order], gain * np.eye(3), -gain * x, theta, u, active[order])


def cone(rng: np.random.Generator) -> np.ndarray:
    """1 to 12 unit generators: rays, lines, wedges, planes, half-spaces, spaces, needles, or nothing special."""

    def some(count: int) -> np.ndarray:
        return unit(rng.normal(size=(count, 3)))

    count, kind = int(rng.integers(1, 13)), int(rng.integers(0, 11))
    if kind == 0:
        return np.repeat(some(1), count, axis=0)
    if kind == 1:
        return some(1) * rng.choice([-1, 1], (count, 1))
    if kind == 2:
        return unit(rng.uniform(0.05, 1, (count, 2)) @ some(2))
    if kind == 3:
        return unit(rng.normal(size=(count, 2)) @ some(2))
    if kind == 4:
        return np.concatenate([unit(rng.normal(size=(count, 2)) @ some(2)), some(1)])[-12:]
    if kind == 5:
        return unit(some(1) + 10.0 ** rng.uniform(-7, -1) * rng.normal(size=(count, 3)))
    if kind == 6:
        return unit(some(1) + 10.0 ** rng.uniform(-4, -1) * rng.normal(size=(count, 3))) * rng.choice(
            [-1, 1], (count, 1)
        )
    if kind == 7:
        rows = some(count)
        return np.where(rows[:, 2:] < 0, -rows, rows)
    if kind == 8:
        return np.concatenate([np.eye(3), -np.eye(3)])[rng.permutation(6)[:count]]
    if kind == 9:
        rows = rng.integers(-2, 3, (count, 3)).astype(float)
        return unit(rows[(rows != 0).any(-1)]) if rows.any() else some(1)
    return some(count)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
