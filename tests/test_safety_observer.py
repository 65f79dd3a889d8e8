"""The observer of safety parameters: the truth of theta and psi is kept."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import pytest
import torch

from tests.safety_teams import Team, crossing
from torchfsid.errors import InputError
from torchfsid.identification.evidence import ObservationModel
from torchfsid.identification.safety_parameters import Possible
from torchfsid.observers.safety import SafetyObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import Arena, SpeedPolygon
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.neighbours import nearest_bodies
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask, Saturation, UnknownGainGoalTask
from torchfsid.robots.unknown_avoidance import UnknownAvoidance
from torchfsid.sets.feasible_set import FeasibleSet

PILLAR = torch.tensor([[0.3, 0.1]], dtype=torch.float64)
UNEQUAL = torch.tensor([0.1, 0.2, 0.15, 0.25], dtype=torch.float64)
EUCLIDEAN, CUBIC, JOINT = {"distance": "euclidean"}, {"power": 3.0}, {"neighbour_velocity": "current"}
FAN_EXCESS = 1 / math.cos(math.pi / 16) - 1
"""By this fraction of the ball's radius the outer polygons of two cones may fail to be nested as the cones are."""

CASES = {
    "the paper's rows": {},
    "exact": {"velocity": 1e-8, "size": 0.0},
    "euclidean and cubic": {"shape": EUCLIDEAN | CUBIC, "gain": 6.0, "velocity": 1e-2},
    "one joint programme": {"shape": JOINT | CUBIC, "gain": 6.0, "velocity": 5e-3},
    "previous velocities": {"shape": {"neighbour_velocity": "previous"}, "velocity": 5e-3, "size": None},
    "square root": {"shape": {"power": 0.5}, "obstacles": PILLAR},
    "unequal radii and a margin": {"radius": UNEQUAL, "distance": 0.1, "obstacles": PILLAR,
                                   "unknown": {"reference": 0.3}},
    "unequal radii, cubic": {"radius": UNEQUAL[:3], "distance": -0.05, "shape": CUBIC, "gain": 8.0,
                             "unknown": {"reference": 0.35, "shared": "robot"}},
    "a euclidean margin": {"radius": UNEQUAL[:3], "distance": 0.1, "shape": EUCLIDEAN},
    "position errors": {"position": 0.01, "shape": JOINT},
    "position errors, a euclidean margin": {"position": 0.01, "radius": UNEQUAL, "distance": 0.1, "obstacles": PILLAR,
                                            "shape": EUCLIDEAN},
    "position errors, unequal radii": {"position": 0.01, "radius": UNEQUAL[:3], "distance": 0.1, "velocity": 1e-2,
                                       "unknown": {"reference": 0.3}},
    "soft rows": {"unknown": {"soft": True}},
    "walls and speed limits": {"others": [SpeedPolygon(8, 0.9), Arena((-1.6, -1.6), (1.6, 1.6), ClassK(1.0))]},
    "clipped by norm": {"task": GoalTask(0.9, saturation=Saturation("norm", (0.7, 0.7), dead_speed=0.05))},
    "clipped by axis": {"task": GoalTask(0.9, saturation=Saturation("box", (0.6, 0.5)))},
    "three parameters": {"task": UnknownGainGoalTask(), "robots": 2, "steps": 6, "velocity": 1e-2},
    "four robots, each its own": {"robots": 4, "unknown": {"shared": "robot"}},
    "a known gain": {"unknown": {"gain": (1.5, 1.5)}, "velocity": 5e-3},
    "a known distance": {"unknown": {"safety_distance": (0.4, 0.4)}, "velocity": 5e-3},
    "both are known": {"unknown": {"gain": (1.5, 1.5), "safety_distance": (0.4, 0.4)}},
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_truth_stays_inside_and_sets_never_grow(name: str) -> None:
    options = {"steps": 20, **CASES[name]}
    for seed in (1, 2):
        team = crossing(seed, **options)
        observer = team.observer()
        psi, theta = observer.safety.volume(), observer.feasible_set.volume()
        for k in range(len(team.measurements) + 1):
            if k < len(team.measurements):
                observer.update(team.measurements[k])
            else:
                observer.look_again(team.measurements)
            assert team.holds_truth(observer), (seed, k)
            assert (observer.safety.volume() <= psi * (1 + 1e-12)).all(), (seed, k)
            assert (observer.feasible_set.volume() <= theta * (1 + 1e-12)).all(), (seed, k)
            psi, theta = observer.safety.volume(), observer.feasible_set.volume()
        assert observer.refutations == []
        assert observer.events == []
        assert (observer.status == Status.OK).all()


@pytest.mark.parametrize("options", [{}, {"shape": CUBIC, "gain": 6.0}, {"shape": EUCLIDEAN}], ids=str)
def test_both_parameters_are_found(options: dict) -> None:
    """Errors a tenth of their bound, as in UNKNOWN.md: both ends come from data, within a few per cent."""
    team = crossing(1, velocity=5e-3, size=0.1, **options)
    observer = team.watched()
    observer.look_again(team.measurements)
    gain, distance = (ends[0] for ends in team.unknown.intervals(observer.safety))
    assert (gain / team.true_gain - 1).abs().max() < (0.2 if options.get("gain") else 0.02)
    assert (distance / team.true_distance - 1).abs().max() < 0.05
    assert all(ends.all() for ends in team.unknown.bounded_by_data(observer.safety))


def test_rows_that_are_never_active_say_nothing_of_the_largest_gain() -> None:
    """Far apart, robots keep their rows whatever the gain above some bound, and nothing touches the distance alone."""
    team = crossing(1, gain=60.0, distance=0.1, steps=6, velocity=1e-4)
    assert not team.run.active.any()
    observer = team.watched()
    observer.look_again(team.measurements)
    gain, distance = team.unknown.bounded_by_data(observer.safety)
    assert not gain[:, 1].any()
    assert not distance.any()
    assert team.holds_truth(observer)


def test_rows_that_are_violated_are_soft_or_refute_the_truth() -> None:
    """A controller with slack variables gives way by a fifth of what its row would take from the nominal control."""
    team = crossing(1, robots=2, velocity=1e-3, size=0.0)
    given_way = [
        replace(m, u=m.u + 0.2 * (team.run.nominal[k] - m.u))
        for k, m in enumerate(team.measurements)
        if m.u is not None
    ]
    assert team.run.active.any()
    soft = replace(team, unknown=replace(team.unknown, soft=True), measurements=given_way).watched()
    soft.look_again(given_way)
    assert team.holds_truth(soft)
    assert soft.refutations == []
    assert (soft.safety.volume() < 0.9 * team.unknown.prior(2).volume()).all()
    assert not team.holds_truth(replace(team, measurements=given_way).watched())


def blocks(team: Team) -> Possible:
    """All that follows from all samples read at once."""
    robots, model = len(team.theta), team.observer().model
    everything = Possible(team.observer().prior, team.unknown.prior(1), torch.zeros(robots).long())
    together = Measurement.concatenate(team.measurements)
    read = model.read(everything, together)
    return Possible(read.theta, read.cuts.apply(everything.psi, everything.owner, 0.0), everything.owner)


@pytest.mark.parametrize("options", [{}, {"shape": JOINT | CUBIC, "gain": 6.0, "position": 5e-3}], ids=str)
def test_a_block_of_samples_holds_what_single_samples_leave(options: dict) -> None:
    """Single samples are read with ever smaller sets. No facets are merged, which would blur the comparison."""
    team = crossing(3, velocity=5e-3, size=None, **options)
    one_by_one, together = team.watched(facets=1000), blocks(team)
    psi = together.psi.facets().halfspaces
    assert (one_by_one.safety.vertices()[0] @ psi.A[0].T <= psi.b[0] + 1e-9).all()
    theta = together.theta.facets().halfspaces
    room = (float(team.noise.velocity) + 0.9 * team.noise.position) / 0.9  # the ball and the drift, as lengths of theta
    corners = one_by_one.feasible_set.vertices()
    over = corners @ theta.A.mT - theta.b.unsqueeze(1)
    assert (over <= FAN_EXCESS * room * theta.A.norm(dim=-1).unsqueeze(1) + 1e-9).all()
    assert together.theta.contains(team.theta).all()
    assert together.psi.contains(team.psi.unsqueeze(0)).all()
    assert together.psi.volume() < 0.5 * team.unknown.prior(1).volume()


@pytest.mark.parametrize("options", [{}, {"shape": JOINT | CUBIC, "gain": 6.0, "position": 5e-3}], ids=str)
def test_compiled_code_and_torch_agree(options: dict) -> None:
    team = crossing(4, velocity=5e-3, size=None, **options)
    compiled, in_torch = team.watched(), team.watched(compiled=False)
    torch.testing.assert_close(compiled.safety.volume(), in_torch.safety.volume(), rtol=1e-7, atol=0)
    torch.testing.assert_close(compiled.feasible_set.volume(), in_torch.feasible_set.volume(), rtol=1e-7, atol=0)


def test_the_order_of_the_robots_does_not_matter() -> None:
    team = crossing(5, robots=4, velocity=5e-3, size=None)
    order = torch.tensor([2, 0, 3, 1])
    turned = replace(team, theta=team.theta[order], measurements=[m.select(order) for m in team.measurements])
    for shared in ("team", "robot"):
        watching, other = (
            replace(each, unknown=replace(team.unknown, shared=shared)).watched() for each in (team, turned)
        )
        watching.look_again(team.measurements)
        other.look_again(turned.measurements)
        for ours, theirs in ((watching.safety, other.safety), (watching.feasible_set, other.feasible_set)):
            torch.testing.assert_close(ours.select(order).volume(), theirs.volume(), rtol=1e-6, atol=0)


@pytest.mark.parametrize("options", [{}, {"shape": CUBIC, "gain": 6.0}, {"shape": EUCLIDEAN | JOINT}], ids=str)
def test_psi_is_differentiable_in_what_was_logged(options: dict) -> None:
    team = crossing(6, robots=2, velocity=5e-3, size=0.1, **options)
    logged = {
        "x": torch.stack([m.bodies[0] for m in team.measurements]).requires_grad_(),
        "u": torch.stack([m.u for m in team.measurements if m.u is not None]).requires_grad_(),
    }

    def reach(logged: dict[str, torch.Tensor]) -> torch.Tensor:
        observer = team.observer()
        for m, x, u in zip(team.measurements, logged["x"], logged["u"], strict=True):
            observer.update(Measurement.of_team(m.time, x, u))
        directions = torch.tensor([[1.0, 0.3], [-1.0, 0.2]], dtype=torch.float64)
        return observer.safety.support(directions).sum()

    slopes = torch.autograd.grad(reach(logged), list(logged.values()))
    generator = torch.Generator().manual_seed(0)
    for name, slope in zip(logged, slopes, strict=True):
        assert slope.abs().max() > 0
        towards = torch.randn(slope.shape, generator=generator, dtype=torch.float64)
        with torch.no_grad():
            up, down = (float(reach({**logged, name: logged[name] + step * towards})) for step in (1e-6, -1e-6))
        assert float((slope * towards).sum()) == pytest.approx((up - down) / 2e-6, rel=1e-4)


def test_bodies_with_gaps() -> None:
    """A robot that is far from all others is not measured for a while. Nothing is lost, and gradients stay finite."""
    team = crossing(7, robots=4, shape=JOINT, gain=4.0, distance=0.2, velocity=1e-3, size=None)
    observer, u, gaps = team.observer(), [], 0
    seen = torch.tensor([True, False, True, True])
    for k, m in enumerate(team.measurements):
        assert m.u is not None
        u.append(m.u.clone().requires_grad_())
        changed = {"u": u[k]}
        if k % 3 == 1 and not team.run.active[k, 1].any() and not team.run.active[k, :, 1].any():
            gaps += 1
            names = ["x", "bodies", "body_velocities"]
            changed |= {name: torch.where(seen[:, None], getattr(m, name), torch.nan) for name in names}
            changed |= {"u": torch.where(seen[:, None], u[k], torch.nan)}
            changed |= {"observed": seen, "present": m.present & seen}
        observer.update(replace(m, **changed))
        assert team.holds_truth(observer)
    assert gaps > 2
    assert observer.skipped.tolist() == [0, gaps, 0, 0]
    reach = observer.safety.support(torch.ones(4, 2, dtype=torch.float64)).sum()
    slopes = torch.stack(torch.autograd.grad(reach, u, allow_unused=True, materialize_grads=True))
    assert slopes.isfinite().all()
    assert slopes.abs().sum() > 0


def test_nearest_bodies_without_a_slot() -> None:
    """Three slots for five neighbours: samples in which a fourth could matter are not used."""
    team = crossing(8, robots=6, velocity=1e-3, size=None, gain=6.0, distance=0.2)
    observer, measurements = team.observer(), []
    for m in team.measurements:
        measurements.append(nearest_bodies(m.time, m.x, m.u, count=3))
        observer.update(measurements[-1])
        assert team.holds_truth(observer)
    assert (observer.skipped > 0).all()
    assert (observer.skipped < len(measurements)).all()
    observer.look_again(measurements)
    assert team.holds_truth(observer)
    assert (observer.safety.volume() < 0.9 * team.unknown.prior(6).volume()).all()


def test_zeros_of_a_controller_that_may_have_failed_say_nothing() -> None:
    """Robot 0 stands too near to two pillars: its programme has no solution. Robot 1 stands at its goal."""
    pillars = torch.tensor([[0.3, 0.0], [-0.3, 0.0]], dtype=torch.float64)
    team = crossing(9, robots=2, steps=2, velocity=1e-3)
    start = torch.tensor([[0.0, 0.0], [3.0, 3.0]], dtype=torch.float64)
    theta = torch.tensor([[0.0, 2.0], [3.0, 3.0]], dtype=torch.float64)
    controller = CbfQpController(team.task, [CollisionAvoidance(ClassK(1.5), 0.4)])
    run = simulate(controller, theta, start, dt=0.1, steps=3, obstacles=pillars)
    assert not run.feasible[:, 0].any()
    assert (run.u == 0).all()
    team = replace(team, theta=theta, run=run, measurements=list(run.measurements()))
    observer = team.watched()
    assert team.holds_truth(observer)
    assert observer.skipped.tolist() == [4, 0]
    possible = replace(team, unknown=replace(team.unknown, safety_distance=(0.1, 0.25))).watched()
    assert possible.skipped.tolist() == [0, 0]  # no psi in Psi makes robot 0 fail


def test_a_copy_by_pickle_goes_on_alike() -> None:
    for options in ({}, {"task": UnknownGainGoalTask(), "robots": 2, "steps": 7}):
        team = crossing(2, velocity=1e-2, size=None, **options)
        observer = team.observer(on_inconsistent="reset")
        for k, m in enumerate(team.measurements):
            if k == 5:
                observer, other = pickle.loads(pickle.dumps(observer)), observer
            observer.update(m)
            if k >= 5:
                other.update(m)
        assert torch.equal(observer.safety.vertices(), other.safety.vertices())
        assert torch.equal(observer.feasible_set.vertices(), other.feasible_set.vertices())


def test_a_log_in_float32() -> None:
    """Its rounding is covered by bounds of 1e-6; all that is computed is float64."""
    team = crossing(2, velocity=1e-4, position=1e-6, size=0.0, shape=JOINT)
    observer, measurements = team.observer(), []
    for m in team.measurements:
        assert m.u is not None
        single = Measurement.of_team(m.time, m.x.float(), m.u.float())
        fields = ("x", "u", "bodies", "body_velocities")
        measurements.append(replace(single, **{name: getattr(single, name).float() for name in fields}))
        observer.update(measurements[-1])
    observer.look_again(measurements)
    assert team.holds_truth(observer)
    assert observer.safety.vertices().dtype == torch.float64
    assert observer.safety.volume()[0] < 0.01 * team.unknown.prior(1).volume()[0]


@pytest.mark.usefixtures("unchecked")
def test_what_is_refused() -> None:
    team = crossing(1, steps=1)
    prior = team.observer().prior
    with pytest.raises(InputError, match="exactly one UnknownAvoidance"):
        SafetyObserver(team.task, [team.unknown, team.unknown], prior, team.noise)
    with pytest.raises(InputError, match="exactly one UnknownAvoidance"):
        SafetyObserver(team.task, [CollisionAvoidance(ClassK(1.0), 0.4)], prior, team.noise)
    with pytest.raises(InputError, match="SafetyObserver"):
        ObservationModel(team.task, [team.unknown], noise=team.noise)  # type: ignore[list-item]
    with pytest.raises(InputError, match="radii"):
        replace(team, unknown=UnknownAvoidance((0.1, 1.0), margin=(0.0, 0.1), distance="euclidean")).watched()


def test_each_robot_has_a_bound_of_its_own() -> None:
    """Robots that share nothing are read, and read again, as if each were alone."""
    team, bounds = crossing(3, velocity=5e-3, unknown={"shared": "robot"}), torch.tensor([0.02, 0.005, 0.01]).double()
    several = replace(team, noise=NoiseBound(bounds)).watched()
    several.look_again(team.measurements)
    for robot in range(3):
        one = torch.tensor([robot])
        half = torch.full((1, 2), 6.0, dtype=torch.float64)
        alone = SafetyObserver(
            team.task, [team.unknown], FeasibleSet.from_box(-half, half), NoiseBound(float(bounds[robot]))
        )
        for sample in team.measurements:
            alone.update(sample.select(one))
        alone.look_again([sample.select(one) for sample in team.measurements])
        for found, expected in ((several.safety, alone.safety), (several.feasible_set, alone.feasible_set)):
            torch.testing.assert_close(found.volume()[one], expected.volume(), rtol=1e-9, atol=0)
