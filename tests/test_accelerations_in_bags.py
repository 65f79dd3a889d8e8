"""Accelerations in ROS 2 bags: at the stamps of the positions, or at their own, within the bounds that are told."""

from __future__ import annotations

import numpy as np
import pytest

from tests.bag_logs import refusal, section
from tests.bag_writer import acceleration, odometry, odometry_of, section_of, write_bag
from tests.logs import write_log
from tests.test_second_order_logs import CONFIG, a_run, are_inside, observed
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.config.documents import validate
from torchfsid.config.observe import ObserveConfig
from torchfsid.errors import ConfigError, LogError
from torchfsid.logs.bags import read_bag
from torchfsid.logs.table_log import read_csv

SECOND = 1_000_000_000
BODIES = ["ann", "bob", "cyd", "dan", "post"]


@pytest.fixture(scope="module")
def csv_log(tmp_path_factory):
    return read_csv(write_log(tmp_path_factory.mktemp("log") / "log.csv", a_run()[1], BODIES))


def accelerations_of(log, frame="world"):
    stamps = np.rint(log.t * 1e9).astype(int).tolist()
    return {
        f"/robot{j}/accel": [acceleration(stamp, log.a[k, j], frame) for k, stamp in enumerate(stamps)]
        for j in range(len(log.bodies))
    }


def mapped(log):
    return {**section_of(log), "accelerations": {f"/robot{j}/accel": body for j, body in enumerate(log.bodies)}}


@pytest.mark.usefixtures("undrawn")
def test_a_bag_is_the_csv_log(csv_log, tmp_path):
    bag = write_bag(tmp_path / "bag", odometry_of(csv_log) | accelerations_of(csv_log))
    log = read_bag(bag, section(**mapped(csv_log)))
    for name in ("x", "u", "a", "seen", "velocity_known", "acceleration_known"):
        np.testing.assert_array_equal(getattr(log, name), getattr(csv_log, name))
    assert are_inside(observed(bag, {**CONFIG, "bag": mapped(csv_log)}, tmp_path / "out"), a_run()[0])


def test_accelerations_at_other_stamps_are_within_their_bounds(tmp_path):
    """A smooth motion whose accelerations are sampled between its positions."""

    def place(t):
        return np.sin(t), np.cos(0.7 * t)

    def velocity(t):
        return np.cos(t), -0.7 * np.sin(0.7 * t)

    def pull(t):
        return -np.sin(t), -0.49 * np.cos(0.7 * t)

    stamps = [round(0.05 * k * SECOND) for k in range(60)]
    late = [stamp + SECOND // 60 for stamp in stamps[:-1]]
    messages = {
        "/odom": [odometry(s, place(s / SECOND), velocity(s / SECOND)) for s in stamps],
        "/accel": [acceleration(s, pull(s / SECOND)) for s in late],
    }
    log = read_bag(write_bag(tmp_path / "bag", messages), section(topics={"/odom": "r"}, accelerations={"/accel": "r"}))
    known = log.acceleration_known[:, 0]
    assert known[1:-1].all()
    assert not known[[0, -1]].any()
    off = np.linalg.norm(log.a[:, 0] - np.stack(pull(log.t), axis=-1), axis=-1)[known]
    told = log.acceleration_error[:, 0][known]
    assert (off <= told).all()
    assert told.max() < 0.05
    with pytest.raises(LogError, match=r"bag\.accelerations"):
        log.accelerated(0.0)


def test_what_is_refused(csv_log, tmp_path):
    bag = write_bag(tmp_path / "bag", odometry_of(csv_log) | accelerations_of(csv_log, frame="base_link"))
    assert "accelerations in the frame 'base_link', not 'world'" in refusal(bag, section(**mapped(csv_log)))
    with pytest.raises(ConfigError, match=r"accelerations\./b: expected one topic for each of"):
        section(topics={"/a": "r"}, accelerations={"/b": "s"})
    assert "is of type 'nav_msgs/msg/Odometry', expected geometry_msgs/msg/AccelStamped" in refusal(
        bag, section(topics={"/robot0/odom": "r"}, accelerations={"/robot1/odom": "r"})
    )
    some = {**mapped(csv_log), "accelerations": {"/robot0/accel": "ann"}}
    whole = write_bag(tmp_path / "some", odometry_of(csv_log) | accelerations_of(csv_log))
    config = validate(CONFIG, ObserveConfig, "config")
    with pytest.raises(ConfigError, match="rows use the accelerations of all bodies, and 'bob' has none"):
        DeclaredLog(config, read_bag(whole, section(**some)))
