"""Fleets in one batch: as one observer for each robot, in bounded memory; and the benchmarks' own workload is right."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks import fleet, geometry, observer, scenario
from tests.problems import exact_area, exact_box, exact_intersection, solve_qp
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.kernels.threads import ITEMS, get_num_threads, set_num_threads
from torchfsid.observers.fleet import FleetObserver
from torchfsid.programmes.layers import ChebyshevCentre, ProjectOnto
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


@pytest.mark.parametrize("threads", [1, 2, 3, 7, 40])
def test_any_number_of_threads_gives_the_same_results(threads: int) -> None:
    team = scenario.Fleet(16, noisy=True)
    moments = [scenario.measured(*moment) for moment in itertools.islice(team, 6)]
    moments[3] = replace(moments[3], u=moments[3].u + 3.0 * (torch.arange(16) % 5 == 2).unsqueeze(-1))  # contradicts
    one, many = scenario.observer(team.prior(), True), scenario.observer(team.prior(), True)
    many = FleetObserver(many, threads)
    assert len(many.parts) == min(threads, 16)
    for measurement in moments:
        single, fleet = one.update(measurement), many.update(measurement)
        assert fleet.t == single.t
        mine, other = fleet.feasible_set.facets(), single.feasible_set.facets()
        used = int(fleet.feasible_set.body.count.max())  # further slots are padding
        for a, b in ((mine.halfspaces.A, other.halfspaces.A), (mine.halfspaces.b, other.halfspaces.b)):
            torch.testing.assert_close(a[:, :used], b[:, :used], rtol=0, atol=0)
        assert torch.equal(mine.source[:, :used], other.source[:, :used])
        for name in ("status", "informative"):
            torch.testing.assert_close(getattr(fleet, name), getattr(single, name), rtol=0, atol=0)
        assert torch.equal(fleet.feasible_set.last_cut, single.feasible_set.last_cut)
    assert many.events == one.events != []
    assert torch.equal(many.skipped, one.skipped)
    assert torch.equal(many.feasible_set.outcome, one.feasible_set.outcome)


def test_a_fleet_has_gradients_as_one_observer() -> None:
    team = scenario.Fleet(6, noisy=True)
    t, x, u = next(iter(team))
    gradients = []
    for threads in (None, 3):
        point = x.clone().requires_grad_()
        watching = scenario.observer(team.prior(), None)
        estimate = (watching if threads is None else FleetObserver(watching, threads)).update(
            scenario.measured(t, point, u)
        )
        gradients.append(torch.autograd.grad(estimate.feasible_set.volume().sum(), point)[0])
        with torch.no_grad():
            assert not estimate.feasible_set.volume().requires_grad
    torch.testing.assert_close(*gradients)


def test_a_fleet_refuses_what_it_cannot_share() -> None:
    team = scenario.Fleet(4)
    watching = scenario.observer(team.prior(), True)
    with pytest.raises(InputError, match="1 or more"):
        FleetObserver(watching, 0)
    moment = scenario.measured(*next(iter(team)))
    with pytest.raises(InputError, match="a batch of 4 robots"):
        FleetObserver(watching, 2).update(moment.select(slice(0, 3)))
    watching.update(moment)
    with pytest.raises(InputError, match="no measurement"):
        FleetObserver(watching)


def test_large_batches_of_layers_do_not_depend_on_threads() -> None:
    """Forward and backward, with and without a metric, on parts of different size."""
    items, before = 2 * ITEMS + 3, get_num_threads()
    of = torch.Generator().manual_seed(1)
    A, y = (torch.randn(items, *shape, 2, generator=of, dtype=torch.float64) for shape in ((5,), ()))
    b, metric = 0.5 + torch.rand(items, 5, generator=of, dtype=torch.float64), torch.tensor([[2.0, 0.3], [0.3, 1.0]])
    answers = []
    try:
        for threads in (1, 2, 3):
            set_num_threads(threads)
            rows = A.clone().requires_grad_()
            found = [ProjectOnto()(Halfspaces(rows, b), y).point, ProjectOnto(metric)(Halfspaces(rows, b), y).point]
            ball = ChebyshevCentre()(Halfspaces(rows, b))
            torch.cat([*found, ball.centre, ball.radius.unsqueeze(-1)], dim=-1).nan_to_num().square().sum().backward()
            answers.append([*(part.detach() for part in (*found, *ball)), rows.grad])
    finally:
        set_num_threads(before)
    for other in answers[1:]:
        for mine, same in zip(other, answers[0], strict=True):
            torch.testing.assert_close(mine, same, rtol=0, atol=0, equal_nan=True)
    with pytest.raises(InputError, match="1 thread or more"):
        set_num_threads(0)


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
