"""ROS bags that are refused, or damaged: one clear line."""

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin

from tests.bag_logs import CSV, refusal, section
from tests.bag_writer import odometry, odometry_of, pose, section_of, transforms, write_bag
from torchfsid.errors import ConfigError, FsidError
from torchfsid.logs.log import Log
from torchfsid.logs.messages import ODOMETRY, POSE, TRANSFORMS
from torchfsid.logs.read import read_log
from torchfsid.logs.table_log import read_csv

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def csv_log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    path = tmp_path_factory.mktemp("csv") / "log.csv"
    path.write_text(CSV)
    return read_csv(path)


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
