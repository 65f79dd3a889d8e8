"""A verdict one can act on: tables that fit, contradictions by name and key, other values of keys, scans, truth."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rich.console import Console

from tests.logs import bounded_errors, write_config, write_log
from torchfsid.cli import main
from torchfsid.commands.alternatives import best_alternative
from torchfsid.commands.check import check
from torchfsid.commands.clock import Clock
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.fitted_table import Column, fitted_table
from torchfsid.commands.hypotheses import Hypotheses
from torchfsid.commands.judged_bound import JudgedBound
from torchfsid.commands.observe import Observation
from torchfsid.commands.report import print_bound, print_verdicts
from torchfsid.commands.report_check import print_check
from torchfsid.commands.report_hypotheses import print_hypotheses
from torchfsid.commands.scan import Range, scan
from torchfsid.config.documents import validate
from torchfsid.config.observe import ObserveConfig
from torchfsid.errors import ConfigError
from torchfsid.logs.log import Log
from torchfsid.logs.table_log import read_csv
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask, Saturation

pytestmark = pytest.mark.usefixtures("undrawn")

WIDTHS = (60, 80, 100, 150)
GOALS = {"ann": [2.0, 0.1], "bob": [-2.0, 0.0], "turtlebot_3": [0.0, 2.0]}
AVOIDANCE = {"kind": "avoidance", "safety_distance": 0.5, "class_k": {"gain": 1.5}, "neighbour_velocity": "current"}
RIGHT = {
    "task": {"kind": "goal", "gain": 0.9},
    "barriers": [AVOIDANCE],
    "prior": {"lower": [-5, -5], "upper": [5, 5]},
    "noise": {"velocity": 0.02},
    "ukf": False,
}
SMALL_PRIOR = {"lower": [-1, -1], "upper": [1, 1]}


def crossing(folder: Path, task: GoalTask, t0: float = 0.0) -> Path:
    """The log of three robots that cross, by one QP over all of them, with errors of 0.01 m/s."""
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3], [0.1, -2.0]], dtype=torch.float64)
    goals = torch.tensor(list(GOALS.values()), dtype=torch.float64)
    avoidance = CollisionAvoidance(ClassK(1.5), safety_distance=0.5, neighbour_velocity="current")
    run = simulate(CbfQpController(task, [avoidance]), goals, start, dt=0.15, steps=32)
    run.t[:] += t0
    return write_log(folder / "log.csv", run, list(GOALS), bounded_errors(run, 3, 0.01, 0))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return crossing(tmp_path_factory.mktemp("log"), GoalTask(0.9))


@pytest.fixture(scope="module")
def log(path: Path) -> Log:
    return read_csv(path)


def declared(log: Log, **changes: object) -> DeclaredLog:
    return DeclaredLog(validate({**RIGHT, **changes}, ObserveConfig, "test"), log)


def console(width: int) -> Console:
    return Console(file=io.StringIO(), width=width)


def said(shown: Console) -> str:
    assert isinstance(shown.file, io.StringIO)
    return shown.file.getvalue()


def is_whole(text: str, width: int) -> bool:
    """Are all lines of tables within the width, with both ends?"""
    ends = {"┏": "┓", "┃": "┃", "┡": "┩", "│": "│", "└": "┘"}
    lines = [line.rstrip() for line in text.splitlines() if line[:1] in ends]
    return bool(lines) and all(len(line) <= width and line[-1] == ends[line[0]] for line in lines)


def lines_with(text: str, *words: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("│") and all(word in line for word in words)]


# Tables -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("changes", [{}, {"prior": SMALL_PRIOR}, {"noise": {"velocity": "auto"}, "truth": GOALS}])
def test_robot_and_status_are_in_a_table_of_any_width(log: Log, tmp_path: Path, changes: dict) -> None:
    observation = Observation(declared(log, **changes))
    observation.run(tmp_path)
    for width in WIDTHS:
        print_verdicts(observation, tmp_path, shown := console(width))
        text = said(shown)
        assert "…" not in text
        assert is_whole(text, width)
        for verdict in observation.verdicts():
            size = "-" if verdict.status != "ok" else f"{verdict.diameter:.3g}"
            assert len(lines_with(text, f" {verdict.robot} ", verdict.status, f" {size} ")) == 1
        (headings,) = (line for line in text.splitlines() if line.startswith("┃"))
        missing = " ".join(text.split()).partition("without ")[2].partition(":")[0]
        assert not any(f" {heading} " in headings for heading in missing.split(", ") if heading)
        assert (missing == "") == (width == 150)
        assert missing == "" or missing.startswith("cases")


def test_what_is_left_out_is_what_matters_least_and_names_are_folded() -> None:
    columns = [Column("robot", "name", ["r" * 30]), Column("a", cells=["1" * 20]), Column("b", cells=["2" * 20])]
    for width, left in ((80, {"a", "b"}), (60, {"b"}), (40, set())):
        shown = console(width)
        shown.print(fitted_table("title", columns, ("a", "b"), shown, "elsewhere"))
        text = said(shown)
        assert {heading for heading, digit in (("a", "1"), ("b", "2")) if digit * 20 in text} == left
        assert sum(line.count("r") for line in text.splitlines() if line[0] == "│") == 30
        assert is_whole(text, width)


def test_tables_of_hypotheses_and_of_check_fit(log: Log, tmp_path: Path) -> None:
    models = {"right": declared(log), "fast": declared(log, task={"kind": "goal", "gain": 1.8})}
    hypotheses = Hypotheses(models)
    for name, observation in hypotheses.observations.items():
        (tmp_path / name).mkdir()
        observation.run(tmp_path / name)
    found = check(models["fast"])
    for width in WIDTHS:
        print_hypotheses(hypotheses, tmp_path, shown := console(width))
        print_check(found, "", shown)
        text = said(shown)
        assert "…" not in text
        assert is_whole(text, width)
        for robot in GOALS:
            assert lines_with(text, f" {robot} ", "possible, ")
            assert lines_with(text, f" {robot} ", "refuted at ")
        for robot in found.robots:
            assert lines_with(text, f" {robot.robot} ", f" {robot.smallest_bound:.3g} ")


# Words --------------------------------------------------------------------------------------------------------------


def test_contradictions_name_rows_and_keys(log: Log, tmp_path: Path) -> None:
    """A prior that is too small is named first; a distance that is too large is an alarm of its row."""
    small = Observation(declared(log, prior=SMALL_PRIOR))
    small.run(tmp_path)
    print_verdicts(small, tmp_path, shown := console(80))
    assert "Not to be trusted: ann (inconsistent), bob (inconsistent), turtlebot_3 (inconsistent)." in said(shown)
    assert "prior too small? Otherwise look at barriers.0.class_k.gain, " in said(shown)
    assert "no contradiction was seen" not in said(shown)
    regions = json.loads((tmp_path / "regions.json").read_text())["robots"]
    for region in regions.values():
        (event,) = region["events"]
        assert event["prior"]
        assert {row["constraint"] for row in event["rows"] if row["source"] < 0} == {"prior"}
        assert {facet["constraint"] for facet in region["facets"]} <= {
            "prior", "nominal control", "avoid ann", "avoid bob", "avoid turtlebot_3",
        }  # fmt: skip
        assert all((facet["constraint"] == "prior") == (facet["source"] == -1) for facet in region["facets"])

    wide = Observation(declared(log, barriers=[{**AVOIDANCE, "safety_distance": 0.8}]))
    wide.run(tmp_path)
    print_verdicts(wide, tmp_path, shown := console(80))
    assert "look at barriers.0.class_k.gain, barriers.0.class_k.power, barriers.0.safety_distance" in said(shown)
    assert "prior too small" not in said(shown)


def test_times_since_1970_count_from_the_first_sample(tmp_path: Path) -> None:
    stamped = read_csv(crossing(tmp_path, GoalTask(0.9), t0=1764211200.25))
    observation = Observation(declared(stamped, prior=SMALL_PRIOR))
    observation.run(tmp_path)
    print_verdicts(observation, tmp_path, shown := console(100))
    assert "t0 = 1764211200.25 s" in said(shown)
    assert said(shown).count("17642112") == 1
    assert json.loads((tmp_path / "regions.json").read_text())["robots"]["ann"]["events"][0]["t"] > 1.7e9
    assert (Clock.of(12.0).sentence(), Clock.of(12.0)(12.5)) == ([], "12.5 s")


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


# Truth, and what results are made from ------------------------------------------------------------------------------


def test_a_log_is_shown_in_a_line(log: Log) -> None:
    assert repr(log).startswith(f"Log({log.source!r}, bodies=['ann', 'bob'")
    assert f"times={len(log.t)}, t=0 to {log.t[-1]:.15g} s, with x, u)" in repr(log)


def test_the_truth_marks_and_changes_nothing(log: Log, tmp_path: Path) -> None:
    truth = {"ann": GOALS["ann"], "bob": [1.0, 1.0]}
    folders = {}
    for name, changes in (("without", {}), ("with", {"truth": truth})):
        folders[name] = tmp_path / name
        folders[name].mkdir()
        observation = Observation(declared(log, **changes))
        observation.run(folders[name])
    shown = Console(record=True, width=300, file=io.StringIO())
    print_verdicts(observation, folders["with"], shown)
    assert "The truth of bob is outside although the status is ok" in shown.export_text()
    assert [verdict.holds_truth for verdict in observation.verdicts()] == [True, False, None]
    for file in ("estimates.csv", "sets.csv", "motion.csv"):
        assert (folders["with"] / file).read_bytes() == (folders["without"] / file).read_bytes()
    marked = json.loads((folders["with"] / "regions.json").read_text())
    assert marked["robots"]["ann"].pop("truth") == {"theta": GOALS["ann"], "inside": True}
    assert marked["robots"]["bob"].pop("truth") == {"theta": [1.0, 1.0], "inside": False}
    assert marked == json.loads((folders["without"] / "regions.json").read_text())
    with pytest.raises(ConfigError, match=r"truth\.eve"):
        declared(log, truth={"eve": [0, 0]})
    with pytest.raises(ConfigError, match=r"truth\.ann: task 'goal' has 2 parameters, got 3"):
        declared(log, truth={"ann": [0, 0, 0]})


def test_a_second_run_says_what_it_replaces_and_leaves_nothing_stale(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, out = write_config(tmp_path / "config.yaml", RIGHT), tmp_path / "out"
    command = ["observe", str(path), "--config", str(config), "--out", str(out)]
    assert main([*command, "--set", "noise.velocity=auto"]) == 0
    assert "replaces" not in capsys.readouterr().out
    assert (out / "velocity_bound.json").exists()
    assert main(command) == 0
    assert f"{out}: replaces the 8 files of an earlier run" in capsys.readouterr().out.replace("\n", "")
    assert not (out / "velocity_bound.json").exists()
    made = json.loads((out / "regions.json").read_text())["made_from"]
    assert made["log"] == str(path)
    assert len(made["sha256"]) == 64
    assert made["torchfsid"]
