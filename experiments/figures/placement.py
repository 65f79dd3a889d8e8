"""The figures of a placed probe: the search, the runs with and without probes, and a film of these.

The figure of the search has the landscape, the methods, the gradients and the switches.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from experiments.design.config import ProbePlacementConfig
from experiments.figures.drawing import add_box, add_goal, add_region, add_robot, headline, name_panel
from experiments.figures.film import Film, spread
from experiments.figures.style import HYBRID, INACTIVE, INVERSE_OPTIMAL, REGION, ROBOT, UKF
from experiments.results import Columns, damaged, read_columns, read_json, reading

FRAMES, FRAME_MS, COLOURS = 40, 120, 96
SIZE, DPI = (8.0, 2.6), 90

PROBE = INVERSE_OPTIMAL
SEEN = 0.95
"""The map shows the places from which a probe brings the area below this share of the largest, and the robot."""

TICKS = [digit * 10.0**power for power in range(-6, 3) for digit in (1, 2, 3, 5, 7)]
METHODS = {
    "none": ("no probe", "0.4"),
    "one_random": ("one at random", "0.4"),
    "random": ("best at random", HYBRID),
    "grid": ("best on a grid", "#56B4E9"),
    "near_path": ("best near the path", "#7F5539"),
    "cem": ("cross-entropy method", UKF),
    "adam": ("Adam", REGION),
}
"""Label and colour of each method."""

MARKERS = {"random": "s", "grid": "D", "cem": "P", "adam": "*"}
"""Of those that are shown on the map."""


def draw_placement(folder: Path, config: ProbePlacementConfig) -> Iterator[tuple[str, Figure | Film]]:
    """The figures and the film, with their names."""
    replay = _replay(folder / "replay.json")
    yield "figure", draw_search(folder, config)
    yield "comparison", draw_before_after(replay, config)
    yield "animation", _film(replay, config)


def _film(replay: dict[str, Any], config: ProbePlacementConfig) -> Film:
    """The same goal without a probe and with the path that was found: a frame per sample, at most `FRAMES`."""
    shown, film = [replay["runs"][0], replay["runs"][-1]], Film(FRAME_MS, COLOURS)
    with mpl.rc_context({"font.size": 8, "axes.titlesize": 8.5}):
        for k in spread(len(shown[0]["samples"]), FRAMES):
            figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
            canvas = FigureCanvasAgg(figure)
            for axes, run in zip(figure.subplots(1, 2), shown, strict=True):
                draw_map(axes, replay, run, config, k)
                sample = run["samples"][k]
                axes.set_title(f"{name_of(run)}   t = {sample['t']:.2f} s   area {sample['area']:.3f} m²")
            canvas.draw()
            film.add(canvas)
    return film


def _replay(path: Path) -> dict[str, Any]:
    """The runs with one goal, without a probe and with several. The content is checked, so that it can be drawn."""
    with reading(path):
        replay = read_json(path)
        _points(replay["goal"], *replay["obstacles"])
        for run in replay["runs"]:
            name_of(run)
            _points(*(run["way_point_places"] or []))
            for sample in run["samples"]:
                _points(sample["x"], *sample["vertices"], *([sample["probe"]] if sample["probe"] else []))
                _points([sample["t"], sample["area"]])
                sample["active"] = list(sample["active"])
    if len({len(run["samples"]) for run in replay["runs"]}) != 1 or not replay["runs"][0]["samples"]:
        damaged(path, "its runs are of different lengths")
    return replay


def _points(*points: Any) -> None:
    """Check that these are pairs of numbers, by a ValueError or TypeError."""
    np.array(points, dtype=float).reshape(len(points), 2)


def draw_search(folder: Path, config: ProbePlacementConfig) -> Figure:
    """The figure of the search."""
    figure = Figure(figsize=(11.5, 6.0), layout="constrained")
    grid = figure.add_gridspec(2, 3, height_ratios=(1.2, 1), width_ratios=(1, 1, 1.7))
    _landscape(figure.add_subplot(grid[0, :2]), folder, config)
    _methods(figure.add_subplot(grid[:, 2]), folder, config)
    _cosines(figure.add_subplot(grid[1, 0]), folder)
    _switches(figure.add_subplot(grid[1, 1]), folder)
    headline(figure, f"{config.title}: {config.scenes} corridors, held-out goals")
    return figure


def _landscape(axes: Axes, folder: Path, config: ProbePlacementConfig) -> None:
    path, (columns, lines) = folder / "landscape.csv", config.landscape
    table = read_columns(path)
    with reading(path):
        mean = table.numbers("mean_area").reshape(lines, columns)
    (left, bottom), (right, top) = config.room.lower, config.room.upper
    low, high = np.nanmin(mean), np.nanmax(mean)
    image = axes.imshow(
        mean, extent=(left, right, bottom, top), origin="lower", norm=LogNorm(low, high), cmap="viridis"
    )
    assert axes.figure is not None
    bar = axes.figure.colorbar(image, ax=axes, pad=0.01, shrink=0.7)
    bar.set_label("mean area left [m²]")
    bar.set_ticks([tick for tick in TICKS if low <= tick <= high])
    bar.ax.minorticks_off()
    bar.ax.yaxis.set_major_formatter("{x:g}")

    obstacles, chosen = _first_corridor(folder / "placements.json")
    _corridor(axes, obstacles, config)
    start_x, start_y = config.start
    axes.add_patch(Circle((start_x, start_y), config.safety_distance, fc="none", ec="black", ls=":", lw=1))
    for way in _ways(read_columns(folder / "descent.csv")):
        found = (way == chosen["adam"]).all(-1).any()
        axes.plot(*way.T, color="white", lw=1.8 if found else 0.5, alpha=1.0 if found else 0.6, zorder=3 + found)
        axes.plot(*way[0], "o", color="white", ms=5.0 if found else 2.4, mec="black", mew=0.4, zorder=3 + found)
    for name, marker in MARKERS.items():
        x, y = chosen[name]
        label, colour = METHODS[name]
        size = 12 if name == "adam" else 7
        axes.plot(x, y, marker, color=colour, ms=size, mec="black", mew=0.8, label=label, ls="", zorder=6)
    places = np.stack([table.numbers("x"), table.numbers("y")], axis=-1)
    matter = mean.ravel() < (SEEN * high if low < SEEN * high else np.inf)
    seen = np.vstack([places[matter], np.array([config.start]) - config.safety_distance / 2])
    left, bottom = np.maximum(seen.min(0) - 0.05, config.room.lower)
    right, top = np.minimum(seen.max(0) + 0.05, config.room.upper)
    axes.set(xlabel="x of a probe that stands still [m]", ylabel="y [m]", xlim=(left, right), ylim=(bottom, top))
    name_panel(axes, 0, "the area a still probe leaves; white: Adam's ways")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=4, fontsize=7, columnspacing=1.2)


def _ways(table: Columns) -> list[np.ndarray]:
    """The places on the descent from each start.

    From one stage to the next a descent goes on from the best of its places.
    """
    places = np.stack([table.numbers("x"), table.numbers("y")], axis=-1)
    return [places[table["start"] == start] for start in dict.fromkeys(table["start"])]


def _first_corridor(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The obstacles of the first corridor, and each method's place of a still probe [m]."""
    with reading(path):
        first = read_json(path)[0]
        chosen = {name: np.array(at[0], dtype=float).reshape(2) for name, at in first["chosen"]["1"].items()}
        return np.array(first["obstacles"], dtype=float).reshape(-1, 2), {name: chosen[name] for name in MARKERS}


def _corridor(axes: Axes, obstacles: np.ndarray, config: ProbePlacementConfig) -> None:
    for x, y in obstacles:
        axes.add_patch(Circle((x, y), config.safety_distance / 2, fc=INACTIVE, ec="0.4", lw=0.6, zorder=2))
    add_robot(axes, config.start, config.safety_distance / 2, ROBOT)


def _methods(axes: Axes, folder: Path, config: ProbePlacementConfig) -> None:
    runs = read_columns(folder / "runs.csv")
    ticks: list[float] = []
    labels, y = [], 0.0
    for K in config.way_points:
        still = "a probe that stands still" if K == 1 else f"a path of {K} way-points"
        axes.text(0.01, y, still, transform=axes.get_yaxis_transform(), fontstyle="italic", va="center")
        for name, (label, colour) in METHODS.items():
            areas = runs.where(method=name, way_points=K).numbers("mean_area")
            if len(areas) == 0:
                continue
            y -= 1
            spread = np.linspace(-0.22, 0.22, len(areas))
            axes.plot(areas, y + spread, "o", color=colour, ms=3, alpha=0.6, mew=0)
            axes.plot([areas.mean()] * 2, [y - 0.38, y + 0.38], color=colour, lw=2.4)
            axes.text(1.02, y, f"{areas.mean():.3g}", transform=axes.get_yaxis_transform(), va="center", fontsize=7)
            ticks.append(y)
            labels.append(label)
        y -= 1.3
    axes.set(
        yticks=ticks, yticklabels=labels, xscale="log", xlabel="mean area left [m²]; a dot per corridor, bar: mean"
    )
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_ylim(min(ticks) - 0.6, 0.6)
    axes.grid(True, axis="x")
    number = config.search.starts * config.search.steps
    name_panel(axes, 1, f"the methods, {number} placements each")


def _cosines(axes: Axes, folder: Path) -> None:
    checks = read_columns(folder / "gradient_check.csv")
    for objective, colour in (("area", REGION), ("log_area", UKF)):
        for K, marker in zip(np.unique(checks.numbers("way_points")).astype(int), "os^", strict=False):
            of = checks.where(objective=objective, way_points=K)
            name = {"area": "A", "log_area": "log A"}[objective]
            for column, dashes, which in (("cosine", "-", ""), ("cosine_without", ":", ", no score")):
                label = f"{name}{which}" if marker == "o" else None
                looks = {"color": colour, "marker": marker, "ms": 4, "lw": 1.3}
                axes.plot(of.numbers("horizon"), of.numbers(column), dashes, label=label, **looks)
    axes.axhline(0.95, color="0.6", lw=0.6)
    axes.set(xlabel="samples", ylabel="cosine", ylim=(-1.9, 1.05), yticks=(-1, -0.5, 0, 0.5, 1))
    name_panel(axes, 2, "gradient against differences")
    axes.grid(True)
    axes.legend(fontsize=6, title="circles: still, squares: path", title_fontsize=6, loc="lower right", ncols=2)


def _switches(axes: Axes, folder: Path) -> None:
    table = read_columns(folder / "switches.csv")
    y, log_area, by_derivatives = (table.numbers(key) for key in ("y", "log_area", "by_derivatives"))
    history = table.numbers("switches").astype(int)
    for i in range(history[-1] + 1):
        axes.plot(y[history == i], log_area[history == i], "-", color=REGION, lw=1.6, label=None if i else "log A")
    axes.plot(y, by_derivatives, ":", color=UKF, lw=1.4, label="its derivatives, added up")
    axes.set(xlabel="y of a still probe [m]", ylabel="log of the area left")
    name_panel(axes, 3, f"one goal: {history[-1]} switches")
    axes.grid(True)
    bottom, top = axes.get_ylim()
    axes.set_ylim(bottom - 0.25 * (top - bottom), top)
    axes.legend(fontsize=6, loc="lower center", ncols=2)


def draw_before_after(replay: dict[str, Any], config: ProbePlacementConfig) -> Figure:
    """The figure of one goal without a probe and with several."""
    runs: list[dict[str, Any]] = replay["runs"]
    figure = Figure(figsize=(11.5, 4.6), layout="constrained")
    grid = figure.subplots(2, 1 + (len(runs) - 1 + 1) // 2, squeeze=False)
    columns = grid.shape[1]
    panels, curves = [*enumerate(grid.flat)], grid[1, 0]
    del panels[columns]  # for the curves
    # A row of maps for each method. Its columns are the numbers of way-points.
    order = [runs[0], *sorted(runs[1:], key=lambda run: (run["method"] != "random", run["way_points"]))]
    for (i, axes), run in zip(panels, order, strict=False):
        draw_map(axes, replay, run, config, len(run["samples"]) - 1)
        name_panel(axes, i, f"{name_of(run)}: {run['samples'][-1]['area']:.3g} m²")
    for run in order:
        t = [sample["t"] for sample in run["samples"]]
        colour = METHODS[run["method"]][1]
        dashes = "-" if run["way_points"] != 1 else "--"
        areas = [sample["area"] for sample in run["samples"]]
        curves.semilogy(t, areas, color=colour, ls=dashes, lw=1.5, label=name_of(run))
    curves.set(xlabel="t [s]", ylabel="area of Θ(t) [m²]")
    name_panel(curves, columns, "over time")
    curves.grid(True)
    curves.set_ylim(bottom=curves.get_ylim()[0] / 8)
    curves.legend(fontsize=7, loc="lower left")
    headline(figure, f"{config.title}: what is left of Θ after {config.duration:g} s, for one goal")
    return figure


def name_of(run: dict[str, Any]) -> str:
    """The name of a run in figures."""
    if run["way_points"] == 0:
        return "no probe"
    what = {"random": "best random", "adam": "Adam's"}[run["method"]]
    return f"{what} {'point' if run['way_points'] == 1 else 'path'}"


def draw_map(axes: Axes, replay: dict[str, Any], run: dict[str, Any], config: ProbePlacementConfig, k: int) -> None:
    """The corridor at sample k: Theta, the robot and its path, the probe and its path."""
    sample, radius = run["samples"][k], config.safety_distance / 2
    lower, upper = np.array(config.prior.lower), np.array(config.prior.upper)
    add_box(axes, (lower, upper), ec=REGION, ls=":", lw=0.8)
    add_region(axes, np.array(sample["vertices"]), REGION, filled=True)
    active = sample["active"]
    bodies = [*replay["obstacles"], *([sample["probe"]] if sample["probe"] else [])]
    for i, (x, y) in enumerate(bodies):
        is_probe = i == len(replay["obstacles"])
        face = PROBE if is_probe else INACTIVE
        axes.add_patch(
            Circle((x, y), radius, fc=face, ec="black" if i in active else "0.55", lw=1.6 if i in active else 0.6)
        )
    if run["way_point_places"]:
        way = np.array(run["way_point_places"])
        axes.plot(*way.T, "-", color=PROBE, lw=0.8, marker=".", ms=4, zorder=6)
        for tail, head in pairwise(way):
            axes.annotate("", (tail + head) / 2, tail, arrowprops={"arrowstyle": "->", "color": PROBE}, zorder=6)
    axes.plot(*np.array([s["x"] for s in run["samples"][: k + 1]]).T, color=ROBOT, lw=1.2, zorder=6)
    add_robot(axes, sample["x"], radius, ROBOT)
    add_goal(axes, replay["goal"])
    (left, bottom), (right, top) = config.room.lower, config.room.upper
    axes.set(xlim=(left - 0.1, max(right, upper[0]) + 0.1), ylim=(bottom, top), aspect="equal")
    axes.set(xlabel="x [m]", ylabel="y [m]")
