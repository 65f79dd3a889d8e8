"""Bodies that are measured at different times: the truth stays within the bounds, and what is unknown is not used."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import islice

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.bag_writer import odometry, pose, write_bag
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.observe import Observation
from torchfsid.config.documents import validate
from torchfsid.config.observe import ObserveConfig
from torchfsid.logs.log import Log
from torchfsid.logs.read import read_log
from torchfsid.logs.resampling import Track, log_of_tracks, seconds
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask

Motion = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
PERIOD = 0.1
ROUND_OFF = 1e-9

seeds = st.integers(0, 2**32).map(np.random.default_rng)
repeatable = settings(deadline=None, derandomize=True, max_examples=60)


def smooth(rng: np.random.Generator) -> Motion:
    """Positions and velocities of a sum of vibrations, down to six samples a period."""
    rate, phase = rng.uniform(0.1, 1 / PERIOD, (3, 2)), rng.uniform(0, 2 * np.pi, (3, 2))
    size = rng.uniform(-1, 1, (3, 2)) / rate

    def at(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = rate * t[:, None, None] + phase
        return (size * np.sin(angle)).sum(axis=1), (size * rate * np.cos(angle)).sum(axis=1)

    return at


def held(rng: np.random.Generator, tick: float) -> Motion:
    """Commands that are held from tick to tick, at other times than those of the samples."""
    ticks = np.concatenate([[0.0], rng.uniform(0, tick) + tick * np.arange(100)])
    commands = rng.normal(size=(len(ticks), 2))
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(commands[:-1] * np.diff(ticks)[:, None], axis=0)])

    def at(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        i = np.searchsorted(ticks, t, side="right") - 1
        return places[i] + (t - ticks[i])[:, None] * commands[i], commands[i]

    return at


def stamps_of(rng: np.random.Generator, jitter: float, count: int = 40) -> np.ndarray:
    return ((np.arange(count) + rng.uniform(0, jitter, count)) * PERIOD * 1e9).astype(np.int64)


def logged(motion: Motion, stamps: np.ndarray, with_velocities: bool = True) -> Log:
    """The motion as sampled at the stamps, beside a body that is measured on a much finer clock."""
    clock = np.linspace(stamps[0], stamps[-1], 400).astype(np.int64)
    x, u = motion(seconds(stamps))
    clockwork = Track("clock", clock, np.zeros((400, 2)), np.zeros((400, 2)))
    return log_of_tracks("test", [clockwork, Track("body", stamps, x, u if with_velocities else None)], None, None)


def excess(values: np.ndarray, truth: np.ndarray, bound: np.ndarray, where: np.ndarray) -> float:
    return float((np.linalg.norm(values - truth, axis=1) - bound)[where].max())


# The bounds.


@repeatable
@given(rng=seeds, jitter=st.sampled_from([0.0, 0.3]))
def test_smooth_motion_stays_within_the_bounds(rng, jitter):
    motion, stamps = smooth(rng), stamps_of(rng, jitter)
    for log in (logged(motion, stamps), logged(motion, stamps, with_velocities=False).differentiated()):
        x, u = motion(log.t)
        assert log.u is not None
        assert log.position_error is not None
        assert log.velocity_error is not None
        seen, known = log.seen[:, 1], log.velocity_known[:, 1]
        assert seen.mean() > 0.9
        assert known.mean() > 0.9
        assert excess(log.x[:, 1], x, log.position_error[:, 1], seen) <= ROUND_OFF
        assert excess(log.u[:, 1], u, log.velocity_error[:, 1], known) <= ROUND_OFF


@repeatable
@given(rng=seeds, tick=st.sampled_from([1.0, 1.3, 3.0]))
def test_held_commands_stay_within_the_bounds(rng, tick):
    """Positions only: at any time the velocity itself is on either side of a jump."""
    motion = held(rng, tick * PERIOD)
    log = logged(motion, stamps_of(rng, 0.0))
    assert log.position_error is not None
    assert excess(log.x[:, 1], motion(log.t)[0], log.position_error[:, 1], log.seen[:, 1]) <= ROUND_OFF


@repeatable
@given(rng=seeds)
def test_differences_of_commands_held_for_long(rng):
    """Three intervals or more from jump to jump: the means on both sides show all of it."""
    motion = held(rng, 3 * PERIOD)
    log = logged(motion, stamps_of(rng, 0.0), with_velocities=False).differentiated()
    x, u = motion(log.t)
    assert log.u is not None
    assert log.position_error is not None
    assert log.velocity_error is not None
    assert excess(log.x[:, 1], x, log.position_error[:, 1], log.seen[:, 1]) <= ROUND_OFF
    assert excess(log.u[:, 1], u, log.velocity_error[:, 1], log.velocity_known[:, 1]) <= ROUND_OFF


def test_the_bounds_are_not_idle():
    """A constant acceleration a: V = a h, so at most a h^2 / 4 and a h / 2, where a h^2 / 8 and 0 are attained."""
    log = logged(
        lambda t: (np.stack([t**2, 0 * t], 1), np.stack([2 * t, 0 * t], 1)), stamps_of(np.random.default_rng(), 0)
    )
    assert log.position_error is not None
    assert log.velocity_error is not None
    assert log.position_error.max() == pytest.approx(2 * PERIOD**2 / 4, rel=1e-2)
    assert log.velocity_error.max() == pytest.approx(2 * PERIOD / 2, rel=1e-2)


@repeatable
@given(rng=seeds)
def test_samples_are_exact(rng):
    motion, stamps = smooth(rng), stamps_of(rng, 0.3)
    first = Track("first", stamps, *motion(seconds(stamps)))
    other = Track(
        "other",
        np.arange(stamps[0], stamps[-1], 70_000_000),
        *([np.zeros((len(range(stamps[0], stamps[-1], 70_000_000)), 2))] * 2),
    )
    log = log_of_tracks("test", [first, other], None, None)
    assert log.u is not None
    assert log.position_error is not None
    assert log.velocity_error is not None
    np.testing.assert_array_equal(log.x[:, 0], first.x)
    np.testing.assert_array_equal(log.u[:, 0], first.u)
    assert not log.position_error[:, 0].any()
    assert not log.velocity_error[:, 0].any()


# What is not known.


def test_gaps_and_ends_are_not_bridged():
    """Two messages lost: the body is lost between its samples, and there only; one lost message is bridged."""
    stamps = np.delete(np.arange(1, 21) * 100_000_000, [5, 11, 12])
    clock = np.arange(0, 45) * 50_000_000
    still = [np.zeros((len(stamps), 2))] * 2
    tracks = [Track("clock", clock, np.zeros((45, 2)), np.zeros((45, 2))), Track("body", stamps, *still)]
    log = log_of_tracks("test", tracks, None, None)
    lost = [0.0, 0.05, *[1.15, 1.2, 1.25, 1.3, 1.35], *[2.05, 2.1, 2.15, 2.2]]
    assert log.lost is not None
    assert log.t[log.lost[:, 1]].tolist() == lost
    observed = [m.observed.tolist() for m in log.measurements(["clock", "body"], ()) if m.observed is not None]
    assert observed == [[not gone, not gone] for gone in log.lost[:, 1]]


@pytest.mark.parametrize("count", [2, 3, 4])
def test_too_few_samples_to_judge_by(count):
    stamps = np.arange(count) * 100_000_000
    still = np.zeros((count, 2))
    log = log_of_tracks(
        "test",
        [Track("a", np.arange(7) * 50_000_000, np.zeros((7, 2)), None), Track("b", stamps, still, still)],
        None,
        None,
    )
    at_samples = [k % 2 == 0 and k < 2 * count for k in range(7)]
    assert log.seen[:, 1].tolist() == ([True] * 7 if count == 4 else at_samples)


def test_numbers_that_overflow():
    stamps = np.arange(8) * 100
    x = np.array([[-1e308, 0], [1e308, 0]] * 4)
    log = log_of_tracks("test", [Track("a", np.arange(8) * 90, x, None), Track("b", stamps, x, None)], None, None)
    for each in (log, log.differentiated()):
        assert each.position_error is not None
        assert np.isfinite(each.x).all()
        assert np.isfinite(each.position_error).all()


def test_the_bounds_reach_the_measurements():
    motion = smooth(np.random.default_rng(0))
    log = logged(motion, stamps_of(np.random.default_rng(1), 0.0))
    assert log.velocity_error is not None
    assert log.position_error is not None
    for modes in (set(), {"previous"}):
        for k, m in enumerate(islice(log.measurements(["body"], modes), 20)):
            assert m.position_error is not None
            assert m.body_velocity_error is not None
            assert m.position_error.tolist() == [log.position_error[k, 1]]
            before = log.velocity_error[max(k - 1, 0)] if modes else log.velocity_error[k]
            assert m.body_velocity_error.tolist() == [np.maximum(log.velocity_error[k], before).tolist()]


# The whole way: a team, recorded at different times, observed.

GOALS = torch.tensor([[2.0, 0.1], [-2.0, 0.0], [0.1, 2.0]], dtype=torch.float64)
START = torch.tensor([[-2.0, 0.0], [2.0, 0.3], [0.0, -2.0]], dtype=torch.float64)


@cache
def crossing() -> Trajectory:
    controller = CbfQpController(GoalTask(0.9), [CollisionAvoidance(ClassK(1.5), 0.5)])
    return simulate(controller, GOALS, START, dt=0.02, steps=200)


def sets_of(config: ObserveConfig, log: Log) -> SetMembershipObserver:
    """What remains after the whole log; no filter, no figures."""
    observation = Observation(DeclaredLog(config, log))
    for measurement in observation.log.measurements(observation.robots, config.neighbour_velocities):
        observation.sets.update(measurement)
    return observation.sets


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("velocity", "period", "diameter"), [("logged", 5, 0.1), ("differentiated", 5, 0.5), ("logged", 12, 0.2)]
)
def test_the_truth_is_inside_the_sets_of_an_asynchronous_bag(tmp_path, velocity, period, diameter):
    """Messages every `period` steps of a controller, each robot's at others. Without the bounds the truth is lost"""
    run = crossing()
    messages = {}
    for j, offset in enumerate([0, 1, 3]):
        stamps = [round(t * 1e9) for t in run.t[offset::period].tolist()]
        x, u = (values[offset::period, j].tolist() for values in (run.x, run.u))
        messages[f"/{j}"] = [*map(odometry, stamps, x, u)] if velocity == "logged" else [*map(pose, stamps, x)]
    config = validate(
        {
            "task": {"kind": "goal", "gain": 0.9},
            "barriers": [{"kind": "avoidance", "safety_distance": 0.5, "class_k": {"gain": 1.5}}],
            "prior": {"lower": [-5, -5], "upper": [5, 5]},
            "noise": {"velocity": 1e-3},
            "velocity": velocity,
            "bag": {"topics": {f"/{j}": f"r{j}" for j in range(3)}},
        },
        ObserveConfig,
        source="config",
    )
    log = read_log(write_bag(tmp_path / "bag", messages), config.bag)
    sets = sets_of(config, log)
    assert not sets.status.any()
    assert sets.feasible_set.contains(GOALS).all()
    assert (sets.feasible_set.diameter() < diameter).all()

    believed = log.differentiated() if velocity == "differentiated" else log
    trusting = config.model_copy(update={"velocity": "logged"})
    without_bounds = sets_of(trusting, replace(believed, position_error=None, velocity_error=None))
    assert not without_bounds.feasible_set.contains(GOALS).all()
