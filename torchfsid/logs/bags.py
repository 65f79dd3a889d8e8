"""ROS 2 bags (sqlite3 or MCAP, with or without zstd) as logs. The extra `ros` is needed, ROS itself is not.

A body is measured by a topic (nav_msgs/Odometry or geometry_msgs/PoseStamped) or by a frame on /tf. Accelerations come
from a geometry_msgs/AccelStamped in the frame of the positions. Times are the stamps of the headers, not the times of
reception. All positions must be in one frame, or chains of transforms lead from theirs to the fixed frame
(`transforms`). What a message means: `messages`.
"""

from __future__ import annotations

import reprlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from torchfsid.config.bags import BagConfig
from torchfsid.errors import ConfigError, FsidError, LogError, one_line
from torchfsid.logs.log import Log
from torchfsid.logs.messages import ACCELERATION, ODOMETRY, POSE, TRANSFORMS, Sample, heading, nanoseconds, sample_of
from torchfsid.logs.motion import Motion, start_of
from torchfsid.logs.reading import Reading
from torchfsid.logs.resampling import Series, Track, log_of_tracks
from torchfsid.logs.transforms import Transforms, namespaces, tf_topics

TF_TOPIC = "/tf"

MAX_TIMES = 1_000_000
"""More times of a clock are a slip of the pen in its rate, or in somebody's stamps."""


def read_bag(path: str | Path, bag: BagConfig, with_headings: bool = False, in_space: bool = False) -> Log:
    """The log in a bag: a folder with metadata.yaml, or a single .mcap or .db3 file.

    Bodies whose stamps differ are resampled onto one clock, with bounds on the errors (`resampling`). Stamps since 1970
    are counted from the first.

    Args:
        path: the folder or file.
        bag: where the bodies are.
        with_headings: read the orientations of the poses, too.
        in_space: robots are in space. Otherwise they are in the plane, and their height has to stay the same.

    Raises:
        LogError: the file cannot be read, or is not such a bag.
        ConfigError: `bag` names a topic or frame that is not in the bag, or a topic of another type.
    """
    source, n = str(path), 3 if in_space else 2
    content = _read(Path(path), bag, n)
    frame = content.common_frame(bag)
    motions = {origin: content.motion(origin) for origin, _ in bag.origins}
    accelerations = {body: content.motion(f"topic {topic!r}") for topic, body in bag.accelerations.items()}
    start = start_of(int(motion.stamps[0]) for motion in [*motions.values(), *accelerations.values()])

    def from_start(where: str, motion: Motion) -> Motion:
        motion = motion._replace(stamps=motion.stamps - start)
        motion.require_numbers(f"{source}: {where}", n)
        return motion

    series = {}
    for topic, body in bag.accelerations.items():
        motion = from_start(f"topic {topic!r}", accelerations[body])
        series[body] = Series(motion.stamps, motion.x[:, :n])
    tracks = []
    for origin, body in bag.origins:
        motion = from_start(origin, motions[origin])
        if not in_space:
            motion.require_level(f"{source}: {origin}")
        tracks.append(Track.of(body, motion if with_headings else motion._replace(heading=None), series.get(body), n))
    clock = None if bag.rate is None else _clock(tracks[0].stamps, bag.rate)
    radius = None if bag.radius is None else np.array([bag.radius[track.body] for track in tracks])
    log = log_of_tracks(source, tracks, clock, radius)
    log = replace(log, frame=frame)
    return replace(log, reading=Reading(time_origin=start / 1_000_000_000)) if start else log


@dataclass
class _Content:
    """What a bag says.

    Attributes:
        source: the bag, for messages.
        samples: the samples from every topic and frame, in the order of reception.
        transforms: all transforms, if there is a fixed frame.
        names: the topic or frame of each entry of `samples`.
    """

    source: str
    samples: dict[str, list[Sample]]
    transforms: Transforms | None
    names: dict[str, str]

    def common_frame(self, bag: BagConfig) -> str:
        """The frame of all positions and accelerations: the fixed frame, if there is one.

        Raises:
            LogError: there are several, or with a fixed frame those of one topic are in several.
        """
        origins = [origin for origin, _ in bag.origins]
        for of_one in [[origin] for origin in origins] if self.transforms else [origins]:
            frames = {sample.frame: origin for origin in of_one for sample in self.samples[origin]}
            if len(frames) > 1:
                (one, here), (other, there), *_ = frames.items()
                both = f"{one!r} ({here}) and {other!r} ({there})"
                hint = "" if self.transforms else "; do transforms join them (bag.fixed_frame)?"
                raise LogError(f"{self.source}: positions in different frames: {both}{hint}")
        common = self.transforms.fixed if self.transforms else next(iter(frames), "")
        for topic in bag.accelerations:
            for sample in self.samples[f"topic {topic!r}"]:
                if sample.frame != common:
                    what = f"accelerations in the frame {sample.frame!r}, not {common!r}"
                    raise LogError(f"{self.source}: topic {topic!r}: {what}")
        return common

    def motion(self, origin: str) -> Motion:
        """The samples from one origin in the order of time, in the fixed frame if there is one."""
        name = self.names[origin]
        if self.transforms is not None and origin.startswith("frame "):
            return self.transforms.of_frame(name)
        ordered = sorted(set(self.samples[origin]))  # messages are often repeated
        where = f"{self.source}: {origin}"
        if len(ordered) < 2:
            raise LogError(f"{where}: expected at least 2 messages with different stamps, got {len(ordered)}")
        stamps = np.array([sample.stamp for sample in ordered])
        if (np.diff(stamps) == 0).any():
            same = int(stamps[np.argmin(np.diff(stamps))])
            t = (same - start_of([int(stamps[0])])) / 1_000_000_000
            raise LogError(f"{where}: different messages have the same stamp, {t} s")
        motion = Motion(
            stamps,
            np.array([sample.x for sample in ordered]),
            None if ordered[0].u is None else np.array([sample.u for sample in ordered]),
            np.array([sample.position_error for sample in ordered]),
            np.array([sample.velocity_error for sample in ordered]),
            np.array([sample.heading for sample in ordered]),
        )
        if self.transforms is None:
            return motion
        return self.transforms.in_fixed(self.transforms.qualified(ordered[0].frame, name), motion, name)


def _read(path: Path, bag: BagConfig, n: int) -> _Content:
    try:
        from rosbags.rosbag2 import Reader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise LogError(f"{path}: ROS bags need an extra: pip install 'torchfsid[ros]'") from error
    # The types are the same in every ROS 2, so no type definition in the bag has to be parsed.
    decode = get_typestore(Stores.LATEST).deserialize_cdr
    names = {f"topic {topic!r}": topic for topic in [*bag.topics, *bag.accelerations]}
    names |= {f"frame {frame!r}": frame.removeprefix("/") for frame in bag.frames}
    content = _Content(str(path), {origin: [] for origin in names}, None, names)
    there: set[str] = set()
    try:
        with Reader(path) as reader:
            types: dict[str, set[str]] = {connection.topic: set() for connection in reader.connections}
            for connection in reader.connections:
                types[connection.topic].add(connection.msgtype)
            if bag.fixed_frame is not None:
                fixed = bag.fixed_frame.removeprefix("/")
                content.transforms = Transforms(str(path), fixed, namespaces(types, TRANSFORMS), n)
            wanted = _wanted(path, types, bag)
            for connection, _, raw in reader.messages([c for c in reader.connections if c.topic in wanted]):
                message: Any = decode(raw, connection.msgtype)
                if connection.msgtype != TRANSFORMS:
                    origin = f"topic {connection.topic!r}"
                    where, multiple = f"{path}: {origin}", bag.covariance_multiple
                    content.samples[origin].append(sample_of(where, connection.msgtype, message, multiple, n))
                elif content.transforms is not None:
                    content.transforms.add(connection.topic, message)
                else:
                    there.update(transform.child_frame_id for transform in message.transforms)
                    _add_frames(content, message, bag)
    except FsidError:
        raise
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or one_line(error)}") from error
    except Exception as error:  # damaged bytes make the parsers raise many kinds
        raise LogError(f"{path}: not a valid ROS bag: {one_line(error)}") from error
    if content.transforms is None and (missing := bag.frames.keys() - there):
        known = reprlib.repr(sorted(there))
        raise ConfigError(
            f"bag.frames: {path}: no transform on {TF_TOPIC} is called {min(missing)!r}; there are {known}"
        )
    return content


def _add_frames(content: _Content, message: Any, bag: BagConfig) -> None:
    """Take in the transforms of bodies, each as a position in its parent."""
    for transform in message.transforms:
        if transform.child_frame_id in bag.frames:
            header, x, turned = transform.header, transform.transform.translation, heading(transform.transform.rotation)
            frame = header.frame_id.removeprefix("/")
            sample = Sample(nanoseconds(header.stamp), frame, (x.x, x.y, x.z), heading=turned)
            content.samples[f"frame {transform.child_frame_id!r}"].append(sample)


def _wanted(path: Path, types: dict[str, set[str]], bag: BagConfig) -> set[str]:
    """The topics to read. Each must be in the bag and have an allowed type."""
    expected: dict[str, tuple[str, ...]] = dict.fromkeys(bag.topics, (ODOMETRY, POSE))
    expected |= dict.fromkeys(bag.accelerations, (ACCELERATION,))
    if bag.fixed_frame is not None:
        expected |= dict.fromkeys(tf_topics(types, TRANSFORMS), (TRANSFORMS,))
    elif bag.frames:
        expected |= {TF_TOPIC: (TRANSFORMS,)}
    for topic, allowed in expected.items():
        if topic not in types:
            raise ConfigError(f"bag: {path}: no topic is called {topic!r}; there are {reprlib.repr(sorted(types))}")
        if len(types[topic]) > 1 or types[topic].isdisjoint(allowed):
            got = " and ".join(map(repr, sorted(types[topic])))
            raise ConfigError(f"bag: {path}: topic {topic!r} is of type {got}, expected {' or '.join(allowed)}")
    return set(expected)


def _clock(stamps: Int[np.ndarray, "samples"], rate: float) -> Int[np.ndarray, "times"]:
    """Times [ns] at this rate [Hz], from the first to the last stamp."""
    times = 1 + float(stamps[-1] - stamps[0]) * 1e-9 * rate
    if not 2 <= times <= MAX_TIMES:
        raise ConfigError(f"bag.rate: {rate} Hz makes {times:.3g} times of the first body's, expected 2 to {MAX_TIMES}")
    return stamps[0] + np.unique(np.rint(np.arange(int(times)) * (1e9 / rate)).astype(np.int64))
