"""Rows that only touch a polytope: they move outward by their round-off and cut. So sets without interior stay flat,
the order of the rows does not matter, a smaller bound never gives a larger set, and nothing is lost.
"""

import itertools
from fractions import Fraction

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.polytopes import box, cut, rows_of, tensor
from torchfsid.halfspaces import Halfspaces
from torchfsid.outcome import Status
from torchfsid.sets.feasible_set import FeasibleSet

SIDE = 5.0
"""Half the side of the box that the sets begin with."""

NOISE = 1e-13
"""As thick as a flat set may be: what a few rows leave open, each by 16 times the rounding error of its terms."""


def prior(p: int, count: int, around: float = 0.0) -> FeasibleSet:
    centre = torch.full((count, p), around, dtype=torch.float64)
    return FeasibleSet.from_box(centre - SIDE, centre + SIDE)


def one_by_one(theta: FeasibleSet, A: Tensor, b: Tensor) -> FeasibleSet:
    for k in range(b.shape[-1]):
        theta = theta.intersect(Halfspaces(A[..., k : k + 1, :], b[..., k : k + 1]))
    return theta


def orders(rows: int, most: int) -> np.ndarray:
    every = np.array(list(itertools.permutations(range(rows)))) if rows < 7 else None
    rng = np.random.default_rng(rows)
    if every is None:
        return np.stack([rng.permutation(rows) for _ in range(most)])
    return every[rng.permutation(len(every))[:most]]


@pytest.mark.parametrize("p", [1, 3, 4])
@pytest.mark.parametrize("turned", [False, True])
def test_boxes_cut_to_facets_edges_and_points_in_any_order(p: int, turned: bool) -> None:
    """All that is asked of {z : Q_k (z - truth) = 0}, the first k rows of an orthonormal Q pinned."""
    rng = np.random.default_rng(p)
    for pinned in range(1, p + 1):
        Q = np.linalg.qr(rng.normal(size=(p, p)))[0] if turned else np.eye(p)
        truth = rng.uniform(-2, 2, p) if turned else rng.choice([-SIDE, SIDE, 0.0, 1 / 3], p)
        ways = orders(2 * pinned, most=12)
        rows = np.vstack([Q[:pinned], -Q[:pinned]]) * np.exp(rng.normal(size=(2 * pinned, 1)))
        A = tensor(rows[ways])
        b = A @ tensor(truth)
        for theta in (prior(p, len(ways)).intersect(Halfspaces(A, b)), one_by_one(prior(p, len(ways)), A, b)):
            again = one_by_one(theta, A, b)
            for flat in (theta, again):
                assert (flat.outcome == Status.UNDECIDED).all()
                assert flat.contains(tensor(truth).expand(len(ways), p)).all()
                across = flat.vertices() @ tensor(Q[:pinned]).T - tensor(Q[:pinned] @ truth)
                assert across.abs().max() < NOISE
                assert (flat.volume() == 0).all()
                centroid, (centre, radius) = flat.centroid(), flat.chebyshev()
                assert flat.contains(centroid).all()
                assert flat.contains(centre).all()
                assert (radius >= 0).all()
                assert (radius < NOISE).all()
                point = tensor(rng.normal(size=(len(ways), p)) * 4 * SIDE)
                foot = flat.project(point)
                assert flat.contains(foot).all()
                pull = point - foot
                assert (flat.support(pull) <= (pull * foot).sum(-1) + 100 * NOISE).all()
                if turned:
                    # However the rows were ordered, it is the same set.
                    support = flat.support(pull[:1].expand(len(ways), p))
                    assert (support - support[0]).abs().max() < 100 * NOISE
                else:
                    free = np.arange(p) >= pinned
                    middle = tensor(np.where(free, 0.0, truth))
                    torch.testing.assert_close(centroid, middle.expand(len(ways), p), rtol=0, atol=10 * NOISE)
                    diameter = torch.full((len(ways),), 2 * SIDE * free.sum() ** 0.5, dtype=torch.float64)
                    torch.testing.assert_close(flat.diameter(), diameter, rtol=0, atol=10 * NOISE)


@pytest.mark.parametrize("around", [0.0, 1e6])
@pytest.mark.parametrize("p", [1, 3, 4])
def test_a_smaller_bound_never_gives_a_larger_set(p: int, around: float) -> None:
    """Exact data with bounds from 0 to 1e-6, rows in several orders: nested, and the same set in each, to round-off."""
    noise = 1e-12 * (around + SIDE)
    for seed in range(4):
        rng = np.random.default_rng([p, seed])
        truth, rows = np.round(rng.uniform(-4, 4, p)) + around, rng.integers(2, 7)
        A = rng.normal(size=(rows, p)) if seed % 2 else rng.integers(-3, 4, size=(rows, p)).astype(float)
        A = np.vstack([A, -A]) if seed % 4 < 2 else A
        ways = torch.as_tensor(orders(len(A), most=3))
        directions, smaller = tensor(rng.normal(size=(6, p))), None
        for bound in (0.0, 1e-16, 1e-14, 1e-12, 1e-9, 1e-6):
            b = A @ truth + bound * np.linalg.norm(A, axis=1)
            rows_in_order = tensor(A)[ways], tensor(b)[ways]
            start = prior(p, len(ways), around)
            found = []
            for theta in (start.intersect(Halfspaces(*rows_in_order)), one_by_one(start, *rows_in_order)):
                assert (theta.outcome != Status.EMPTY).all()
                assert theta.contains(tensor(truth).expand(len(ways), p)).all()
                found.append(
                    torch.stack([theta.support(direction.expand(len(ways), p)) for direction in directions], dim=-1)
                )
            support = torch.cat(found)
            assert (support.amax(0) - support.amin(0)).max() < noise
            if smaller is not None:
                assert (smaller - support.amax(0)).max() < noise
            smaller = support.amax(0)


@pytest.mark.parametrize("p", [1, 3, 4])
def test_a_row_that_only_touches_leaves_a_sliver(p: int) -> None:
    """At a facet, an edge, a vertex of a block; a little further on, nothing is left, and a little less far, a set."""
    block = box(p, half=1.0)
    for k in range(1, p + 1):
        row = -np.append(np.ones(k), np.zeros(p - k))
        touched = cut(block, row[None], np.array([-float(k)]))
        assert touched.outcome == Status.UNDECIDED
        assert touched.shrunk
        assert touched.body.volume() == 0
        assert touched.body.centroid()[0].numpy() == pytest.approx(-row, abs=NOISE)
        A, b = rows_of(touched.body)
        (moved,) = b[touched.body.source[0, : len(b)].numpy() == 0]
        assert -k < moved < -k + NOISE
        assert cut(block, row[None], np.array([-k - 1e-9])).outcome == Status.EMPTY
        less = cut(block, row[None], np.array([-k + 1e-9]))
        assert less.outcome == Status.OK
        assert touched.body.support(tensor(A)[None]).amax() <= less.body.support(tensor(A)[None]).amax() + NOISE
        assert not cut(block, -row[None], np.array([float(k)])).shrunk


def least_float_above(row: np.ndarray, point: np.ndarray) -> float:
    """The least float b with row.point <= b, in rational arithmetic."""
    value = sum(Fraction(a) * Fraction(z) for a, z in zip(row.tolist(), point.tolist(), strict=True))
    b = float(value)
    while Fraction(b) < value:
        b = float(np.nextafter(b, np.inf))
    return b


@pytest.mark.parametrize("half", [1e-1, 1e-3, 1e-5, 1e-8, 1e-10, 1e-12])
@pytest.mark.parametrize("p", [1, 3, 4])
def test_a_truth_at_the_apex_of_a_sharp_cone_is_never_lost(p: int, half: float) -> None:
    """The cone, a row across it, then rows of all directions, each through the truth: a row that touches too far from
    the corner that was computed leaves a sliver around it, and half-spaces that still hold the truth."""
    cones = []
    for seed in range(30):
        rng = np.random.default_rng([p, seed])
        truth, Q = rng.uniform(-1, 1, p) + rng.choice([0, 1e3, 1e6]), np.linalg.qr(rng.normal(size=(p, p)))[0]
        axis, sides = Q[0], np.vstack([Q[1:], -Q[1:]]) * np.cos(half) + Q[0] * np.sin(half)
        across = -axis + half * rng.uniform(-1, 1, (2, p))
        A = np.vstack([sides, across, rng.normal(size=(3, p)), -sides[:1]])
        cones.append((truth, A, [least_float_above(row, truth) for row in A]))
    truth, A, b = (tensor(np.stack(part)) for part in zip(*cones, strict=True))
    theta, turns = FeasibleSet.from_box(truth.round() - 2, truth.round() + 2), b.shape[-1] - 5
    for rows in (slice(0, turns), *(slice(k, k + 1) for k in range(turns, b.shape[-1]))):
        theta = theta.intersect(Halfspaces(A[:, rows], b[:, rows]))
        assert (theta.outcome != Status.EMPTY).all()
        assert theta.contains(truth).all()
        for answer in (*theta.chebyshev(), theta.centroid(), theta.project(truth + 5), theta.volume()):
            assert answer.isfinite().all()
    facets = theta.facets().halfspaces
    for point, rows, right in zip(truth.tolist(), facets.A.tolist(), facets.b.tolist(), strict=True):
        for row, c in zip(rows, right, strict=True):
            assert sum(Fraction(a) * Fraction(z) for a, z in zip(row, point, strict=True)) <= Fraction(c)


@pytest.mark.parametrize("p", [3, 4])
def test_flat_sets_are_merged_to_few_facets_without_growing_much(p: int) -> None:
    """A disc of 24 sides in a hyperplane, seen again and again: it keeps its truth, its plane and about its size."""
    rng = np.random.default_rng(p)
    Q, truth = np.linalg.qr(rng.normal(size=(p, p)))[0], rng.uniform(-1, 1, p)
    start = FeasibleSet.from_box(*(tensor(np.full((1, p), side)) for side in (-SIDE, SIDE)), max_facets=4 * p)
    theta = start.intersect(Halfspaces(tensor(np.stack([Q[0], -Q[0]])), tensor([Q[0] @ truth, -Q[0] @ truth])))
    for _ in range(4):
        around = rng.normal(size=(4, p - 1))
        A = around / np.linalg.norm(around, axis=1, keepdims=True) @ Q[1:]
        diameter = theta.diameter()
        theta = theta.intersect(Halfspaces(tensor(A), tensor(A @ truth + 1.0)))
        assert int(theta.body.count) <= 4 * p
        assert theta.contains(tensor(truth)[None])
        assert ((theta.vertices() - tensor(truth)) @ tensor(Q[0])).abs().max() < NOISE
        assert theta.diameter() <= diameter * 1.01
        assert theta.volume() == 0
    assert theta.diameter() < 1.5 * SIDE


def test_a_set_as_small_as_round_off_has_a_ball() -> None:
    """The rows that are left of it are open on one side."""
    rng, centre = np.random.default_rng(279), np.full(3, 1e6)
    found = FeasibleSet.from_box(torch.tensor(centre - 1e-6), torch.tensor(centre + 1e-6))
    for _ in range(3):
        A = rng.normal(size=(6, 3))
        found = found.intersect(Halfspaces(torch.tensor(A), torch.tensor(A @ centre + 1e-12)))
    middle, radius = found.chebyshev()
    assert bool(found.contains(middle))
    assert 0 <= float(radius) < 1e-6
