"""Nearest point and inscribed ball where rows are nearly parallel, tied, thin, far away, or of extreme length.

Every answer carries its own proof: a ball that fits, with a radius that HiGHS does not exceed; a point inside, with
multipliers >= 0 that balance it.
"""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import linprog
from torch import Tensor

from tests.hard_sets import hard_sets, padded
from torchfsid import ChebyshevCentre, Halfspaces, ProjectOnto
from torchfsid.kernels.active_rows import simplex_around
from torchfsid.outcome import Status
from torchfsid.programmes import exact, rational

ROUND_OFF = 128 * 2.0**-52
DIMENSIONS = pytest.mark.parametrize("p", [1, 2, 3, 4, 5, 6])


def tensor(*values) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def most_radius(A: np.ndarray, b: np.ndarray, centre: np.ndarray, radius: float) -> float:
    """HiGHS's radius, asked from a centre and in units of a radius that are about right."""
    lengths = np.linalg.norm(A, axis=1)
    A, b = A[lengths > 0] / lengths[lengths > 0, None], b[lengths > 0] / lengths[lengths > 0]
    rows = np.column_stack([A, np.ones(len(A))])
    found = linprog(np.append(0 * centre, -1.0), A_ub=rows, b_ub=(b - A @ centre) / radius, bounds=(None, None))
    return radius * found.x[-1]


SLANTED = [
    ([[2210.0, 2443], [2211, 2444], [-2210, -2443], [-2211, -2444]], [1645.0, 1650, 1645, 1646], 0.4993488),
    ([[4095.0, -7707], [4095, -7706], [-4095, 7707], [-4095, 7706]], [4364.0, 4365, 4364, 4360], 0.4999152),
]


@pytest.mark.parametrize(("A", "b", "radius"), SLANTED)
def test_parallelograms_of_nearly_parallel_sides(A, b, radius):
    sides = torch.cat([torch.eye(2), -torch.eye(2)]).double()
    halfspaces = Halfspaces(torch.cat([tensor(*A), sides]), torch.cat([tensor(*b), torch.full((4,), 5.0).double()]))
    ball = ChebyshevCentre()(halfspaces)
    assert ball.status == Status.OK
    assert float(ball.radius) == pytest.approx(radius, abs=1e-7)
    assert float(halfspaces.slack(ball.centre).min()) == pytest.approx(radius, abs=1e-7)


@DIMENSIONS
def test_balls_fit_and_none_is_larger(p):
    sets = hard_sets(p, each=3)
    centre, radius, _, status = exact.inscribed_ball(*padded(sets))
    assert (status == Status.OK).all()
    for (A, b), z, r in zip(sets, centre, radius, strict=True):
        lengths = np.linalg.norm(A, axis=1)
        room = ROUND_OFF * (np.abs(b / lengths).max() + np.abs(z).sum())
        assert ((b - A @ z) / lengths).min() >= r - room
        assert most_radius(A, b, z, r) <= r * (1 + 1e-6) + 8 * room


def conditions(A: np.ndarray, b: np.ndarray, y: np.ndarray, z: np.ndarray, mu: np.ndarray) -> None:
    """Feasibility, complementarity and stationarity, with mu (m,) for all rows."""
    lengths = np.linalg.norm(A, axis=1)
    size = np.abs(b / lengths).max() + np.abs(y).sum() + np.abs(z).sum()
    slack = (b - A @ z) / lengths
    assert slack.min() >= -ROUND_OFF * size
    assert (mu >= 0).all()
    assert np.abs(slack[mu > 0]).max(initial=0.0) <= ROUND_OFF * size
    assert np.abs(z - y + mu @ A).max() <= ROUND_OFF * (size + mu @ lengths)


@DIMENSIONS
def test_points_are_inside_and_balanced(p):
    sets = hard_sets(p, each=8, seed=1)
    A, b = padded(sets)
    y = 6 * np.random.default_rng(p).normal(size=(len(sets), p))
    z, mu, rows, filled, status = exact.nearest_point(A, b, y)
    assert (status == Status.OK).all()
    for i, (own, bounds) in enumerate(sets):
        every = np.zeros(len(bounds))
        np.add.at(every, rows[i][filled[i]], mu[i][filled[i]])
        conditions(own, bounds, y[i], z[i], every)


@pytest.mark.parametrize("p", [1, 2, 3])
def test_the_rational_programmes_say_the_same(p):
    """They are asked so rarely that they are asked here on purpose."""
    sets = hard_sets(p, each=1, seed=2)
    A, b = padded(sets)
    y = 6 * np.random.default_rng(p).normal(size=(len(sets), p))
    z, *_ = exact.nearest_point(A, b, y)
    _, radius, *_ = exact.inscribed_ball(A, b)
    for i, (own, bounds) in enumerate(sets):
        point, mu, rows, filled = np.zeros(p), np.zeros(p), np.zeros(p, dtype=np.int64), np.zeros(p, dtype=bool)
        status = rational.nearest_point(own, bounds, y[i], np.empty((0, p, p)), point, mu, rows, filled)
        assert status == Status.OK
        every = np.zeros(len(bounds))
        np.add.at(every, rows[filled], mu[filled])
        conditions(own, bounds, y[i], point, every)
        assert np.linalg.norm(point - y[i]) == pytest.approx(np.linalg.norm(z[i] - y[i]), rel=1e-9)
        centre, touching = np.zeros(p), np.zeros(p + 1, dtype=np.int64)
        r, status = rational.inscribed_ball(own, bounds, simplex_around(p), centre, touching)
        assert status == Status.OK
        lengths = np.linalg.norm(own, axis=1)
        room = ROUND_OFF * (np.abs(bounds / lengths).max() + np.abs(centre).sum())
        assert r == pytest.approx(radius[i], abs=8 * room)
        assert ((bounds - own @ centre) / lengths).min() >= r - room


def test_what_the_kernel_cannot_verify_is_solved_in_rationals(monkeypatch):
    """With a kernel that gives up, the answers are the same; with rationals that give up too, the status says so."""
    A, b = padded(hard_sets(2, each=1)[:10])
    y = np.full((len(A), 2), 7.0)
    z, *_, status = exact.nearest_point(A, b, y)
    _, radius, *_ = exact.inscribed_ball(A, b)
    for name in ("nearest_point", "inscribed_ball"):
        whole = getattr(exact.kernel, name)

        def gives_up(*arguments, whole=whole):
            whole(*arguments)
            arguments[-1][:] = Status.UNSOLVED

        monkeypatch.setattr(exact.kernel, name, gives_up)
    again = exact.nearest_point(A, b, y)
    assert np.array_equal(again[-1], status)
    assert np.linalg.norm(again[0] - y, axis=1) == pytest.approx(np.linalg.norm(z - y, axis=1), rel=1e-9)
    assert exact.inscribed_ball(A, b)[1] == pytest.approx(radius, abs=1e-8)
    monkeypatch.setattr(rational, "nearest_rows", lambda *_: (0, exact.kernel.UNSOLVED))
    monkeypatch.setattr(rational, "inscribed_rows", lambda *_: False)
    leaves = [torch.from_numpy(t).requires_grad_() for t in (A, b, y)]
    halfspaces = Halfspaces(*leaves[:2])
    point, ball = ProjectOnto()(halfspaces, leaves[2]), ChebyshevCentre()(halfspaces)
    for answer in (point.status, ball.status):
        assert (answer == Status.UNSOLVED).all()
    for value in (point.point, ball.centre, ball.radius):
        assert value.isnan().all()
        for gradient in torch.autograd.grad(value.sum(), leaves, allow_unused=True, retain_graph=True):
            assert gradient is None or gradient.abs().max() == 0


@pytest.mark.parametrize("exponent", [-300, -170, -100, 100, 160, 300])
def test_rows_of_any_length_mean_the_same(exponent):
    """Values, and gradients times the scale; with a metric and without; `Halfspaces` and the layers."""
    A, b, z = tensor([3.0, 4.0], [-1.0, 2.0], [1.0, -3.0], [0.0, 0.0]), tensor(5.0, 2.0, 3.0, 1.0), tensor(0.3, 0.2)
    outside, metric = tensor(4.0, 1.0), tensor([2.0, 0.5], [0.5, 1.0])
    found = []
    for scale in (1.0, 10.0**exponent):
        rows, bounds = (A * scale).requires_grad_(), torch.where((A != 0).any(-1), b * scale, b).requires_grad_()
        halfspaces = Halfspaces(rows, bounds)
        ball, point = ChebyshevCentre()(halfspaces), ProjectOnto()(halfspaces, outside).point
        skewed, slack = ProjectOnto(metric)(halfspaces, outside).point, halfspaces.slack(z)
        loss = ball.radius + ball.centre.sum() + point.sum() + skewed.sum() + slack[:3].sum()
        first = torch.autograd.grad(loss, (rows, bounds), retain_graph=True)
        graph = torch.autograd.grad(loss, (rows, bounds), create_graph=True)
        values = [ball.centre, ball.radius, point, skewed, slack, halfspaces.round_off(z), halfspaces.normalised().A]
        found.append([*values, *(gradient * scale for gradient in (*first, *graph))])
        assert bool(halfspaces.contains(z))
        assert not bool(halfspaces.contains(outside))
    for mine, theirs in zip(*found, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-13, atol=1e-13)


@DIMENSIONS
def test_what_is_no_metric_has_no_nearest_point(p):
    sides = torch.cat([torch.eye(p), -torch.eye(p)]).double()
    halfspaces, y = Halfspaces(sides, torch.ones(2 * p)), torch.full((p,), 9.0).double().requires_grad_()
    metrics = [-torch.eye(p), torch.zeros(p, p), torch.full((p, p), math.nan), math.inf * torch.eye(p)]
    if p > 1:
        metrics.append(torch.eye(p) + 2 * torch.ones(p, p) - 2 * torch.eye(p))
    for metric in metrics:
        metric = metric.double().requires_grad_()
        point, status = ProjectOnto(metric)(halfspaces, y)
        assert status == Status.UNDEFINED
        assert point.isnan().all()
        for gradient in torch.autograd.grad(point.sum(), (y, metric)):
            assert torch.equal(gradient, torch.zeros_like(gradient))


@DIMENSIONS
@pytest.mark.parametrize("condition", [1e2, 1e8, 1e14])
def test_stretched_metrics(p, condition):
    rng = np.random.default_rng(p)
    turn, _ = np.linalg.qr(rng.normal(size=(100, p, p)))
    H = (turn * condition ** rng.uniform(size=(100, 1, p))) @ turn.swapaxes(1, 2)
    H = (H + H.swapaxes(1, 2)) / 2
    A, b = rng.normal(size=(100, 3 * p + 3, p)), rng.uniform(0.2, 1, (100, 3 * p + 3))
    y = 5 * rng.normal(size=(100, p))
    z, mu, rows, _, status = exact.nearest_point(A, b, y, H)
    assert (status == Status.OK).all()
    assert (np.einsum("bmp,bp->bm", A, z) - b).max() <= 1e-12
    pull = np.einsum("bij,bj->bi", H, z - y) + np.einsum("bs,bsp->bp", mu, A[np.arange(100)[:, None], rows])
    assert (np.abs(pull).max(-1) <= 1e-10 * np.abs(H).max((1, 2))).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["A", "b", "y"])
def test_numbers_that_are_none(bad, where):
    given = {"A": tensor([1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]), "b": tensor(1.0, 1.0, 1.0), "y": tensor(3.0, 0.0)}
    given[where].view(-1)[0] = bad
    leaves = [value.requires_grad_() for value in given.values()]
    point, ball = ProjectOnto()(Halfspaces(*leaves[:2]), leaves[2]), ChebyshevCentre()(Halfspaces(*leaves[:2]))
    assert point.status == Status.UNDEFINED
    assert point.point.isnan().all()
    assert ball.status == (Status.OK if where == "y" else Status.UNDEFINED)
    for gradient in torch.autograd.grad(point.point.sum(), leaves):
        assert torch.equal(gradient, torch.zeros_like(gradient))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("backend", ["exact", "cvxpylayers"])
@pytest.mark.parametrize("batch", [(), (0,), (1,), (2, 3)])
def test_batches_of_any_shape(backend, batch):
    A, b, y = tensor([3.0, 4.0], [-1.0, 2.0], [1.0, -3.0]), tensor(5.0, 2.0, 3.0), tensor(4.0, 1.0)
    halfspaces, outside = Halfspaces(A.expand(*batch, 3, 2), b.expand(*batch, 3)), y.expand(*batch, 2)
    alone = ChebyshevCentre()(Halfspaces(A, b)).radius
    ball = ChebyshevCentre(backend)(halfspaces)
    assert ball.centre.shape == (*batch, 2)
    assert ball.status.shape == batch
    torch.testing.assert_close(ball.radius, alone.expand(batch), rtol=1e-8, atol=0)
    for metric in (None, torch.eye(2).double()):
        assert ProjectOnto(metric, backend)(halfspaces, outside).point.shape == (*batch, 2)


@pytest.mark.parametrize("scale", [1e-8, 1e-4, 1.0, 1e4, 1e8])
def test_a_contradiction_does_not_depend_on_the_scale_of_rows(scale: float):
    A = torch.tensor([[1.0, 0.0], [-1.0, 0.0]], dtype=torch.float64)
    b = torch.tensor([1.0, -1.0 - 1e-10], dtype=torch.float64)
    found = ProjectOnto()(Halfspaces(A * scale, b * scale), torch.tensor([16.0, 32.0]))
    assert int(found.status) == Status.EMPTY
