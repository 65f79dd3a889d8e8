"""The commands on logs of robots whose safety parameters, or whose task's gain, nobody tells."""

import csv
import json
import math
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from tests.logs import bounded_errors, write_config, write_log
from torchfsid.cli import main
from torchfsid.commands.check_safety import check_safety
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.safety_figure import draw_safety
from torchfsid.commands.terminal import ends
from torchfsid.config.documents import validate
from torchfsid.config.models import dump_models, load_models
from torchfsid.config.observe import ObserveConfig
from torchfsid.errors import ConfigError, FigureError
from torchfsid.logs.table_log import read_csv
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask

GOALS = {"ann": (2.0, 0.1), "bob": (-2.0, 0.0), "cat": (0.1, 2.0)}
GAIN, DISTANCE, KP = 1.5, 0.5, 0.9
BODIES = list(GOALS)
AVOIDANCE = {"kind": "avoidance", "safety_distance": [0.2, 1.0], "class_k": {"gain": [0.1, 20]}}
CONFIG = {
    "task": {"kind": "goal", "gain": KP},
    "barriers": [AVOIDANCE],
    "prior": {"lower": [-5, -5], "upper": [5, 5]},
    "noise": {"velocity": 0.01},
    "ukf": False,
}


@pytest.fixture(scope="module")
def run() -> Trajectory:
    """Three robots cross."""
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3], [0.0, -2.0]], dtype=torch.float64)
    goals = torch.tensor(list(GOALS.values()), dtype=torch.float64)
    controller = CbfQpController(GoalTask(KP), [CollisionAvoidance(ClassK(GAIN), safety_distance=DISTANCE)])
    return simulate(controller, goals, start, dt=0.1, steps=50)


@pytest.fixture(scope="module")
def log(run: Trajectory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "log.csv", run, BODIES, bounded_errors(run, 3, 0.002, 0))


def observe(log: Path, tmp_path: Path, config: dict) -> Path:
    out = tmp_path / "out"
    file = write_config(tmp_path / "config.yaml", config)
    assert main(["observe", str(log), "--config", str(file), "--out", str(out)]) == 0
    return out


def test_observe_learns_gain_and_distance_beside_the_goals(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = observe(log, tmp_path, CONFIG)
    found = json.loads((out / "regions.json").read_text())
    team = found["safety"]
    low, high = team["gain"]
    assert GAIN - 0.2 < low <= GAIN <= high < GAIN + 0.2
    low, high = team["safety_distance"]
    assert DISTANCE - 0.05 < low <= DISTANCE <= high < DISTANCE + 0.05
    assert team["bounded_by_data"] == {"gain": [True, True], "safety_distance": [True, True]}
    psi = torch.tensor([GAIN, GAIN * DISTANCE**2], dtype=torch.float64)
    assert bool((torch.tensor(team["A"]) @ psi.float() <= torch.tensor(team["b"]) + 1e-6).all())
    for r, slow, fast in team["approach_speed"]:
        assert slow - 1e-9 <= GAIN / 2 * (r - DISTANCE**2 / r) <= fast + 1e-9
    assert all(facet is None or facet["robot"] in BODIES for facet in team["facets"])
    assert found["refutations"] == [] and found["odd"] == []  # noqa: PT018
    for robot, goal in GOALS.items():
        region = found["robots"][robot]
        assert region["status"] == "ok"
        assert region["safety"] == team
        inside = torch.tensor(region["A"]) @ torch.tensor(goal) <= torch.tensor(region["b"]) + 1e-5
        assert bool(inside.all())
    with (out / "estimates.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["robot"] == "ann"]
    widths = [math.log(float(row["gain_high"]) / float(row["gain_low"])) for row in rows]
    assert all(after <= before + 1e-12 for before, after in pairwise(widths))
    assert float(rows[0]["distance_high"]) <= 1.0
    assert (out / "safety.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    assert "the team" in printed and "safety distance [m]" in printed  # noqa: PT018


def test_a_robot_of_its_own_kind_is_named_and_does_not_silence_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3], [0.0, -2.0], [0.2, 2.2]], dtype=torch.float64)
    goals = torch.tensor([[2.0, 0.1], [-2.0, 0.0], [0.1, 2.0], [-0.1, -2.0]], dtype=torch.float64)
    gains = torch.tensor([1.5, 1.5, 1.5, 4.0], dtype=torch.float64).unsqueeze(-1)
    barrier = CollisionAvoidance(ClassK(gains), safety_distance=DISTANCE)
    run = simulate(CbfQpController(GoalTask(KP), [barrier]), goals, start, dt=0.1, steps=50)
    log = write_log(tmp_path / "log.csv", run, ["a", "b", "c", "d"])
    found = json.loads((observe(log, tmp_path, CONFIG) / "regions.json").read_text())
    assert "safety" not in found
    assert found["odd"] == ["d"]
    assert found["refutations"][0]["robot"] is None
    for robot, gain in zip("abcd", gains.flatten().tolist(), strict=True):
        region = found["robots"][robot]
        assert region["status"] == "ok"
        low, high = region["safety"]["gain"]
        assert low <= gain <= high
        assert {facet["robot"] for facet in region["safety"]["facets"] if facet is not None} == {robot}
    printed = capsys.readouterr().out
    assert "the team has no safety parameters in common" in printed
    assert "without d the others can have the same parameters" in printed


@pytest.mark.usefixtures("undrawn")
def test_forms_of_a_barrier_are_hypotheses_and_the_run_repeats(log: Path, tmp_path: Path) -> None:
    forms = {**AVOIDANCE, "distance": ["squared", "euclidean"], "neighbour_velocity": "auto"}
    out = observe(log, tmp_path, {**CONFIG, "barriers": [forms]})
    verdicts = json.loads((out / "hypotheses.json").read_text())
    assert set(verdicts["ann"]) == {
        f"{distance}.{share}" for distance in ("squared", "euclidean") for share in ("none", "current", "previous")
    }
    for of_robot in verdicts.values():
        assert of_robot["squared.none"]["refuted_at"] is None
    models = load_models(out / "config.yaml")
    assert dump_models(models) == (out / "config.yaml").read_text()


@pytest.mark.usefixtures("undrawn")
def test_an_unknown_gain_of_the_task_is_narrowed(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = {**CONFIG, "task": {"kind": "goal", "gain": [0.3, 3.0]}}
    out = observe(log, tmp_path, config)
    found = json.loads((out / "task_gain.json").read_text())
    assert 0.9 * KP < found["found"][0] <= KP <= found["found"][1] < 1.1 * KP
    assert found["bounded_by_data"] == [True, True]
    regions = json.loads((out / "regions.json").read_text())["robots"]
    for robot, goal in GOALS.items():
        inside = torch.tensor(regions[robot]["A"]) @ torch.tensor(goal) <= torch.tensor(regions[robot]["b"]) + 1e-5
        assert bool(inside.all())
    assert "task.gain: " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("gain", "distance", "verdict"),
    [(GAIN, DISTANCE, "possible"), (1.2 * GAIN, DISTANCE, "gain"), (GAIN, 0.8 * DISTANCE, "distance")],
)
def test_check_names_the_wrong_value_and_blames_no_other(log: Path, gain: float, distance: float, verdict: str) -> None:
    barrier = {**AVOIDANCE, "safety_distance": distance, "class_k": {"gain": gain}}
    config = validate({**CONFIG, "barriers": [barrier]}, ObserveConfig, "test")
    found = check_safety(DeclaredLog(config, read_csv(log)))
    assert found is not None
    assert found.verdict == verdict
    assert found.free is not None
    assert found.free.gain[0] <= GAIN <= found.free.gain[1]


def test_check_says_that_rows_which_were_never_active_bound_nothing(tmp_path: Path) -> None:
    start = torch.tensor([[-2.0, 0.0], [-2.0, 9.0]], dtype=torch.float64)
    goals = torch.tensor([[2.0, 0.0], [2.0, 9.0]], dtype=torch.float64)
    controller = CbfQpController(GoalTask(KP), [CollisionAvoidance(ClassK(GAIN), safety_distance=DISTANCE)])
    run = simulate(controller, goals, start, dt=0.1, steps=20)
    log = write_log(tmp_path / "log.csv", run, ["a", "b"])
    prior = {"lower": [-20, -20], "upper": [20, 20]}
    config = validate({**CONFIG, "prior": prior}, ObserveConfig, "test")
    found = check_safety(DeclaredLog(config, read_csv(log)))
    assert found is not None
    assert found.free is not None
    assert not any((*found.free.gain_by_data, *found.free.distance_by_data))
    assert "not bounded by the data" in found.conclusion()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"safety_distance": [0.5, 0.2]}, r"barriers\[0\].safety_distance: expected \[low, high\] with low <= high"),
        ({"class_k": {"gain": [1]}}, r"barriers\[0\].class_k.gain: expected at least 2 entries, got 1"),
        ({"class_k": {"gain": [0, 1]}}, r"barriers\[0\].class_k.gain\[0\]: Input should be greater than 0"),
        ({"shared": "fleet"}, r"barriers\[0\].shared"),
        (
            {"safety_distance": 0.5, "class_k": {"gain": 1.0}, "shared": "team"},
            r"barriers\[0\].shared: expected an unknown",
        ),
        ({"safety_distances": {"bob": 1.0}}, r"barriers\[0\].safety_distances: bodies have no distances of their own"),
    ],
)
def test_wrong_intervals_are_refused_by_their_path(change: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        validate({**CONFIG, "barriers": [{**AVOIDANCE, **change}]}, ObserveConfig, "test")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"set": "critical_region"}, "set: critical_region needs known safety parameters"),
        ({"barriers": [AVOIDANCE, AVOIDANCE]}, r"barriers\[1\]: one barrier may have unknown parameters"),
        (
            {"task": {"kind": "goal", "gain": [0.5, 1]}, "noise": {"velocity": "auto"}},
            "noise: auto takes an error of task.gain",
        ),
        ({"task": {"kind": "goal", "gain": [0.5, 1], "dead_zone": 0.1}}, "task.gain: expected a known gain"),
    ],
)
def test_what_cannot_be_unknown_together_is_refused(change: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        validate({**CONFIG, **change}, ObserveConfig, "test")


def test_a_form_that_is_left_open_has_different_values(tmp_path: Path) -> None:
    file = write_config(
        tmp_path / "c.yaml", {**CONFIG, "barriers": [{**AVOIDANCE, "class_k": {"gain": 1, "power": [1, 1]}}]}
    )
    with pytest.raises(ConfigError, match=r"barriers\[0\].class_k.power: expected different values"):
        load_models(file)


def test_a_figure_of_damaged_results_says_so(tmp_path: Path) -> None:
    (tmp_path / "regions.json").write_text("{}")
    with pytest.raises(FigureError, match=r"regions.json: missing or damaged"):
        draw_safety(tmp_path)


def test_intervals_are_rounded_outward() -> None:
    assert ends([53.389, 669.393], [False, True]) == "53* .. 670"
    assert ends([0.9999789, 1.0000211]) == "0.999978 .. 1.000022"
    assert ends([0.015, 150.0]) == "0.015 .. 150"


def test_what_no_parameters_explain_is_not_called_a_difference_between_robots(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a wrong gain of the task every robot is refuted by itself, and none is the odd one."""
    out = observe(log, tmp_path, CONFIG | {"task": {"kind": "goal", "gain": 4 * KP}})
    said, regions = capsys.readouterr().out, json.loads((out / "regions.json").read_text())
    assert {robot["status"] for robot in regions["robots"].values()} == {"inconsistent"}
    assert regions["odd"] == []
    assert "something else in the model or the prior is wrong" in said
    assert "no theta in the prior explains the motion of" in said
    assert "without" not in said


def test_check_does_not_rule_out_that_the_intervals_are_wrong(log: Path, tmp_path: Path) -> None:
    config = CONFIG | {"barriers": [AVOIDANCE | {"class_k": {"gain": [2 * GAIN, 3 * GAIN]}}]}
    found = check_safety(DeclaredLog(validate(config, ObserveConfig, "config"), read_csv(log)))
    assert found is not None
    assert "declared intervals" in found.conclusion()
    assert "they are wrong, robots differ" in found.conclusion()
