"""Sets of nearly parallel, opposite and repeated rows, thin and far from the origin: each number is compared with HiGHS
or Qhull, both asked in the frame of the set, or with the conditions of optimality.
"""

import numpy as np
import pytest
import torch
from scipy.optimize import linprog, nnls
from scipy.spatial import ConvexHull
from torch import Tensor

from tests.polytopes import tensor
from torchfsid.halfspaces import Halfspaces
from torchfsid.outcome import Status
from torchfsid.sets.feasible_set import FeasibleSet

HALF = 5.0
"""Half the side of the boxes that the sets begin with."""


def box_around(centre: Tensor) -> FeasibleSet:
    return FeasibleSet.from_box(centre - HALF, centre + HALF)


SLABS = [
    ([[-204, -434, -822], [-204, -435, -823], [-204, -435, -822], [204, 434, 822], [204, 435, 823]], 476.0, 0.4994861),
    ([[-47, -771, 550], [-48, -770, 550], [-48, -771, 551], [47, 771, -550], [48, 770, -550]], 474.0, 0.4998760),
]


@pytest.mark.parametrize(("A", "bound", "expected"), SLABS)
def test_the_radius_of_a_slab_between_three_rows_and_two(A: list[list[float]], bound: float, expected: float) -> None:
    theta = box_around(torch.zeros(3, dtype=torch.float64)).intersect(Halfspaces(tensor(A), torch.full((5,), bound)))
    centre, radius = theta.chebyshev()
    assert radius.item() == pytest.approx(expected, abs=1e-7)
    assert theta.contains(centre)


def nearly_parallel(rng: np.random.Generator, p: int, kind: str, angle: float, width: float) -> tuple[np.ndarray, ...]:
    """Rows of all scales, and how far their boundaries are from the truth."""
    n, Q = rng.normal(size=p), np.linalg.qr(rng.normal(size=(p, p)))[0]
    tilt = angle * rng.normal(size=(12, p))
    if kind == "slab":
        A = n / np.linalg.norm(n) * np.array([1, 1, 1, -1, -1])[:, None] + tilt[:5] * np.array([1, 1, 1, 0, 1])[:, None]
        slack = np.full(5, width)
    elif kind == "needle":
        A = np.vstack([Q[: max(1, p - 1)], -Q[: max(1, p - 1)]])
        A, slack = A + tilt[: len(A)], width * rng.uniform(0.3, 1, len(A))
    elif kind == "prism":
        around = np.arange(6) * np.pi / 3
        A = np.outer(np.cos(around), Q[0]) + (np.outer(np.sin(around), Q[1]) if p > 1 else 0.0) + tilt[:6]
        slack = np.full(6, width)
    else:  # repeated
        A = rng.normal(size=(4, p))
        A, slack = np.vstack([A, 3 * A, A * (1 + tilt[:4]), -A]), width * rng.uniform(0.5, 1, 16)
    A = A * np.exp(2 * rng.normal(size=(len(A), 1)))
    return A, slack * np.linalg.norm(A, axis=1)


@pytest.mark.parametrize("kind", ["slab", "needle", "prism", "repeated"])
@pytest.mark.parametrize("p", [1, 3, 4])
def test_every_number_is_right(p: int, kind: str) -> None:
    for k, angle in enumerate([1e-1, 1e-3, 1e-5, 1e-7, 1e-9, 1e-12]):
        rng = np.random.default_rng([p, k])
        centre = rng.choice([0.0, 1e3, 1e6]) * rng.normal(size=p)
        truth, width = centre + rng.uniform(-2, 2, p), 10 ** rng.uniform(-6, 0) * max(1.0, 1e-3 * np.abs(centre).max())
        A, slack = nearly_parallel(rng, p, kind, angle, width)
        theta = box_around(tensor(centre).round()).intersect(Halfspaces(tensor(A), tensor(A @ truth + slack)))
        assert theta.outcome == Status.OK
        assert theta.contains(tensor(truth))
        sides = np.vstack([np.eye(p), -np.eye(p)])
        rows, right = np.vstack([A, sides]), np.append(A @ truth + slack, sides @ centre.round() + HALF)
        lengths, noise = np.linalg.norm(rows, axis=1), 2e-14 * (np.abs(centre).max() + HALF)
        rows, right = rows / lengths[:, None], right / lengths

        points = theta.vertices().numpy()
        middle = points.mean(0)
        _, spread, axes = np.linalg.svd(points - middle, full_matrices=False)
        y = (points - middle) @ axes.T / spread
        relative = 1e-6 + noise / spread.min()

        middle_ball, radius = theta.chebyshev()
        framed = np.column_stack([rows @ (axes.T * spread), np.full(len(rows), spread.min())])
        scale = np.linalg.norm(framed, axis=1)
        objective = np.append(np.zeros(p), -1.0)
        found = linprog(objective, framed / scale[:, None], (right - rows @ middle) / scale, bounds=(None, None))
        assert radius.item() == pytest.approx(found.x[-1] * spread.min(), rel=1e-6, abs=noise)
        assert (right - rows @ middle_ball.numpy()).min() >= radius.item() - noise

        hull = np.ptp(y) if p == 1 else ConvexHull(y, qhull_options="QJ").volume
        assert theta.volume().item() == pytest.approx(hull * spread.prod(), rel=20 * relative)
        assert theta.contains(theta.centroid())

        # The nearest point: in the set, and the pull towards it is a combination of the rows that are active there.
        point = centre + 4 * HALF * rng.normal(size=p)
        foot = theta.project(tensor(point)).numpy()
        left = right - rows @ foot
        assert left.min() >= -noise
        pull = point - foot
        if np.linalg.norm(pull) > 0:
            _, missing = nnls(rows[left < noise].T, pull / np.linalg.norm(pull))
            assert missing < 1e-7
