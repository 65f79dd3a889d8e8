"""Chains of transforms in bags: map -> odom -> base_link, static and dynamic, of one robot and of fleets."""

from pathlib import Path

import numpy as np
import pytest

from tests.bag_writer import odometry, pose, transforms, write_bag, yawed
from torchfsid.config.bags import BagConfig
from torchfsid.errors import ConfigError, LogError
from torchfsid.logs.bags import read_bag
from torchfsid.logs.log import Log

MS = 1_000_000


def turn(yaw: float) -> np.ndarray:
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def correction(t: float) -> tuple[np.ndarray, float]:
    """The pose of odom in map, which drifts."""
    return np.array([1 + 0.2 * t, -0.5 + 0.05 * t]), 0.3 + 0.1 * t


def driven(t: float) -> np.ndarray:
    """The position of base_link in odom."""
    return np.array([0.4 * t, 0.1 * np.sin(t)])


def in_map(t: float) -> np.ndarray:
    p, yaw = correction(t)
    return p + turn(yaw) @ driven(t)


def link(t_ms: int, parent: str, child: str, position: np.ndarray, yaw: float = 0.0) -> object:
    return transforms(t_ms * MS, {child: position.tolist()}, parent, yawed(yaw))


def corrections(prefix: str = "", until: int = 1000) -> list[object]:
    """map -> odom every 250 ms."""
    return [link(k, "map", f"{prefix}odom", *correction(k * 1e-3)) for k in range(0, until + 1, 250)]


def odometries(prefix: str = "") -> list[object]:
    """odom -> base_link every 50 ms."""
    return [link(k, f"{prefix}odom", f"{prefix}base_link", driven(k * 1e-3)) for k in range(0, 1001, 50)]


def read(folder: Path, messages: dict, **bag: object) -> Log:
    return read_bag(write_bag(folder / "bag", messages), BagConfig.model_validate({"fixed_frame": "map", **bag}))


def within_bounds(log: Log, truth: np.ndarray) -> bool:
    """Is each position within its bound of the truth? And where both links have a message, equal to it?"""
    assert log.position_error is not None
    off = np.linalg.norm(log.x[:, 0] - truth, axis=-1)
    return bool((off <= log.position_error[:, 0] + 1e-12).all() and (off[::5] < 1e-12).all() and off.max() > 1e-6)


def test_a_chain_with_a_static_link_at_its_end(tmp_path):
    """The camera is 0.1 m to the right of base_link, which has no rotation in odom."""
    static = transforms(0, {"camera": (0, -0.1, 0.3)}, "base_link")
    messages = {"/tf": [*odometries(), *corrections()], "/tf_static": [static]}
    log = read(tmp_path, messages, frames={"base_link": "r"})
    times = np.arange(0, 1.01, 0.05)
    np.testing.assert_allclose(log.t, times)
    assert within_bounds(log, np.array([in_map(t) for t in times]))
    camera = read_bag(tmp_path / "bag", BagConfig(frames={"camera": "c"}, fixed_frame="map"))
    beside = np.array([in_map(t) + turn(correction(t)[1]) @ [0, -0.1] for t in times])
    assert within_bounds(camera, beside)


def test_headings_turn_with_the_frames(tmp_path):
    """The robot points 0.5 rad to the left of odom's x-axis, which turns in the map."""
    sent = [link(k, "odom", "base_link", driven(k * 1e-3), 0.5) for k in range(0, 1001, 50)]
    path = write_bag(tmp_path / "bag", {"/tf": [*sent, *corrections()]})
    log = read_bag(path, BagConfig(frames={"base_link": "r"}, fixed_frame="map"), with_headings=True)
    assert log.heading is not None
    expected = [0.5 + correction(t)[1] for t in np.arange(0, 1.01, 0.05)]
    np.testing.assert_allclose(log.heading[:, 0], expected, atol=1e-5)


def test_odometry_seen_from_the_map(tmp_path):
    """Positions and twists of an Odometry in odom; before the first and after the last correction nothing is known."""
    sent = [odometry(k * MS, driven(k * 1e-3).tolist(), (0.4, 0.0), frame="odom") for k in range(0, 1501, 50)]
    log = read(tmp_path, {"/odom": sent, "/tf": corrections()}, topics={"/odom": "r"})
    times = np.arange(0, 1.01, 0.05)
    np.testing.assert_allclose(log.t, times)
    assert within_bounds(log, np.array([in_map(t) for t in times]))
    assert log.u is not None
    assert log.velocity_error is not None
    off = np.linalg.norm(log.u[:, 0] - np.array([turn(correction(t)[1]) @ [0.4, 0.0] for t in times]), axis=-1)
    assert (off <= log.velocity_error[:, 0] + 1e-12).all()


def test_fleets(tmp_path):
    """Frames with a prefix on one topic, and the same frames on topics of each namespace, say the same."""
    prefixed = {"/tf": [m for ns in ("r1/", "r2/") for m in [*odometries(ns), *corrections(ns)]]}
    frames = {"r1/base_link": "a", "r2/base_link": "b"}
    one = read(tmp_path, prefixed, frames=frames)
    (tmp_path / "spaces").mkdir()
    spaces = {f"/{ns}/tf": [*odometries(), *corrections()] for ns in ("r1", "r2")}
    other = read(tmp_path / "spaces", spaces, frames=frames)
    for name in ("t", "x", "position_error"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.bodies == ("a", "b")
    (tmp_path / "topics").mkdir()
    sent = {
        f"/{ns}/pose": [pose(k * MS, driven(k * 1e-3).tolist(), "odom") for k in range(0, 1001, 50)]
        for ns in ("r1", "r2")
    }
    third = read(tmp_path / "topics", sent | spaces, topics={"/r1/pose": "a", "/r2/pose": "b"})
    np.testing.assert_allclose(third.x, one.x, atol=1e-12)


def test_stamps_since_1970_are_counted_from_the_first(tmp_path):
    start = 1_790_000_000_000
    messages = [pose((start + 10 * k) * MS + 123, (0.01 * k, 0), "map") for k in range(5)]
    log = read(tmp_path, {"/pose": messages}, topics={"/pose": "r"})
    np.testing.assert_array_equal(log.t, [0, 0.01, 0.02, 0.03, 0.04])
    assert log.reading.to_json() == {"time_origin": 1790000000.000000123}
    again = [*messages, pose((start + 20) * MS + 123, (9, 0), "map")]
    (tmp_path / "again").mkdir()
    with pytest.raises(LogError, match=r"different messages have the same stamp, 0\.02 s"):
        read(tmp_path / "again", {"/pose": again}, topics={"/pose": "r"})


def refusals() -> dict[str, dict]:
    base = odometries()
    return {
        r"bag\.fixed_frame: .*: no transforms lead from 'base_link' to 'map', they end at 'odom'": {"/tf": base},
        r"no transforms lead from 'base_link' to 'map', they end at 'base_link'": {"/tf": corrections()},
        r"frame 'odom': it has two parents, 'map' and 'world'": {
            "/tf": [*base, *corrections(), link(0, "world", "odom", np.zeros(2))]
        },
        r"frame 'odom': different transforms at the same stamp": {
            "/tf": [*base, *corrections(), link(250, "map", "odom", np.zeros(2))]
        },
        r"'base_link' and the transforms of its frame share no time": {
            "/tf": [*base, *[link(5000 + k, "map", "odom", np.zeros(2)) for k in range(2)]]
        },
        r"frame 'base_link' does not move: it is given on tf_static alone": {
            "/tf_static": [link(0, "map", "base_link", np.zeros(2))],
            "/tf": corrections(),
        },
        r"frame 'base_link': expected a unit quaternion, got \(0\.0, 0\.0, 0\.0, 0\.0\)": {
            "/tf": [transforms(k * MS, {"base_link": (k, 0)}, "map", (0.0,) * 4) for k in range(3)]
        },
        r"frame 'base_link': robots in the plane \(a prior of two entries\), but the height changes from 0 to 0\.6 m": {
            "/tf": [transforms(k * MS, {"base_link": (k, 0, 0.3 * k)}, "map") for k in range(3)]
        },
        r"no transforms lead from 'base_link' to 'map', they end at 'base_link'; there are \['base_link', 'odom'\]": {
            "/tf": [*base, link(0, "base_link", "odom", np.zeros(2))]
        },
    }


@pytest.mark.parametrize("expected", refusals())
def test_what_is_no_chain(tmp_path, expected):
    with pytest.raises((LogError, ConfigError), match=expected) as caught:
        read(tmp_path, refusals()[expected], frames={"base_link": "r"})
    assert str(caught.value).isprintable()
