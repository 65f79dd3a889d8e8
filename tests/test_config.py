"""Configuration: what a file means, and that a wrong one is refused with one clear line."""

import copy
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfsid.config.barriers import BarrierConfig
from torchfsid.config.documents import Strict, apply_overrides, dump, load, read_yaml, validate
from torchfsid.config.observe import ObserveConfig
from torchfsid.config.observers import PriorConfig
from torchfsid.config.tasks import TaskConfig
from torchfsid.errors import ConfigError
from torchfsid.robots.barriers import Arena, ClassK, CollisionAvoidance, SpeedBox, SpeedPolygon
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
    assert not config.uses_radius


def test_the_sample_with_radii():
    config = observe(text=IRSIM)
    assert [barrier.build([]) for barrier in config.barriers] == [
        CollisionAvoidance(ClassK(1.0, 1.0), margin=0.2, neighbour_velocity="previous"),
        SpeedBox((0.8, 0.8)),
    ]
    assert config.noise.build() == NoiseBound(1e-5)
    assert config.neighbour_velocities == {"previous"}
    assert config.uses_radius


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
    assert config.parameters == len(built.parameter_names)


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
        "ukf": st.fixed_dictionaries({}, optional={"prior_std": positive, "qp_inside": st.booleans()}),
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


# What is refused, and how.

WRONG_VALUES = {
    "noise.velocty=1": "noise.velocty: unknown key (did you mean 'velocity'?)",
    "nois={}": "nois: unknown key (did you mean 'noise'?)",
    "task.saturaton={kind: norm, limit: 1}": "task.saturaton: unknown key (did you mean 'saturation'?)",
    "barriers.1.sidez=8": "barriers[1].sidez: unknown key (did you mean 'sides'?)",
    "barriers.1.kind=speed_box": "barriers[1].sides: unknown key",
    '"a\\nb"=1': "unknown key",
    "task={gain: 1}": "task.kind: required key is missing",
    "task={kind: goal}": "task.gain: required key is missing",
    "task={kind: gaol}": "task.kind: expected one of 'goal', ",
    "task={kind: [goal]}": "task.kind: expected one of 'goal', ",
    "task=goal": "task: expected keys and values, got 'goal'",
    "task.gain=0": "task.gain: Input should be greater than 0, got 0",
    "task={kind: patrol, gain: 1, rate: 1, harmonics: 0}": "task.harmonics: Input should be greater than or equal to 1",
    "task={kind: formation, gain: 1, leader: 1.0}": "task.leader: expected a name, got 1.0",
    "barriers=[]": "barriers: expected at least 1 entries, got 0",
    "barriers={}": "barriers: expected a list, got {}",
    "barriers.0=avoidance": "barriers[0]: expected keys and values, got 'avoidance'",
    "barriers.0.safety_distance=-0.1": "barriers[0].safety_distance: Input should be greater than 0, got -0.1",
    "barriers.0.safety_distance=0": "barriers[0].safety_distance: Input should be greater than 0, got 0",
    "barriers.0.margin=0.1": "barriers[0]: expected safety_distance or margin, got both",
    "barriers.0.safety_distance=": "barriers[0]: expected safety_distance or margin, got neither",
    "barriers.0.class_k.gain=-1": "barriers[0].class_k.gain: Input should be greater than 0",
    "barriers.0.class_k.power=0": "barriers[0].class_k.power: Input should be greater than 0",
    "barriers.0.distance=cubed": "barriers[0].distance: Input should be 'squared' or 'euclidean', got 'cubed'",
    "barriers.0.soft=1": "barriers[0].soft: Input should be a valid boolean, got 1",
    "barriers.1.sides=2": "barriers[1].sides: Input should be greater than or equal to 3, got 2",
    "barriers.1.sides=8.0": "barriers[1].sides: Input should be a valid integer, got 8.0",
    "barriers.1.sides=true": "barriers[1].sides: Input should be a valid integer, got True",
    "barriers.1.limit=0": "barriers[1].limit: Input should be greater than 0, got 0",
    "barriers.1={kind: speed_box, limit: [1]}": "barriers[1].limit: expected at least 2 entries, got 1",
    "barriers.1={kind: speed_box, limit: [1, 0]}": "barriers[1].limit[1]: Input should be greater than 0, got 0",
    "barriers.1={kind: arena, lower: [0, 0], upper: [1, 0], class_k: {gain: 1}}": "barriers[1]: lower[1] must be less",
    "prior.lower=[0, 1]": "prior: lower[1] must be less than upper[1], got 1.0 and 0.96",
    "prior.lower=[0, 0.96]": "prior: lower[1] must be less than upper[1], got 0.96 and 0.96",
    "prior.lower=[0, 0, 0]": "prior: lower has 3 entries, upper has 2",
    "prior={lower: [0], upper: [1]}": "prior: task 'goal' has 2 parameters, lower and upper have 1",
    "task={kind: goal_unknown_gain}": "prior: task 'goal_unknown_gain' has 3 parameters, lower and upper have 2",
    "task={kind: patrol, gain: 1, rate: 1}": "prior: task 'patrol' has 6 parameters, lower and upper have 2",
    "prior.upper=[.inf, 1]": "prior.upper[0]: Input should be a finite number, got inf",
    "prior.upper=[a, 1]": "prior.upper[0]: Input should be a valid number, got 'a'",
    "noise.velocity=-0.1": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got -0.1",
    "noise.velocity=.nan": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got nan",
    "noise.velocity=nan": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got 'nan'",
    "noise.velocity=1e400": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got",
    "noise.velocity=1" + 400 * "0": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got",
    "noise.velocity=true": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got True",
    "noise.velocity=[1]": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got [1]",
    "noise.slack=-1": "noise.slack: Input should be greater than or equal to 0, got -1",
    "noise=": "noise: expected keys and values, got None",
    "set=paper": "set: Input should be 'inverse_optimal' or 'critical_region', got 'paper'",
    "velocity=none": "velocity: Input should be 'logged' or 'differentiated', got 'none'",
    "active_tolerance=-1e-3": "active_tolerance: Input should be greater than 0, got '-1e-3'",
    "obstacles=1000": "obstacles: expected a list, got 1000",
    "obstacles=['', a]": "obstacles[0]: expected a name, got ''",
    "obstacles=[true]": "obstacles[0]: expected a name, got True",
    "obstacles=[2001-01-01]": "obstacles[0]: expected a name",
    "ukf.position_noise=0": "ukf.position_noise: Input should be greater than 0, got 0",
    "ukf.prior_std=0": "ukf.prior_std: Input should be greater than 0, got 0",
    "ukf.qp_inside=1": "ukf.qp_inside: Input should be a valid boolean, got 1",
}


@pytest.mark.parametrize("override", WRONG_VALUES)
def test_a_wrong_value_is_named_by_its_path(override):
    message = refusal(lambda: observe(override))
    assert message.startswith("cfg.yaml: ")
    assert WRONG_VALUES[override] in message


def test_several_mistakes_are_counted():
    message = refusal(lambda: observe("noise.velocity=-1", "noise.slack=-1", "set=paper"))
    assert message.startswith("cfg.yaml: noise.slack: ")
    assert message.endswith("got -1 (and 2 more)")


def test_missing_sections():
    message = refusal(lambda: validate({}, ObserveConfig, "cfg.yaml"))
    assert message == "cfg.yaml: task: required key is missing (and 3 more)"


WRONG_FILES = {
    b"": "expected keys and values, got nothing",
    b"# nothing\n": "expected keys and values, got nothing",
    b"- a\n- b\n": "expected keys and values, got ['a', 'b']",
    b"just text": "expected keys and values, got 'just text'",
    b"a: [1, 2\nb: 3\n": "line 2: not valid YAML",
    b"a: 1\nb:\n  c: 1\n  d: 2\n  c: 3\n": "line 5: not valid YAML: key 'c' is given twice",
    b"a: 1\n'a': 2\n": "line 2: not valid YAML: key 'a' is given twice",
    b"a: 1\n---\nb: 1\n": "not valid YAML: but found another document",
    b"a: \xff\xfe": "not valid YAML",
    b"a: !!python/object/apply:os.getcwd []": "line 1: not valid YAML: could not determine a constructor",
    b"a: !!float x": "not valid YAML",
    b"a: !!bool x": "not valid YAML",
    b"a: 2001-99-99": "not valid YAML",
    b"a: " + 2000 * b"[": "not valid YAML",
    b"a: " + 5000 * b"1": "not valid YAML",
    b"? {a: 1}\n: 2": "line 1: not valid YAML: found unhashable key",
}


@pytest.mark.parametrize("content", WRONG_FILES)
def test_a_file_that_is_no_mapping_is_named(content, tmp_path):
    path = tmp_path / "cfg.yaml"
    path.write_bytes(content)
    message = refusal(lambda: load(path, ObserveConfig))
    assert message.startswith(f"{path}: ")
    assert WRONG_FILES[content] in message


@pytest.mark.parametrize("name", ["missing.yaml", ".", "nul\0.yaml"])
def test_a_file_that_cannot_be_read(name, tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        load(tmp_path / name, ObserveConfig)


def test_a_byte_order_mark_and_windows_line_ends_do_not_matter(tmp_path):
    path = tmp_path / "cfg.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + ROBOTARIUM.strip().replace("\n", "\r\n").encode())
    assert load(path, ObserveConfig) == observe()


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


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("foo", "expected path.to.key=value"),
        ("=1", "expected path.to.key=value"),
        ("a..b=1", "expected path.to.key=value"),
        ("task.gain=[", "not valid YAML"),
        ("task={kind: goal, kind: goal}", "key 'kind' is given twice"),
        ("barriers.2.limit=1", "expected a number below 2 in place of '2'"),
        ("barriers.-1.limit=1", "expected a number below 2 in place of '-1'"),
        ("task.gain.x=1", "0.11 has no key 'x'"),
        ("a\n=[", "not valid YAML"),
    ],
)
def test_a_malformed_override(override, expected):
    message = refusal(lambda: observe(override))
    assert message.startswith(f"override {override!r}: ")
    assert expected in message


# Anything at all gives a configuration that builds, or a `ConfigError` of one line.

keys = st.one_of(
    st.text(max_size=4), st.sampled_from(["kind", "gain", "lower", "limit", "task", "velocity", "class_k"])
)
words = st.sampled_from(["goal", "avoidance", "speed_box", "previous", "1e-6", "nan", "1"])
scalars = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=4), words, st.dates())
values = st.recursive(
    scalars, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=3), max_leaves=6
)


def places(node, path=()):
    """Every place in a tree of mappings and lists."""
    yield path
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, child in items:
        yield from places(child, (*path, key))


def builds_or_refuses(make) -> None:
    message, config = "", None
    try:
        config = make()
    except ConfigError as error:
        message = str(error)
    assert message.isprintable()
    if config is None:
        return
    config.task.build([*BODIES, getattr(config.task, "leader", "")])
    config.noise.build()
    for barrier in config.barriers:
        barrier.build([])


@repeatable
@given(data=st.data(), raw=configs)
def test_one_wrong_place_in_a_right_file(data, raw):
    where = data.draw(st.sampled_from(list(places(raw))[1:]))
    *inner, last = where
    node = raw
    for key in inner:
        node = node[key]
    if isinstance(node, tuple):
        node = list(node)
    node[last] = data.draw(values)
    builds_or_refuses(lambda: validate(raw, ObserveConfig, "cfg.yaml"))


@repeatable
@given(path=st.lists(keys, min_size=1, max_size=3).map(".".join), value=st.text(max_size=8))
def test_any_override(path, value):
    builds_or_refuses(lambda: observe(f"{path}={value}"))


@repeatable
@given(
    cut=st.integers(0, len(ROBOTARIUM)),
    insert=st.text(st.sampled_from("a:[]{}-,&*!?|>'\"%@# \n\t0.\x00\ud800"), max_size=5),
)
def test_any_text_put_into_a_file(cut, insert, tmp_path_factory):
    path: Path = tmp_path_factory.getbasetemp() / "any.yaml"
    text = ROBOTARIUM[:cut] + insert + ROBOTARIUM[cut:]
    path.write_bytes(text.encode("utf-8", errors="surrogatepass"))
    builds_or_refuses(lambda: load(path, ObserveConfig))


def test_pieces_serve_other_models():
    class Other(Strict):
        prior: PriorConfig

    assert "prior: lower[0] must be less" in refusal(
        lambda: validate({"prior": {"lower": [1], "upper": [0]}}, Other, "other.yaml")
    )
