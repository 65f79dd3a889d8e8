"""A sweep, with one column per entry of the first axis of its grid.

The rows show whether each set holds the truth, sizes and errors over time, and the paper's cases of the robots.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from experiments.figures.style import HYBRID, INVERSE_OPTIMAL, REGION, UKF
from experiments.results import Columns
from experiments.sweeps.config import SweepConfig
from experiments.sweeps.swept import Swept, quantiles, short

BAND = (0.1, 0.9)
LEGEND_WIDTH = 2.0
"""Of an entry, on average [inches]."""

Measure = tuple[str, str, str]
"""A column of the series, its label, its colour."""

SIZES: tuple[Measure, ...] = (
    ("inverse_optimal_sqrt_area", "inverse-optimal set", INVERSE_OPTIMAL),
    ("critical_region_sqrt_area", "paper's region", REGION),
)
ERRORS: tuple[Measure, ...] = (("ukf_error", "UKF", UKF), ("hybrid_error", "hybrid", HYBRID))
CASE_COLOURS = {"A": "#DDDDDD", "B": "#BBCCEE", "C": "#222255", "D": "#4477AA", "E": "#225522"}


def draw_sweep(folder: Path, config: SweepConfig) -> Iterator[tuple[str, Figure]]:
    """One figure. If the grid has a second axis, one figure per entry of it."""
    swept = Swept(folder, config)
    if len(config.axes) < 2:
        yield "figure", _draw(swept, None)
    else:
        for i, label in enumerate(swept.labels(1)):
            yield f"figure_{'_'.join(label)}", _draw(swept, i)


def _draw(swept: Swept, second: int | None) -> Figure:
    """One figure. `second` is the entry of the grid's second axis, or None if there is no such axis."""
    labels = swept.labels(0) if swept.config.axes else [[]]
    figure = Figure(figsize=(2.2 * len(labels) + 1.1, 7.4), layout="constrained")
    grid = figure.subplots(4, len(labels), sharey="row", squeeze=False, height_ratios=(2, 3.2, 3.2, 0.7))
    for column, label in enumerate(labels):
        levels = tuple(level for level in (column, second) if level is not None)[: len(swept.config.axes)]
        runs, series = swept.chosen(swept.runs, levels), swept.chosen(swept.series, levels)
        if len(series["run"]):
            sizes = [size for size in SIZES if size[0].removesuffix("_sqrt_area") in swept.kinds(runs)]
            _draw_containment(grid[0, column], series, sizes)
            _draw_lengths(grid[1, column], series, sizes)
            _draw_lengths(grid[2, column], series, ERRORS)
            _draw_cases(grid[3, column], runs)
            grid[2, column].set_xlabel("t [s]")
        else:
            _draw_nothing(grid[:, column])
        named = [f"{short(key)} {value}" for key, value in zip(swept.telling(0), label, strict=True)] if label else []
        robots = f"{len(runs['run'])} runs, {runs['robots'].sum():.0f} robots"
        grid[0, column].set_title("\n".join([*named, robots]), fontsize=8.5)
    grid[0, 0].set_ylabel("truth in the set\n[share of robots]")
    grid[1, 0].set_ylabel("√area [m]")
    grid[2, 0].set_ylabel("error [m]")
    grid[3, 0].set_ylabel("time\nin case", rotation=0, ha="right", va="center")
    told = (
        "" if second is None else f"; {', '.join(map(short, swept.telling(1)))}: {', '.join(swept.labels(1)[second])}"
    )
    figure.suptitle(swept.config.title + told, fontsize=9.5, x=0.01, ha="left", fontweight="bold")
    _add_legend(figure, [size for size in SIZES if size[0] in swept.series])
    return figure


def _draw_containment(axes: Axes, series: Columns, sizes: Sequence[Measure]) -> None:
    t = np.unique(series["t"])
    for name, _, colour in sizes:
        kind = name.removesuffix("_sqrt_area")
        lost, silent = series[f"{kind}_lost"] == 1, series[f"{kind}_status"] == "ok"
        held = [1 - lost[series["t"] == at].mean() for at in t]
        unaware = [(lost & silent)[series["t"] == at].mean() for at in t]
        width = 3.6 if kind == "inverse_optimal" else 1.6
        axes.plot(t, held, color=colour, lw=width, clip_on=False, zorder=3)
        axes.plot(t, unaware, color=colour, lw=1.3, ls=(0, (1, 1)), clip_on=False)
    axes.set(ylim=(0, 1), yticks=(0, 0.5, 1), xlim=(t[0], t[-1]))
    axes.tick_params(labelbottom=False)
    axes.grid(True)


def _draw_lengths(axes: Axes, series: Columns, measures: Sequence[Measure]) -> None:
    t = np.unique(series["t"])
    for name, _, colour in measures:
        of_times = [quantiles(series[name][series["t"] == at], (BAND[0], 0.5, BAND[1])) for at in t]
        low, middle, high = np.array(of_times).T
        axes.fill_between(t, low, high, color=colour, alpha=0.2, lw=0)
        axes.semilogy(t, middle, color=colour, lw=1.8)
    axes.set(xlim=(t[0], t[-1]))
    axes.grid(True)


def _draw_nothing(column: np.ndarray) -> None:
    for axes in column:
        axes.tick_params(bottom=False, labelbottom=False)
    column[1].text(0.5, 0.5, "no run yet", ha="center", color="0.4", transform=column[1].transAxes)
    column[-1].set_axis_off()


def _draw_cases(axes: Axes, runs: Columns) -> None:
    left = 0.0
    for letter, colour in CASE_COLOURS.items():
        share = float(np.average(runs[f"case_{letter}"], weights=runs["robots"]))
        axes.barh(0, share, left=left, color=colour, height=0.8)
        if share > 0.04:
            text = f"{letter} {share:.0%}" if share > 0.15 else letter
            shade = "white" if letter in "CDE" else "0.2"
            axes.text(left + share / 2, 0, text, ha="center", va="center", fontsize=7, color=shade)
        left += share
    axes.set(xlim=(0, 1), ylim=(-0.5, 0.5), yticks=(), xticks=())
    axes.spines[:].set_visible(False)


def _add_legend(figure: Figure, sizes: Sequence[Measure]) -> None:
    lines = [(Line2D([], [], color=colour, lw=1.8), label) for _, label, colour in (*sizes, *ERRORS)]
    lines += [
        (Line2D([], [], color="0.35", lw=1.3, ls=(0, (1, 1))), "truth lost, status still ok"),
        (Patch(color="0.35", alpha=0.25, lw=0), "median and 10 % to 90 % of the robots"),
    ]
    handles, labels = zip(*lines, strict=True)
    fitting = min(len(lines), max(1, int(figure.get_figwidth() / LEGEND_WIDTH)))
    figure.legend(handles, labels, loc="outside lower center", ncols=fitting, columnspacing=1.5)
