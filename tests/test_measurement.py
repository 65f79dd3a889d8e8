"""Measurements as values: concatenated, selected, and read as one batch."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import Arena, Barrier, SpeedBox
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.neighbours import nearest_bodies
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask, PatrolTask, Saturation, Task, UnknownGainGoalTask
from torchfsid.sets.feasible_set import FeasibleSet

AVOIDANCE = CollisionAvoidance(ClassK(1.5), safety_distance=0.4)
STARTS = torch.tensor([[-1.5, 0.0], [1.5, 0.2], [0.1, 1.5]], dtype=torch.float64)


def samples(task: Task, theta: Tensor, barriers: list[Barrier]) -> list[Measurement]:
    return list(simulate(CbfQpController(task, barriers), theta, STARTS, dt=0.1, steps=12).measurements())


def prior(p: int, half: float = 4.0) -> FeasibleSet:
    return FeasibleSet.from_box(torch.full((3, p), -half), torch.full((3, p), half))


TASKS: dict[str, Task] = {
    "goal": GoalTask(0.9),
    "clipped": GoalTask(0.9, saturation=Saturation("norm", (0.5, 0.5))),
    "unknown gain": UnknownGainGoalTask(),
    "patrol": PatrolTask(0.8, 1.3, harmonics=1),
}


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("noise", [NoiseBound(1e-3), NoiseBound(1e-3, position=1e-2)], ids=["exact", "position errors"])
def test_a_log_is_one_batch(name: str, noise: NoiseBound) -> None:
    """The evidence of all samples at once is that of one after the other, also of a task that depends on the time."""
    task, p = TASKS[name], len(TASKS[name].parameter_names)
    theta = torch.linspace(0.5, 1.5, 3 * p, dtype=torch.float64).reshape(3, p)
    barriers: list[Barrier] = [AVOIDANCE, SpeedBox((0.8, 0.8)), Arena((-3.0, -3.0), (3.0, 3.0), ClassK(1.0))]
    run = samples(task, theta, barriers)
    model, known = ObservationModel(task, barriers, noise=noise), prior(p)
    together = evidence(model, known, Measurement.concatenate(run))
    alone = [evidence(model, known, sample) for sample in run]
    for field in ("informative", "alarmed", "slack", "excess"):
        expected = torch.cat([getattr(each, field) for each in alone])
        torch.testing.assert_close(getattr(together, field), expected, rtol=1e-13, atol=1e-13)
    for field in ("A", "b"):
        expected = torch.cat([getattr(each.omega, field) for each in alone])
        torch.testing.assert_close(getattr(together.omega, field), expected, rtol=1e-12, atol=1e-12)
    assert torch.equal(together.kkt.case, torch.cat([each.kkt.case for each in alone]))
    assert together.informative.sum() > 20
    assert (together.omega.slack(theta.repeat(len(run), 1)).amin(-1) >= -1e-9).all()


def test_parts_are_found_again() -> None:
    run = samples(GoalTask(0.9), torch.ones(3, 2, dtype=torch.float64), [AVOIDANCE])
    joined = Measurement.concatenate(run)
    assert joined.t.tolist() == [sample.t for sample in run for _ in range(3)]  # type: ignore[union-attr]
    part = joined.select(torch.arange(6, 9))
    assert part.time == run[2].t
    for field in fields(Measurement):
        mine, other = getattr(part, field.name), getattr(run[2], field.name)
        if field.name != "t" and other is not None:
            assert torch.equal(mine, other), field.name
    masked = run[0].select(torch.tensor([True, False, True]))
    assert torch.equal(masked.x, STARTS[[0, 2]])
    with pytest.raises(InputError, match=r"measurement\.t"):
        _ = joined.time
    watching = SetMembershipObserver(GoalTask(0.9), [AVOIDANCE], prior(2), noise=NoiseBound(1e-3))
    with pytest.raises(InputError, match=r"measurement\.t"):
        watching.update(joined.select(torch.tensor([0, 4, 8])))


def test_what_only_some_know_is_filled_up() -> None:
    x, u = STARTS, 0.1 * STARTS
    known = nearest_bodies(1.0, x, u, count=1, within=1.0, previous_u=u, seen=torch.tensor([True, True, False]))
    plain = replace(nearest_bodies(2.0, x, u, count=1), left_out=None)
    joined = Measurement.concatenate([known, plain])
    assert joined.observed is not None
    assert joined.left_out is not None
    assert joined.previous_body_velocities is not None
    assert joined.observed.tolist() == [True, True, False, True, True, True]
    assert joined.left_out.distance[3:].isinf().all()
    assert torch.equal(joined.left_out.distance[:3], known.left_out.distance)  # type: ignore[union-attr]
    assert joined.previous_body_velocities[3:].isnan().all()
    errors = replace(plain, position_error=torch.ones(3).double())
    both = Measurement.concatenate([errors, plain])
    assert both.position_error is not None
    assert both.position_error.tolist() == [1.0] * 3 + [0.0] * 3
    for other in (nearest_bodies(3.0, x, u, count=2), replace(plain, u=None), replace(plain, radius=torch.ones(3))):
        with pytest.raises(InputError, match="parts"):
            Measurement.concatenate([plain, other])
    with pytest.raises(InputError, match="parts"):
        Measurement.concatenate([])


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("kind", ["inverse_optimal", "critical_region"])
@pytest.mark.parametrize("barriers", [[AVOIDANCE], [AVOIDANCE, SpeedBox((9.0, 9.0))]], ids=["no row", "four rows"])
def test_no_body_has_no_slot(compiled: bool, kind: Any, barriers: list[Barrier]) -> None:
    goals = torch.tensor([[2.0, 1.0], [0.0, 3.0], [-1.0, -1.0]], dtype=torch.float64)
    nobody = torch.zeros(3, 0, 2, dtype=torch.float64)
    for noise in (NoiseBound(0.01), NoiseBound(0.01, position=1e-3)):
        alone = Measurement(0.0, STARTS, 0.9 * (goals - STARTS), nobody, nobody[..., 0].bool())
        watching = SetMembershipObserver(GoalTask(0.9), barriers, prior(2), kind, noise, compiled=compiled)
        estimate = watching.update(alone)
        assert estimate.informative.all()
        assert estimate.feasible_set.contains(goals).all()
        assert estimate.kkt.case.tolist() == [0, 0, 0]
        if kind == "inverse_optimal":
            assert (estimate.feasible_set.diameter() < 0.03).all()


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("field", ["x", "u"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_nobody_looks_at_a_robot_that_was_not_observed(compiled: bool, field: str, bad: float) -> None:
    run = samples(GoalTask(0.9), torch.ones(3, 2, dtype=torch.float64), [AVOIDANCE])
    spoilt = getattr(run[3], field).clone()
    spoilt[1, 0] = bad
    broken = replace(run[3], **{field: spoilt}, observed=torch.tensor([True, False, True]))
    whole = replace(run[3], observed=broken.observed)
    mine, other = (
        SetMembershipObserver(GoalTask(0.9), [AVOIDANCE], prior(2), noise=NoiseBound(1e-3), compiled=compiled).update(m)
        for m in (broken, whole)
    )
    assert mine.informative.tolist() == other.informative.tolist() == [True, False, True]
    assert torch.equal(mine.feasible_set.volume(), other.feasible_set.volume())
    with pytest.raises(InputError, match=r"finite .* robot \[1\]"):
        SetMembershipObserver(GoalTask(0.9), [AVOIDANCE], prior(2), noise=NoiseBound(1e-3)).update(
            replace(broken, observed=None)
        )
