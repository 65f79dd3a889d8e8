"""The safety QP, against exact rationals, a conic solver and daqp."""

import itertools
from fractions import Fraction

import cvxpy
import daqp
import numpy as np
import pytest
import torch

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.kkt import solve_kkt
from torchfsid.robots.controller import solve_safe_qp

INFEASIBLE = -1
"""daqp's exit flag."""


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


# ---------------------------------------------------------------- references


def exact_control(A, b, uhat):
    """The nearest point of a planar polyhedron in rational arithmetic: uhat, its projections on the lines, or a vertex.

    Returns (u, number of tight rows at u), or None where there is no point.
    """
    A = [[Fraction(value) for value in row] for row in A.tolist()]
    b = [Fraction(value) for value in b.tolist()]
    x, y = (Fraction(value) for value in uhat.tolist())
    candidates = [(x, y)]
    for (p, q), c in zip(A, b, strict=True):
        if (p, q) != (0, 0):
            step = (p * x + q * y - c) / (p * p + q * q)
            candidates.append((x - step * p, y - step * q))
    for (i, (p, q)), (j, (r, s)) in itertools.combinations(enumerate(A), 2):
        determinant = p * s - q * r
        if determinant != 0:
            candidates.append(((b[i] * s - b[j] * q) / determinant, (p * b[j] - r * b[i]) / determinant))
    inside = [u for u in candidates if all(p * u[0] + q * u[1] <= c for (p, q), c in zip(A, b, strict=True))]
    if not inside:
        return None
    best = min(inside, key=lambda u: (u[0] - x) ** 2 + (u[1] - y) ** 2)
    tight = sum(p * best[0] + q * best[1] == c for (p, q), c in zip(A, b, strict=True) if (p, q) != (0, 0))
    return np.array([float(best[0]), float(best[1])]), tight


def conic_control(A, b, uhat):
    u = cvxpy.Variable(len(uhat))
    problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(u - uhat)), [A @ u <= b])
    problem.solve(solver=cvxpy.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11)
    return u.value if problem.status == cvxpy.OPTIMAL else None


def random_problems(kind, count, m, n, seed):
    rng = np.random.default_rng(seed)
    A, b, uhat = rng.normal(size=(count, m, n)), rng.normal(size=(count, m)) + 0.5, 3 * rng.normal(size=(count, n))
    if kind == "duplicated":
        scale = np.exp(rng.normal(size=(count, m // 2)))
        A[:, : m // 2] = A[:, -(m // 2) :] * scale[..., None]
        b[:, : m // 2] = b[:, -(m // 2) :] * scale
    if kind == "vertex":  # all rows through one point
        b = np.einsum("kmn,kn->km", A, rng.normal(size=(count, n)))
    if kind == "slow":  # speeds of micrometres per second
        b, uhat = 1e-6 * b, 1e-6 * uhat
    return Halfspaces(torch.tensor(A), torch.tensor(b)), torch.tensor(uhat)


# ---------------------------------------------------------------- the QP


def test_planar_controls_are_exact_in_integer_problems_full_of_ties():
    """Small integers make duplicated, opposite and zero rows, three rows at a vertex, and sets that are points."""
    rng = np.random.default_rng(0)
    tight_at_solution = []
    infeasible = 0
    for _ in range(300):
        m = rng.integers(1, 8)
        A = rng.integers(-2, 3, size=(m, 2)).astype(float)
        b = rng.integers(-2, 4, size=m).astype(float)
        uhat = rng.integers(-4, 5, size=2).astype(float)
        expected = exact_control(A, b, uhat)
        solution = solve_safe_qp(Halfspaces(torch.tensor(A), torch.tensor(b)), torch.tensor(uhat))
        assert bool(solution.feasible) == (expected is not None), (A, b, uhat)
        if expected is None:
            infeasible += 1
        else:
            np.testing.assert_allclose(solution.u.numpy(), expected[0], atol=1e-12)
            tight_at_solution.append(expected[1])
    counts = np.bincount(tight_at_solution)
    assert infeasible > 30
    assert (counts[:4] > 10).all()  # none, one, two, and three tight rows were all seen


@pytest.mark.parametrize("n", [2, 3, 5])
def test_controls_agree_with_a_conic_solver(n):
    safe_controls, uhat = random_problems("random", 40, 6, n, seed=n)
    solution = solve_safe_qp(safe_controls, uhat)
    for item in range(40):
        expected = conic_control(safe_controls.A[item].numpy(), safe_controls.b[item].numpy(), uhat[item].numpy())
        assert bool(solution.feasible[item]) == (expected is not None)
        if expected is not None:
            np.testing.assert_allclose(solution.u[item].numpy(), expected, atol=1e-7)
    assert solution.active.sum(-1).max() >= 2


@pytest.mark.parametrize("kind", ["random", "duplicated", "vertex", "slow"])
@pytest.mark.parametrize(("m", "n"), [(2, 2), (8, 2), (6, 4)])
def test_kkt_residuals_of_the_rows_as_given(kind, m, n):
    """Multipliers need not be unique, so the conditions are compared and not the multipliers."""
    safe_controls, uhat = random_problems(kind, 200, m, n, seed=m * n)
    u, active, mu, feasible = solve_safe_qp(safe_controls, uhat)
    speed = uhat.abs().max()
    assert feasible.double().mean() > 0.2
    slack = safe_controls.slack(u)[feasible]
    assert slack.min() >= -1e-11 * speed
    assert (mu >= 0).all()
    assert ((mu > 0) == active).all()
    assert (active.sum(-1) <= n).all()
    assert (mu[feasible] * safe_controls.norms()[feasible] * slack).abs().max() <= 1e-10 * speed**2
    pull = 0.5 * (mu.unsqueeze(-1) * safe_controls.A).sum(-2)
    torch.testing.assert_close((uhat - u)[feasible], pull[feasible], atol=1e-11 * float(speed), rtol=0)


def test_a_thin_wedge_is_not_called_infeasible():
    """Two nearly opposite rows, 1e-6 rad apart: feasible, though daqp's default tolerances deny it."""
    rng = np.random.default_rng(3)
    angle, hard = 1e-6, 0
    for _ in range(50):
        turn = rng.uniform(0, 2 * np.pi)
        A = np.array([[np.cos(turn), np.sin(turn)], [-np.cos(turn + angle), -np.sin(turn + angle)]])
        b = A @ rng.normal(size=2)
        uhat = 3 * rng.normal(size=2)
        expected = exact_control(A, b, uhat)
        assert expected is not None
        hard += daqp.solve(np.eye(2), -uhat, A, b)[2] == INFEASIBLE
        safe_controls = Halfspaces(torch.tensor(A), torch.tensor(b))
        solution = solve_safe_qp(safe_controls, torch.tensor(uhat))
        assert bool(solution.feasible)
        # Round-off divided by the angle.
        np.testing.assert_allclose(solution.u.numpy(), expected[0], atol=1e-8)
        polished = solve_kkt(safe_controls, solution.active, torch.eye(2, dtype=torch.float64), tensor(0.0, 0.0))
        np.testing.assert_allclose((polished.G @ torch.tensor(uhat) + polished.f).numpy(), expected[0], atol=1e-7)
    assert hard > 10


def test_infeasible_items_are_values_and_leave_the_others_alone():
    wall, gap = [[1.0, 0.0], [-1.0, 0.0]], tensor(-1.0, 0.5)
    safe_controls = Halfspaces(
        tensor(wall, wall, [[0.0, 0.0], [1.0, 0.0]], [[float("nan"), 0.0], [1.0, 0.0]]),
        torch.stack([gap, tensor(1.0, 0.5), tensor(-1.0, 1.0), tensor(1.0, 1.0)]),
    )
    u, active, mu, feasible = solve_safe_qp(safe_controls, tensor(2.0, 3.0).expand(4, 2))
    assert feasible.tolist() == [False, True, False, False]
    torch.testing.assert_close(u, tensor([0.0, 0.0], [1.0, 3.0], [0.0, 0.0], [0.0, 0.0]))
    assert active.tolist() == [[False] * 2, [True, False], [False] * 2, [False] * 2]
    assert mu[1].tolist() == pytest.approx([2.0, 0.0])
    assert mu[[0, 2, 3]].abs().sum() == 0


def test_controls_agree_with_daqp():
    """Random rows, some of them duplicated, opposite, or nearly so; daqp decides feasibility to its own tolerance."""
    rng = np.random.default_rng(12)
    A, b, uhat = rng.normal(size=(400, 5, 2)), rng.normal(size=(400, 5)) + 0.4, 3 * rng.normal(size=(400, 2))
    A /= np.linalg.norm(A, axis=-1, keepdims=True)
    A[100:200, 1], b[100:200, 1] = A[100:200, 0], b[100:200, 0]
    A[200:300, 1], b[200:300, 1] = -A[200:300, 0], 0.01 - b[200:300, 0]
    A[300:, 1] = A[300:, 0] + 1e-4 * rng.normal(size=(100, 2))
    solution = solve_safe_qp(Halfspaces(torch.tensor(A), torch.tensor(b)), torch.tensor(uhat))
    for item in range(400):
        u, _, flag, _ = daqp.solve(np.eye(2), -uhat[item], A[item], b[item], primal_tol=1e-12, sing_tol=1e-14)
        assert bool(solution.feasible[item]) == (flag == 1)
        if flag == 1:
            np.testing.assert_allclose(solution.u[item].numpy(), u, atol=1e-7)
    assert 100 < solution.feasible.sum() < 350


def test_batch_equals_loop_and_broadcasts():
    safe_controls, uhat = random_problems("random", 30, 5, 2, seed=5)
    grid = Halfspaces(safe_controls.A.reshape(5, 6, 5, 2), safe_controls.b.reshape(5, 6, 5))
    batch = solve_safe_qp(grid, uhat.reshape(5, 6, 2))
    for item in range(30):
        alone = solve_safe_qp(Halfspaces(safe_controls.A[item], safe_controls.b[item]), uhat[item])
        for of_batch, of_one in zip(batch, alone, strict=True):
            assert torch.equal(of_batch[item // 6, item % 6], of_one)
    many = solve_safe_qp(Halfspaces(safe_controls.A[3], safe_controls.b[3]), uhat)
    assert torch.equal(many.u[7], solve_safe_qp(Halfspaces(safe_controls.A[3], safe_controls.b[3]), uhat[7]).u)


def test_padding_order_and_scale_of_rows_do_not_matter():
    safe_controls, uhat = random_problems("random", 100, 4, 2, seed=6)
    u, active, mu, feasible = solve_safe_qp(safe_controls, uhat)
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(7, generator=generator)
    scale = torch.rand(100, 7, generator=generator, dtype=torch.float64) * 10 + 0.1
    padding = Halfspaces(torch.zeros(3, 2), torch.ones(3))
    padded = Halfspaces.stack([safe_controls, padding])
    other = Halfspaces((scale.unsqueeze(-1) * padded.A)[:, order], (scale * padded.b)[:, order])
    u2, active2, mu2, feasible2 = solve_safe_qp(other, uhat)
    back = order.argsort()
    assert torch.equal(feasible, feasible2)
    assert torch.equal(active, active2[:, back][:, :4])
    assert not active2[:, back][:, 4:].any()
    torch.testing.assert_close(u, u2, atol=1e-12, rtol=0)
    torch.testing.assert_close(mu, (mu2[:, back] * scale)[:, :4], atol=1e-10, rtol=0)


def test_uhat_of_another_dimension_is_refused():
    with pytest.raises(InputError, match="uhat"):
        solve_safe_qp(Halfspaces(tensor([1.0, 0.0]), tensor(-1.0)), tensor(2.0, 3.0, 1.0))


@pytest.mark.parametrize("reach", [3.0, 0.1])
def test_a_gap_exactly_as_wide_as_is_safe_is_feasible(reach):
    """Two rows that are opposite up to round-off, with bounds that leave nothing or a rounding error between them."""
    rng = np.random.default_rng(13)
    turn, bound = rng.uniform(0, 2 * np.pi, 5000), rng.uniform(-1, 1, 5000)
    rows = [np.stack([np.cos(angle), np.sin(angle)], axis=-1) for angle in (turn, turn + np.pi)]
    for gap in (0.0, 1e-16):
        safe_controls = Halfspaces(torch.tensor(np.stack(rows, 1)), torch.tensor(np.stack([bound, gap - bound], -1)))
        solution = solve_safe_qp(safe_controls, torch.tensor(reach * rng.normal(size=(5000, 2))))
        assert solution.feasible.all()
        assert safe_controls.slack(solution.u).min() > -1e-13
    clearly = Halfspaces(safe_controls.A, safe_controls.b - 1e-9)
    assert not solve_safe_qp(clearly, torch.zeros(5000, 2, dtype=torch.float64)).feasible.any()
