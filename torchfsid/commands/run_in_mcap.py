"""`observe --mcap`: a run as standard ROS 2 messages, for Foxglove, RViz, rerun (docs/mcap.md has the layout).

    /torchfsid/bodies            MarkerArray       all bodies, discs with names, at every time
    /torchfsid/status            DiagnosticArray   the line of estimates.csv of every robot, at every time
    /torchfsid/<robot>/region    MarkerArray       Theta(t), the prior, name and status: when one of them has changed,
                                                   at least every `RESENT`, and at the end
    /torchfsid/<robot>/centroid  PoseStamped       a point of Theta(t), at every time; likewise hybrid and ukf
    /torchfsid/<body>/odom       Odometry          what was observed, at every time at which it was
    /tf                          TFMessage         the same as frames torchfsid/<body>

All is in one frame: that of the bag's positions, otherwise `FRAME`. Regions and points are drawn where theta has two or
three entries; other theta are told by the diagnostics only.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch

from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.figure_style import ROBOT_COLOURS
from torchfsid.commands.interruption import uninterrupted
from torchfsid.commands.results import STATUS_NAMES
from torchfsid.commands.safety_results import without_repeats
from torchfsid.logs.mcap import OURS, McapFile
from torchfsid.logs.ros_messages import ADD, CYLINDER, DELETE, LINES, SPHERE, TEXT, TRIANGLES, Messages
from torchfsid.outcome import Status
from torchfsid.sets.feasible_set import FeasibleSet

FRAME = "map"
"""The frame of logs that name none."""

RESENT = 1_000_000_000
"""Longest time without a region [ns], so that a viewer that starts in the middle soon has all."""

UNTRUSTED = (0.45, 0.45, 0.45)
"""Colour of a region whose status is not ok."""

OBSTACLE = (0.3, 0.3, 0.3)

LEVELS = {Status.OK: 0, Status.ALARM: 1, Status.INCONSISTENT: 2}
"""Levels of DiagnosticStatus: OK, WARN, ERROR."""

TOUCHING = 1e-6
"""Slack below which a vertex lies on a facet, relative to the size of its set."""


class RunInMcap:
    """Writes the messages of a run. Use it as a context manager.

    Args:
        path: the file. It must not exist.
        declared: the log and its model.
        header: names of the columns of estimates.csv.
        source: a bag whose messages are copied, too. None: none.

    Raises:
        ConfigError: a type of the bag has no definition.
        OSError: the file cannot be made.
    """

    def __init__(self, path: Path, declared: DeclaredLog, header: Sequence[str], source: Path | None = None):
        log, robots, prior = declared.log, declared.robots, declared.prior
        self._file, self._log, self._robots = McapFile(path, source), log, list(robots)
        self._header = list(header)
        self._points = {
            name: [self._header.index(f"{name}_{i}") for i in range(prior.dim)]
            for name in ("centroid", "hybrid", "ukf")
        }
        self._make = Messages(self._file.types, log.frame or FRAME)
        self._origin = round((log.reading.time_origin or 0.0) * 1e9)
        self._topics = _topics(log.bodies)
        x = log.x[log.seen]
        self._size = max(float((x.max(axis=0) - x.min(axis=0)).max()), 1e-3)
        self._is_drawn = prior.dim in (2, 3)
        self._priors = [outline(prior, i) for i in range(len(robots))] if self._is_drawn else []
        self._told: list[tuple[float, int, int]] = [(math.inf, -1, 0)] * len(robots)
        self._last: int | None = None

    def __enter__(self) -> RunInMcap:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with uninterrupted():
            self._file.close()

    def see(self, t: float, sets: FeasibleSet, status: Sequence[int], lines: Sequence[Sequence[str]]) -> None:
        """Write the messages of one time.

        Args:
            t: the time [s].
            sets: the set of each robot.
            status: a `Status` for each robot.
            lines: the lines of estimates.csv.
        """
        k = int(np.argmin(np.abs(self._log.t - t)))
        stamp = self._origin + round(t * 1e9)
        self._write(stamp, "bodies", self._make.markers(self._bodies(k, stamp)))
        places = {}
        for j in np.flatnonzero(self._log.seen[k]).tolist():
            name, heading = self._topics[self._log.bodies[j]], self._heading(k, j)
            x, u = self._log.x[k, j], self._velocity(k, j)
            places[f"torchfsid/{name}"] = x, heading
            self._write(stamp, f"{name}/odom", self._make.odometry(stamp, x, u, heading))
        self._file.write("/tf", stamp, self._make.transforms(stamp, places))
        self._write(stamp, "status", self._diagnostics(stamp, status, lines))
        if self._is_drawn:
            self._write_regions(stamp, sets, status)
            self._write_points(stamp, lines)
        self._last = stamp

    def finish(self, sets: FeasibleSet, status: Sequence[int]) -> None:
        """Write the final regions, at the time of the last sample."""
        if self._last is not None and self._is_drawn:
            self._told = [(math.inf, -1, 0)] * len(self._robots)
            self._write_regions(self._last, sets, status)

    def _write(self, stamp: int, topic: str, message: Any) -> None:
        self._file.write(f"{OURS}{topic}", stamp, message)

    def _write_points(self, stamp: int, lines: Sequence[Sequence[str]]) -> None:
        """Write the points that estimates.csv has."""
        for robot, line in zip(self._robots, lines, strict=True):
            for name, columns in self._points.items():
                cells = [line[column] for column in columns]
                if all(cells):
                    point = self._make.pose(stamp, np.array(list(map(float, cells))))
                    self._write(stamp, f"{self._topics[robot]}/{name}", point)

    def _write_regions(self, stamp: int, sets: FeasibleSet, status: Sequence[int]) -> None:
        """Write the regions that have changed, or were not told for long."""
        cuts = sets.last_cut.nan_to_num(nan=-math.inf).tolist()  # a set that is reset is the prior, never cut
        for i, robot in enumerate(self._robots):
            cut, told, at = self._told[i]
            if (cuts[i], int(status[i])) != (cut, told) or stamp - at >= RESENT:
                self._told[i] = cuts[i], int(status[i]), stamp
                markers = self._region(i, outline(sets, i), Status(int(status[i])), stamp)
                self._write(stamp, f"{self._topics[robot]}/region", self._make.markers(markers))

    def _region(self, i: int, outline: tuple[np.ndarray, np.ndarray], status: Status, stamp: int) -> Iterator[Any]:
        """Fill, outline and label of a region, and the prior."""
        (vertices, edges), (corners, sides), width = outline, self._priors[i], 0.004 * self._size
        trusted = status == Status.OK
        colour = _rgb(ROBOT_COLOURS[i % len(ROBOT_COLOURS)]) if trusted else UNTRUSTED
        yield self._make.marker(
            stamp, "prior", LINES, (0.6, 0.6, 0.6, 0.6), width / 2, points=corners[sides.reshape(-1)]
        )
        if not len(vertices):
            for name in ("fill", "outline", "label"):
                yield self._make.marker(stamp, name, TEXT, (*colour, 0.0), width, action=DELETE)
            return
        fan = [(0, b, b + 1) for b in range(1, len(vertices) - 1)] if vertices.shape[1] == 2 else []
        triangles = vertices[np.array(fan, dtype=int).reshape(-1)]
        if len(triangles):
            yield self._make.marker(stamp, "fill", TRIANGLES, (*colour, 0.35), 1.0, points=triangles)
        else:
            yield self._make.marker(stamp, "fill", TRIANGLES, (*colour, 0.0), 1.0, action=DELETE)
        yield self._make.marker(stamp, "outline", LINES, (*colour, 1.0), width, points=vertices[edges.reshape(-1)])
        text = f"{self._robots[i]}: {STATUS_NAMES[status]}"
        centre = vertices.mean(axis=0)
        yield self._make.marker(stamp, "label", TEXT, (*colour, 1.0), 0.025 * self._size, at=centre, text=text)

    def _bodies(self, k: int, stamp: int) -> Iterator[Any]:
        """A disc, or a ball in space, and a name for each body."""
        log, place = self._log, {robot: i for i, robot in enumerate(self._robots)}
        for j, body in enumerate(log.bodies):
            radius = 0.01 * self._size if log.radius is None or log.radius[j] == 0 else float(log.radius[j])
            i = place.get(body)
            colour = OBSTACLE if i is None else _rgb(ROBOT_COLOURS[i % len(ROBOT_COLOURS)])
            kind, action = SPHERE if log.x.shape[-1] == 3 else CYLINDER, ADD if log.seen[k, j] else DELETE
            yield self._make.marker(stamp, "bodies", kind, (*colour, 0.9), 2 * radius, j, at=log.x[k, j], action=action)
            yield self._make.marker(
                stamp, "names", TEXT, (*colour, 1.0), 0.025 * self._size, j, at=log.x[k, j], text=body, action=action
            )

    def _velocity(self, k: int, j: int) -> np.ndarray:
        """The velocity of a body [m/s], zero where it is unknown."""
        log = self._log
        return log.u[k, j] if log.u is not None and log.velocity_known[k, j] else np.zeros(log.x.shape[-1])

    def _heading(self, k: int, j: int) -> float:
        """The heading of a body [rad], zero where it is unknown."""
        log = self._log
        is_known = log.heading is not None and log.oriented is not None and bool(log.oriented[k, j])
        return float(log.heading[k, j]) if is_known and log.heading is not None else 0.0

    def _diagnostics(self, stamp: int, status: Sequence[int], lines: Sequence[Sequence[str]]) -> Any:
        """The lines of estimates.csv."""
        states = [Status(int(of)) for of in status]
        return self._make.diagnostics(
            stamp,
            (
                (LEVELS[state], f"torchfsid: {robot}", STATUS_NAMES[state], dict(zip(self._header, line, strict=True)))
                for robot, state, line in zip(self._robots, states, lines, strict=True)
            ),
        )


def outline(sets: FeasibleSet, i: int) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of a set, and its edges as pairs of vertices: those that lie on p - 1 facets together.

    In the plane the vertices go round. An empty set has none.
    """
    one = sets.select(torch.tensor([i], device=sets.outcome.device))
    vertices = without_repeats(one.vertices()[0].detach()).cpu().numpy()
    if not np.isfinite(vertices).all():
        return np.zeros((0, sets.dim)), np.zeros((0, 2), dtype=int)
    if sets.dim == 2:
        here = np.arange(len(vertices))
        return vertices, np.stack([here, np.roll(here, -1)], axis=1) if len(here) > 1 else np.zeros((0, 2), dtype=int)
    rows = one.facets().halfspaces
    A, b = rows.A[0].detach().cpu().numpy(), rows.b[0].detach().cpu().numpy()
    lengths = np.linalg.norm(A, axis=1)
    A, b = A[lengths > 0] / lengths[lengths > 0, None], b[lengths > 0] / lengths[lengths > 0]
    size = float(np.ptp(vertices, axis=0).max())
    on = np.abs(vertices @ A.T - b) <= TOUCHING * size
    shared = on.astype(int) @ on.T.astype(int)
    return vertices, np.argwhere(np.triu(shared >= sets.dim - 1, k=1))


def _topics(bodies: Sequence[str]) -> Mapping[str, str]:
    """A name for each body that is allowed in topics: letters, digits and _, no digit first."""
    names: dict[str, str] = {}
    for body in bodies:
        name = re.sub(r"[^A-Za-z0-9_]", "_", body)
        name = f"robot_{name}" if not name[:1].isalpha() else name
        while name in names.values():
            name += "_"
        names[body] = name
    return names


def _rgb(colour: str) -> tuple[float, float, float]:
    return int(colour[1:3], 16) / 255, int(colour[3:5], 16) / 255, int(colour[5:7], 16) / 255
