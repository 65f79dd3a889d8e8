"""Check 8 beyond the plane: derivatives of polytopes against finite differences, areas that are known, and polygons."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from tests.polytopes import Solid, kind_for
from torchfsid.halfspaces import Halfspaces
from torchfsid.observers.set_membership import SetKind, SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import UnknownGainGoalTask
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.sets.polygon import Polygon

DIMENSIONS = [1, 3, 4]


def tensor(values: object) -> Tensor:
    return torch.as_tensor(np.asarray(values, dtype=float))


def corners(p: int, half: float, count: int) -> tuple[Tensor, Tensor]:
    upper = torch.full((count, p), half, dtype=torch.float64)
    return -upper, upper


def clipped(A: Tensor, b: Tensor, body: Solid | None = None, half: float = 2.0) -> Solid:
    """A box (or body) cut by rows (B, R, p)."""
    body = kind_for(A.shape[-1]).from_box(*corners(A.shape[-1], half, len(A))) if body is None else body
    time, source = torch.zeros(b.shape, dtype=torch.float64), torch.zeros(b.shape, dtype=torch.long)
    return body.clip(A, b, time, source, 1000).body


def ragged_rows(p: int) -> tuple[Tensor, Tensor]:
    """Two simple polytopes, the second of fewer facets: padding, a redundant row, rows of different scales."""
    generator, R = torch.Generator().manual_seed(p), 1 if p == 1 else 6
    A = torch.randn(2, R, p, generator=generator, dtype=torch.float64)
    b = A.norm(dim=-1) * (0.7 + torch.rand(2, R, generator=generator, dtype=torch.float64))
    if p > 1:
        b[0, 5] = 20.0
        A[1, 3:], b[1, 3:] = 0.0, 1.0
    return A.requires_grad_(), b.requires_grad_()


def given(p: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points outside, directions, and factors of metrics."""
    generator = torch.Generator().manual_seed(p + 10)
    points = 2.0 + torch.rand(2, p, generator=generator, dtype=torch.float64)
    directions = torch.randn(2, 3, p, generator=generator, dtype=torch.float64)
    return points, directions, torch.randn(2, p, p, generator=generator, dtype=torch.float64)


def metric(factor: Tensor) -> Tensor:
    return factor @ factor.mT + torch.eye(factor.shape[-1], dtype=factor.dtype)


def measures(body: Solid, points: Tensor, directions: Tensor, factors: Tensor) -> dict[str, Tensor]:
    centre, radius = body.chebyshev()
    return {
        "volume": body.volume(), "centroid": body.centroid(), "vertices": body.vertices, "centre": centre,
        "radius": radius, "diameter": body.diameter(), "support": body.support(directions),
        "nearest": body.nearest(points), "nearest in a metric": body.nearest(points, metric(factors)),
        "nearest to a point inside": body.nearest(0.01 * points), "A": body.rows()[0], "b": body.rows()[1],
    }  # fmt: skip


# Finite differences -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("p", DIMENSIONS)
def test_measures_of_a_clipped_box(p: int) -> None:
    """With respect to the rows, points, directions and metric; twice."""
    rows, others = ragged_rows(p), given(p)
    assert int(clipped(*rows).count.min()) < int(clipped(*rows).count.max()) or p == 1
    for other in others:
        other.requires_grad_()

    def of(A: Tensor, b: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
        return tuple(measures(clipped(A, b), *others).values())

    assert gradcheck(of, (*rows, *others), fast_mode=p == 4)
    torch.manual_seed(0)
    assert gradgradcheck(of, (*rows, *others), fast_mode=True)


@pytest.mark.parametrize("p", DIMENSIONS)
def test_the_box_that_a_set_begins_with(p: int) -> None:
    A, b = (rows.detach() for rows in ragged_rows(p))
    lower, upper = (corner.requires_grad_() for corner in corners(p, 2.0, 2))

    def of(lower: Tensor, upper: Tensor) -> tuple[Tensor, ...]:
        body = clipped(A, b, kind_for(p).from_box(lower, upper))
        return body.volume(), body.centroid(), body.vertices, *body.chebyshev()

    assert gradcheck(of, (lower, upper))


def central_differences(of: object, *leaves: Tensor, step: float = 1e-6) -> list[Tensor]:
    found = []
    for k, leaf in enumerate(leaves):
        difference = torch.zeros_like(leaf)
        for j in range(leaf.numel()):
            for sign in (1.0, -1.0):
                moved = [other.detach().clone() for other in leaves]
                moved[k].view(-1)[j] += sign * step
                difference.view(-1)[j] += sign * float(of(*moved)) / (2 * step)  # type: ignore[operator]
        found.append(difference)
    return found


SEVERAL_FACETS_MEET = {
    "pyramid": ([[1.0, 0, 1], [-1, 0, 1], [0, 1, 1], [0, -1, 1], [0, 0, -1]], [1.0, 1, 1, 1, 0]),
    "octahedron": (list(product([-1.0, 1], repeat=3)), [1.0] * 8),
    "cross polytope, p = 4": (list(product([-1.0, 1], repeat=4)), [1.0] * 16),
    "cube cut in three vertices": ([[1.0, 1, 1]], [2.0]),
    "cube cut along an edge": ([[1.0, 1, 0.0]], [0.0]),
}


@pytest.mark.parametrize("name", SEVERAL_FACETS_MEET)
def test_volume_and_centroid_where_more_facets_meet_than_dimensions(name: str) -> None:
    """Their first derivatives exist there, though those of the vertices do not."""
    A, b = (tensor(part)[None].requires_grad_() for part in SEVERAL_FACETS_MEET[name])
    weights = torch.arange(1.0, A.shape[-1] + 1, dtype=torch.float64)
    for of in (lambda body: body.volume().sum(), lambda body: (body.centroid() @ weights).sum()):
        found = torch.autograd.grad(of(clipped(A, b)), (A, b))
        expected = central_differences(lambda A, b, of=of: of(clipped(A, b)), A, b)
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=1e-5)  # the second ones may jump


# Known answers ------------------------------------------------------------------------------------------------------


def turned_block(widths: list[float], seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A block of these widths, turned, away from the origin: its rows, its middle, and the middles of its sides."""
    p, rng, w = len(widths), np.random.default_rng(seed), tensor(widths)
    axes, middle = tensor(np.linalg.qr(rng.normal(size=(p, p)))[0]), tensor(rng.uniform(-1, 1, p))
    A = torch.cat([axes, -axes])
    b = A @ middle + w.repeat(2) / 2
    return A[None].requires_grad_(), b[None].requires_grad_(), middle, middle + A.detach() * (w.repeat(2) / 2)[:, None]


@pytest.mark.parametrize("width", [1.0, 1e-3, 1e-6])
@pytest.mark.parametrize("p", [3, 4])
def test_blocks_down_to_thin_ones(p: int, width: float) -> None:
    """dV/db is the area of a side, dV/dA that times its middle, d2V/db2 the volume over two widths."""
    widths = [width, 0.8, 1.5, 0.7][:p]
    A, b, _, sides = turned_block(widths)
    body, w, relative = clipped(A, b, half=5.0), tensor(widths), 1e-12 + 1e-14 / width
    area = (w.prod() / w).repeat(2)
    of_A, of_b = torch.autograd.grad(body.volume(), (A, b), create_graph=True)
    torch.testing.assert_close(of_b[0], area, rtol=relative, atol=0)
    torch.testing.assert_close(of_A[0], -area[:, None] * sides, rtol=0, atol=relative)
    hessian = torch.stack([torch.autograd.grad(entry, b, retain_graph=True)[0][0] for entry in of_b[0]])
    expected = w.prod() / (w[:, None] * w) * (1 - torch.eye(p, dtype=torch.float64))
    torch.testing.assert_close(hessian, expected.repeat(2, 2), rtol=0, atol=1e-12)

    normals = A.detach()[0]
    # A side that moves outward by 1 takes the centroid along by 1/2: as exactly as rows that may be tilted by one
    # rounding error allow, which is worth 1e-16 of the length across a thin set, and 1e-16 / width^2 here.
    for k in range(p):
        (of_b,) = torch.autograd.grad(body.centroid()[0, k], b, retain_graph=True)
        torch.testing.assert_close(of_b[0], normals[:, k] / 2, rtol=0, atol=1e-12 + 1e-16 / width**2)
    (of_b,) = torch.autograd.grad(body.chebyshev()[1].sum(), b, retain_graph=True)
    torch.testing.assert_close(of_b[0], ((w == w.min()).double() / 2).repeat(2), rtol=0, atol=1e-12)
    beyond = (sides[0] + normals[0] + 0.1 * normals[1])[None]
    (of_b,) = torch.autograd.grad((body.nearest(beyond) @ normals[0]).sum(), b, retain_graph=True)
    torch.testing.assert_close(of_b[0], torch.eye(2 * p, dtype=torch.float64)[0], rtol=0, atol=1e-12)
    (of_b,) = torch.autograd.grad((body.vertices[0] @ normals[0]).max(), b)
    torch.testing.assert_close(of_b[0], torch.eye(2 * p, dtype=torch.float64)[0], rtol=0, atol=1e-9)


def test_in_the_plane_polygons_have_the_same_derivatives() -> None:
    """First and second ones, by two implementations that share nothing but their interface."""
    generator = torch.Generator().manual_seed(2)
    A = torch.randn(3, 8, 2, generator=generator, dtype=torch.float64).requires_grad_()
    b = (A.detach().norm(dim=-1) * torch.linspace(0.6, 1.6, 8, dtype=torch.float64)).requires_grad_()
    points, factors = 3 * torch.ones(3, 2, dtype=torch.float64), torch.randn(3, 2, 2, generator=generator).double()
    time, source = torch.zeros(3, 8, dtype=torch.float64), torch.zeros(3, 8, dtype=torch.long)
    polygon = Polygon.from_box(*corners(2, 2.0, 3)).clip(A, b, time, source, 1000).body
    weights = torch.randn(3, 2, generator=generator).double()
    derivatives = []
    for body in (clipped(A, b), polygon):
        asked = {
            "volume": body.volume(), "centroid": body.centroid(), "radius": body.chebyshev()[1],
            "centre": body.chebyshev()[0], "diameter": body.diameter(), "support": body.support(weights.unsqueeze(1)),
            "nearest": body.nearest(points), "in a metric": body.nearest(points, metric(factors)),
        }  # fmt: skip
        found = {}
        for name, value in asked.items():
            weighted = (value.reshape(3, -1) * weights[:, : value.numel() // 3]).sum()
            first = torch.autograd.grad(weighted, (A, b), create_graph=True)
            total = torch.stack([part.square().sum() for part in first]).sum()
            found[name] = (*first, *torch.autograd.grad(total, (A, b), retain_graph=True))
        derivatives.append(found)
    torch.testing.assert_close(*derivatives, rtol=1e-9, atol=1e-9)


# Batches, histories, rough data -------------------------------------------------------------------------------------


def test_a_batch_is_its_items() -> None:
    """Through select, replaced and merging too; an item that was put aside gets nothing."""
    (A, b), others = ragged_rows(3), given(3)
    order = torch.tensor([1, 0])
    body = clipped(A, b)
    body = body.select(order).replaced(torch.tensor([0]), body.select(order[:1]).merge(7))
    for name, value in measures(body, *others).items():
        together = torch.autograd.grad(
            value.reshape(2, -1).amax(-1).sum(), (A, b), retain_graph=True, materialize_grads=True
        )
        for i, place in enumerate(order.tolist()):
            rows = A[i : i + 1].detach().requires_grad_(), b[i : i + 1].detach().requires_grad_()
            alone = clipped(*rows).merge(7) if place == 0 else clipped(*rows)
            value = measures(alone, *(other[place : place + 1] for other in others))[name].amax()
            apart = torch.autograd.grad(value, rows, materialize_grads=True)
            for one, other in zip(apart, together, strict=True):
                torch.testing.assert_close(one[0], other[i], rtol=1e-12, atol=1e-12)
    only = body.select(order[:1]).volume().sum()
    assert torch.autograd.grad(only, b)[0][1].abs().max() == 0


@pytest.mark.parametrize("kind", ["random", "integers", "near repetitions", "needles"])
@pytest.mark.parametrize("p", DIMENSIONS)
def test_gradients_of_rough_sets_are_finite(p: int, kind: str) -> None:
    """Rows through the truth, repeated up to round-off, closing in to 1e-12; first and second derivatives."""
    for seed in range(4):
        rng, leaves = np.random.default_rng([p, seed]), []
        truth, body = np.round(rng.uniform(-4, 4, p)), kind_for(p).from_box(*corners(p, 10.0, 1))
        for step in range(8):
            A = rng.normal(size=(5, p)) * np.exp(rng.normal(size=(5, 1)))
            slack = 3 * 0.7**step * rng.exponential(size=5) * np.linalg.norm(A, axis=1)
            if kind == "integers":
                A, slack = rng.integers(-3, 4, size=(5, p)).astype(float), rng.integers(0, 4, size=5) * 0.3
            if kind == "near repetitions":
                own = body.A[0, rng.integers(int(body.count), size=4)].detach().numpy()
                A[1:] = own * (1 + rng.normal(size=(4, p)) * 10 ** rng.uniform(-16, -8, size=(4, 1)))
            if kind == "needles" and step > 3:
                A[1] = -A[0] + 10 ** rng.uniform(-12, -1) * rng.normal(size=p)
                slack[:2] = 10 ** rng.uniform(-12, -3) * np.linalg.norm(A[:2], axis=1)
            rows = tensor(A)[None].requires_grad_(), tensor(A @ truth + slack)[None].requires_grad_()
            leaves += rows
            body = clipped(*rows, body).merge(20)
        q, factor = tensor(truth + rng.normal(size=p))[None], tensor(rng.normal(size=(1, p, p)))
        for value in measures(body, q, tensor(rng.normal(size=(1, 2, p))), factor).values():
            first = torch.autograd.grad(value.sum(), leaves, create_graph=True, materialize_grads=True)
            assert all(gradient.isfinite().all() for gradient in first)
            total = torch.stack([gradient.square().sum() for gradient in first]).sum()
            if total.requires_grad:
                second = torch.autograd.grad(total, leaves, retain_graph=True, materialize_grads=True)
                assert all(gradient.isfinite().all() for gradient in second)
        of_volume = torch.autograd.grad(body.volume().sum(), leaves[1::2], materialize_grads=True)
        assert (sum(float(gradient.sum()) for gradient in of_volume) > 0) == (body.volume() > 0)


def test_where_no_gradient_is_required_there_is_none_and_numbers_do_not_depend_on_it() -> None:
    (A, b), others = ragged_rows(3), given(3)
    with_gradients = measures(clipped(A, b), *others)
    assert all(value.requires_grad for value in with_gradients.values())
    detached = measures(clipped(A.detach(), b.detach()), *others)
    with torch.no_grad():
        forbidden = measures(clipped(A, b), *others)
    for name, value in with_gradients.items():
        assert not detached[name].requires_grad
        assert not forbidden[name].requires_grad
        assert torch.equal(value, detached[name])
        assert torch.equal(value, forbidden[name])


@pytest.mark.parametrize("p", [1, 3])
def test_the_graph_has_the_size_of_the_facets(p: int) -> None:
    """After 200 cuts. The gradient of the volume is that of scaling the set."""
    rng, scale = np.random.default_rng(p), torch.ones((), dtype=torch.float64, requires_grad=True)
    body = kind_for(p).from_box(*corners(p, 9.0, 2))
    for k in range(200):
        A = tensor(rng.normal(size=(2, 4, p)))
        body = clipped(A, scale * A.norm(dim=-1) * 0.97**k, body)
    volume = body.volume().sum()
    nodes, found = [volume.grad_fn], set()
    while nodes:
        if (node := nodes.pop()) not in found:
            found.add(node)
            nodes += [before for before, _ in node.next_functions if before is not None]
    assert len(found) <= 20 + 10 * int(body.count.sum())
    assert torch.autograd.grad(volume, scale)[0].item() == pytest.approx(p * volume.item(), rel=1e-9)


# Sets ---------------------------------------------------------------------------------------------------------------


def test_feasible_sets_step_by_step_in_single_precision() -> None:
    """Intersected, merged, chosen, emptied: the volume's gradient reaches each step's rows, in their own type."""
    generator = torch.Generator().manual_seed(5)
    A = torch.randn(3, 2, 4, 3, generator=generator)
    b = A.norm(dim=-1) * (0.4 + torch.rand(3, 2, 4, generator=generator))

    def volume(b: Tensor) -> Tensor:
        prior = FeasibleSet.from_box(*corners(3, 2.0, 2), max_facets=9)
        theta = prior
        for k in range(3):
            theta = theta.intersect(Halfspaces(A[k], b[k]), time=float(k))
        theta = theta.where(torch.tensor([True, False]), prior.intersect(Halfspaces(A[0], b[1])))
        gone = theta.intersect(Halfspaces(A[0, :, :1], -9 * torch.ones(2, 1)))
        assert gone.is_empty.all()
        return theta.volume().sum() + gone.volume().sum() + theta.select(torch.tensor([1])).diameter().sum()

    b = b.requires_grad_()
    (found,) = torch.autograd.grad(volume(b), b)
    assert found.dtype == torch.float32
    assert (found.flatten(1).abs().amax(-1) > 0).sum() == 3
    (expected,) = central_differences(volume, b.double())
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["inverse_optimal", "critical_region"])
def test_an_unknown_gain_observed_past_an_obstacle(kind: SetKind) -> None:
    """From where the obstacle is to what is asked of Theta(T), p = 3, over a whole run."""
    task, avoidance = UnknownGainGoalTask(), CollisionAvoidance(ClassK(1.5), safety_distance=0.5)
    obstacle, start = tensor([[0.2, 0.3]]), tensor([[-2.0, 0.0]])
    run = simulate(
        CbfQpController(task, [avoidance]), tensor([[0.9, 1.8, 0.09]]), start, dt=0.05, steps=60, obstacles=obstacle
    )
    assert run.active.any()

    def asked(obstacle: Tensor) -> Tensor:
        prior = FeasibleSet.from_box(tensor([[0.1, -5.0, -5.0]]), tensor([[3.0, 5.0, 5.0]]))
        watching = SetMembershipObserver(task, [avoidance], prior, kind, NoiseBound(1e-3), 1e-3)
        for measurement in list(run.measurements())[::6]:
            bodies = torch.cat([measurement.bodies[:, :1], obstacle.expand(1, 1, 2)], dim=1)
            theta = watching.update(replace(measurement, bodies=bodies)).feasible_set
        assert watching.status.tolist() == [Status.OK]
        origin = torch.zeros(1, 3, dtype=torch.float64)
        return theta.volume().log() + theta.diameter() + theta.centroid().sum() + theta.project(origin).sum()

    (found,) = torch.autograd.grad(asked(obstacle.requires_grad_()), obstacle)
    assert found.norm() > 0.1
    (expected,) = central_differences(asked, obstacle, step=1e-7)
    assert math.dist(found[0], expected[0]) < 1e-5 * found.norm()
