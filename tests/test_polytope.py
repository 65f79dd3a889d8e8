"""Checks 3 to 7 on polytopes, p = 1 and p > 2: exact rationals, the proof that a set is empty, the truth kept and no
growth, thin sets, invariances, batch equals loop.
"""

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import torch

from tests.polytopes import (
    BOX,
    DIMENSIONS,
    Solid,
    box,
    cut,
    exact_vertices,
    frame,
    kind_for,
    points_of,
    random_set,
    rows_around,
    rows_of,
    solve_exactly,
    tensor,
    width_along,
)  # fmt: skip
from torchfsid.outcome import Status
from torchfsid.sets.body import PRIOR
from torchfsid.sets.polygon import Polygon
from torchfsid.sets.polytope import Polytope


@pytest.mark.parametrize("width", [1.0, 1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("p", [1, 3, 4])
def test_support_function_against_exact_rationals(p: int, width: float) -> None:
    """In directions in which the set is as wide as in all others: errors are relative to the width."""
    for seed in range(3):
        rng = np.random.default_rng([p, seed])
        body, A, b = random_set(rng, p, rows=5, width=width)
        exact = exact_vertices(A, b)
        points, (_, axes, spread) = points_of(body), frame(body)
        for weights in rng.normal(size=(6, p)):
            direction = weights / spread @ axes
            truth = max(sum(Fraction(d) * x for d, x in zip(direction.tolist(), z, strict=True)) for z in exact)
            support = body.support(tensor(direction)[None, None]).item()
            noise = 1e-14 * np.abs(direction).sum() * BOX
            assert abs(float(Fraction(support) - truth)) < noise + 1e-12 * width_along(points, direction)
        assert width_along(points, A[0] / np.linalg.norm(A[0])) < 2 * width or width == 1


@pytest.mark.parametrize("p", [1, 3, 4])
def test_an_empty_set_comes_with_rows_that_contradict_each_other(p: int) -> None:
    """The rows are rows that were given, and exact multipliers y >= 0 prove it: y'A = 0, y'b < 0."""
    for seed in range(8):
        rng = np.random.default_rng([p, seed])
        body, _, _ = random_set(rng, p)
        a = rng.normal(size=(3, p))
        outside = -body.support(tensor(-a)[None])[0].numpy() - [1e-6, -100.0, 10.0 ** rng.uniform(-9, 0)]
        after = cut(body, a, outside, time=7.0)
        assert after.outcome == Status.EMPTY
        assert not after.shrunk
        assert torch.equal(after.body.vertices, body.vertices)
        proof = after.contradiction
        used = ~proof.b[0].isnan()
        used_A, used_b = proof.A[0, used].numpy(), proof.b[0, used].numpy()
        given = {
            (*row, c): (time, source)
            for row, c, time, source in zip(
                np.vstack([a, body.A[0].numpy()]).tolist(),
                np.append(outside, body.b[0].numpy()).tolist(),
                [7.0, 7.0, 7.0, *body.time[0].tolist()],
                [0, 1, 2, *body.source[0].tolist()],
                strict=True,
            )
        }
        for row, c, time, source in zip(
            used_A.tolist(), used_b.tolist(), proof.time[0, used].tolist(), proof.source[0, used].tolist(), strict=True
        ):
            expected = given[(*row, c)]
            assert source == expected[1]
            assert time == expected[0] or (math.isnan(time) and source == PRIOR)
        assert 7.0 in proof.time[0, used].tolist()
        assert len(used_b) == p + 1
        # The first multiplier is 1: sum of the others times their rows is minus the first row.
        columns = [[Fraction(x) for x in row] for row in used_A.T.tolist()]
        y = solve_exactly([[*row[1:], -row[0]] for row in columns])
        assert y is not None
        assert all(multiplier > 0 for multiplier in y)
        c = [Fraction(x) for x in used_b.tolist()]
        assert c[0] + sum(multiplier * right for multiplier, right in zip(y, c[1:], strict=True)) < 0


@pytest.mark.parametrize("p", DIMENSIONS)
def test_rows_that_meet_in_the_truth_are_never_called_empty(p: int) -> None:
    """Small integers: every row holds at the truth exactly, often with nothing to spare, and the sets become flat."""
    undecided = 0
    for seed in range(12):
        rng = np.random.default_rng([p, seed])
        truth, body = np.round(rng.uniform(-8, 8, p)) * rng.integers(0, 2, p), box(p)
        for _ in range(15):
            A = rng.integers(-3, 4, size=(6, p)).astype(float)
            after = cut(body, A, A @ truth + rng.integers(0, 4, size=6) * 1e-3)
            assert after.outcome != Status.EMPTY
            undecided += int(after.outcome == Status.UNDECIDED)
            body = after.body
            A, b = rows_of(body)
            assert (A @ truth <= b + 1e-15).all()
    assert undecided > 0


# Promises ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("p", DIMENSIONS)
def test_the_truth_stays_inside_and_the_volume_never_grows(p: int) -> None:
    rng = np.random.default_rng(p)
    truths = rng.uniform(-0.8 * BOX, 0.8 * BOX, (4, p))
    body = box(p, count=len(truths))
    volume = body.volume()
    for k in range(30):
        made = [rows_around(rng, truth, 4, 3 * 0.8**k) for truth in truths]
        after = cut(body, np.stack([A for A, _ in made]), np.stack([b for _, b in made]), time=float(k))
        assert (after.outcome == Status.OK).all()
        # Only what was really cut is another set now.
        assert (after.body.volume()[~after.shrunk] == volume[~after.shrunk]).all()
        assert (after.body.volume()[after.shrunk] < volume[after.shrunk]).all()
        body, volume = after.body, after.body.volume()
        inside = (body.A @ tensor(truths).unsqueeze(-1)).squeeze(-1) <= body.b
        assert inside.all()
        for item, (A, b) in enumerate(made):
            points = points_of(body, item)
            assert (points @ A.T <= b + 1e-14 * BOX * np.abs(A).sum(1)).all()
    assert (volume < 1e-2**p).all()
    assert (body.count >= p + 1).all()
    assert body.time[body.source != PRIOR].median() > 20


@pytest.mark.parametrize("width", [1e-6, 1e-9, 1e-11])
@pytest.mark.parametrize("p", DIMENSIONS)
def test_thin_sets_keep_the_truth(p: int, width: float) -> None:
    """A slab of this width, then rows across it and rows that nearly are its own, tilted by up to one part in 10."""
    rng = np.random.default_rng([p, int(-math.log10(width))])
    for _ in range(4):
        body, A, _ = random_set(rng, p, width=width)
        truth = body.centroid()[0].numpy()
        volume = body.volume().item()
        for _ in range(12):
            across, far = rows_around(rng, truth, 2, 2.0)
            tilt = 10 ** rng.uniform(-12, -1, size=(2, 1)) * rng.normal(size=(2, p))
            along = A[:2] / np.linalg.norm(A[:2], axis=1, keepdims=True) + tilt
            close = along @ truth + width * rng.uniform(0.2, 1.0, 2)
            after = cut(body, np.vstack([across, along]), np.append(far, close))
            assert after.outcome == Status.OK
            body = after.body
            rows, right = rows_of(body)
            assert (rows @ truth <= right + 1e-15 * BOX * np.abs(rows).sum(1)).all()
            assert body.volume().item() <= volume * (1 + 1e-9 + 1e-14 * p * BOX / width)
            volume = body.volume().item()
            centre, radius = body.chebyshev()
            assert 0 < radius.item() < 2 * width
            assert (rows @ centre[0].numpy() <= right).all()


def test_a_cut_before_the_empty_one_is_taken_back() -> None:
    block = box(3, half=1.0)
    after = cut(block, np.array([[1.0, 0, 0], [-1.0, 0, 0]]), np.array([-0.5, 0.2]), time=3.0)
    assert after.outcome == Status.EMPTY
    assert not after.shrunk
    assert torch.equal(after.body.vertices, block.vertices)
    assert sorted(after.contradiction.source[0].tolist()) == [PRIOR, PRIOR, 0, 1]
    assert after.contradiction.time[0, :2].tolist() == [3.0, 3.0]


def test_facets_of_which_only_an_edge_is_left_are_dropped() -> None:
    """A cube cut along the diagonal: two sides touch the prism that is left, and are redundant."""
    prism = cut(box(3, half=1.0), np.array([[1.0, 1, 0]]), np.zeros(1)).body
    assert (int(prism.count), int(prism.vertex_count)) == (5, 6)
    assert prism.volume().item() == pytest.approx(4.0, rel=1e-14)


def test_padding_rows_change_nothing_and_a_row_that_nothing_satisfies_empties() -> None:
    block = box(3)
    assert not cut(block, np.zeros((2, 3)), np.ones(2)).shrunk
    impossible = cut(block, np.zeros((1, 3)), np.array([-1.0]))
    assert impossible.outcome == Status.EMPTY
    assert impossible.contradiction.b[0].tolist()[0] == -1.0
    assert impossible.contradiction.b[0, 1:].isnan().all()


# Invariances ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("p", DIMENSIONS)
def test_order_scale_repetition_and_motion_of_the_rows_change_nothing(p: int) -> None:
    rng = np.random.default_rng(p)
    truth = rng.uniform(-3, 3, p)
    A, b = rows_around(rng, truth, 12, 2.0)
    before = cut(box(p), A, b).body
    directions = rng.normal(size=(5, p))
    support = before.support(tensor(directions)[None])[0].numpy()

    def check(body: Solid, directions: np.ndarray, support: np.ndarray) -> None:
        assert body.support(tensor(directions)[None])[0].numpy() == pytest.approx(support, abs=1e-12 * BOX)
        assert int(body.count) == int(before.count)
        assert int(body.vertex_count) == int(before.vertex_count)
        assert body.volume().item() == pytest.approx(before.volume().item(), rel=1e-11)
        assert body.diameter().item() == pytest.approx(before.diameter().item(), rel=1e-12)
        assert body.chebyshev()[1].item() == pytest.approx(before.chebyshev()[1].item(), rel=1e-11)

    order = rng.permutation(len(b))
    one_by_one = box(p)
    for i in order:
        one_by_one = cut(one_by_one, A[i : i + 1], b[i : i + 1]).body
    check(one_by_one, directions, support)
    scale = np.exp(4 * rng.normal(size=len(b)))
    check(cut(box(p), A * scale[:, None], b * scale).body, directions, support)
    again = cut(cut(box(p), np.vstack([A, 3 * A]), np.append(b, 3 * b)).body, A, b)
    assert not again.shrunk
    check(again.body, directions, support)
    shift = rng.normal(size=p)
    moved = kind_for(p).from_box(tensor(shift - BOX)[None], tensor(shift + BOX)[None])
    check(cut(moved, A, b + A @ shift).body, directions, support + directions @ shift)
    # In a box that turning it does not change: a set that does not reach the box.
    turn, _ = np.linalg.qr(rng.normal(size=(p, p)))
    ball = np.vstack([rng.normal(size=(4 * p, p)), np.eye(p), -np.eye(p)])
    rows, right = np.vstack([A, ball]), np.append(b, np.linalg.norm(ball, axis=1) + ball @ truth)
    before = cut(box(p), rows, right).body
    check(
        cut(box(p), rows @ turn.T, right).body, directions @ turn.T, before.support(tensor(directions)[None])[0].numpy()
    )


def test_in_the_plane_it_agrees_with_polygons() -> None:
    """Two implementations that share nothing but their interface."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        truth = rng.uniform(-5, 5, 2)
        corners = tensor([[-BOX, -BOX]]), tensor([[BOX, BOX]])
        polytope, polygon = Polytope.from_box(*corners), Polygon.from_box(*corners)
        for _ in range(4):
            A, b = rows_around(rng, truth, 5, 2.0)
            stamp, source = torch.zeros(1, 5, dtype=torch.float64), torch.arange(5)[None]
            flat = polygon.clip(tensor(A)[None], tensor(b)[None], stamp, source, 1000)
            after = cut(polytope, A, b)
            assert after.outcome == flat.outcome
            assert after.shrunk == flat.shrunk
            polytope, polygon = after.body, flat.body
        assert polytope.count == polygon.count
        assert sorted(polytope.source[0].tolist()) == sorted(polygon.source[0, : int(polygon.count)].tolist())
        q = tensor(rng.uniform(-BOX, BOX, (1, 2)))
        metric = tensor([[[2.0, 0.5], [0.5, 1.0]]])
        for one, other in [
            (polytope.volume(), polygon.volume()),
            (polytope.centroid(), polygon.centroid()),
            (polytope.diameter(), polygon.diameter()),
            (polytope.chebyshev()[1], polygon.chebyshev()[1]),
            (polytope.nearest(q), polygon.nearest(q)),
            (polytope.nearest(q, metric), polygon.nearest(q, metric)),
        ]:
            torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-12)


def test_a_batch_is_its_items_and_padding_is_harmless() -> None:
    p = 3
    made = [random_set(np.random.default_rng(seed), p, rows=2 + 3 * seed) for seed in range(4)]
    batch = box(p, count=4)
    A, b = np.zeros((4, 20, p)), np.ones((4, 20))
    for i, (_, rows, right) in enumerate(made):
        A[i, : len(right)], b[i, : len(right)] = rows, right
    A[2], b[2] = 0.0, -1.0  # one that nothing satisfies
    after = cut(batch, A, b)
    assert after.outcome.tolist() == [Status.OK, Status.OK, Status.EMPTY, Status.OK]
    assert after.shrunk.tolist() == [True, True, False, True]
    expected = [body for body, _, _ in made]
    expected[2] = box(p)
    q = tensor(np.random.default_rng(0).uniform(-20, 20, (4, p)))
    for i, one in enumerate(expected):
        for item in (after.body.select(torch.tensor([i])), after.body.select(torch.arange(4) == i)):
            assert item.volume() == one.volume()
            assert torch.equal(item.vertices, one.select(torch.tensor([0])).vertices)
            assert torch.equal(item.chebyshev()[0], one.chebyshev()[0])
        body = after.body
        assert body.volume()[i] == one.volume()[0]
        assert body.diameter()[i] == one.diameter()[0]
        assert torch.equal(body.support(q[:, None])[i], one.support(q[i][None, None])[0])
        assert torch.equal(body.nearest(q)[i], one.nearest(q[i : i + 1])[0])
        assert (body.A[i, int(body.count[i]) :] == 0).all()
        assert (body.b[i, int(body.count[i]) :] == 1).all()
        assert (body.vertices[i, int(body.vertex_count[i]) :] == body.vertices[i, 0]).all()
    swapped = after.body.replaced(torch.tensor([2, 0]), after.body.select(torch.tensor([1, 2])))
    assert swapped.volume().tolist() == [after.body.volume()[i].item() for i in (2, 1, 1, 3)]
    rebuilt = replace(swapped)
    assert torch.equal(rebuilt.volume(), swapped.volume())
