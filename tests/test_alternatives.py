"""Other values of keys: which one a log suspects, and scans over the values of one."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest

from tests.logs import write_config
from tests.verdicts import AVOIDANCE, GOALS, RIGHT, console, crossing, declared, said
from torchfsid.cli import main
from torchfsid.commands.alternatives import best_alternative
from torchfsid.commands.check import check
from torchfsid.commands.judged_bound import JudgedBound
from torchfsid.commands.observe import Observation
from torchfsid.commands.report import print_bound, print_verdicts
from torchfsid.commands.scan import Range, scan
from torchfsid.errors import ConfigError
from torchfsid.logs.log import Log
from torchfsid.logs.table_log import read_csv
from torchfsid.robots.tasks import GoalTask, Saturation

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return crossing(tmp_path_factory.mktemp("log"), GoalTask(0.9))


@pytest.fixture(scope="module")
def log(path: Path) -> Log:
    return read_csv(path)


# Other values of keys -----------------------------------------------------------------------------------------------

WRONG = {
    "task.gain": {"task": {"kind": "goal", "gain": 0.8}},
    "barriers.0.safety_distance": {"barriers": [{**AVOIDANCE, "safety_distance": 0.35}]},
    "barriers.0.class_k.gain": {"barriers": [{**AVOIDANCE, "class_k": {"gain": 15.0}}]},
    "barriers.0.neighbour_velocity": {"barriers": [{**AVOIDANCE, "neighbour_velocity": "none"}]},
    "prior": {"prior": {"lower": [-1.5, -5], "upper": [1.5, 5]}},
}


@pytest.mark.parametrize("key", WRONG)
def test_the_wrong_key_is_suspected(log: Log, key: str) -> None:
    wrong = declared(log, **WRONG[key])
    smallest = max(wrong.smallest_bounds().values())
    found = best_alternative(wrong, smallest)
    assert found is not None
    assert (found.key, found.bound < 0.7 * smallest) == (key, True)
    right = {"task.gain": 0.9, "barriers.0.safety_distance": 0.5, "barriers.0.class_k.gain": 1.5}.get(key)
    assert right is None or float(found.value) == pytest.approx(right, rel=0.05)
    assert ("prior too small" if key == "prior" else f"suspect {key}: ") in found.sentence("m/s")


def test_check_names_the_key_and_no_shift(log: Log) -> None:
    """A shift is named only where it explains much more than another value of a key does."""
    result = check(declared(log, **WRONG["barriers.0.safety_distance"]))
    assert result.best_shift == 0
    smallest, rival = result.smallest_bound, 0.4 * result.smallest_bound
    assert result.alternative is not None
    alternative = replace(result.alternative, bound=rival)
    shifted = replace(result, shifts={0: smallest, -2: 0.39 * smallest}, alternative=alternative)
    assert shifted.best_shift == 0
    assert replace(shifted, alternative=None).best_shift == -2
    assert replace(shifted, shifts={0: smallest, -2: 0.2 * smallest}).best_shift == -2
    assert result.conclusions()[1].startswith("suspect barriers.0.safety_distance: 0.")
    assert not any("sample(s)" in line for line in result.conclusions())
    assert result.safety is not None
    neither = replace(result, safety=replace(result.safety, pair=False, free=None))
    for other, is_said in ((neither, False), (replace(neither, alternative=None), True)):
        assert any("common to all robots" in line for line in other.conclusions()) == is_said  # the cause is named once


def test_nothing_is_suspected_of_the_right_model(log: Log) -> None:
    right = declared(log)
    assert best_alternative(right, max(right.smallest_bounds().values())) is None
    lines = check(right).conclusions()
    assert "consistent: no contradiction was seen. That is no proof of the model" in lines
    assert not any("suspect" in line or "too small" in line for line in lines)


def test_auto_warns_where_a_fixed_bound_would(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A gain that is a tenth off, for which `auto` finds a bound; and a speed limit that was forgotten."""
    config = write_config(tmp_path / "config.yaml", {**RIGHT, "noise": {"velocity": "auto"}})
    command = ["observe", "--config", str(config), "--out", str(tmp_path / "out")]
    assert main([*command, str(path)]) == 0
    assert "Warning" not in capsys.readouterr().out
    assert main([*command, str(path), "--set", "task.gain=0.8"]) == 0
    assert "Warning: suspect task.gain: 0.9" in capsys.readouterr().out
    limited = crossing(tmp_path, GoalTask(0.9, saturation=Saturation("norm", (0.5, 0.5))))
    assert main([*command, str(limited)]) in (0, 2)
    captured = capsys.readouterr()
    assert "suspect task.saturation: {kind: norm, limit: 0.5" in captured.out or "the model is wrong" in captured.err


def test_auto_says_who_needs_much() -> None:
    for typical, named in ((1.0, True), (2.0, False), (0.3, False)):  # the last bound is useless, which says more
        print_bound(
            shown := console(80), {"ann": 0.12, "bob": 0.05}, JudgedBound(0.24, typical, 3.0, "m/s"), "velocity"
        )
        assert ("More than 10% of the typical control is needed by ann: " in said(shown)) == named
        assert ("useless" in said(shown)) == (typical == 0.3)


def test_little_was_learned_is_said(log: Log, tmp_path: Path) -> None:
    observation = Observation(declared(log, noise={"velocity": 10.0}))
    observation.run(tmp_path)
    assert observation.hardly_cut() == list(GOALS)
    print_verdicts(observation, tmp_path, shown := console(80))
    assert "The log says little of ann, bob, turtlebot_3" in said(shown)


# Scans --------------------------------------------------------------------------------------------------------------


def test_a_scan_finds_the_value_that_was_wrong(log: Log) -> None:
    config = declared(log, task={"kind": "goal", "gain": 0.8}).config
    found = scan(log, config, Range.parse("task.gain=0.6:1.2:4"))
    assert found.best == pytest.approx(0.9, rel=0.03)
    assert found.declared == 0.8
    for value in (0.6, 0.8, found.best):
        model = declared(log, task={"kind": "goal", "gain": value})
        assert found.bounds[value] == tuple(model.smallest_bounds().values())
        assert found.largest(found.best) <= found.largest(value)
    assert found.conclusions()[0].startswith(f"best: task.gain={found.best:.4g} needs ")


def test_a_scan_is_printed_and_written(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, out = write_config(tmp_path / "config.yaml", RIGHT), tmp_path / "out"
    command = ["check", str(path), "--config", str(config), "--out", str(out), "--scan"]
    assert main([*command, "barriers.0.class_k.power=1:3:3"]) == 0
    assert "best" in capsys.readouterr().out
    found = json.loads((out / "scan.json").read_text())
    assert found["values"][0] == 1.0
    assert found["best"]["value"] == pytest.approx(1.0, abs=0.1)
    rows = list(csv.DictReader((out / "scan.csv").open()))
    assert len(rows) == 3 * len(found["values"])
    assert {row["robot"] for row in rows} == set(GOALS)
    assert float(rows[0]["velocity_bound"]) == pytest.approx(found["bounds"]["ann"][0], rel=1e-5)
    assert (out / "scan.png").exists()
    assert main([*command, "task.gain=0.2"]) == 2
    assert main([*command, "task.gian=0.2:0.3"]) == 2
    assert "did you mean" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text", ["", "task.gain", "task.gain=1", "task.gain=2:1", "task.gain=1:2:1", "a=1:nan", "a=0:inf"]
)
def test_ranges_are_refused_in_one_line(text: str) -> None:
    with pytest.raises(ConfigError, match="expected KEY=LOW:HIGH"):
        Range.parse(text)


def test_the_bound_that_is_found_is_not_scanned() -> None:
    with pytest.raises(ConfigError, match="this bound is what is found"):
        Range.parse("noise.velocity=0.1:0.2")
