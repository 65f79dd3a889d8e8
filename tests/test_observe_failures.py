"""Whatever goes wrong beside the sets: they are inferred to the end, and what was written is whole."""

import csv
import errno
import json
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
import yaml
from matplotlib.figure import Figure

from tests.logs import write_config, write_log
from torchfsid.cli import main
from torchfsid.commands import results
from torchfsid.commands.results_folder import ResultsFolder
from torchfsid.observers.set_membership import SetEstimates, SetMembershipObserver
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask

SAMPLES = 13
CONFIG = {
    "task": {"kind": "goal", "gain": 0.9},
    "barriers": [{"kind": "avoidance", "safety_distance": 0.5, "class_k": {"gain": 1.5}}],
    "prior": {"lower": [-5, -5], "upper": [5, 5]},
    "noise": {"velocity": 1e-3},
    "ukf": False,
}
TASKS = {
    **{key: value for key, value in CONFIG.items() if key != "task"},
    "tasks": [{"task": CONFIG["task"]}, {"task": {"kind": "velocity"}}],
}

Observe = Callable[..., int]

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two robots that swap places."""
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3]], dtype=torch.float64)
    controller = CbfQpController(GoalTask(0.9), [CollisionAvoidance(ClassK(1.5), safety_distance=0.5)])
    run = simulate(controller, start.flip(0), start, dt=0.1, steps=SAMPLES - 1)
    return write_log(tmp_path_factory.mktemp("log") / "log.csv", run, ["ann", "bob"])


@pytest.fixture
def observe(log: Path, tmp_path: Path) -> Observe:
    """`torchfsid observe` into the folder `out`."""

    def call(config: dict = CONFIG, *overrides: str) -> int:
        path = write_config(tmp_path / "config.yaml", config)
        options = [option for override in overrides for option in ("--set", override)]
        return main(["observe", str(log), "--config", str(path), "--out", str(tmp_path / "out"), *options])

    return call


def rows_of(out: Path) -> list[dict[str, str]]:
    """The rows of estimates.csv, which ends with a whole line."""
    assert (out / "estimates.csv").read_bytes().endswith(b"\n")
    rows = list(csv.DictReader((out / "estimates.csv").open()))
    assert all(None not in row and None not in row.values() for row in rows)
    return rows


def goals_are_inside(out: Path) -> bool:
    regions = json.loads((out / "regions.json").read_text())["robots"]
    goals = {"ann": (2.0, 0.3), "bob": (-2.0, 0.0)}
    return all(
        a[0] * goals[robot][0] + a[1] * goals[robot][1] <= b + 1e-9
        for robot, region in regions.items()
        for a, b in zip(region["A"], region["b"], strict=True)
    )


def last_line(capsys: pytest.CaptureFixture[str]) -> str:
    return capsys.readouterr().err.splitlines()[-1]


def test_without_a_filter_the_sets_are_the_same_and_its_columns_empty(observe: Observe, tmp_path: Path) -> None:
    assert observe(CONFIG, "ukf={}") == 0
    with_filter = rows_of(tmp_path / "out")
    regions = (tmp_path / "out" / "regions.json").read_bytes()
    assert observe() == 0
    without = rows_of(tmp_path / "out")
    assert (tmp_path / "out" / "regions.json").read_bytes() == regions
    columns = ["ukf_0", "ukf_1", "hybrid_0", "hybrid_1"]
    assert all(row[column] != "" for row in with_filter for column in columns)
    assert without == [{**row, **dict.fromkeys(columns, "")} for row in with_filter]
    assert yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())["ukf"] is False


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_whole_samples_and_the_sets_so_far(
    observe: Observe, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """A second one while the sets are written changes nothing."""
    read, regions, seen = SetMembershipObserver.read, results.regions, []

    def interrupted(self: SetMembershipObserver, samples: Measurement) -> Iterator[SetEstimates]:
        seen.append(samples)
        if len(seen) == 3:
            signal.raise_signal(number)
        return read(self, samples)

    def asked_again(*arguments) -> dict:
        signal.raise_signal(signal.SIGINT)
        return regions(*arguments)

    monkeypatch.setattr("torchfsid.commands.observe.BLOCK", 3)
    monkeypatch.setattr(SetMembershipObserver, "read", interrupted)
    monkeypatch.setattr(results, "regions", asked_again)
    assert observe() == 128 + number
    assert last_line(capsys).endswith(f"; what is done so far is in {tmp_path / 'out'}")
    assert len(rows_of(tmp_path / "out")) == 2 * 6
    assert goals_are_inside(tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        ".torchfsid",
        "config.yaml",
        "estimates.csv",
        "motion.csv",
        "regions.json",
        "sets.csv",
    }


def test_a_signal_while_the_sets_are_written_waits(
    observe: Observe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    regions = results.regions

    def interrupted(*arguments) -> dict:
        signal.raise_signal(signal.SIGTERM)
        return regions(*arguments)

    monkeypatch.setattr(results, "regions", interrupted)
    assert observe() == 143
    assert len(rows_of(tmp_path / "out")) == 2 * SAMPLES
    assert goals_are_inside(tmp_path / "out")


class Disk:
    """A file on a disk that is full after so many bytes, or after which somebody ends the command."""

    def __init__(self, file, room: int, ended: bool):
        self.file, self.room, self.ended = file, room, ended

    def __getattr__(self, name: str):
        return getattr(self.file, name)

    def write(self, content: bytes) -> int:
        if self.room == 0 and self.ended:
            signal.raise_signal(signal.SIGTERM)
        if self.room == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written = self.file.write(content[: self.room])
        self.room -= written
        return written


@pytest.mark.parametrize("ended", [False, True], ids=["a full disk", "a signal"])
def test_a_table_that_breaks_off_in_a_line_loses_that_sample_and_not_the_sets(
    observe: Observe, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, ended: bool
) -> None:
    enter = results.ResultsWriter.__enter__

    def on_a_small_disk(self: results.ResultsWriter) -> results.ResultsWriter:
        self = enter(self)
        self._estimates._file = Disk(self._estimates._file, 700, ended)
        return self

    monkeypatch.setattr(results.ResultsWriter, "__enter__", on_a_small_disk)
    assert observe() == (143 if ended else 1)
    captured, out = capsys.readouterr(), tmp_path / "out"
    if not ended:
        assert captured.err.splitlines()[-1] == f"torchfsid: {out / 'estimates.csv'}: No space left on device"
        assert "bob" in captured.out  # the table of what was found
    assert 0 < len(rows_of(out)) < 2 * SAMPLES
    assert len(rows_of(out)) % 2 == 0
    assert goals_are_inside(out)


def test_a_figure_that_fails_is_the_last_thing_said(
    observe: Observe, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments, **options) -> None:
        raise RuntimeError("no renderer")

    monkeypatch.setattr(Figure, "savefig", fail)
    assert observe() == 1
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-1] == f"torchfsid: {tmp_path / 'out' / 'regions.png'}: not drawn: no renderer"
    assert "bob" in captured.out
    assert "regions.png" not in captured.out
    assert len(rows_of(tmp_path / "out")) == 2 * SAMPLES
    assert goals_are_inside(tmp_path / "out")


def test_only_what_this_run_drew_is_listed(
    observe: Observe, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder stands where the figure of an earlier run was. In a second run nothing can be drawn at all."""
    out = tmp_path / "out"
    assert observe() == 0
    assert "regions.png" in capsys.readouterr().out
    (out / "regions.png").unlink()
    (out / "regions.png").mkdir()
    assert observe() == 1
    assert "regions.png" not in capsys.readouterr().out
    (out / "regions.png").rmdir()
    assert observe() == 0
    capsys.readouterr()
    monkeypatch.setattr(Figure, "savefig", lambda *arguments, **options: 1 / 0)
    assert observe() == 1
    assert "regions.p" not in capsys.readouterr().out


def test_sets_of_which_sizes_are_not_known_are_written(
    observe: Observe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """NaN is an empty cell, null, and a dash."""
    from torchfsid.sets.feasible_set import FeasibleSet

    centroid = FeasibleSet.centroid
    monkeypatch.setattr(FeasibleSet, "centroid", lambda self: torch.full_like(centroid(self), torch.nan))
    monkeypatch.setattr(FeasibleSet, "diameter", lambda self: torch.full_like(centroid(self)[..., 0], torch.inf))
    assert observe() == 0
    assert {row["centroid_0"] + row["diameter"] for row in rows_of(tmp_path / "out")} == {""}
    regions = json.loads((tmp_path / "out" / "regions.json").read_text())["robots"]
    assert [(region["centroid"], region["diameter"]) for region in regions.values()] == [([None, None], None)] * 2
    assert "(-, -)" in capsys.readouterr().out


def test_a_folder_that_is_written_to_is_left_alone(
    observe: Observe, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = ResultsFolder(tmp_path / "out", "observe")
    other.claim([])
    assert observe() == 2
    assert last_line(capsys) == f"torchfsid: {tmp_path / 'out'}: another command is writing there"
    assert not (tmp_path / "out" / "estimates.csv").exists()
    other.release()
    assert observe() == 0


def test_a_folder_of_a_sweep_is_refused(observe: Observe, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "config.yaml").write_text("kind: sweep\n")
    assert observe() == 2
    assert "holds the results of 'sweep'" in last_line(capsys)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["config.yaml"]


def test_runs_do_not_mix(observe: Observe, tmp_path: Path, log: Path) -> None:
    """Hypotheses, then fewer of them, then one model: each run leaves its own files only. Each can be repeated."""
    out = tmp_path / "out"
    assert observe(TASKS) == 0
    of_goal = (out / "goal" / "regions.json").read_bytes()
    assert (out / "velocity" / "estimates.csv").exists()
    again = tmp_path / "again"
    assert main(["observe", str(log), "--config", str(out / "config.yaml"), "--out", str(again)]) == 0
    assert (again / "hypotheses.json").read_bytes() == (out / "hypotheses.json").read_bytes()
    assert (again / "config.yaml").read_bytes() == (out / "config.yaml").read_bytes()
    assert observe({**TASKS, "tasks": [TASKS["tasks"][0], {"name": "x", "task": {"kind": "velocity"}}]}) == 0
    assert not (out / "velocity").exists()
    assert (out / "goal" / "regions.json").read_bytes() == of_goal
    assert observe() == 0
    tables = {"estimates.csv", "sets.csv", "motion.csv", "regions.json"}
    names = {"config.yaml", *tables, "regions.png", "regions.pdf", ".torchfsid"}
    assert {path.name for path in out.iterdir()} == names


def test_raising_on_an_inconsistent_set_is_a_failure_after_the_fact(
    observe: Observe, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert observe(CONFIG, "on_inconsistent=raise", "prior={lower: [3, 3], upper: [4, 4]}") == 1
    assert last_line(capsys) == (
        "torchfsid: robot 'ann' at 0 s: no parameter explains the measurements; "
        "these contradict each other: avoid bob at 0 s, prior"
    )
    regions = json.loads((tmp_path / "out" / "regions.json").read_text())["robots"]
    assert regions["ann"]["status"] == "inconsistent"
