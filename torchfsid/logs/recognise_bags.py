"""The bodies of a ROS 2 bag, found from its topics and transforms. The extra `ros` is needed.

A robot's topics are told by their namespace. Of several kinds that give its position the first in this order is taken.

    nav_msgs/Odometry          position and velocity
    geometry_msgs/PoseStamped  position
    a transform on /tf         position of its child frame, for robots without such a topic

If positions are in different frames, the fixed frame is the root of the tree of transforms in which all of them are.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchfsid.errors import LogError, one_line
from torchfsid.logs.messages import ACCELERATION, ODOMETRY, POSE, TRANSFORMS
from torchfsid.logs.transforms import Transforms, namespaces, tf_topics


def bag_section(path: Path) -> dict[str, Any]:
    """The section `bag` for a bag: topics, frames, accelerations and, if needed, the fixed frame.

    Raises:
        LogError: the bag cannot be read, or has no topic that gives positions of bodies.
    """
    try:
        from rosbags.rosbag2 import Reader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise LogError(f"{path}: ROS bags need an extra: pip install 'torchfsid[ros]'") from error
    decode = get_typestore(Stores.LATEST).deserialize_cdr
    try:
        with Reader(path) as reader:
            types: dict[str, set[str]] = {connection.topic: set() for connection in reader.connections}
            for connection in reader.connections:
                types[connection.topic].add(connection.msgtype)

            def first(topic: str) -> Any:
                """The first message of a topic."""
                for connection, _, raw in reader.messages([c for c in reader.connections if c.topic == topic]):
                    return decode(raw, connection.msgtype)
                return None

            tree = _Tree(Transforms(str(path), "", namespaces(types, TRANSFORMS)))
            spoken = [c for c in reader.connections if c.topic in tf_topics(types, TRANSFORMS)]
            for connection, _, raw in reader.messages(spoken) if spoken else ():  # no connections would mean all
                tree.add(connection.topic, decode(raw, connection.msgtype))
            positions = [topic for topic, of in types.items() if of in ({ODOMETRY}, {POSE})]
            bodies, frames = _topics(types, _labels(positions)), {}
            for topic in list(bodies):
                message = first(topic)
                if message is None:
                    del bodies[topic]
                else:
                    frames[topic] = tree.told.qualified(message.header.frame_id, topic)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or one_line(error)}") from error
    except Exception as error:  # damaged bytes make the parsers raise many kinds
        raise LogError(f"{path}: not a valid ROS bag: {one_line(error)}") from error
    return _section(path, types, bodies, frames, tree)


class _Tree:
    """The tree of transforms of a bag: the parent of every frame, and which links move."""

    def __init__(self, told: Transforms) -> None:
        self.told = told
        self.parents: dict[str, str] = {}
        self.moving: set[str] = set()

    def add(self, topic: str, message: Any) -> None:
        """Take in a TFMessage."""
        for stamped in message.transforms:
            child = self.told.qualified(stamped.child_frame_id, topic)
            self.parents[child] = self.told.qualified(stamped.header.frame_id, topic)
            if not topic.endswith("tf_static"):
                self.moving.add(child)

    def root(self, frame: str) -> str:
        """Where the chain above a frame ends."""
        met = [frame]
        while met[-1] in self.parents and self.parents[met[-1]] not in met:
            met.append(self.parents[met[-1]])
        return met[-1]

    def fixed(self, frame: str) -> str:
        """The root, as the fixed frame is called: without a namespace of topics tf."""
        root = self.root(frame)
        namespace = next((name for name in self.told.namespaces if root.startswith(f"{name}/")), "")
        return root.removeprefix(f"{namespace}/")

    def bodies(self) -> list[str]:
        """Frames that move and have no moving frame below: the bodies, not what is mounted on their joints."""
        above = {self.parents[frame] for frame in self.moving}
        return [frame for frame in self.parents if frame in self.moving and frame not in above]


def _labels(names: Sequence[str]) -> dict[str, str]:
    """What topics or frames are called for short: the first part of their namespaces in which some differ.

    /mocap/r1/pose and /mocap/r2/pose are r1 and r2. A single namespace is the name of all in it, "" that of none.
    """
    parts = {name: name.strip("/").split("/") for name in names}
    depth = min((len(of) for of in parts.values()), default=1) - 1
    for k in range(depth):
        if len({of[k] for of in parts.values()}) > 1:
            return {name: of[k] for name, of in parts.items()}
    return {name: of[depth - 1] if depth else "" for name, of in parts.items()}


def _topics(types: dict[str, set[str]], labels: dict[str, str]) -> dict[str, str]:
    """The topics that give positions, and the names of their bodies. One kind of topic for each label."""
    chosen: dict[str, list[str]] = {}
    for kind in (ODOMETRY, POSE):
        of_kind: dict[str, list[str]] = {}
        for topic in sorted(topic for topic, of in types.items() if of == {kind}):
            of_kind.setdefault(labels[topic], []).append(topic)
        chosen = {**of_kind, **chosen}
    short = {topics[0]: label or topics[0].strip("/") for label, topics in chosen.items() if len(topics) == 1}
    longer = {topic: topic.strip("/") for topics in chosen.values() if len(topics) > 1 for topic in topics}
    return dict(sorted({**short, **longer}.items()))


def _section(
    path: Path, types: dict[str, set[str]], bodies: dict[str, str], frames: dict[str, str], tree: _Tree
) -> dict[str, Any]:
    """The section, from the bodies of topics, the frames of their positions, and the transforms."""
    section: dict[str, Any] = {"topics": bodies} if bodies else {}
    start, needs_tree = list(frames.values()), len(set(frames.values())) > 1
    if not bodies:
        start = tree.bodies()
        if not start:
            there = ", ".join(f"{topic} ({min(of)})" for topic, of in sorted(types.items()))
            raise LogError(
                f"{path}: no Odometry, no PoseStamped and no transform that moves: nothing gives positions of bodies; "
                f"there are {there or 'no topics'}"
            )
        labels = _labels(start)
        is_short = all(labels.values()) and len(set(labels.values())) == len(start)
        section["frames"] = {frame: labels[frame] if is_short else frame for frame in start}
        needs_tree = {tree.parents[frame] for frame in start} != {tree.root(frame) for frame in start}
    roots = {tree.fixed(frame) for frame in start}
    if needs_tree and len(roots) == 1:
        section["fixed_frame"] = roots.pop()
    pulls = sorted(topic for topic, of in types.items() if of == {ACCELERATION})
    names = _labels([*bodies, *pulls])
    bodies_by_label = {names[topic]: body for topic, body in bodies.items()}
    accelerations = {topic: bodies_by_label[names[topic]] for topic in pulls if names[topic] in bodies_by_label}
    if len(set(accelerations.values())) == len(bodies) > 0:
        section["accelerations"] = accelerations
    return section
