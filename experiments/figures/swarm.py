"""A swarm: the robots at some times, coloured by the size of their sets, and the sizes over time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from experiments.figures.drawing import NO_RADIUS, frame, headline, name_panel
from experiments.figures.style import INVERSE_OPTIMAL
from experiments.results import Columns, read_columns, read_json, reading
from experiments.runs.swarm_config import SwarmConfig

COLOURS = "viridis_r"

SMALLEST = 1e-6
"""Where the colours end [m]."""


def draw_swarm(folder: Path, config: SwarmConfig) -> Iterator[tuple[str, Figure]]:
    """The figure, with its name."""
    sizes = read_columns(folder / "sizes.csv").of_length(config.steps + 1)
    snapshots = {round(t / config.dt) for t in config.snapshots}
    robots = read_columns(folder / "snapshots.csv").of_length(config.robots * len(snapshots))
    with reading(folder / "summary.json"):
        lost = int(read_json(folder / "summary.json")["truth_outside"])
    times = np.unique(robots.numbers("t"))
    figure = Figure(figsize=(3.1 * len(times) + 3.6, 3.9), layout="constrained")
    panels = figure.subplots(1, len(times) + 1, width_ratios=[3.1] * len(times) + [2.9])
    smallest = max(float(robots.numbers("sqrt_area").min()), SMALLEST)
    norm = LogNorm(smallest, float(robots.numbers("sqrt_area").max()))
    discs = None
    for i, (axes, t) in enumerate(zip(panels, times, strict=False)):
        at = robots.numbers("t") == t
        places, goals = (
            np.stack([robots.numbers(f"{p}x")[at], robots.numbers(f"{p}y")[at]], axis=-1) for p in ("", "goal_")
        )
        axes.add_collection(LineCollection(list(np.stack([places, goals], axis=1)), colors="0.85", lw=0.4, zorder=0))
        width = np.full(at.sum(), config.safety_distance or NO_RADIUS)
        discs = EllipseCollection(
            width, width, np.zeros(at.sum()), units="xy", offsets=places, offset_transform=axes.transData, cmap=COLOURS
        )
        discs.set(array=robots.numbers("sqrt_area")[at].clip(min=smallest), norm=norm, edgecolor="0.3", linewidth=0.2)
        axes.add_collection(discs)
        corner = np.full(2, 0.52 * config.side)
        frame(axes, (-corner, corner))
        axes.set_xlabel("x [m]")
        name_panel(axes, i, f" t = {t:.4g} s")
    panels[0].set_ylabel("y [m]")
    if discs is not None:
        figure.colorbar(discs, ax=panels[:-1], label="√area of the goal's set [m]", shrink=0.8, pad=0.01)
    _draw_sizes(panels[-1], sizes)
    headline(figure, f"{config.title}, {config.steps} steps: truth lost for {lost} of {config.robots}")
    yield "figure", figure


def _draw_sizes(axes: Axes, sizes: Columns) -> None:
    t = sizes.numbers("t")
    axes.fill_between(
        t, sizes.numbers("sqrt_area_0.1"), sizes.numbers("sqrt_area_0.9"), color=INVERSE_OPTIMAL, alpha=0.2, lw=0
    )
    axes.semilogy(t, sizes.numbers("sqrt_area_0.5"), color=INVERSE_OPTIMAL, lw=1.8, label="median, 10 % to 90 %")
    axes.semilogy(t, sizes.numbers("sqrt_area_1"), color=INVERSE_OPTIMAL, lw=1.0, ls=(0, (1, 1)), label="largest")
    axes.set(xlabel="t [s]", ylabel="√area [m]", xlim=(t[0], t[-1]))
    axes.set_title("sizes of the sets", fontweight="bold")
    axes.grid(True)
    axes.legend(loc="lower left")
