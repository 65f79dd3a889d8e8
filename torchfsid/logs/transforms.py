r"""Chains of transforms, such as map -> odom -> base_link, from /tf and /tf_static.

A link says where a frame is in its parent: x_parent = R x + p. A static link holds at all times. A body's samples have
the stamps of the lowest link that is not static (usually odom -> base_link), or of its topic. At a stamp that lies a
part l of the way between two messages of a link above, with x_a and x_b the body's positions by the one and by the
other,

    x = (1 - l) x_a + l x_b       error <= max(l, 1 - l) |x_b - x_a|

The bound assumes that in between the body is where a point between x_a and x_b is: a correction of the odometry is
somewhere on its way from one message to the next. The same holds for velocities, which are turned. Headings are turned
without a bound. Samples before a
link's first message and after its last one are left out.

A topic /r1/tf is that of the namespace r1: its frame base_link is called r1/base_link here, as if the frame itself had
been given that prefix. Only the fixed frame is the same in all namespaces.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchfsid.errors import ConfigError, LogError
from torchfsid.logs.messages import nanoseconds, rotation
from torchfsid.logs.motion import Motion, heading_of


@dataclass
class _Link:
    """A frame in its parent, as messages tell it.

    Attributes:
        where: file and frame, for messages.
        parent: the parent.
        told: the transform at each stamp [ns]. The stamp of a static link is None.
        problem: what is wrong with it, if it is needed.
    """

    where: str
    parent: str
    told: dict[int | None, Any] = field(default_factory=dict)
    problem: str | None = None

    @property
    def is_static(self) -> bool:
        return None in self.told

    def tell(self, parent: str, stamp: int | None, transform: Any) -> None:
        if parent != self.parent:
            self.problem = f"it has two parents, {self.parent!r} and {parent!r}"
        elif self.told.setdefault(stamp, transform) != transform:
            self.problem = "different static transforms" if stamp is None else "different transforms at the same stamp"

    def pose(self, stamp: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """R and p at a stamp."""
        of = self.told[stamp]
        return rotation(self.where, of.rotation), np.array([of.translation.x, of.translation.y, of.translation.z])

    def series(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stamps, R and p in the order of time."""
        stamps = sorted(stamp for stamp in self.told if stamp is not None)
        R, p = zip(*map(self.pose, stamps), strict=True)
        return np.array(stamps), np.array(R), np.array(p)


@dataclass
class Transforms:
    """The links of a bag.

    Attributes:
        source: the bag, for messages.
        fixed: the fixed frame.
        namespaces: the namespaces that have a topic tf of their own.
        n: errors count in the plane (2) or in space (3).
    """

    source: str
    fixed: str
    namespaces: frozenset[str]
    n: int = 2
    _links: dict[str, _Link] = field(default_factory=dict)

    def qualified(self, frame: str, topic: str) -> str:
        """The name of a frame of which a message on this topic speaks."""
        frame, namespace = frame.removeprefix("/"), topic.strip("/").rpartition("/")[0]
        if namespace not in self.namespaces or frame == self.fixed or frame.startswith(f"{namespace}/"):
            return frame
        return f"{namespace}/{frame}"

    def add(self, topic: str, message: Any) -> None:
        """Take in a TFMessage."""
        for stamped in message.transforms:
            child = self.qualified(stamped.child_frame_id, topic)
            parent = self.qualified(stamped.header.frame_id, topic)
            stamp = None if topic.endswith("tf_static") else nanoseconds(stamped.header.stamp)
            link = self._links.setdefault(child, _Link(f"{self.source}: frame {child!r}", parent))
            link.tell(parent, stamp, stamped.transform)

    def of_frame(self, frame: str) -> Motion:
        """The motion of a frame's origin, in the fixed frame.

        Raises:
            ConfigError: no chain leads from this frame to the fixed frame.
            LogError: all links are static, or they share no time.
        """
        at = frame
        x, ahead = np.zeros(3), np.array([1.0, 0.0, 0.0])
        while (link := self._link(at, frame)).is_static:
            R, p = link.pose()
            x, ahead, at = R @ x + p, R @ ahead, link.parent
            if at == self.fixed:
                raise LogError(f"{self.source}: frame {frame!r} does not move: it is given on tf_static alone")
        stamps, R, p = link.series()
        motion = Motion.exact(stamps, R @ x + p)._replace(heading=np.array(list(map(heading_of, R @ ahead))))
        return self.in_fixed(link.parent, motion, frame)

    def in_fixed(self, frame: str, motion: Motion, origin: str) -> Motion:
        """A motion in a frame, seen from the fixed frame.

        Args:
            frame: the frame in which the motion is given.
            motion: the motion.
            origin: what moves, for messages.

        Raises:
            ConfigError: no chain leads from this frame to the fixed frame.
            LogError: they share no time.
        """
        while frame != self.fixed:
            link = self._link(frame, origin)
            motion, frame = _moved(motion, link, self.n), link.parent
            if len(motion.stamps) == 0:
                raise LogError(f"{self.source}: {origin!r} and the transforms of its frame share no time")
        return motion

    def _link(self, frame: str, origin: str) -> _Link:
        """The link above a frame.

        Raises:
            ConfigError: it does not lead to the fixed frame.
            LogError: there is a problem with it.
        """
        passed = [frame]
        while passed[-1] in self._links and passed[-1] not in passed[:-1]:
            passed.append(self._links[passed[-1]].parent)
        if self.fixed not in passed:
            there = reprlib.repr(sorted({*self._links, *(link.parent for link in self._links.values())}))
            raise ConfigError(
                f"bag.fixed_frame: {self.source}: no transforms lead from {origin!r} to {self.fixed!r}, "
                f"they end at {passed[-1]!r}; there are {there}"
            )
        link = self._links[frame]
        if link.problem is not None:
            raise LogError(f"{link.where}: {link.problem}")
        return link


def _moved(motion: Motion, link: _Link, n: int) -> Motion:
    """The motion in the parent's frame, without the samples at which the link is unknown."""
    if link.is_static:
        R, p = link.pose()
        x, u = motion.x @ R.T + p, None if motion.u is None else motion.u @ R.T
        return motion._replace(x=x, u=u, heading=_turned(motion, R[None]))
    stamps, R, p = link.series()
    inside = (motion.stamps >= stamps[0]) & (motion.stamps <= stamps[-1])
    at = motion.stamps[inside]
    after = np.searchsorted(stamps, at, side="left")
    before = np.where(stamps[after] == at, after, after - 1)
    part = (at - stamps[before]) / np.maximum(stamps[after] - stamps[before], 1)

    def between(values: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = (np.einsum("kij,kj->ki", R[k], values[inside]) + offsets[k] for k in (before, after))
        mean = (1 - part[:, None]) * a + part[:, None] * b
        return mean, np.maximum(part, 1 - part) * np.linalg.norm((b - a)[:, :n], axis=-1)

    x, x_error = between(motion.x, p)
    u, u_error = (None, 0.0) if motion.u is None else between(motion.u, np.zeros_like(p))
    kept = motion._replace(heading=None if motion.heading is None else motion.heading[inside])
    turns = (1 - part)[:, None, None] * R[before] + part[:, None, None] * R[after]
    errors = motion.position_error[inside] + x_error, motion.velocity_error[inside] + u_error
    return Motion(at, x, u, *errors, heading=_turned(kept, turns))


def _turned(motion: Motion, R: np.ndarray) -> np.ndarray | None:
    """The headings, turned by one R or by one for each sample."""
    if motion.heading is None:
        return None
    ahead = np.stack([np.cos(motion.heading), np.sin(motion.heading)], axis=-1)
    turned = (R[:, :2, :2] @ ahead[..., None])[..., 0]
    return np.arctan2(turned[:, 1], turned[:, 0])


def namespaces(types: Mapping[str, set[str]], kind: str) -> frozenset[str]:
    """The namespaces of the topics tf and tf_static among topics of these types."""
    return frozenset(topic.strip("/").rpartition("/")[0] for topic in tf_topics(types, kind)) - {""}


def tf_topics(types: Mapping[str, set[str]], kind: str) -> list[str]:
    """The topics of transforms among topics of these types."""
    return [topic for topic, of in types.items() if of == {kind} and topic.endswith(("/tf", "/tf_static"))]
