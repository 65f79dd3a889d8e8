"""Barriers of somebody else's: what a barrier does not say of itself is not taken for granted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

import torchfsid as fsid
from torchfsid.halfspaces import Halfspaces
from torchfsid.robots.barriers import Barrier, is_joint
from torchfsid.robots.bounds import ErrorBounds, RowErrors

AVOIDANCE = fsid.CollisionAvoidance(fsid.ClassK(1.5), safety_distance=0.5)
TASK, NOISE = fsid.GoalTask(1.0), fsid.NoiseBound(1e-3)
GOAL = torch.tensor([[3.0, 0.3]], dtype=torch.float64)
AMONG = torch.tensor([[0.0, 0.0], [-0.60, 0.0], [0.65, 0.10]], dtype=torch.float64)
PRIOR = fsid.FeasibleSet.from_box(torch.full((1, 2), -5.0), torch.full((1, 2), 5.0))


@dataclass(frozen=True)
class Foreign:
    """The rows of `AVOIDANCE`, and nothing but what a barrier has to have."""

    soft: bool = False

    def __call__(self, measurement: fsid.Measurement) -> Halfspaces:
        return AVOIDANCE(measurement)

    def errors(self, measurement: fsid.Measurement, bounds: ErrorBounds) -> RowErrors:
        return AVOIDANCE.errors(measurement, bounds)

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return AVOIDANCE.labels(bodies)


def as_functions(slots: int, **declared) -> fsid.AffineBarrier:
    """The rows of `AVOIDANCE` as functions of the measurement."""
    names = tuple(str(j) for j in range(slots))
    return fsid.AffineBarrier(lambda m: AVOIDANCE(m).A, lambda m: AVOIDANCE(m).b, names, **declared)


def measured(x: Tensor, count: int) -> fsid.Measurement:
    """The first body on its way to the goal, among its nearest bodies."""
    among_all = fsid.Measurement.of_team(0.0, x, robots=[0])
    u = torch.zeros_like(x)
    u[0] = fsid.CbfQpController(TASK, [AVOIDANCE])(among_all, GOAL).u[0]
    return fsid.nearest_bodies(0.0, x, u, count=count, robots=[0])


def used(barriers: list[Barrier], measurement: fsid.Measurement, noise: fsid.NoiseBound = NOISE) -> bool:
    """Does the sample say something? If so, it keeps the truth."""
    watching = fsid.SetMembershipObserver(TASK, barriers, PRIOR, noise=noise)
    estimate = watching.update(measurement)
    assert estimate.feasible_set.contains(GOAL).all()
    return bool(estimate.informative)


BARRIERS = {"avoidance": AVOIDANCE, "functions": as_functions(1), "foreign": Foreign()}


@pytest.mark.parametrize("name", BARRIERS)
def test_a_body_left_out_may_be_the_active_one(name: str) -> None:
    """The body behind has the slot, the one ahead holds the robot up."""
    assert not used([BARRIERS[name]], measured(AMONG, 1))


def test_what_is_not_declared_is_not_proven() -> None:
    """A body is left out that is far away: only who can tell so uses the sample."""
    far = measured(torch.tensor([[0.0, 0.0], [-0.60, 0.0], [40.0, 9.0]], dtype=torch.float64), 1)
    assert used([AVOIDANCE], far)
    assert not used([as_functions(1)], far)
    assert not used([Foreign()], far)
    assert not used([AVOIDANCE, Foreign()], far)
    assert used([as_functions(1, left_out=AVOIDANCE.slack_left_out)], far)
    assert not used([as_functions(1, left_out=lambda m: m.x[..., 0] * math.nan)], far)
    assert not used([as_functions(1, left_out=AVOIDANCE.slack_left_out)], measured(AMONG, 1))


@pytest.mark.parametrize("name", BARRIERS)
def test_nobody_is_left_out_of_enough_slots(name: str) -> None:
    barriers = {**BARRIERS, "functions": as_functions(3)}
    assert used([barriers[name]], measured(AMONG, 3))


def test_rows_that_look_at_no_body() -> None:
    """Constant rows say so themselves; functions are told to."""
    identity, limit = torch.eye(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    constant = fsid.AffineBarrier(identity, 9 * limit, ("x", "y"))
    function = fsid.AffineBarrier(lambda m: identity, lambda m: 9 * limit, ("x", "y"))
    declared = fsid.AffineBarrier(lambda m: identity, lambda m: 9 * limit, ("x", "y"), depends_on_bodies=False)
    far = measured(torch.tensor([[0.0, 0.0], [-0.60, 0.0], [40.0, 9.0]], dtype=torch.float64), 1)
    assert used([AVOIDANCE, constant], far)
    assert used([AVOIDANCE, declared], far)
    assert not used([AVOIDANCE, function], far)
    assert used([constant], far, fsid.NoiseBound(1e-3, position=0.1))


def test_a_team_at_rest_may_have_been_stopped_by_a_joint_controller() -> None:
    """Nobody moves. One who has arrived says where; not if one QP may have stopped them all."""
    x = torch.tensor([[0.0, 0.0], [4.0, 4.0]], dtype=torch.float64)
    at_rest = fsid.Measurement.of_team(0.0, x, torch.zeros_like(x), robots=[0])

    def says(barrier: Barrier) -> bool:
        watching = fsid.SetMembershipObserver(TASK, [barrier], PRIOR, noise=NOISE)
        return bool(watching.update(at_rest).informative)

    assert says(AVOIDANCE)
    assert not says(Foreign())
    assert not says(as_functions(2))
    assert says(as_functions(2, neighbour_velocity="none"))
    assert not is_joint([Foreign(), as_functions(2)])  # a controller does what it was told to


class Silent:
    """Rows, and nothing else."""

    soft = False

    def __call__(self, measurement: fsid.Measurement) -> Halfspaces:
        return AVOIDANCE(measurement)


@pytest.mark.usefixtures("unchecked")
def test_rows_that_may_be_off_in_any_way_say_nothing() -> None:
    """Positions have errors, and the barrier does not say what these come to."""
    measurement = measured(AMONG, 3)
    exact, blurred = (
        fsid.SetMembershipObserver(TASK, [Silent()], PRIOR, noise=noise).update(measurement)  # type: ignore[list-item]
        for noise in (NOISE, fsid.NoiseBound(1e-3, position=0.01))
    )
    assert exact.informative.all()
    assert not blurred.informative.any()
    assert blurred.feasible_set.contains(GOAL).all()


@pytest.mark.parametrize("angle", [math.pi, math.nan, 0.1])
@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("kind", ["inverse_optimal", "critical_region"])
def test_a_row_that_vanished_among_errors_may_point_anywhere(angle: float, compiled: bool, kind: str) -> None:
    """0.u <= b where errors may have turned the row. Padding is a zero row without errors."""

    def observed(angle: float, slack: float) -> bool:
        told = RowErrors(torch.tensor([[angle]]).double(), torch.tensor([[slack]]).double())
        row = fsid.AffineBarrier(torch.zeros(1, 2), torch.tensor([0.05]), ("row",), row_errors=lambda *_: told)
        noise = fsid.NoiseBound(1e-3, position=0.1)
        watching = fsid.SetMembershipObserver(TASK, [row], PRIOR, kind, noise, compiled=compiled)  # type: ignore[arg-type]
        u = torch.tensor([[0.4, 0.0]], dtype=torch.float64)
        return bool(watching.update(fsid.Measurement.of_team(0.0, torch.zeros(1, 2), u)).informative)

    assert not observed(angle, 0.1)
    assert not observed(angle, math.nan)
    assert observed(angle, 0.01)  # provably inactive
    assert observed(0.0, 0.1)
