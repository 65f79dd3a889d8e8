"""The map of an observed log: paths, final regions and what they are compared with, with labels that hide nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from torchfsid.commands.figure_style import MOST_NAMED, colour, plain_name, thinned
from torchfsid.config.observe import ObserveConfig

NARROWEST = 0.01
"""Least width of the map [m], where parked robots and their sets are points. Robots themselves are larger."""

SMALL = 0.02
"""Share of the scene below which a region is too small to be seen, and gets a ring."""

DISTANCES = (12, 18, 28, 42, 58)
"""Distances of labels from what they name that are tried [points]."""

LEADER = 20
"""Distance beyond which a line leads from the label to what it names [points]."""

ROW = 5
"""Marks that a row of the legend holds."""

PRIOR: dict[str, Any] = {"facecolor": "none", "edgecolor": "0.35", "lw": 1.0, "ls": (0, (1, 2))}
"""How the prior is drawn."""


@dataclass(frozen=True)
class Marks:
    """What the map shows beside paths and regions.

    Attributes:
        prior: lower and upper corner of the prior. It is drawn where it is in view.
        truth: the true theta of some robots.
        unit: the unit of theta. Empty if its entries have different ones.
        is_place: theta is a place. Otherwise regions are not drawn over paths.
    """

    prior: tuple[Sequence[float], Sequence[float]] | None = None
    truth: Mapping[str, Sequence[float]] = field(default_factory=dict)
    unit: str = "m"
    is_place: bool = True

    @classmethod
    def of(cls, config: ObserveConfig) -> Marks:
        """What a configuration says of them."""
        corners = config.prior.lower, config.prior.upper
        return cls(corners, config.truth or {}, config.task.unit, config.task.is_place)


class Label(NamedTuple):
    """A text and the point that it names."""

    text: str
    point: tuple[float, float]
    colour: str


class Unfinished(NamedTuple):
    """Labels that are still to be placed, and the marks of the legend."""

    labels: Sequence[Label]
    handles: Mapping[str, Line2D | Patch]


def extent(final: Mapping[str, Any], x: np.ndarray, seen: np.ndarray, marks: Marks) -> tuple[float, float]:
    """Width and height of what the map shows [m]."""
    points = np.concatenate([x[seen], *(np.array(region["vertices"]) for region in _drawn(final, marks).values())])
    width, height = np.ptp(points, axis=0) if len(points) else (0.0, 0.0)
    return max(float(width), NARROWEST), max(float(height), NARROWEST)


def draw_map(
    axes: Axes, final: Mapping[str, Any], x: np.ndarray, seen: np.ndarray, bodies: Sequence[str], marks: Marks
) -> Unfinished:
    """Draw the map.

    Args:
        axes: where to draw.
        final: the entries of regions.json.
        x: (T, N, 2) positions of the bodies [m].
        seen: (T, N) where they were measured.
        bodies: names of the bodies.
        marks: what is drawn besides.

    Returns:
        What `finish_map` needs.
    """
    handles: dict[str, Line2D | Patch] = {}
    width, height = extent(final, x, seen, marks)
    _draw_paths(axes, final, x, seen, bodies, handles)
    robots, labels = list(final), []
    for robot, region in _drawn(final, marks).items():
        i = robots.index(robot)
        labels.append(_draw_region(axes, robot, region, colour(i), SMALL * max(width, height), handles, marks.unit))
    for robot, theta in marks.truth.items():
        if marks.is_place and len(theta) == 2 and robot in final:
            star = {"color": colour(robots.index(robot)), "mec": "black", "mew": 0.7, "ms": 11, "ls": "none"}
            axes.plot(*theta, "*", **star)
            handles["truth"] = Line2D([], [], marker="*", **{**star, "color": "0.6"})
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.ticklabel_format(useOffset=False, style="plain")  # far from the origin, an offset would hide the legend
    axes.set_aspect("equal", adjustable="datalim")  # the map fills its place, however flat the data
    axes.margins(0.12)
    left, low = axes.dataLim.x0, axes.dataLim.y0
    axes.update_datalim([(left - NARROWEST / 2, low), (left + NARROWEST / 2, low)])
    axes.grid(color="0.93", lw=0.6)
    axes.set_axisbelow(True)
    _legend(axes, handles | {"prior": Patch(**PRIOR)})  # room for it
    axes.set_title("Final regions" if labels else "Paths", pad=16 + 11 * (len(handles) >= ROW))
    return Unfinished(labels if len(final) <= MOST_NAMED else [], handles)


def finish_map(axes: Axes, unfinished: Unfinished, marks: Marks) -> None:
    """Add what depends on the limits of the axes, which must have been laid out: prior, legend and labels."""
    handles = dict(unfinished.handles)
    if marks.prior is not None and marks.is_place and len(marks.prior[0]) == 2:
        limits, corners = (axes.get_xlim(), axes.get_ylim()), list(zip(*marks.prior, strict=True))
        if any(low < side < high for (low, high), sides in zip(limits, corners, strict=True) for side in sides):
            (left, right), (low, high) = corners
            axes.add_artist(Rectangle((left, low), right - left, high - low, **PRIOR))  # it does not widen the view
            handles["prior"] = Patch(**PRIOR)
    _legend(axes, handles)
    _place(axes, unfinished.labels)


def _legend(axes: Axes, handles: Mapping[str, Line2D | Patch]) -> None:
    style = {"fontsize": 7.5, "handletextpad": 0.4, "columnspacing": 1.2, "borderaxespad": 0.2}
    columns = len(handles) if len(handles) <= ROW else -(-len(handles) // 2)
    axes.legend(handles.values(), handles, ncols=columns, loc="lower left", bbox_to_anchor=(0.0, 1.0), **style)


def _drawn(final: Mapping[str, Any], marks: Marks) -> dict[str, Any]:
    """The regions that can be drawn: planar ones that are places and not empty."""
    return {
        robot: region
        for robot, region in final.items()
        if marks.is_place and len(region["centroid"]) == 2 and None not in region["centroid"]
    }


def _draw_paths(
    axes: Axes, final: Mapping[str, Any], x: np.ndarray, seen: np.ndarray, bodies: Sequence[str], handles: dict
) -> None:
    for k, body in enumerate(bodies):
        path = thinned(x[seen[:, k], k])
        if len(path) == 0:  # its only sample was the last one, where velocities from differences do not exist
            continue
        if body not in final:
            axes.plot(*path.T, color="0.75", lw=1)
            axes.plot(*path[-1], "o", color="0.6", ms=6)
            handles["obstacle"] = Line2D([], [], color="0.75", lw=1, marker="o", ms=6, mfc="0.6", mec="0.6")
            continue
        mine = colour(list(final).index(body))
        axes.plot(*path.T, color=mine, lw=1.2, alpha=0.8)
        axes.plot(*path[0], "o", color=mine, ms=4, mfc="white")
        axes.plot(*path[-1], "o", color=mine, ms=6)
        handles["start"] = Line2D([], [], color="0.4", marker="o", ms=4, mfc="white", ls="none")
        handles["end"] = Line2D([], [], color="0.4", marker="o", ms=6, ls="none")


def _draw_region(
    axes: Axes, robot: str, region: Mapping[str, Any], mine: str, small: float, handles: dict, unit: str
) -> Label:
    vertices, (cx, cy) = np.array(region["vertices"]), region["centroid"]
    if region["status"] != "ok":
        axes.fill(*vertices.T, facecolor="0.5", edgecolor="none", alpha=0.15)
        axes.fill(*vertices.T, facecolor="none", edgecolor=mine, alpha=0.7, lw=1.2, ls="--", hatch="////")
        if region["diameter"] < small:
            axes.plot(cx, cy, "o", color="0.5", alpha=0.4, mec=mine, ms=20, ls="none", zorder=1)
        handles["region not trusted"] = Patch(facecolor="0.88", edgecolor="0.4", ls="--", hatch="////")
        return Label(f"{plain_name(robot)}: {region['status']}", (cx, cy), mine)
    axes.fill(*vertices.T, facecolor=mine, edgecolor="none", alpha=0.3)
    axes.fill(*vertices.T, facecolor="none", edgecolor=mine, alpha=0.6, lw=1.2)
    axes.plot(cx, cy, "+", color=mine, ms=11, mew=1.6)
    handles["region"] = Patch(facecolor="0.8", edgecolor="0.4")
    handles["centroid"] = Line2D([], [], color="0.4", marker="+", ms=10, mew=1.6, ls="none")
    if region["diameter"] < small:
        ring = {"marker": "o", "ms": 15, "mfc": "none", "mew": 1.0, "ls": "none"}
        axes.plot(cx, cy, color=mine, **ring)
        handles["region too small to see"] = Line2D([], [], color="0.4", **{**ring, "ms": 9})
    return Label(f"{plain_name(robot)}: {region['diameter']:.2g} {unit}".rstrip(), (cx, cy), mine)


def _place(axes: Axes, labels: Sequence[Label]) -> None:
    """Put labels beside what they name: inside the axes, off paths, marks and other labels where there is room.

    Of some places around each point the one that hides least is taken.
    """
    figure = axes.figure
    scale = figure.dpi / 72
    frame, taken = axes.get_window_extent(), [np.empty((0, 2))]
    for line in axes.lines:
        points = axes.transData.transform(np.column_stack([line.get_xdata(), line.get_ydata()]).astype(float))
        taken.append(_filled(points))
    for patch in axes.patches:
        taken.append(_filled(np.asarray(patch.get_transform().transform_path(patch.get_path()).vertices)))
    points, boxes = np.concatenate(taken), []
    for label in labels:
        centre = axes.transData.transform(label.point)
        text = axes.text(0, 0, label.text, color=label.colour)
        box = text.get_window_extent()
        text.remove()
        size = np.array([box.width, box.height])
        best = None
        for distance in DISTANCES:
            for angle in np.arange(8) * np.pi / 4 + np.pi / 4:
                direction = np.array([np.cos(angle), np.sin(angle)])
                middle = centre + direction * distance * scale + np.sign(np.round(direction, 6)) * size / 2
                low, high = middle - size / 2 - 2, middle + size / 2 + 2
                hidden = int(((points > low) & (points < high)).all(axis=1).sum())
                overlaps = sum(bool((low < other[1]).all() and (high > other[0]).all()) for other in boxes)
                outside = bool((low < frame.min).any() or (high > frame.max).any())
                cost = hidden + 300 * overlaps + 1000 * outside + distance / 4
                if best is None or cost < best[0]:
                    best = cost, distance, middle, (low, high)
        assert best is not None
        _, distance, middle, corners = best
        boxes.append(corners)
        line = {"arrowstyle": "-", "color": label.colour, "lw": 0.6, "shrinkA": 0, "shrinkB": 4}
        axes.annotate(
            label.text,
            label.point,
            xytext=tuple((middle - centre) / scale),
            textcoords="offset points",
            ha="center",
            va="center",
            color=label.colour,
            arrowprops=line if distance > LEADER else None,
        )


def _filled(points: np.ndarray) -> np.ndarray:
    """Points along a line of pixels, about 4 apart."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 2:
        return np.repeat(points, 25, axis=0)  # a mark: as good as a piece of a path
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    wanted = np.linspace(0.0, along[-1], min(2000, 2 + int(along[-1] / 4)))
    return np.column_stack([np.interp(wanted, along, points[:, i]) for i in (0, 1)])
