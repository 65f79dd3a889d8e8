"""The command as its user meets it: files of the contract, and one clear line for whatever is wrong."""

import csv
import json
from pathlib import Path

import pytest
import torch
import yaml

from torchfsid.cli import main
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask

GOALS = {"ann": (2.0, 0.1), "bob": (-2.0, 0.0)}
CONFIG = {
    "task": {"kind": "goal", "gain": 0.9},
    "barriers": [{"kind": "avoidance", "safety_distance": 0.5, "class_k": {"gain": 1.5, "power": 1}}],
    "prior": {"lower": [-5, -5], "upper": [5, 5]},
    "noise": {"velocity": 1e-6},
    "set": "inverse_optimal",
    "obstacles": ["pillar"],
}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A log and its config."""
    folder = tmp_path_factory.mktemp("log")
    controller = CbfQpController(GoalTask(0.9), [CollisionAvoidance(ClassK(1.5), safety_distance=0.5)])
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3]], dtype=torch.float64)
    goals = torch.tensor(list(GOALS.values()), dtype=torch.float64)
    run = simulate(controller, goals, start, dt=0.05, steps=60, obstacles=torch.tensor([[0.2, 1.0]]))
    log, config = folder / "log.csv", folder / "config.yaml"
    with log.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "robot", "x", "y", "vx", "vy"])
        for k, t in enumerate(run.t.tolist()):
            for j, body in enumerate([*GOALS, "pillar"]):
                writer.writerow([t, body, *run.x[k, j].tolist(), *run.u[k, j].tolist()])
    config.write_text(yaml.safe_dump(CONFIG))
    return log, config


def test_observe_writes_the_files_of_the_contract(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, config = files
    assert main(["observe", str(log), "--config", str(config), "--out", str(tmp_path)]) == 0
    table = capsys.readouterr().out
    assert "ann" in table
    assert "ok" in table

    rows = list(csv.DictReader((tmp_path / "estimates.csv").open()))
    assert len(rows) == 2 * 61
    columns = "t,robot,case,n_active,volume,diameter,centre_0,centre_1,radius,centroid_0,centroid_1"
    assert ",".join(rows[0]) == f"{columns},ukf_0,ukf_1,hybrid_0,hybrid_1,status"
    assert {row["case"] for row in rows} <= set("ABCDE")
    regions = json.loads((tmp_path / "regions.json").read_text())["robots"]
    assert set(regions) == set(GOALS)
    for robot, region in regions.items():
        assert region["status"] == "ok"
        for a, b in zip(region["A"], region["b"], strict=True):
            assert sum(x * y for x, y in zip(a, GOALS[robot], strict=True)) <= b + 1e-9
        last = [row for row in rows if row["robot"] == robot][-1]
        assert float(last["volume"]) == pytest.approx(region["volume"], rel=1e-9)
    assert {"config.yaml", "regions.png", "regions.pdf"} <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.usefixtures("undrawn")
def test_a_run_can_be_repeated_from_its_results_folder(files: tuple[Path, Path], tmp_path: Path) -> None:
    log, config = files
    first, second = tmp_path / "first", tmp_path / "second"
    options = ["--set", "ukf.position_noise=0.01"]
    assert main(["observe", str(log), "--config", str(config), "--out", str(first), *options]) == 0
    assert main(["observe", str(log), "--config", str(first / "config.yaml"), "--out", str(second)]) == 0
    assert (first / "estimates.csv").read_bytes() == (second / "estimates.csv").read_bytes()
    assert (first / "regions.json").read_bytes() == (second / "regions.json").read_bytes()


@pytest.mark.usefixtures("undrawn")
def test_differentiated_velocities_of_held_commands_are_exact(files: tuple[Path, Path], tmp_path: Path) -> None:
    log, config = files
    options = ["--set", "velocity=differentiated", "--set", "noise.velocity=1e-9"]
    assert main(["observe", str(log), "--config", str(config), "--out", str(tmp_path), *options]) == 0
    regions = json.loads((tmp_path / "regions.json").read_text())["robots"]
    assert [region["status"] for region in regions.values()] == ["ok", "ok"]


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("noise.velocty=1", "noise.velocty"),
        ("task.gain=fast", "task.gain"),
        ("task.gain=-1", "task.gain"),
        ("prior.lower=[5, -5]", "prior"),
        ("noise.velocity=-0.1", "noise.velocity"),
        ("barriers.0.safety_distance=0", "barriers[0].safety_distance"),
        ("obstacles=[wall]", "obstacles[0]"),
        ("active_tolerance=.nan", "active_tolerance"),
    ],
)
def test_a_wrong_config_is_one_line_and_exit_code_2(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], override: str, expected: str
) -> None:
    log, config = files
    out = tmp_path / "out"
    assert main(["observe", str(log), "--config", str(config), "--out", str(out), "--set", override]) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda text: text.replace("vx,vy", "vx,w"), "vy"),
        (lambda text: text.replace("t,robot,x", "t,robot,lat"), "'x'"),
        (lambda text: text.replace("\n0.05,ann,", "\n0.05,ann,abc", 1), "line 5"),
        (lambda text: text.replace("\n0.1,ann,", "\n0.01,ann,", 1), "line 8"),
        (lambda text: text.replace("\n0.05,ann,-", "\n0.05,ann,nan,", 1), "line 5"),
        (lambda text: "", "empty"),
    ],
)
def test_a_wrong_log_is_one_line_and_exit_code_2(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], change, expected: str
) -> None:
    log, config = files
    broken, out = tmp_path / "broken.csv", tmp_path / "out"
    text = change(log.read_text())
    assert text != log.read_text()
    broken.write_text(text)
    assert main(["observe", str(broken), "--config", str(config), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1
    assert not out.exists()


def test_missing_files_and_arguments_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(["observe", str(tmp_path / "no.csv"), "--config", str(tmp_path / "no.yaml"), "--out", str(tmp_path / "o")])
        == 2
    )
    assert capsys.readouterr().err.count("\n") == 1
    with pytest.raises(SystemExit, match="2"):
        main(["observe"])
    assert capsys.readouterr().err.count("\n") == 1
