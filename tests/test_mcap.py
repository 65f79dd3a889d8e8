"""A run as ROS messages: read back, it is estimates.csv and regions.json; and it is a log again."""

import csv
import json
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from rosbags.rosbag2 import Reader, Writer
from rosbags.typesys import Stores, get_typestore

from tests.bag_writer import odometry_of, section_of, write_bag
from tests.logs import write_log
from torchfsid.cli import main
from torchfsid.commands.run_in_mcap import outline
from torchfsid.halfspaces import Halfspaces
from torchfsid.logs.table_log import read_csv
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet

BODIES = ["7", "bob b", "pillar"]
NAMED = {"7": "robot_7", "bob b": "bob_b", "pillar": "pillar"}
CONFIG = {
    "task": {"kind": "goal", "gain": 0.9},
    "barriers": [{"kind": "avoidance", "safety_distance": 0.5, "class_k": {"gain": 1.5}}],
    "prior": {"lower": [-5, -5], "upper": [5, 5]},
    "noise": {"velocity": 1e-6},
    "obstacles": ["pillar"],
}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """30 samples of two robots that pass each other beside a pillar."""
    controller = CbfQpController(GoalTask(0.9), [CollisionAvoidance(ClassK(1.5), safety_distance=0.5)])
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3]], dtype=torch.float64)
    goals = torch.tensor([[2.0, 0.1], [-2.0, 0.0]], dtype=torch.float64)
    run = simulate(controller, goals, start, dt=0.08, steps=30, obstacles=torch.tensor([[0.2, 1.0]]))
    return write_log(tmp_path_factory.mktemp("log") / "log.csv", run, BODIES)


def observed(log: Path, folder: Path, *options: str, **changes: object) -> Path:
    """The file of a run in `folder`."""
    config = folder / "config.yaml"
    config.write_text(yaml.safe_dump({**CONFIG, **changes}))
    made = folder / "run.mcap"
    arguments = ["observe", str(log), "--config", str(config), "--out", str(folder / "out"), "--mcap", str(made)]
    assert main([*arguments, *options]) == 0
    return made


def messages(path: Path) -> dict[str, list]:
    """The messages of a bag by topic, each with its time of reception."""
    decode = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr
    found = defaultdict(list)
    with Reader(path) as reader:
        for connection, time, raw in reader.messages():
            found[connection.topic].append((time, decode(raw, connection.msgtype)))
    return found


def seconds(message: object) -> float:
    stamp = message.header.stamp  # type: ignore[attr-defined]
    return stamp.sec + 1e-9 * stamp.nanosec


def points(marker: object) -> np.ndarray:
    return np.array([[p.x, p.y] for p in marker.points])  # type: ignore[attr-defined]


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("gain", [0.9, 0.3])  # right, and so wrong that sets are refuted
def test_what_is_read_back_is_the_results(log, tmp_path, gain):
    found = messages(observed(log, tmp_path, task={"kind": "goal", "gain": gain}))
    rows = list(csv.DictReader((tmp_path / "out" / "estimates.csv").open()))
    regions = json.loads((tmp_path / "out" / "regions.json").read_text())["robots"]
    assert (regions["7"]["status"] == "ok") == (gain == 0.9)

    told = [status for _, message in found["/torchfsid/status"] for status in message.status]
    assert [{pair.key: pair.value for pair in status.values} for status in told] == rows
    assert [status.message for status in told] == [row["status"] for row in rows]
    assert [status.level for status in told] == [["ok", "alarm", "inconsistent"].index(row["status"]) for row in rows]
    for topic, of_topic in found.items():
        for time, message in of_topic if topic.startswith("/torchfsid/") else ():
            first = message.markers[0] if hasattr(message, "markers") else message
            assert round(seconds(first) * 1e9) == time, topic
    for robot in ("7", "bob b"):
        mine = [row for row in rows if row["robot"] == robot]
        for name in ("centroid", "hybrid", "ukf"):
            of_name = found[f"/torchfsid/{NAMED[robot]}/{name}"]
            assert [float(row["t"]) for row in mine] == pytest.approx([seconds(m) for _, m in of_name], abs=1e-9)
            here = [[m.pose.position.x, m.pose.position.y] for _, m in of_name]
            assert here == [[float(row[f"{name}_{i}"]) for i in (0, 1)] for row in mine]

        course = found[f"/torchfsid/{NAMED[robot]}/region"]
        last = {marker.ns: marker for marker in course[-1][1].markers}
        np.testing.assert_array_equal(points(last["outline"])[::2], regions[robot]["vertices"])
        np.testing.assert_array_equal(points(last["prior"])[::2].max(axis=0), [5, 5])
        assert last["label"].text == f"{robot}: {regions[robot]['status']}"
        # Between two messages nothing has changed: each is the set of all times up to the next.
        volumes = {float(row["t"]): float(row["volume"]) for row in mine}
        times = [seconds(message.markers[0]) for _, message in course]
        for t, volume in volumes.items():
            _, message = course[int(np.searchsorted(times, t + 1e-6)) - 1]
            outline = points(next(marker for marker in message.markers if marker.ns == "outline"))
            x, y, after = outline[::2, 0], outline[::2, 1], outline[1::2]
            assert abs((x * after[:, 1] - y * after[:, 0]).sum()) / 2 == pytest.approx(volume, rel=1e-9)


@pytest.mark.usefixtures("undrawn")
def test_it_is_a_log_again(log, tmp_path):
    """Positions and velocities of all bodies, as they were: observed again, the same sets."""
    made = observed(log, tmp_path, ukf=False)
    (tmp_path / "again").mkdir()
    bag = {"topics": {f"/torchfsid/{name}/odom": body for body, name in NAMED.items()}}
    observed(made, tmp_path / "again", bag=bag, ukf=False)
    first, second = (
        json.loads((folder / "out" / "regions.json").read_text())["robots"] for folder in (tmp_path, tmp_path / "again")
    )
    for robot in first:
        np.testing.assert_allclose(first[robot]["vertices"], second[robot]["vertices"], atol=1e-6)


@pytest.mark.usefixtures("undrawn")
def test_beside_the_messages_of_a_bag(log, tmp_path):
    """All messages of the bag, and ours in the frame of its positions."""
    source = read_csv(log)
    bag = write_bag(tmp_path / "bag", odometry_of(source))
    before = messages(bag)
    after = messages(observed(bag, tmp_path, "--merge", bag=section_of(source), ukf=False))
    for topic, of_topic in before.items():
        assert [time for time, _ in after[topic]] == [time for time, _ in of_topic]
    assert len(after["/torchfsid/status"]) == len(source.t)
    _, region = after["/torchfsid/robot_7/region"][-1]
    assert {marker.header.frame_id for marker in region.markers} == {"world"}


@pytest.mark.parametrize(
    ("options", "changes", "expected"),
    [
        (["--mcap", "{folder}/run.bag"], {}, "expected a name that ends with .mcap"),
        (["--mcap", "{folder}/there.mcap"], {}, "is there, and is not replaced"),
        (["--mcap", "{folder}/no/run.mcap"], {}, "is no folder"),
        (["--merge"], {}, "expected --mcap beside it"),
        (["--mcap", "{folder}/run.mcap", "--merge"], {}, "the config has no section bag"),
        (
            ["--mcap", "{folder}/run.mcap"],
            {"barriers": [{**CONFIG["barriers"][0], "distance": ["squared", "euclidean"]}]},  # type: ignore[index]
            "several hypotheses",
        ),
    ],
)
def test_refusals_come_first(log, tmp_path, capsys, options, changes, expected):
    (tmp_path / "there.mcap").touch()
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump({**CONFIG, **changes}))
    arguments = ["observe", str(log), "--config", str(config), "--out", str(tmp_path / "out")]
    try:
        code = main([*arguments, *(option.format(folder=tmp_path) for option in options)])
    except SystemExit as stop:
        code = stop.code
    assert code == 2
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_times_below_zero_are_none_of_ros(log, tmp_path, capsys):
    earlier = tmp_path / "log.csv"
    header, *lines = log.read_text().splitlines()
    moved = [f"{float(line.partition(',')[0]) - 1},{line.partition(',')[2]}" for line in lines]
    earlier.write_text("\n".join([header, *moved]))
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(CONFIG))
    arguments = ["observe", str(earlier), "--config", str(config), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--mcap", str(tmp_path / "run.mcap")]) == 2
    assert "the log begins at -1 s" in capsys.readouterr().err


def test_without_the_extra(log, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "rosbags.rosbag2", None)
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(CONFIG))
    arguments = ["observe", str(log), "--config", str(config), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--mcap", str(tmp_path / "run.mcap")]) == 2
    assert "pip install 'torchfsid[ros]'" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_a_full_disk_leaves_no_half_file(log, tmp_path, monkeypatch, capsys):
    """The sets are still there, and the error says which file is missing."""

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Writer, "write", full)
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump({**CONFIG, "ukf": False}))
    arguments = ["observe", str(log), "--config", str(config), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--mcap", str(tmp_path / "run.mcap")]) == 1
    assert f"{tmp_path}/run.mcap: No space left on device" in capsys.readouterr().err
    assert (tmp_path / "out" / "regions.json").exists()
    assert not list(tmp_path.glob("run.mcap*"))


@pytest.mark.parametrize("cuts", [0, 1, 12])
def test_edges_of_a_set_in_space(cuts):
    """Euler: vertices - edges + faces = 2. Every edge lies on two faces, every vertex has three edges or more."""
    ones = torch.ones(1, 3, dtype=torch.float64)
    generator = torch.Generator().manual_seed(7)
    A = torch.randn(1, cuts, 3, generator=generator, dtype=torch.float64)
    sets = FeasibleSet.from_box(-ones, ones).intersect(Halfspaces(A, 0.7 * A.norm(dim=-1)))
    vertices, edges = outline(sets, 0)
    rows = sets.facets().halfspaces
    gaps = np.abs(vertices @ rows.A[0].numpy().T - rows.b[0].numpy())
    faces = int(((gaps < 1e-9).sum(axis=0) >= 3).sum())
    assert len(vertices) - len(edges) + faces == 2
    assert ((gaps[edges] < 1e-9).all(axis=1).sum(axis=1) == 2).all()
    assert np.bincount(edges.reshape(-1)).min() >= 3
