"""`outliers: q` for `torchfsid observe`: a log with two gross errors, what is printed of them, and what is refused."""

import json
from pathlib import Path

import pytest
import torch

from tests.logs import write_config, write_log
from tests.test_config import observe, refusal
from torchfsid.cli import main
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask

CONFIG = {
    "task": {"kind": "goal", "gain": 0.9},
    "barriers": [{"kind": "avoidance", "safety_distance": 0.5, "class_k": {"gain": 1.5}}],
    "prior": {"lower": [-5, -5], "upper": [5, 5]},
    "noise": {"velocity": 1e-3},
    "ukf": False,
}
GOALS = {"ann": (2.0, 1.3), "bob": (-2.0, 0.0)}

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two robots that pass each other. Ann's velocity has two spikes of 1 m/s, while she is far from bob."""
    start = torch.tensor([[-2.0, 1.0], [2.0, 0.5]], dtype=torch.float64)
    goals = torch.tensor(list(GOALS.values()), dtype=torch.float64)
    controller = CbfQpController(GoalTask(0.9), [CollisionAvoidance(ClassK(1.5), safety_distance=0.5)])
    run = simulate(controller, goals, start, dt=0.1, steps=40)
    errors = torch.zeros_like(run.u)
    errors[2, 0, 1], errors[38, 0, 0] = 1.0, -1.0
    return write_log(tmp_path_factory.mktemp("log") / "log.csv", run, list(GOALS), errors)


def observed(log: Path, folder: Path, config: dict) -> dict:
    out = folder / "out"
    path = write_config(folder / "config.yaml", config)
    assert main(["observe", str(log), "--config", str(path), "--out", str(out)]) == 0
    return json.loads((out / "regions.json").read_text())["robots"] if (out / "regions.json").is_file() else {}


def test_the_samples_set_aside_are_named(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    regions = observed(log, tmp_path, CONFIG | {"outliers": 2})
    said = " ".join(capsys.readouterr().out.split())
    assert "outliers: 2: a set holds the truth if at most 2 of its robot's samples are outliers" in said
    assert "ok, 2 set aside" in said
    assert "ann: set aside: 0.2 s (nominal control), 3.8 s (nominal control)" in said
    assert "bob:" not in said
    assert "More than half of noise" not in said
    entry = regions["ann"]["outliers"]
    assert (entry["q"], entry["at_least"]) == (2, 2)
    assert [(round(sample["t"], 9), sample["certain"]) for sample in entry["set_aside"]] == [(0.2, True), (3.8, True)]
    assert regions["bob"]["outliers"] == {"q": 2, "at_least": 0, "set_aside": []}
    for robot, region in regions.items():
        assert region["status"] == "ok"
        assert region["diameter"] < 0.01
        assert all(
            a[0] * GOALS[robot][0] + a[1] * GOALS[robot][1] <= b + 1e-9
            for a, b in zip(region["A"], region["b"], strict=True)
        )


@pytest.mark.parametrize("outliers", [0, 1])
def test_with_fewer_the_run_is_inconsistent(log: Path, tmp_path: Path, outliers: int) -> None:
    regions = observed(log, tmp_path, CONFIG | {"outliers": outliers})
    assert regions["ann"]["status"] == "inconsistent"
    assert ("outliers" in regions["ann"]) == (outliers > 0)
    assert regions["bob"]["status"] == "ok"


def test_hypotheses_say_what_they_leave_unexplained(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models = {key: value for key, value in CONFIG.items() if key != "task"}
    tasks = [{"task": CONFIG["task"]}, {"task": {"kind": "velocity"}}]
    observed(log, tmp_path, models | {"tasks": tasks, "outliers": 2})
    said = " ".join(capsys.readouterr().out.split())
    assert "ann: set aside: 0.2 s (nominal control), 3.8 s (nominal control)" in said
    verdicts = json.loads((tmp_path / "out" / "hypotheses.json").read_text())
    assert verdicts["ann"]["goal"]["refuted_at"] is None
    assert verdicts["ann"]["velocity"]["refuted_at"] is not None


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("on_inconsistent=reset", "outliers: a change of goal would count as an outlier"),
        ("barriers.0.class_k.gain=[1, 200]", "outliers: expected 0 with an unknown gain or distance of a barrier"),
        ("task.gain=[0.1, 0.2]", "outliers: expected 0 with an unknown task.gain"),
        ("velocity=windows", "outliers: a wrong position spoils all windows that hold it"),
        ("noise.velocity=auto", "noise: auto takes an outlier for noise"),
    ],
)
def test_what_outliers_do_not_go_with(override: str, expected: str) -> None:
    assert expected in refusal(lambda: observe(override, "outliers=1"))
