"""The figure of an observed log, from its saved results: the final regions over the trajectories, and how they came."""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

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


def draw_observation(out: Path, x: np.ndarray, seen: np.ndarray, bodies: Sequence[str]) -> list[Path]:
    """Draw regions.png and regions.pdf into the results folder `out`, from its files and the log's positions.

    Args:
        x: (T, N, 2) positions of the bodies [m]. seen: (T, N) where they were measured.
    """
    final = json.loads((out / "regions.json").read_text(encoding="utf-8"))["robots"]
    history = _history(out / "estimates.csv")
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10.5, 5.2), layout="constrained")
        grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1), height_ratios=(2.2, 1))
        _draw_map(figure.add_subplot(grid[:, 0]), final, x, seen, bodies)
        size = figure.add_subplot(grid[0, 1])
        _draw_sizes(size, history)
        _draw_cases(figure.add_subplot(grid[1, 1], sharex=size), history)
        paths = [out / "regions.png", out / "regions.pdf"]
        for path in paths:
            figure.savefig(path)
    return paths


def _history(path: Path) -> dict[str, dict[str, np.ndarray]]:
    columns: dict[str, dict[str, list]] = defaultdict(lambda: defaultdict(list))
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            of_robot = columns[row["robot"]]
            of_robot["t"].append(float(row["t"]))
            of_robot["diameter"].append(float(row["diameter"]))
            of_robot["case"].append(CASES.index(row["case"]) if row["case"] else np.nan)
    return {robot: {name: np.array(values) for name, values in of.items()} for robot, of in columns.items()}


def _draw_map(axes: Axes, final: dict, x: np.ndarray, seen: np.ndarray, bodies: Sequence[str]) -> None:
    for body in bodies:
        k = bodies.index(body)
        path = x[seen[:, k], k]
        if len(path) == 0:  # its only sample was the last one, which has no difference to a next one
            continue
        if body not in final:
            axes.plot(*path.T, color="0.75", lw=1)
            axes.plot(*path[-1], "o", color="0.6", ms=6)
            continue
        colour = _colour(list(final).index(body))
        axes.plot(*path.T, color=colour, lw=1.2, alpha=0.8)
        axes.plot(*path[0], "o", color=colour, ms=4, mfc="white")
        axes.plot(*path[-1], "o", color=colour, ms=6)
    for i, (robot, region) in enumerate(final.items()):
        if len(region["centroid"]) != 2:
            continue
        vertices = np.array(region["vertices"])
        axes.fill(*vertices.T, facecolor=_colour(i), edgecolor=_colour(i), alpha=0.3, lw=1.2)
        axes.plot(*region["centroid"], "+", color=_colour(i), ms=11, mew=1.6)
        axes.annotate(
            f"{robot}: {region['diameter']:.2g} m",
            region["centroid"],
            textcoords="offset points",
            xytext=(7, 7),
            color=_colour(i),
        )
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="Final regions, centroids, diameters")
    axes.margins(0.18)
    axes.grid(color="0.93", lw=0.6)
    axes.set_axisbelow(True)


def _draw_sizes(axes: Axes, history: dict[str, dict[str, np.ndarray]]) -> None:
    for i, (robot, of) in enumerate(history.items()):
        axes.semilogy(of["t"], of["diameter"], color=_colour(i), lw=1.5, label=robot)
    axes.set(ylabel="diameter [m]", title="Size of the region")
    axes.grid(color="0.93", lw=0.6)
    axes.tick_params(labelbottom=False)
    axes.legend(title="robot", ncols=1 + len(history) // 6, fontsize=8)


def _draw_cases(axes: Axes, history: dict[str, dict[str, np.ndarray]]) -> None:
    cases = np.stack([of["case"] for of in history.values()])
    t = next(iter(history.values()))["t"]
    ends = np.append(t, t[-1] + (t[-1] - t[-2] if len(t) > 1 else 1.0))
    colours = ListedColormap(CASE_GREYS)
    axes.pcolormesh(ends, np.arange(len(history) + 1), cases, cmap=colours, vmin=-0.5, vmax=4.5, rasterized=True)
    axes.set_yticks(np.arange(len(history)) + 0.5, list(history))
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


def _colour(i: int) -> str:
    return ROBOT_COLOURS[i % len(ROBOT_COLOURS)]
