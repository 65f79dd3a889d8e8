"""Check 8: first and second derivatives against finite differences, with padding, ties and orthogonal equal rows.

Every clip costs: second derivatives through one are compared along random directions (`fast_mode`), seeded.

Where a quantity has a kink (tied rows) gradcheck has no answer to compare with: there the gradients are checked by sums
that any one-sided choice must have, or along parameters that move the tied rows together.
"""

import math
import weakref

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from tests.problems import CASES, batch, paper_case, random_scene
from tests.reference_clip import Rings
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.critical_region import critical_region, region_of
from torchfsid.identification.inverse_optimal import inverse_optimal_set
from torchfsid.identification.kkt import solve_unit
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.polygon import Polygon

OUTSIDE = torch.tensor([[4.0, 3.5], [-3.0, 5.0]], dtype=torch.float64).repeat(100, 1)
DIRECTIONS = torch.tensor([[[0.6, 0.8]], [[-1.0, 0.3]]], dtype=torch.float64).repeat(100, 1, 1)
METRIC = torch.tensor([[2.0, 0.7], [0.7, 1.0]], dtype=torch.float64).repeat(200, 1, 1)


def measures(polygon: Polygon) -> tuple[Tensor, ...]:
    """Everything that is asked of a polygon; in one function, so that each finite difference costs one clip."""
    B = len(polygon.count)
    return (
        polygon.volume(), polygon.centroid(), *polygon.chebyshev(), polygon.diameter(), polygon.support(DIRECTIONS[:B]),
        polygon.nearest(OUTSIDE[:B]), polygon.nearest(OUTSIDE[:B], METRIC[:B]),
    )  # fmt: skip


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def clipped_box(A: Tensor, b: Tensor) -> Polygon:
    half = torch.full((len(b), 2), 2.0, dtype=torch.float64)
    time = torch.zeros(b.shape, dtype=torch.float64)
    return Polygon.from_box(-half, half).clip(A, b, time, torch.zeros(b.shape, dtype=torch.long), 1000).body


def ragged_rows() -> tuple[Tensor, Tensor]:
    """Two polygons of 7 and 3 edges; a padding row, a redundant row and a cut-away corner."""
    pi = math.pi
    angles = torch.tensor([[0.3, 1.1, 2.4, 3.9, 5.0], [0.5, 0.5 + 2 * pi / 3, 0.4 + 4 * pi / 3, 1.0, 2.0]])
    A = torch.stack([angles.cos(), angles.sin()], dim=-1).double() * torch.tensor([1, 3, 0.5, 2, 1]).unsqueeze(-1)
    b = A.norm(dim=-1) * torch.tensor([[1.0, 1.2, 1.9, 2.4, 1.9], [0.6, 0.7, 0.8, 9.0, 9.0]])
    A[1, 4], b[1, 4] = 0.0, 1.0
    return A.requires_grad_(), b.requires_grad_()


def test_measures_of_a_clipped_box():
    A, b = ragged_rows()
    assert clipped_box(A, b).count.tolist() == [7, 3]

    assert gradcheck(lambda A, b: measures(clipped_box(A, b)), (A, b))
    assert gradgradcheck(lambda A, b: measures(clipped_box(A, b)), (A, b), fast_mode=True)


def test_orthogonal_equal_rows_turned_by_45_degrees():
    """Where the derivative of an SVD is wrong or NaN."""
    A = torch.tensor([[[1.0, 1.0], [1.0, -1.0]]], dtype=torch.float64).mul(math.sqrt(0.5)).requires_grad_()
    b = torch.tensor([[0.7, 0.8]], dtype=torch.float64, requires_grad=True)

    assert gradcheck(lambda A, b: measures(clipped_box(A, b)), (A, b))
    assert gradgradcheck(lambda A, b: measures(clipped_box(A, b)), (A, b), fast_mode=True)


def test_tied_rows_that_move_together():
    """Every row three times, at different scales: as a function of the one row behind them, nothing has a kink."""
    A, b = ragged_rows()
    scale = torch.tensor([1.0, 3.0, 0.7]).repeat_interleave(5).double()

    def tripled(A: Tensor, b: Tensor) -> tuple[Tensor, ...]:
        return measures(clipped_box(A.repeat(1, 3, 1) * scale.unsqueeze(-1), b.repeat(1, 3) * scale))

    assert gradcheck(tripled, (A, b))
    assert gradgradcheck(tripled, (A, b), fast_mode=True)


def test_tied_rows_share_their_gradient():
    """d(area)/db over rows on one line sums to the edge's length; d(radius)/db over all the edges sums to 1."""
    A = torch.tensor([[1.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=torch.float64).unsqueeze(0)
    b = torch.ones(1, 5, dtype=torch.float64, requires_grad=True)
    square = clipped_box(A, b)
    (of_area,) = torch.autograd.grad(square.volume().sum(), b, retain_graph=True)
    assert of_area[0, :2].sum() == pytest.approx(2.0)
    (of_radius,) = torch.autograd.grad(square.chebyshev()[1].sum(), b)
    assert of_radius.sum() == pytest.approx(1.0)
    assert of_radius.min() >= 0


def test_nearest_point_and_metric():
    polygon = clipped_box(*ragged_rows())
    inputs = OUTSIDE[:2].clone().requires_grad_(), METRIC[:2].clone().requires_grad_()
    assert gradcheck(polygon.nearest, inputs)
    inner = torch.zeros(2, 2, dtype=torch.float64, requires_grad=True)
    jacobian = torch.autograd.functional.jacobian(polygon.nearest, inner)
    assert torch.equal(jacobian[0, :, 0], torch.eye(2, dtype=torch.float64))


# Which rows a derivative belongs to ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("upper", "row", "slopes"),
    [
        ([1.0, 1.0], [1.0, 1.0], (1.0, 1 / 3, 1.0)),
        ([1.0, 3.0], [1.0, 1.0], (1.0, 1 / 3, 1.0)),  # through one corner
        ([1.0, 2.0], [1.0, 2.0], (0.5, 1 / 3, 1.0)),
    ],
)
def test_a_cut_through_a_corner_has_the_derivative_of_its_facet(upper: list, row: list, slopes: tuple):
    """V, c_x and h(1, 1): a triangle with legs b / row; at b = 1 the derivatives from both sides, or one of the two."""
    b = torch.ones(1, 1, dtype=torch.float64, requires_grad=True)
    corner = torch.tensor([upper], dtype=torch.float64)
    polygon = Polygon.from_box(torch.zeros_like(corner), corner)
    A, nothing = torch.tensor([[row]], dtype=torch.float64), torch.zeros(1, 1, dtype=torch.long)
    triangle = polygon.clip(A, b, torch.zeros(1, 1, dtype=torch.float64), nothing, 8).body
    asked = triangle.volume(), triangle.centroid()[:, 0], triangle.support(torch.ones(1, 1, 2).double())
    found = [torch.autograd.grad(answer.sum(), b, retain_graph=True)[0].item() for answer in asked]
    assert found == pytest.approx(slopes, rel=1e-12)


def test_a_thin_set_far_away_sweeps_with_all_of_its_facets():
    """An integer parallelogram 1e-2 wide at 1e6: dV/db of each edge is its length over the length of its row."""
    A = torch.tensor([[[100.0, 1.0], [-100.0, -1.0], [1.0, 100.0], [-1.0, -100.0]]], dtype=torch.float64)
    b = torch.tensor([[101e6 + 1, -101e6, 101e6 + 1, -101e6]], dtype=torch.float64, requires_grad=True)
    corner = torch.full((1, 2), 1e6, dtype=torch.float64)
    polygon = Polygon.from_box(corner - 4e-9, corner + 1.0)
    cut = polygon.clip(A, b, torch.zeros(1, 4, dtype=torch.float64), torch.arange(4).expand(1, 4), 8).body
    (slopes,) = torch.autograd.grad(cut.volume().sum(), b)
    ends = cut.corners[0, : int(cut.count)]
    for row, source in zip(cut.A[0], cut.source[0], strict=True):
        if source >= 0:
            edge = int((cut.source[0] == source).nonzero())
            length = (ends[(edge + 1) % len(ends)] - ends[edge]).norm()
            assert slopes[0, source].item() == pytest.approx(float(length / row.norm()), rel=1e-6)
    assert (slopes > 0).any()


def test_gradients_are_those_of_clips_in_torch():
    """Area and centroid after ten clips, down to a size of 1e-6."""
    rng, count, size = np.random.default_rng(8), 50, 10.0
    truth, corner = torch.from_numpy(rng.uniform(-1, 1, (count, 1, 2))), torch.full((count, 2), 3.0).double()
    rows, polygon, rings = [], Polygon.from_box(-corner, corner), Rings.boxes(-corner, corner)
    for _ in range(10):
        angle, distance = rng.uniform(0, 2 * np.pi, (count, 6)), rng.uniform(0.2, 1, (count, 6)) * size
        A = torch.from_numpy(np.stack([np.cos(angle), np.sin(angle)], axis=-1))
        b = (A * truth).sum(-1) + torch.from_numpy(distance)
        rows += [A.requires_grad_(), b.requires_grad_()]
        polygon = polygon.clip(A, b, torch.zeros(count, 6).double(), torch.zeros(count, 6).long(), 32).body
        rings, size = rings.clip(A, b), 0.2 * size
    torch.testing.assert_close(polygon.volume(), rings.area(), rtol=1e-9, atol=0)
    for mine, other in ((polygon.volume().log(), rings.area().log()), (polygon.centroid(), rings.centroid())):
        found, expected = (torch.autograd.grad(x.sum(), rows, retain_graph=True, materialize_grads=True)
                           for x in (mine, other))  # fmt: skip
        scale = max(float(slope.abs().max()) for slope in expected)
        for slope, other_slope in zip(found, expected, strict=True):
            torch.testing.assert_close(slope, other_slope, rtol=0, atol=1e-8 * scale)


def test_memory_is_facets():
    """After 300 differentiable clips, few rows are kept, and the graphs of clips that left no facet are gone."""
    rng, graphs = np.random.default_rng(9), []
    corner = torch.full((3, 2), 9.0, dtype=torch.float64)
    polygon, b = Polygon.from_box(-corner, corner), torch.zeros(3, 4).double().requires_grad_()
    for k in range(300):
        angle = rng.uniform(0, 2 * np.pi, (3, 4))
        A = torch.from_numpy(np.stack([np.cos(angle), np.sin(angle)], axis=-1))
        right = b + 8 * 0.99**k
        graphs.append(weakref.ref(right))
        polygon = polygon.clip(A, right, torch.zeros(3, 4).double(), torch.zeros(3, 4).long(), 12).body
        assert polygon.sheets.rows <= 2 * polygon.label.numel()
    del right
    assert sum(graph() is not None for graph in graphs) <= 36
    assert len(polygon.sheets.sheets) <= 36
    assert torch.autograd.grad(polygon.volume().sum(), b)[0].abs().sum() > 0
    fresh = polygon.clip(torch.zeros(3, 1, 2).double(), torch.ones(3, 1).double(), torch.zeros(3, 1).double(),
                         torch.zeros(3, 1).long(), 12).body  # fmt: skip
    assert fresh is polygon


# The sets -----------------------------------------------------------------------------------------------------------


ON_ONE_LINE = ("C same side", "C opposite", "E half-plane")


def region_rows(A: Tensor, b: Tensor, active: Tensor, C: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    region = critical_region(Halfspaces(A, b), active, C, d)
    return region.A, region.b


@pytest.mark.parametrize("case", CASES)
def test_critical_region(case: str):
    """With respect to b, C, d and A, but to A not where rows lie on one line: there the set is not continuous in A."""
    scene = paper_case(case, np.random.default_rng(4))
    A, active, b, C, d = (torch.from_numpy(part) for part in (scene.A, scene.active, scene.b, scene.C, scene.d))
    inputs = (
        A.requires_grad_(case not in ON_ONE_LINE),
        b.requires_grad_(),
        active,
        C.requires_grad_(),
        d.requires_grad_(),
    )
    assert gradcheck(region_rows, inputs)
    assert gradgradcheck(region_rows, inputs)


def test_forward_derivatives_and_products_with_many_vectors_at_once():
    scene = paper_case("D", np.random.default_rng(4))
    A, active, b, C, d = (torch.from_numpy(part) for part in (scene.A, scene.active, scene.b, scene.C, scene.d))
    A, b = A.requires_grad_(), b.requires_grad_()
    assert gradcheck(region_rows, (A, b, active, C, d), check_forward_ad=True, check_batched_grad=True, fast_mode=True)
    assert gradcheck(lambda A, b: clipped_box(A, b).volume(), ragged_rows(), check_batched_grad=True, fast_mode=True)


def test_compiled_critical_regions_are_those_of_torch():
    """Of 300 random scenes and all cases in one batch: rows, names, derivatives."""
    rng = np.random.default_rng(8)
    scenes = [random_scene(rng, int(rng.integers(1, 9))) for _ in range(300)]
    safe, active, _, C, d = batch([*scenes, *(paper_case(case, rng) for case in CASES)])
    leaves = [part.requires_grad_() for part in (safe.A, safe.b, C, d)]
    rows, found = Halfspaces(*leaves[:2]), []
    unit = rows.normalised()
    reference = region_of(unit, solve_unit(unit, active, C, d), C, d)
    is_row = (reference.A != 0).any(-1)
    weights = torch.from_numpy(rng.normal(size=(2, *reference.b.shape)))
    for region in (critical_region(rows, active, C, d), reference):
        value = (weights[0] * region.A.sum(-1) + weights[1] * region.b)[is_row].sum()
        found.append([region.A, region.b, *torch.autograd.grad(value, leaves)])
        assert region.source is not None
        found[-1].append(region.source[is_row])
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)


def test_padding_is_not_active_whatever_is_said_of_it():
    """Neither in compiled code, nor in torch's, whose derivatives are differentiated again."""
    A, b = torch.tensor([[[-1.0, 1.0], [0.0, 0.0]]], dtype=torch.float64), torch.ones(1, 2, dtype=torch.float64)
    C, d, grads = torch.eye(2, dtype=torch.float64)[None], torch.zeros(1, 2, dtype=torch.float64), []
    for said, again in ((True, False), (True, True), (False, False)):
        region = critical_region(Halfspaces(A, b), torch.tensor([[True, said]]), C.requires_grad_(), d)
        grads += torch.autograd.grad(region.A.square().sum(), C, create_graph=again)
    assert grads[2].abs().max() > 0
    torch.testing.assert_close(grads[0], grads[2], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(grads[1], grads[2], rtol=1e-12, atol=1e-12)


def test_critical_region_at_orthogonal_equal_rows():
    A = torch.tensor([[1.0, 1.0], [1.0, -1.0], [0.3, 1.0]], dtype=torch.float64, requires_grad=True)
    b = torch.tensor([0.5, 0.5, 4.0], dtype=torch.float64, requires_grad=True)
    C, d = torch.eye(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    active = torch.tensor([True, True, False])
    assert gradcheck(lambda A, b: region_rows(A, b, active, C, d), (A, b))
    assert gradgradcheck(lambda A, b: region_rows(A, b, active, C, d), (A, b))


@pytest.mark.parametrize("case", CASES)
def test_inverse_optimal_set(case: str):
    """With respect to the control, the task and, where the set is continuous in them, the rows."""
    scene = paper_case(case, np.random.default_rng(5))
    A, b, u, C, d = (torch.from_numpy(part) for part in (scene.A, scene.b, scene.u, scene.C, scene.d))
    if case not in ON_ONE_LINE:
        A.requires_grad_()

    def rows(A: Tensor, u: Tensor, C: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        safe = inverse_optimal_set(Halfspaces(A, b), u, C, d, NoiseBound(0.05))
        return safe.A, safe.b

    assert gradcheck(rows, (A, u.requires_grad_(), C.requires_grad_(), d.requires_grad_()))
    assert gradgradcheck(rows, (A, u, C, d))


def scene_of_positions(x: Tensor, bodies: Tensor, present: Tensor) -> tuple[Halfspaces, Tensor, Tensor]:
    measurement = Measurement(t=0.0, x=x, u=None, bodies=bodies, present=present)
    safe_controls = CollisionAvoidance(ClassK(1.5), safety_distance=0.5)(measurement)
    return safe_controls, *GoalTask(0.8)(measurement)


@pytest.mark.parametrize("kind", ["critical region", "inverse optimal"])
def test_area_as_a_function_of_positions_and_control(kind: str):
    """The whole chain, from where the bodies are to the area of the set; one slot of the bodies is empty."""
    x = torch.tensor([[0.1, -0.2]], dtype=torch.float64, requires_grad=True)
    places = [[[1.2, 0.4], [0.9, -1.1], [-2.0, 0.5], [0.0, 0.0]]]
    bodies = torch.tensor(places, dtype=torch.float64, requires_grad=True)
    present = torch.tensor([[True, True, True, False]])
    active = torch.tensor([[True, True, False, False]])
    safe_controls, _, _ = scene_of_positions(x, bodies, present)
    u = torch.linalg.solve(safe_controls.A[:, :2], safe_controls.b[:, :2]).detach().requires_grad_()

    def area(x: Tensor, bodies: Tensor, u: Tensor) -> Tensor:
        safe_controls, C, d = scene_of_positions(x, bodies, present)
        if kind == "critical region":
            theta = critical_region(safe_controls, active, C, d)
        else:
            theta = inverse_optimal_set(safe_controls, u, C, d, NoiseBound(0.05))
        half = torch.full((1, 2), 6.0, dtype=torch.float64)
        source = torch.zeros(theta.b.shape, dtype=torch.long)
        time = torch.zeros(theta.b.shape, dtype=torch.float64)
        return Polygon.from_box(-half, half).clip(theta.A, theta.b, time, source, 1000).body.volume()

    assert 1 < area(x, bodies, u) < 100
    assert gradcheck(area, (x, bodies, u))
    assert gradgradcheck(area, (x, bodies, u), fast_mode=True)


def test_gradients_of_random_scenes_are_finite():
    """200 scenes in one batch, ragged by padding, every measure, both sets."""
    rng, count = np.random.default_rng(6), 200
    safe_controls, active, *task = batch([random_scene(rng, int(rng.integers(1, 9))) for _ in range(count)])
    leaves = [leaf.requires_grad_() for leaf in (safe_controls.A, safe_controls.b, *task)]
    safe_controls, (u, C, d) = Halfspaces(*leaves[:2]), leaves[2:]
    sets = critical_region(safe_controls, active, C, d), inverse_optimal_set(safe_controls, u, C, d, NoiseBound(0.1))
    for theta in sets:
        polygon = clipped_box(theta.A / 5, theta.b / 5 - (theta.A @ torch.ones(2).double()) / 50)
        for measure in measures(polygon):
            gradients = torch.autograd.grad(measure.sum(), leaves, retain_graph=True, allow_unused=True)
            assert all(gradient is None or gradient.isfinite().all() for gradient in gradients)
            assert any(gradient is not None and gradient.abs().max() > 0 for gradient in gradients)
