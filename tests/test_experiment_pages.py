"""Pages of experiments: a run with the truth, a sweep as tables. The browser looks at them in test_page."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jaxtyping
import pytest
from matplotlib.figure import Figure

from experiments.__main__ import main
from experiments.results import read_columns, read_json

CONFIGS = Path(__file__).parents[1] / "configs"

SWEEP = """
kind: sweep
title: A small sweep
seed: 5
repeats: 2
times: [0, 0.2]
experiment:
  kind: scene
  task: {kind: goal, gain: 1.0}
  barriers: [{kind: avoidance, distance: squared, safety_distance: 0.4, class_k: {gain: 2.0}}]
  team: {robots: [2, 2], obstacles: [1, 1], place: [circle], radius: 2.0, separation: 0.7}
  dt: 0.1
  duration: 0.4
  prior: {lower: [-4, -4], upper: [4, 4]}
  set: inverse_optimal
  noise: {velocity: 1.0e-6}
grid: {task.gain: [0.8, 1.2]}
"""


@pytest.fixture(autouse=True)
def _fast(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No figures, and no checks of shapes."""
    monkeypatch.setattr(Figure, "savefig", lambda figure, file, **options: Path(file).write_bytes(b"."))
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def record(page: Path) -> dict[str, Any]:
    """What the scripts of a page find."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(), re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def test_a_scene_has_a_page_with_the_truth(tmp_path: Path) -> None:
    short = ["--set", "duration=0.2", "--set", "snapshots=[0.1]", "--set", "expected=[]"]
    out = tmp_path / "out"
    assert main(["run", str(CONFIGS / "four_robots.yaml"), "--out", str(out), *short, "--report"]) == 0
    page, estimates = record(out / "report.html"), read_columns(out / "estimates.csv")
    assert page["samples"] == 11
    assert [robot["name"] for robot in page["robots"]] == ["east", "north", "west", "south"]
    assert page["robots"][0]["truth"] == [-1.27, 0.75]
    assert page["robots"][0]["told"] == [["truth outside its set", "at 0 of 11 samples"]]
    assert [body["name"] for body in page["motion"]["bodies"]] == ["east", "north", "west", "south"]
    for robot in page["robots"]:
        of_robot = estimates.where(robot=robot["name"])
        assert "".join(of_robot["case"]) == robot["case"]
    named = {page["names"][k] for body in page["motion"]["bodies"] for rows in body["active"] or [] for k in rows}
    assert named
    assert named <= {f"avoid {robot['name']}" for robot in page["robots"]}
    (out / "report.html").unlink()
    assert main(["report", str(out)]) == 0
    assert record(out / "report.html") == page


def test_a_sweep_has_a_page_of_tables(tmp_path: Path) -> None:
    config, out = tmp_path / "sweep.yaml", tmp_path / "out"
    config.write_text(SWEEP)
    assert main(["sweep", str(config), "--out", str(out), "--report"]) == 0
    page, summary = record(out / "report.html"), read_json(out / "summary.json")
    points, runs = page["tables"]
    assert [len(table["rows"]) for table in (points, runs)] == [2, 4]
    assert [row[0] for row in points["rows"]] == [point["point"][0] for point in summary["points"]]
    column = points["columns"].index("hybrid error, median")
    assert [row[column] for row in points["rows"]] == [point["hybrid_error"][1] for point in summary["points"]]
    assert "error" not in runs["columns"]  # none failed
    table = read_columns(out / "runs.csv")
    column = runs["columns"].index("inverse optimal lost")
    assert [row[column] for row in runs["rows"]] == table.numbers("inverse_optimal_lost").tolist()


def test_a_kind_without_a_page_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(CONFIGS / "swarm.yaml"), "--out", str(tmp_path / "out"), "--report"]) == 2
    assert "--report: results of the kind 'swarm' have no page, only figures" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
