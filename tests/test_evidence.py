"""What one measurement says: its derivatives, the KKT conditions solved once, and what it takes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from tests.problems import paper_case
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification import evidence as room
from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.identification.kkt import solve_kkt
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import SpeedBox
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet

AVOIDANCE = CollisionAvoidance(ClassK(1.5), safety_distance=0.4)
TASK, NOISE = GoalTask(0.9), NoiseBound(1e-3)


def crowd(robots: int, bodies: int = 4) -> tuple[Tensor, Tensor, Tensor]:
    """Robots among bodies of their own, and what they do; most of them are held up by one body or two."""
    generator = torch.Generator().manual_seed(2)
    x, direction = torch.randn(2, robots, 2, generator=generator, dtype=torch.float64)
    angle = 2 * torch.pi * torch.rand(robots, bodies, generator=generator, dtype=torch.float64)
    away = 0.45 + 0.6 * torch.rand(robots, bodies, 1, generator=generator, dtype=torch.float64)
    body = x.unsqueeze(1) + away * torch.stack([angle.cos(), angle.sin()], dim=-1)
    before = Measurement(0.0, x, None, body, torch.ones(robots, bodies, dtype=torch.bool))
    return x, body, CbfQpController(TASK, [AVOIDANCE])(before, x + 3 * direction).u


def prior(robots: int, half: float = 9.0) -> FeasibleSet:
    corner = torch.full((robots, 2), half, dtype=torch.float64)
    return FeasibleSet.from_box(-corner, corner)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("noise", [NOISE, NoiseBound(1e-3, position=1e-2)], ids=["exact", "position errors"])
@pytest.mark.parametrize("kind", ["critical_region", "inverse_optimal"])
def test_half_spaces_are_differentiable_in_all_that_is_measured(kind: Any, noise: NoiseBound) -> None:
    x, body, u = crowd(12)
    there, model = torch.ones(12, 4, dtype=torch.bool), ObservationModel(TASK, [AVOIDANCE], kind, noise)

    def rows(x: Tensor, body: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        omega = evidence(model, prior(12), Measurement(0.0, x, u, body, there)).omega
        return omega.A, omega.b

    inputs = tuple(values.clone().requires_grad_() for values in (x, body, u))
    found = evidence(model, prior(12), Measurement(0.0, inputs[0], inputs[2], inputs[1], there))
    assert len(found.kkt.case.unique()) == 3
    assert gradcheck(rows, inputs, fast_mode=True)
    assert gradgradcheck(rows, inputs, fast_mode=True)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("case", ["B", "D", "E three pointed", "E four pointed", "E half-plane"])
def test_the_solution_of_the_kkt_conditions_has_two_derivatives(case: str) -> None:
    """Also where the rows do not meet in one point any more, and of orthogonal rows of equal length."""
    safe_controls, active, C, d = paper_case(case, np.random.default_rng(3)).tensors
    right = torch.tensor([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], dtype=torch.float64)
    for A, b, which in (
        (safe_controls.A, safe_controls.b, active),
        (right, torch.tensor([0.2, 0.1, 9.0], dtype=torch.float64), torch.tensor([True, True, False])),
    ):

        def solution(A: Tensor, b: Tensor, C: Tensor, d: Tensor, which: Tensor = which) -> tuple[Tensor, ...]:
            kkt = solve_kkt(Halfspaces(A, b), which, C, d)
            return kkt.G, kkt.f, kkt.projector, kkt.offset

        inputs = tuple(values.clone().requires_grad_() for values in (A, b, C, d))
        assert gradcheck(solution, inputs)
        assert gradgradcheck(solution, inputs, fast_mode=True)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("kind", "at_once"), [("critical_region", 1), ("inverse_optimal", 0)])
def test_kkt_conditions_are_solved_once(
    kind: Any, at_once: int, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The paper's set needs them, the other one does not; compiled code solves them on the way."""
    solved: list[int] = []

    def counted(*arguments: Any, solve: Any = room.solve_unit) -> Any:
        solved.append(1)
        return solve(*arguments)

    monkeypatch.setattr(room, "solve_unit", counted)
    x, body, u = crowd(3)
    watching = SetMembershipObserver(TASK, [AVOIDANCE], prior(3), kind, NOISE, compiled=compiled)
    estimate = watching.update(Measurement(0.0, x, u, body, torch.ones(3, 4, dtype=torch.bool)))
    assert len(solved) == (0 if compiled else at_once)
    assert estimate.kkt is estimate.kkt
    assert len(solved) == (0 if compiled else 1)


@pytest.mark.parametrize("compiled", [False, True])
def test_single_precision_is_cast_up(compiled: bool) -> None:
    x, body, u = (values.float() for values in crowd(20))
    there, model = torch.ones(20, 4, dtype=torch.bool), ObservationModel(TASK, [AVOIDANCE], noise=NOISE)
    single = evidence(model, prior(20), Measurement(0.0, x, u, body, there), compiled)
    double = evidence(model, prior(20), Measurement(0.0, x.double(), u.double(), body.double(), there), compiled)
    assert single.omega.A.dtype == torch.float64
    torch.testing.assert_close(single.slack, double.slack, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("compiled", [False, True])
def test_no_robots_say_nothing(compiled: bool) -> None:
    nobody = torch.zeros(0, 2, dtype=torch.float64)
    measurement = Measurement(0.0, nobody, nobody, torch.zeros(0, 3, 2).double(), torch.zeros(0, 3).bool())
    model = ObservationModel(TASK, [AVOIDANCE, SpeedBox((1.0, 1.0))], noise=NOISE)
    assert evidence(model, prior(0), measurement, compiled).omega.A.shape[0] == 0


def test_what_is_read_later_is_what_was_measured() -> None:
    """The tensors of a measurement may be used again: slacks and KKT conditions are of the numbers it had."""
    x, body, u = crowd(20)
    model, there = ObservationModel(TASK, [AVOIDANCE], "inverse_optimal", NOISE), torch.ones(20, 4, dtype=torch.bool)
    kept = evidence(model, prior(20), Measurement(0.0, x, u, body, there))
    given = [part.clone() for part in (x, u, body)]
    reused = evidence(model, prior(20), Measurement(0.0, *given, there))
    for part in given:
        part += 1.0
    torch.testing.assert_close(reused.slack, kept.slack, rtol=0, atol=0)
    torch.testing.assert_close(reused.kkt.f, kept.kkt.f, rtol=0, atol=0)


def test_wrong_use_is_refused() -> None:
    x, body, u = crowd(3)
    measurement = Measurement(0.0, x, u, body, torch.ones(3, 4, dtype=torch.bool))
    model = ObservationModel(TASK, [AVOIDANCE], noise=NOISE)
    assert evidence(model, prior(1), measurement).informative.shape == (3,)
    for robots in (2, 6):
        with pytest.raises(InputError, match="measurement"):
            evidence(model, prior(robots), measurement)
    with pytest.raises(InputError, match="velocities"):
        evidence(model, prior(3), Measurement(0.0, x, None, body, measurement.present))
    for wrong in ({"noise": None}, {"active_tolerance": 0.0}):
        with pytest.raises(InputError):
            ObservationModel(**{"task": TASK, "barriers": [AVOIDANCE], "noise": NOISE} | wrong)
