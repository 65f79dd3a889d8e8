"""ROS 2 bags (sqlite3 or MCAP, with or without zstd) as logs. The extra `ros` is needed, ROS itself is not.

A body is measured by a topic (nav_msgs/Odometry or geometry_msgs/PoseStamped) or by a transform on /tf. Accelerations
come from a geometry_msgs/AccelStamped in the frame of the positions. Times are the
stamps of the headers, not the times of reception. All positions must be in one frame. The twist of an Odometry is in
its child frame. The orientation of the pose turns it into the frame of the positions, unless both frames are the same.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from torchfsid.config.bags import BagConfig
from torchfsid.errors import ConfigError, FsidError, LogError, one_line
from torchfsid.logs.log import Log
from torchfsid.logs.resampling import Series, Track, log_of_tracks
from torchfsid.logs.tables import A_NUMBER, is_measurable

ODOMETRY, POSE, TRANSFORMS = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage"
ACCELERATION = "geometry_msgs/msg/AccelStamped"
TF_TOPIC = "/tf"

UNIT = 1e-2
"""How far a quaternion's norm may be from 1; all zeros, the usual mistake, is no orientation."""

TILTED = 0.5
"""Sine of the angle between the plane and a body's x-axis beyond which its direction in the plane says nothing."""

MAX_TIMES = 1_000_000
"""More times of a clock are a slip of the pen in its rate, or in somebody's stamps."""


def read_bag(path: str | Path, bag: BagConfig, with_headings: bool = False) -> Log:
    """The log in a bag: a folder with metadata.yaml, or a single .mcap or .db3 file.

    Bodies whose stamps differ are resampled onto one clock, with bounds on the errors (`resampling`).

    Args:
        path: the folder or file.
        bag: where the bodies are.
        with_headings: read the orientations of the poses, too.

    Raises:
        LogError: the file cannot be read, or is not such a bag.
        ConfigError: `bag` names a topic or frame that is not in the bag, or a topic of another type.
    """
    source = str(path)
    samples = _read(Path(path), bag, with_headings)
    frames = {sample.frame: origin for origin, _ in bag.origins for sample in samples[origin]}
    if len(frames) > 1:
        (one, here), (other, there), *_ = frames.items()
        raise LogError(f"{source}: positions in different frames: {one!r} ({here}) and {other!r} ({there})")
    accelerations = {}
    for topic, body in bag.accelerations.items():
        origin = f"topic {topic!r}"
        for sample in samples[origin]:
            if sample.frame not in frames:
                raise LogError(
                    f"{source}: {origin}: accelerations in the frame {sample.frame!r}, not {next(iter(frames))!r}"
                )
        accelerations[body] = _series(f"{source}: {origin}", samples[origin])
    tracks = [
        _track(f"{source}: {origin}", body, samples[origin], accelerations.get(body), with_headings)
        for origin, body in bag.origins
    ]
    clock = None if bag.rate is None else _clock(tracks[0].stamps, bag.rate)
    radius = None if bag.radius is None else np.array([bag.radius[track.body] for track in tracks])
    return log_of_tracks(source, tracks, clock, radius)


class _Sample(NamedTuple):
    """What one message says about a body.

    Attributes:
        stamp: time of the header [ns].
        frame: frame of the header.
        x: position [m], or acceleration [m/s2].
        u: velocity in the same frame [m/s], or None.
        heading: direction of the body's x-axis [rad], NaN if it has none. Zero if headings were not asked for.
    """

    stamp: int
    frame: str
    x: tuple[float, float]
    u: tuple[float, float] | None
    heading: float = 0.0


def _read(path: Path, bag: BagConfig, with_headings: bool) -> dict[str, list[_Sample]]:
    """The samples from every topic and frame, in the order of reception."""
    try:
        from rosbags.rosbag2 import Reader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise LogError(f"{path}: ROS bags need an extra: pip install 'torchfsid[ros]'") from error
    # The three types are the same in every ROS 2, so no type definition in the bag has to be parsed.
    decode = get_typestore(Stores.LATEST).deserialize_cdr
    samples: dict[str, list[_Sample]] = {origin: [] for origin, _ in bag.origins}
    samples |= {f"topic {topic!r}": [] for topic in bag.accelerations}
    frames: set[str] = set()
    heading_of = _heading if with_headings else lambda orientation: 0.0
    try:
        with Reader(path) as reader:
            types: dict[str, set[str]] = {connection.topic: set() for connection in reader.connections}
            for connection in reader.connections:
                types[connection.topic].add(connection.msgtype)
            wanted = _wanted(path, types, bag)
            for connection, _, content in reader.messages([c for c in reader.connections if c.topic in wanted]):
                message: Any = decode(content, connection.msgtype)
                if connection.msgtype == TRANSFORMS:
                    frames.update(transform.child_frame_id for transform in message.transforms)
                    for transform in message.transforms:
                        if transform.child_frame_id in bag.frames:
                            origin = f"frame {transform.child_frame_id!r}"
                            place = transform.transform
                            sample = _sample(f"{path}: {origin}", transform.header, place.translation, None)
                            samples[origin].append(sample._replace(heading=heading_of(place.rotation)))
                else:
                    origin = f"topic {connection.topic!r}"
                    sample = _READ[connection.msgtype](f"{path}: {origin}", message)
                    if connection.topic in bag.topics:
                        pose = message.pose if connection.msgtype == POSE else message.pose.pose
                        sample = sample._replace(heading=heading_of(pose.orientation))
                    samples[origin].append(sample)
    except FsidError:
        raise
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or one_line(error)}") from error
    except Exception as error:  # damaged bytes make the parsers raise many kinds
        raise LogError(f"{path}: not a valid ROS bag: {one_line(error)}") from error
    if missing := bag.frames.keys() - frames:
        there = reprlib.repr(sorted(frames))
        raise ConfigError(
            f"bag.frames: {path}: no transform on {TF_TOPIC} is called {min(missing)!r}; there are {there}"
        )
    return samples


def _wanted(path: Path, types: dict[str, set[str]], bag: BagConfig) -> set[str]:
    """The topics to read. Each must be in the bag and have an allowed type."""
    expected = dict.fromkeys(bag.topics, (ODOMETRY, POSE)) | ({TF_TOPIC: (TRANSFORMS,)} if bag.frames else {})
    expected |= dict.fromkeys(bag.accelerations, (ACCELERATION,))
    for topic, allowed in expected.items():
        if topic not in types:
            raise ConfigError(f"bag: {path}: no topic is called {topic!r}; there are {reprlib.repr(sorted(types))}")
        if len(types[topic]) > 1 or types[topic].isdisjoint(allowed):
            got = " and ".join(map(repr, sorted(types[topic])))
            raise ConfigError(f"bag: {path}: topic {topic!r} is of type {got}, expected {' or '.join(allowed)}")
    return set(expected)


def _of_pose(where: str, message: Any) -> _Sample:
    return _sample(where, message.header, message.pose.position, None)


def _of_acceleration(where: str, message: Any) -> _Sample:
    return _sample(where, message.header, message.accel.linear, None)


def _of_odometry(where: str, message: Any) -> _Sample:
    pose, twist = message.pose.pose, message.twist.twist.linear
    velocity = twist.x, twist.y, twist.z
    if message.child_frame_id != message.header.frame_id:
        q = pose.orientation
        if not abs(math.hypot(q.w, q.x, q.y, q.z) - 1) <= UNIT:
            raise LogError(f"{where}: expected a unit quaternion, got {(q.x, q.y, q.z, q.w)}")
        velocity = _rotated((q.w, q.x, q.y, q.z), velocity)
    return _sample(where, message.header, pose.position, velocity[:2])


_READ = {ODOMETRY: _of_odometry, POSE: _of_pose, ACCELERATION: _of_acceleration}


def _sample(where: str, header: Any, position: Any, velocity: tuple[float, ...] | None) -> _Sample:
    values = position.x, position.y, *(velocity or ())
    stamp = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
    if not is_measurable(values).all():
        raise LogError(f"{where}: expected {A_NUMBER} everywhere, got {values} at t = {stamp / 1_000_000_000} s")
    u = None if velocity is None else (values[2], values[3])
    return _Sample(stamp, header.frame_id.removeprefix("/"), (values[0], values[1]), u)


def _heading(orientation: Any) -> float:
    """The direction of the body's x-axis in the plane [rad]. NaN without an orientation, or if that axis is steep."""
    w, x, y, z = orientation.w, orientation.x, orientation.y, orientation.z
    if not abs(math.hypot(w, x, y, z) - 1) <= UNIT:
        return math.nan
    ahead = _rotated((w, x, y, z), (1.0, 0.0, 0.0))
    return math.atan2(ahead[1], ahead[0]) if abs(ahead[2]) <= TILTED else math.nan


def _rotated(quaternion: tuple[float, ...], vector: tuple[float, ...]) -> tuple[float, ...]:
    """The vector v turned by the quaternion (w, q): v + w t + q x t, with t = 2 (q x v) / norm^2.

    The norm of the quaternion may differ slightly from 1.
    """
    w, *axis = quaternion
    twice = [2 / sum(q * q for q in quaternion) * c for c in _cross(axis, vector)]
    return tuple(v + w * t + c for v, t, c in zip(vector, twice, _cross(axis, twice), strict=True))


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _track(
    where: str, body: str, samples: Sequence[_Sample], acceleration: Series | None, with_headings: bool
) -> Track:
    stamps, x, u, heading = _in_order(where, samples)
    return Track(body, stamps, x, u, acceleration, heading if with_headings else None)


def _series(where: str, samples: Sequence[_Sample]) -> Series:
    stamps, values, _, _ = _in_order(where, samples)
    return Series(stamps, values)


def _in_order(where: str, samples: Sequence[_Sample]) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray]:
    """Stamps, positions, velocities and headings."""
    ordered = sorted(set(samples))  # transforms are often repeated
    if len(ordered) < 2:
        raise LogError(f"{where}: expected at least 2 messages with different stamps, got {len(ordered)}")
    stamps = np.array([sample.stamp for sample in ordered])
    if (np.diff(stamps) == 0).any():
        t = stamps[np.argmin(np.diff(stamps))] / 1_000_000_000
        raise LogError(f"{where}: different messages have the same stamp, {t} s")
    u = None if ordered[0].u is None else np.array([sample.u for sample in ordered])
    return stamps, np.array([sample.x for sample in ordered]), u, np.array([sample.heading for sample in ordered])


def _clock(stamps: Int[np.ndarray, "samples"], rate: float) -> Int[np.ndarray, "times"]:
    """Times [ns] at this rate [Hz], from the first to the last stamp."""
    times = 1 + float(stamps[-1] - stamps[0]) * 1e-9 * rate
    if not 2 <= times <= MAX_TIMES:
        raise ConfigError(f"bag.rate: {rate} Hz makes {times:.3g} times of the first body's, expected 2 to {MAX_TIMES}")
    return stamps[0] + np.unique(np.rint(np.arange(int(times)) * (1e9 / rate)).astype(np.int64))
