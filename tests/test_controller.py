"""The controller: its control is the solution of the safety QP, and differentiable; joint QPs of a team."""

import itertools

import cvxpy
import numpy as np
import pytest
import torch

from torchfsid.errors import InputError
from torchfsid.identification.kkt import solve_kkt
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import SpeedBox, stack_barriers
from torchfsid.robots.controller import CbfQpController, solve_safe_qp
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import GoalTask


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


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
    with pytest.raises(InputError, match="teams"):
        controller(scene(), torch.zeros(4, 1, 2, dtype=torch.float64))
    with pytest.raises(InputError, match="teams"):
        controller(scene(), torch.zeros(4, 2, dtype=torch.float64))
    with pytest.raises(InputError, match="slot i"):
        controller(Measurement.of_team(0.0, BODIES, robots=[1]), tensor([1.0, 2.0]))
    with pytest.raises(InputError, match="batch"):
        controller(Measurement.of_team(0.0, BODIES), torch.zeros(2, 2, dtype=torch.float64))
