"""Robots that change their goals, and robots of another kind: what Psi keeps, and what refutes a team."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.safety_teams import Team, crossing
from torchfsid.errors import InconsistentError
from torchfsid.observers.safety_sets import SETTLED
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement


def test_a_change_of_goal_resets_theta_and_not_psi() -> None:
    for seed in (1, 2, 3):
        before = crossing(seed, gain=4.0, distance=0.3, velocity=2e-3, size=None, steps=25)
        after = crossing(seed + 20, gain=4.0, distance=0.3, velocity=2e-3, size=None, steps=30)
        later = [replace(m, t=m.time + 2.6) for m in after.measurements]
        observer = before.observer(on_inconsistent="reset")
        for m in before.measurements:
            observer.update(m)
            assert before.holds_truth(observer)
        psi = observer.safety.volume()
        for k, m in enumerate(later):
            observer.update(m)
            assert observer.safety.contains(before.psi.expand(3, 2)).all(), (seed, k)
            assert (observer.safety.volume() <= psi * (1 + 1e-12)).all()
            psi = observer.safety.volume()
        resets = [event for event in observer.events if event.reset]
        assert {event.robot for event in resets} == {0, 1, 2}
        assert all(0 <= event.t - 2.6 < 0.35 for event in resets)
        assert observer.feasible_set.contains(after.theta).all()
        assert (observer.status == Status.OK).all()
        assert observer.refutations == []


def test_what_a_robot_had_to_do_is_believed_only_later() -> None:
    """While robots may change goals, the permissive side of Psi moves no sooner than `SETTLED` samples later."""
    team = crossing(1, velocity=2e-3, size=None)
    at_once, later = team.observer(), team.observer(on_inconsistent="reset")
    least = team.observer(on_inconsistent="reset").safety
    direction = torch.tensor([[1.0, 0.0]] * 3, dtype=torch.float64)  # the largest gain: only rule 4 bounds it
    reached = {"at once": [], "later": []}
    for m in team.measurements:
        for name, observer in (("at once", at_once), ("later", later)):
            observer.update(m)
            reached[name].append(bool(observer.safety.support(direction)[0] < least.support(direction)[0]))
    first = {name: found.index(True) for name, found in reached.items()}
    assert first["later"] == first["at once"] + SETTLED + 1  # SETTLED samples lie in between


def with_an_odd_robot(seed: int, odd: int, gain: float) -> Team:
    """Four robots, one of them with another gain."""
    team = crossing(seed, robots=4, velocity=1e-3, steps=1)
    x, measurements = team.run.x[0], []
    usual, other = (CbfQpController(team.task, [CollisionAvoidance(ClassK(g), 0.4)]) for g in (1.5, gain))
    for k in range(25):
        seen = Measurement.of_team(0.1 * k, x)
        u = usual(seen, team.theta).u
        u[odd] = other(seen, team.theta).u[odd]
        measurements.append(Measurement.of_team(0.1 * k, x, u))
        x = x + 0.1 * u
    return replace(team, measurements=measurements)


@pytest.mark.parametrize(("seed", "odd", "gain"), [(1, 2, 4.0), (2, 0, 0.6), (3, 3, 3.0)])
def test_one_odd_robot_is_named_and_all_robots_keep_their_own_sets(seed: int, odd: int, gain: float) -> None:
    team = with_an_odd_robot(seed, odd, gain)
    observer = team.watched()
    assert not observer.is_shared
    (refutation,) = observer.refutations
    assert refutation.robot is None
    assert refutation.rows == () or odd in {robot for _, robot, _ in refutation.rows}
    assert odd in observer.odd()
    assert (observer.status == Status.OK).all()
    observer.look_again(team.measurements)
    psi = team.psi.repeat(4, 1)
    psi[odd] *= gain / 1.5
    assert observer.safety.contains(psi).all()
    assert observer.feasible_set.contains(team.theta).all()
    assert observer.odd() == [odd]


def test_a_refuted_robot_is_named_after_a_second_look() -> None:
    """The declared distances are too large. Some robots' Psi come out empty when all samples are read at once."""
    wrong = {"shared": "robot", "gain": (2.0, 20.0), "safety_distance": (0.5, 0.9)}
    team = crossing(1, velocity=1e-3, size=None, unknown=wrong)
    for first in (1, len(team.measurements)):
        observer = team.observer()
        for m in team.measurements[:first]:
            observer.update(m)
        observer.look_again(team.measurements)
        assert [refutation.robot for refutation in observer.refutations] == [0, 1, 2]
        for refutation in observer.refutations:
            assert refutation.unexplained == (refutation.robot,)
            assert {robot for _, robot, _ in refutation.rows} <= {refutation.robot}
            assert first > 1 or len(refutation.rows) > 0
            assert all(row != refutation.robot for _, _, row in refutation.rows)
        assert (observer.status == Status.INCONSISTENT).all()
        assert {event.robot for event in observer.events} == {0, 1, 2}
    with pytest.raises(InconsistentError):
        team.watched(on_inconsistent="raise")
