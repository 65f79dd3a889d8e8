"""Gradients of the layers: finite differences of first and second order, and cvxpylayers' beside the exact ones."""

import math
from collections.abc import Callable

import cvxpy as cp
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from tests.test_layers import random_sets, spd, tensor, triangle_ball
from torchfsid import ChebyshevCentre, Halfspaces, ProjectOnto
from torchfsid.errors import InputError
from torchfsid.outcome import Status
from torchfsid.programmes.conic import ActiveRowsSolver, CvxpyLayer

EXACT_BALL, EXACT_POINT = ChebyshevCentre(), ProjectOnto()


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def bounded_sets(B: int, m: int, p: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Random sets in a box."""
    A, b, y = random_sets(B, m, p, seed)
    sides = torch.cat([torch.eye(p), -torch.eye(p)]).double().expand(B, 2 * p, p)
    return torch.cat([A, sides], dim=1), torch.cat([b, torch.full((B, 2 * p), 1.7).double()], dim=1), y


def answers(A: Tensor, b: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    halfspaces = Halfspaces(A, b)
    return EXACT_POINT(halfspaces, y).point, *EXACT_BALL(halfspaces)[:2]


def check(function: Callable[..., tuple[Tensor, ...]], *inputs: Tensor, fast: bool = False) -> None:
    leaves = [t.clone().requires_grad_() for t in inputs]
    for answer in function(*leaves):
        assert answer.isfinite().all()
    assert gradcheck(function, leaves, fast_mode=fast)
    assert gradgradcheck(function, leaves, fast_mode=True)


@pytest.mark.parametrize("p", [1, 2, 3, 5])
def test_random_sets(p):
    check(answers, *bounded_sets(3, p + 3, p, seed=p), fast=p > 2)


@pytest.mark.parametrize("p", [1, 2, 3])
def test_mahalanobis(p):
    A, b, y = random_sets(3, 2 * p + 3, p, seed=10 + p)
    roots = torch.stack([torch.linalg.cholesky(spd(p, seed)) for seed in range(3)])

    def point(A: Tensor, b: Tensor, y: Tensor, root: Tensor) -> tuple[Tensor]:
        return (ProjectOnto(root @ root.mT)(Halfspaces(A, b), y).point,)

    check(point, A, b, y, roots)
    # A metric that is no tensor product of anything: as far as it is symmetric, it may be moved freely.
    symmetric = [t.clone().requires_grad_() for t in (y, roots @ roots.mT)]
    assert gradcheck(lambda y, H: ProjectOnto((H + H.mT) / 2)(Halfspaces(A, b), y).point, symmetric)


def test_tied_rows_that_move_together():
    """Every row three times, at different scales: as a function of the one row behind them, nothing has a kink."""
    A, b, y = bounded_sets(2, 2, 2, seed=20)
    scale = tensor(1.0, 3.0, 0.7).repeat_interleave(6)

    def tripled(A: Tensor, b: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        return answers(A.repeat(1, 3, 1) * scale.unsqueeze(-1), b.repeat(1, 3) * scale, y)

    check(tripled, A, b, y)


def test_several_rows_through_one_corner():
    """The point nearest to (3, 4) is a corner of five rows; the corner moves, and they with it."""
    angles = torch.linspace(0, math.pi / 2, 5).double()
    A = torch.stack([angles.cos(), angles.sin()], dim=-1)
    check(lambda corner, y: (EXACT_POINT(Halfspaces(A, A @ corner), y).point,), tensor(1.0, 0.5), tensor(3.0, 4.0))


@pytest.mark.parametrize("turn", [0.0, math.pi / 4])
def test_orthogonal_equal_rows(turn):
    """Where derivatives of an SVD are NaN, or wrong after a turn by 45 degrees."""
    cosine, sine = math.cos(turn), math.sin(turn)
    A = tensor([cosine, sine], [-sine, cosine], [sine - cosine, -sine - cosine])
    b, outside = tensor(0.7, 0.7, 0.5), A[0] * 2 + A[1] * 3
    check(answers, A, b, outside)


def test_a_disc_free_to_roll():
    """The radius is smooth there, with multipliers as its slopes, and so is the centre that the tie rule chooses, as
    long as the two long sides stay parallel."""
    A = tensor([1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -2.0])

    def ball(b: Tensor, turn: Tensor) -> tuple[Tensor, ...]:
        rotation = torch.stack([turn.cos(), -turn.sin(), turn.sin(), turn.cos()]).reshape(2, 2)
        return tuple(EXACT_BALL(Halfspaces(A @ rotation, b))[:2])

    b = tensor(3.0, 2.0, 1.0, 2.0)
    check(ball, b, tensor(0.1)[0])
    b.requires_grad_()
    (slopes,) = torch.autograd.grad(EXACT_BALL(Halfspaces(A, b)).radius, b)
    torch.testing.assert_close(slopes, tensor(0.0, 0.0, 0.5, 0.25))


@pytest.mark.parametrize("rows_first", [True, False])
def test_padding(rows_first):
    A, b, y = bounded_sets(2, 3, 2, seed=30)

    def padded(A: Tensor, b: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        parts = [Halfspaces(A, b), Halfspaces(torch.zeros(2, 3, 2), torch.ones(2, 3))]
        stacked = Halfspaces.stack(parts if rows_first else parts[::-1])
        return answers(stacked.A, stacked.b, y)

    check(padded, A, b, y)


def test_thin_sets():
    """A triangle 1e-6 high, moved by shares of its height: a corner moves a million times as far as its rows."""
    height = 1e-6
    A, b, _ = triangle_ball(height)
    y = tensor(0.3, 2.0)

    def thin(of_A: Tensor, of_b: Tensor, of_y: Tensor) -> tuple[Tensor, ...]:
        point, centre, radius = answers(A + 1e-2 * height * of_A, b + 1e-2 * height * of_b, y + of_y)
        return point, centre, radius / height

    leaves = [t.requires_grad_() for t in (torch.zeros_like(A), torch.zeros_like(b), torch.zeros_like(y))]
    assert gradcheck(thin, leaves, eps=1e-4, atol=1e-5)
    assert gradgradcheck(thin, leaves, eps=1e-4, atol=1e-4)


def test_no_gradient_is_nan():
    """1000 sets, among them empty, duplicated, padded, thin and unbounded ones, in one batch."""
    A, b, y = random_sets(1000, 8, 2, seed=40, least=-0.1)
    A[:200, 3], b[:200, 3] = 2 * A[:200, 2], 2 * b[:200, 2]
    A[200:400, 5], b[200:400, 5] = -A[200:400, 4], 1e-6 - b[200:400, 4]
    A[400:600, 4:], b[400:600, 4:] = 0.0, 1.0
    leaves = [t.requires_grad_() for t in (A, b, y)]
    halfspaces = Halfspaces(A, b)
    (point, of_point), ball = EXACT_POINT(halfspaces, y), EXACT_BALL(halfspaces)
    assert point[of_point == Status.OK].isfinite().all()
    assert ball.centre[ball.status == Status.OK].isfinite().all()
    assert all(int((ball.status == status).sum()) > 20 for status in (Status.OK, Status.EMPTY, Status.UNBOUNDED))
    for answer in (point, ball.centre, ball.radius):
        for gradient in torch.autograd.grad(answer.sum(), leaves, retain_graph=True, allow_unused=True):
            assert gradient is None or gradient.isfinite().all()


# cvxpylayers --------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("p", [1, 2, 3])
def test_both_backends_agree(p):
    """Values and gradients to 1e-6 of their size, at every scale: far rows, small and large units, padding, thin."""
    A, b, y = random_sets(8, 3 * p + 3, p, seed=50 + p)
    A[1, -2:], b[1, -2:] = 0.0, 1.0
    b[2, 0] = 1e6
    A[3], b[3], y[3] = A[3] * 1e5, b[3], y[3] * 1e-5
    A[4], b[4], y[4] = A[4], b[4] * 1e5, y[4] * 1e5
    if p > 1:
        A[5, 1], b[5, 1] = -A[5, 0] + 0.1 * A[5, 2], 1e-5 - b[5, 0] + 0.1 * b[5, 2]
    unit = torch.ones(8, dtype=torch.float64)
    unit[3], unit[4] = 1e-5, 1e5  # of length
    lengths = A.norm(dim=-1)
    found = []
    for backend in ("exact", "cvxpylayers"):
        leaves = [t.clone().requires_grad_() for t in (A, b, y)]
        halfspaces = Halfspaces(*leaves[:2])
        projected = ProjectOnto(spd(p), backend)(halfspaces, leaves[2])
        ball = ChebyshevCentre(backend)(halfspaces)
        ok = ball.status == Status.OK
        loss = projected.point.sum() + ball.radius[ok].sum() + ball.centre[ok].sum()
        of_A, of_b, of_y = torch.autograd.grad(loss, leaves)
        values = [projected.point / unit[:, None], ball.centre / unit[:, None], ball.radius / unit]
        slopes = [of_A * (lengths / unit.unsqueeze(-1)).unsqueeze(-1), of_b * lengths, of_y]
        found.append(([projected.status, ball.status], values, slopes))
    exact, conic = found
    for mine, theirs in zip(exact[0], conic[0], strict=True):
        assert torch.equal(mine, theirs)
    for mine, theirs in zip(exact[1], conic[1], strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-6, rtol=1e-6, equal_nan=True)
    for mine, theirs in zip(exact[2], conic[2], strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-6, rtol=1e-6)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_cvxpylayers_without_gradients():
    A, b, y = random_sets(3, 6, 2, seed=60)
    A.requires_grad_()
    with torch.no_grad():
        assert not ProjectOnto(backend="cvxpylayers")(Halfspaces(A, b), y).point.requires_grad
        assert not ChebyshevCentre("cvxpylayers")(Halfspaces(A, b)).radius.requires_grad


def interface_layer(distance: str, dual: bool = False) -> CvxpyLayer:
    z, A, b, y = cp.Variable(2), cp.Parameter((7, 2)), cp.Parameter(7), cp.Parameter(2)
    rows = A @ z <= b
    objective = cp.sum_squares(z - y) if distance == "with equalities" else cp.sum_squares(z) - 2 * y @ z
    wanted = [z, rows.dual_variables[0]] if dual else [z]
    return CvxpyLayer(cp.Problem(cp.Minimize(objective), [rows]), [A, b, y], wanted, solver=ActiveRowsSolver())


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("distance", ["with equalities", "without"])
def test_the_exact_solver_inside_a_cvxpylayer(distance):
    """cvxpy writes |z - y|^2 with variables t = z - y, and expands the other objective; the answer is one."""
    inputs = [t.requires_grad_() for t in random_sets(6, 7, 2, seed=70)]
    A, b, y = inputs
    z, dual = interface_layer(distance, dual=True)(*inputs)
    direct = EXACT_POINT(Halfspaces(A, b), y).point
    torch.testing.assert_close(z, direct, atol=1e-12, rtol=0)
    # Stationarity, 2 (z - y) + A' dual = 0, and complementarity.
    torch.testing.assert_close(2 * (y - z), (A.mT @ dual.unsqueeze(-1)).squeeze(-1), atol=1e-10, rtol=0)
    assert (dual * (b - (A @ z.unsqueeze(-1)).squeeze(-1))).abs().max() < 1e-10
    mine = torch.autograd.grad(z.pow(3).sum(), inputs, retain_graph=True)
    for through_layer, gradient in zip(mine, torch.autograd.grad(direct.pow(3).sum(), inputs), strict=True):
        torch.testing.assert_close(through_layer, gradient, atol=1e-9, rtol=1e-9)
    (alone,) = interface_layer(distance)(A[0], b[0], y[0])
    torch.testing.assert_close(alone, direct[0], atol=1e-12, rtol=0)


def test_what_the_exact_solver_refuses():
    z, q = cp.Variable(2), cp.Parameter(2)
    with pytest.raises(InputError, match="strictly convex"):
        CvxpyLayer(cp.Problem(cp.Minimize(q @ z), [z >= 0]), [q], [z], solver=ActiveRowsSolver())
    cone = cp.Problem(cp.Minimize(cp.sum_squares(z - q)), [cp.norm(z) <= 1])
    with pytest.raises(InputError, match="linear constraints"):
        CvxpyLayer(cone, [q], [z], solver=ActiveRowsSolver())


@pytest.mark.parametrize("p", [1, 2, 3])
def test_compiled_first_derivatives_are_those_of_the_graph(p):
    """With no graph asked for, numba's; with one, torch's. Among the sets are empty and unbounded ones."""
    A, b, y = (t.requires_grad_() for t in random_sets(200, 2 * p + 2, p, seed=80 + p, least=-0.2))
    halfspaces = Halfspaces(A, b)
    point, ball = EXACT_POINT(halfspaces, y).point, EXACT_BALL(halfspaces)
    assert ball.status.unique().tolist() == [Status.OK, Status.EMPTY, Status.UNBOUNDED]
    weights = torch.randn(200, p, dtype=torch.float64)
    for loss in ((point * weights).sum(), (ball.centre * weights).sum(), ball.radius.sum()):
        compiled = torch.autograd.grad(loss, (A, b, y), retain_graph=True, allow_unused=True)
        graph = torch.autograd.grad(loss, (A, b, y), create_graph=True, allow_unused=True)
        for mine, theirs in zip(compiled, graph, strict=True):
            assert (mine is None) == (theirs is None)
            if mine is not None:
                torch.testing.assert_close(mine, theirs, atol=1e-10, rtol=1e-9)


def test_a_trained_metric_stays_symmetric_and_the_points_inside() -> None:
    """Only the symmetric part of a metric counts, so only it has a gradient; the backends agree on it."""
    generator = torch.Generator().manual_seed(1)
    A = torch.randn(8, 6, 3, dtype=torch.float64, generator=generator)
    rows = Halfspaces(A, torch.rand(8, 6, dtype=torch.float64, generator=generator) + 0.2)
    y, wanted = (torch.randn(8, 3, dtype=torch.float64, generator=generator) * scale for scale in (3.0, 1.0))
    gradients = []
    for backend in ("exact", "cvxpylayers"):
        layer = ProjectOnto(torch.nn.Parameter(torch.eye(3, dtype=torch.float64)), backend)
        (layer(rows, y).point - wanted).square().sum().backward()
        gradients.append(layer.metric.grad)
    torch.testing.assert_close(*gradients, rtol=1e-6, atol=1e-6)
    layer = ProjectOnto(torch.nn.Parameter(torch.eye(3, dtype=torch.float64)))
    optimiser = torch.optim.Adam(layer.parameters(), lr=0.03)
    for _ in range(12):
        optimiser.zero_grad()
        (layer(rows, y).point - wanted).square().sum().backward()
        optimiser.step()
    assert layer.metric is not None
    assert torch.equal(layer.metric, layer.metric.mT)
    assert float(rows.slack(layer(rows, y).point).detach().min()) > -1e-12
    skew = torch.tensor([[0.0, 0.3, 0.0], [-0.3, 0.0, 0.1], [0.0, -0.1, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(ProjectOnto(layer.metric + skew)(rows, y).point, layer(rows, y).point)


def test_an_infeasible_item_leaves_shared_gradients_alone() -> None:
    """An item without a solution is NaN; parameters that all items share have the gradient of the others."""
    x, G, h, y, L = cp.Variable(2), cp.Parameter((4, 2)), cp.Parameter(4), cp.Parameter(2), cp.Parameter((2, 2))
    problem = cp.Problem(cp.Minimize(cp.sum_squares(L @ x - y)), [G @ x <= h])
    layer = CvxpyLayer(problem, [G, h, y, L], [x], solver=ActiveRowsSolver())
    box = tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]).expand(3, 4, 2)
    shared, point = torch.eye(2, dtype=torch.float64, requires_grad=True), torch.full((3, 2), 0.4, dtype=torch.float64)
    bounds = torch.ones(3, 4, dtype=torch.float64)
    bounds[0] = -5.0
    (found,) = layer(box, bounds, point, shared)
    assert found.isnan().all(-1).tolist() == [True, False, False]
    (slope,) = torch.autograd.grad(found[1:].sum(), shared)
    (others,) = layer(box[1:], bounds[1:], point[1:], shared)
    torch.testing.assert_close(slope, torch.autograd.grad(others.sum(), shared)[0])
