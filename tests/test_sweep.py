"""Sweeps: the same tables however they were run and interrupted, what they are made of, and what they refuse."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jaxtyping
import numpy as np
import pytest
from distributed import LocalCluster
from rich.console import Console

from experiments.__main__ import main
from experiments.kinds import load
from experiments.results import Journal
from experiments.sweeps.config import SweepConfig
from experiments.sweeps.sweep import run_sweep
from experiments.sweeps.swept import print_sweep, read_table, summarise_sweep
from experiments.sweeps.workers import WorkersError, workers
from torchfsid.commands.results_folder import ResultsFolder
from torchfsid.config.documents import dump
from torchfsid.errors import ConfigError, FigureError

ROOT = Path(__file__).parents[1]
TABLES = ("runs.csv", "runs.parquet", "series.csv", "series.parquet")
RUNS = 10

CONFIG = """
kind: sweep
title: Tiny
seed: 5
repeats: 5
times: [0, 0.2, 0.3]
experiment:
  kind: scene
  task: {kind: goal, gain: 1}
  barriers: [{kind: avoidance, safety_distance: 0.4, class_k: {gain: 2}}]
  team: {robots: [2, 3], obstacles: [0, 1], place: [disc, circle], radius: 1.5, separation: 0.6}
  measurement_noise: {shape: adversarial}
  dt: 0.1
  duration: 0.3
  prior: {lower: [-4, -4], upper: [4, 4]}
  set: inverse_optimal
  noise: {velocity: 0}
draw: {task.gain: [0.6, 1.6]}
grid:
  measurement_noise.velocity, noise.velocity: [[1.0e-3, 1.1e-3], [1.0e-2, 1.1e-2]]
"""


@pytest.fixture(scope="module", autouse=True)
def _shapes_are_checked_elsewhere() -> Iterator[None]:
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("config") / "tiny.yaml"
    path.write_text(CONFIG, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def uninterrupted(config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("uninterrupted")
    run_sweep(load_sweep(config), out, untracked)
    return out


def untracked(records: Iterable[Any], *_: Any) -> Iterable[Any]:
    return records


def load_sweep(path: Path, *overrides: str) -> SweepConfig:
    config = load(path, overrides, "sweep")
    assert isinstance(config, SweepConfig)
    return config


def assert_same_tables(out: Path, other: Path) -> None:
    for name in TABLES:
        assert (out / name).read_bytes() == (other / name).read_bytes(), name


# However it is run --------------------------------------------------------------------------------------------------


def start(config: Path, out: Path, jobs: int) -> subprocess.Popen:
    command = [sys.executable, "-m", "experiments", "sweep", str(config), "--out", str(out), "--jobs", str(jobs)]
    return subprocess.Popen(command, cwd=ROOT, start_new_session=True, stderr=subprocess.DEVNULL)


def finished(out: Path) -> int:
    path = out / "records.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def kill_after(process: subprocess.Popen, out: Path, runs: int) -> None:
    while finished(out) < runs and process.poll() is None:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL


def test_killed_twice_and_resumed_is_the_uninterrupted_sweep(config: Path, uninterrupted: Path, tmp_path: Path):
    kill_after(start(config, tmp_path, jobs=1), tmp_path, runs=2)
    first = (tmp_path / "records.jsonl").read_bytes().splitlines()[:2]
    kill_after(start(config, tmp_path, jobs=2), tmp_path, runs=finished(tmp_path) + 1)
    assert 3 <= finished(tmp_path) < RUNS
    with (tmp_path / "records.jsonl").open("ab") as journal:
        journal.write(b'{"run": 9, "error": "", "row": {"rob')  # a line that a kill has cut
    run_sweep(load_sweep(config), tmp_path, untracked)
    records = (tmp_path / "records.jsonl").read_bytes().splitlines()
    assert records[:2] == first
    assert sorted(json.loads(line)["run"] for line in records) == list(range(RUNS))
    assert_same_tables(tmp_path, uninterrupted)


def test_a_part_that_was_interrupted_is_run_again_and_keeps_its_records(
    config: Path, uninterrupted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("experiments.sweeps.sweep.PARTS", 2)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    for out in (whole, broken):
        out.mkdir()
    run_sweep(load_sweep(config), whole, untracked)
    lines = (whole / "records.jsonl").read_bytes().splitlines(keepends=True)
    (broken / "records.jsonl").write_bytes(b"".join(lines[:2]))
    run_sweep(load_sweep(config), broken, untracked)
    resumed = (broken / "records.jsonl").read_bytes().splitlines(keepends=True)
    assert resumed[:2] == lines[:2]
    assert sorted(json.loads(line)["run"] for line in resumed) == list(range(RUNS))
    assert_same_tables(whole, broken)
    alone, together = (read_table(out / "runs.parquet") for out in (uninterrupted, whole))
    assert list(alone) == list(together)


def test_a_dask_cluster_gives_the_same(config: Path, uninterrupted: Path, tmp_path: Path):
    # Workers in threads, reached over TCP: starting processes would take longer than the sweep.
    local = {"processes": False, "protocol": "tcp://", "dashboard_address": None}
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, **local) as cluster,
        workers(dask=cluster.scheduler_address) as team,
    ):
        run_sweep(load_sweep(config), tmp_path, untracked, team)
    assert_same_tables(tmp_path, uninterrupted)


def test_a_dask_cluster_that_dies_is_one_error(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("experiments.sweeps.workers.DASK_TIMEOUT", 0.5)
    local = {"processes": False, "protocol": "tcp://", "dashboard_address": None}
    cluster = LocalCluster(n_workers=1, threads_per_worker=1, **local)

    def until_it_dies(records: Iterable[Any], *_: Any) -> Iterable[Any]:
        for record in records:
            yield record
            cluster.close()

    with pytest.raises(WorkersError, match="goes on from here"), workers(dask=cluster.scheduler_address) as team:
        run_sweep(load_sweep(config), tmp_path, until_it_dies, team)
    assert 1 <= finished(tmp_path) < RUNS
    assert len(read_table(tmp_path / "runs.parquet")["run"]) == finished(tmp_path)


def test_nothing_is_run_again_and_figures_are_drawn_from_the_tables(config: Path, uninterrupted: Path, tmp_path: Path):
    out = tmp_path / "out"
    out.mkdir()
    shutil.copy(uninterrupted / "records.jsonl", out)
    journal = (out / "records.jsonl").read_bytes()
    assert main(["sweep", str(config), "--out", str(out)]) == 0
    assert (out / "records.jsonl").read_bytes() == journal
    assert_same_tables(out, uninterrupted)
    drawn = {name: (out / name).read_bytes() for name in ("figure.png", "figure.pdf")}
    for name in drawn:
        (out / name).unlink()
    assert main(["figures", str(out)]) == 0
    assert {name: (out / name).read_bytes() for name in drawn} == drawn


def test_other_configs_and_other_processes_are_kept_out(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out, small = tmp_path / "out", ("--set", "repeats=1")
    assert main(["sweep", str(config), "--out", str(out), *small]) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    capsys.readouterr()
    assert main(["sweep", str(config), "--out", str(out), *small, "--set", "seed=6"]) == 2
    assert "holds another sweep" in capsys.readouterr().err
    assert main(["run", str(ROOT / "configs" / "two_pairs.yaml"), "--out", str(out)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    folder = ResultsFolder(out, None)
    folder.claim([], resume=True)
    assert main(["sweep", str(config), "--out", str(out), *small]) == 2
    assert main(["figures", str(out)]) == 2
    folder.release()
    assert capsys.readouterr().err.count("another command is writing there") == 2
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert main(["sweep", str(config), "--out", str(tmp_path / "new"), "--dask", "nonsense://"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_a_sweep_leaves_the_folder_of_a_run_alone(config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "config.yaml").write_text("kind: scene\n", encoding="utf-8")
    assert main(["sweep", str(config), "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]


def test_the_journal_keeps_every_whole_line(tmp_path: Path):
    path = tmp_path / "records.jsonl"
    with Journal(path) as journal:
        journal.add([{"run": 3, "row": {"a": 1}}])
        journal.add([{"run": 1, "row": {"a": 2}}])
    whole = path.read_bytes()
    for broken in (b"", b"{", b'{"run": 2, "row": {}}', b"\0\0\0"):
        path.write_bytes(whole + broken)
        with Journal(path) as journal:
            assert journal.records.keys() == {1, 3}
            assert path.read_bytes() == whole
    path.write_bytes(b"\0\0\n" + whole)
    with Journal(path) as journal:
        journal.add([{"run": 0, "row": {}}])
    with Journal(path) as journal:
        assert journal.records.keys() == {0, 1, 3}


# What it is made of -------------------------------------------------------------------------------------------------


def test_rows_say_what_was_run(config: Path, uninterrupted: Path):
    tiny = load_sweep(config)
    runs, series = (read_table(uninterrupted / f"{name}.parquet") for name in ("runs", "series"))
    assert runs["run"].tolist() == list(range(RUNS))
    for run in range(RUNS):
        scene = tiny.scene(run)
        assert scene.noise.velocity == runs["noise.velocity"][run] == tiny.point(run)["noise.velocity"]
        assert scene.task.gain == runs["task.gain"][run]
        assert len(scene.robots) == runs["robots"][run]
        assert set(series["t"][series["run"] == run].tolist()) == set(tiny.times)
    assert len({scene.seed for scene in map(tiny.scene, range(RUNS))}) == RUNS
    assert (series["inverse_optimal_lost"] == 0).all()
    shares = np.sum([runs[f"case_{letter}"] for letter in "ABCDE"], axis=0)
    np.testing.assert_allclose(shares, 1, atol=1e-5)


def test_a_failed_run_is_a_row_and_not_the_end(config: Path, tmp_path: Path):
    crowded = "experiment.team={robots: [1, 6], place: [disc], radius: 0.6, separation: 0.6}"
    summary = run_sweep(load_sweep(config, crowded, "seed=2"), tmp_path, untracked)
    runs = read_table(tmp_path / "runs.parquet")
    failed = runs["error"] != ""
    assert 0 < failed.sum() < RUNS
    assert all("no room" in error for error in runs["error"][failed])
    assert summary["failed"] == failed.sum()


def test_keys_with_dots_can_be_set(config: Path):
    grid = "grid.measurement_noise.velocity,noise.velocity=[[0.01, 0.02]]"
    changed = load_sweep(config, "draw.task.gain=[1, 2]", grid, "grid.task.kind=[goal]")
    assert changed.draw == {"task.gain": (1.0, 2.0)}
    assert changed.grid == {"measurement_noise.velocity, noise.velocity": [[0.01, 0.02]], "task.kind": ["goal"]}


def test_an_interrupted_sweep_is_drawn_with_a_gap(config: Path, uninterrupted: Path, tmp_path: Path):
    """Runs of the first point of the grid only."""
    lines = (uninterrupted / "records.jsonl").read_bytes().splitlines(keepends=True)
    (tmp_path / "records.jsonl").write_bytes(b"".join(line for line in lines if json.loads(line)["run"] < 5))
    (tmp_path / "config.yaml").write_text(dump(load_sweep(config)), encoding="utf-8")
    with pytest.raises(KeyboardInterrupt):
        run_sweep(load_sweep(config), tmp_path, interrupted)
    assert main(["figures", str(tmp_path)]) == 0
    summary = summarise_sweep(tmp_path, load_sweep(config))
    assert [point["runs"] for point in summary["points"]] == [5, 0]
    print_sweep(summary, Console(file=io.StringIO()))


def interrupted(records: Iterable[Any], *_: Any) -> Iterable[Any]:
    raise KeyboardInterrupt


def test_a_sweep_in_which_every_run_fails_says_so(config: Path, tmp_path: Path):
    sweep = load_sweep(config)
    crowded = {"robots": [9, 9], "place": ["disc"], "radius": 0.6, "separation": 0.6}
    failing = sweep.model_copy(update={"experiment": {**sweep.experiment, "team": crowded}})
    with pytest.raises(FigureError, match="every run failed, as with: team: no room"):
        run_sweep(failing, tmp_path, untracked)
    assert (tmp_path / "runs.csv").exists()


# What it refuses ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("kind=scene", "kind"),
        ("repeats=0", "repeats"),
        ("times=[0.2, 0.1]", "times"),
        ("times=[0.2, 0.9]", "times"),
        ("grid={nois.velocity: [1]}", "nois"),
        ("grid={noise.velocity: []}", "grid.noise.velocity"),
        ("grid={noise.velocity: [0.1, -0.1]}", "noise.velocity"),
        ('grid={"noise.velocity, noise.slack": [[0.1]]}', "grid.noise.velocity, noise.slack[0]"),
        ("grid={task.gain: [1, 2]}", "grid, draw"),
        ("draw={task.gain: [2, 1]}", "draw.task.gain"),
        ("experiment.seed=1", "experiment.seed"),
        ("experiment.robots=[]", "experiment.robots"),
        ("experiment.team.robots=[3, 2]", "team.robots"),
        ("experiment.team.separation=9", "team"),
        ("experiment.prior.upper=[4]", "prior"),
        ("repeats=1000000", "repeats, grid"),
    ],
)
def test_wrong_config_is_one_line_and_exit_code_2(
    override: str, named: str, config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["sweep", str(config), "--out", str(tmp_path / "out"), "--set", override]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert f": {named}: " in message
    assert not (tmp_path / "out").exists()


def test_the_committed_sweep_is_one():
    assert load_sweep(ROOT / "configs" / "monte_carlo.yaml").runs == 1000
    with pytest.raises(ConfigError, match="kind"):
        load_sweep(ROOT / "configs" / "two_pairs.yaml")
