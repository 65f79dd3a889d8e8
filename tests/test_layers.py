"""What the layers return: against HiGHS, daqp and exact rationals; statuses; both backends; batches, types, vmap."""

import copy
import math

import daqp
import numpy as np
import pytest
import torch
from scipy.optimize import linprog
from torch import Tensor, nn
from torch.func import grad, hessian, jacrev, vmap

from torchfsid import ChebyshevCentre, Halfspaces, ProjectOnto
from torchfsid.errors import InputError
from torchfsid.outcome import Status

BACKENDS = pytest.mark.parametrize("backend", ["exact", "cvxpylayers"])


def tensor(*values) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def random_sets(B: int, m: int, p: int, seed: int, least: float = 0.2) -> tuple[Tensor, Tensor, Tensor]:
    """Rows of any length, offsets of at least `least` lengths (negative: often empty), points around."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(B, m, p)) * np.exp(rng.normal(size=(B, m, 1)))
    b = np.linalg.norm(A, axis=-1) * (least + rng.uniform(size=(B, m)))
    return torch.from_numpy(A), torch.from_numpy(b), torch.from_numpy(3 * rng.normal(size=(B, p)))


def spd(p: int, seed: int = 0) -> Tensor:
    root = np.random.default_rng(seed).normal(size=(p, p))
    return torch.from_numpy(root @ root.T + 0.3 * np.eye(p))


# Against other solvers ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("p", [1, 2, 3, 5])
@pytest.mark.parametrize("mahalanobis", [False, True])
def test_projections_agree_with_daqp(p, mahalanobis):
    A, b, y = random_sets(60, 3 * p + 3, p, seed=p, least=-0.3)
    metric = spd(p) if mahalanobis else None
    point, status = ProjectOnto(metric)(Halfspaces(A, b), y)
    H = np.eye(p) if metric is None else metric.numpy()
    for i in range(len(A)):
        lengths = A[i].norm(dim=-1, keepdim=True)
        unit, right = (A[i] / lengths).numpy(), (b[i] / lengths[:, 0]).numpy()
        expected, _, flag, _ = daqp.solve(H, -H @ y[i].numpy(), unit, right, primal_tol=1e-12, dual_tol=1e-12)
        assert status[i] == (Status.OK if flag == 1 else Status.EMPTY)
        if flag == 1:
            np.testing.assert_allclose(point[i].numpy(), expected, atol=1e-8)
        else:
            assert point[i].isnan().all()
    assert (status == Status.OK).sum() > 10
    assert (status == Status.EMPTY).sum() > 5


@pytest.mark.parametrize("p", [1, 2, 3, 5])
def test_radius_and_depth_of_emptiness_agree_with_highs(p):
    A, b, _ = random_sets(60, 3 * p + 3, p, seed=p, least=-0.4)
    centre, radius, status = ChebyshevCentre()(Halfspaces(A, b))
    for i in range(len(A)):
        rows = np.column_stack([A[i].numpy(), A[i].norm(dim=-1).numpy()])
        highs = linprog(np.append(np.zeros(p), -1.0), A_ub=rows, b_ub=b[i].numpy(), bounds=(None, None))
        if highs.status != 0:
            assert status[i] == Status.UNBOUNDED
            continue
        np.testing.assert_allclose(float(radius[i]), highs.x[-1], atol=1e-9)
        assert status[i] == (Status.OK if highs.x[-1] > 0 else Status.EMPTY)
        # The ball is where it is said to be: no row is nearer than its radius.
        np.testing.assert_allclose(float(Halfspaces(A[i], b[i]).slack(centre[i]).min()), float(radius[i]), atol=1e-12)
    assert (status == Status.EMPTY).sum() > 5
    assert (status == Status.OK).sum() > 5


def triangle_ball(height: float) -> tuple[Tensor, Tensor, float]:
    """The isosceles triangle (-1, 0), (1, 0), (0, height): rows, and the radius area / half the perimeter."""
    side = math.hypot(1.0, height)
    return tensor([0.0, -1.0], [height, 1.0], [-height, 1.0]), tensor(0.0, height, height), height / (1 + side)


@pytest.mark.parametrize("height", [1.0, 1e-3, 1e-6, 1e-9])
def test_thin_triangles_far_from_the_origin(height):
    A, b, radius = triangle_ball(height)
    away = tensor(30.0, -20.0)
    ball = ChebyshevCentre()(Halfspaces(A, b + A @ away))
    assert ball.status == Status.OK
    # What round-off leaves of an offset of size 50.
    assert float(ball.radius) == pytest.approx(radius, abs=1e-13)
    torch.testing.assert_close(ball.centre, away + tensor(0.0, radius), atol=1e-13 / height, rtol=0)
    tip, status = ProjectOnto()(Halfspaces(A, b + A @ away), away + tensor(0.0, 5.0))
    assert status == Status.OK
    torch.testing.assert_close(tip, away + tensor(0.0, height), atol=1e-13 / height, rtol=0)


def test_of_many_centres_the_first_in_order_of_coordinates():
    """A box, its rows in any order and at any scale: as far to the left, then as far down, as the ball fits."""
    rng = np.random.default_rng(0)
    for p, half in ((2, (3.0, 1.0)), (3, (2.0, 1.0, 3.0)), (3, (2.0, 2.0, 1.0))):
        sides, smallest = tensor(*half), min(half)
        A = torch.cat([torch.eye(p), -torch.eye(p)]).double()
        for _ in range(10):
            order, scale = rng.permutation(2 * p), torch.from_numpy(np.exp(rng.normal(size=2 * p)))
            ball = ChebyshevCentre()(Halfspaces((A * scale.unsqueeze(-1))[order], (sides.repeat(2) * scale)[order]))
            torch.testing.assert_close(ball.centre, smallest - sides, atol=1e-12, rtol=0)
            assert float(ball.radius) == pytest.approx(smallest)


# Statuses -----------------------------------------------------------------------------------------------------------


@BACKENDS
def test_one_bad_item_does_not_spoil_the_batch(backend):
    box = torch.cat([torch.eye(2), -torch.eye(2)]).double()
    A = box.repeat(8, 1, 1)
    b = torch.ones(8, 4, dtype=torch.float64)
    b[1, 0] = -1.5  # x <= -1.5 and x >= -1
    A[2, 3], b[2, 3] = 0.0, -1.0  # 0.z <= -1
    A[3, 2:] = 0.0  # a quadrant
    b[4, 0], b[4, 2] = 0.3, -0.3  # a segment
    A[5, 0, 0] = math.nan
    A[6, 2] = 0.0  # a half-strip open to the left: the first centre is infinitely far
    A[7, 0] = 0.0  # a half-strip open to the right
    A.requires_grad_()
    b.requires_grad_()
    y = tensor(2.0, 0.5).expand(8, 2).clone().requires_grad_()

    ball = ChebyshevCentre(backend)(Halfspaces(A, b))
    S = Status
    assert ball.status.tolist() == [
        S.OK, S.EMPTY, S.EMPTY, S.UNBOUNDED, S.DEGENERATE, S.UNDEFINED, S.UNBOUNDED, S.OK
    ]  # fmt: skip
    expected = tensor(1.0, -0.25, -math.inf, math.inf, 0.0, math.nan, 1.0, 1.0)
    torch.testing.assert_close(ball.radius, expected, equal_nan=True, atol=1e-8, rtol=0)
    torch.testing.assert_close(ball.centre[0], tensor(0.0, 0.0), atol=1e-8, rtol=0)
    assert ball.centre[[2, 3, 5, 6]].isnan().all()

    point, status = ProjectOnto(backend=backend)(Halfspaces(A, b), y)
    assert status.tolist() == [S.OK, S.EMPTY, S.EMPTY, S.OK, S.OK, S.UNDEFINED, S.OK, S.OK]
    torch.testing.assert_close(point[[0, 3, 7]], tensor([1, 0.5], [1, 0.5], [2, 0.5]), atol=1e-8, rtol=0)
    # A set without interior is hard for SCS.
    torch.testing.assert_close(point[4], tensor(0.3, 0.5), atol=1e-12 if backend == "exact" else 1e-3, rtol=0)
    assert point[[1, 2, 5]].isnan().all()

    for of_A, of_b in (
        torch.autograd.grad(ball.radius.sum() + ball.centre.sum(), (A, b)),
        torch.autograd.grad(point.sum(), (A, b)),
    ):
        assert of_A.isfinite().all()
        assert of_b.isfinite().all()
        assert of_b[[2, 5]].abs().max() == 0
    if backend == "exact":
        (of_b,) = torch.autograd.grad(ChebyshevCentre()(Halfspaces(A, b)).radius[[1, 6]].sum(), b)
        torch.testing.assert_close(of_b[1], tensor(0.5, 0.0, 0.5, 0.0))
        torch.testing.assert_close(of_b[6], tensor(0.0, 0.5, 0.0, 0.5))


@BACKENDS
def test_no_rows_no_items_and_only_padding(backend):
    free = Halfspaces(torch.zeros(2, 0, 3), torch.zeros(2, 0))
    y = torch.ones(2, 3, dtype=torch.float64)
    point, status = ProjectOnto(backend=backend)(free, y)
    assert torch.equal(point, y)
    assert status.tolist() == [Status.OK] * 2
    assert ChebyshevCentre(backend)(free).radius.tolist() == [math.inf] * 2
    padding = Halfspaces(torch.zeros(2, 4, 3), torch.ones(2, 4))
    assert torch.equal(ProjectOnto(backend=backend)(padding, y).point, y)
    nothing = Halfspaces(torch.zeros(0, 4, 3), torch.ones(0, 4))
    assert ProjectOnto(backend=backend)(nothing, y[:0]).point.shape == (0, 3)
    assert ChebyshevCentre(backend)(nothing).centre.shape == (0, 3)


def test_a_metric_that_is_none_is_a_status():
    A, b, y = random_sets(3, 6, 2, seed=0)
    metric = torch.stack([spd(2), tensor([1.0, 2.0], [2.0, 1.0]), tensor([1.0, math.nan], [0.0, 1.0])])
    point, status = ProjectOnto(metric)(Halfspaces(A, b), y)
    assert status.tolist() == [Status.OK, Status.UNDEFINED, Status.UNDEFINED]
    assert point[0].isfinite().all()


def test_what_the_layers_refuse(unchecked):
    A, b, y = random_sets(4, 6, 2, seed=0)
    with pytest.raises(InputError, match="backend"):
        ChebyshevCentre("simplex")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="metric"):
        ProjectOnto(torch.ones(2))
    with pytest.raises(InputError, match="metric"):
        ProjectOnto(torch.eye(3))(Halfspaces(A, b), y)
    with pytest.raises(InputError, match="point"):
        ProjectOnto()(Halfspaces(A, b), torch.zeros(4, 3))
    with pytest.raises(InputError, match="broadcast"):
        ProjectOnto()(Halfspaces(A, b), torch.zeros(3, 2))


# Batches, types, transforms -----------------------------------------------------------------------------------------


def test_batches_broadcast_and_equal_the_loop():
    A, b, y = random_sets(12, 7, 3, seed=1)
    metric = spd(3)
    grid = Halfspaces(A.reshape(3, 4, 7, 3), b.reshape(3, 4, 7))
    many = ProjectOnto(metric)(grid, y[:4])
    balls = ChebyshevCentre()(grid)
    for i in range(12):
        one = Halfspaces(A[i], b[i])
        torch.testing.assert_close(
            many.point[i // 4, i % 4], ProjectOnto(metric)(one, y[i % 4]).point, rtol=0, atol=1e-14
        )
        alone = ChebyshevCentre()(one)
        torch.testing.assert_close(balls.centre[i // 4, i % 4], alone.centre, atol=0, rtol=0, equal_nan=True)


@BACKENDS
def test_float32_inputs_get_float32_gradients(backend):
    A, b, y = (t.float().requires_grad_() for t in random_sets(5, 6, 2, seed=2))
    projected = ProjectOnto(backend=backend)(Halfspaces(A, b), y).point
    assert projected.dtype == torch.float32
    loss = projected.sum() + ChebyshevCentre(backend)(Halfspaces(A, b)).radius.sum()
    for gradient in torch.autograd.grad(loss, (A, b, y)):
        assert gradient.dtype == torch.float32
        assert gradient.isfinite().all()


def test_vmap_and_higher_transforms():
    A, b, y = random_sets(6, 8, 2, seed=3)
    project, ball = ProjectOnto(), ChebyshevCentre()
    mapped = vmap(lambda A, b, y: project(Halfspaces(A, b), y).point)
    assert torch.equal(mapped(A, b, y), project(Halfspaces(A, b), y).point)
    assert torch.equal(vmap(lambda b: ball(Halfspaces(A[0], b)).radius)(b), ball(Halfspaces(A[0], b)).radius)
    of_y = vmap(vmap(lambda b, y: project(Halfspaces(A[0], b), y).status, (None, 0)), (0, None))(b, y)
    assert of_y.shape == (6, 6)

    # dr/db are multipliers: with the lengths of the rows they add up to one.
    slopes = vmap(jacrev(lambda A, b: ball(Halfspaces(A, b)).radius, argnums=1))(A, b)
    torch.testing.assert_close((slopes * A.norm(dim=-1)).sum(-1), torch.ones(6).double())

    def size(b: Tensor) -> Tensor:
        return project(Halfspaces(A[0], b), y[0]).point.square().sum() + ball(Halfspaces(A[0], b)).centre.prod()

    forward_over_reverse = vmap(hessian(size))(b)
    for i in range(6):
        torch.testing.assert_close(forward_over_reverse[i], torch.autograd.functional.hessian(size, b[i]))
        torch.testing.assert_close(grad(size)(b[i]), torch.autograd.functional.jacobian(size, b[i]))


def test_the_layers_are_modules():
    layer = ProjectOnto(nn.Parameter(spd(2)))
    assert [name for name, _ in layer.named_parameters()] == ["metric"]
    A, b, y = random_sets(20, 6, 2, seed=4)
    layer(Halfspaces(A, b), y).point.square().sum().backward()
    assert layer.metric is not None
    assert layer.metric.grad is not None
    assert layer.metric.grad.abs().max() > 0
    assert "metric" in ProjectOnto(spd(2)).state_dict()
    twin = copy.deepcopy(layer)
    assert torch.equal(twin(Halfspaces(A, b), y).point, layer(Halfspaces(A, b), y).point)
    assert repr(twin) == "ProjectOnto(backend='exact', metric=(2, 2))"
