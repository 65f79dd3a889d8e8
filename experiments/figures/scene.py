"""The figures of a scene: as in the paper, in space in three projections, and in the plane with a film of the run.

Those of a team are snapshots with every robot's region, and sizes of regions beside errors.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from experiments.figures import drawing
from experiments.figures.animation import animate
from experiments.figures.film import Film
from experiments.figures.single import draw_single
from experiments.figures.style import SET_NAMES, team_colours
from experiments.runs.config import SceneConfig
from experiments.runs.saved import ROOT_NAMES, Results
from torchfsid.commands.space_figure import PLANES, shadow

PANELS = (
    ("critical_region", "paper's region"),
    ("inverse_optimal", "inverse-optimal set"),
    ("ukf", "UKF error"),
    ("hybrid", "hybrid error"),
)

VIEWS = ("from above", "from the side (along y)", "from the front (along x)")


def draw_scene(folder: Path, config: SceneConfig) -> Iterator[tuple[str, Figure | Film]]:
    """The figures and the film, with their names."""
    results = Results(folder, config)
    if config.dimension == 3:
        yield "figure", draw_snapshots(results, config)
        yield "comparison", draw_comparison(results, config)
        return
    if len(config.robots) == 1:
        yield "figure", draw_single(results, config)
    else:
        yield "figure", draw_team(results, config)
        yield "comparison", draw_comparison(results, config)
    yield "animation", animate(results, config)


def draw_team(results: Results, config: SceneConfig) -> Figure:
    """The snapshots of a team in the plane."""
    columns = 2 if len(config.snapshots) > 1 else 1
    rows = math.ceil(len(config.snapshots) / columns)
    figure = Figure(figsize=(3.7 * columns, 3.75 * rows + 0.4), layout="constrained")
    grid = figure.add_gridspec(rows, columns)
    box = drawing.map_frame(results, config, aspect=1.0)
    for i, t in enumerate(config.snapshots):
        k, axes = results.at(t), figure.add_subplot(grid[divmod(i, columns)])
        _draw_snapshot(axes, results, config, k)
        drawing.frame(axes, box)
        drawing.name_panel(axes, i, f" t = {results.t[k]:.2f} s")
        if i // columns == rows - 1:
            axes.set_xlabel("x [m]")
        if i % columns == 0:
            axes.set_ylabel("y [m]")
    drawing.headline(figure, f"{config.title}: {SET_NAMES[config.set]} of each goal")
    handles = [
        drawing.marker("o", "0.45", mfc="0.8", ms=9),
        drawing.marker("*", "0.45", ms=10),
        drawing.marker("x", "0.45", ms=6, mew=1.6),
        Patch(facecolor="0.88", edgecolor="0.45"),
    ]
    figure.legend(handles, ["robot", "its goal", "its UKF estimate", "its region"], loc="outside lower center", ncols=4)
    return figure


def _draw_snapshot(axes: Axes, results: Results, config: SceneConfig, k: int) -> None:
    """The map at sample k, with every robot's region."""
    drawing.add_obstacles(axes, config, [name for region in results.regions[k] for name in region.active])
    for i, (robot, colour) in enumerate(zip(config.robots, team_colours(config), strict=True)):
        path = results.paths[robot.name]
        drawing.add_region(axes, results.regions[k][i].vertices[config.set], colour, filled=True, zorder=5.5)
        axes.plot(*path[: k + 1].T, color=colour, lw=1.0, zorder=4.5)
        drawing.add_robot(axes, path[k], drawing.disc_radius(config), colour, solid=False)
        drawing.add_goal(axes, robot.goal, colour, size=11)
        ukf = results.numbers("ukf_0", "ukf_1")[k, i]
        axes.plot(*ukf, "x", color=colour, ms=6, mew=1.6, zorder=8)


def draw_comparison(results: Results, config: SceneConfig) -> Figure:
    """Lengths over time, one colour per robot: each kind of set, the filter, the hybrid."""
    measures, colours, root = results.lengths, team_colours(config), ROOT_NAMES[config.dimension]
    panels = [panel for panel in PANELS if panel[0] in (*config.sets, *measures)]
    figure = Figure(figsize=(2.75 * len(panels), 3.5), layout="constrained")
    all_axes = figure.subplots(1, len(panels), sharex=True, sharey=True)
    for axes, (name, title) in zip(all_axes, panels, strict=True):
        main = drawing.positive(measures[name] if name in measures else measures[f"{name} {root}"])
        for i, colour in enumerate(colours):
            axes.semilogy(results.t, main[:, i], color=colour, lw=1.5)
            if name not in measures:
                diameter = drawing.positive(measures[f"{name} diameter"][:, i])
                axes.semilogy(results.t, diameter, color=colour, lw=1.0, ls=(0, (4, 1.5)))
        for k in map(results.at, config.snapshots):
            axes.axvline(results.t[k], color="0.6", lw=0.7, ls=(0, (1, 1.5)), zorder=0)
        axes.grid(True)
        axes.set(title=title, xlabel="t [s]", xlim=(results.t[0], results.t[-1]))
    all_axes[0].set_ylabel("length [m]")
    drawing.headline(figure, f"{config.title}, dotted: the snapshots")
    robots = [Line2D([], [], color=colour, lw=1.8) for colour in colours]
    looks = [Line2D([], [], color="0.4", lw=1.5), Line2D([], [], color="0.4", lw=1.0, ls=(0, (4, 1.5)))]
    labels = [
        *(robot.name for robot in config.robots),
        f"{'√area' if config.dimension == 2 else '∛volume'}, error",
        "diameter",
    ]
    figure.legend([*robots, *looks], labels, loc="outside lower center", ncols=min(len(labels), 10))
    return figure


def draw_snapshots(results: Results, config: SceneConfig) -> Figure:
    """One row of three projections for each snapshot. The shadow of a set is the hull of its projected vertices."""
    count = len(config.snapshots)
    figure = Figure(figsize=(10.0, 3.3 * count + 0.7), layout="constrained")
    all_axes = figure.subplots(count, 3, squeeze=False)
    reach = np.concatenate([*results.paths.values(), results.goals])
    for of_snapshot, t in zip(all_axes, config.snapshots, strict=True):
        k = results.at(t)
        for axes, plane, view in zip(of_snapshot, PLANES, VIEWS, strict=True):
            _draw_projection(axes, results, config, k, plane)
            low, high = reach.min(0)[list(plane)] - 0.3, reach.max(0)[list(plane)] + 0.3
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
            axes.set(xlabel=f"{'xyz'[plane[0]]} [m]", ylabel=f"{'xyz'[plane[1]]} [m]")
            axes.set_title(f"t = {results.t[k]:.2f} s, {view}" if plane == PLANES[0] else view)
    drawing.headline(figure, f"{config.title}: {SET_NAMES[config.set]} of each goal, and its shadows")
    handles = [
        drawing.marker("o", "0.45", ms=7),
        drawing.marker("*", "0.45", ms=10),
        drawing.marker("o", "0.8", ms=9),
        Patch(facecolor="0.88", edgecolor="0.45"),
    ]
    labels = ["robot", "its goal", "body that stands still", "shadow of its set"]
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def _draw_projection(axes: Axes, results: Results, config: SceneConfig, k: int, plane: tuple[int, int]) -> None:
    """What is seen at sample k along the third axis."""
    seen = list(plane)
    for obstacle in config.obstacles:
        axes.plot(*np.array(obstacle.position)[seen], "o", color="0.8", ms=9, zorder=2)
    for i, (robot, colour) in enumerate(zip(config.robots, team_colours(config), strict=True)):
        vertices = results.regions[k][i].vertices[config.set]
        if len(vertices):
            outline = shadow(vertices[:, seen])
            axes.fill(*outline.T, facecolor=colour, alpha=0.12, zorder=1)
            axes.plot(*np.vstack([outline, outline[:1]]).T, color=colour, lw=1.1, zorder=4)
        path = results.paths[robot.name][:, seen]
        axes.plot(*path[: k + 1].T, color=colour, lw=1.0, zorder=3)
        axes.plot(*path[k], "o", color=colour, ms=7, zorder=5)
        axes.plot(*np.array(robot.goal)[seen], "*", color=colour, mec="white", mew=0.5, ms=11, zorder=6)
    axes.grid(True)
