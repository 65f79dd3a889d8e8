"""The paper's figure of a scene with one robot: snapshots, below each the region, and all errors over time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from string import ascii_lowercase

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.patches import Patch, Rectangle

from experiments.figures import drawing
from experiments.figures.style import (
    ACTIVE,
    HYBRID,
    INACTIVE,
    ROBOT,
    SET_COLOURS,
    SET_NAMES,
    UKF,
    length,
)
from experiments.runs.config import SceneConfig
from experiments.runs.saved import Results

ASPECT = 1.25
"""Width / height of the maps."""


def draw_single(results: Results, config: SceneConfig) -> Figure:
    """The figure."""
    samples = [results.at(t) for t in config.snapshots]
    count = len(samples)
    figure = Figure(figsize=(2.45 * count + 3.6, 4.9), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.04, h_pad=0.04, wspace=0.03, hspace=0.03)  # type: ignore[union-attr]
    grid = figure.add_gridspec(2, count + 1, width_ratios=[*[2.45] * count, 3.2])
    box = drawing.map_frame(results, config, ASPECT)
    for column, k in enumerate(samples):
        above, below = figure.add_subplot(grid[0, column]), figure.add_subplot(grid[1, column])
        _draw_map(above, results, config, k, box)
        drawing.name_panel(above, column, f" t = {results.t[k]:.2f} s")
        _draw_region(below, results, k, box)
        if column == 0:
            above.set_ylabel("y [m]")
            below.set_ylabel("y − goal [m]")
    right = grid[:, count].subgridspec(2, 1, height_ratios=(7, 1))
    errors = figure.add_subplot(right[0])
    strip = figure.add_subplot(right[1], sharex=errors)
    _draw_errors(errors, results, samples)
    drawing.name_panel(errors, count, " sizes and errors [m]", pad=13)
    _draw_strip(strip, results)
    drawing.headline(figure, f"{config.title}   {_settings(config)}")
    _add_legends(figure, errors, config.sets)
    return figure


def _draw_map(axes: Axes, results: Results, config: SceneConfig, k: int, box: tuple[np.ndarray, np.ndarray]) -> None:
    region, path = results.regions[k][0], results.paths[config.robots[0].name]
    first = config.sets[0]
    drawing.add_region(axes, region.vertices[first], SET_COLOURS[first], filled=True)
    drawing.add_obstacles(axes, config, region.active)
    axes.plot(*path[: k + 1].T, color=ROBOT, lw=1.1, zorder=4.5)
    drawing.add_robot(axes, path[k], drawing.disc_radius(config), ROBOT)
    drawing.add_goal(axes, results.goals[0])
    _add_estimates(axes, results, k, np.zeros(2))
    drawing.frame(axes, box)
    axes.set_xlabel("x [m]")


def _draw_region(axes: Axes, results: Results, k: int, box: tuple[np.ndarray, np.ndarray]) -> None:
    """The region about the goal, to its own scale. A dashed frame is the frame of the map."""
    region, goal = results.regions[k][0], results.goals[0]
    first, *others = results.config.sets
    for kind in results.config.sets:
        drawn = drawing.add_region(axes, region.vertices[kind] - goal, SET_COLOURS[kind], filled=kind == first)
        if kind in others:
            drawn.set(linestyle=(0, (3, 2)), zorder=1.5)
    drawing.add_goal(axes, (0.0, 0.0))
    _add_estimates(axes, results, k, goal)
    vertices = np.vstack([region.vertices[first] - goal, np.zeros((1, 2))])
    drawing.frame(axes, drawing.padded(vertices.min(0), vertices.max(0), ASPECT, 1.25))
    lower, upper = box
    drawing.add_box(axes, (lower - goal, upper - goal), ec="0.45", lw=0.7, ls=(0, (1, 1.5)))
    axes.set_xlabel("x − goal [m]")
    axes.locator_params(nbins=5)
    for kind, side in zip(results.config.sets, ("left", "right"), strict=False):
        size = length(np.sqrt(results.of_set(kind, "volume")[k, 0]))
        axes.set_title(f"√area {size}", loc=side, color=SET_COLOURS[kind], fontsize=8)


def _add_estimates(axes: Axes, results: Results, k: int, origin: np.ndarray) -> None:
    """The filter's path and present estimate, and the hybrid estimate, clipped to the frame."""
    ukf = results.numbers("ukf_0", "ukf_1")[: k + 1, 0] - origin
    hybrid = results.numbers("hybrid_0", "hybrid_1")[k, 0] - origin
    axes.plot(*ukf.T, color=UKF, lw=1.1, zorder=6)
    axes.plot(*ukf[-1], "x", color=UKF, ms=6.5, mew=1.8, zorder=8)
    axes.plot(*hybrid, "D", color=HYBRID, ms=7.5, mfc="none", mew=1.4, zorder=7.5)


def _draw_errors(axes: Axes, results: Results, samples: list[int]) -> None:
    """Errors and sizes over time, with the snapshots marked."""
    drawing.add_curves(axes, results.t, {name: values[:, 0] for name, values in results.lengths.items()})
    looks = {"ha": "center", "va": "bottom", "fontsize": 7, "color": "0.4"}
    for letter, t in zip(ascii_lowercase, results.t[samples], strict=False):
        axes.axvline(t, color="0.6", lw=0.7, ls=(0, (1, 1.5)), zorder=0)
        axes.text(t, 1.0, f"({letter})", transform=axes.get_xaxis_transform(), **looks)
    axes.tick_params(labelbottom=False)


def _draw_strip(axes: Axes, results: Results) -> None:
    """The number of active rows over time."""
    active = results.n_active()[:, 0]
    axes.fill_between(results.t, active, step="post", color=ACTIVE, alpha=0.75, lw=0)
    top = max(2, int(active.max()))
    axes.set(xlabel="t [s]", ylabel="active", ylim=(0, top + 0.3), yticks=range(top + 1))


def _settings(config: SceneConfig) -> str:
    lower, upper = (", ".join(f"{x:g}" for x in corner) for corner in (config.prior.lower, config.prior.upper))
    filtered = length(config.ukf.position_noise) + ("/s" if config.dynamics == "double_integrator" else "")
    return (
        f"dt = {config.dt:g} s, prior [{lower}] to [{upper}] m, UKF: √R = {filtered}, "
        f"inverse-optimal bound {config.noise.control:g} {config.noise.unit}"
    )


def _add_legends(figure: Figure, errors: Axes, kinds: Sequence[str]) -> None:
    obstacles = tuple(drawing.marker("o", colour, ms=8, mec="0.4") for colour in (ACTIVE, INACTIVE))
    patches = [Patch(facecolor=(*to_rgb(SET_COLOURS[kinds[0]]), 0.25), edgecolor=SET_COLOURS[kinds[0]])]
    patches += [Patch(facecolor="none", edgecolor=SET_COLOURS[kind], ls=(0, (3, 2))) for kind in kinds[1:]]
    entries = [
        (drawing.marker("o", ROBOT, ms=9), "robot"),
        (drawing.marker("*", "black", ms=10), "goal"),
        (obstacles, "obstacle: active, inactive"),
        (Rectangle((0, 0), 1, 1, fill=False, ec="0.45", ls=(0, (1, 1.5))), "frame of the map above"),
        *zip(patches, map(SET_NAMES.get, kinds), strict=True),
        (drawing.marker("x", UKF, ms=7, mew=1.8), "UKF"),
        (drawing.marker("D", HYBRID, ms=6.5, mfc="none", mew=1.4), "hybrid estimate"),
    ]
    handles, labels = zip(*entries, strict=True)
    looks = {"handler_map": {tuple: HandlerTuple(None)}, "columnspacing": 1.6}
    figure.legend(handles, labels, loc="outside lower left", ncols=math.ceil(len(entries) / 2), **looks)
    figure.legend(
        *errors.get_legend_handles_labels(), loc="outside lower right", ncols=3, columnspacing=1.0, handlelength=2
    )
