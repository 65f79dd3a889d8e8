"""What is learned of gain and safety distance: an example, the cost in Theta, enclosures by bound and by time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.figures.style import HYBRID, INVERSE_OPTIMAL, ROBOT, STYLE
from experiments.results import Columns, read_columns, read_json
from experiments.studies.safety_summary import by_bound, by_time, half_widths

COLOURS = {"gain": INVERSE_OPTIMAL, "safety distance": ROBOT}
DASHES = {"1": "-", "3": (0, (3, 1.5))}
STAGES = {0: ("after 1 s", "0.8"), 1: ("after 2 s", "0.4"), -1: ("second look", INVERSE_OPTIMAL)}
"""Those that are drawn of a team's sets, their labels and colours."""

SECONDS = {"1 s": 1.0, "2 s": 2.0, "4 s": 4.0, "streamed": 8.0}
"""Places of the stages on the time axis; the last one is the end."""

FLOOR = 1e-6
"""Smaller excesses of diameters are round-off."""


def draw_study(folder: Path) -> Figure:
    """The figure of the study, from its files."""
    sets, robots = read_columns(folder / "sets.csv"), read_columns(folder / "robots.csv")
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 5.8), layout="constrained")
        (example, cost), (bounds, times) = figure.subplots(2, 2)
        _draw_example(example, _telling(read_json(folder / "shapes.json")))
        _draw_cost(cost, robots.where(gain_prior=100.0).rows(robots.where(gain_prior=100.0)["part"] != "odd"))
        _draw_widths(bounds, by_bound(sets), float)
        bounds.set(xscale="log", xlabel="declared bound of velocities [m/s]", title="c)  Enclosures by bound")
        _draw_widths(times, (group for group in by_time(sets) if group[0]["stage"] in SECONDS), SECONDS.__getitem__)
        times.set(xscale="log", xlabel="t [s]", title="d)  Enclosures by time, bound 5 mm/s")
        times.set_xticks(list(SECONDS.values()), ["1", "2", "4", "end"])
        times.minorticks_off()
        figure.legend(*bounds.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def _telling(shapes: list[dict[str, Any]]) -> dict[str, Any]:
    """The team with p = 1 whose Psi shrinks most nearly to a third between the stages drawn: all can be seen."""

    def unlike(shape: dict[str, Any]) -> float:
        extents = [np.ptp(np.array(shape["sets"][place]), axis=0).prod() for place in STAGES]
        return float(np.abs(np.diff(np.log(extents)) + np.log(3.0)).sum())

    return min([shape for shape in shapes if shape["power"] == 1] or shapes, key=unlike)


def _draw_example(axes: Axes, shape: dict[str, Any]) -> None:
    for place, (stage, shade) in STAGES.items():
        corners = shape["sets"][place]
        gain, distance = np.array([*corners, corners[0]]).T
        axes.fill(gain, distance, color=shade, alpha=0.25, lw=0)
        axes.plot(gain, distance, color=shade, lw=1.4, label=stage)
    axes.plot(*shape["truth"], "+", color=ROBOT, ms=9, mew=1.5, label="truth")
    axes.set(xlabel="gain", ylabel="safety distance [m]", title=f"a)  Ψ of a team of {shape['robots']}")
    axes.margins(0.12)
    axes.legend(loc="lower right", fontsize=7)


def _draw_cost(axes: Axes, robots: Columns) -> None:
    known = robots.numbers("known")
    for name, label, colour in (("streamed", "one pass", HYBRID), ("looked", "second look", INVERSE_OPTIMAL)):
        excess = np.sort(robots.numbers(name) / known - 1)
        left = 1 - np.arange(len(excess)) / len(excess)
        axes.step(excess[excess > FLOOR], left[excess > FLOOR], color=colour, label=label, lw=1.6)
    axes.axvline(0.1, color="0.6", lw=0.8, ls=(0, (1, 1)))
    axes.set(xscale="log", yscale="log", xlim=(FLOOR, None), ylim=(0.5 / len(known), 1))
    axes.set(xlabel="diameter of Θ, unknown / known Ψ, minus 1", ylabel="share of robots above")
    axes.set_title(f"b)  Cost in Θ, {len(known)} robots")
    axes.grid(True)
    axes.legend()


def _draw_widths(axes: Axes, groups: Iterable[tuple[dict[str, str], Columns]], place: Callable[[str], float]) -> None:
    lines: dict[tuple[str, str], list[tuple[float, ...]]] = {}
    for about, found in groups:
        power, value = about.values()
        for name, widths in zip(COLOURS, half_widths(found), strict=True):
            lines.setdefault((power, name), []).append((place(value), *np.quantile(widths, (0.25, 0.5, 0.75))))
    for (power, name), points in lines.items():
        x, low, middle, high = np.array(sorted(points)).T
        axes.fill_between(x, low, high, color=COLOURS[name], alpha=0.12, lw=0)
        axes.plot(x, middle, color=COLOURS[name], ls=DASHES[power], lw=1.6, label=f"{name}, p = {power}")
    axes.set(yscale="log", ylabel="half width / truth")
    axes.grid(True)
