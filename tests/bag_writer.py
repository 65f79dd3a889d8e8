"""Real ROS 2 bags, written by rosbags: message by message, or from a CSV log.

python -m tests.bag_writer LOG.csv FOLDER          prints the config's section `bag`
"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import yaml
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from torchfsid.logs.log import Log
from torchfsid.logs.messages import ACCELERATION, ODOMETRY, POSE, TRANSFORMS
from torchfsid.logs.table_log import read_csv

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
UNTURNED = (1.0, 0.0, 0.0, 0.0)


def yawed(yaw: float) -> tuple[float, float, float, float]:
    """The quaternion (w, x, y, z) of a turn about the vertical."""
    return np.cos(yaw / 2).item(), 0.0, 0.0, np.sin(yaw / 2).item()


def _header(stamp: int, frame: str) -> object:
    time = TYPES["builtin_interfaces/msg/Time"](sec=stamp // 1_000_000_000, nanosec=stamp % 1_000_000_000)
    return TYPES["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def _vector(kind: str, values: Sequence[float]) -> object:
    x, y, z = (*values, 0.0)[:3]
    return TYPES[f"geometry_msgs/msg/{kind}"](x=float(x), y=float(y), z=float(z))


def _quaternion(values: Sequence[float]) -> object:
    w, x, y, z = values
    return TYPES["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def _pose(position: Sequence[float], orientation: Sequence[float]) -> object:
    return TYPES["geometry_msgs/msg/Pose"](position=_vector("Point", position), orientation=_quaternion(orientation))


def odometry(
    stamp: int,
    position: Sequence[float],
    twist: Sequence[float],
    orientation: Sequence[float] = UNTURNED,
    frame: str = "world",
    child: str = "base_link",
    covariance: np.ndarray | None = None,
) -> object:
    """nav_msgs/Odometry; `twist` is in the frame `child`. Pose and twist have the same covariance."""
    covariance = np.zeros(36) if covariance is None else covariance
    full_twist = TYPES["geometry_msgs/msg/Twist"](linear=_vector("Vector3", twist), angular=_vector("Vector3", (0, 0)))
    with_covariance = TYPES["geometry_msgs/msg/PoseWithCovariance"], TYPES["geometry_msgs/msg/TwistWithCovariance"]
    return TYPES[ODOMETRY](
        header=_header(stamp, frame),
        child_frame_id=child,
        pose=with_covariance[0](pose=_pose(position, orientation), covariance=covariance),
        twist=with_covariance[1](twist=full_twist, covariance=covariance),
    )


def pose(
    stamp: int, position: Sequence[float], frame: str = "world", orientation: Sequence[float] = UNTURNED
) -> object:
    """geometry_msgs/PoseStamped."""
    return TYPES[POSE](header=_header(stamp, frame), pose=_pose(position, orientation))


def acceleration(stamp: int, values: Sequence[float], frame: str = "world") -> object:
    """geometry_msgs/AccelStamped."""
    accel = TYPES["geometry_msgs/msg/Accel"](linear=_vector("Vector3", values), angular=_vector("Vector3", (0, 0)))
    return TYPES[ACCELERATION](header=_header(stamp, frame), accel=accel)


def transforms(
    stamp: int,
    positions: Mapping[str, Sequence[float]],
    frame: str = "world",
    orientation: Sequence[float] = UNTURNED,
) -> object:
    """tf2_msgs/TFMessage of several child frames."""
    of = TYPES["geometry_msgs/msg/Transform"]
    return TYPES[TRANSFORMS](
        transforms=[
            TYPES["geometry_msgs/msg/TransformStamped"](
                header=_header(stamp, frame),
                child_frame_id=child,
                transform=of(translation=_vector("Vector3", position), rotation=_quaternion(orientation)),
            )
            for child, position in positions.items()
        ]
    )


def write_bag(
    folder: Path,
    messages: Mapping[str, Sequence[object]],
    storage: StoragePlugin = StoragePlugin.SQLITE3,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """A bag of messages by topic, received in this order, a second apart and long after their stamps."""
    writer = Writer(folder, version=9, storage_plugin=storage)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        for topic, of_topic in messages.items():
            kinds: list[str] = [type(message).__msgtype__ for message in of_topic]  # type: ignore[attr-defined]
            connections = {kind: writer.add_connection(topic, kind, typestore=STORE) for kind in dict.fromkeys(kinds)}
            for k, (message, kind) in enumerate(zip(of_topic, kinds, strict=True)):
                received = (1_000_000 + k) * 1_000_000_000
                writer.write(connections[kind], received, STORE.serialize_cdr(message, kind))
    return folder


def odometry_of(log: Log, yaw: float = 0.0) -> dict[str, list[object]]:
    """The log as one topic of Odometry per body, of robots that are turned."""
    assert log.u is not None
    c, s = np.cos(yaw), np.sin(yaw)
    twists = log.u @ np.array([[c, -s], [s, c]])  # R^T u, written for rows
    stamps = np.rint(log.t * 1e9).astype(int).tolist()
    return {
        f"/robot{j}/odom": [
            odometry(stamp, log.x[k, j], twists[k, j] if yaw else log.u[k, j], yawed(yaw))
            for k, stamp in enumerate(stamps)
            if log.seen[k, j]
        ]
        for j in range(len(log.bodies))
    }


def section_of(log: Log) -> dict[str, object]:
    """The config's section `bag` for `odometry_of(log)`."""
    section: dict[str, object] = {"topics": {f"/robot{j}/odom": body for j, body in enumerate(log.bodies)}}
    if log.radius is not None:
        section["radius"] = dict(zip(log.bodies, log.radius.tolist(), strict=True))
    return section


if __name__ == "__main__":
    source = read_csv(sys.argv[1])
    write_bag(Path(sys.argv[2]), odometry_of(source))
    print(yaml.safe_dump({"bag": section_of(source)}, default_flow_style=None))
