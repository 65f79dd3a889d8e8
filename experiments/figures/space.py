"""The figure of a scene in space: snapshots with every robot's set, in three projections each."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from experiments.figures import drawing
from experiments.figures.style import SET_NAMES, team_colours
from experiments.runs.config import SceneConfig
from experiments.runs.saved import Results
from torchfsid.commands.space_figure import PLANES, shadow

VIEWS = ("from above", "from the side (along y)", "from the front (along x)")


def draw_snapshots(results: Results, config: SceneConfig) -> Figure:
    """One row of three projections for each snapshot. The shadow of a set is the hull of its projected vertices."""
    count = len(config.snapshots)
    figure = Figure(figsize=(10.0, 3.3 * count + 0.7), layout="constrained")
    all_axes = figure.subplots(count, 3, squeeze=False)
    reach = np.concatenate([*results.paths.values(), results.goals])
    for of_snapshot, t in zip(all_axes, config.snapshots, strict=True):
        k = results.at(t)
        for axes, plane, view in zip(of_snapshot, PLANES, VIEWS, strict=True):
            _draw(axes, results, config, k, plane)
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


def _draw(axes: Axes, results: Results, config: SceneConfig, k: int, plane: tuple[int, int]) -> None:
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
