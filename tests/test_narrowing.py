"""Numbers of a model that nobody tells: what a log leaves of them, and that neither they nor the goals are lost."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.logs import bounded_errors, write_config, write_log
from tests.second_order_teams import crossing
from tests.test_config import refusal
from torchfsid.cli import main
from torchfsid.commands.check import check
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.narrowing import narrowed
from torchfsid.commands.observe import Observation
from torchfsid.config.documents import validate
from torchfsid.config.observe import ObserveConfig
from torchfsid.logs.table_log import read_csv
from torchfsid.outcome import Status
from torchfsid.robots.orca import Orca, OrcaController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask, Saturation

HORIZON, MARGIN, ERROR = 2.4, 0.06, 1e-3
ORCA = {
    "kind": "orca", "time_horizon": HORIZON, "time_step": 0.1, "max_speed": 1.2, "margin": MARGIN,
    "neighbours": {"count": 10, "distance": 10.0},
}  # fmt: skip
CONFIG = {
    "task": {"kind": "goal", "gain": 0.6, "saturation": {"kind": "norm", "limit": 1.0}},
    "barriers": [ORCA],
    "prior": {"lower": [-5, -5], "upper": [5, 5]},
    "noise": {"velocity": ERROR, "neighbour_velocity": ERROR},
    "ukf": False,
}
AVOIDANCE = {
    "kind": "avoidance", "order": 2, "safety_distance": 0.4, "class_k": [{"gain": 1.5}, {"gain": 2.0}],
    "neighbour_acceleration": "current",
}  # fmt: skip
SECOND_ORDER = {
    "dynamics": "double_integrator",
    "task": {"kind": "goal", "gain": 0.6, "damping": 1.4},
    "barriers": [AVOIDANCE, {"kind": "acceleration_box", "limit": [1.5, 1.5]}],
    "prior": {"lower": [-4, -4], "upper": [4, 4]},
    "noise": {"acceleration": ERROR, "neighbour_acceleration": ERROR},
    "obstacles": ["post"],
    "ukf": False,
}

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture(scope="module")
def orca(tmp_path_factory: pytest.TempPathFactory) -> tuple[Tensor, Path]:
    """The goals and the log of four robots that cross."""
    generator, turn = torch.Generator().manual_seed(13), math.pi / 2 * torch.arange(4, dtype=torch.float64)
    start = 2.5 * torch.stack([turn.cos(), turn.sin()], dim=-1)
    start = start + 0.15 * torch.randn(4, 2, generator=generator, dtype=torch.float64)
    goals = -start + 0.3 * torch.randn(4, 2, generator=generator, dtype=torch.float64)
    radius = torch.tensor([0.2, 0.25, 0.3, 0.2], dtype=torch.float64)
    controller = OrcaController(
        GoalTask(0.6, saturation=Saturation("norm", (1.0, 1.0))), Orca(HORIZON, 0.1, 1.2, 10, 10.0, MARGIN)
    )
    run = simulate(controller, goals, start, dt=0.1, steps=80, radius=radius)
    path = tmp_path_factory.mktemp("log") / "log.csv"
    return goals, write_log(path, run, ["ann", "bob", "cyd", "dan"], bounded_errors(run, 4, ERROR, seed=0))


def declared(log: Path, config: dict, **barrier: object) -> DeclaredLog:
    """The log with other values for the first barrier."""
    first, *rest = config["barriers"]
    return DeclaredLog(
        validate({**config, "barriers": [{**first, **barrier}, *rest]}, ObserveConfig, "c"), read_csv(log)
    )


def are_kept(model: DeclaredLog, goals: Tensor, **truth: float) -> bool:
    """Does an observation keep the goals, and numbers within an interval of 20 % or 1 cm about them?"""
    observation = Observation(model)
    for seen in observation.declared.measurements():
        observation.observer.update(seen)
    assert observation.narrowing is not None
    assert bool((observation.sets.status == Status.OK).all())
    for number, value in zip(observation.narrowing.numbers.values(), truth.values(), strict=True):
        assert number.found[0] <= value <= number.found[1]
        assert number.found[1] - number.found[0] < max(0.2 * value, 0.01)
    return bool(observation.sets.feasible_set.contains(goals).all())


def test_horizon_and_margin_of_orca(orca: tuple[Tensor, Path]) -> None:
    goals, log = orca
    assert are_kept(declared(log, CONFIG, time_horizon=[1, 6], margin=[0, 0.2]), goals, horizon=HORIZON, margin=MARGIN)


def test_gain_and_distance_of_second_order(tmp_path: Path) -> None:
    goals, run = crossing("damped", "current", 0)
    log = write_log(tmp_path / "log.csv", run, ["a", "b", "c", "d", "post"], bounded_errors(run, 4, ERROR, seed=1))
    unknown = {"class_k": [{"gain": [0.5, 3]}, {"gain": 2.0}], "safety_distance": [0.2, 0.8]}
    assert are_kept(declared(log, SECOND_ORDER, **unknown), goals, gain=1.5, distance=0.4)


def test_two_gains_can_be_exchanged(tmp_path: Path) -> None:
    """What is left of either gain has the values of both: their boxes are two."""
    _, run = crossing("damped", "current", 0)
    log = write_log(tmp_path / "log.csv", run, ["a", "b", "c", "d", "post"])
    config = {**SECOND_ORDER, "noise": {"acceleration": 1e-5}}
    _, found = narrowed(declared(log, config, class_k=[{"gain": [1, 3]}, {"gain": [1, 3]}]))
    for number in found.numbers.values():
        assert 1.3 < number.found[0] <= 1.5
        assert 2.0 <= number.found[1] < 2.3


def straight(path: Path, gains: list[float], odd: bool = False) -> Path:
    """Robots far from each other, each on a straight way to its goal; the last one shakes if it is `odd`."""
    rng = np.random.default_rng(0)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "robot", "x", "y", "vx", "vy", "radius"])
        x = [-3.0] * len(gains)
        for k in range(40):
            for i, gain in enumerate(gains):
                u = -gain * x[i] + odd * (i == len(gains) - 1) * rng.choice([-0.5, 0.5])
                writer.writerow([0.1 * k, f"robot{i}", x[i], 20 * i, u, 0, 0.2])
                x[i] += 0.1 * u
    return path


APART = {
    **CONFIG,
    "task": {"kind": "goal", "gain": [0.2, 2.0]},
    "barriers": [{**ORCA, "max_speed": 10.0}],
    "prior": {"lower": [-5, -50], "upper": [5, 50]},
    "noise": {"velocity": 1e-4},
}


def observed(log: Path, config: dict, tmp_path: Path) -> Path:
    out, path = tmp_path / "out", write_config(tmp_path / "config.yaml", config)
    assert main(["observe", str(log), "--config", str(path), "--out", str(out)]) == 0
    return out


def test_an_odd_robot_is_named_and_what_the_data_do_not_bound_is_marked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = {**APART, "barriers": [{**APART["barriers"][0], "time_horizon": [1, 6]}]}
    out = observed(straight(tmp_path / "log.csv", [0.8, 0.8, 0.8], odd=True), config, tmp_path)
    found = json.loads((out / "unknown_numbers.json").read_text())
    assert found["unexplained"] == ["robot2"]
    assert found["explained"] == ["robot0", "robot1"]
    gain, horizon = found["numbers"]["task.gain"], found["numbers"]["barriers[0].time_horizon"]
    assert gain["found"] == pytest.approx([0.8, 0.8], rel=0.02)
    assert horizon["found"] == [1, 6]
    assert horizon["bounded_by_data"] == [False, False]
    assert json.loads((out / "task_gain.json").read_text()) == gain
    robots = json.loads((out / "regions.json").read_text())["robots"]
    assert [robot["status"] for robot in robots.values()] == ["ok", "ok", "inconsistent"]
    printed = capsys.readouterr().out
    assert "no values of the unknown numbers explain robot2" in printed
    assert "barriers[0].time_horizon: 1* .. 6* s" in printed


def test_robots_without_values_in_common_are_told_apart_from_unexplained_ones(tmp_path: Path) -> None:
    log = straight(tmp_path / "log.csv", [0.5, 1.5])
    _, found = narrowed(declared(log, APART))
    assert not found.explains
    assert found.unexplained == ()
    assert found.said() == [
        "no values of the unknown numbers explain all of robot0, robot1 together (declared task.gain 0.2 .. 2)"
    ]


def test_check_and_hypotheses_narrow_too(orca: tuple[Tensor, Path], tmp_path: Path) -> None:
    _, log = orca
    found = check(declared(straight(tmp_path / "log.csv", [0.8, 0.8]), APART))
    assert found.smallest_bound < 2e-4
    assert any(line.startswith("task.gain: 0.79") for line in found.conclusions())
    assert found.to_json()["unknown_numbers"]["explained"] == ("robot0", "robot1")
    shorter, longer = ({**ORCA, "time_horizon": interval} for interval in ([1.0, 2.0], [2.2, 2.7]))
    tasks = [
        {"name": name, "task": CONFIG["task"], "barriers": [of]} for name, of in (("short", shorter), ("long", longer))
    ]
    config = {key: value for key, value in CONFIG.items() if key not in ("task", "barriers")}
    out = observed(log, {**config, "tasks": tasks, "barriers": [ORCA]}, tmp_path)
    for verdicts in json.loads((out / "hypotheses.json").read_text()).values():
        assert verdicts["short"]["status"] == "inconsistent"
        assert verdicts["long"]["status"] == "ok"


REFUSED: dict[str, tuple[dict, dict, str]] = {
    "order": ({"time_horizon": [3, 1]}, {}, "barriers[0].time_horizon: expected [low, high] with low <= high"),
    "negative": ({"margin": [-0.1, 0.1]}, {}, "barriers[0].margin: expected distances >= 0"),
    "push away": ({"margin": [0, 0.1], "push_away": 0.002}, {}, "barriers[0].margin: expected a known margin"),
    "reset": (
        {"margin": [0, 0.1]},
        {"on_inconsistent": "reset"},
        "on_inconsistent: barriers[0].margin can be narrowed",
    ),
    "auto": (
        {"time_horizon": [1, 3]},
        {"noise": {"velocity": "auto"}},
        "noise: auto takes an error of barriers[0].time",
    ),
    "omega": ({"time_horizon": [1, 3]}, {"set": "critical_region"}, "set: critical_region"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_narrowed_is_refused(name: str) -> None:
    barrier, changes, expected = REFUSED[name]
    config = {**CONFIG, "barriers": [{**ORCA, **barrier}], **changes}
    assert expected in refusal(lambda: validate(config, ObserveConfig, "config"))


def test_critical_regions_need_known_gains() -> None:
    barrier = {**AVOIDANCE, "class_k": [{"gain": [1, 2]}, {"gain": 2.0}]}
    config = {**SECOND_ORDER, "barriers": [barrier], "set": "critical_region"}
    assert "set: critical_region needs rows" in refusal(lambda: validate(config, ObserveConfig, "config"))
