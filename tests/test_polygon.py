"""Checks 3, 4, 5 and 6 on polygons: exact rationals, invariances, the truth kept and no growth, thin sets.

A row's exact counterpart is the very rationals that its floats are: what differs is the library's rounding, only.
"""

import math
from collections import Counter
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from torch import Tensor

from tests.problems import (
    Point,
    exact,
    exact_area,
    exact_box,
    exact_centroid,
    exact_inscribed_radius,
    exact_intersection,
    exactly_feasible,
    solve_qp,
)
from torchfsid.outcome import Status
from torchfsid.sets.body import Clipped
from torchfsid.sets.polygon import Polygon
from torchfsid.tolerances import ROUND_OFF

BOX = 10.0
"""Half the side of the first box: the size that round-off is measured against."""


def tensor(values: object) -> Tensor:
    return torch.as_tensor(np.asarray(values, dtype=float))


def boxes(count: int, half: float = BOX) -> Polygon:
    return Polygon.from_box(tensor(np.full((count, 2), -half)), tensor(np.full((count, 2), half)))


def cut(
    polygon: Polygon, A: np.ndarray | Tensor, b: np.ndarray | Tensor, time: float = 0.0, most: int = 1000
) -> Clipped:
    A, b = torch.as_tensor(A), torch.as_tensor(b)
    stamp, source = torch.full(b.shape, time, dtype=torch.float64), torch.arange(b.shape[1]).expand(b.shape)
    return polygon.clip(A, b, stamp, source, most)


def unit(angles: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def ring(polygon: Polygon, item: int) -> np.ndarray:
    return polygon.vertices[item, : int(polygon.count[item])].numpy()


def perimeter(polygon: Polygon) -> Tensor:
    return (polygon.vertices - polygon.vertices.roll(-1, 1)).norm(dim=-1).sum(-1)


def rows_around(
    rng: np.random.Generator, truth: np.ndarray, rows: int, width: float = 1.0, needle: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of all scales that hold at `truth`; below width 1, two of them close in on it to about `width`."""
    count = len(truth)
    angles, distance = rng.uniform(0, 2 * np.pi, (count, rows)), rng.uniform(0.2, 3.0, (count, rows))
    if width < 1:
        heading = np.arange(count)[:, None] + rng.normal(size=(count, 2)) * (0.3 * width if needle else 0.0)
        angles[:, :2], distance[:, :2] = heading + np.array([0, np.pi]), rng.uniform(0.5, 1.0, (count, 2)) * width
    A = unit(angles) * 10 ** rng.uniform(-2, 2, (count, rows, 1))
    return A, (A * truth[:, None]).sum(-1) + distance * np.linalg.norm(A, axis=-1)


def random_polygons(seed: int, count: int = 40, rows: int = 8) -> tuple[Polygon, list[list[Point]]]:
    """Polygons with their exact rings."""
    rng = np.random.default_rng(seed)
    A, b = rows_around(rng, rng.uniform(-5, 5, (count, 2)), rows)
    exact_rings = [exact_intersection(exact_box((-BOX, -BOX), (BOX, BOX)), A[i], b[i]) for i in range(count)]
    return cut(boxes(count), A, b).body, exact_rings


def as_floats(exact_ring: list[Point]) -> np.ndarray:
    return np.array([[float(x), float(y)] for x, y in exact_ring])


# Against exact rationals (check 3) ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_vertices_area_and_centroid_are_the_exact_ones(seed: int):
    polygon, rings = random_polygons(seed)
    area, centroid = polygon.volume().numpy(), polygon.centroid().numpy()
    for i, exact_ring in enumerate(rings):
        assert int(polygon.count[i]) == len(exact_ring)
        apart = np.linalg.norm(ring(polygon, i)[:, None] - as_floats(exact_ring), axis=-1)
        assert max(apart.min(0).max(), apart.min(1).max()) < 1e-12 * BOX
        assert area[i] == pytest.approx(float(exact_area(exact_ring)), rel=1e-9)
        assert centroid[i] == pytest.approx([float(z) for z in exact_centroid(exact_ring)], abs=1e-9)


def test_edges_say_which_row_they_are_and_when_it_came():
    rng = np.random.default_rng(7)
    polygon, given_rows = boxes(20), {}
    for time in (1.0, 2.0, 3.0):
        A, b = rows_around(rng, np.zeros((20, 2)), 5)
        given_rows[time] = A, b
        polygon = cut(polygon, A, b, time).body
    for i in range(20):
        for k in range(int(polygon.count[i])):
            time, source = float(polygon.time[i, k]), int(polygon.source[i, k])
            if source >= 0:
                A, b = given_rows[time]
                assert (polygon.A[i, k].tolist(), float(polygon.b[i, k])) == (A[i, source].tolist(), b[i, source])
            ends = polygon.vertices[i, [k, (k + 1) % int(polygon.count[i])]]
            assert torch.allclose(ends @ polygon.A[i, k], polygon.b[i, k], rtol=1e-12, atol=1e-12 * 100)


# Thin sets (check 6), the truth kept, no growth (check 5) ------------------------------------------------------------


@pytest.mark.parametrize("needle", [False, True], ids=["strip", "needle"])
@pytest.mark.parametrize("width", [1e-3, 1e-6, 1e-9])
def test_thin_sets_keep_the_truth_and_their_area(width: float, needle: bool):
    """20 sets x 20 updates x 6 rows closing in on the truth. The error of the area is that of vertices displaced by
    round-off at the size of the prior box: absolute, so at width 1e-9 about 1e-6 of the area."""
    rng = np.random.default_rng(3)
    truth = rng.uniform(-5, 5, (20, 2))
    polygon, rings = boxes(20), [exact_box((-BOX, -BOX), (BOX, BOX))] * 20
    for step in range(20):
        A, b = rows_around(rng, truth, 6, max(width, 10.0**-step), needle)
        result = cut(polygon, A, b)
        assert (result.outcome == Status.OK).all()
        slivers = ROUND_OFF * BOX * perimeter(polygon)
        assert (result.body.volume() <= polygon.volume() + slivers).all()
        polygon = result.body
        rings = [exact_intersection(rings[i], A[i], b[i]) for i in range(20)]
    for i in range(20):
        x, y = exact(truth[i])
        edges = zip(polygon.A[i].numpy(), polygon.b[i].numpy(), strict=True)
        assert all(p * x + q * y <= c for (p, q), c in ((exact(row), Fraction(float(bound))) for row, bound in edges))
    assert torch.allclose(polygon.nearest(tensor(truth)), tensor(truth), rtol=0, atol=0)
    expected = tensor([float(exact_area(r)) for r in rings])
    error = (polygon.volume() - expected).abs()
    assert (error <= 0.25 * ROUND_OFF * BOX * perimeter(polygon)).all()
    assert (error / expected).max() < 1e-13 / width


def test_rows_that_touch_within_round_off_change_nothing():
    """Rows that cut a corner off by about the tolerance itself, so many that BLAS rounds batches differently."""
    rng = np.random.default_rng(0)
    before = boxes(128)
    normals = tensor(unit(rng.uniform(0, 2 * np.pi, (128, 100))))
    support = before.support(normals)
    room = ROUND_OFF * (normals.abs() * before.reach.unsqueeze(1)).sum(-1) + ROUND_OFF * support.abs()
    rows = normals, support - room * (1 + 0.005 * tensor(rng.uniform(-1, 1, (128, 100))))
    for most in (1000, 6):
        after = cut(before, *rows, most=most).body
        assert torch.allclose(after.volume(), before.volume(), rtol=1e-12)
        assert torch.allclose(after.chebyshev()[1], before.chebyshev()[1], rtol=1e-12)


def test_rows_of_a_disc_accumulate_without_overflow():
    angles = np.random.default_rng(4).permutation(400) * 2 * np.pi / 400
    polygon = boxes(2)
    for part in np.split(angles, 20):
        polygon = cut(polygon, np.stack([unit(part)] * 2), np.ones((2, 20))).body
    assert polygon.count.tolist() == [400, 400]
    assert polygon.volume().tolist() == pytest.approx([400 * math.tan(math.pi / 400)] * 2, rel=1e-12)
    assert polygon.chebyshev()[1].tolist() == pytest.approx([1, 1], rel=1e-12)
    assert polygon.diameter().tolist() == pytest.approx([2 / math.cos(math.pi / 400)] * 2, rel=1e-12)


# What is asked of a polygon -----------------------------------------------------------------------------------------


def test_support_and_diameter_by_brute_force():
    polygon, rings = random_polygons(10)
    directions = unit(np.random.default_rng(10).uniform(0, 2 * np.pi, (len(rings), 16)))
    support, diameter = polygon.support(tensor(directions)).numpy(), polygon.diameter().numpy()
    for i, points in enumerate(map(as_floats, rings)):
        assert support[i] == pytest.approx((directions[i] @ points.T).max(-1), abs=1e-12)
        assert diameter[i] == pytest.approx(max(np.linalg.norm(p - q) for p in points for q in points), rel=1e-12)


def test_chebyshev_disc_is_that_of_a_linear_programme():
    """HiGHS, about the centroid and in units of the diameter."""
    polygon, rings = random_polygons(11)
    centre, radius = polygon.chebyshev()
    for i in range(len(rings)):
        n, size, origin = int(polygon.count[i]), float(polygon.diameter()[i]), polygon.centroid()[i]
        A, b = polygon.A[i, :n], polygon.b[i, :n]
        norms = A.norm(dim=-1)
        rows, bounds = torch.column_stack([A / norms[:, None], torch.ones(n)]), (b - A @ origin) / norms / size
        answer = linprog([0, 0, -1], A_ub=rows.numpy(), b_ub=bounds.numpy(), bounds=[(None, None)] * 3)
        assert float(radius[i]) == pytest.approx(-answer.fun * size, rel=1e-8)
        assert float(((b - A @ centre[i]) / norms).min()) == pytest.approx(float(radius[i]), rel=1e-12)


@pytest.mark.parametrize("width", [1.0, 1e-3, 1e-6, 1e-9])
def test_chebyshev_radius_of_thin_sets_is_exact(width: float):
    rng = np.random.default_rng(12)
    polygon = cut(boxes(20), *rows_around(rng, rng.uniform(-5, 5, (20, 2)), 6, width, needle=True)).body
    radius = polygon.chebyshev()[1]
    for i in range(20):
        n = int(polygon.count[i])
        expected = exact_inscribed_radius(polygon.A[i, :n].numpy(), polygon.b[i, :n].numpy())
        assert float(radius[i]) == pytest.approx(expected, abs=4 * ROUND_OFF * BOX)


@pytest.mark.parametrize("euclidean", [True, False], ids=["euclidean", "metric"])
def test_nearest_point_is_that_of_a_quadratic_programme(euclidean: bool):
    polygon = random_polygons(13, count=100)[0]
    rng = np.random.default_rng(13)
    points = polygon.centroid().numpy() + rng.normal(size=(100, 2)) * rng.choice([0.1, 3.0], (100, 1))
    roots = np.stack([np.eye(2)] * 100) if euclidean else np.eye(2) + 0.7 * rng.normal(size=(100, 2, 2))
    metric = np.swapaxes(roots, 1, 2) @ roots
    nearest = polygon.nearest(tensor(points), None if euclidean else tensor(metric)).numpy()
    inside = 0
    for i in range(100):
        n = int(polygon.count[i])
        A, b = polygon.A[i, :n].numpy(), polygon.b[i, :n].numpy()
        # With w = root z the metric is Euclidean.
        solution = np.linalg.solve(roots[i], solve_qp(A @ np.linalg.inv(roots[i]), b, roots[i] @ points[i]))
        assert nearest[i] == pytest.approx(solution, abs=1e-8)
        inside += np.array_equal(nearest[i], points[i])
    assert 20 < inside < 80


# Merging ------------------------------------------------------------------------------------------------------------


def assert_outer(outer: Polygon, inner: Polygon) -> None:
    """Every vertex of `inner` is within round-off of `outer`, by rows and by the ring of vertices."""
    room = ROUND_OFF * BOX
    assert ((outer.A @ inner.vertices.transpose(1, 2) - outer.b[..., None]).amax((1, 2)) <= room).all()
    for i in range(len(inner.count)):
        for vertex in inner.vertices[i, : int(inner.count[i])]:
            ends = torch.from_numpy(ring(outer, i))
            edge = ends.roll(-1, 0) - ends
            right_of = (edge[:, 1] * (vertex - ends)[:, 0] - edge[:, 0] * (vertex - ends)[:, 1]) / edge.norm(dim=-1)
            assert right_of.max() <= room


@pytest.mark.parametrize(("most", "growth"), [(32, 0.004), (24, 0.007), (8, 0.08), (4, 0.6)])
def test_merge_is_outer_and_small(most: int, growth: float):
    """100 random tangents of a disc; `growth` is measured: a regular polygon of 24 sides has 0.6 % more than a disc."""
    rows = unit(np.random.default_rng(5).uniform(0, 2 * np.pi, (10, 100))), np.ones((10, 100))
    polygon, merged = cut(boxes(10), *rows).body, cut(boxes(10), *rows, most=most).body
    assert (merged.count <= most).all()
    assert_outer(merged, polygon)
    grown = merged.volume() / polygon.volume() - 1
    assert grown.min() >= 0
    assert grown.max() < growth


@pytest.mark.parametrize("thickness", [1e-3, 1e-6, 1e-9, 1e-10, 1e-11])
def test_merge_of_needles_is_outer(thickness: float):
    """60 tangents of a flat ellipse whose directions differ by less than its thickness."""
    rng = np.random.default_rng(6)
    normals = unit(np.pi / 2 * (-1.0) ** np.arange(60) + rng.uniform(-1, 1, (5, 60)) * thickness)
    rows = normals, 5 * np.hypot(normals[..., 0], thickness * normals[..., 1])
    polygon, merged = cut(boxes(5), *rows).body, cut(boxes(5), *rows, most=32).body
    assert (polygon.count > 32).all()
    assert (merged.count <= 32).all()
    assert_outer(merged, polygon)


def test_merge_leaves_a_parallelogram_alone():
    """Without any of its edges a parallelogram is unbounded: three of its rows make no outer polygon."""
    halved = cut(boxes(1), np.array([[[1.0, 0.0]]]), np.zeros((1, 1)), most=3).body
    assert halved.count.item() == 4
    assert halved.volume().item() == pytest.approx(2 * BOX * BOX)


# Emptiness, three-way -----------------------------------------------------------------------------------------------


def test_outcome_when_sets_touch():
    """At a vertex, along an edge, and a hair further off, a hair less, not at all."""
    rows = np.array([[[-1.0, -1.0]], [[-1.0, 0.0]], [[-1.0, -1.0]], [[-1.0, -1.0]], [[-1.0, 0.0]]])
    result = cut(boxes(5, half=1.0), rows, np.array([[-2.0], [-1.0], [-2.0 - 1e-13], [-2.0 + 1e-13], [-2.0]]))
    names = [Status(int(outcome)).name for outcome in result.outcome]
    assert names == ["UNDECIDED", "UNDECIDED", "EMPTY", "OK", "EMPTY"]
    area, diameter = result.body.volume(), result.body.diameter()
    assert area[[2, 4]].tolist() == [4.0] * 2  # of empty ones the polygon before
    assert area[[0, 1, 3]].max() < 1e-12
    assert diameter[[0, 1, 3]].tolist() == pytest.approx([0.0, 2.0, 0.0], abs=1e-12)
    assert result.shrunk.tolist() == [True, True, False, True, False]


def test_empty_intersection_leaves_the_polygon_as_it_was():
    """Also where rows of the same update have cut it before the one that empties it was reached."""
    rows, bounds = np.array([[[1.0, 0.0], [-1.0, 0.5], [0.0, 1.0]]] * 2), np.array([[-8.0, 2.0, 3.0], [2.0, 8.0, 3.0]])
    before = cut(boxes(2), np.array([[[1.0, 2.0]]] * 2), np.array([[9.0]] * 2), time=1.0).body
    result = cut(before, rows, bounds, time=2.0)
    assert result.outcome.tolist() == [Status.EMPTY, Status.OK]
    assert result.shrunk.tolist() == [False, True]
    assert torch.equal(result.body.volume()[:1], before.volume()[:1])
    assert result.body.count[0] == before.count[0]
    assert not (result.body.time[0] == 2.0).any()
    assert {0, 1} <= set(result.contradiction.source[0].tolist())


def test_emptiness_is_exactly_right_or_undecided():
    """Rows of small integers, which often touch exactly: a decided answer is the exact one, and its three rows exclude
    each other in exact rationals. 2 500 sequences of 3 rows at a time until an answer other than OK."""
    rng, count, table = np.random.default_rng(0), 2500, Counter()
    polygon, rings, going_on = boxes(count, half=5.0), [exact_box((-5, -5), (5, 5))] * count, np.ones(count, dtype=bool)
    while going_on.any():
        A, b = rng.integers(-3, 4, (count, 3, 2)).astype(float), rng.integers(-2, 6, (count, 3)) / 4
        A[(A == 0).all(-1)] = (1.0, 0.0)
        result = cut(polygon, A, b)
        polygon, against = result.body, result.contradiction
        for i in np.flatnonzero(going_on):
            rings[i] = exact_intersection(rings[i], A[i], b[i])
            truth = "empty" if not rings[i] else "flat" if exact_area(rings[i]) == 0 else "fat"
            outcome = Status(int(result.outcome[i]))
            table[truth, outcome.name] += 1
            going_on[i] = (truth, outcome) == ("fat", Status.OK)
            if outcome is Status.EMPTY:
                table["touching contradiction"] += exactly_feasible(against.A[i].numpy(), against.b[i].numpy())
    assert table["touching contradiction"] == 0
    assert table["flat", "UNDECIDED"] + table["empty", "UNDECIDED"] + table["empty", "EMPTY"] == count
    assert min(table["flat", "UNDECIDED"], table["empty", "EMPTY"] - 10 * table["empty", "UNDECIDED"]) > 200


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.floats(-4, 4), st.floats(0.05, 20), st.floats(-1, 3)), min_size=1, max_size=12))
def test_any_sequence_of_rows(rows: list[tuple[float, float, float]]):
    """Rows (angle, scale, distance), one at a time: no growth, and the exact answer up to round-off at every step."""
    polygon, exact_ring = boxes(1), exact_box((-BOX, -BOX), (BOX, BOX))
    for angle, scale, distance in rows:
        A, b = scale * unit(np.array([[angle]])), np.array([[scale * distance]])
        result = cut(polygon, A, b)
        area = polygon.volume()
        polygon, exact_ring = result.body, exact_intersection(exact_ring, A[0], b[0])
        assert (polygon.volume() <= area + ROUND_OFF * BOX * perimeter(polygon)).all()
        assert result.outcome != Status.EMPTY or not exact_ring
        if result.outcome != Status.OK or not exact_ring:
            return
        room = 2 * ROUND_OFF * BOX * float(perimeter(polygon))
        assert float(polygon.volume()) == pytest.approx(float(exact_area(exact_ring)), abs=room)
