"""What was observed, from motion.csv or, for an experiment, from trajectory.csv and regions.jsonl."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from torchfsid.commands.page.tables import Table, rounded, thinned
from torchfsid.commands.page.words import Shift

MOST_TIMES = 2000
"""Times of motion.csv, and of a trajectory on the page."""

MOST_LINES = 30_000
"""Lines of motion.csv on the page: a time has one for each body."""

FINE = 1e-5
"""Resolution of positions and velocities, in units of their range."""


def read_motion(folder: Path, names: dict[str, int], shift: Shift, notes: list[str]) -> dict[str, Any] | None:
    """The motion of every body: times, positions, velocities, active rows. None if no file has it.

    Args:
        folder: the results folder.
        names: numbers of the names of constraints. New names are added.
        shift: from a time of the files to one of the page.
        notes: sentences about what was left out. New ones are added.

    Raises:
        FigureError: a file is damaged.
    """
    path = next((folder / name for name in ("motion.csv", "trajectory.csv") if (folder / name).is_file()), None)
    if path is None:
        notes.append("motion.csv is missing: no motion is drawn (torchfsid observe writes it).")
        return None
    table = Table(path)
    axes = [axis for axis in "xyz" if axis in table.columns]
    every, sample = np.unique(table.numbers("t")[:, 0], return_inverse=True)
    kept = thinned(len(every), min(MOST_TIMES, MOST_LINES // len(set(table.texts("robot")))))
    if len(kept) < len(every):
        notes.append(f"{len(kept)} of the {len(every)} times in {path.name} are shown, evenly chosen.")
    elif path.name == "motion.csv" and len(every) > MOST_TIMES // 2:
        notes.append(f"motion.csv has {len(every)} times, at most {MOST_TIMES}: of a longer log it has every so many.")
    place = np.full(len(every), -1)
    place[kept] = np.arange(len(kept))
    robots, at = np.array(table.texts("robot")), place[sample]
    x = table.numbers(*axes)
    velocities = [f"v{axis}" for axis in axes]
    v = table.numbers(*velocities) if all(name in table.columns for name in velocities) else np.full_like(x, np.nan)
    radius = table.numbers("radius")[:, 0] if "radius" in table.columns else np.full(table.rows, np.nan)
    active = table.texts("active") if "active" in table.columns else _recorded(folder, table)
    coarse = FINE * float(np.ptp(x, axis=0).max(initial=0.0)), FINE * float(np.nanmax(np.abs(v), initial=0.0))
    bodies = []
    for body in dict.fromkeys(robots.tolist()):
        of_body = np.flatnonzero((robots == body) & (at >= 0))
        of_times = np.full((2, len(kept), len(axes)), np.nan)
        of_times[0, at[of_body]], of_times[1, at[of_body]] = x[of_body], v[of_body]
        rows: list[list[int]] = [[] for _ in kept]
        for k in of_body.tolist():
            rows[at[k]] = [names.setdefault(name, len(names)) for name in active[k].split("; ") if name]
        sizes = radius[of_body][np.isfinite(radius[of_body])]
        bodies.append(
            {
                "name": body,
                "x": [_or_none(point) for point in rounded(of_times[0], coarse[0])],
                "v": [_or_none(point) for point in rounded(of_times[1], coarse[1])],
                "active": rows if any(rows) else None,
                "radius": float(sizes[0]) if len(sizes) else None,
            }
        )
    return {"axes": axes, "t": [shift(t) for t in every[kept].tolist()], "bodies": bodies}


def _or_none(point: list[float | None]) -> list[float | None] | None:
    return None if None in point else point


def _recorded(folder: Path, table: Table) -> list[str]:
    """The active rows of an experiment, which are in regions.jsonl, for each line of trajectory.csv."""
    path = folder / "regions.jsonl"
    if not path.is_file():
        return [""] * table.rows
    bodies, found = set(table.texts("robot")), {}
    with path.open(encoding="utf-8") as file:
        for line in map(json.loads, file):
            named = [f"avoid {name}" if name in bodies else name for name in line["active"]]
            found[f"{line['t']:.9g}", line["robot"]] = "; ".join(named)
    times = table.numbers("t")[:, 0].tolist()
    return [found.get((f"{t:.9g}", robot), "") for t, robot in zip(times, table.texts("robot"), strict=True)]
