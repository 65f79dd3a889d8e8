"""Fleets in one batch: as one observer for each robot, in bounded memory; and the benchmarks' own workload is right."""

import itertools

import numpy as np
import pytest
import torch

from benchmarks import fleet, geometry, observer, scenario
from tests.problems import exact_area, exact_box, exact_intersection, solve_qp
from torchfsid.robots.avoidance import CollisionAvoidance
from torchfsid.sets.feasible_set import MAX_FACETS


@pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "torch"])
def test_the_fleet_is_as_one_observer_for_each_robot(compiled: bool) -> None:
    """Bit for bit where it is compiled: no sum is taken across robots."""
    team = scenario.Fleet(16, noisy=True)
    together = scenario.observer(team.prior(), compiled)
    alone = [scenario.observer(team.prior().select(torch.tensor([i])), compiled) for i in range(4)]
    for t, x, u in itertools.islice(team, 8):
        both = together.update(scenario.measured(t, x, u))
        for i, one in enumerate(alone):
            single = one.update(scenario.measured(t, x, u, range(i, i + 1)))
            assert single.informative[0] == both.informative[i]
            mine, other = single.feasible_set.volume()[0], both.feasible_set.volume()[i]
            torch.testing.assert_close(mine, other, rtol=1e-13 if compiled else 1e-9, atol=0.0)
    assert together.feasible_set.contains(team.goals).all()


def test_memory_is_that_of_the_facets() -> None:
    """150 noisy updates: slots stay within the cap, and what an observer keeps does not grow with the steps."""
    team = scenario.Fleet(12, noisy=True)
    watching = scenario.observer(team.prior(), True)
    sizes = []
    for t, x, u in itertools.islice(team, 150):
        watching.update(scenario.measured(t, x, u))
        sizes.append(sum(field.nbytes for field in watching.feasible_set.body.fields()))
    assert watching.feasible_set.body.slots <= MAX_FACETS + 8
    assert sizes[-1] == sizes[60]
    assert watching.events == []
    assert watching.feasible_set.contains(team.goals).all()


def test_the_fleet_solves_its_qps() -> None:
    """Controls without measurement errors against daqp."""
    t, x, u = next(iter(scenario.Fleet(40)))
    measurement = scenario.measured(t, x, u)
    rows = CollisionAvoidance(scenario.BARRIER.class_k, scenario.BARRIER.safety_distance)(measurement)
    goals = scenario.Fleet(40).goals
    for i in range(40):
        expected = solve_qp(rows.A[i].numpy(), rows.b[i].numpy(), 0.9 * (goals - x)[i].numpy())
        assert u[i].numpy() == pytest.approx(expected, abs=1e-8)


def test_the_exact_answers_of_the_geometry_benchmark() -> None:
    ring, exact = exact_box((-10, -10), (10, 10)), geometry.Exact()
    for A, b in geometry.workload(3, 12, 1e-6):
        ring = exact_intersection(ring, A[0], b[0])
        exact.update(A[0], b[0])
        assert exact.area() == float(exact_area(ring))
        rows, bounds = exact.rows()
        assert len(rows) == len(ring)
        corners = np.array([[float(z) for z in corner] for corner in ring])
        assert (corners @ rows.T - bounds).max() < 1e-13


def test_benchmarks_judge_us_too() -> None:
    rows = [(A[0], b[0]) for A, b in geometry.workload(2, 6, 1e-8)]
    found = geometry.run_alone(geometry.Ours, rows, geometry.truths(2, 0)[0])
    assert found["failed"] == 0
    assert geometry.judge((1.0, np.eye(3, 2), np.zeros(2)), 2.0, np.array([0.2, 0.2])) == "area"
    assert geometry.judge((0.5, np.eye(3, 2), np.zeros(2)), 0.5, np.array([0.9, 0.9])) == "truth lost"
    assert geometry.run_batch(20, 4, None)["truths_lost"] == 0
    assert fleet.run(20, 3, True, True)["truths_lost"] == 0
    assert set(observer.run(1, 1)) == {"set, torch", "set, compiled", "UKF (filterpy)", "hybrid"}
