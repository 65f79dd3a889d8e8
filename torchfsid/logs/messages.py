"""ROS messages as samples: what one message says about a body, and how far it may be wrong.

The twist of an Odometry is in its child frame. The orientation q of the pose turns it into the frame of the positions,
unless both frames are the same. With k the declared number of standard deviations and S the covariances of the x and y
of the pose, and of the turned twist,

    position error <= k sqrt(largest eigenvalue of S)
    velocity error <= k sqrt(largest eigenvalue of S) + k |v| (deviation of the yaw)
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from torchfsid.errors import LogError
from torchfsid.logs.motion import heading_of, rotation_of

ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
ACCELERATION, TRANSFORMS = "geometry_msgs/msg/AccelStamped", "tf2_msgs/msg/TFMessage"


class Sample(NamedTuple):
    """What one message says about a body.

    Attributes:
        stamp: time of the header [ns].
        frame: frame of the header.
        x: position in it [m], or acceleration [m/s2].
        u: velocity in the same frame [m/s], or None.
        position_error: bound on the error of x [m].
        velocity_error: bound on the error of u [m/s].
        heading: direction of the body's x-axis [rad], NaN if it has none.
    """

    stamp: int
    frame: str
    x: tuple[float, float, float]
    u: tuple[float, float, float] | None = None
    position_error: float = 0.0
    velocity_error: float = 0.0
    heading: float = math.nan


def sample_of(where: str, kind: str, message: Any, multiple: float | None, n: int = 2) -> Sample:
    """The sample in a message of type ODOMETRY, POSE or ACCELERATION.

    Args:
        where: file and topic, for messages.
        kind: the type.
        message: the message.
        multiple: number of standard deviations that bound the errors of an Odometry. None: no bounds.
        n: errors count in the plane (2) or in space (3).

    Raises:
        LogError: an orientation is no unit quaternion, or a covariance is missing.
    """
    header = message.header
    stamp, frame = nanoseconds(header.stamp), header.frame_id.removeprefix("/")
    if kind == POSE:
        return Sample(stamp, frame, _vector(message.pose.position), heading=heading(message.pose.orientation))
    if kind == ACCELERATION:
        return Sample(stamp, frame, _vector(message.accel.linear))
    turn = np.eye(3)
    if message.child_frame_id != header.frame_id:
        turn = rotation(where, message.pose.pose.orientation)
    x, u = _vector(message.pose.pose.position), turn @ _vector(message.twist.twist.linear)
    velocity, turned = (float(u[0]), float(u[1]), float(u[2])), heading(message.pose.pose.orientation)
    if multiple is None:
        return Sample(stamp, frame, x, velocity, heading=turned)
    of_pose, of_twist = (
        _covariance(where, name, of.covariance, n) for name, of in (("pose", message.pose), ("twist", message.twist))
    )
    turning = of_pose[5:, 5:] if n == 2 else of_pose[3:, 3:]
    turning = _deviation(turning) if message.child_frame_id != header.frame_id else 0.0
    position = multiple * _deviation(of_pose[:n, :n])
    return Sample(
        stamp, frame, x, velocity, position,
        multiple * (_deviation((turn @ of_twist[:3, :3] @ turn.T)[:n, :n]) + math.hypot(*velocity[:n]) * turning),
        turned,
    )  # fmt: skip


def nanoseconds(stamp: Any) -> int:
    """The time of a header [ns]."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def rotation(where: str, q: Any) -> Float[np.ndarray, "3 3"]:
    """The matrix that turns vectors by the quaternion q.

    Raises:
        LogError: it is no unit quaternion.
    """
    turn = rotation_of(q.x, q.y, q.z, q.w)
    if turn is None:
        raise LogError(f"{where}: expected a unit quaternion, got {(q.x, q.y, q.z, q.w)}")
    return turn


def heading(q: Any) -> float:
    """The direction in the plane of the x-axis of a body with the orientation q [rad]. NaN if it has none."""
    turn = rotation_of(q.x, q.y, q.z, q.w)
    return math.nan if turn is None else heading_of(turn[:, 0])


def _vector(message: Any) -> tuple[float, float, float]:
    return float(message.x), float(message.y), float(message.z)


def _covariance(where: str, name: str, entries: Any, n: int) -> Float[np.ndarray, "6 6"]:
    """A covariance as ROS writes it: 36 entries. All zeros, or a negative variance, mean that it is unknown."""
    matrix = np.array(entries, dtype=np.float64).reshape(6, 6)
    if not (np.isfinite(matrix).all() and (np.diag(matrix) >= 0).all() and matrix[:n, :n].any()):
        raise LogError(f"{where}: no covariance of the {name}: declare noise instead of bag.covariance_multiple")
    return matrix


def _deviation(covariance: Float[np.ndarray, "k k"]) -> float:
    """The largest standard deviation in any direction."""
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))
