"""The figure of an observed log, from its saved results: regions over trajectories, sizes and cases over time."""

from __future__ import annotations

import csv
import io
import json
import math
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.font_manager import get_font_names
from matplotlib.patches import Patch

from torchfsid.commands.results_folder import write_whole
from torchfsid.errors import FigureError, one_line
from torchfsid.identification.kkt import CASES

ROBOT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F5539", "#4D4D4D")
"""Okabe and Ito's colours, readable for the colour-blind; reused in turn beyond eight robots."""

CASE_GREYS = ("#ededed", "#c6c6c6", "#9a9a9a", "#5f5f5f", "#222222")
STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "savefig.dpi": 160,
    "pdf.fonttype": 42,
}


MOST_POINTS = 2000
"""Of a line or a row of cells: more than a figure is wide, drawn in the time of a few."""

MOST_NAMED = 24
"""Robots beyond which a legend names none."""

NARROWEST = 0.01
"""Least width of the map [m], where parked robots and their sets are points. Robots themselves are larger."""

WIDE_FONTS = (
    "Noto Sans CJK JP",
    "Noto Sans CJK SC",
    "Noto Sans CJK KR",
    "Noto Sans Arabic",
    "Noto Sans Devanagari",
    "WenQuanYi Zen Hei",
    "Droid Sans Fallback",
    "Hiragino Sans",
    "Microsoft YaHei",
    "Arial Unicode MS",
    "Unifont",
)
"""Fonts for names that the default font cannot write, taken where they are installed."""


def draw_observation(out: Path, x: np.ndarray, seen: np.ndarray, bodies: Sequence[str]) -> list[Path]:
    """Draw regions.png and regions.pdf from the files of the results folder and the positions of the log.

    Args:
        out: the results folder.
        x: (T, N, 2) positions of the bodies [m].
        seen: (T, N) where they were measured.
        bodies: names of the bodies.

    Raises:
        FigureError: a file is missing or damaged, or matplotlib fails.
        OSError: a figure cannot be written.
    """
    final = _regions(out / "regions.json")
    history = _history(out / "estimates.csv", final)

    def draw(figure: Figure) -> None:
        grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1), height_ratios=(2.2, 1))
        _draw_map(figure.add_subplot(grid[:, 0]), final, x, seen, bodies)
        size = figure.add_subplot(grid[0, 1])
        _draw_sizes(size, history, final)
        _draw_cases(figure.add_subplot(grid[1, 1], sharex=size), history)

    return render(out / "regions", (10.5, 5.2), draw)


def render(name: Path, size: tuple[float, float], draw: Callable[[Figure], None]) -> list[Path]:
    """Draw a figure of this size [inches] and write it as `name`.png and `name`.pdf.

    Raises:
        FigureError: matplotlib fails.
        OSError: a figure cannot be written.
    """
    paths, drawn = [name.with_suffix(".png"), name.with_suffix(".pdf")], []
    try:
        with mpl.rc_context({**STYLE, "font.family": _fonts()}), warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Glyph .* missing from")  # if no font has a glyph, a box is drawn
            figure = Figure(figsize=size, layout="constrained")
            draw(figure)
            for path in paths:
                content = io.BytesIO()
                figure.savefig(content, format=path.suffix[1:])
                figure.set_layout_engine("none")  # computed once: the layout is the slowest part of drawing
                drawn.append(content.getvalue())
    except Exception as error:  # unusual names and numbers make matplotlib raise many kinds
        raise FigureError(f"{paths[0]}: not drawn: {one_line(error)}") from error
    for path, content in zip(paths, drawn, strict=True):
        write_whole(path, content)
    return paths


def _regions(path: Path) -> dict[str, Any]:
    """The robots' final sets."""
    try:
        robots = json.loads(path.read_text(encoding="utf-8"))["robots"]
        needed = ("vertices", "centroid", "diameter", "status")
        return {
            robot: {**{name: region[name] for name in needed}, "read_again": "safety" in region}
            for robot, region in robots.items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise FigureError(f"{path}: missing or damaged: {one_line(error)}") from error


def _history(path: Path, robots: Collection[str]) -> dict[str, dict[str, np.ndarray]]:
    """For each robot: times [s], diameters (NaN if the set is empty) and indices of cases (NaN if not measured).

    The times are thinned while they are read: what is not drawn is not parsed.
    """
    columns: dict[str, tuple[list[float], list[float], list[float]]] = defaultdict(lambda: ([], [], []))
    number = {"": math.nan, **{case: float(i) for i, case in enumerate(CASES)}}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = sum(len(list(io.StringIO(f"{name}.", newline=""))) for name in robots)  # a name may have several
            times = (sum(1 for _ in file) - 1) // max(1, lines)
            file.seek(0)
            header = next(csv.reader(file))
            robot, *wanted = (header.index(name) for name in ("robot", "t", "diameter", "case"))
            drawn = set(thinned(np.arange(times)).tolist())
            kept = (line for k, line in enumerate(file) if k // max(1, lines) in drawn or k >= times * lines)
            for row in csv.reader(kept):
                t, diameter, case = (row[i] for i in wanted)
                of_robot = columns[row[robot]]
                of_robot[0].append(float(t))
                of_robot[1].append(float(diameter or math.nan))
                of_robot[2].append(number[case])
    except (OSError, StopIteration, ValueError, LookupError, csv.Error) as error:
        raise FigureError(f"{path}: missing or damaged: {one_line(error)}") from error
    if not columns or len({len(t) for t, _, _ in columns.values()}) > 1:
        raise FigureError(f"{path}: missing or damaged: the robots have not the same times, or none")
    return {
        robot: dict(zip(("t", "diameter", "case"), map(np.array, of_robot), strict=True))
        for robot, of_robot in columns.items()
    }


def _fonts() -> list[str]:
    there = set(get_font_names())
    return ["sans-serif", *(font for font in WIDE_FONTS if font in there)]


def thinned(values: np.ndarray) -> np.ndarray:
    """At most `MOST_POINTS` of the values, evenly spaced, the last one included."""
    step = -(-len(values) // MOST_POINTS)
    return values if step <= 1 else values[(len(values) - 1) % step :: step]


def plain_name(name: str) -> str:
    """The name for matplotlib: a dollar starts no formula, and a leading underscore does not hide it from a legend."""
    name = name if len(name) <= 24 else f"{name[:23]}…"
    return (" " if name.startswith("_") else "") + name.replace("$", r"\$")


def _draw_map(axes: Axes, final: dict, x: np.ndarray, seen: np.ndarray, bodies: Sequence[str]) -> None:
    for body in bodies:
        k = bodies.index(body)
        path = thinned(x[seen[:, k], k])
        if len(path) == 0:  # its only sample was the last one, where velocities from differences do not exist
            continue
        if body not in final:
            axes.plot(*path.T, color="0.75", lw=1)
            axes.plot(*path[-1], "o", color="0.6", ms=6)
            continue
        mine = colour(list(final).index(body))
        axes.plot(*path.T, color=mine, lw=1.2, alpha=0.8)
        axes.plot(*path[0], "o", color=mine, ms=4, mfc="white")
        axes.plot(*path[-1], "o", color=mine, ms=6)
    labels: Counter[tuple[float, ...]] = Counter()
    for i, (robot, region) in enumerate(final.items()):
        if len(region["centroid"]) != 2 or None in region["centroid"]:  # not planar, or empty
            continue
        vertices = np.array(region["vertices"])
        is_ok = region["status"] == "ok"
        axes.fill(*vertices.T, facecolor=colour(i) if is_ok else "0.5", edgecolor="none", alpha=0.3 if is_ok else 0.15)
        axes.fill(*vertices.T, facecolor="none", edgecolor=colour(i), alpha=0.6, lw=1.2, ls="-" if is_ok else "--")
        axes.plot(*region["centroid"], "+", color=colour(i), ms=11, mew=1.6)
        axes.annotate(
            f"{plain_name(robot)}: {region['diameter']:.2g} m" + ("" if is_ok else f", {region['status']}"),
            region["centroid"],
            textcoords="offset points",
            xytext=(7, 7 - 12 * labels[tuple(region["centroid"])]),
            color=colour(i),
        )
        labels[tuple(region["centroid"])] += 1  # sets that were never cut have the same centroid
    axes.set(xlabel="x [m]", ylabel="y [m]", title="Final regions, centroids, diameters")
    axes.set_aspect("equal", adjustable="datalim")  # the map fills its place, however flat the data
    axes.margins(0.18)
    left, low = axes.dataLim.x0, axes.dataLim.y0
    axes.update_datalim([(left - NARROWEST / 2, low), (left + NARROWEST / 2, low)])
    axes.grid(color="0.93", lw=0.6)
    axes.set_axisbelow(True)


def _draw_sizes(axes: Axes, history: dict[str, dict[str, np.ndarray]], final: dict[str, Any]) -> None:
    for i, (robot, of) in enumerate(history.items()):
        axes.plot(thinned(of["t"]), thinned(of["diameter"]), color=colour(i), lw=1.5, label=plain_name(robot))
    last = [final[robot]["diameter"] or math.nan for robot in history if final[robot]["read_again"]]
    if last:
        for i, (size, of) in enumerate(zip(last, history.values(), strict=True)):
            axes.plot(of["t"][-1], size, "o", color=colour(i), ms=5, clip_on=False)
        axes.plot([], [], "o", color="0.4", ms=5, label="read again")
    sizes = np.concatenate([*(of["diameter"] for of in history.values()), last])
    sizes = sizes[sizes > 0]
    if len(sizes) and sizes.max() > 2 * sizes.min():
        axes.set_yscale("log")
    else:
        axes.set_ylim(0, 1.1 * sizes.max() if len(sizes) else None)
    axes.set(ylabel="diameter [m]", title="Size of the region")
    axes.grid(color="0.93", lw=0.6)
    axes.tick_params(labelbottom=False)
    if len(history) <= MOST_NAMED:
        axes.legend(title="robot", ncols=1 + len(history) // 6, fontsize=8)


def _draw_cases(axes: Axes, history: dict[str, dict[str, np.ndarray]]) -> None:
    cases = np.stack([thinned(of["case"]) for of in history.values()])
    t = thinned(next(iter(history.values()))["t"])
    ends = np.append(t, t[-1] + (t[-1] - t[-2] if len(t) > 1 else 1.0))
    colours = ListedColormap(CASE_GREYS)
    axes.pcolormesh(ends, np.arange(len(history) + 1), cases, cmap=colours, vmin=-0.5, vmax=4.5, rasterized=True)
    named = len(history) <= MOST_NAMED
    axes.set_yticks(np.arange(len(history)) + 0.5 if named else [], map(plain_name, history) if named else [])
    axes.invert_yaxis()
    axes.set(xlabel="t [s]", ylabel="robot", title="Case")
    handles = [Patch(facecolor=grey, edgecolor="0.5", label=case) for case, grey in zip(CASES, CASE_GREYS, strict=True)]
    axes.legend(
        handles=handles,
        ncols=5,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        fontsize=8,
        handlelength=1,
        columnspacing=1,
    )


def colour(i: int) -> str:
    return ROBOT_COLOURS[i % len(ROBOT_COLOURS)]
