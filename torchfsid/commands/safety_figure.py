"""The figure of unknown safety parameters, from saved results.

left      the intervals of gain and distance over time, as the observer learned them
middle    all pairs of gain and distance that are left, after the log was read again
right     the band of speeds at which a robot may approach a standing body
"""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchfsid.commands.figure_style import MOST_NAMED, colour, plain_name, render, thinned
from torchfsid.errors import FigureError, one_line

TEAM = "0.25"
"""Colour of what a whole team has in common."""

WIDE = 20.0
"""Ratio of the ends of a range beyond which its axis is logarithmic."""

NARROW = 1e-9
"""Fraction of the values below which the pairs' width is round-off, and is not spread over the axes."""


def draw_safety(out: Path) -> list[Path]:
    """Draw safety.png and safety.pdf from the files of the results folder.

    Raises:
        FigureError: a file is missing or damaged, or matplotlib fails.
        OSError: a figure cannot be written.
    """
    final, history = _final(out / "regions.json"), _history(out / "estimates.csv")
    if "the team" in final:
        history = {"the team": next(iter(history.values()))}

    def draw(figure: Figure) -> None:
        grid = figure.add_gridspec(2, 3, width_ratios=(1.15, 1, 1))
        gain = figure.add_subplot(grid[0, 0])
        distance = figure.add_subplot(grid[1, 0], sharex=gain)
        named = "margin" if "margin" in next(iter(final.values())) else "safety distance"
        _draw_intervals(gain, history, "gain", "gain")
        _draw_intervals(distance, history, "distance", f"{named} [m]")
        gain.set_title("What was learned over time")
        gain.tick_params(labelbottom=False)
        distance.set_xlabel("t [s]")
        _draw_pairs(figure.add_subplot(grid[:, 1]), final, f"{named} [m]")
        _draw_band(figure.add_subplot(grid[:, 2]), final)

    return render(out / "safety", (11.5, 4.4), draw)


def _final(path: Path) -> dict[str, dict[str, Any]]:
    """The safety parameters of the team, or of every robot."""
    try:
        whole = json.loads(path.read_text(encoding="utf-8"))
        if "safety" in whole:
            return {"the team": whole["safety"]}
        return {robot: region["safety"] for robot, region in whole["robots"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise FigureError(f"{path}: missing or damaged: {one_line(error)}") from error


def _history(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """For each robot: times [s], and the ends of both intervals."""
    columns: dict[str, list[list[float]]] = defaultdict(list)
    names = ("t", "gain_low", "gain_high", "distance_low", "distance_high")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                columns[row["robot"]].append([float(row[name]) for name in names])
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise FigureError(f"{path}: missing or damaged: {one_line(error)}") from error
    return {robot: dict(zip(names, np.array(rows).T, strict=True)) for robot, rows in columns.items()}


def _colour(name: str, i: int) -> str:
    return TEAM if name == "the team" else colour(i)


def _draw_intervals(axes: Axes, history: dict[str, dict[str, np.ndarray]], of: str, label: str) -> None:
    for i, (name, columns) in enumerate(history.items()):
        t, low, high = (thinned(columns[key]) for key in ("t", f"{of}_low", f"{of}_high"))
        axes.fill_between(t, low, high, color=_colour(name, i), alpha=0.25, lw=0, step="post")
        for end in (low, high):
            axes.step(t, end, color=_colour(name, i), lw=1, where="post")
    ends = np.concatenate([columns[f"{of}_{side}"] for columns in history.values() for side in ("low", "high")])
    if ends.min() > 0 and ends.max() > WIDE * ends.min():
        axes.set_yscale("log")
    axes.set_ylabel(label)
    axes.grid(color="0.93", lw=0.6)


def _draw_pairs(axes: Axes, final: dict[str, dict[str, Any]], label: str) -> None:
    """The polygons Psi with gain and distance as coordinates. Their edges are curves."""
    for i, (name, safety) in enumerate(final.items()):
        corners = np.array(safety["vertices"])
        along = np.linspace(0.0, 1.0, 30)[:, None, None]
        edges = (1 - along) * corners + along * np.roll(corners, -1, axis=0)
        beta, D = np.moveaxis(edges, 2, 0)[..., :].reshape(2, len(along), -1).transpose(0, 2, 1).reshape(2, -1)
        length = np.sqrt(np.maximum(D / beta, 0.0)) if safety["distance"] == "squared" else D / beta
        if "margin" in safety and safety["distance"] == "squared":
            length = length - (safety["safety_distance"][0] - safety["margin"][0])
        gain = beta ** safety["power"]
        axes.fill(gain, length, facecolor=_colour(name, i), alpha=0.3, lw=0, label=plain_name(name))
        axes.plot(gain, length, color=_colour(name, i), lw=1.2)
        axes.plot(gain[:1], length[:1], ".", color=_colour(name, i), ms=4)  # for a set that is a point
    gains = np.array([safety["gain"] for safety in final.values()])
    if gains.max() > WIDE * gains.min():
        axes.set_xscale("log")
    for (low, high), widen in ((axes.dataLim.intervalx, axes.set_xlim), (axes.dataLim.intervaly, axes.set_ylim)):
        size = max(abs(low), abs(high))
        if high - low < NARROW * size:  # a known value: its round-off is not drawn as a polygon
            widen(low - 0.1 * size, high + 0.1 * size)
    axes.set(xlabel="gain", ylabel=label, title="Pairs that are left")
    axes.margins(0.15)
    axes.grid(color="0.93", lw=0.6)
    axes.set_axisbelow(True)
    ends = [
        f"{what} {end}"
        for what, key in (("gain", "gain"), (label.split(" [")[0], "safety_distance"))
        for end, column in (("low", 0), ("high", 1))
        if not all(safety["bounded_by_data"][key][column] for safety in final.values())
    ]
    if ends:
        axes.text(0.5, 0.98, f"not bounded by the data:\n{', '.join(ends)}", transform=axes.transAxes, ha="center",
                  va="top", fontsize=8, color="0.35")  # fmt: skip
    if 1 < len(final) <= MOST_NAMED:
        axes.legend(title="robot", fontsize=8, loc="best")


def _draw_band(axes: Axes, final: dict[str, dict[str, Any]]) -> None:
    for i, (name, safety) in enumerate(final.items()):
        if not safety["approach_speed"]:
            continue
        r, low, high = np.array(safety["approach_speed"]).T
        axes.fill_between(r, low, high, color=_colour(name, i), alpha=0.25, lw=0)
        for end in (low, high):
            axes.plot(r, end, color=_colour(name, i), lw=1)
    fastest = max(safety["largest_speed"] for safety in final.values())
    if axes.get_ylim()[1] > 2 * fastest > 0:  # no robot moves faster: there a row is never active
        bottom = min(min(low for _, low, _ in safety["approach_speed"]) for safety in final.values())
        axes.set_ylim(max(bottom - 0.1 * fastest, -2 * fastest), 2 * fastest)
        relevant = [r for safety in final.values() for r, least, _ in safety["approach_speed"] if least < 2 * fastest]
        axes.set_xlim(min(relevant, default=None), max(relevant, default=None))
    axes.axhline(0.0, color="0.6", lw=0.8)
    axes.set(xlabel="distance r [m]", ylabel="speed [m/s]", title="Allowed speed of approach")
    axes.grid(color="0.93", lw=0.6)
