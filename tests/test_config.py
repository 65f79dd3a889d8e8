"""Configuration: what a file means, and that a wrong one is refused with one clear line."""

import copy
import math
import subprocess
import sys

import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfsid.config.barriers import BarrierConfig
from torchfsid.config.documents import Strict, apply_overrides, dump, load, read_yaml, validate
from torchfsid.config.observe import ObserveConfig
from torchfsid.config.tasks import TaskConfig
from torchfsid.errors import ConfigError
from torchfsid.observers.hybrid import HybridObserver
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import Arena, SpeedBox, SpeedPolygon
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.tasks import FormationTask, GoalTask, OrbitTask, PatrolTask, UnknownGainGoalTask, VelocityTask
from torchfsid.tolerances import ACTIVE_TOLERANCE

IRSIM = """
task: {kind: goal, gain: 0.09}
barriers:
- kind: avoidance
  distance: squared
  margin: 0.2
  class_k: {gain: 1.0, power: 1}
  neighbour_velocity: previous
- kind: speed_box
  limit: [0.8, 0.8]
prior:
  lower: [0.2, 0.2]
  upper: [9.8, 9.8]
noise: {velocity: 1.0e-05}
set: inverse_optimal
velocity: logged
"""

ROBOTARIUM = """
task: {kind: goal, gain: 0.11}
barriers:
- kind: avoidance
  distance: squared
  safety_distance: 0.15
  class_k: {gain: 100.0, power: 3}
  neighbour_velocity: current
- {kind: speed_polygon, sides: 8, limit: 0.2}
prior:
  lower: [-0.96, -0.96]
  upper: [0.96, 0.96]
noise: {velocity: 0.02}
set: inverse_optimal
velocity: logged
"""

BODIES = ["0", "1", "wall"]

repeatable = settings(deadline=None, derandomize=True)


class Task(Strict):
    task: TaskConfig


class Barrier(Strict):
    barrier: BarrierConfig


def observe(*overrides: str, text: str = ROBOTARIUM) -> ObserveConfig:
    return validate(apply_overrides(yaml.safe_load(text), overrides), ObserveConfig, "cfg.yaml")


def refusal(call) -> str:
    """The message of the `ConfigError` that the call must end in: one printable line."""
    with pytest.raises(ConfigError) as caught:
        call()
    message = str(caught.value)
    assert message.isprintable(), message
    return message


# What a file means.


def test_the_sample_of_a_joint_qp():
    config = observe(text=ROBOTARIUM)
    assert config.task.build(BODIES) == GoalTask(0.11)
    assert [barrier.build([]) for barrier in config.barriers] == [
        CollisionAvoidance(ClassK(100.0, 3.0), safety_distance=0.15, distance="squared", neighbour_velocity="current"),
        SpeedPolygon(sides=8, limit=0.2),
    ]
    assert (config.prior.lower, config.prior.upper) == ((-0.96, -0.96), (0.96, 0.96))
    assert config.noise.build() == NoiseBound(0.02, 0.02)
    assert (config.set, config.velocity, config.obstacles) == ("inverse_optimal", "logged", ())
    assert config.neighbour_velocities == {"current"}
    config.barriers[0].require_radii(None)


def test_the_sample_with_radii():
    config = observe(text=IRSIM)
    assert [barrier.build([]) for barrier in config.barriers] == [
        CollisionAvoidance(ClassK(1.0, 1.0), margin=0.2, neighbour_velocity="previous"),
        SpeedBox((0.8, 0.8)),
    ]
    assert config.noise.build() == NoiseBound(1e-5)
    assert config.neighbour_velocities == {"previous"}
    config.barriers[0].require_radii([0.2, 0.2])
    assert "a margin needs the radii" in refusal(lambda: config.barriers[0].require_radii(None))
    touching = observe("barriers.0.margin=0", text=IRSIM).barriers[0]
    assert "a margin of 0 needs positive radii" in refusal(lambda: touching.require_radii([0.0, 0.2]))


TASKS = {
    "{kind: goal, gain: 2}": GoalTask(2.0),
    "{kind: goal_unknown_gain}": UnknownGainGoalTask(),
    "{kind: velocity}": VelocityTask(),
    "{kind: formation, gain: 2, leader: 1}": FormationTask(2.0, leader=1),
    "{kind: orbit, rate: -0.5}": OrbitTask(-0.5),
    "{kind: patrol, gain: 2, rate: 3, harmonics: 2}": PatrolTask(2.0, 3.0, 2),
}


@pytest.mark.parametrize("text", TASKS)
def test_every_kind_of_task(text):
    config = validate({"task": yaml.safe_load(text)}, Task, "cfg.yaml").task
    built = config.build(BODIES)
    assert built == TASKS[text]
    assert config.parameters(2) == len(built.parameter_names)
    if 3 in config.dimensions:
        assert config.parameters(3) == len(config.build(BODIES, 3).parameter_names)


BARRIERS = {
    "{kind: avoidance, distance: euclidean, margin: 0, class_k: {gain: 2}, soft: true}": CollisionAvoidance(
        ClassK(2.0), margin=0.0, distance="euclidean", soft=True
    ),
    "{kind: avoidance, safety_distance: 0.3, class_k: {gain: 2, power: 0.5}}": CollisionAvoidance(
        ClassK(2.0, 0.5), safety_distance=0.3
    ),
    "{kind: speed_box, limit: [1, 2], soft: true}": SpeedBox((1.0, 2.0), soft=True),
    "{kind: speed_polygon, sides: 3, limit: 2, soft: true}": SpeedPolygon(3, 2.0, soft=True),
    "{kind: arena, lower: [-1, -2], upper: [1, 2], margin: 0.1, class_k: {gain: 3, power: 3}, soft: true}": Arena(
        (-1.0, -2.0), (1.0, 2.0), ClassK(3.0, 3.0), margin=0.1, soft=True
    ),
}


@pytest.mark.parametrize("text", BARRIERS)
def test_every_kind_of_barrier(text):
    assert validate({"barrier": yaml.safe_load(text)}, Barrier, "cfg.yaml").barrier.build([]) == BARRIERS[text]


def test_the_default_tolerance_is_that_of_the_active_set():
    assert observe().active_tolerance == ACTIVE_TOLERANCE


@pytest.mark.parametrize("number", ["1e-6", "1.0e-6", "'1e-6'", ".000001"])
def test_numbers_that_yaml_takes_for_text(number):
    assert observe(f"noise.velocity={number}").noise.velocity == 1e-6


def test_names_are_what_was_written(tmp_path):
    path = tmp_path / "cfg.yaml"
    path.write_text(ROBOTARIUM + "obstacles: [1000, 010, 0x10, 1_0, 1:30, -3, '7', no-one]")
    names = ("1000", "010", "0x10", "1_0", "1:30", "-3", "7", "no-one")
    assert load(path, ObserveConfig).obstacles == names


def test_validation_does_not_wait_for_torch():
    code = "import sys, torchfsid.config; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_what_observers_are_built():
    """The prior of every robot, and a filter that starts from it, or none."""
    config, task = observe("ukf.position_noise=0.5", "prior.upper=[1.04, 2.04]"), GoalTask(0.11)
    hybrid = config.build_observer(task, [], 3)
    assert isinstance(hybrid, HybridObserver)
    torch.testing.assert_close(hybrid.sets.prior.volume(), torch.full((3,), 6.0, dtype=torch.float64))
    torch.testing.assert_close(hybrid.ukf.mean, torch.tensor([[0.04, 0.54]] * 3, dtype=torch.float64))
    assert hybrid.ukf.position_noise == 0.5
    torch.testing.assert_close(
        torch.as_tensor(hybrid.ukf.spread), torch.tensor([[2.0, 3.0]] * 3, dtype=torch.float64) / math.sqrt(12)
    )
    given = observe("ukf.prior_std=7").build_observer(task, [], 1)
    assert isinstance(given, HybridObserver)
    assert torch.as_tensor(given.ukf.spread).tolist() == [[7.0, 7.0]]
    alone = observe("ukf=false", "set=critical_region").build_observer(task, [], 3)
    assert isinstance(alone, SetMembershipObserver)
    assert alone.kind == "critical_region"


def test_robots_are_all_but_obstacles_and_the_leader():
    assert observe().robots(BODIES) == BODIES
    assert observe("obstacles=[wall]").robots(BODIES) == ["0", "1"]
    assert observe("task={kind: formation, gain: 1, leader: 0}", "obstacles=[wall]").robots(BODIES) == ["1"]


def test_bodies_that_are_not_in_the_log():
    assert "obstacles[1]: no body is called '9'" in refusal(lambda: observe("obstacles=[0, 9]").robots(BODIES))
    assert "no robot is left" in refusal(lambda: observe("obstacles=[0, 1, wall]").robots(BODIES))
    task = observe("task={kind: formation, gain: 1, leader: 9}").task
    assert "task.leader: no body is called '9'" in refusal(lambda: task.build(BODIES))


# Round trip.

number = st.floats(min_value=-1e6, max_value=1e6)
positive = st.floats(min_value=1e-9, max_value=1e6)
name = st.text(st.characters(exclude_characters="\0"), min_size=1)  # with what no file of text can hold
class_k = st.fixed_dictionaries({"gain": positive}, optional={"power": positive})
box = st.tuples(number, number, positive, positive).map(
    lambda v: {"lower": [v[0], v[1]], "upper": [v[0] + v[2] + 1, v[1] + v[3] + 1]}
)
configs = st.fixed_dictionaries(
    {
        "task": st.one_of(
            st.fixed_dictionaries({"kind": st.just("goal"), "gain": positive}),
            st.fixed_dictionaries({"kind": st.just("formation"), "gain": positive, "leader": name}),
            st.fixed_dictionaries({"kind": st.just("orbit"), "rate": number}),
        ),
        "barriers": st.lists(
            st.one_of(
                st.fixed_dictionaries(
                    {"kind": st.just("avoidance"), "safety_distance": positive, "class_k": class_k},
                    optional={"soft": st.booleans(), "neighbour_velocity": st.sampled_from(["none", "previous"])},
                ),
                st.fixed_dictionaries({"kind": st.just("speed_box"), "limit": st.tuples(positive, positive)}),
                box.map(lambda walls: {"kind": "arena", **walls, "class_k": {"gain": 1.0}}),
            ),
            min_size=1,
        ),
        "prior": box,
        "noise": st.fixed_dictionaries({"velocity": positive}, optional={"slack": positive}),
    },
    optional={
        "set": st.sampled_from(["inverse_optimal", "critical_region"]),
        "active_tolerance": positive,
        "obstacles": st.lists(name),
        "ukf": st.just(False) | st.fixed_dictionaries({}, optional={"prior_std": positive, "qp_inside": st.booleans()}),
    },
)


@repeatable
@given(raw=configs)
def test_dump_loads_back_to_the_same_configuration(raw, tmp_path_factory):
    config = validate(raw, ObserveConfig, "cfg.yaml")
    path = tmp_path_factory.getbasetemp() / "resolved.yaml"
    path.write_text(dump(config), encoding="utf-8")
    assert load(path, ObserveConfig) == config
    assert [barrier.build([]) for barrier in load(path, ObserveConfig).barriers] == [
        b.build([]) for b in config.barriers
    ]


# Overrides.


def test_overrides_change_a_copy():
    raw = yaml.safe_load(ROBOTARIUM)
    before = copy.deepcopy(raw)
    changed = apply_overrides(raw, ["barriers.0.safety_distance=0.2", "noise.slack=0.1", "ukf.feedback=true"])
    assert raw == before
    assert changed["barriers"] == [{**before["barriers"][0], "safety_distance": 0.2}, before["barriers"][1]]
    assert changed["noise"] == {"velocity": 0.02, "slack": 0.1}
    assert changed["ukf"] == {"feedback": True}


def test_an_override_does_not_reach_an_alias(tmp_path):
    path = tmp_path / "cfg.yaml"
    path.write_text("a: &shared {x: 1}\nb: *shared\n")
    assert apply_overrides(read_yaml(path), ["b.x=2"]) == {"a": {"x": 1}, "b": {"x": 2}}


def test_a_later_override_wins(tmp_path):
    path = tmp_path / "cfg.yaml"
    path.write_text(ROBOTARIUM)
    assert load(path, ObserveConfig, ["noise.velocity=1", "noise.velocity=2"]).noise.velocity == 2
