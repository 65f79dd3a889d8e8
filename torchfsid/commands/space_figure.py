"""The figure of an observed log of robots in space, from its saved results: three maps, sizes and cases over time.

Each map is that of the plane (`map_panel`), of everything seen along one axis. A set is seen as its shadow, the convex
hull of its projected vertices. So a point outside of one of the shadows is outside of the set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from torchfsid.commands.clock import Clock
from torchfsid.commands.figure_style import render
from torchfsid.commands.figures import (
    CASE_WORDS_IN_SPACE,
    doubt_bound,
    draw_cases,
    draw_observation,
    draw_sizes,
    final_regions,
    history_of,
)
from torchfsid.commands.map_panel import Marks, draw_map, finish_map

PLANES = ((0, 1), (0, 2), (1, 2))
"""The axes of the projections."""


def draw_regions(
    out: Path,
    x: Float[np.ndarray, "times bodies n"],
    seen: Bool[np.ndarray, "times bodies"],
    bodies: Sequence[str],
    marks: Marks | None = None,
) -> list[Path]:
    """`draw_observation` in the plane, `draw_in_space` in space."""
    return (draw_in_space if x.shape[-1] == 3 else draw_observation)(out, x, seen, bodies, marks)


def draw_in_space(
    out: Path,
    x: Float[np.ndarray, "times bodies 3"],
    seen: Bool[np.ndarray, "times bodies"],
    bodies: Sequence[str],
    marks: Marks | None = None,
) -> list[Path]:
    """Draw regions.png and regions.pdf from the files of the results folder and the positions of the log.

    Args:
        out: the results folder.
        x: positions of the bodies [m].
        seen: where they were measured.
        bodies: names of the bodies.
        marks: what is drawn besides.

    Raises:
        FigureError: a file is missing or damaged, or matplotlib fails.
        OSError: a figure cannot be written.
    """
    final = final_regions(out / "regions.json")
    history = history_of(out / "estimates.csv", final)
    marks, clock = marks or Marks(), Clock.of(float(next(iter(history.values()))["t"][0]))

    def draw(figure: Figure) -> None:
        doubt_bound(figure, out / "regions.json")
        grid = figure.add_gridspec(3, 2, height_ratios=(1, 1, 0.32))
        maps = []
        for plane, place in zip(PLANES, (grid[1, 0], grid[0, 0], grid[0, 1]), strict=True):
            axes, of_plane = figure.add_subplot(place), seen_along(marks, plane)
            unfinished = draw_map(axes, shadows(final, plane), x[..., plane], seen, bodies, of_plane)
            axes.set(xlabel=f"{'xyz'[plane[0]]} [m]", ylabel=f"{'xyz'[plane[1]]} [m]")
            axes.set_title(f"{axes.get_title(loc='left')}, along {'xyz'[3 - sum(plane)]}", pad=27)
            maps.append((axes, unfinished, of_plane))
        draw_sizes(figure.add_subplot(grid[1, 1]), history, final, clock, marks.unit)
        draw_cases(figure.add_subplot(grid[2, :]), history, clock, CASE_WORDS_IN_SPACE)
        figure.draw_without_rendering()
        if (layout := figure.get_layout_engine()) is not None:
            layout.execute(figure)  # again, because an equal aspect changes limits and ticks
        figure.set_layout_engine("none")  # labels are placed where the axes are now
        for axes, unfinished, of_plane in maps:
            finish_map(axes, unfinished, of_plane)

    return render(out / "regions", (10.5, 10.0), draw)


def shadows(final: Mapping[str, Any], plane: tuple[int, int]) -> dict[str, Any]:
    """The entries of regions.json, seen along the third axis. Sets over other parameters than places have no shadow."""
    found = {}
    for robot, region in final.items():
        outline, centroid = np.empty((0, 2)), [None, None]
        if len(region["centroid"]) == 3 and None not in region["centroid"]:
            outline = shadow(np.array(region["vertices"], dtype=float)[:, plane])
            centroid = [region["centroid"][i] for i in plane]
        found[robot] = {**region, "vertices": outline, "centroid": centroid}
    return found


def seen_along(marks: Marks, plane: tuple[int, int]) -> Marks:
    """The marks, seen along the third axis. Those over other parameters than places are left out."""

    def projected(theta: Sequence[float]) -> list[float]:
        return [theta[i] for i in plane]

    prior = marks.prior if marks.prior is not None and len(marks.prior[0]) == 3 else None
    truth = {robot: projected(theta) for robot, theta in marks.truth.items() if len(theta) == 3}
    return replace(marks, prior=None if prior is None else (projected(prior[0]), projected(prior[1])), truth=truth)


def shadow(points: Float[np.ndarray, "v 2"]) -> Float[np.ndarray, "k 2"]:
    """The corners of the convex hull of points in the plane, in order (Andrew's monotone chain)."""
    ordered = np.unique(points, axis=0)
    halves = []
    for side in (ordered, ordered[::-1]):
        half: list[np.ndarray] = []
        for point in side:
            while len(half) > 1 and _turn(half[-2], half[-1], point) <= 0:
                half.pop()
            half.append(point)
        halves += half[:-1]
    return np.array(halves or ordered[:1])


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    """Positive where the way from a over b to c turns left."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
