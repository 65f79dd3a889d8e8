"""The figure of an observed log of robots in space, from its saved results.

Three projections (xy, xz, yz) of the trajectories and of the final sets, whose shadows are the convex hulls of the
projected vertices, with a cross at the centroid. Beside them the sizes over time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchfsid.commands.figures import MOST_NAMED, _history, _regions, colour, plain_name, render, thinned

PLANES = ((0, 1), (0, 2), (1, 2))
"""The axes of the projections."""


def draw_in_space(
    out: Path, x: Float[np.ndarray, "times bodies 3"], seen: Bool[np.ndarray, "times bodies"], bodies: Sequence[str]
) -> list[Path]:
    """Draw regions.png and regions.pdf from the files of the results folder and the positions of the log.

    Args:
        out: the results folder.
        x: positions of the bodies [m].
        seen: where they were measured.
        bodies: names of the bodies.

    Raises:
        FigureError: a file is missing or damaged, or matplotlib fails.
        OSError: a figure cannot be written.
    """
    final, history = _regions(out / "regions.json"), _history(out / "estimates.csv")

    def draw(figure: Figure) -> None:
        grid = figure.add_gridspec(2, 2)
        axes = [figure.add_subplot(place) for place in (grid[1, 0], grid[0, 0], grid[0, 1])]
        for plane, of in zip(PLANES, axes, strict=True):
            draw_projection(of, plane, final, x, seen, bodies)
        draw_sizes(figure.add_subplot(grid[1, 1]), history, final)

    return render(out / "regions", (10.5, 8.4), draw)


def draw_projection(
    axes: Axes,
    plane: tuple[int, int],
    final: Mapping[str, Any],
    x: Float[np.ndarray, "times bodies 3"],
    seen: Bool[np.ndarray, "times bodies"],
    bodies: Sequence[str],
) -> None:
    """Paths and sets, seen along the third axis. Bodies that are not inferred are grey.

    Args:
        axes: where it is drawn.
        plane: the two axes that are seen.
        final: for each robot its `vertices`, `centroid`, `diameter` and `status`.
        x: positions of the bodies [m].
        seen: where they were measured.
        bodies: names of the bodies.
    """
    first, second = ("xyz"[i] for i in plane)
    for k, body in enumerate(bodies):
        path = thinned(x[seen[:, k], k])[:, plane]
        if len(path) == 0:
            continue
        mine = colour(list(final).index(body)) if body in final else "0.7"
        axes.plot(*path.T, color=mine, lw=1.2, alpha=0.8)
        axes.plot(*path[0], "o", color=mine, ms=4, mfc="white")
        axes.plot(*path[-1], "o", color=mine, ms=5 if body in final else 7)
    for i, region in enumerate(final.values()):
        if None in region["centroid"]:  # empty
            continue
        outline, is_ok = shadow(np.array(region["vertices"], dtype=float)[:, plane]), region["status"] == "ok"
        looks = {"color": colour(i) if is_ok else "0.5", "alpha": 0.3 if is_ok else 0.15, "lw": 0}
        axes.fill(*outline.T, **looks)
        axes.plot(*np.vstack([outline, outline[:1]]).T, color=colour(i), lw=1.2, alpha=0.7, ls="-" if is_ok else "--")
        axes.plot(*np.array(region["centroid"])[list(plane)], "+", color=colour(i), ms=11, mew=1.6)
    axes.set(xlabel=f"{first} [m]", ylabel=f"{second} [m]", title=f"seen along {'xyz'[3 - sum(plane)]}")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.grid(color="0.93", lw=0.6)
    axes.set_axisbelow(True)


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


def draw_sizes(axes: Axes, history: Mapping[str, Mapping[str, np.ndarray]], final: Mapping[str, Any]) -> None:
    """The diameters over time, and in the legend the last ones.

    Args:
        axes: where they are drawn.
        history: for each robot its times `t` [s] and `diameter` [m].
        final: for each robot its `diameter` and `status`.
    """
    named = len(history) <= MOST_NAMED
    for i, (robot, of) in enumerate(history.items()):
        last, status = final[robot]["diameter"], final[robot]["status"]
        told = "empty" if last is None or math.isnan(last) else f"{last:.2g} m"
        label = f"{plain_name(robot)}: {told}" + ("" if status == "ok" else f", {status}")
        axes.plot(thinned(of["t"]), thinned(of["diameter"]), color=colour(i), lw=1.5, label=label if named else None)
    sizes = np.concatenate([of["diameter"] for of in history.values()])
    sizes = sizes[sizes > 0]
    if len(sizes) and sizes.max() > 2 * sizes.min():
        axes.set_yscale("log")
    axes.set(xlabel="t [s]", ylabel="diameter [m]", title="Size of the sets")
    axes.grid(color="0.93", lw=0.6)
    if named:
        axes.legend(title="robot and last diameter", fontsize=8, ncols=1 + len(history) // 9)
