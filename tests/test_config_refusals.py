"""Configuration that is wrong: one clear line, which names the file and the path of the key."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.test_config import BODIES, ROBOTARIUM, configs, observe, refusal, repeatable
from torchfsid.config.documents import Strict, load, validate
from torchfsid.config.observe import ObserveConfig
from torchfsid.config.observers import PriorConfig
from torchfsid.errors import ConfigError

WRONG_VALUES = {
    "noise.velocty=1": "noise.velocty: unknown key (did you mean 'velocity'?)",
    "nois={}": "nois: unknown key (did you mean 'noise'?)",
    "task.saturaton={kind: norm, limit: 1}": "task.saturaton: unknown key (did you mean 'saturation'?)",
    "barriers.1.sidez=8": "barriers[1].sidez: unknown key (did you mean 'sides'?)",
    "barriers.1.kind=speed_box": "barriers[1].sides: unknown key",
    '"a\\nb"=1': "unknown key",
    "barriers.0.gain=1": "barriers[0].gain: unknown key (did you mean 'class_k.gain'?)",
    "lower=[0, 0]": "lower: unknown key (did you mean 'prior.lower'?)",
    "position=1": "position: unknown key (did you mean 'noise.position'?)",
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
    "prior={lower: [0], upper: [1]}": "prior: task 'goal' has 2 parameters in the plane and 3 in space",
    "task={kind: goal_unknown_gain}": "prior: task 'goal_unknown_gain' has 3 parameters in the plane and 4 in space",
    "task={kind: patrol, gain: 1, rate: 1}": "prior: task 'patrol' has 6 parameters in the plane and 9 in space",
    "prior.upper=[.inf, 1]": "prior.upper[0]: Input should be a finite number, got inf",
    "prior.upper=[a, 1]": "prior.upper[0]: Input should be a valid number, got 'a'",
    "noise.velocity=-0.1": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got -0.1",
    "outliers=-1": "outliers: Input should be greater than or equal to 0, got -1",
    "outliers=1.5": "outliers: Input should be a valid integer, got 1.5",
    "noise.velocity=.nan": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got nan",
    "noise.velocity=nan": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got 'nan'",
    "noise.velocity=1e400": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got",
    "noise.velocity=1" + 400 * "0": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got",
    "noise.velocity=true": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got True",
    "noise.velocity=[1]": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got [1]",
    "noise.slack=-1": "noise.slack: Input should be greater than or equal to 0, got -1",
    "noise=": "noise: expected keys and values, got None",
    "set=paper": "set: Input should be 'inverse_optimal' or 'critical_region', got 'paper'",
    "velocity=none": "velocity: Input should be 'logged', 'differentiated' or 'windows', got 'none'",
    "active_tolerance=-1e-3": "active_tolerance: Input should be greater than 0, got '-1e-3'",
    "obstacles=1000": "obstacles: expected a list, got 1000",
    "obstacles=['', a]": "obstacles[0]: expected a name, got ''",
    "obstacles=[true]": "obstacles[0]: expected a name, got True",
    "obstacles=[2001-01-01]": "obstacles[0]: expected a name",
    "ukf.position_noise=0": "ukf.position_noise: Input should be greater than 0, got 0",
    "ukf.prior_std=0": "ukf.prior_std: Input should be greater than 0, got 0",
    "task.gain=1_0": "task.gain: Input should be a valid number, got '1_0'",
    "task.gain=1_0.0": "task.gain: Input should be a valid number, got '1_0.0'",
    "task.gain='1_0'": "task.gain: Input should be a valid number, got '1_0'",
    "task.gain=1:30.0": "task.gain: Input should be a valid number, got '1:30.0'",
    "task.gain=0x10": "task.gain: Input should be a valid number, got '0x10'",
    "noise.velocity=1_0": "noise.velocity: expected a bound of at least 0 m/s or 'auto', got '1_0'",
    "prior=infinite": "prior: expected keys and values, got 'infinite'",
    "prior.lower=[-.inf, 0]": "prior.lower[0]: Input should be a finite number, got -inf",
    "prior.upper=[1, 1.1e+9]": "prior.upper: expected no number beyond 1e+09, because sets in a larger prior lose",
    'obstacles=["a\\0"]': "obstacles[0]: expected a name without a NUL, got 'a\\x00'",
    "ukf=true": "ukf: expected keys and values, got True",
    "ukf=": "ukf: expected keys and values, got None",
    "ukf={position_nois: 1}": "ukf.position_nois: unknown key (did you mean 'position_noise'?)",
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
