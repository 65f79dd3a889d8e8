"""Standard ROS 2 messages in one frame: markers, poses, odometry, diagnostics."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

LINES, CYLINDER, SPHERE, TEXT, TRIANGLES = 5, 3, 2, 9, 11
"""Types of Marker: LINE_LIST, CYLINDER, SPHERE, TEXT_VIEW_FACING, TRIANGLE_LIST."""

ADD, DELETE = 0, 2
"""Actions of Marker."""

Colour = tuple[float, float, float, float]
"""Red, green, blue and opacity, 0 to 1."""


@dataclass(frozen=True)
class Messages:
    """Makes messages.

    Attributes:
        types: the classes of messages, by their type.
        frame: the frame of all positions.
    """

    types: Any
    frame: str

    def odometry(self, stamp: int, x: Float[np.ndarray, "n"], u: Float[np.ndarray, "n"], heading: float = 0.0) -> Any:
        """nav_msgs/Odometry: position [m], velocity in the same frame [m/s], heading [rad]."""
        types = self.types
        twist = types["geometry_msgs/msg/Twist"](linear=self._vector(u), angular=self._vector(np.zeros(2)))
        pose = types["geometry_msgs/msg/PoseWithCovariance"](pose=self._pose(x, heading), covariance=np.zeros(36))
        return types["nav_msgs/msg/Odometry"](
            header=self._header(stamp),
            child_frame_id=self.frame,
            pose=pose,
            twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
        )

    def transforms(self, stamp: int, places: Mapping[str, tuple[Float[np.ndarray, "n"], float]]) -> Any:
        """tf2_msgs/TFMessage: child frames, each with its position [m] and heading [rad]."""
        types, sent = self.types, []
        for child, (x, heading) in places.items():
            pose = self._pose(x, heading)
            moved = types["geometry_msgs/msg/Transform"](translation=self._vector(x), rotation=pose.orientation)
            of = types["geometry_msgs/msg/TransformStamped"]
            sent.append(of(header=self._header(stamp), child_frame_id=child, transform=moved))
        return types["tf2_msgs/msg/TFMessage"](transforms=sent)

    def pose(self, stamp: int, x: Float[np.ndarray, "n"]) -> Any:
        """geometry_msgs/PoseStamped."""
        return self.types["geometry_msgs/msg/PoseStamped"](header=self._header(stamp), pose=self._pose(x))

    def diagnostics(self, stamp: int, told: Iterable[tuple[int, str, str, Mapping[str, str]]]) -> Any:
        """diagnostic_msgs/DiagnosticArray, of a level, name, message and values for each part."""
        of, pair = self.types["diagnostic_msgs/msg/DiagnosticStatus"], self.types["diagnostic_msgs/msg/KeyValue"]
        status = [
            of(
                level=level,
                name=name,
                message=message,
                hardware_id="",
                values=[pair(key=key, value=value) for key, value in values.items()],
            )
            for level, name, message, values in told
        ]
        return self.types["diagnostic_msgs/msg/DiagnosticArray"](header=self._header(stamp), status=status)

    def markers(self, markers: Iterable[Any]) -> Any:
        """visualization_msgs/MarkerArray."""
        return self.types["visualization_msgs/msg/MarkerArray"](markers=list(markers))

    def marker(
        self,
        stamp: int,
        name: str,
        kind: int,
        colour: Colour,
        size: float,
        number: int = 0,
        points: Float[np.ndarray, "m n"] | None = None,
        at: Float[np.ndarray, "n"] | None = None,
        text: str = "",
        action: int = ADD,
    ) -> Any:
        """visualization_msgs/Marker.

        Args:
            stamp: time [ns].
            name: its namespace.
            kind: LINES, CYLINDER, ..
            colour: its colour.
            size: diameter, width of lines, or height of letters [m].
            number: its number in the namespace.
            points: ends of lines or corners of triangles [m].
            at: its place [m].
            text: of TEXT.
            action: ADD or DELETE.
        """
        types = self.types
        r, g, b, a = colour
        image = types["sensor_msgs/msg/CompressedImage"](
            header=self._header(0), format="", data=np.zeros(0, dtype=np.uint8)
        )
        return types["visualization_msgs/msg/Marker"](
            header=self._header(stamp),
            ns=name,
            id=number,
            type=kind,
            action=action,
            pose=self._pose(np.zeros(2) if at is None else at),
            scale=types["geometry_msgs/msg/Vector3"](x=size, y=size, z=size),
            color=types["std_msgs/msg/ColorRGBA"](r=r, g=g, b=b, a=a),
            lifetime=types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0),
            frame_locked=False,
            points=[] if points is None else [self._point(point) for point in points],
            colors=[],
            texture_resource="",
            texture=image,
            uv_coordinates=[],
            text=text,
            mesh_resource="",
            mesh_file=types["visualization_msgs/msg/MeshFile"](filename="", data=np.zeros(0, dtype=np.uint8)),
            mesh_use_embedded_materials=False,
        )

    def _header(self, stamp: int) -> Any:
        time = self.types["builtin_interfaces/msg/Time"](sec=stamp // 1_000_000_000, nanosec=stamp % 1_000_000_000)
        return self.types["std_msgs/msg/Header"](stamp=time, frame_id=self.frame)

    def _pose(self, position: np.ndarray, yaw: float = 0.0) -> Any:
        turn = self.types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
        return self.types["geometry_msgs/msg/Pose"](position=self._point(position), orientation=turn)

    def _point(self, values: np.ndarray) -> Any:
        x, y, z = (*values.tolist(), 0.0)[:3]
        return self.types["geometry_msgs/msg/Point"](x=x, y=y, z=z)

    def _vector(self, values: np.ndarray) -> Any:
        x, y, z = (*values.tolist(), 0.0)[:3]
        return self.types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)
