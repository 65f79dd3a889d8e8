"""ROS bags, real ones: what is read is what a CSV log of the same motion says; what is wrong is one clear line."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from tests.bag_writer import odometry, odometry_of, pose, section_of, transforms, write_bag, yawed
from torchfsid.cli import main
from torchfsid.config.bags import BagConfig
from torchfsid.config.documents import validate
from torchfsid.errors import ConfigError, FsidError, LogError
from torchfsid.logs.bags import read_bag
from torchfsid.logs.log import Log
from torchfsid.logs.messages import ODOMETRY, POSE, TRANSFORMS
from torchfsid.logs.read import read_log
from torchfsid.logs.table_log import read_csv

CSV = """t,robot,x,y,vx,vy,radius
0,ann,-1.4999999999999998,0.25,0.12499999999999999,-0.5,0.2
0,bob,1.1,0.3,-0.7,0.01,0.25
0.033,ann,-1.49,0.23,0.13,-0.49,0.2
0.033,bob,1.08,0.31,-0.69,0.02,0.25
0.066,ann,-1.48,0.21,0.14,-0.48,0.2
0.066,bob,1.06,0.32,-0.68,0.03,0.25
0.1,ann,-1.47,0.19,0.15,-0.47,0.2
0.1,bob,1.04,0.33,-0.67,0.04,0.25
"""
FIELDS = ("t", "x", "u", "seen", "velocity_known", "radius", "position_error", "velocity_error", "lost")
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def csv_log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    path = tmp_path_factory.mktemp("csv") / "log.csv"
    path.write_text(CSV)
    return read_csv(path)


def section(**fields: object) -> BagConfig:
    return validate(fields, BagConfig, source="bag")


def refusal(path: Path, bag: BagConfig) -> str:
    """The message in which reading must end: one printable line."""
    with pytest.raises((LogError, ConfigError)) as caught:
        read_log(path, bag)
    message = str(caught.value)
    assert message.isprintable(), message
    return message


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


# What is refused, and how.


def test_wrong_mappings(csv_log, tmp_path):
    others = {"/tf": [transforms(0, {"a": (0, 0)})] * 2, "/mixed": [odometry(0, (0, 0), (0, 0)), pose(1, (0, 0))]}
    path = write_bag(tmp_path / "bag", odometry_of(csv_log) | others)
    assert "no topic is called '/robot7/odom'; there are ['/mixed', '/robot0/odom', '/robot1/odom', '/tf']" in refusal(
        path, section(topics={"/robot7/odom": "ann"})
    )
    for topic, kind in {"/tf": f"'{TRANSFORMS}'", "/mixed": f"'{POSE}' and '{ODOMETRY}'"}.items():
        message = refusal(path, section(topics={topic: "ann"}))
        assert f"topic '{topic}' is of type {kind}, expected {ODOMETRY} or {POSE}" in message
    assert "frame 'a': expected at least 2 messages with different stamps, got 1" in refusal(
        path, section(frames={"a": "ann"})
    )
    with pytest.raises(ConfigError, match="bag: required to read a ROS bag"):
        read_log(path)


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({}, "bag: the file: expected topics (topic: robot), frames (child frame: robot), or both"),
        ({"topics": {"/a": "r", "/b": "r"}}, "bag: the file: 2 topics or frames are mapped to 'r'"),
        ({"topics": {"/a": "r"}, "frames": {"f": "r"}}, "bag: the file: 2 topics or frames are mapped to 'r'"),
        ({"topics": {"/a": ""}}, "bag: topics./a: expected a name"),
        (
            {"topics": {"/a": "r"}, "radius": {"s": 1}},
            "bag: radius: expected a radius for each of ['r'], got {'s': 1.0}",
        ),
        ({"topics": {"/a": "r"}, "radius": {"r": -1}}, "bag: radius.r: "),
        ({"topics": {"/a": "r"}, "rate": 0}, "bag: rate: "),
        ({"topics": {"/a": "r"}, "frequency": 5}, "bag: frequency: unknown key"),
    ],
)
def test_wrong_sections(fields, expected):
    with pytest.raises(ConfigError) as caught:
        section(**fields)
    assert str(caught.value).startswith(expected)


NAN = float("nan")
WRONG = {
    "finite number of at most 1e+12 everywhere, got (nan, 0.0, 1.0, 0.0) at t = 1.0 s": lambda k: odometry(
        k * SECOND, (NAN, 0), (1, 0)
    ),
    "expected a unit quaternion, got (0.0, 0.0, 0.0, 0.0)": lambda k: odometry(k * SECOND, (0, 0), (1, 0), (0.0,) * 4),
    "different messages have the same stamp, 0.0 s": lambda k: odometry(0, (k, 0), (1, 0)),
    "positions in different frames: 'odom1' (topic '/odom') and 'odom2' (topic '/odom')": (
        lambda k: odometry(k * SECOND, (0, 0), (1, 0), frame=f"odom{k}")
    ),
}


@pytest.mark.parametrize("expected", WRONG)
def test_wrong_messages(tmp_path, expected):
    path = write_bag(tmp_path / "bag", {"/odom": [WRONG[expected](k) for k in (1, 2)]})
    message = refusal(path, section(topics={"/odom": "r"}))
    assert message.startswith(f"{path}: ")
    assert expected in message


def test_bodies_that_share_no_time(tmp_path):
    path = write_bag(
        tmp_path / "bag",
        {f"/{j}": [odometry((10 * j + k) * SECOND, (0, 0), (1, 0)) for k in range(5)] for j in range(2)},
    )
    assert refusal(path, section(topics={"/0": "a", "/1": "b"})) == (
        f"{path}: at no time of the clock are all bodies known: 'a' from 0.0 to 4.0 s, 'b' from 10.0 to 14.0 s"
    )


@pytest.mark.parametrize("name", ["none.mcap", "none.db3", "text.mcap", "text.db3", "folder"])
def test_what_is_no_bag(tmp_path, name):
    path = tmp_path / name
    if name.startswith("text"):
        path.write_text("t,robot,x,y\n")
    elif name == "folder":
        path.mkdir()
    assert refusal(path, section(topics={"/a": "a"})).startswith(f"{path}: ")


def test_without_the_extra(tmp_path, monkeypatch):
    path = tmp_path / "log.mcap"
    path.touch()
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    assert refusal(path, section(topics={"/a": "a"})) == f"{path}: ROS bags need an extra: pip install 'torchfsid[ros]'"


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory, csv_log) -> dict[str, bytes]:
    """A file of each storage, small."""
    folder, content = tmp_path_factory.mktemp("bags"), {}
    for storage in StoragePlugin:
        write_bag(folder / storage.name, odometry_of(csv_log), storage)
        (file,) = (path for path in (folder / storage.name).iterdir() if path.suffix != ".yaml")
        content[file.suffix] = file.read_bytes()
    return content | {".yaml": (folder / "SQLITE3" / "metadata.yaml").read_bytes()}


@settings(deadline=None, derandomize=True, max_examples=150)
@given(data=st.data())
def test_damaged_bags_are_one_line(bags, csv_log, tmp_path_factory, data):
    """Cut off, overwritten, with bytes missing, or a single byte changed: one line, or a log of finite numbers."""
    suffix = data.draw(st.sampled_from(sorted(bags)))
    content = bags[suffix]
    first, second = sorted(data.draw(st.tuples(*[st.integers(0, len(content))] * 2)))
    damage = data.draw(st.sampled_from([b"", b"\xff" * (second - first), b"\x00" * (second - first), b"end", None]))
    if damage is None:
        second, damage = first + 1, data.draw(st.binary(min_size=1, max_size=1))
    folder = tmp_path_factory.mktemp("damaged")
    path = folder / f"log{suffix}"
    if suffix == ".yaml":
        path = folder
        (folder / "SQLITE3.db3").write_bytes(bags[".db3"])
        (folder / "metadata.yaml").write_bytes(content[:first] + damage + content[second:])
    else:
        path.write_bytes(content[:first] + damage + content[second:])
    message, log = "", None
    try:
        log = read_log(path, section(**section_of(csv_log)))
    except FsidError as error:
        message = str(error)
    assert message.isprintable()
    if log is not None:
        assert np.isfinite(log.x).all()
        assert (np.diff(log.t) > 0).all()


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
