"""A verdict one can act on: tables that fit, contradictions by name and key, truth."""

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from tests.logs import write_config
from tests.verdicts import AVOIDANCE, GOALS, RIGHT, console, crossing, declared, said
from torchfsid.cli import main
from torchfsid.commands.check import check
from torchfsid.commands.clock import Clock
from torchfsid.commands.fitted_table import Column, fitted_table
from torchfsid.commands.hypotheses import Hypotheses
from torchfsid.commands.observe import Observation
from torchfsid.commands.report import print_verdicts
from torchfsid.commands.report_check import print_check
from torchfsid.commands.report_hypotheses import print_hypotheses
from torchfsid.errors import ConfigError
from torchfsid.logs.log import Log
from torchfsid.logs.table_log import read_csv
from torchfsid.robots.tasks import GoalTask

pytestmark = pytest.mark.usefixtures("undrawn")

WIDTHS = (60, 80, 100, 150)
SMALL_PRIOR = {"lower": [-1, -1], "upper": [1, 1]}


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return crossing(tmp_path_factory.mktemp("log"), GoalTask(0.9))


@pytest.fixture(scope="module")
def log(path: Path) -> Log:
    return read_csv(path)


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
