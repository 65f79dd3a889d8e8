"""`torchfsid check` and `noise.velocity: auto`: what a log says about its model without any truth."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml

from tests.logs import bounded_errors, write_config, write_log
from torchfsid.cli import main
from torchfsid.commands.check import check
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.terminal import COMPILING
from torchfsid.config.documents import validate
from torchfsid.config.observe import ObserveConfig
from torchfsid.logs.table_log import read_csv
from torchfsid.observers.consistency import RESOLUTION, SMALLEST
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask, Saturation

GOALS = {"ann": (2.0, 0.1), "bob": (-2.0, 0.0)}
pytestmark = pytest.mark.usefixtures("undrawn")

BODIES = [*GOALS, "pillar"]
CONFIG = {
    "task": {"kind": "goal", "gain": 0.9},
    "barriers": [{"kind": "avoidance", "safety_distance": 0.5, "class_k": {"gain": 1.5}}],
    "prior": {"lower": [-5, -5], "upper": [5, 5]},
    "noise": {"velocity": 0.02},
    "obstacles": ["pillar"],
}


def run_of(task: GoalTask) -> Trajectory:
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3]], dtype=torch.float64)
    controller = CbfQpController(task, [CollisionAvoidance(ClassK(1.5), safety_distance=0.5)])
    goals = torch.tensor(list(GOALS.values()), dtype=torch.float64)
    return simulate(controller, goals, start, dt=0.15, steps=24, obstacles=torch.tensor([[0.2, 1.0]]))


@pytest.fixture(scope="module")
def crossing() -> Trajectory:
    """Two robots swap places past a pillar."""
    return run_of(GoalTask(0.9))


@pytest.fixture(scope="module")
def noisy_log(crossing: Trajectory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The crossing, with errors of 0.01 m/s in the velocities."""
    return write_log(tmp_path_factory.mktemp("log") / "log.csv", crossing, BODIES, bounded_errors(crossing, 2, 0.01, 0))


def declared(log: Path, **changes) -> DeclaredLog:
    return DeclaredLog(validate({**CONFIG, **changes}, ObserveConfig, "test"), read_csv(log))


def statuses(model: DeclaredLog, bounds: torch.Tensor) -> list[int]:
    """How an observer ends that reads the samples one by one."""
    observer = SetMembershipObserver(model.task, model.barriers, model.prior, noise=NoiseBound(bounds))
    for sample in model.measurements():
        observer.update(sample)
    return observer.status.tolist()


def test_the_smallest_bound_is_where_an_observer_begins_to_contradict(noisy_log: Path) -> None:
    model = declared(noisy_log)
    bounds = torch.tensor(list(model.smallest_bounds().values()))
    assert (bounds < 0.01 * RESOLUTION).all()
    assert (bounds > 0.003).all()
    assert statuses(model, bounds * RESOLUTION) == [Status.OK, Status.OK]
    assert min(statuses(model, bounds / RESOLUTION**2)) > Status.OK


def test_with_a_clipped_nominal_control_too(tmp_path: Path) -> None:
    run = run_of(GoalTask(0.9, saturation=Saturation("norm", (0.8, 0.8))))
    log = write_log(tmp_path / "log.csv", run, BODIES, bounded_errors(run, 2, 0.01, 1))
    task = {"kind": "goal", "gain": 0.9, "saturation": {"kind": "norm", "limit": 0.8}}
    model = declared(log, task=task)
    bounds = torch.tensor(list(model.smallest_bounds().values()))
    assert (bounds < 0.01 * RESOLUTION).all()
    assert statuses(model, bounds * RESOLUTION) == [Status.OK, Status.OK]


def test_observe_finds_the_bound_uses_twice_that_and_can_be_repeated(
    noisy_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = write_config(tmp_path / "config.yaml", {**CONFIG, "noise": {"velocity": "auto", "position": 1e-4}})
    first, second = tmp_path / "first", tmp_path / "second"
    assert main(["observe", str(noisy_log), "--config", str(config), "--out", str(first)]) == 0
    assert "auto found 0.00" in capsys.readouterr().out
    found = json.loads((first / "velocity_bound.json").read_text())
    used = yaml.safe_load((first / "config.yaml").read_text())["noise"]["velocity"]
    assert used == found["used"] == 2 * max(found["smallest"].values())
    assert set(found["smallest"]) == set(GOALS)
    regions = json.loads((first / "regions.json").read_text())["robots"]
    for robot, goal in GOALS.items():
        assert regions[robot]["status"] == "ok"
        for a, b in zip(regions[robot]["A"], regions[robot]["b"], strict=True):
            assert a[0] * goal[0] + a[1] * goal[1] <= b + 1e-9
    assert main(["observe", str(noisy_log), "--config", str(first / "config.yaml"), "--out", str(second)]) == 0
    assert (first / "regions.json").read_bytes() == (second / "regions.json").read_bytes()
    assert not (second / "velocity_bound.json").exists()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("prior={lower: [40, 40], upper: [45, 45]}", "'ann'"),
        ("on_inconsistent=reset", "noise"),
        ("noise.velocity=automatic", "noise.velocity: expected a bound of at least 0 m/s or 'auto'"),
    ],
)
def test_no_bound_is_one_line_and_exit_code_2(
    noisy_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: str, expected: str
) -> None:
    config = write_config(tmp_path / "config.yaml", {**CONFIG, "noise": {"velocity": "auto"}})
    out = tmp_path / "out"
    assert main(["observe", str(noisy_log), "--config", str(config), "--out", str(out), "--set", change]) == 2
    *others, error = capsys.readouterr().err.splitlines()
    assert expected in error
    assert set(others) <= {COMPILING}
    assert not out.exists()


def test_an_exact_log_of_the_declared_model(crossing: Trajectory, tmp_path: Path) -> None:
    found = check(declared(write_log(tmp_path / "log.csv", crossing, BODIES)))
    assert found.smallest_bound == SMALLEST
    assert found.best_shift == 0
    assert all(robot.worst <= SMALLEST * RESOLUTION for robot in found.robots)
    assert not any(robot.contradictions or robot.violations for robot in found.robots)
    assert found.conclusions()[0].startswith("the log is consistent with the declared model for velocity >= 1e-09 m/s")


def write_rows(path: Path, rows: list[str]) -> Path:
    path.write_text("\n".join(["t,robot,x,y,vx,vy", *rows]) + "\n")
    return path


def test_a_log_that_says_nothing_is_not_called_consistent(tmp_path: Path) -> None:
    """A robot that breaks the barrier and does not move: its controller has failed."""
    log = write_rows(
        tmp_path / "a.csv", [f"{t},{body},{x},0,0,0" for t in range(6) for body, x in (("a", 0), ("b", 0.3))]
    )
    found = check(declared(log, obstacles=["b"]))
    assert found.to_json()["smallest_bound"] is found.to_json()["robots"]["a"]["smallest_bound"] is None
    assert found.conclusions() == ["nothing can be said of a: no sample could be used"]
    assert check(declared(log, obstacles=[])).conclusions() == ["nothing can be said of a, b: no sample could be used"]


def test_what_is_said_is_only_said_of_robots_with_samples_and_of_shifts_that_were_tried(tmp_path: Path) -> None:
    bodies = (("a", 0, 0), ("b", 0.3, 0), ("c", 4, 0.9))
    rows = [f"{t},{body},{x},0,{vx},0" for t in range(2) for body, x, vx in bodies]
    conclusions = check(declared(write_rows(tmp_path / "a.csv", rows), obstacles=[])).conclusions()
    assert conclusions[0] == "nothing can be said of a, b: no sample could be used"
    assert conclusions[1].startswith("the log is consistent")
    assert conclusions[2].startswith("nothing can be said of the alignment")


def test_a_shift_between_positions_and_velocities_is_found(crossing: Trajectory, tmp_path: Path) -> None:
    """Velocities are logged one sample too late."""
    late = replace(crossing, u=torch.cat([crossing.u[:1], crossing.u[:-1]]))
    found = check(declared(write_log(tmp_path / "log.csv", late, BODIES)))
    assert found.best_shift == 1
    assert "velocities logged 1 sample(s) later fit better" in found.conclusions()[1]


def test_check_names_the_rows_of_a_wrong_model(
    noisy_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The declared distance is too large: rows are violated, and what is left makes no sense either."""
    config = write_config(tmp_path / "config.yaml", CONFIG)
    command = ["check", str(noisy_log), "--config", str(config), "--out", str(tmp_path)]
    assert main([*command, "--set", "barriers.0.safety_distance=0.7"]) == 0
    text = capsys.readouterr().out
    found = json.loads((tmp_path / "check.json").read_text())
    assert found["smallest_bound"] > 0.02
    assert "declared 0.02, too small for ann, bob" in found["conclusions"][0]
    assert "samples that violate a hard row at 0.02 m/s" in text
    for robot, other in (("ann", "bob"), ("bob", "ann")):
        violations = found["robots"][robot]["violations"]
        assert {f"avoid {other}"} <= {fault["row"] for fault in violations} <= {f"avoid {other}", "avoid pillar"}
        assert all(fault["worst"] > 0 and not fault["soft"] for fault in violations)
        contradictions = found["robots"][robot]["contradictions"]
        assert {fault["row"] for fault in contradictions} <= {f"avoid {other}", "avoid pillar", "nominal control"}
        assert all(0 <= fault["first"] <= 3.6 and fault["worst"] > 0 for fault in contradictions)


def test_observe_says_when_a_generous_bound_is_used_up(
    noisy_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A gain that is wrong by 5 % hides in a bound of 0.06 m/s; the right one needs a sixth of it."""
    config = write_config(tmp_path / "config.yaml", {**CONFIG, "noise": {"velocity": 0.06}})
    command = ["observe", str(noisy_log), "--config", str(config), "--out", str(tmp_path / "out")]
    for gain, strained in ((0.9, False), (0.945, True)):
        assert main([*command, "--set", f"task.gain={gain}"]) == 0
        text = capsys.readouterr().out
        assert "inconsistent" not in text
        assert ("More than half of noise.velocity, 0.06 m/s, is needed by ann, bob" in text) == strained


def test_check_answers_mistakes_with_one_line(
    noisy_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = write_config(tmp_path / "config.yaml", CONFIG)
    assert main(["check", str(noisy_log), "--config", str(config), "--set", "task.gain=0"]) == 2
    assert main(["check", str(tmp_path / "no.csv"), "--config", str(config)]) == 2
    assert capsys.readouterr().err.count("\n") == 2
