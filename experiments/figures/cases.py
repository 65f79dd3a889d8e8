"""Table I, measured, as a figure: for each case its rows, what was learned, and how fast."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from experiments.figures.drawing import add_box, add_curves, add_goal, add_region, frame, headline, marker
from experiments.figures.style import ACTIVE, INVERSE_OPTIMAL, REGION, ROBOT, SET_COLOURS, UKF
from experiments.results import reading
from experiments.runs.config import CasesConfig
from experiments.runs.saved import Region, Results

SHADOW = 20.0
"""How far the forbidden side of a row is drawn, in units of the panel [m/s]."""


def draw_cases(folder: Path, config: CasesConfig) -> Iterator[tuple[str, Figure]]:
    """One column per case: the rows over the control at half time, the final sets over the goal, lengths over time."""
    results, count = Results(folder, config), len(config.cases)
    figure = Figure(figsize=(1.62 * count + 0.6, 6.3), layout="constrained")
    axes = figure.subplots(3, count, height_ratios=(1, 1, 0.9))
    half_way, measures, measured = len(results.t) // 2, results.lengths, _measured(results)
    reach = 1.15 * max(np.abs([*region.u, *region.nominal]).max() for region in results.regions[half_way])
    for i, case in enumerate(config.cases):
        _draw_rows(axes[0, i], results.regions[half_way][i], reach)
        _draw_sets(axes[1, i], results, i)
        add_curves(axes[2, i], results.t, {name: values[:, i] for name, values in measures.items()})
        axes[2, i].set_xlabel("t [s]")
        axes[0, i].set_title(case.name, fontweight="bold", loc="center")
        _set_verdict(axes[1, i], measured[i])
        axes[2, i].sharey(axes[2, 0])
        for axis in axes[:, i] if i else ():
            axis.tick_params(labelleft=False)
    axes[0, 0].set_ylabel("$u_y$ [m/s]")
    axes[1, 0].set_ylabel("goal y [m]")
    axes[2, 0].set_ylabel("[m]")
    question = "can a point estimator learn, does the paper's region shrink? (In brackets: the paper)"
    headline(figure, f"{config.title}: {question}")
    handles = [
        Line2D([], [], color=ACTIVE, lw=1.8),
        Line2D([], [], color="0.65", lw=0.9),
        marker("o", "black", mfc="white", ms=8),
        marker("o", ROBOT, ms=5.5),
        marker("*", "black", ms=9),
        marker("x", UKF, ms=6, mew=1.6),
        Patch(facecolor="#BFE7DC", edgecolor=REGION),
        Patch(facecolor="none", edgecolor=INVERSE_OPTIMAL),
    ]
    controls = ["active row", "inactive row", "nominal control", "control"]
    labels = [*controls, "goal", "UKF", "paper's region", "inverse-optimal set"]
    lines, names = axes[2, 0].get_legend_handles_labels()
    figure.legend([*handles, *lines], [*labels, *names], loc="outside lower center", ncols=7, columnspacing=1.4)
    yield "figure", figure


def _measured(results: Results) -> list[dict[str, Any]]:
    """The entries of summary.json for each case that are shown."""
    with reading(results.folder / "summary.json"):
        of_cases = results.summary["cases"]
        shown = [f"{what}_{by}" for what in ("point", "region") for by in ("measured", "paper")]
        return [{name: str(of_cases[i][name]) for name in shown} for i in range(len(results.robots))]


def _set_verdict(axes: Axes, measured: dict[str, Any]) -> None:
    answers = [(measured[f"{what}_measured"], measured[f"{what}_paper"]) for what in ("point", "region")]
    (point, point_paper), (region, region_paper) = answers
    agrees = all(ours == theirs for ours, theirs in answers)
    text = f"point: {point} ({point_paper})\nregion: {region} ({region_paper})"
    axes.set_title(
        text, loc="center", fontsize=8, color="black" if agrees else "#B00020", fontweight=None if agrees else "bold"
    )


def _draw_rows(axes: Axes, region: Region, reach: float) -> None:
    """The plane of controls: the rows with their forbidden sides, the nominal control and the control."""
    on = np.abs(region.rows[:, :2] @ region.u - region.rows[:, 2]) < 1e-6
    for (a_x, a_y, b), active in zip(region.rows, on, strict=True):
        normal, along, far = np.array([a_x, a_y]), np.array([-a_y, a_x]), SHADOW * reach
        edge = np.array([b * normal - far * along, b * normal + far * along])
        axes.add_patch(
            Polygon([*edge, *(edge[::-1] + far * normal)], facecolor="0.2" if active else "0.6", alpha=0.13, lw=0)
        )
        axes.plot(*edge.T, color=ACTIVE if active else "0.65", lw=1.8 if active else 0.9, zorder=2)
    axes.plot(*np.array([region.nominal, region.u]).T, color="0.3", lw=0.8, ls=(0, (2, 1.5)), zorder=3)
    axes.plot(*region.nominal, "o", color="black", mfc="white", ms=8.5, zorder=4)
    axes.plot(*region.u, "o", color=ROBOT, mec="white", mew=0.6, ms=6.5, zorder=5)
    axes.plot(0, 0, "+", color="0.4", ms=6, mew=0.8)
    axes.set(xlim=(-0.6 * reach, reach), ylim=(-0.8 * reach, 0.8 * reach), aspect="equal", xlabel="$u_x$ [m/s]")


def _draw_sets(axes: Axes, results: Results, i: int) -> None:
    """The plane of goals: the final sets within the prior."""
    lower, upper = np.array(results.config.prior.lower), np.array(results.config.prior.upper)
    add_box(axes, (lower, upper), ec="0.6", lw=0.8)
    for kind, filled in (("critical_region", True), ("inverse_optimal", False)):
        add_region(axes, results.regions[-1][i].vertices[kind], SET_COLOURS[kind], filled=filled)
    path = results.numbers("ukf_0", "ukf_1")[:, i]
    axes.plot(*path.T, color=UKF, lw=1.0, zorder=6)
    axes.plot(*path[-1], "x", color=UKF, ms=6, mew=1.6, zorder=8)
    add_goal(axes, results.goals[i])
    margin = 0.06 * (upper - lower)[0]
    frame(axes, (lower - margin, upper + margin))
    axes.set_xlabel("goal x [m]")
