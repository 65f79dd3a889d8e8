"""`torchfsid init`: what it writes for a log is valid at once, says what the log says, and names what to edit."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from tests.bag_writer import acceleration, odometry, odometry_of, pose, transforms, write_bag, yawed
from tests.logs import write_log
from tests.test_motion_capture import columns, crazyswarm, optitrack, tum, vicon
from torchfsid.cli import main
from torchfsid.commands.survey import survey
from torchfsid.config.models import load_models
from torchfsid.config.observe import ObserveConfig
from torchfsid.logs.read import read_log
from torchfsid.logs.recognise import recognise
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.second_order import SecondOrderAvoidance
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask

MS = 1_000_000
GOALS = torch.tensor([[2.0, 0.1], [-2.0, 0.0]], dtype=torch.float64)
START = torch.tensor([[-2.0, 0.0], [2.0, 0.3]], dtype=torch.float64)
BODIES = ["7", "b 2", "pillar"]


@pytest.fixture(scope="module")
def run() -> Trajectory:
    """Two robots pass each other beside a pillar and come to rest."""
    controller = CbfQpController(GoalTask(0.9), [CollisionAvoidance(ClassK(1.5), safety_distance=0.5)])
    return simulate(controller, GOALS, START, dt=0.05, steps=160, obstacles=torch.tensor([[0.2, 1.0]]))


def started(log: Path, folder: Path) -> tuple[ObserveConfig, str]:
    """The configuration that `init` writes, validated, and its text."""
    out = folder / "started.yaml"
    assert main(["init", str(log), "--out", str(out)]) == 0
    (model,) = load_models(out).values()
    return model, out.read_text()


@pytest.mark.usefixtures("undrawn")
def test_a_table_is_observed_at_once(run, tmp_path):
    """Bodies, prior, gain and what stands still are those of the log; everything uncertain is marked."""
    log = write_log(tmp_path / "log.csv", run, BODIES)
    model, text = started(log, tmp_path)
    assert model.obstacles == ("pillar",)
    assert model.velocity == "logged"
    assert model.noise.control == "auto"
    assert model.task.gain == pytest.approx(0.9, rel=1e-3)  # type: ignore[union-attr]
    closest = torch.cdist(run.x, run.x).flatten(1)
    assert 0.9 * closest[closest > 0].min() < model.barriers[0].safety_distance < closest[closest > 0].min()  # type: ignore
    assert (torch.tensor(model.prior.lower) < GOALS.min(0).values).all()
    assert (torch.tensor(model.prior.upper) > GOALS.max(0).values).all()
    for key in ("gain:", "kind: avoidance", "safety_distance:", "class_k:", "lower:"):
        assert "# EDIT: " in next(line for line in text.splitlines() if line.strip(" -").startswith(key))
    for key in ObserveConfig.model_fields.keys() - {"bag", "log", "body", "windows"}:
        assert f"{key}:" in text
    assert max(len(line) for line in text.splitlines() if str(tmp_path) not in line) <= 132
    arguments = ["observe", str(log), "--config", str(tmp_path / "started.yaml"), "--out", str(tmp_path / "out")]
    assert main(arguments) == 0


def test_a_file_is_not_replaced(run, tmp_path, capsys):
    log, out = write_log(tmp_path / "log.csv", run, BODIES), tmp_path / "mine.yaml"
    out.write_text("mine")
    assert main(["init", str(log), "--out", str(out)]) == 2
    assert "is there, and is not replaced" in capsys.readouterr().err
    assert out.read_text() == "mine"


def test_the_least_gain_is_that_of_a_barrier_that_was_active(run, tmp_path):
    """h' + gamma h >= 0 with the true distance: the smallest gamma that forbids nothing seen is the true one."""
    pair = write_log(tmp_path / "log.csv", run, BODIES)
    joint = CbfQpController(
        GoalTask(0.9), [CollisionAvoidance(ClassK(1.5), safety_distance=0.5, neighbour_velocity="current")]
    )
    together = simulate(joint, GOALS, START, dt=0.01, steps=400)
    log = write_log(tmp_path / "joint.csv", together, BODIES[:2])
    assert survey(read_log(log)).least_gain(0.5) == pytest.approx(1.5, rel=0.02)
    assert survey(read_log(pair)).least_gain(10.0) is None  # nothing was that far apart


def test_robots_of_second_order(tmp_path):
    """Accelerations in the log: gain and damping are found, and the barrier is of order 2."""
    barrier = SecondOrderAvoidance((1.5, 2.0), safety_distance=0.5)
    controller = CbfQpController(GoalTask(0.6, damping=1.4), [barrier])
    run = simulate(controller, GOALS, START, dt=0.05, steps=300, velocity=torch.zeros_like(START))
    model, _ = started(write_log(tmp_path / "log.csv", run, BODIES[:2]), tmp_path)
    assert model.dynamics == "double_integrator"
    assert (model.task.gain, model.task.damping) == pytest.approx((0.6, 1.4), rel=1e-3)  # type: ignore[union-attr]
    assert model.barriers[0].is_second_order


@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_positions_alone(run, tmp_path, noise):
    """Exact positions are differentiated, measured ones are read by windows."""
    log = tmp_path / "log.csv"
    error = noise * np.random.default_rng(1).normal(size=run.x.shape)
    lines = ["t,robot,x,y"]
    for k, j in itertools.product(range(len(run.t)), range(3)):
        x, y = (run.x[k, j].numpy() + error[k, j]).tolist()
        lines.append(f"{run.t[k]:.6f},{BODIES[j]},{x:.12f},{y:.12f}")
    log.write_text("\n".join(lines))
    model, _ = started(log, tmp_path)
    assert model.velocity == ("windows" if noise else "differentiated")
    assert model.obstacles == ("pillar",)
    if noise:
        assert 3 * noise < model.noise.position < 10 * noise


@pytest.mark.parametrize("kind", ["optitrack", "vicon", "tum", "columns", "crazyswarm"])
def test_exports_of_motion_capture(tmp_path, kind):
    """The section `log` reads what the tests of motion capture declare by hand: same times and positions."""
    make = {
        "optitrack": optitrack,
        "vicon": vicon,
        "tum": tum,
        "columns": lambda folder: columns(folder)[0],
        "crazyswarm": lambda folder: crazyswarm(folder)[0],
    }
    path = make[kind](tmp_path)
    model, text = started(path, tmp_path)
    assert model.log is not None
    log = read_log(path, form=model.log)
    assert len(log.bodies) == 2
    step = 0.01 if kind in ("tum", "crazyswarm") else 1 / 120
    np.testing.assert_allclose(log.t, step * np.arange(6), atol=2e-9)
    scale = 100 if kind == "columns" else 1  # centimetres, which this table does not say: the line asks for it
    np.testing.assert_allclose(log.x[0, 0], np.array([0.5, -1.0]) * scale, atol=1e-6)
    assert ("unit: m" in text) or kind not in ("columns", "crazyswarm")
    assert model.velocity == ("logged" if kind == "crazyswarm" else "differentiated")


def line(k: int, shift: float) -> tuple[float, float]:
    return 0.1 * k + shift, shift


def drift(parent: str, child: str) -> list[object]:
    return [transforms(k * 50 * MS, {child: (0.01 * k, 0.0)}, parent) for k in range(6)]


def twists(robot: int, frame: str) -> list[object]:
    return [odometry(k * 50 * MS, line(k, robot), (2.0, 0.0), frame=frame) for k in range(6)]


@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        (
            {"/r1/odom": twists(1, "world"), "/r2/odom": twists(2, "world")},
            {"topics": {"/r1/odom": "r1", "/r2/odom": "r2"}},
        ),
        (  # an Odometry is taken before a pose of the same robot
            {
                "/r1/odom": twists(1, "world"),
                "/r1/amcl_pose": [pose(k * 50 * MS, line(k, 1)) for k in range(6)],
                "/r2/odom": twists(2, "world"),
            },
            {"topics": {"/r1/odom": "r1", "/r2/odom": "r2"}},
        ),
        (  # names below a common namespace
            {f"/mocap/{name}/pose": [pose(k * 50 * MS, line(k, j)) for k in range(6)] for j, name in enumerate("ab")},
            {"topics": {"/mocap/a/pose": "a", "/mocap/b/pose": "b"}},
        ),
        (  # frames of their own, joined by transforms
            {
                **{f"/r{j}/odom": twists(j, f"r{j}/odom") for j in (1, 2)},
                "/tf": [*drift("map", "r1/odom"), *drift("map", "r2/odom")],
            },
            {"topics": {"/r1/odom": "r1", "/r2/odom": "r2"}, "fixed_frame": "map"},
        ),
        (  # a topic tf for each robot, whose frames have no prefix
            {
                f"/r{j}/{name}": of
                for j in (1, 2)
                for name, of in (("odom", twists(j, "odom")), ("tf", drift("map", "odom")))
            },
            {"topics": {"/r1/odom": "r1", "/r2/odom": "r2"}, "fixed_frame": "map"},
        ),
        (  # transforms alone: the lowest frames that move, not a camera on one of them
            {
                "/tf": [
                    *(transforms(k * 50 * MS, {f"r{j}/base": line(k, j) for j in (1, 2)}, "odom") for k in range(6)),
                    *drift("map", "odom"),
                ],
                "/tf_static": [transforms(0, {"r1/camera": (0, 0.1)}, "r1/base")],
            },
            {"frames": {"r1/base": "r1", "r2/base": "r2"}, "fixed_frame": "map"},
        ),
        (
            {
                **{f"/r{j}/odom": twists(j, "world") for j in (1, 2)},
                **{f"/r{j}/accel": [acceleration(k * 50 * MS, (0.1, 0.0)) for k in range(6)] for j in (1, 2)},
            },
            {
                "topics": {"/r1/odom": "r1", "/r2/odom": "r2"},
                "accelerations": {"/r1/accel": "r1", "/r2/accel": "r2"},
            },
        ),
    ],
)
def test_bags(tmp_path, sent, expected):
    path = write_bag(tmp_path / "bag", sent)
    assert recognise(path).bag == expected
    model, _ = started(path, tmp_path)
    assert model.bag is not None
    assert (model.dynamics == "double_integrator") == ("accelerations" in expected)


def test_robots_that_drive_along_their_headings_are_unicycles(tmp_path):
    """A circle driven forwards, and the same circle driven sideways."""
    angles = np.arange(40) / 20
    for sideways in (0.0, np.pi / 2):
        sent = [
            pose(k * 50 * MS, (np.sin(a), 1 - np.cos(a)), orientation=yawed(a + sideways)) for k, a in enumerate(angles)
        ]
        path = write_bag(tmp_path / f"bag{sideways:.0f}", {"/r1/pose": sent})
        (tmp_path / f"{sideways:.0f}").mkdir()
        model, _ = started(path, tmp_path / f"{sideways:.0f}")
        assert (model.body is not None) == (sideways == 0.0)


def test_a_bag_that_is_a_log_has_its_bodies(run, tmp_path):
    log = read_log(write_log(tmp_path / "log.csv", run, BODIES))
    model, _ = started(write_bag(tmp_path / "bag", odometry_of(log)), tmp_path)
    assert model.obstacles == ("robot2",)
    assert model.task.gain == pytest.approx(0.9, rel=1e-3)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("content", "expected"),
    [("a,b\n1,2\n", "no positions found"), ("", "the file is empty"), ("t,robot,x,y\n0,a,1,2\n", "a single time")],
)
def test_what_is_no_log_is_one_line(tmp_path, capsys, content, expected):
    log = tmp_path / "log.csv"
    log.write_text(content)
    assert main(["init", str(log), "--out", str(tmp_path / "c.yaml")]) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1
    assert not (tmp_path / "c.yaml").exists()


def test_names_that_yaml_reads_as_something_else(tmp_path):
    """Names stay names: numbers, truth values, quotes, line breaks and what is not ASCII."""
    names = ["010", "no", 'a"b: #', "Ω", "1e3", "two\nlines: [", "</script>"]
    log = tmp_path / "log.csv"
    rows = [
        f'{k},"{name.replace(chr(34), chr(34) * 2)}",{j + (k if j < 1 else 0)},0'
        for k in range(5)
        for j, name in enumerate(names)
    ]
    log.write_text("t,robot,x,y\n" + "\n".join(rows))
    model, text = started(log, tmp_path)
    assert model.obstacles == tuple(names[1:])
    assert yaml.safe_load(text)["obstacles"] == names[1:]


def test_far_from_the_origin(run, tmp_path):
    """In metres of a map grid, the prior is a box around the robots as it is at the origin."""
    far = replace(run, x=run.x + torch.tensor([500_000.0, 5_400_000.0], dtype=torch.float64))
    near, _ = started(write_log(tmp_path / "near.csv", run, BODIES), tmp_path)
    (tmp_path / "started.yaml").unlink()
    model, _ = started(write_log(tmp_path / "far.csv", far, BODIES), tmp_path)
    for corner in ("lower", "upper"):
        offset = np.subtract(getattr(model.prior, corner), getattr(near.prior, corner))
        np.testing.assert_allclose(offset, [500_000.0, 5_400_000.0], atol=2e-3)


def test_a_bag_of_drones_is_in_space(tmp_path):
    """Heights that change say so: the prior has three entries. Observed in the plane, such a bag is refused."""
    drones = {
        f"/{name}/odom": [
            odometry(k * 50 * MS, (side * (2 - 0.05 * k), 0.1, 1 + 0.02 * k), (-side, 0.0, 0.4)) for k in range(40)
        ]
        for name, side in (("a", 1.0), ("b", -1.0))
    }
    model, _ = started(write_bag(tmp_path / "bag", drones), tmp_path)
    assert len(model.prior.lower) == 3
    assert model.prior.lower[2] < 1 < 1.78 < model.prior.upper[2]
