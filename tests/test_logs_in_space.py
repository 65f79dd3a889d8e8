"""Robots in space from file to figure: tables, bags, motion capture, configurations, commands, experiments."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import torchfsid as fsid
from experiments.__main__ import main as experiments
from tests.bag_writer import odometry, write_bag
from tests.logs import write_config, write_log
from torchfsid.cli import main
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.map_panel import Marks
from torchfsid.commands.space_figure import seen_along, shadow, shadows
from torchfsid.config.bags import BagConfig
from torchfsid.config.documents import validate
from torchfsid.config.motion_capture import LogConfig
from torchfsid.config.observe import ObserveConfig
from torchfsid.errors import ConfigError, LogError
from torchfsid.logs.read import read_log
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.ellipsoid import Ellipsoid
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import AffineTask, GoalTask
from torchfsid.sets.feasible_set import FeasibleSet

SECOND = 1_000_000_000
START = torch.tensor([[-1.0, 0.1, 0.5], [1.0, -0.1, 0.6], [0.1, 1.0, 0.4]], dtype=torch.float64)
GOALS = torch.tensor([[1.2, 0.0, 0.9], [-1.1, 0.2, 0.3], [0.0, -1.2, 0.8]], dtype=torch.float64)
AXES = (0.3, 0.3, 0.6)

CONFIG = {
    "task": {"kind": "goal", "gain": 1.0},
    "barriers": [{"kind": "avoidance", "ellipsoid": list(AXES), "class_k": {"gain": 2.0}}],
    "prior": {"lower": [-2.0, -2.0, 0.0], "upper": [2.0, 2.0, 2.0]},
    "noise": {"velocity": 1e-6},
}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    barrier = Ellipsoid(CollisionAvoidance(ClassK(2.0), 1.0), AXES)
    run = simulate(CbfQpController(GoalTask(1.0, 3), [barrier]), GOALS, START, dt=0.1, steps=8)
    return write_log(tmp_path_factory.mktemp("space") / "log.csv", run, ["a", "b", "c"])


def config(**changes: object) -> ObserveConfig:
    return validate({**CONFIG, **changes}, ObserveConfig, "cfg.yaml")


def test_observe(log: Path, tmp_path: Path) -> None:
    """Sets with the filter and the hybrid: all truths inside, and a figure."""
    path = write_config(tmp_path / "config.yaml", CONFIG)
    assert main(["observe", str(log), "--config", str(path), "--out", str(tmp_path / "out")]) == 0
    robots = json.loads((tmp_path / "out" / "regions.json").read_text())["robots"]
    for region, goal in zip(robots.values(), GOALS.numpy(), strict=True):
        assert region["status"] == "ok"
        assert (np.array(region["A"]) @ goal - region["b"]).max() < 1e-9
        assert len(region["centroid"]) == 3
        assert region["diameter"] < 1e-2
    assert (tmp_path / "out" / "regions.png").stat().st_size > 10_000
    header = (tmp_path / "out" / "estimates.csv").read_text().splitlines()[0]
    assert "hybrid_2" in header


def test_objects_in_place_of_sections(log: Path) -> None:
    """A task of the package, and an own one that does not say whether it is in space."""
    own = AffineTask(torch.eye(3, dtype=torch.float64), lambda measurement: -measurement.x, ("a", "b", "c"))
    corner = torch.full((3,), 2.0, dtype=torch.float64)
    for task in (GoalTask(1.0, 3), own):
        barrier = Ellipsoid(CollisionAvoidance(ClassK(2.0), 1.0), AXES)
        found = fsid.observe(str(log), task, [barrier], FeasibleSet.from_box(-corner, corner), NoiseBound(1e-6))
        assert bool(found.sets.contains(GOALS, 1e-9).all())


def test_check_and_hypotheses(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tasks = [{"name": name, "task": {"kind": "goal", "gain": gain}} for name, gain in (("right", 1.0), ("wrong", 1.3))]
    rest = {key: value for key, value in CONFIG.items() if key != "task"} | {"ukf": False}
    path = write_config(tmp_path / "config.yaml", {"tasks": tasks, **rest})
    assert main(["check", str(log), "--config", str(path), "--out", str(tmp_path / "out")]) == 0
    right, wrong = (json.loads((tmp_path / "out" / name / "check.json").read_text()) for name in ("right", "wrong"))
    assert right["smallest_bound"] < 1e-6 < wrong["smallest_bound"]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"barriers": [{"kind": "speed_box", "limit": [1, 1]}]},
            "barriers[0]: the prior says that robots are in space",
        ),
        ({"barriers": [{"kind": "speed_polygon", "sides": 8, "limit": 1}]}, "'speed_polygon' is in the plane"),
        ({"velocity": "windows", "noise": {"velocity": 0, "position": 1e-3}}, "windows are for robots in the plane"),
        (
            {"body": {"kind": "unicycle", "map": "si_to_uni"}, "velocity": "differentiated"},
            "unicycles are in the plane",
        ),
        ({"task": {"kind": "orbit", "rate": 1}}, "task 'orbit' has 2 parameters in the plane, lower and upper have 3"),
        ({"task": {"kind": "goal", "gain": 1, "saturation": {"kind": "box", "limit": [1, 1]}}}, "task 'goal' has 2"),
        (
            {"barriers": [{"kind": "avoidance", "ellipsoid": [1, 1, 2], "margin": 1, "class_k": {"gain": 1}}]},
            "no other",
        ),
        (
            {"barriers": [{"kind": "buffered_voronoi", "ellipsoid": [0.3] * 3, "horizon": 0.5, "max_speed": 0.5}]},
            "barriers[0].sidestep: expected less than horizon * max_speed = 0.25 m",
        ),
        (
            {
                "barriers": [
                    {"kind": "buffered_voronoi", "ellipsoid": [0.3] * 3, "horizon": 1.0, "max_speed": 0.5},
                    {"kind": "arena", "lower": [-2] * 3, "upper": [2] * 3, "class_k": {"gain": 1}},
                ]
            },
            "expected sidestep: 0",
        ),
    ],
)
def test_refusals(changes: dict, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        config(**changes)
    assert expected in str(caught.value)


def test_the_log_and_the_prior_agree(log: Path) -> None:
    plane = {"lower": [-2.0, -2.0], "upper": [2.0, 2.0]}
    flat = config(prior=plane, barriers=[{"kind": "avoidance", "safety_distance": 0.3, "class_k": {"gain": 2.0}}])
    with pytest.raises(ConfigError, match="robots in the plane, but the log has positions z"):
        DeclaredLog(flat, read_log(log))


def test_a_bag_with_heights(tmp_path: Path) -> None:
    covariance = np.zeros((6, 6))
    covariance[:3, :3], covariance[3:, 3:] = np.diag([1e-6, 4e-6, 9e-6]), np.diag([1e-4, 4e-4, 1e-4])
    messages = {
        f"/{name}/odom": [
            odometry(k * SECOND // 10, (k, j, 2 * k), (10, 0, 20), covariance=covariance.ravel()) for k in range(5)
        ]
        for j, name in enumerate("ab")
    }
    bag = BagConfig(topics={f"/{name}/odom": name for name in "ab"}, covariance_multiple=3.0)
    path = write_bag(tmp_path / "bag", messages)
    read = read_log(path, bag, in_space=True)
    assert read.x[3, 1].tolist() == [3, 1, 6]
    assert read.u is not None
    assert read.position_error is not None
    assert read.velocity_error is not None
    assert read.u[3, 1].tolist() == [10, 0, 20]
    assert read.position_error[0, 0] == pytest.approx(3 * 3e-3)
    assert read.velocity_error[0, 0] == pytest.approx(3 * (3e-3 + np.hypot(10, 20) * 2e-2))
    with pytest.raises(LogError, match="the height changes from 0 to 8 m"):
        read_log(path, bag)


def test_motion_capture_with_the_y_axis_up(tmp_path: Path) -> None:
    path = tmp_path / "robot.txt"
    path.write_text("0 1 0.5 2 0 0 0 1\n1 1 1.5 3 0 0 0 1\n")
    of = LogConfig(format="tum", up="y")
    assert read_log(path, form=of, in_space=True).x[:, 0].tolist() == [[1, -2, 0.5], [1, -3, 1.5]]
    path.write_text("t,x,y\n0,1,2\n1,1,2\n")
    columns = LogConfig(format="columns", time="t", bodies={"r": {"x": "x", "y": "y"}})  # type: ignore[dict-item]
    with pytest.raises(ConfigError, match=r"log\.bodies\.r\.z: required key is missing, robots are in space"):
        read_log(path, form=columns, in_space=True)


@pytest.mark.parametrize("name", ["drones", "drones_accelerated"])
def test_the_drones(name: str, tmp_path: Path) -> None:
    """A shorter run of the experiment: no truth is lost, and its log gives the same sets."""
    of_file = Path("configs") / f"{name}.yaml"
    shorter = ["--set", "duration=0.3", "--set", "snapshots=[0.3]"]
    assert experiments(["run", str(of_file), "--out", str(tmp_path / "run"), *shorter]) == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert sum(summary["truth_outside"]["inverse_optimal"].values()) == 0
    assert (tmp_path / "run" / "figure.png").stat().st_size > 10_000
    declared = yaml.safe_load(of_file.read_text())
    kept = {key: declared[key] for key in ("task", "barriers", "prior", "noise", "dynamics") if key in declared}
    kept["obstacles"] = [body["name"] for body in declared["obstacles"]]
    written = read_log(tmp_path / "run" / "trajectory.csv")
    assert validate(kept, ObserveConfig, "cfg.yaml").dimension == written.x.shape[-1]


def test_projections_of_regions() -> None:
    """Places have shadows. Sets that are empty, or over a gain and a goal, have none, instead of a wrong one."""
    box = [[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)]
    final = {
        "place": {"vertices": box, "centroid": [0.5, 1.0, 1.5], "status": "ok"},
        "empty": {"vertices": [], "centroid": [None] * 3, "status": "inconsistent"},
        "gain": {"vertices": [[1.0, *corner] for corner in box], "centroid": [1.0, 0.5, 1.0, 1.5], "status": "ok"},
    }
    seen = shadows(final, (0, 2))
    assert sorted(map(tuple, seen["place"]["vertices"])) == [(0, 0), (0, 3), (1, 0), (1, 3)]
    assert seen["place"]["centroid"] == [0.5, 1.5]
    assert all(len(seen[robot]["vertices"]) == 0 and None in seen[robot]["centroid"] for robot in ("empty", "gain"))
    marks = seen_along(Marks(([0, 1, 2], [3, 4, 5]), {"place": [6, 7, 8], "gain": [1, 6, 7, 8]}), (0, 2))
    assert marks.prior == ([0, 2], [3, 5])
    assert marks.truth == {"place": [6, 8]}


def test_shadows() -> None:
    corners = np.array([[0, 0], [2, 0], [2, 1], [1, 0.5], [0, 1], [0, 0], [1, 0]], dtype=float)
    assert sorted(map(tuple, shadow(corners))) == [(0, 0), (0, 1), (2, 0), (2, 1)]
    assert sorted(map(tuple, shadow(np.array([[0.0, 0.0], [1, 1], [2, 2]])))) == [(0, 0), (2, 2)]
    assert shadow(np.zeros((3, 2))).tolist() == [[0, 0]]
