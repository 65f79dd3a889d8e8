"""Polyhedra, the sets of three parameters: against exact rationals, against `Polytope`, and against each other.

Rows are adversarial: through the vertices that are there, parallel up to round-off, repeated, facing each other as
closely as 1e-14, small integers, and rows that only touch.
"""

import math
from collections import Counter
from fractions import Fraction

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from tests.polytopes import BOX, box, cut, exact_vertices, points_of, rows_of, tensor
from torchfsid.halfspaces import Halfspaces
from torchfsid.outcome import Status
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.sets.polyhedron import Polyhedron
from torchfsid.sets.polytope import Polytope

KINDS = ["random", "integers", "through vertices", "nearly repeated", "needles", "touching"]
Rows = tuple[np.ndarray, np.ndarray]


def adversarial(rng: np.random.Generator, kind: str, body: Polyhedron, truth: np.ndarray, step: int) -> Rows:
    """Six rows that hold at the truth, exactly."""
    A = rng.normal(size=(6, 3)) * np.exp(rng.normal(size=(6, 1)))
    slack = 10 * 0.8**step * rng.exponential(size=6) * np.linalg.norm(A, axis=1)
    if kind == "integers":
        A, slack = rng.integers(-3, 4, size=(6, 3)).astype(float), rng.integers(0, 4, size=6) * 0.3
    elif kind == "through vertices":
        vertex = points_of(body)[rng.integers(len(points_of(body)))]
        A *= np.sign(A @ (vertex - truth))[:, None]
        slack = np.abs(A @ (vertex - truth))
    elif kind == "nearly repeated":
        own, _ = rows_of(body)
        A[1:] = own[rng.integers(len(own), size=5)] * (1 + rng.normal(size=(5, 3)) * 10 ** rng.uniform(-16, -8, (5, 1)))
        slack = np.linalg.norm(A, axis=1) * np.abs(rng.normal(size=6)) / 2
    elif kind == "needles":
        tilt = 10 ** rng.uniform(-14, -1, size=(3, 1)) * rng.normal(size=(3, 3))
        A[[1, 2, 4]] = A[[0, 0, 3]] * [[-1], [1], [-1]] + tilt
        slack[:5] *= 10 ** rng.uniform(-13, -1)
    elif kind == "touching":
        A[1], A[3] = -A[0], -A[2]
        slack[:2], slack[2:4] = 0.0, rng.choice([0.0, 1e-15, 1e-13])
    b = A @ truth + slack
    for i, row in enumerate(A):
        exact = sum(Fraction(x) * Fraction(z) for x, z in zip(row.tolist(), truth.tolist(), strict=True))
        while Fraction(b[i]) < exact:
            b[i] = np.nextafter(b[i], np.inf)
    return A, b


def check_graph(body: Polyhedron) -> None:
    """Three facets meet in each of 2 F - 4 vertices, every edge has two ends, and vertices are on their facets."""
    (A, b), reach = rows_of(body), body.reach[0].numpy()
    meets, points, edges = body.meets[0, : 2 * len(b) - 4].numpy(), points_of(body), Counter()
    round_off = 2.0**-49 * (np.abs(A) @ reach + np.abs(b))
    for three, point in zip(meets, points, strict=True):
        assert len(set(three)) == 3
        edges.update(tuple(sorted((three[i], three[i - 1]))) for i in range(3))
        assert (np.abs(A[three] @ point - b[three]) <= 2 * round_off[three]).all()
    assert set(edges.values()) == {2}
    assert len(edges) == 3 * len(b) - 6
    assert (points @ A.T - b <= 2 * round_off).all()


@pytest.mark.parametrize("most", [1000, 10])
@pytest.mark.parametrize("kind", KINDS)
def test_adversarial_rows_against_exact_rationals(kind: str, most: int) -> None:
    """The truth is never lost. Without merging, it is the exact set: relative to its width, and to round-off."""
    for seed in range(3):
        rng = np.random.default_rng([seed, most])
        truth, body, (A, b) = np.round(rng.uniform(-32, 32, 3)) / 8, box(3), rows_of(box(3))
        for step in range(3):
            rows, right = adversarial(rng, kind, body, truth, step)
            A, b = np.vstack([A, rows]), np.append(b, right)
            body = body.clip(*(tensor(part)[None] for part in (rows, right, 0 * right)), torch.zeros(1, 6).long(), most)
            assert body.outcome != Status.EMPTY
            body = body.body
            check_graph(body)
            for row, c in zip(*rows_of(body), strict=True):
                assert sum(Fraction(x) * Fraction(z) for x, z in zip(row, truth.tolist(), strict=True)) <= Fraction(c)
        if most > 100:
            exact = np.array(
                [[float(x - Fraction(t)) for x, t in zip(z, truth, strict=True)] for z in exact_vertices(A, b)]
            )
            frame, found = body._numbers.frame, points_of(body) - truth
            for weights in rng.normal(size=(8, 3)):
                direction = (weights / frame.scale[0].numpy()) @ frame.axes[0].numpy()
                direction /= np.linalg.norm(direction)
                width = np.ptp(exact @ direction)
                assert (found @ direction).max() == pytest.approx((exact @ direction).max(), abs=1e-9 * width + 2e-13)


@pytest.mark.parametrize("width", [1e-4, 1e-6, 1e-8])
def test_thin_sets_have_the_volume_of_exact_rationals(width: float) -> None:
    """Two rows of each update face each other. Qhull about HiGHS' centre fails at 1e-8 (`python -m benchmarks
    polyhedra`)."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth, across, body, (A, b) = rng.uniform(-5, 5, 3), rng.normal(size=3), box(3), rows_of(box(3))
        for _ in range(3):
            rows = rng.normal(size=(6, 3))
            rows[:2] = np.outer([1, -1], across) + width * rng.uniform(-0.25, 0.25, (2, 3))
            slack = np.append(width * rng.uniform(0.25, 0.5, 2), rng.uniform(1, 4, 4))
            right = rows @ truth + slack * np.linalg.norm(rows, axis=1)
            after = cut(body, rows, right)
            assert after.outcome == Status.OK
            body, A, b = after.body, np.vstack([A, rows]), np.append(b, right)
        exact = exact_vertices(A, b)
        y = np.array([[float(x - x0) for x, x0 in zip(z, exact[0], strict=True)] for z in exact])
        _, spread, axes = np.linalg.svd(y - y.mean(0), full_matrices=False)
        volume = ConvexHull(y @ axes.T / spread, qhull_options="QJ").volume * spread.prod()
        assert body.volume().item() == pytest.approx(volume, rel=1e-7 + 1e-13 / width)
        assert len(rows_of(body)[1]) == len(np.unique(np.round(y @ axes.T / spread, 6), axis=0)) // 2 + 2


def test_it_agrees_with_polytopes() -> None:
    """Two implementations that share only the ball and the nearest point."""
    for seed in range(8):
        rng = np.random.default_rng(seed)
        corner, truth = torch.full((1, 3), BOX, dtype=torch.float64), rng.uniform(-5, 5, 3)
        one, other = Polyhedron.from_box(-corner, corner), Polytope.from_box(-corner, corner)
        for step in range(4):
            A = rng.normal(size=(8, 3))
            b = A @ truth + 6 * 0.6**step * rng.uniform(0.2, 1, 8)
            one, other = (cut(body, A, b, time=float(step)).body for body in (one, other))
        stamps = [sorted(zip(body.time[0].tolist(), body.source[0].tolist(), strict=True))[: int(body.count)]
                  for body in (one.select(torch.tensor([0])), other)]  # fmt: skip
        assert [s for s in stamps[0] if s[1] >= 0] == [s for s in stamps[1] if s[1] >= 0]
        direction = tensor(rng.normal(size=(1, 5, 3)))
        for name in ("volume", "centroid", "diameter", "chebyshev"):
            for mine, theirs in zip(getattr(one, name)(), getattr(other, name)(), strict=True):
                torch.testing.assert_close(mine, theirs, rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(one.support(direction), other.support(direction), rtol=1e-10, atol=1e-12)


def test_many_facets_through_one_vertex() -> None:
    """A pyramid of 16 sides: its apex is proven to be beyond a row by at most four rows, cut off, and touched."""
    around = np.arange(16) * np.pi / 8
    sides = np.column_stack([np.cos(around), np.sin(around), np.ones(16)])
    pyramid = cut(box(3), np.vstack([sides, [0, 0, -1.0]]), np.append(np.ones(16), 0.0)).body
    check_graph(pyramid)
    assert pyramid.volume().item() == pytest.approx(16 * math.tan(math.pi / 16) / 3, rel=1e-12)
    above = np.array([[0.1, 0.05, -1.0]])
    beyond = cut(pyramid, above, np.array([-1.0 - 1e-9]))
    assert beyond.outcome == Status.EMPTY
    assert (~beyond.contradiction.b[0].isnan()).sum() <= 4
    touched = cut(pyramid, above, np.array([-1.0]))
    assert touched.outcome == Status.UNDECIDED
    assert touched.body.volume() == 0
    assert touched.body.centroid()[0].numpy() == pytest.approx([0, 0, 1], abs=1e-13)
    cut_off = cut(pyramid, np.array([[0, 0, 1.0]]), np.array([0.5])).body
    assert cut_off.volume().item() == pytest.approx(pyramid.volume().item() * 7 / 8, rel=1e-12)
    check_graph(cut_off)


@pytest.mark.parametrize("flat", [False, True])
def test_merging_in_one_go_contains_the_set_and_a_batch_is_its_items(flat: bool) -> None:
    """Balls of 40 rows, or discs, are merged to 12 facets at once: they grow little, and stay flat if they were."""
    rng, B = np.random.default_rng(flat), 6
    truth, normal = rng.uniform(-2, 2, (B, 1, 3)), rng.normal(size=(B, 1, 3))
    A = rng.normal(size=(B, 40, 3))
    if flat:
        A -= normal * (A * normal).sum(-1, keepdims=True) / (normal**2).sum(-1, keepdims=True)
        A[:, :2] = normal * [[1.0], [-1.0]]
    b = (A * truth).sum(-1) + np.linalg.norm(A, axis=-1)
    if flat:
        b[:, :2] = (A[:, :2] * truth).sum(-1)
    halfspaces = Halfspaces(tensor(A), tensor(b))
    corner = torch.full((B, 3), BOX, dtype=torch.float64)
    whole, few = (FeasibleSet.from_box(-corner, corner, most).intersect(halfspaces) for most in (1000, 12))
    assert (whole.body.count > 20).all()
    assert (few.body.count <= 12).all()
    rows, right = few.facets().halfspaces.A, few.facets().halfspaces.b
    assert (rows @ whole.vertices().mT <= right.unsqueeze(-1) + 1e-13).all()
    assert (few.diameter() <= 1.6 * whole.diameter()).all()
    if flat:
        across = ((few.vertices() - tensor(truth)) * tensor(normal)).sum(-1)
        assert across.abs().max() < 1e-13 * np.linalg.norm(normal, axis=-1).max() * BOX
        assert (few.volume() == 0).all()
    else:
        assert (few.volume() <= 2.5 * whole.volume()).all()
    for i in range(B):
        alone = FeasibleSet.from_box(-corner[:1], corner[:1], 12).intersect(
            Halfspaces(tensor(A[i])[None], tensor(b[i])[None])
        )
        assert torch.equal(alone.body.select(torch.tensor([0])).corners, few.body.select(torch.tensor([i])).corners)
        assert torch.equal(alone.volume()[0], few.volume()[i])
        assert torch.equal(alone.centroid()[0], few.centroid()[i])
