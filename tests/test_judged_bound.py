"""A bound that a wrong model needs is called useless, and a right model's never is."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from tests.logs import write_config, write_log
from torchfsid.cli import main
from torchfsid.commands.declared_log import DeclaredLog, automatic_bound
from torchfsid.commands.figures import doubt_bound
from torchfsid.commands.functions import observe
from torchfsid.commands.judged_bound import USELESS, JudgedBound
from torchfsid.commands.page.content import content
from torchfsid.config.documents import validate
from torchfsid.config.observe import ObserveConfig
from torchfsid.logs.table_log import read_csv
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask

pytestmark = pytest.mark.usefixtures("undrawn")

RIGHT = {
    "task": {"kind": "goal", "gain": 0.9},
    "barriers": [
        {"kind": "avoidance", "safety_distance": 0.5, "class_k": {"gain": 1.5}, "neighbour_velocity": "current"}
    ],
    "prior": {"lower": [-5, -5], "upper": [5, 5]},
    "noise": {"velocity": "auto"},
    "ukf": False,
}
AVOIDANCE = RIGHT["barriers"][0]
WRONG = {
    "kind of task": {"task": {"kind": "velocity"}},
    "gain of the task": {"task": {"kind": "goal", "gain": 1.8}},
    "gain of the barrier": {"barriers": [{**AVOIDANCE, "class_k": {"gain": 15.0}}]},
    "neighbours' velocities": {"barriers": [{**AVOIDANCE, "neighbour_velocity": "none"}]},
    "no avoidance": {"barriers": [{"kind": "speed_box", "limit": [5, 5]}]},
}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three robots that cross, by one QP over all of them, and then stay at their goals."""
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3], [0.1, -2.0]], dtype=torch.float64)
    goals = torch.tensor([[2.0, 0.1], [-2.0, 0.0], [0.0, 2.0]], dtype=torch.float64)
    avoidance = CollisionAvoidance(ClassK(1.5), safety_distance=0.5, neighbour_velocity="current")
    run = simulate(CbfQpController(GoalTask(0.9), [avoidance]), goals, start, dt=0.15, steps=40)
    return write_log(tmp_path_factory.mktemp("log") / "log.csv", run, ["ann", "bob", "eve"])


def observed(log: Path, out: Path, changes: dict) -> dict:
    config = write_config(out.with_suffix(".yaml"), {**RIGHT, **changes})
    assert main(["observe", str(log), "--config", str(config), "--out", str(out)]) == 0
    return json.loads((out / "regions.json").read_text())


@pytest.mark.parametrize("wrong", WRONG)
def test_the_bound_that_a_wrong_model_needs_is_useless(log: Path, wrong: str) -> None:
    model = DeclaredLog(validate({**RIGHT, **WRONG[wrong]}, ObserveConfig, "test"), read_csv(log))
    smallest = model.smallest_bounds()
    assert model.judged(automatic_bound(smallest)).is_useless


def test_auto_does_not_end_with_a_bare_ok_on_a_wrong_model(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    regions = observed(log, tmp_path / "out", WRONG["neighbours' velocities"])
    said = capsys.readouterr().out
    assert said.count("ok (bound useless)") == 3
    assert "Warning:" in said
    assert "suspect barriers.0.neighbour_velocity: current instead of none" in said
    assert {region["status"] for region in regions["robots"].values()} == {"ok"}
    found = json.loads((tmp_path / "out" / "velocity_bound.json").read_text())
    assert regions["bound"]["useless"] is found["useless"] is True
    assert regions["bound"]["share"] == found["share"] == found["used"] / found["typical"] > USELESS
    assert main(["check", str(log), "--config", str(tmp_path / "out.yaml")]) == 0
    said = capsys.readouterr().out
    assert "is useless: it is" in said
    assert "consistent: no contradiction" not in said
    assert "at a useless bound that says nothing of the model" in said
    page = content(tmp_path / "out")
    assert page["useless"]
    assert all("is useless" in robot["meaning"] for robot in page["robots"])
    assert "ok (bound useless)" in repr(observe(log, config=tmp_path / "out.yaml"))


def test_a_figure_says_that_its_bound_is_useless(tmp_path: Path) -> None:
    judged = JudgedBound(0.5, 1.0, 2.0, "m/s")
    said = []
    for bound in ({"used": 0.5, **judged.to_json()}, {"used": 0.1, **replace(judged, bound=0.1).to_json()}):
        (tmp_path / "regions.json").write_text(json.dumps({"robots": {}, "bound": bound}))
        figure = Figure()
        doubt_bound(figure, tmp_path / "regions.json")
        said.append(figure.get_suptitle())
    assert said == ["The bound 0.5 m/s is useless: a wrong model explains the log as well", ""]


def test_a_bound_read_from_its_results_is_the_same() -> None:
    judged = JudgedBound(0.5, 1.0, 2.0, "m/s2", differences=0.25)
    assert JudgedBound.from_json({"used": judged.bound, **judged.to_json()}) == judged


def test_a_right_model_is_never_warned_of(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    regions = observed(log, tmp_path / "out", {})
    said = capsys.readouterr().out
    assert said.count("ok (bound less than 0.1 %)") == 3
    assert main(["check", str(log), "--config", str(tmp_path / "out.yaml")]) == 0
    assert "useless" not in said + capsys.readouterr().out
    assert regions["bound"]["useless"] is False
    assert regions["bound"]["share"] < 1e-6


def test_a_declared_bound_is_judged_too_and_asked_for_less(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    typical = observed(log, tmp_path / "sound", {"noise": {"velocity": 1e-3}})["bound"]["typical"]
    assert "ok (" not in (said := capsys.readouterr().out)
    assert "useless" not in said
    assert observed(log, tmp_path / "large", {"noise": {"velocity": 0.5 * typical}})["bound"]["useless"]
    said = capsys.readouterr().out
    assert said.count("ok (bound useless)") == 3
    assert "declare a smaller one, or auto" in said
    assert "suspect" not in said


def test_a_hypothesis_that_is_left_with_a_useless_bound_says_so(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = {**AVOIDANCE, "class_k": {"gain": 15.0, "power": [1, 3]}}
    config = write_config(tmp_path / "config.yaml", {**RIGHT, "barriers": [wrong]})
    out = tmp_path / "out"
    assert main(["observe", str(log), "--config", str(config), "--out", str(out)]) == 0
    verdicts = json.loads((out / "hypotheses.json").read_text())
    each = [verdict for of_robot in verdicts.values() for verdict in of_robot.values()]
    left = [verdict["refuted_at"] is None for verdict in each]
    assert any(left)
    assert [verdict["bound_useless"] for verdict in each] == left
    assert capsys.readouterr().out.count("possible (bound useless)") == sum(left)


def test_the_typical_control_is_the_median_over_the_way() -> None:
    """Robots that stand, and a sample that is far too large, do not move it."""
    sizes = np.concatenate([np.zeros(1000), np.full(100, 0.2), [0.4] * 40, [3.0]])
    judged = JudgedBound.of(0.05, sizes, "m/s2")
    assert (judged.typical, judged.largest, judged.share) == (0.2, 3.0, 0.25)
    assert not judged.is_useless
    assert JudgedBound.of(0.05, sizes[:-1]).typical == 0.2
    assert "25 % of the typical control seen, 0.2 m/s2" in judged.compared()
    standing = JudgedBound.of(0.1, np.zeros(5))
    assert math.isnan(standing.share)
    assert standing.cell("ok", is_found=True) == "ok (bound without motion)"
    assert not standing.is_useless
