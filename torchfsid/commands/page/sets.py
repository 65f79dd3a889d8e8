"""The sets Theta(t) of a results folder with their vertices, ready to be drawn.

A set comes as facets A theta <= b, each with the constraint and the time it came from. Its vertices are found by
intersecting a box that surely holds it with these rows. For each vertex the page gets the facets that meet there: an
edge of the set, or of its shadow on a plane, lies on the facets that its two ends have in common.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchfsid.commands.page.tables import Table, rounded, thinned
from torchfsid.errors import FigureError

MOST_FACETS = 60_000
"""Facets of all sets together; beyond them every robot's sets are thinned evenly."""

ON_FACET = 1e-6
"""How far a vertex may be from a facet that meets there, in diameters of the set, and in units of its coordinates
times 1e-6."""

FINE = 1e-5
"""Resolution of vertices, in diameters of the set."""


@dataclass(frozen=True)
class Facets:
    """The facets of one set.

    Attributes:
        t: time from which this is the set [s].
        A: rows (facets, p).
        b: right-hand sides (facets,).
        rows: the constraint that each facet came from.
        row_t: the time of its measurement [s], NaN for the prior.
    """

    t: float
    A: np.ndarray
    b: np.ndarray
    rows: Sequence[str]
    row_t: np.ndarray


def read_sets(path: Path) -> dict[str, list[Facets]]:
    """The sets of each robot in sets.csv, in the order of time.

    Raises:
        FigureError: the file is missing or damaged.
    """
    table = Table(path)
    t, b, row_t = (table.numbers(name)[:, 0] for name in ("t", "b", "row_t"))
    A, robots, rows = table.numbers(*table.indexed("A")), table.texts("robot"), table.texts("row")
    if not np.isfinite(np.column_stack([t, b, A])).all():
        raise FigureError(f"{path}: is damaged: a facet has no number")
    starts = [k for k in range(table.rows) if k == 0 or robots[k] != robots[k - 1] or t[k] != t[k - 1]]
    sets: dict[str, list[Facets]] = {}
    for start, end in zip(starts, [*starts[1:], table.rows], strict=True):
        part = slice(start, end)
        found = Facets(float(t[start]), A[part], b[part], rows[part], row_t[part])
        sets.setdefault(robots[start], []).append(found)
    return sets


def fewer(sets: dict[str, list[Facets]], notes: list[str]) -> dict[str, list[Facets]]:
    """At most about `MOST_FACETS` facets. What was left out becomes a sentence of `notes`."""
    facets = sum(len(one.b) for of_robot in sets.values() for one in of_robot)
    if facets <= MOST_FACETS:
        return sets
    share, before = MOST_FACETS / facets, sum(map(len, sets.values()))
    kept = {
        robot: [of_robot[k] for k in thinned(len(of_robot), int(share * len(of_robot)))]
        for robot, of_robot in sets.items()
    }
    shown = sum(map(len, kept.values()))
    notes.append(f"{shown} of the {before} sets in sets.csv are shown, evenly chosen for each robot.")
    return kept


def drawn(sets: Sequence[Facets], around: tuple[np.ndarray, np.ndarray], names: dict[str, int]) -> list[list[Any]]:
    """Each set as [t, vertices, facets at each vertex, [name, time] of each facet].

    Args:
        sets: the sets of a robot.
        around: lower and upper corner of a box that holds all of them.
        names: numbers of the names of constraints. New names are added.
    """
    import torch

    from torchfsid.halfspaces import Halfspaces
    from torchfsid.sets.feasible_set import FeasibleSet

    if not sets:
        return []
    most = max(len(one.b) for one in sets)
    A = np.stack([np.pad(one.A, ((0, most - len(one.b)), (0, 0))) for one in sets])
    b = np.stack([np.pad(one.b, (0, most - len(one.b)), constant_values=1.0) for one in sets])
    lower, upper = (torch.from_numpy(np.broadcast_to(end, (len(sets), A.shape[-1])).copy()) for end in around)
    box = FeasibleSet.from_box(lower, upper, max_facets=most + 2 * A.shape[-1])
    vertices = box.intersect(Halfspaces(torch.from_numpy(A), torch.from_numpy(b))).vertices().numpy()
    return [_drawn(one, corners, names) for one, corners in zip(sets, vertices, strict=True)]


def _drawn(one: Facets, padded: np.ndarray, names: dict[str, int]) -> list[Any]:
    corners = padded[np.isfinite(padded).all(-1)]
    _, first = np.unique(corners, axis=0, return_index=True)
    corners = corners[np.sort(first)]
    size = float(np.ptp(corners, axis=0).max()) if len(corners) else math.nan
    off = np.abs(corners @ one.A.T - one.b) / np.linalg.norm(one.A, axis=-1)
    meets = off <= ON_FACET * (size + ON_FACET * np.abs(corners).max(initial=0.0))
    return [
        one.t,
        rounded(corners, FINE * size) if size > 0 else corners.tolist(),
        [np.flatnonzero(at).tolist() for at in meets],
        [
            [names.setdefault(name, len(names)), None if math.isnan(time) else time]
            for name, time in zip(one.rows, one.row_t.tolist(), strict=True)
        ],
    ]
