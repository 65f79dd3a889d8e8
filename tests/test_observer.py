"""The set-membership observer: sound on exact data, and loud about data that break the declared model."""

from dataclasses import replace

import pytest
import torch

from torchfsid.errors import InconsistentError, InputError
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import SpeedBox
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet

TASK = GoalTask(0.9)
AVOIDANCE = CollisionAvoidance(ClassK(1.5), safety_distance=0.5)
GOALS = torch.tensor([[2.0, 0.1], [-2.0, 0.0]], dtype=torch.float64)


@pytest.fixture(scope="module")
def crossing() -> Trajectory:
    """Two robots swap places past a pillar."""
    controller = CbfQpController(TASK, [AVOIDANCE])
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3]], dtype=torch.float64)
    return simulate(controller, GOALS, start, dt=0.05, steps=120, obstacles=torch.tensor([[0.2, 1.0]]))


def observer(
    kind: str = "inverse_optimal", avoidance: CollisionAvoidance = AVOIDANCE, **options
) -> SetMembershipObserver:
    prior = FeasibleSet.from_box(torch.full((2, 2), -5.0), torch.full((2, 2), 5.0))
    noise = NoiseBound(1e-6) if kind == "inverse_optimal" else None
    return SetMembershipObserver(TASK, [avoidance], prior, kind=kind, noise=noise, **options)


def with_u(measurement: Measurement, u: list[list[float]]) -> Measurement:
    return replace(measurement, u=torch.tensor(u, dtype=torch.float64))


@pytest.mark.parametrize("kind", ["inverse_optimal", "critical_region"])
def test_truth_inside_at_every_step_and_area_never_grows(crossing: Trajectory, kind: str) -> None:
    watching = observer(kind)
    area = watching.feasible_set.volume()
    active = 0
    for measurement in crossing.measurements():
        estimate = watching.update(measurement)
        assert estimate.feasible_set.contains(GOALS).all()
        assert (estimate.feasible_set.volume() <= area * (1 + 1e-12)).all()
        area = estimate.feasible_set.volume()
        active += int(estimate.kkt.n_active.sum())
    assert active > 0
    assert (area < 1.0).all()
    assert watching.status.tolist() == [Status.OK, Status.OK]
    assert watching.events == []


def test_inverse_optimal_set_is_inside_the_critical_region(crossing: Trajectory) -> None:
    """On exact data, with a small bound, step by step over a whole run."""
    fine, coarse = observer("inverse_optimal"), observer("critical_region", active_tolerance=1e-6)
    for measurement in crossing.measurements():
        inner, outer = fine.update(measurement).feasible_set, coarse.update(measurement).feasible_set
        rows = outer.facets().halfspaces
        corners = inner.vertices()
        excess = (rows.A.unsqueeze(1) @ corners.unsqueeze(-1)).squeeze(-1) - rows.b.unsqueeze(1)
        assert excess.max() < 1e-5


def test_the_batch_equals_one_observer_per_robot(crossing: Trajectory) -> None:
    together = observer()
    alone = [
        SetMembershipObserver(
            TASK,
            [AVOIDANCE],
            FeasibleSet.from_box(torch.full((1, 2), -5.0), torch.full((1, 2), 5.0)),
            noise=NoiseBound(1e-6),
        )
        for _ in range(2)
    ]
    for k in range(40):
        both = together.update(crossing.measurement(k)).feasible_set.volume()
        for i in range(2):
            single = Measurement.of_team(float(crossing.t[k]), crossing.x[k], crossing.u[k], robots=[i])
            assert alone[i].update(single).feasible_set.volume().item() == pytest.approx(both[i].item(), rel=1e-9)


def test_a_contradiction_is_reported_and_the_set_is_kept(crossing: Trajectory) -> None:
    """Robot 0 is suddenly measured fleeing its goal: its set stays as it was, the other robot's goes on shrinking."""
    watching = observer()
    for k in range(10):
        before = watching.update(crossing.measurement(k)).feasible_set
    honest = crossing.measurement(10)
    assert honest.u is not None
    t = honest.t
    estimate = watching.update(with_u(honest, [[-1.0, 0.2], honest.u[1].tolist()]))
    assert watching.status.tolist() == [Status.INCONSISTENT, Status.OK]
    assert estimate.informative.tolist() == [False, True]
    corners = int(before.body.count[0])  # the slots behind them are padding
    assert estimate.feasible_set.body.count[0] == corners
    assert torch.equal(estimate.feasible_set.vertices()[0, :corners], before.vertices()[0, :corners])
    (event,) = watching.events
    assert (event.robot, event.t, event.status) == (0, t, Status.INCONSISTENT)
    assert t in {time for time, _ in event.rows}
    assert len({time for time, _ in event.rows}) > 1
    after = watching.update(crossing.measurement(11))
    assert after.status[0] == Status.INCONSISTENT
    assert after.feasible_set.contains(GOALS).all()


def test_a_contradiction_raised_says_which_robot_when_and_by_which_rows(crossing: Trajectory) -> None:
    """The second robot jumps to the opposite control; the exception comes again as often as the contradiction does."""
    watching = observer(on_inconsistent="raise")
    first, second, *_ = crossing.measurements()
    watching.update(first)
    turned = with_u(second, [second.u[0].tolist(), (-second.u[1]).tolist()])
    for _ in range(2):
        with pytest.raises(InconsistentError, match=r"robot 1 at t = 0\.05 s: no parameter .*\(0\.05, ") as found:
            watching.update(turned)
        assert (found.value.robot, found.value.t) == (1, 0.05)
        assert found.value.rows == watching.events[-1].rows
    assert watching.status.tolist() == [Status.OK, Status.INCONSISTENT]
    assert len(watching.events) == 1


def test_a_broken_hard_row_raises_the_alarm_and_is_not_used(crossing: Trajectory) -> None:
    near = next(k for k in range(len(crossing.t)) if bool(crossing.active[k, 0].any()))
    measurement = crossing.measurement(near)
    row = int(crossing.active[near, 0].long().argmax())
    into = measurement.bodies[0, row] - measurement.x[0]
    forbidden = (2.0 * into / into.norm()).tolist()
    assert measurement.u is not None
    hard = observer()
    estimate = hard.update(with_u(measurement, [forbidden, measurement.u[1].tolist()]))
    assert hard.status.tolist() == [Status.ALARM, Status.OK]
    assert hard.events[0].rows == ((measurement.t, row),)
    assert estimate.feasible_set.volume()[0] == 100.0
    soft = observer(avoidance=replace(AVOIDANCE, soft=True))
    soft.update(with_u(measurement, [forbidden, measurement.u[1].tolist()]))
    assert soft.status.tolist() == [Status.OK, Status.OK]


def test_samples_without_information_are_skipped_and_counted(crossing: Trajectory) -> None:
    first = crossing.measurement(0)
    unseen = replace(first, observed=torch.tensor([False, True]))
    watching = observer()
    estimate = watching.update(unseen)
    assert estimate.informative.tolist() == [False, True]
    assert watching.skipped.tolist() == [1, 0]
    assert estimate.feasible_set.volume()[0] == 100.0

    # A failed controller: too close to the pillar already, and commanding exactly zero.
    x = torch.tensor([[0.0, 0.9], [4.0, 4.0], [0.2, 1.0]], dtype=torch.float64)
    stuck = Measurement.of_team(0.0, x, torch.zeros_like(x), robots=[0, 1])
    watching = observer()
    assert watching.update(stuck).informative.tolist() == [False, True]
    assert watching.status.tolist() == [Status.OK, Status.OK]

    # A neighbour whose velocity is unknown: the row could be the active one.
    previous = torch.full_like(x, float("nan"))
    unknown = Measurement.of_team(0.0, x, torch.ones_like(x), robots=[0, 1], previous_u=previous)
    watching = observer(avoidance=replace(AVOIDANCE, neighbour_velocity="previous"))
    assert watching.update(unknown).informative.tolist() == [False, False]


def test_constraints_that_stack() -> None:
    """A speed limit that is active says: the nominal control is beyond it."""
    x = torch.zeros(1, 2, dtype=torch.float64)
    prior = FeasibleSet.from_box(torch.full((1, 2), -5.0), torch.full((1, 2), 5.0))
    watching = SetMembershipObserver(TASK, [AVOIDANCE, SpeedBox((0.5, 0.5))], prior, noise=NoiseBound(1e-6))
    limited = Measurement.of_team(0.0, x, torch.tensor([[0.5, 0.09]], dtype=torch.float64))
    theta = watching.update(limited).feasible_set
    assert theta.contains(torch.tensor([[3.0, 0.1]])).all()
    assert not theta.contains(torch.tensor([[0.4, 0.1]])).any()
    assert not theta.contains(torch.tensor([[3.0, 0.2]])).any()


def test_wrong_use_is_refused(crossing: Trajectory) -> None:
    prior = FeasibleSet.from_box(torch.zeros(2, 1), torch.ones(2, 1))
    with pytest.raises(InputError, match="2 parameters"):
        SetMembershipObserver(TASK, [AVOIDANCE], prior, noise=NoiseBound(0.1))
    with pytest.raises(InputError, match="NoiseBound"):
        SetMembershipObserver(TASK, [AVOIDANCE], FeasibleSet.from_box(torch.zeros(2, 2), torch.ones(2, 2)))
    with pytest.raises(InputError, match="finite"):
        observer().update(with_u(crossing.measurement(0), [[float("nan"), 0.0], [0.0, 0.0]]))
