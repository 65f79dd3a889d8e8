"""The safety QP and its differentiable control, against exact rationals, a conic solver and finite differences."""

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
from torchfsid.robots.barriers import ClassK, CollisionAvoidance, SpeedBox, stack_barriers
from torchfsid.robots.controller import CbfQpController, solve_safe_qp
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import GoalTask

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


# ---------------------------------------------------------------- the controller

BODIES = tensor([1.0, 0.3], [0.9, -0.5], [-2.0, 1.0])


def scene(x=(0.0, 0.0), bodies=BODIES):
    """One robot, the body in slot 0, among the others."""
    return Measurement.of_team(0.0, torch.cat([tensor(x), bodies]), robots=[0])


def avoid(gamma=1.2, Ds=0.5, **options):
    return CollisionAvoidance(ClassK(gamma), safety_distance=Ds, **options)


def test_the_control_solves_the_qp_and_is_affine_in_theta():
    rng = np.random.default_rng(7)
    controller = CbfQpController(GoalTask(1.1), [avoid(), SpeedBox((0.8, 0.6))])
    for _ in range(40):
        measurement = Measurement.of_team(0.0, torch.tensor(rng.uniform(-2, 2, size=(6, 2))))
        theta = torch.tensor(rng.uniform(-3, 3, size=(6, 2)))
        control = controller(measurement, theta)
        C, d = controller.task(measurement)
        safe_controls = stack_barriers(controller.barriers, measurement)
        solution = solve_safe_qp(safe_controls, control.nominal)
        assert torch.equal(control.active, solution.active)
        assert torch.equal(control.feasible, solution.feasible)
        torch.testing.assert_close(control.u, solution.u, atol=1e-11, rtol=0)
        kkt = solve_kkt(safe_controls, control.active, C, d)
        affine = (kkt.G @ theta.unsqueeze(-1)).squeeze(-1) + kkt.f
        torch.testing.assert_close(control.u[control.feasible], affine[control.feasible], atol=1e-12, rtol=0)


def test_theta_may_have_more_batch_dimensions_than_the_measurement():
    controller = CbfQpController(GoalTask(1.1), [avoid()])
    measurement = Measurement.of_team(0.0, torch.tensor(np.random.default_rng(8).uniform(-1.5, 1.5, size=(3, 2))))
    theta = torch.tensor(np.random.default_rng(9).uniform(-3, 3, size=(20, 3, 2)))
    control = controller(measurement, theta)
    assert control.u.shape == (20, 3, 2)
    assert control.active.shape == (20, 3, 3)
    for sample in range(20):
        torch.testing.assert_close(control.u[sample], controller(measurement, theta[sample]).u, atol=1e-14, rtol=0)


# goal, distance, active rows; every scene is far from a switch, which the test checks
SCENES = {
    "none active": ((-1.5, -1.5), "squared", []),
    "one active": ((2.0, 3.0), "squared", [1]),
    "two active": ((3.0, -0.2), "squared", [1, 2]),
    "two active, euclidean": ((3.0, -0.2), "euclidean", [1, 2]),
}


@pytest.mark.parametrize("name", SCENES)
def test_gradients_of_the_control(name):
    goal, distance, rows = SCENES[name]

    def control(theta, x, bodies, gain, gamma, Ds):
        return CbfQpController(GoalTask(gain), [avoid(gamma, Ds, distance=distance)])(
            Measurement.of_team(0.0, torch.cat([x, bodies]), robots=[0]), theta
        )

    values = [tensor(goal), tensor([0.0, 0.0]), BODIES, tensor(0.9)[0], tensor(1.2)[0], tensor(0.5)[0]]
    values = [value.clone().requires_grad_() for value in values]
    at = control(*values)
    measurement = scene()
    safe_controls = stack_barriers([avoid(distance=distance)], measurement)
    assert at.active[0].nonzero().flatten().tolist() == rows
    assert (safe_controls.slack(at.u)[~at.active] > 1e-2).all()
    assert (solve_safe_qp(safe_controls, at.nominal).multipliers[at.active] > 1e-2).all()
    assert torch.autograd.gradcheck(lambda *inputs: control(*inputs).u, values, atol=1e-7)


def test_float32_parameters_get_float32_gradients():
    theta = torch.tensor([[2.0, 3.0]], dtype=torch.float32, requires_grad=True)
    control = CbfQpController(GoalTask(0.9), [avoid()])(scene(), theta)
    assert control.u.dtype == torch.float64
    control.u.sum().backward()
    assert theta.grad is not None
    assert theta.grad.dtype == torch.float32
    assert theta.grad.abs().sum() > 0


def test_an_infeasible_robot_stands_still_with_zero_gradient():
    """Squeezed between two bodies, closer than the safety distance to both: no control gets away from both."""
    theta = tensor([2.0, 3.0]).requires_grad_()
    bodies = tensor([0.2, 0.0], [-0.2, 0.0]).requires_grad_()
    control = CbfQpController(GoalTask(0.9), [avoid()])(scene(bodies=bodies), theta)
    assert control.feasible.tolist() == [False]
    assert not control.active.any()
    assert control.u.tolist() == [[0.0, 0.0]]
    for gradient in torch.autograd.grad(control.u.sum(), [theta, bodies]):
        assert torch.equal(gradient, torch.zeros_like(gradient))


def test_two_bodies_at_one_place_are_infeasible_not_an_error():
    for distance in ("squared", "euclidean"):
        control = CbfQpController(GoalTask(0.9), [avoid(distance=distance)])(
            scene(bodies=tensor([0.0, 0.0])), tensor([2.0, 3.0])
        )
        assert control.feasible.tolist() == [False]
        assert control.u.tolist() == [[0.0, 0.0]]


def test_a_joint_qp_decides_where_current_velocities_count():
    """Written out for a conic solver: one row per pair, -2 dx.u_i + 2 dx.u_j <= gamma h, and one per obstacle."""
    rng = np.random.default_rng(11)
    gamma, Ds = 1.2, 0.5
    controller = CbfQpController(GoalTask(1.1), [SpeedBox((2.0, 2.0)), avoid(gamma, Ds, neighbour_velocity="current")])
    shared = 0
    for _ in range(15):
        x = rng.uniform(-1.2, 1.2, size=(5, 2))  # three robots, two obstacles
        while min(np.linalg.norm(x[i] - x[j]) for i, j in itertools.combinations(range(5), 2)) < Ds:
            x = rng.uniform(-1.2, 1.2, size=(5, 2))
        theta = rng.uniform(-3, 3, size=(3, 2))
        measurement = Measurement.of_team(0.0, torch.tensor(x), robots=range(3))
        control = controller(measurement, torch.tensor(theta))

        u = cvxpy.Variable((3, 2))
        rows = [cvxpy.abs(u) <= 2.0]
        for i, j in itertools.combinations(range(5), 2):
            if i < 3:
                dx = x[i] - x[j]
                towards = u[i] - u[j] if j < 3 else u[i]
                rows.append(-2 * dx @ towards <= gamma * (dx @ dx - Ds**2))
        problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(u - 1.1 * (theta - x[:3]))), rows)
        problem.solve(solver=cvxpy.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11)
        assert control.feasible.all()
        np.testing.assert_allclose(control.u.numpy(), u.value, atol=1e-7)

        pairs = control.active[:, 4:7]
        assert torch.equal(pairs, pairs.T)
        shared += int(pairs.any())

        # Each robot's control is also the best one for itself, the neighbours' velocities given.
        velocities = torch.cat([control.u, torch.zeros(2, 2)])
        measured = Measurement.of_team(0.0, torch.tensor(x), velocities, robots=range(3))
        alone = controller(measured, torch.tensor(theta))
        torch.testing.assert_close(alone.u, control.u, atol=1e-10, rtol=0)
    assert shared > 5


def test_gradients_of_the_joint_control():
    x = tensor([0.0, 0.0], [1.0, 0.1], [0.4, 1.0])
    theta = tensor([2.0, 0.2], [-1.0, 0.0])

    def u(x, theta, gamma):
        controller = CbfQpController(GoalTask(0.9), [avoid(gamma, neighbour_velocity="current")])
        return controller(Measurement.of_team(0.0, x, robots=[0, 1]), theta)

    at = u(x, theta, tensor(1.2)[0])
    assert at.active[0, 1]
    assert at.active[1, 0]
    inputs = [value.clone().requires_grad_() for value in (x, theta, tensor(1.2)[0])]
    assert torch.autograd.gradcheck(lambda *values: u(*values).u, inputs, atol=1e-7)


def test_what_the_controller_refuses():
    controller = CbfQpController(GoalTask(0.9), [avoid(neighbour_velocity="current")])
    with pytest.raises(InputError, match="barriers"):
        CbfQpController(GoalTask(0.9), [])
    with pytest.raises(InputError, match="goal_x"):
        controller(scene(), tensor([1.0, 2.0, 3.0]))
    with pytest.raises(InputError, match="finite"):
        controller(scene(), tensor([1.0, float("nan")]))
    with pytest.raises(InputError, match="one team"):
        controller(scene(), torch.zeros(4, 1, 2, dtype=torch.float64))
    with pytest.raises(InputError, match="one team"):
        controller(scene(), torch.zeros(4, 2, dtype=torch.float64))
    with pytest.raises(InputError, match="slot i"):
        controller(Measurement.of_team(0.0, BODIES, robots=[1]), tensor([1.0, 2.0]))
    with pytest.raises(InputError, match="batch"):
        controller(Measurement.of_team(0.0, BODIES), torch.zeros(2, 2, dtype=torch.float64))
