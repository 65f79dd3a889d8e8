"""Problems that know their own answer, and small independent solvers: the tests' second opinion, without torch.

A `Scene` is one robot at one instant: the rows A u <= b of its QP, its task uhat = C theta + d, and the true theta.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import daqp
import numpy as np
import torch
from torch import Tensor

from torchfsid.halfspaces import Halfspaces

ACTIVE = 1e-9
"""Slack of a solved QP below which a row is active [m/s]; the scenes' rows and controls are of order one."""

Point = tuple[Fraction, Fraction]


@dataclass(frozen=True)
class Scene:
    """A QP whose answer is known. `active` are the rows that hold with equality at the true theta's control."""

    A: np.ndarray
    b: np.ndarray
    C: np.ndarray
    d: np.ndarray
    theta: np.ndarray
    u: np.ndarray
    active: np.ndarray

    @property
    def safe_controls(self) -> Halfspaces:
        return Halfspaces(torch.from_numpy(self.A), torch.from_numpy(self.b))

    @property
    def tensors(self) -> tuple[Halfspaces, Tensor, Tensor, Tensor]:
        """(safe_controls, active, C, d), as `critical_region` takes them."""
        return self.safe_controls, torch.from_numpy(self.active), torch.from_numpy(self.C), torch.from_numpy(self.d)

    def nominal(self, theta: np.ndarray) -> np.ndarray:
        return theta @ self.C.T + self.d


# Scenes -------------------------------------------------------------------------------------------------------------


def random_scene(rng: np.random.Generator, rows: int, p: int = 2, crowded: float = 1.0) -> Scene:
    """A robot among `rows` obstacles, the paper's rows; standing still is safe, so the QP has a solution.

    p = 2: the goal task, C = kp I, d = -kp x. p = 3: unknown gain, C = [-x I]. Any other p: a random linear task.
    """
    x, gain = rng.normal(size=2), rng.uniform(0.5, 2.0)
    angles = rng.uniform(0, 2 * np.pi, rows)
    distance = 0.3 + rng.exponential(crowded, rows)
    away = -distance[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    A, b = -away, rng.uniform(0.5, 3.0) / 2 * (distance**2 - 0.25**2)
    if p == 2:
        C, d, theta = gain * np.eye(2), -gain * x, x + rng.normal(scale=3.0, size=2)
    elif p == 3:
        goal = x + rng.normal(scale=3.0, size=2)
        C, d, theta = np.column_stack([-x, np.eye(2)]), np.zeros(2), np.array([gain, *(gain * goal)])
    else:
        C, d, theta = rng.normal(size=(2, p)), rng.normal(size=2), rng.normal(scale=3.0, size=p)
    u = solve_qp(A, b, C @ theta + d)
    return Scene(A, b, C, d, theta, u, is_active(A, b, u))


CASES = [
    "A",
    "B",
    "C same side",
    "C opposite",
    "D",
    "E three pointed",
    "E three whole plane",
    "E four pointed",
    "E half-plane",
]

_ACTIVE_ROWS = {
    # Small integers: with u in eighths, a.u is exact, so that the rows of C and E really meet in one point.
    "A": [],
    "B": [(3, 1)],
    "C same side": [(2, -1), (4, -2), (6, -3)],
    "C opposite": [(2, -1), (-4, 2)],
    "D": [(3, 1), (-1, 2)],
    "E three pointed": [(1, 0), (0, 1), (1, 1)],
    "E three whole plane": [(1, 0), (-1, 2), (-1, -3)],
    "E four pointed": [(1, 0), (2, 1), (1, 3), (-1, 4)],
    "E half-plane": [(1, 2), (-2, 1), (2, -1)],
}


def paper_case(name: str, rng: np.random.Generator, inactive: int = 3) -> Scene:
    """A scene with the active rows of one of the paper's cases, and `inactive` others clear of the control."""
    active_rows = np.array(_ACTIVE_ROWS[name], dtype=float).reshape(-1, 2)
    u = rng.integers(-8, 9, 2) / 8
    others = rng.normal(size=(inactive, 2))
    A = np.concatenate([active_rows, others])
    b = A @ u
    b[len(active_rows) :] += rng.uniform(0.3, 1.5, inactive) * np.linalg.norm(others, axis=-1)
    multipliers = rng.uniform(0.1, 1.0, len(active_rows))
    gain, x = rng.uniform(0.5, 2.0), rng.normal(size=2)
    theta = x + (u + multipliers @ active_rows) / gain
    active = np.arange(len(A)) < len(active_rows)
    order = rng.permutation(len(A))
    return Scene(A[order], b[order], gain * np.eye(2), -gain * x, theta, u, active[order])


def rotated(scene: Scene, angle: float) -> Scene:
    """The controls, and with them rows and task, turned; the set of parameters must not notice."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return replace(scene, A=scene.A @ turn.T, C=turn @ scene.C, d=turn @ scene.d, u=turn @ scene.u)


def batch(scenes: Sequence[Scene], rows: int | None = None) -> tuple[Halfspaces, Tensor, Tensor, Tensor, Tensor]:
    """(safe_controls, active, u, C, d) of many scenes, padded to `rows`."""
    rows = rows or max(len(scene.b) for scene in scenes)
    A = torch.zeros(len(scenes), rows, 2, dtype=torch.float64)
    b, active = torch.ones(A.shape[:2], dtype=torch.float64), torch.zeros(A.shape[:2], dtype=torch.bool)
    for i, scene in enumerate(scenes):
        m = len(scene.b)
        A[i, :m], b[i, :m], active[i, :m] = map(torch.from_numpy, (scene.A, scene.b, scene.active))
    u, C, d = (torch.from_numpy(np.stack([getattr(scene, part) for scene in scenes])) for part in ("u", "C", "d"))
    return Halfspaces(A, b), active, u, C, d


def true_thetas(scenes: Sequence[Scene]) -> Tensor:
    return torch.from_numpy(np.stack([scene.theta for scene in scenes]))


# Solvers ------------------------------------------------------------------------------------------------------------


def solve_qp(A: np.ndarray, b: np.ndarray, nominal: np.ndarray) -> np.ndarray:
    """argmin |u - nominal|^2 s.t. A u <= b, by daqp on unit rows."""
    norms = np.linalg.norm(A, axis=-1)
    unit = np.ascontiguousarray(A / norms[:, None])
    lower, sense = np.full(len(b), -1e30), np.zeros(len(b), dtype=np.int32)
    u, _, flag, _ = daqp.solve(
        np.eye(len(nominal)), -nominal, unit, b / norms, lower, sense, primal_tol=1e-11, dual_tol=1e-12
    )
    assert flag == 1, f"daqp: exit flag {flag}"
    return np.array(u)


def slack(A: np.ndarray, b: np.ndarray, u: np.ndarray) -> np.ndarray:
    """(b - A u)/|a|, for one u or many."""
    return (b - u @ A.T) / np.linalg.norm(A, axis=-1)


def is_active(A: np.ndarray, b: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.abs(slack(A, b, u)) < ACTIVE


# Exact rational polygons --------------------------------------------------------------------------------------------


def exact(numbers: Iterable[float]) -> tuple[Fraction, ...]:
    """The very rationals that floats are."""
    return tuple(Fraction(float(number)) for number in numbers)


def exact_box(lower: Sequence[float], upper: Sequence[float]) -> list[Point]:
    (x0, y0), (x1, y1) = exact(lower), exact(upper)
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def exact_clip(ring: list[Point], row: Sequence[float], bound: float) -> list[Point]:
    """The convex ring cut by row.z <= bound, without a single rounding (Sutherland and Hodgman). Empty: []."""
    (ax, ay), c = exact(row), Fraction(float(bound))
    over = [ax * x + ay * y - c for x, y in ring]
    kept: list[Point] = []
    for i, (x, y) in enumerate(ring):
        j = (i + 1) % len(ring)
        if over[i] <= 0:
            kept.append((x, y))
        if over[i] * over[j] < 0:
            share = over[i] / (over[i] - over[j])
            kept.append((x + share * (ring[j][0] - x), y + share * (ring[j][1] - y)))
    return kept


def exact_intersection(ring: list[Point], A: np.ndarray, b: np.ndarray) -> list[Point]:
    for row, bound in zip(A, b, strict=True):
        ring = exact_clip(ring, row, bound)
    return ring


def exact_area(ring: list[Point]) -> Fraction:
    following = ring[1:] + ring[:1]
    return sum((x * q - y * p for (x, y), (p, q) in zip(ring, following, strict=True)), Fraction(0)) / 2


def exact_centroid(ring: list[Point]) -> Point:
    following = ring[1:] + ring[:1]
    pieces = [(x, y, p, q, x * q - y * p) for (x, y), (p, q) in zip(ring, following, strict=True)]
    six_areas = 3 * sum(piece[4] for piece in pieces)
    return sum((x + p) * w for x, _, p, _, w in pieces) / six_areas, sum(
        (y + q) * w for _, y, _, q, w in pieces
    ) / six_areas


def exact_inscribed_radius(A: np.ndarray, b: np.ndarray) -> float:
    """Of a bounded set in the plane, by duality: the least lambda.b over triples and opposite pairs of rows with
    lambda >= 0, sum lambda (a, |a|) = (0, 1). Only the lengths |a| are rounded."""
    rows = [(*exact(row), Fraction(math.hypot(*row)), Fraction(float(bound))) for row, bound in zip(A, b, strict=True)]
    bounds = []
    for (p, q, u, b1), (r, s, v, b2), (x, y, w, b3) in itertools.combinations(rows, 3):
        weights = (r * y - s * x, x * q - y * p, p * s - q * r)  # orthogonal to both columns of the three a
        total = weights[0] * u + weights[1] * v + weights[2] * w
        if total != 0 and all(weight / total >= 0 for weight in weights):
            bounds.append((weights[0] * b1 + weights[1] * b2 + weights[2] * b3) / total)
    for (p, q, u, b1), (r, s, v, b2) in itertools.combinations(rows, 2):
        if p * s == q * r and p * r + q * s < 0:
            share = -(p * r + q * s) / (r * r + s * s)
            bounds.append((b1 + share * b2) / (u + share * v))
    return float(min(bounds))


def exactly_feasible(A: np.ndarray, b: np.ndarray) -> bool:
    """Does some point of the plane satisfy all rows? By Fourier and Motzkin, in rationals."""
    rows = [(*exact(row), Fraction(float(bound))) for row, bound in zip(A, b, strict=True)]
    for _ in range(2):  # eliminate the first of the remaining unknowns
        below = [row for row in rows if row[0] < 0]
        above = [row for row in rows if row[0] > 0]
        combined = [tuple(u / p[0] - v / q[0] for u, v in zip(p[1:], q[1:], strict=True)) for p in above for q in below]
        rows = [row[1:] for row in rows if row[0] == 0] + combined
    return all(row[0] >= 0 for row in rows)
