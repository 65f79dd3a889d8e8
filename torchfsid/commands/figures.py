"""The figure of an observed log, from its saved results: regions over trajectories, sizes and cases over time.

A set that is not trusted does not look precise: it is hatched, named by its status instead of its size, and its curve
is dotted from the first contradiction on. A useless bound is said above all.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections import defaultdict
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from torchfsid.commands.clock import Clock
from torchfsid.commands.figure_style import MOST_NAMED, colour, plain_name, readable_log_axis, render, thinned
from torchfsid.commands.map_panel import Marks, draw_map, extent, finish_map
from torchfsid.errors import FigureError, one_line
from torchfsid.identification.kkt import CASES

CASE_GREYS = ("#ededed", "#c6c6c6", "#9a9a9a", "#5f5f5f", "#222222")
CASE_WORDS = ("none", "one", "several, parallel", "two", "more")
"""How many rows are active in each of `CASES`, in the plane."""

CASE_WORDS_IN_SPACE = (*CASE_WORDS[:3], "several, independent", "dependent, not parallel")
"""The same in space, where up to three rows are independent."""

DOUBT = "#b00020"
"""The colour of warnings."""

FLAT = 1.9
"""Width of a scene over its height from which on the map has the whole width of the page."""


def draw_observation(
    out: Path, x: np.ndarray, seen: np.ndarray, bodies: Sequence[str], marks: Marks | None = None
) -> list[Path]:
    """Draw regions.png and regions.pdf from the files of the results folder and the positions of the log.

    Args:
        out: the results folder.
        x: (T, N, n) positions of the bodies [m].
        seen: (T, N) where they were measured.
        bodies: names of the bodies.
        marks: what is drawn besides.

    Raises:
        FigureError: a file is missing or damaged, or matplotlib fails.
        OSError: a figure cannot be written.
    """
    final = final_regions(out / "regions.json")
    history = history_of(out / "estimates.csv", final)
    marks, clock = marks or Marks(), Clock.of(float(next(iter(history.values()))["t"][0]))
    width, height = extent(final, x[..., :2], seen, marks)
    is_flat = width > FLAT * height
    size = (10.5, min(3.6, 1.4 + 9.5 * height / width) + 2.9) if is_flat else (10.5, 5.4)

    def draw(figure: Figure) -> None:
        if is_flat:
            grid = figure.add_gridspec(2, 2, height_ratios=(size[1] - 2.9, 2.9))
            places = grid[0, :], grid[1, 0], grid[1, 1]
        else:
            grid = figure.add_gridspec(
                2, 2, width_ratios=(1.25 if width > 0.6 * height else 0.8, 1), height_ratios=(2, 1)
            )
            places = grid[:, 0], grid[0, 1], grid[1, 1]
        doubt_bound(figure, out / "regions.json")
        map_axes = figure.add_subplot(places[0])
        unfinished = draw_map(map_axes, final, x[..., :2], seen, bodies, marks)
        sizes = figure.add_subplot(places[1])
        draw_sizes(sizes, history, final, clock, marks.unit)
        cases = figure.add_subplot(places[2], sharex=sizes)
        draw_cases(cases, history, clock)
        if not is_flat:
            sizes.tick_params(labelbottom=False)
            sizes.set_xlabel("")
        figure.draw_without_rendering()
        if (layout := figure.get_layout_engine()) is not None:
            layout.execute(figure)  # again, because an equal aspect changes limits and ticks
        figure.set_layout_engine("none")  # labels are placed where the axes are now
        finish_map(map_axes, unfinished, marks)

    return render(out / "regions", size, draw)


def doubt_bound(figure: Figure, path: Path) -> None:
    """Say above the figure if the bound in regions.json is useless: no region and no status shows it."""
    bound = json.loads(path.read_text(encoding="utf-8")).get("bound") or {}
    if bound.get("useless"):
        told = f"The bound {bound['used']:.3g} {bound['unit']} is useless: a wrong model explains the log as well"
        figure.suptitle(told, color=DOUBT, fontweight="bold")


def final_regions(path: Path) -> dict[str, Any]:
    """The robots' final sets."""
    try:
        robots = json.loads(path.read_text(encoding="utf-8"))["robots"]
        needed = ("vertices", "centroid", "diameter", "status")
        return {
            robot: {
                **{name: region[name] for name in needed},
                "read_again": "safety" in region,
                "contradicted_at": next((e["t"] for e in region.get("events", ()) if not e["reset"]), None),
            }
            for robot, region in robots.items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise FigureError(f"{path}: missing or damaged: {one_line(error)}") from error


def history_of(path: Path, robots: Collection[str]) -> dict[str, dict[str, np.ndarray]]:
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


def draw_sizes(axes: Axes, history: dict, final: dict[str, Any], clock: Clock, unit: str) -> None:
    count = len(history)
    for i, (robot, of) in enumerate(history.items()):
        t, diameter = thinned(of["t"]) - clock.start, thinned(of["diameter"])
        # The first lines are the widest, so that those on top of them do not hide them.
        style: dict[str, Any] = {
            "color": colour(i),
            "lw": 1.2 + 1.8 * (count - 1 - i) / count if count <= MOST_NAMED else 1,
        }
        at = final[robot]["contradicted_at"]
        ends = t > (math.inf if at is None else at - clock.start)
        trusted = ~ends if not ends.any() else ~ends | (np.arange(len(t)) == ends.argmax())
        axes.plot(t[trusted], diameter[trusted], label=plain_name(robot), **style)
        if at is not None:
            axes.plot(t[ends], diameter[ends], **{**style, "lw": 1.2, "ls": ":"})
            axes.axvline(at - clock.start, color=colour(i), lw=1, ls="--")
    last = [final[robot]["diameter"] or math.nan for robot in history if final[robot]["read_again"]]
    if last:
        for i, (size, of) in enumerate(zip(last, history.values(), strict=True)):
            axes.plot(of["t"][-1] - clock.start, size, "o", color=colour(i), ms=5, clip_on=False)
        axes.plot([], [], "o", color="0.4", ms=5, label="read again")
    if any(final[robot]["contradicted_at"] is not None for robot in history):
        axes.plot([], [], color="0.4", lw=1, ls="--", label="first contradiction")
        axes.plot([], [], color="0.4", lw=1.2, ls=":", label="not trusted")
    sizes = np.concatenate([*(of["diameter"] for of in history.values()), last])
    sizes = sizes[sizes > 0]
    if len(sizes) and sizes.max() > 2 * sizes.min():
        axes.set_yscale("log")
        readable_log_axis(axes.yaxis, sizes.min(), sizes.max())
    else:
        axes.set_ylim(0, 1.1 * sizes.max() if len(sizes) else None)
    axes.set(xlabel=_time(clock), ylabel=f"diameter [{unit}]" if unit else "diameter", title="Size of the region")
    axes.grid(color="0.93", lw=0.6)
    if axes.get_legend_handles_labels()[0] and count <= MOST_NAMED:
        axes.legend(title="robot", ncols=1 + count // 6, fontsize=8)


def draw_cases(
    axes: Axes, history: dict[str, dict[str, np.ndarray]], clock: Clock, words: Sequence[str] = CASE_WORDS
) -> None:
    cases = np.stack([thinned(of["case"]) for of in history.values()])
    t = thinned(next(iter(history.values()))["t"]) - clock.start
    ends = np.append(t, t[-1] + (t[-1] - t[-2] if len(t) > 1 else 1.0))
    colours = ListedColormap(CASE_GREYS)
    axes.pcolormesh(ends, np.arange(len(history) + 1), cases, cmap=colours, vmin=-0.5, vmax=4.5, rasterized=True)
    named = len(history) <= MOST_NAMED
    axes.set_yticks(np.arange(len(history)) + 0.5 if named else [], map(plain_name, history) if named else [])
    axes.invert_yaxis()
    axes.set(xlabel=_time(clock), ylabel="robot")
    axes.set_title("Active rows (cases)", pad=16)
    handles = [
        Patch(facecolor=grey, edgecolor="0.5", label=f"{case}: {told}")
        for case, grey, told in zip(CASES, CASE_GREYS, words, strict=True)
    ]
    style = {"fontsize": 7.5, "handlelength": 1, "columnspacing": 0.9, "handletextpad": 0.4, "borderaxespad": 0.2}
    axes.legend(handles=handles, ncols=5, loc="lower left", bbox_to_anchor=(0.0, 1.0), **style)


def _time(clock: Clock) -> str:
    return f"t - t0 [s], t0 = {clock.start:.15g} s" if clock.start else "t [s]"
