"""Common parts of the figures of scenes: the map with its bodies, regions, and the frame of a map.

A body, the robot included, is a disc of radius Ds/2. Two discs that touch are at the safety distance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle, Polygon

from experiments.figures.style import ACTIVE, INACTIVE
from experiments.runs.config import SceneConfig
from experiments.runs.saved import Results

SMALLEST = 1e-12
"""Half the side of a box around a point [m]."""

NO_RADIUS = 0.1
"""Radius of a disc in a scene without safety distance [m]."""


def disc_radius(config: SceneConfig) -> float:
    """The radius in which bodies are drawn [m]."""
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


def add_obstacles(axes: Axes, config: SceneConfig) -> list[Circle]:
    """Draw inactive obstacles with their names, in the order of the configuration."""
    discs = []
    for obstacle in config.obstacles:
        x, y = obstacle.position
        disc = Circle((x, y), disc_radius(config), facecolor=INACTIVE, edgecolor="0.55", lw=0.6, zorder=2)
        axes.add_patch(disc)
        discs.append(disc)
        axes.text(x, y, obstacle.name, ha="center", va="center", fontsize=7, color="0.35", zorder=4)
    return discs


def darken(axes: Axes, discs: Sequence[Circle], config: SceneConfig, active: Sequence[str]) -> None:
    """Mark the active obstacles."""
    for disc, text, obstacle in zip(discs, axes.texts, config.obstacles, strict=False):
        on = obstacle.name in active
        disc.set(facecolor=ACTIVE if on else INACTIVE, edgecolor="0.1" if on else "0.55", zorder=2.5 if on else 2)
        text.set_color("white" if on else "0.35")


def add_robot(axes: Axes, at: Sequence[float], radius: float, colour: str, *, solid: bool = True) -> Circle:
    """Draw a robot as a disc."""
    face, edge = (colour, "white") if solid else (translucent(colour, 0.45), colour)
    disc = Circle((at[0], at[1]), radius, facecolor=face, edgecolor=edge, lw=0.7, zorder=5)
    axes.add_patch(disc)
    return disc


def add_region(axes: Axes, vertices: np.ndarray, colour: str, *, filled: bool, zorder: float = 1) -> Polygon:
    """Draw a set as a polygon."""
    face = translucent(colour, 0.25) if filled else "none"
    region = Polygon(vertices, facecolor=face, edgecolor=colour, lw=1.1, zorder=zorder, joinstyle="round")
    axes.add_patch(region)
    return region


def add_goal(axes: Axes, at: Sequence[float], colour: str = "black", size: float = 9) -> None:
    """Mark a goal."""
    axes.plot(at[0], at[1], "*", color=colour, ms=size, mec="white", mew=0.6, zorder=7)


def translucent(colour: str, opacity: float) -> tuple[float, float, float, float]:
    """The colour with this opacity, as (red, green, blue, opacity)."""
    red, green, blue = to_rgb(colour)
    return red, green, blue, opacity
