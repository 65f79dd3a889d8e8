"""A film of the run: the map, the regions to their own scale, and the lengths over time.

The background is drawn once. A frame adds only what moves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.figures import drawing
from experiments.figures.film import Film, spread
from experiments.figures.style import HYBRID, ROBOT, SET_COLOURS, UKF, length, team_colours
from experiments.runs.config import SceneConfig
from experiments.runs.saved import Results

FRAMES, FRAME_MS, COLOURS = 100, 60, 192
SIZE, DPI = (8.0, 4.0), 100

Redraw = Callable[[int], Iterable[Artist]]
"""Brings a panel to sample k, and returns what has to be drawn."""


def animate(results: Results, config: SceneConfig) -> Film:
    """The film of a run."""
    film = Film(FRAME_MS, COLOURS)
    with mpl.rc_context({"font.size": 8, "axes.titlesize": 8.5, "axes.labelsize": 8}):
        figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1), height_ratios=(1.1, 1))
        panels = [
            _map(figure.add_subplot(grid[:, 0]), results, config),
            _regions(figure.add_subplot(grid[0, 1]), results, config),
            _curves(figure.add_subplot(grid[1, 1]), results),
        ]
        canvas.draw()
        background = canvas.copy_from_bbox(figure.bbox)
        for k in spread(len(results.t), FRAMES):
            canvas.restore_region(background)
            for panel in panels:
                for artist in panel(k):
                    assert artist.axes is not None
                    artist.axes.draw_artist(artist)
            film.add(canvas)
    return film


def _colours(config: SceneConfig) -> list[str]:
    """The colours of the regions: one fixed colour for a single robot, the robots' colours for a team."""
    return [SET_COLOURS[config.set]] if len(config.robots) == 1 else team_colours(config)


def _map(axes: Axes, results: Results, config: SceneConfig) -> Redraw:
    alone, colours, radius = len(config.robots) == 1, _colours(config), drawing.disc_radius(config)
    discs = drawing.add_obstacles(axes, config, [])
    names = list(axes.texts)
    regions, paths, robots, filters, hybrids = [], [], [], [], []
    for robot, colour, goal in zip(config.robots, colours, results.goals, strict=True):
        body = ROBOT if alone else colour
        regions.append(drawing.add_region(axes, results.regions[0][0].vertices[config.set], colour, filled=True))
        paths += axes.plot([], [], color=body, lw=1.1)
        robots.append(drawing.add_robot(axes, results.paths[robot.name][0], radius, body, solid=alone))
        filters += axes.plot([], [], "x", color=UKF if alone else colour, ms=6, mew=1.6)
        hybrids += axes.plot([], [], "D", color=HYBRID if alone else colour, ms=6.5, mfc="none", mew=1.2)
        drawing.add_goal(axes, goal, "black" if alone else colour, size=10)
    goals = [line for line in axes.lines if line.get_marker() == "*"]
    clock = axes.text(0.02, 0.98, "", transform=axes.transAxes, va="top", fontweight="bold")
    drawing.frame(axes, drawing.map_frame(results, config, aspect=1.1))
    axes.set(xlabel="x [m]", ylabel="y [m]", title=config.title)
    moving = [*regions, *discs, *names, *paths, *robots, *goals, *filters, *hybrids, clock]
    for artist in moving:
        artist.set_animated(True)
    ukf, hybrid = results.numbers("ukf_0", "ukf_1"), results.numbers("hybrid_0", "hybrid_1")

    def update(k: int) -> Iterable[Artist]:
        drawing.darken(axes, discs, config, [name for of_robot in results.regions[k] for name in of_robot.active])
        for i, robot in enumerate(config.robots):
            path = results.paths[robot.name]
            regions[i].set_xy(results.regions[k][i].vertices[config.set])
            paths[i].set_data(*path[: k + 1].T)
            robots[i].set_center(path[k])
            filters[i].set_data(*ukf[k, i, :, None])
            hybrids[i].set_data(*hybrid[k, i, :, None])
        clock.set_text(f"t = {results.t[k]:.2f} s")
        return moving

    return update


def _regions(axes: Axes, results: Results, config: SceneConfig) -> Redraw:
    """Every region about its goal, all to the scale of the largest."""
    regions = [drawing.add_region(axes, np.zeros((3, 2)), colour, filled=True) for colour in _colours(config)]
    scale = axes.text(0.99, 0.98, "", transform=axes.transAxes, ha="right", va="top")
    drawing.add_goal(axes, (0.0, 0.0), size=10)
    axes.set(xticks=[], yticks=[], aspect="equal", adjustable="datalim", title="the whole region, about the goal")
    axes.spines[["top", "right"]].set_visible(True)
    star = axes.lines[0]
    moving = [*regions, star, scale]
    for artist in moving:
        artist.set_animated(True)

    def update(k: int) -> Iterable[Artist]:
        about = [of.vertices[config.set] - goal for of, goal in zip(results.regions[k], results.goals, strict=True)]
        for region, vertices in zip(regions, about, strict=True):
            region.set_xy(vertices)
        vertices = np.vstack([*about, np.zeros((1, 2))])
        width, height = axes.bbox.size
        (left, bottom), (right, top) = drawing.padded(vertices.min(0), vertices.max(0), width / height, 1.2)
        axes.set(xlim=(left, right), ylim=(bottom, top))
        scale.set_text(f"width of this panel: {length(right - left)}")
        return moving

    return update


def _curves(axes: Axes, results: Results) -> Redraw:
    """Lengths over time. For a team, their geometric means."""
    measures = results.lengths
    shown = [
        (f"{results.config.set} sqrt_area", "region √area", SET_COLOURS[results.config.set], 1.6, "-"),
        (f"{results.config.set} diameter", "region diameter", SET_COLOURS[results.config.set], 1.0, "--"),
        ("ukf", "UKF error", UKF, 1.6, "-"),
        ("hybrid", "hybrid error", HYBRID, 1.2, "-"),
    ]
    lines, curves = [], []
    for name, label, colour, width, dashes in shown:
        curve = np.exp(np.log(drawing.positive(measures[name])).mean(axis=1))
        axes.semilogy(results.t, curve, color=colour, lw=width, alpha=0.2)
        curves.append(curve)
        lines += axes.plot([], [], color=colour, lw=width, ls=dashes, label=label, animated=True)
    team = " (geometric mean over the team)" if len(results.robots) > 1 else ""
    axes.set(xlabel="t [s]", xlim=(results.t[0], results.t[-1]), title=f"lengths [m]{team}")
    axes.grid(True)
    axes.legend(loc="best", fontsize=7, frameon=True, framealpha=0.85, edgecolor="none")

    def update(k: int) -> Iterable[Artist]:
        for line, curve in zip(lines, curves, strict=True):
            line.set_data(results.t[: k + 1], curve[: k + 1])
        return lines

    return update
