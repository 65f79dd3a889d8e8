"""Robots driven by accelerations: their rows, the errors of these, their motion, and sets that keep the truth."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.problems import solve_qp
from tests.second_order_teams import TASKS, barriers_of, crossing, measured
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.observers.ukf import ParameterUkf
from torchfsid.outcome import Status
from torchfsid.robots.affine_barrier import AffineBarrier
from torchfsid.robots.barriers import SpeedBox
from torchfsid.robots.bounds import ErrorBounds, NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import LeftOut, Measurement
from torchfsid.robots.neighbours import left_out_inactive, nearest_bodies, within_bounds
from torchfsid.robots.second_order import SecondOrderAvoidance
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask, Saturation
from torchfsid.sets.feasible_set import FeasibleSet

EXACT = NoiseBound(1e-9)
INEXACT = NoiseBound(
    3e-3, position=2e-3, neighbour_velocity=4e-3, neighbour_acceleration=5e-3, arrival=3e-3
)  # fmt: skip


def random_measurement(generator: torch.Generator, count: int) -> Measurement:
    """One robot and one body, `count` times."""
    x, v, a = torch.randn(3, count, 2, generator=generator, dtype=torch.float64)
    body, body_v, body_a = torch.randn(3, count, 1, 2, generator=generator, dtype=torch.float64)
    there = torch.ones(count, 1, dtype=torch.bool)
    return Measurement(0.0, x, a, body, there, body_v, velocity=v, body_accelerations=body_a)


def prior(robots: int) -> FeasibleSet:
    corner = torch.full((robots, 2), 4.0, dtype=torch.float64)
    return FeasibleSet.from_box(-corner, corner)


@pytest.mark.parametrize("neighbour", ["none", "current"])
def test_rows_are_the_derivatives_of_h(neighbour: str) -> None:
    """(d/dt + k1)(d/dt + k2) h along the motion, by finite differences, is |row| times the slack."""
    k1, k2, Ds = 1.5, 0.7, 0.6
    barrier = SecondOrderAvoidance((k1, k2), safety_distance=Ds, neighbour_acceleration=neighbour)
    seen = random_measurement(torch.Generator().manual_seed(1), 200)
    assert seen.u is not None
    assert seen.velocity is not None
    assert seen.body_velocities is not None
    assert seen.body_accelerations is not None
    pull = seen.body_accelerations[:, 0] if neighbour == "current" else torch.zeros_like(seen.u)

    def h(t: float) -> Tensor:
        robot = seen.x + t * seen.velocity + t**2 / 2 * seen.u
        body = seen.bodies[:, 0] + t * seen.body_velocities[:, 0] + t**2 / 2 * pull
        return (robot - body).square().sum(-1) - Ds**2

    step = 1e-3
    before, now, after = h(-step), h(0.0), h(step)
    wanted = (after - 2 * now + before) / step**2 + (k1 + k2) * (after - before) / (2 * step) + k1 * k2 * now
    rows = barrier(seen)
    torch.testing.assert_close(rows.b[:, 0] - (rows.A[:, 0] * seen.u).sum(-1), wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("neighbour", ["none", "current"])
def test_row_errors_hold_on_both_sides(neighbour: str) -> None:
    """Every vector is moved by its bound in 6 directions, and the numbers to corners of their box: no direction and no
    slack changes by more than told."""
    generator = torch.Generator().manual_seed(2)
    compass = [(math.cos(k * math.pi / 3), math.sin(k * math.pi / 3)) for k in range(6)]
    moves = torch.tensor(list(itertools.product(compass, repeat=4)), dtype=torch.float64)
    tight = 0.0
    for scale, unknown in itertools.product((0.0, 1e-3, 0.05, 0.3), (0.0, 0.02, 0.4)):
        of_1, of_2, of_Ds = unknown * torch.tensor([1.0, 0.5, 0.2]).double()
        barrier = SecondOrderAvoidance(
            (1.5, 0.7), safety_distance=0.5, neighbour_acceleration=neighbour,
            gain_errors=(float(of_1), float(of_2)), distance_error=float(of_Ds),
        )  # fmt: skip
        for _ in range(20):
            one = random_measurement(generator, 1).select(torch.zeros(len(moves), dtype=torch.long))
            assert one.velocity is not None
            assert one.body_velocities is not None
            assert one.body_accelerations is not None
            sizes = scale * torch.rand(5, generator=generator, dtype=torch.float64)
            sides = [float(side) for side in 2 * torch.randint(0, 2, (3,), generator=generator) - 1]
            other = SecondOrderAvoidance(
                (1.5 + sides[0] * float(of_1), 0.7 + sides[1] * float(of_2)),
                safety_distance=0.5 + sides[2] * float(of_Ds), neighbour_acceleration=neighbour,
            )  # fmt: skip
            robot, body = ErrorBounds.none(one)[0], ErrorBounds.none(one)[1]
            bounds = ErrorBounds(
                robot + sizes[0], body + sizes[1], body + sizes[2], robot + sizes[3], body + sizes[4], robot
            )
            told = barrier.errors(one, bounds)
            if told.angle[0, 0] >= math.pi:
                assert told.slack[0, 0] == math.inf
                continue
            true = replace(
                one,
                x=one.x + sizes[0] * moves[:, 0],
                bodies=one.bodies - sizes[1] * moves[:, :1],
                body_velocities=one.body_velocities + sizes[2] * moves[:, 1:2],
                velocity=one.velocity - sizes[3] * moves[:, 2],
                body_accelerations=one.body_accelerations + sizes[4] * moves[:, 3:],
            )
            cosine = (barrier(one).normalised().A * other(true).normalised().A).sum(-1).clamp(-1, 1)
            assert (cosine.arccos() <= told.angle + 1e-7).all()
            change = barrier(one).normalised().slack(one.u) - other(true).normalised().slack(one.u)
            assert (change.abs() <= told.slack * (1 + 1e-9) + 1e-12).all()
            if scale == unknown == 0:
                assert (told.slack == 0).all()
                continue
            tight = max(tight, float(change.abs().max() / told.slack.max()))
    assert tight > 0.6


@pytest.mark.parametrize("neighbour", ["none", "current"])
@pytest.mark.parametrize("task", TASKS)
def test_a_run_against_an_independent_integrator(task: str, neighbour: str) -> None:
    """The QPs solved by DAQP, the motion in a hundred small steps of each sampling time."""
    goals, run = crossing(task, neighbour, 0)
    assert run.velocity is not None
    n, x, v = 4, run.x[0].numpy().copy(), run.velocity[0].numpy().copy()
    gain, damping, limit, loop = {
        "damped": (0.6, 1.4, math.inf, 0.0), "clipped": (0.8, 1.5, 0.5, 0.0), "loop": (0.7, 0.0, 0.5, 1.8),
    }[task]  # fmt: skip
    share = 1.0 if neighbour == "current" else 0.0
    for k in range(len(run.t)):
        np.testing.assert_allclose(run.x[k], x, atol=1e-6)
        np.testing.assert_allclose(run.velocity[k], v, atol=1e-6)
        wish = gain * (goals.numpy() - x[:n]) - damping * v[:n]
        wish = wish / np.maximum(1.0, np.linalg.norm(wish, axis=-1, keepdims=True) / limit)
        wish = wish if loop == 0 else loop * (wish - v[:n])
        rows, bounds = [], []
        for i, j in itertools.product(range(n), range(n + 1)):
            if i != j:
                dx, dv, row = x[i] - x[j], v[i] - v[j], np.zeros((n, 2))
                row[i] = -2 * dx
                if j < n:
                    row[j] = share * 2 * dx
                rows.append(row.ravel())
                bounds.append(2 * dv @ dv + 3.5 * 2 * dx @ dv + 3.0 * (dx @ dx - 0.4**2))
        rows += [*np.eye(2 * n), *-np.eye(2 * n)]
        a = np.zeros((n + 1, 2))
        a[:n] = solve_qp(np.array(rows), np.array(bounds + [1.5] * 4 * n), wish.ravel()).reshape(n, 2)
        np.testing.assert_allclose(run.u[k], a, atol=1e-5)
        for _ in range(100):
            x, v = x + 1e-3 * (v + 5e-4 * a), v + 1e-3 * a
    assert run.active[:, :, :5].any()


@pytest.mark.parametrize("noise", [EXACT, INEXACT], ids=["exact", "inexact"])
@pytest.mark.parametrize("neighbour", ["none", "current"])
@pytest.mark.parametrize("task", TASKS)
def test_the_truth_stays_inside(task: str, neighbour: str, noise: NoiseBound) -> None:
    generator, sizes = torch.Generator().manual_seed(4), []
    for seed in range(2):
        goals, run = crossing(task, neighbour, seed)
        watching = SetMembershipObserver(TASKS[task], barriers_of(neighbour), prior(4), noise=noise)
        for seen in measured(run, noise, generator):
            assert watching.update(seen).feasible_set.contains(goals).all()
        assert (watching.status == Status.OK).all()
        sizes.append(watching.feasible_set.diameter())
    assert torch.cat(sizes).median() < (1e-3 if noise is EXACT else 1.0)


@pytest.mark.parametrize("task", TASKS)
def test_compiled_and_batched_are_the_same(task: str) -> None:
    """Compiled code and torch, a batch and single samples: the same half-spaces."""
    _, run = crossing(task, "current", 0)
    samples = list(measured(run, INEXACT, torch.Generator().manual_seed(6)))[::4]
    model = ObservationModel(TASKS[task], barriers_of("current"), noise=INEXACT)
    together = evidence(model, prior(4), Measurement.concatenate(samples), False)
    one_by_one = [evidence(model, prior(4), seen, False) for seen in samples]
    torch.testing.assert_close(together.omega.b, torch.cat([found.omega.b for found in one_by_one]))
    assert together.informative.any()
    if TASKS[task].saturation is None:
        compiled = evidence(model, prior(4), Measurement.concatenate(samples), True)
        torch.testing.assert_close(compiled.slack, together.slack)
        assert torch.equal(compiled.informative, together.informative)
        sets = [prior(4 * len(samples)).intersect(found.omega).volume() for found in (compiled, together)]
        torch.testing.assert_close(*sets)


def test_a_velocity_loop_is_a_goal_task_of_u() -> None:
    """uhat = k_a (clip(k_v (theta - x)) - v): with w = a/k_a + v a goal task, and rows k_a A w <= b + k_a A v."""
    k_v, k_a, limit = 0.7, 1.8, Saturation("norm", (0.5, 0.5))
    loop, inner = GoalTask.in_velocity_loop(k_v, k_a, limit), GoalTask(k_v, saturation=limit)
    _, run = crossing("loop", "none", 1)
    for k in range(0, len(run.t), 9):
        seen = run.measurement(k)
        assert seen.u is not None
        assert seen.velocity is not None
        rows = Halfspaces.stack([barrier(seen) for barrier in barriers_of("none")])
        moved = rows.b + k_a * (rows.A * seen.velocity.unsqueeze(-2)).sum(-1)
        inner_rows = Halfspaces(k_a * rows.A, moved)
        names = tuple(map(str, range(rows.rows)))
        told = AffineBarrier(inner_rows.A, inner_rows.b, names)
        w = replace(seen, u=seen.u / k_a + seen.velocity, body_velocities=None, body_accelerations=None)
        outer = evidence(ObservationModel(loop, barriers_of("none"), noise=NoiseBound(k_a * 1e-3)), prior(4), seen)
        within = evidence(ObservationModel(inner, [told], noise=NoiseBound(1e-3)), prior(4), w)
        sets = [prior(4).intersect(found.omega).volume() for found in (outer, within)]
        torch.testing.assert_close(*sets)


@pytest.mark.parametrize(("task", "inside"), [*((task, False) for task in TASKS), ("loop", True)])
def test_the_filter(task: str, inside: bool) -> None:
    """It takes the velocities for its state, which the accelerations change."""
    goals, run = crossing(task, "none", 1)
    corner = torch.full((4, 2), 4.0, dtype=torch.float64)
    ukf = ParameterUkf.from_prior(TASKS[task], barriers_of("none"), -corner, corner, qp_inside=inside)
    for k in range(len(run.t)):
        estimate = ukf.update(run.measurement(k))
    assert (estimate.status == Status.OK).all()
    assert (estimate.theta - goals).norm(dim=-1).median() < 0.2


def test_bodies_left_out_are_proved_inactive() -> None:
    """What `slack_left_out` promises, for bodies as near, as fast and as bad as they can be; unknown is not proved."""
    generator = torch.Generator().manual_seed(8)
    for neighbour in ("none", "current"):
        barrier = SecondOrderAvoidance((1.5, 0.7), safety_distance=0.5, neighbour_acceleration=neighbour)
        seen = random_measurement(generator, 4000)
        assert seen.body_velocities is not None
        assert seen.body_accelerations is not None
        apart = (seen.x - seen.bodies[:, 0]).norm(dim=-1)
        left_out = LeftOut(
            apart, seen.body_velocities[:, 0].norm(dim=-1), apart, seen.body_accelerations[:, 0].norm(dim=-1)
        )
        least = barrier.slack_left_out(replace(seen, left_out=left_out))
        assert (barrier(seen).normalised().slack(seen.u)[:, 0] >= least).all()
    unknown = replace(seen, left_out=left_out._replace(acceleration=torch.full_like(apart, math.nan)))
    assert not left_out_inactive([barrier], unknown, torch.tensor(0.0), torch.tensor(0.0)).any()
    wider = within_bounds(replace(seen, left_out=left_out), NoiseBound(0.0, arrival=0.1, neighbour_velocity=0.2))
    assert torch.allclose(barrier.slack_left_out(wider), least - 2.2 * 0.3)


def test_a_fleet_keeps_the_truth() -> None:
    """Two teams far apart, with slots for the three nearest bodies: the sets are those of a team on its own."""
    task, barriers = TASKS["damped"], barriers_of("current")
    goals, run = crossing("damped", "current", 2, robots=3)
    assert run.velocity is not None
    few, full = (SetMembershipObserver(task, barriers, prior(3), noise=EXACT) for _ in range(2))
    for k in range(len(run.t)):
        full.update(run.measurement(k))
        x, v, a = (torch.cat([run.x[k], run.x[k] + 12.0]), *(torch.cat([of[k]] * 2) for of in (run.velocity, run.u)))
        few.update(nearest_bodies(float(run.t[k]), x, v, count=3, robots=range(3), acceleration=a))
        assert few.feasible_set.contains(goals).all()
    assert torch.equal(few.skipped, full.skipped)
    torch.testing.assert_close(few.feasible_set.volume(), full.feasible_set.volume())


def test_a_joint_qp_that_fails_says_nothing() -> None:
    """The commands of the whole team are zero, while the robots coast."""
    weak = SpeedBox((0.2, 0.2), quantity="acceleration")
    task, barriers = TASKS["damped"], [barriers_of("current")[0], weak]
    x = torch.tensor([[0.0, 0.0], [0.41, 0.0], [3.0, 3.0]], dtype=torch.float64)
    v = torch.tensor([[0.35, 0.0], [-0.35, 0.0], [0.2, 0.0]], dtype=torch.float64)
    run = simulate(CbfQpController(task, barriers), torch.zeros_like(x), x, dt=0.05, steps=1, velocity=v)
    assert not run.feasible[0].any()
    found = evidence(ObservationModel(task, barriers, noise=EXACT), prior(3), run.measurement(0))
    assert not found.informative.any()


def test_gradients_reach_gains_and_goals() -> None:
    gains = torch.tensor([1.5, 2.0], dtype=torch.float64, requires_grad=True)
    goals = torch.tensor([[2.0, 0.1], [-2.0, 0.0]], dtype=torch.float64, requires_grad=True)

    def end(gains: Tensor, goals: Tensor) -> Tensor:
        barrier = SecondOrderAvoidance((gains[0], gains[1]), safety_distance=0.5, neighbour_acceleration="none")
        controller = CbfQpController(TASKS["damped"], [barrier])
        start = torch.tensor([[-0.6, 0.0], [0.6, 0.02]], dtype=torch.float64)
        run = simulate(controller, goals, start, dt=0.1, steps=6, velocity=torch.zeros_like(start))
        return run.x[-1]

    assert torch.autograd.gradcheck(end, (gains, goals), atol=1e-6)


@pytest.mark.parametrize(
    ("barrier", "missing"),
    [
        (SecondOrderAvoidance((1.0, 1.0), safety_distance=0.5), {"velocity": None}),
        (SecondOrderAvoidance((1.0, 1.0), safety_distance=0.5), {"body_velocities": None}),
        (SecondOrderAvoidance((1.0, 1.0), margin=0.1), {}),
        (
            SecondOrderAvoidance((1.0, 1.0), safety_distance=0.5, neighbour_acceleration="current"),
            {"body_accelerations": None},
        ),
    ],
)
def test_what_the_rows_need(barrier: SecondOrderAvoidance, missing: dict) -> None:
    seen = random_measurement(torch.Generator().manual_seed(10), 3)
    with pytest.raises(InputError, match="measurement"):
        barrier(replace(seen, **missing))


def test_wrong_arguments() -> None:
    for arguments in ({"gains": (1.0, 0.0), "margin": 0.1}, {"gains": (1.0, 1.0)}):
        with pytest.raises(InputError):
            SecondOrderAvoidance(**arguments)
    with pytest.raises(InputError, match="damping"):
        GoalTask(1.0, damping=-1.0)
    start = torch.zeros(2, 2, dtype=torch.float64)
    with pytest.raises(InputError, match="velocity"):
        simulate(
            CbfQpController(GoalTask(1.0), barriers_of("none")),
            start,
            start,
            dt=0.1,
            steps=1,
            velocity=start * math.nan,
        )
