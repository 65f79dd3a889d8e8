"""ORCA: rows and controls against RVO2, the QP in a disc against its conditions, and truths that stay inside."""

import itertools
import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor

from tests import rvo
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import ErrorBounds, NoiseBound, RowErrors
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.neighbours import nearest_bodies
from torchfsid.robots.orca import Orca, OrcaController
from torchfsid.robots.speed_disc import SpeedDisc
from torchfsid.robots.tasks import GoalTask, Saturation, VelocityTask
from torchfsid.sets.feasible_set import FeasibleSet


def test_rows_are_the_lines_of_rvo2() -> None:
    """RVO2 keeps the lines of its last step: point and direction, the half-plane to the left."""
    rng, rows_seen = np.random.default_rng(0), 0
    for _ in range(30):
        scene = rvo.random_scene(rng)
        simulator = scene.simulator()
        simulator.do_step()
        rows = scene.orca(scene.measurement())
        for i in range(len(scene.x)):
            lines = [simulator.get_agent_orca_line(i, k) for k in range(simulator.get_agent_num_orca_lines(i))]
            ours = (rows.A[i] != 0).any(-1).nonzero().flatten().tolist()
            assert len(lines) == len(ours)
            order = [int(simulator.get_agent_agent_neighbor(i, k)) for k in range(len(lines))]
            assert sorted(order) == ours
            for line, j in zip(lines, order, strict=True):
                px, py, dx, dy = _numbers(line)
                touching = abs(np.linalg.norm(scene.x[i] - scene.x[j]) - scene.radius[i] - scene.radius[j]) < 1e-3
                tolerance = 2e-3 if touching else 2e-5
                assert rows.A[i, j].tolist() == pytest.approx([dy, -dx], abs=tolerance)
                assert float(rows.b[i, j]) == pytest.approx(dy * px - dx * py, abs=20 * tolerance)
                rows_seen += 1
    assert rows_seen > 1000


def test_controls_are_those_of_rvo2() -> None:
    """Where the rows have a common control, up to single precision. Else RVO2's violation is not smaller."""
    rng, errors, relaxed = np.random.default_rng(1), [], []
    for _ in range(80):
        scene = rvo.random_scene(rng)
        simulator, agents = scene.simulator(), len(scene.x)
        wishes = rng.normal(0, scene.orca.max_speed, (agents, 2)).astype(np.float32)
        for i, wish in enumerate(wishes.tolist()):
            simulator.set_agent_pref_velocity(i, tuple(wish))
        simulator.do_step()
        theirs = torch.from_numpy(rvo.vectors(simulator, "velocity", agents))
        seen = scene.measurement()
        control = OrcaController(VelocityTask(), scene.orca)(seen, torch.from_numpy(wishes).double())
        rows = scene.orca(seen)
        worse = rows.slack(control.u).amin(-1) - rows.slack(theirs).amin(-1)
        errors.append((control.u - theirs).norm(dim=-1)[control.feasible])
        relaxed.append(worse[~control.feasible])
        assert (control.u.norm(dim=-1) <= scene.orca.max_speed * (1 + 1e-9)).all()
    error, worse = torch.cat(errors), torch.cat(relaxed)
    assert len(error) > 500
    assert len(worse) > 100
    assert error.quantile(0.99) < 1e-6
    assert error.max() < 2e-5  # corners of nearly parallel lines, in single precision
    assert worse.min() > -2e-5  # their control violates its rows as much as ours, or more


def test_the_control_in_a_disc_meets_its_optimality_conditions() -> None:
    """uhat - u lies in the cone of the rows and of the disc at u, or (LP3) the worst rows hold each other."""
    generator = torch.Generator().manual_seed(2)
    a = torch.randn(4000, 5, 2, generator=generator, dtype=torch.float64)
    b = 0.6 * torch.randn(4000, 5, generator=generator, dtype=torch.float64) + 0.3
    uhat = 2 * torch.randn(4000, 2, generator=generator, dtype=torch.float64)
    control = _control(Halfspaces(a, b), uhat)
    u, unit = control.u, Halfspaces(a, b).normalised()
    speed, slack = u.norm(dim=-1), unit.slack(u)
    assert (speed <= 1 + 1e-9).all()
    assert (slack[control.feasible] >= -1e-9).all()
    assert 0.1 < float(control.feasible.double().mean()) < 0.95
    disc = torch.where((speed > 1 - 1e-9).unsqueeze(-1), u, 0.0)
    worst = slack.amin(-1, keepdim=True).clamp(max=0.0)
    near = slack - worst < 1e-7
    generators = torch.cat([torch.where(near.unsqueeze(-1), unit.A, 0.0), disc.unsqueeze(-2)], dim=-2)
    pull = torch.where(control.feasible.unsqueeze(-1), uhat - u, 0.0)
    for k in range(len(u)):
        assert _in_cone(generators[k], pull[k], normalised=not bool(control.feasible[k]))


def test_the_control_in_a_disc_is_differentiable() -> None:
    torch.manual_seed(3)
    scene = rvo.random_scene(np.random.default_rng(8))
    seen = scene.measurement()
    wish = torch.randn(len(scene.x), 2, dtype=torch.float64, requires_grad=True)
    controller = OrcaController(VelocityTask(), scene.orca)
    jacobian = torch.autograd.functional.jacobian(lambda theta: controller(seen, theta).u.sum(0), wish)
    step, direction = 1e-6, torch.randn_like(wish)
    ahead, behind = (controller(seen, (wish + s * direction).detach()).u.sum(0) for s in (step, -step))
    assert torch.einsum("iab,ab->i", jacobian, direction).tolist() == pytest.approx(
        ((ahead - behind) / (2 * step)).tolist(), abs=1e-5
    )


@pytest.mark.parametrize("rho", [0.0, 0.01], ids=["exact", "positions wrong by 1 cm"])
@pytest.mark.parametrize("kind", ["circle", "crossing"])
def test_no_truth_is_lost_among_rvo2_agents(kind: str, rho: float) -> None:
    rng = np.random.default_rng(11)
    agents, orca = 12, replace(rvo.random_orca(rng, 1.2), time_step=0.1, count=10)
    angle = 2 * np.pi * np.arange(agents) / agents
    x = 2.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1) + rng.normal(0, 0.01, (agents, 2))
    goals = -x if kind == "circle" else x[::-1] + rng.normal(0, 0.3, (agents, 2))
    radius = rng.uniform(0.2, 0.35, agents)
    scene = rvo.Scene(orca, *(v.astype(np.float32) for v in (x, np.zeros_like(x), radius)))
    observer = SetMembershipObserver(
        GoalTask(0.5, saturation=Saturation("norm", (1.0, 1.0))), [orca],
        FeasibleSet.from_box(*(side * torch.full((agents, 2), 5.0, dtype=torch.float64) for side in (-1, 1))),
        noise=NoiseBound(1e-5, position=rho),
    )  # fmt: skip
    relaxed = 0
    for sample in rvo.run(scene, goals, 0.5, 1.0, steps=120):
        direction = torch.from_numpy(rng.normal(size=(agents, 2)))
        wrong = sample.bodies[0] + rho * direction / direction.norm(dim=-1, keepdim=True)
        seen = replace(sample, x=wrong, bodies=wrong.expand_as(sample.bodies))
        relaxed += int(observer.update(seen).evidence.infeasible.sum())
    assert observer.feasible_set.contains(torch.from_numpy(goals.astype(np.float32)).double()).all()
    assert (observer.status == Status.OK).all()
    assert relaxed > 0 or kind == "circle"
    if rho == 0 and kind == "crossing":
        assert float(observer.feasible_set.diameter().median()) < 1.1 * 2e-5 / 0.5


def test_rows_hold_for_all_errors_within_their_bounds() -> None:
    """A truly active row is measured active, and in a direction within its angle, even if the branch is another.

    Neither the horizon nor the margin need be known: they are at corners of their intervals, or somewhere between.
    """
    generator = torch.Generator().manual_seed(4)
    B, reached = 20000, 0.0

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def within(bound: float, *shape: int) -> Tensor:
        direction = normal(*shape)
        return bound * direction / direction.norm(dim=-1, keepdim=True)

    known = [(e, eps, 0.0, 0.0, 0.0, 0.0) for e, eps in [(0.002, 0.0), (0.01, 0.01), (0.05, 0.02), (0.0, 0.05)]]
    unknown = [
        (e, eps, 0.05, 0.03, *at) for e, eps in [(0.0, 0.0), (0.01, 0.01)] for at in product((-1, 0.3, 1), (-1, 1))
    ]
    for e, eps, tau, sigma, at_tau, at_sigma in [*known, *unknown, (0, 0, 0.2, 0, 1, 0), (0, 0, 0, 0.1, 0, -1)]:
        orca = Orca(2.0, 0.1, 1.5, 5, 1e3, margin=0.1, rate_error=tau, margin_error=sigma)
        own = replace(orca, time_horizon=1 / (0.5 + at_tau * tau), margin=0.1 + at_sigma * sigma, rate_error=0.0)
        x, v, others = normal(B, 2), 0.5 * normal(B, 2), 0.5 * normal(B, 1, 2)
        away = normal(B, 2)
        body = (x + away / away.norm(dim=-1, keepdim=True) * (0.4 + 2 * normal(B, 1).abs() ** 2)).unsqueeze(-2)
        radius = torch.full((B,), 0.3, dtype=torch.float64)
        true = Measurement(
            0.0, x, None, body, torch.ones(B, 1, dtype=torch.bool), previous_body_velocities=others, velocity=v,
            radius=radius, body_radii=radius.unsqueeze(-1),
        )  # fmt: skip
        row = own(true)
        n, low = -row.A[:, 0], -row.b[:, 0]
        across = torch.stack([-n[:, 1], n[:, 0]], dim=-1)
        u = n * low.unsqueeze(-1) + across * normal(B, 1)  # on the boundary of the true row
        seen = replace(
            true, u=u, x=x + within(e / 2, B, 2), bodies=body + within(e / 2, B, 1, 2),
            velocity=v + within(eps / 2, B, 2), previous_body_velocities=others + within(eps / 2, B, 1, 2),
        )  # fmt: skip
        exact = ErrorBounds.none(seen)
        bounds = exact._replace(
            position=exact.position + e / 2, body_position=exact.body_position + e / 2,
            velocity=exact.velocity + eps / 2, body_velocity=exact.body_velocity + eps / 2,
        )  # fmt: skip
        told, measured = orca.errors(seen, bounds), orca.rows_within(seen, bounds)
        slack = measured.slack(u)[:, 0]
        assert (slack.abs() <= told.slack[:, 0] + 1e-9).all()
        turned = torch.atan2(
            (measured.A[:, 0, 0] * n[:, 1] - measured.A[:, 0, 1] * n[:, 0]).abs(), -(measured.A[:, 0] * n).sum(-1)
        )
        assert (turned <= told.angle[:, 0] + 1e-9).all()
        known = told.angle[:, 0] < math.pi
        reached = max(reached, float((turned / told.angle[:, 0])[known].max()))
    assert reached > 0.8  # the bounds are no larger than they have to be


def test_a_neighbour_that_may_be_chosen_is_a_generator_and_no_alarm() -> None:
    """Two bodies at distances that the bounds cannot tell apart, of which the controller avoids one."""
    orca = Orca(2.0, 0.1, 1.5, 1, 10.0)
    x = torch.tensor([[0.0, 0.0], [0.9, 0.0], [0.0, 0.905]], dtype=torch.float64)
    v = torch.tensor([[0.6, 0.6], [-0.5, 0.0], [0.0, -0.5]], dtype=torch.float64)
    seen = Measurement.of_team(0.0, x, v, robots=[0], previous_u=v, radius=torch.full((3,), 0.3, dtype=torch.float64))
    assert (orca(seen).A[0, :3] != 0).any(-1).tolist() == [False, True, False]
    bounds = ErrorBounds.of(seen, NoiseBound(1e-5, position=0.005))
    assert bounds is not None
    assert (orca.rows_within(seen, bounds).A[0, :3] != 0).any(-1).tolist() == [False, True, True]
    control = CbfQpController(VelocityTask(), [orca])(replace(seen, u=None), torch.tensor([[0.6, 0.6]]).double())
    model = ObservationModel(VelocityTask(), [orca], noise=NoiseBound(1e-5, position=0.005))
    box = FeasibleSet.from_box(torch.full((1, 2), -3.0).double(), torch.full((1, 2), 3.0).double())
    found = evidence(model, box, replace(seen, u=control.u))
    assert not bool(found.alarmed.any())
    assert bool(found.omega.contains(torch.tensor([[0.6, 0.6]]).double()).all())


def test_a_violated_row_that_nothing_explains_is_an_alarm() -> None:
    """One row, violated by far, while the robot is slower than its limit: no ORCA controller does this."""
    orca = Orca(2.0, 0.1, 1.5, 5, 10.0)
    x = torch.tensor([[0.0, 0.0], [0.9, 0.0]], dtype=torch.float64)
    u = torch.tensor([[0.8, 0.1], [-0.8, 0.0]], dtype=torch.float64)
    seen = Measurement.of_team(0.0, x, u, previous_u=u, radius=torch.full((2,), 0.3, dtype=torch.float64))
    box = FeasibleSet.from_box(torch.full((2, 2), -3.0).double(), torch.full((2, 2), 3.0).double())
    for compiled in (True, False):
        found = evidence(ObservationModel(VelocityTask(), [orca], noise=NoiseBound(1e-5)), box, seen, compiled)
        assert found.alarmed.all()
        assert not found.infeasible.any()


def test_single_precision_between_nearly_opposite_rows_is_no_alarm() -> None:
    """Between two bodies RVO2 stops up to 3e-4 m/s short of its speed limit, where the least violation is."""
    orca = Orca(2.0, 0.1, 1.5, 5, 10.0)
    x = torch.tensor([[0.0, 0.0], [0.55, 0.003], [-0.55, 0.0]], dtype=torch.float64)
    v = torch.zeros_like(x)
    seen = Measurement.of_team(0.0, x, previous_u=v, radius=torch.full((3,), 0.3, dtype=torch.float64), robots=[0])
    exact = CbfQpController(VelocityTask(), [orca])(seen, torch.tensor([[0.0, 1.0]]).double())
    assert not exact.feasible.any()
    assert float(exact.u.norm()) == pytest.approx(1.5)
    box = FeasibleSet.from_box(torch.full((1, 2), -3.0).double(), torch.full((1, 2), 3.0).double())
    for compiled, share in itertools.product((True, False), (1.0, 1 - 2e-4)):
        model = ObservationModel(VelocityTask(), [orca], noise=NoiseBound(1e-5))
        found = evidence(model, box, replace(seen, u=share * exact.u), compiled)
        assert found.infeasible.all()
        assert not found.alarmed.any()


def test_bodies_without_a_slot_are_no_neighbours_behind_nearer_ones() -> None:
    rng = np.random.default_rng(5)
    x, v = rng.uniform(-4, 4, (30, 2)), rng.normal(0, 0.3, (30, 2))
    orca, radius = Orca(2.0, 0.1, 1.5, 6, 5.0), np.full(30, 0.2)
    team = Measurement.of_team(
        0.0, torch.from_numpy(x), torch.from_numpy(v), previous_u=torch.from_numpy(v), radius=torch.from_numpy(radius)
    )
    for slots, proven in ((8, True), (4, False)):
        near = nearest_bodies(0.0, x, v, count=slots, previous_u=v, radius=radius)
        assert near.left_out is not None
        assert bool((orca.slack_left_out(near) == math.inf).all()) == proven
    near = nearest_bodies(0.0, x, v, count=8, previous_u=v, radius=radius)
    few, all_of_them = orca(near), orca(team)
    assert sorted(few.b[0][few.b[0] != 1].tolist()) == pytest.approx(
        sorted(all_of_them.b[0][all_of_them.b[0] != 1].tolist())
    )


def test_what_a_measurement_must_have() -> None:
    seen = Measurement.of_team(0.0, torch.eye(2, dtype=torch.float64), None, radius=torch.ones(2))
    with pytest.raises(InputError, match="velocities of robots and bodies one sample earlier"):
        Orca(2.0, 0.1, 1.0, 3, 5.0)(seen)
    with pytest.raises(InputError, match="time_horizon"):
        Orca(0.0, 0.1, 1.0, 3, 5.0)
    joint = CollisionAvoidance(ClassK(1.0), safety_distance=0.3, neighbour_velocity="current")
    with pytest.raises(InputError, match="instead of a disc"):
        CbfQpController(VelocityTask(), [joint, SpeedDisc(1.0)])(seen, torch.zeros(2, 2).double())


def _numbers(line: object) -> tuple[float, float, float, float]:
    direction, point = line  # type: ignore[misc]
    return *point, *direction


class _Fixed:
    soft, relaxes, speed_limit = True, True, 1.0

    def __init__(self, rows: Halfspaces):
        self.rows = rows

    def __call__(self, measurement: Measurement) -> Halfspaces:
        return self.rows

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        return RowErrors.none(self.rows.b)

    def labels(self, bodies: object) -> list[str]:
        return []


def _control(rows: Halfspaces, uhat: Tensor):
    here = torch.zeros_like(uhat)
    nobody = here[:, None][:, :0]
    seen = Measurement(0.0, here, None, nobody, nobody[..., 0].bool())
    return CbfQpController(VelocityTask(), [_Fixed(rows)])(seen, uhat)  # type: ignore[list-item]


def _in_cone(generators: Tensor, vector: Tensor, normalised: bool) -> bool:
    """Is the vector a combination >= 0 of the generators (with weights of sum 1 if `normalised`)?"""
    from scipy.optimize import nnls

    A, y = generators.T.numpy(), vector.numpy()
    if normalised:
        A, y = np.vstack([A, np.linalg.norm(A, axis=0) > 0]), np.append(y, 1.0)
    return nnls(A, y)[1] < 1e-6
