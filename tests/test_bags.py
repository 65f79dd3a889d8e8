"""ROS bags, real ones: what is read is what a CSV log of the same motion says."""

import json
import subprocess
import sys

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from tests.bag_logs import CSV, refusal, section
from tests.bag_writer import odometry, odometry_of, pose, section_of, transforms, write_bag, yawed
from torchfsid.cli import main
from torchfsid.errors import LogError
from torchfsid.logs.bags import read_bag
from torchfsid.logs.log import Log
from torchfsid.logs.read import read_log
from torchfsid.logs.table_log import read_csv

FIELDS = ("t", "x", "u", "seen", "velocity_known", "radius", "position_error", "velocity_error", "lost")
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def csv_log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    path = tmp_path_factory.mktemp("csv") / "log.csv"
    path.write_text(CSV)
    return read_csv(path)


# What a bag means.


@pytest.mark.parametrize(
    ("storage", "compression"),
    [
        (StoragePlugin.SQLITE3, CompressionMode.NONE),
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
        (StoragePlugin.MCAP, CompressionMode.NONE),
        (StoragePlugin.MCAP, CompressionMode.FILE),
        (StoragePlugin.MCAP, CompressionMode.MESSAGE),
        (StoragePlugin.MCAP, CompressionMode.STORAGE),
    ],
)
def test_synchronous_odometry_is_the_csv_log(csv_log, tmp_path, storage, compression):
    folder = write_bag(tmp_path / "bag", odometry_of(csv_log), storage, compression)
    bag = section(**section_of(csv_log))
    files = [path for path in folder.iterdir() if path.suffix != ".yaml"]
    if compression in (CompressionMode.FILE, CompressionMode.MESSAGE):
        files = []  # only metadata.yaml says how they are compressed
    for path in (folder, *files):
        log = read_log(path, bag)
        assert log.bodies == csv_log.bodies
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(log, name), getattr(csv_log, name))


@pytest.mark.parametrize("yaw", [0.3, np.pi / 2, -3.0])
def test_twists_of_turned_robots_are_turned_back(csv_log, tmp_path, yaw):
    log = read_bag(write_bag(tmp_path / "bag", odometry_of(csv_log, yaw)), section(**section_of(csv_log)))
    np.testing.assert_array_equal(log.x, csv_log.x)
    np.testing.assert_allclose(log.u, csv_log.u, rtol=0, atol=1e-15)


def test_a_robot_that_is_tilted(tmp_path):
    """Pitched by 60 degrees, then yawed by 90: forward motion shows half its speed in the plane, along y."""
    pitch, yaw = np.pi / 6, np.pi / 4
    orientation = (np.cos(yaw) * np.cos(pitch), -np.sin(yaw) * np.sin(pitch), np.cos(yaw) * np.sin(pitch))
    orientation = (*orientation, np.sin(yaw) * np.cos(pitch))
    messages = [odometry(k * SECOND, (0, 0), (1, 0), orientation) for k in range(2)]
    log = read_bag(write_bag(tmp_path / "bag", {"/odom": messages}), section(topics={"/odom": "r"}))
    np.testing.assert_allclose(log.u, [[[0, 0.5]], [[0, 0.5]]], atol=1e-15)


def test_a_twist_in_the_frame_of_the_positions_is_not_turned(tmp_path):
    messages = [odometry(k * SECOND, (0, 0), (1, 0), yawed(1.0), frame="map", child="map") for k in range(2)]
    log = read_bag(write_bag(tmp_path / "bag", {"/odom": messages}), section(topics={"/odom": "r"}))
    np.testing.assert_array_equal(log.u, [[[1, 0]], [[1, 0]]])


def test_poses_need_differences(csv_log, tmp_path):
    stamps = np.rint(csv_log.t * 1e9).astype(int).tolist()
    poses = {
        f"/{body}/pose": [pose(stamp, csv_log.x[k, j]) for k, stamp in enumerate(stamps)]
        for j, body in enumerate(csv_log.bodies)
    }
    log = read_bag(write_bag(tmp_path / "bag", poses), section(topics={"/ann/pose": "ann", "/bob/pose": "bob"}))
    assert log.u is None
    with pytest.raises(LogError, match="take `velocity: differentiated`"):
        log.measurements(["ann"], ())
    for name in ("t", "x", "u", "seen", "velocity_known"):
        np.testing.assert_array_equal(getattr(log.differentiated(), name), getattr(csv_log.differentiated(), name))


def test_transforms(csv_log, tmp_path):
    """Two frames of one message each time, others beside them, one transform sent twice."""
    stamps = np.rint(csv_log.t * 1e9).astype(int).tolist()
    sent = [
        transforms(stamp, {"ann/base": csv_log.x[k, 0], "wheel": (9, 9), "bob/base": csv_log.x[k, 1]})
        for k, stamp in enumerate(stamps)
    ]
    path = write_bag(tmp_path / "bag", {"/tf": [*sent, sent[2]]})
    log = read_bag(path, section(frames={"ann/base": "ann", "bob/base": "bob"}))
    for name in ("t", "x", "seen"):
        np.testing.assert_array_equal(getattr(log, name), getattr(csv_log, name))
    assert "called 'carl/base'; there are ['ann/base', 'bob/base', 'wheel']" in refusal(
        path, section(frames={"carl/base": "carl"})
    )


def test_topics_and_frames_in_the_order_of_the_config(tmp_path):
    path = write_bag(
        tmp_path / "bag",
        {
            "/tf": [transforms(k * SECOND, {"base": (k, 0)}, frame="/world") for k in range(3)],
            "/odom": [odometry(k * SECOND, (k, 1), (1, 0)) for k in range(3)],
            "/pose": [pose(k * SECOND, (k, 2)) for k in range(3)],
            "/other": [pose(k * SECOND, (k, 3), frame="elsewhere") for k in range(3)],
        },
    )
    bag = section(topics={"/pose": 7, "/odom": "r"}, frames={"base": "b"}, radius={7: 0.1, "r": 0.2, "b": 0.3})
    log = read_bag(path, bag)
    assert log.bodies == ("7", "r", "b")
    assert log.x[2].tolist() == [[2, 2], [2, 1], [2, 0]]
    assert log.velocity_known.tolist() == [[False, True, False]] * 3
    assert log.radius is not None
    assert log.radius.tolist() == [0.1, 0.2, 0.3]


def test_stamps_order_the_messages(csv_log, tmp_path):
    late = {topic: messages[::-1] for topic, messages in odometry_of(csv_log).items()}
    log = read_bag(write_bag(tmp_path / "bag", late), section(**section_of(csv_log)))
    np.testing.assert_array_equal(log.t, csv_log.t)
    np.testing.assert_array_equal(log.x, csv_log.x)


def test_times_since_1970_keep_their_nanoseconds(tmp_path):
    """Differences of asynchronous bodies are taken of whole nanoseconds, not of rounded seconds."""
    start, period = 1_790_000_000 * SECOND, 20_000_000
    poses = {f"/{j}": [pose(start + k * period + 7 * j * 1_000_000, (0.02 * k, j)) for k in range(8)] for j in range(2)}
    log = read_bag(write_bag(tmp_path / "bag", poses), section(topics={"/0": "a", "/1": "b"})).differentiated()
    assert log.u is not None
    np.testing.assert_allclose(log.u[log.velocity_known], [[1, 0]] * int(log.velocity_known.sum()), atol=1e-12)


def test_the_clock(tmp_path):
    bodies = {
        "/a": [odometry(int(k * 0.1 * SECOND), (0.1 * k, 0), (1, 0)) for k in range(11)],
        "/b": [odometry(int(k * 0.07 * SECOND), (0.07 * k, 1), (1, 0)) for k in range(11)],
    }
    path = write_bag(tmp_path / "bag", bodies)
    topics = {"/a": "a", "/b": "b"}
    np.testing.assert_allclose(read_bag(path, section(topics=topics)).t, 0.1 * np.arange(11))
    np.testing.assert_allclose(read_bag(path, section(topics=topics, rate=3.0)).t, [0, 1 / 3, 2 / 3, 1], atol=1e-9)
    assert refusal(path, section(topics=topics, rate=0.5)).startswith("bag.rate: 0.5 Hz makes 1.5 times")
    assert refusal(path, section(topics=topics, rate=1e300)).startswith("bag.rate: 1e+300 Hz makes 1e+300 times")


def test_observe_gives_the_same_regions_as_from_csv(csv_log, tmp_path, capsys):
    config = {
        "task": {"kind": "goal", "gain": 0.5},
        "barriers": [{"kind": "avoidance", "margin": 0.1, "class_k": {"gain": 1}, "neighbour_velocity": "current"}],
        "prior": {"lower": [-5, -5], "upper": [5, 5]},
        "noise": {"velocity": 0.01},
        "bag": section_of(csv_log),
    }
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    (tmp_path / "log.csv").write_text(CSV)
    write_bag(tmp_path / "bag", odometry_of(csv_log))
    results = []
    for log in ("log.csv", "bag"):
        out = tmp_path / "out" / log
        arguments = ["observe", str(tmp_path / log), "--config", str(tmp_path / "config.yaml"), "--out", str(out)]
        assert main(arguments) == 0
        found = json.loads((out / "regions.json").read_text())
        assert found.pop("made_from")["log"] == str(tmp_path / log)
        results.append([found, *((out / name).read_bytes() for name in ("estimates.csv", "config.yaml"))])
    assert results[0] == results[1]

    capsys.readouterr()
    assert main([*arguments, "--set", "bag.topics={/odom: ann}", "--set", "bag.radius={ann: 1}"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_reading_does_not_wait_for_torch_or_ros():
    slow = {"torch", "rosbags", "pyarrow"}
    code = f"import sys, torchfsid.logs.read, torchfsid.config.observe; sys.exit(bool({slow} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_writer_is_a_script(csv_log, tmp_path):
    (tmp_path / "log.csv").write_text(CSV)
    command = [sys.executable, "-m", "tests.bag_writer", str(tmp_path / "log.csv"), str(tmp_path / "bag")]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    bag = section(**yaml.safe_load(printed)["bag"])
    np.testing.assert_array_equal(read_log(tmp_path / "bag", bag).x, csv_log.x)
