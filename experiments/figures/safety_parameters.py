"""What is learned of gain and safety distance: an example, the cost in Theta, enclosures by bound and by time."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.figures.style import INVERSE_OPTIMAL, ROBOT, STYLE, TEAM
from experiments.results import Columns, read_columns, read_json
from experiments.studies.safety_summary import half_widths, shrinking

LOOKS = {"gain": INVERSE_OPTIMAL, "safety distance": ROBOT}
DASHES = {"1": "-", "3": (0, (3, 1.5))}
SHADES = {"1 s": "0.8", "2 s": "0.62", "4 s": "0.42", "looked": INVERSE_OPTIMAL}
NAMES = {"streamed": "one pass", "looked": "second look"}


def draw_study(folder: Path) -> Figure:
    """The figure of the study, from its files."""
    sets, robots = read_columns(folder / "sets.csv"), read_columns(folder / "robots.csv")
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 5.6), layout="constrained")
        (example, cost), (by_bound, by_time) = figure.subplots(2, 2)
        _draw_example(example, read_json(folder / "example.json"))
        _draw_cost(cost, robots.rows(robots["part"] != "odd"))
        _draw_bounds(by_bound, sets)
        _draw_times(by_time, sets)
        for axes, letter in zip(figure.axes, "abcd", strict=True):
            axes.set_title(f"{letter})  {axes.get_title('left')}", loc="left")
    return figure


def _draw_example(axes: Axes, example: dict) -> None:
    for stage, corners in example["sets"].items():
        gain, distance = np.array([*corners, corners[0]]).T
        axes.plot(gain, distance, color=SHADES[stage], lw=1.2)
        axes.fill(gain, distance, color=SHADES[stage], alpha=0.25, lw=0)
        at = int(np.argmax(gain))
        axes.annotate(stage, (gain[at], distance[at]), fontsize=7)
    axes.plot(*example["truth"], "+", color=ROBOT, ms=8)
    axes.set(xscale="log", xlabel="gain", ylabel="safety distance [m]", title="Ψ of one team")


def _draw_cost(axes: Axes, robots: Columns) -> None:
    for (stage, name), colour in zip(NAMES.items(), (TEAM[3], INVERSE_OPTIMAL), strict=True):
        more = np.sort(robots.numbers(stage) / robots.numbers("known") - 1)
        axes.plot(np.clip(more, 1e-6, None), 1 - np.arange(len(more)) / len(more), color=colour, label=name, lw=1.6)
    axes.set(
        xscale="log", yscale="log", xlim=(1e-6, None), xlabel="diameter of Θ, unknown to known parameters, minus 1"
    )
    axes.set(ylabel="share of robots above", title=f"Cost in Θ ({len(robots['run'])} robots)")
    axes.grid(True)
    axes.legend()


def _draw_bounds(axes: Axes, sets: Columns) -> None:
    _draw_widths(axes, shrinking(sets, "velocity", stage="looked", gain_prior=100.0), float)
    axes.set(xscale="log", xlabel="declared bound of velocities [m/s]", title="Enclosures by bound")


def _draw_times(axes: Axes, sets: Columns) -> None:
    seconds = {"1 s": 1.0, "2 s": 2.0, "4 s": 4.0, "streamed": 9.0}
    sets = sets.rows(np.isin(sets["stage"], list(seconds)))
    _draw_widths(axes, shrinking(sets, "stage", velocity=0.005, gain_prior=100.0), seconds.__getitem__)
    axes.set(xscale="log", xlabel="t [s]", title="Enclosures by time, bound 5 mm/s")
    axes.set_xticks([1, 2, 4, 9], ["1", "2", "4", "end"])
    axes.minorticks_off()
    axes.legend()


def _draw_widths(axes: Axes, groups, place) -> None:
    lines: dict[tuple[str, str], list[tuple[float, float, float, float]]] = {}
    for about, found in groups:
        power, value = about.values()
        for name, widths in zip(LOOKS, half_widths(found), strict=True):
            lines.setdefault((power, name), []).append((place(value), *np.quantile(widths, (0.1, 0.5, 0.9))))
    for (power, name), points in lines.items():
        x, low, middle, high = np.array(sorted(points)).T
        axes.fill_between(x, low, high, color=LOOKS[name], alpha=0.1, lw=0)
        axes.plot(x, middle, color=LOOKS[name], ls=DASHES[power], lw=1.6, label=f"{name}, p = {power}")
    axes.set(yscale="log", ylabel="half width / truth")
    axes.grid(True)
