"""Positions and velocities known up to bounds: whole closed loops, errors at the bound, the truth never lost."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import Arena, Barrier, SpeedPolygon
from torchfsid.robots.bounds import ErrorBounds, NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask, OrbitTask, PatrolTask, Saturation, Task, UnknownGainGoalTask, VelocityTask
from torchfsid.sets.feasible_set import FeasibleSet

SATURATIONS = [None, Saturation("norm", (0.5, 0.5), dead_speed=0.03), Saturation("box", (0.5, 0.4))]
BARRIERS: list[list[Barrier]] = [
    [CollisionAvoidance(ClassK(1.0), safety_distance=0.3)],
    [CollisionAvoidance(ClassK(2.0, 3), safety_distance=0.3, neighbour_velocity="current"), SpeedPolygon(8, 0.45)],
    [
        CollisionAvoidance(ClassK(1.0), safety_distance=0.3, distance="euclidean", neighbour_velocity="previous"),
        Arena((-2.0, -2.0), (2.0, 2.0), ClassK(1.0)),
    ],
]


@pytest.mark.parametrize(("which", "clipped"), [(0, 0), (1, 0), (2, 0), (0, 1), (1, 2), (2, 1)])
def test_truth_inside_for_a_whole_run(which: int, clipped: int) -> None:
    barriers, saturation = BARRIERS[which], SATURATIONS[clipped]
    generator = torch.Generator().manual_seed(10 * which + clipped)
    task, n = GoalTask(0.8, saturation=saturation), 4
    turn = 2 * math.pi * torch.arange(n, dtype=torch.float64) / n
    start = 1.4 * torch.stack([turn.cos(), turn.sin()], dim=-1)
    goals = -start + 0.2 * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    run = simulate(CbfQpController(task, barriers), goals, start, dt=0.1, steps=20)
    for position, velocity in [(3e-3, 1e-3), (3e-2, 3e-2)]:

        def error(bound: float, at_the_bound: bool) -> torch.Tensor:
            angle = 2 * math.pi * torch.rand(n, generator=generator, dtype=torch.float64)
            length = 1.0 if at_the_bound else torch.rand(n, 1, generator=generator, dtype=torch.float64)
            return bound * length * torch.stack([angle.cos(), angle.sin()], dim=-1)

        noise = NoiseBound(velocity, position=position, neighbour_velocity=velocity)
        prior = FeasibleSet.from_box(torch.full((n, 2), -4.0), torch.full((n, 2), 4.0))
        watching = SetMembershipObserver(task, barriers, prior, noise=noise)
        previous_u = torch.zeros(n, 2, dtype=torch.float64)
        for k in range(len(run.t)):
            x, u = run.x[k] + error(position, k % 2 == 0), run.u[k] + error(velocity, k % 3 > 0)
            seen = Measurement.of_team(float(run.t[k]), x, u, previous_u=previous_u)
            estimate = watching.update(replace(seen, observed=run.feasible[k]))
            assert estimate.feasible_set.contains(goals).all(), (k, position, velocity)
            previous_u = u
        assert (watching.status == Status.OK).all()


def test_row_errors_hold_at_the_corners_of_the_errors() -> None:
    """Move the robot and a body by their bounds in 16 x 16 directions: nothing changes by more than told."""
    generator = torch.Generator().manual_seed(4)
    compass = [(math.cos(k * math.pi / 8), math.sin(k * math.pi / 8)) for k in range(16)]
    moves = torch.tensor(list(itertools.product(compass, compass)), dtype=torch.float64)
    for distance, velocity, power in itertools.product(["squared", "euclidean"], ["none", "current"], [1, 2, 3]):
        barrier = CollisionAvoidance(
            ClassK(1.5, power), safety_distance=0.4, distance=distance, neighbour_velocity=velocity
        )
        for e_robot, e_body in [(0.01, 0.02), (0.1, 0.0), (0.2, 0.15)]:
            count = len(moves)
            x = torch.randn(1, 2, generator=generator, dtype=torch.float64).expand(count, 2)
            body = x[:, None] + 0.3 + torch.rand(1, 1, 2, generator=generator, dtype=torch.float64)
            u, u_body = torch.randn(2, 1, 2, generator=generator, dtype=torch.float64).expand(2, count, 2)
            there = torch.ones(count, 1, dtype=torch.bool)
            seen = Measurement(0.0, x, u, body, there, body_velocities=u_body.unsqueeze(1))
            exactly = torch.zeros(count, 1, dtype=torch.float64)
            bounds = ErrorBounds.none(seen)._replace(position=exactly[:, 0] + e_robot, body_position=exactly + e_body)
            told = barrier.errors(seen, bounds)
            true = replace(seen, x=x + e_robot * moves[:, 0], bodies=body + e_body * moves[:, 1:])
            measured, rows = barrier(seen).normalised(), barrier(true).normalised()
            cosine = (rows.A * measured.A).sum(-1).clamp(-1, 1)
            assert (cosine.arccos() <= told.angle + 1e-7).all()
            # An active row is not measured as further from active, one that is kept not as further violated.
            assert ((measured.slack(u) - rows.slack(u)).abs() <= told.slack + 1e-9).all()


@pytest.mark.parametrize(
    "task",
    [GoalTask(0.7), UnknownGainGoalTask(), VelocityTask(), OrbitTask(-0.6), PatrolTask(0.7, 0.5, harmonics=2)],
    ids=lambda task: type(task).__name__,
)
def test_drift_bounds_what_position_errors_do_to_the_nominal_control(task: Task) -> None:
    generator = torch.Generator().manual_seed(5)
    p = len(task.parameter_names)
    x, move = torch.randn(2, 500, 2, generator=generator, dtype=torch.float64)
    theta = torch.randn(500, p, generator=generator, dtype=torch.float64)
    nobody = torch.zeros(500, 0, 2, dtype=torch.float64)

    def nominal(at: torch.Tensor) -> torch.Tensor:
        C, d = task(Measurement(0.3, at, None, nobody, nobody[..., 0].bool()))
        return (C @ theta.unsqueeze(-1)).squeeze(-1) + d

    bound = 0.05
    exact = ErrorBounds.none(Measurement(0.0, x, None, nobody, nobody[..., 0].bool()))
    drift = task.drift(exact._replace(position=exact.position + bound), theta.abs())
    moved = nominal(x + bound * move / move.norm(dim=-1, keepdim=True)) - nominal(x)
    assert (moved.norm(dim=-1) <= drift + 1e-12).all()


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("velocity", ["none", "current"])
@pytest.mark.parametrize("distance", ["squared", "euclidean"])
def test_a_body_measured_at_the_robots_own_place(distance: str, velocity: str, compiled: bool) -> None:
    """Positions rounded to decimetres: robot and body fall on one point. Other bodies are near, and known well."""
    generator, goal, lattice = torch.Generator().manual_seed(6), torch.tensor([[3.0, 0.4]], dtype=torch.float64), 0.1
    barrier = CollisionAvoidance(ClassK(1.5), safety_distance=0.03, distance=distance, neighbour_velocity=velocity)
    prior = FeasibleSet.from_box(torch.full((1, 2), -5.0), torch.full((1, 2), 5.0))
    noise = NoiseBound(1e-3, position=lattice * math.sqrt(0.5), neighbour_velocity=1e-3)
    held_up = 0
    for _ in range(40):
        x = lattice * (torch.rand(1, 2, generator=generator, dtype=torch.float64) - 0.5)
        ahead = 0.035 * (goal - x) / (goal - x).norm()
        body = torch.stack([x + ahead, x + torch.tensor([0.0, 0.9])], dim=1)
        there, standing = torch.ones(1, 2, dtype=torch.bool), torch.zeros_like(body)
        exact = Measurement(0.0, x, None, body, there, body_velocities=standing)
        control = CbfQpController(GoalTask(1.0), [barrier])(exact, goal)
        held_up += int(control.active[0, 0])
        rounded = (body / lattice).round() * lattice
        seen = replace(exact, x=(x / lattice).round() * lattice, bodies=rounded, u=control.u)
        watching = SetMembershipObserver(GoalTask(1.0), [barrier], prior, noise=noise, compiled=compiled)
        estimate = watching.update(seen)
        assert estimate.feasible_set.contains(goal).all()
        assert estimate.status.tolist() == [Status.OK]
        if torch.equal(rounded[:, 0], seen.x):
            assert not estimate.informative.any()
    assert held_up > 30


def test_gradients_are_finite_at_a_bodys_place() -> None:
    """Body and robot coincide for one robot of two: the other's half-spaces keep their gradients."""
    for distance in ("squared", "euclidean"):
        barrier = CollisionAvoidance(ClassK(1.5), safety_distance=0.3, distance=distance)
        x = torch.tensor([[0.0, 0.0], [1.0, 0.0]], dtype=torch.float64, requires_grad=True)
        bodies = torch.tensor([[[0.0, 0.0]], [[1.4, 0.0]]], dtype=torch.float64, requires_grad=True)
        u = torch.tensor([[0.1, 0.0], [0.1, 0.2]], dtype=torch.float64)
        prior = FeasibleSet.from_box(torch.full((2, 2), -5.0), torch.full((2, 2), 5.0))
        model = ObservationModel(GoalTask(1.0), [barrier], noise=NoiseBound(1e-2, position=1e-2))
        found = evidence(model, prior, Measurement(0.0, x, u, bodies, torch.ones(2, 1, dtype=torch.bool)))
        assert found.informative.tolist() == [False, True]
        for gradient in torch.autograd.grad(found.omega.A.sum() + found.omega.b.sum(), (x, bodies)):
            assert bool(gradient.isfinite().all())
            assert bool((gradient[1] != 0).any())


@pytest.mark.parametrize("compiled", [False, True])
def test_a_controller_that_may_have_failed_says_nothing(compiled: bool) -> None:
    """Jammed between two bodies, a little too near to both: the QP has no solution and the robot stops. Measured, the
    gap is wide enough, and standing still would say that the robot has arrived."""
    barrier = CollisionAvoidance(ClassK(1.0), safety_distance=0.5)
    goal, there = torch.tensor([[0.3, 3.0]], dtype=torch.float64), torch.ones(1, 2, dtype=torch.bool)
    x = torch.zeros(1, 2, dtype=torch.float64)
    jammed = torch.tensor([[[-0.48, 0.0], [0.48, 0.0]]], dtype=torch.float64)
    control = CbfQpController(GoalTask(1.0), [barrier])(Measurement(0.0, x, None, jammed, there), goal)
    assert not control.feasible.any()
    prior = FeasibleSet.from_box(torch.full((1, 2), -5.0), torch.full((1, 2), 5.0))
    for noise, error in (
        (NoiseBound(1e-3, position=0.03), None),
        (NoiseBound(1e-3), torch.full((1, 2), 0.03).double()),
    ):
        watching = SetMembershipObserver(GoalTask(1.0), [barrier], prior, noise=noise, compiled=compiled)
        seen = Measurement(0.0, x, control.u, 1.06 * jammed, there, body_position_error=error)
        estimate = watching.update(seen)
        assert estimate.feasible_set.contains(goal).all()
        assert not estimate.informative.any()
        clear = watching.update(replace(seen, t=1.0, bodies=3 * jammed, u=x))
        assert clear.informative.all()
