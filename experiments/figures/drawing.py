"""Common parts of the figures: headings, curves, entries of legends, and the map with its bodies and regions.

A body, the robot included, is a disc of its radius, or else of radius Ds/2. Two discs of radius Ds/2 that touch are at
the safety distance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from string import ascii_lowercase
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon, Rectangle

from experiments.figures.style import ACTIVE, CURVES, INACTIVE
from experiments.runs.config import SceneConfig
from experiments.runs.saved import Results

SMALLEST = 1e-12
"""Half the side of a box around a point [m]."""

NO_RADIUS = 0.1
"""Radius of a disc in a scene without radius and safety distance [m]."""


def headline(figure: Figure, text: str) -> None:
    """Write the headline of the figure."""
    figure.suptitle(text, fontsize=9, x=0.01, ha="left")


def name_panel(axes: Axes, number: int, text: str, **looks: Any) -> None:
    """Write the title of a panel, with the letter of its number."""
    axes.set_title(f"({ascii_lowercase[number]}) {text}", fontweight="bold", **looks)


def marker(shape: str, colour: str, **looks: Any) -> Line2D:
    """A marker for a legend."""
    return Line2D([], [], ls="", marker=shape, color=colour, **looks)


def positive(values: np.ndarray) -> np.ndarray:
    """The values, with NaN for those that a logarithmic axis cannot show."""
    return np.where(values > 0, values, np.nan)


def add_curves(axes: Axes, t: np.ndarray, measures: Mapping[str, np.ndarray]) -> None:
    """Draw the sizes and errors of one robot over time."""
    for measure, label, looks in (curve for curve in CURVES if curve[0] in measures):
        axes.semilogy(t, positive(measures[measure]), label=label, **looks)
    axes.grid(True)
    axes.set_xlim(t[0], t[-1])


def disc_radius(config: SceneConfig) -> float:
    """The radius in which bodies are drawn [m]."""
    if config.radius is not None:
        return config.radius
    return NO_RADIUS if config.safety_distance is None else config.safety_distance / 2


def map_frame(results: Results, config: SceneConfig, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner [m] of a box around all bodies and goals. `aspect` is its width / height."""
    radius = disc_radius(config)
    points = np.concatenate([*results.paths.values(), results.goals])
    return padded(points.min(0) - 1.3 * radius, points.max(0) + 1.3 * radius, aspect, 1.06)


def padded(lower: np.ndarray, upper: np.ndarray, aspect: float, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """The box [m], `margin` times as large, then extended to width / height = aspect."""
    centre, half = (lower + upper) / 2, np.maximum(margin * (upper - lower) / 2, SMALLEST)
    half = np.array([max(half[0], half[1] * aspect), max(half[1], half[0] / aspect)])
    return centre - half, centre + half


def frame(axes: Axes, box: tuple[np.ndarray, np.ndarray]) -> None:
    """Limit the axes to the box [m]."""
    (left, bottom), (right, top) = box
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")


def add_box(axes: Axes, box: tuple[np.ndarray, np.ndarray], **looks: Any) -> None:
    """Draw the edges of a box [m]."""
    lower, upper = box
    axes.add_patch(Rectangle(tuple(lower), *(upper - lower), fill=False, **looks))


def add_obstacles(axes: Axes, config: SceneConfig, active: Sequence[str]) -> list[Circle]:
    """Draw the obstacles with their names, in the order of the configuration."""
    discs = []
    for obstacle in config.obstacles:
        x, y = obstacle.position
        discs.append(axes.add_patch(Circle((x, y), disc_radius(config), lw=0.6)))
        axes.text(x, y, obstacle.name, ha="center", va="center", fontsize=7, zorder=4)
    darken(axes, discs, config, active)
    return discs


def darken(axes: Axes, discs: Sequence[Circle], config: SceneConfig, active: Sequence[str]) -> None:
    """Mark the active obstacles."""
    for disc, text, obstacle in zip(discs, axes.texts, config.obstacles, strict=False):
        on = obstacle.name in active
        disc.set(facecolor=ACTIVE if on else INACTIVE, edgecolor="0.1" if on else "0.55", zorder=2.5 if on else 2)
        text.set_color("white" if on else "0.35")


def add_robot(axes: Axes, at: Sequence[float], radius: float, colour: str, *, solid: bool = True) -> Circle:
    """Draw a robot as a disc."""
    face, edge = (colour, "white") if solid else ((*to_rgb(colour), 0.45), colour)
    disc = Circle((at[0], at[1]), radius, facecolor=face, edgecolor=edge, lw=0.7, zorder=5)
    axes.add_patch(disc)
    return disc


def add_region(axes: Axes, vertices: np.ndarray, colour: str, *, filled: bool, zorder: float = 1) -> Polygon:
    """Draw a set as a polygon."""
    face = (*to_rgb(colour), 0.25) if filled else "none"
    region = Polygon(vertices, facecolor=face, edgecolor=colour, lw=1.1, zorder=zorder, joinstyle="round")
    axes.add_patch(region)
    return region


def add_goal(axes: Axes, at: Sequence[float], colour: str = "black", size: float = 9) -> None:
    """Mark a goal."""
    axes.plot(at[0], at[1], "*", color=colour, ms=size, mec="white", mew=0.6, zorder=7)
