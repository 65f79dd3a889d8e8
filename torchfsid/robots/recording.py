"""A simulated run as a log: a CSV file that `torchfsid observe` and `fsid.read_log` read back without a loss.

    t, robot, x, y[, z], vx, vy[, vz][, ax, ay[, az]][, radius]          one line per body and time, SI units

Robots of first order have their controls as velocities. Those of second order have velocities and, as controls,
accelerations. Numbers have 17 digits, with which a reader knows that they are not rounded.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchfsid.errors import InputError

if TYPE_CHECKING:
    from torchfsid.robots.simulation import Trajectory


def names_of(run: Trajectory, names: Sequence[str] | None = None) -> tuple[str, ...]:
    """The names of the bodies of a run: "0", "1", ... for robots, "obstacle_0", ... for what stands still.

    Raises:
        InputError: given names are not one for each body.
    """
    bodies = run.x.shape[-2]
    if names is None:
        return (
            *(str(i) for i in range(run.robots)),
            *(f"obstacle_{i}" for i in range(bodies - run.robots)),
        )
    if isinstance(names, str) or len(set(names)) != bodies or len(names) != bodies:
        raise InputError("names", f"{bodies} different names, robots first", names)
    return tuple(names)


def write_run(run: Trajectory, path: str | Path, names: Sequence[str] | None = None) -> Path:
    """Write a run of one team.

    Raises:
        InputError: it is a batch of teams, names do not fit, or the suffix is not .csv.
        OSError: the file cannot be written.
    """
    path, n = Path(path), run.x.shape[-1]
    if run.x.ndim != 3 or run.present is not None:
        raise InputError("run", "one team (samples, bodies, n), all of them present", tuple(run.x.shape))
    if path.suffix.lower() != ".csv":
        raise InputError("path", "a file *.csv", str(path))
    groups = [("", run.x), ("v", run.u)] if run.velocity is None else [("", run.x), ("v", run.velocity), ("a", run.u)]
    header = ["t", "robot", *(f"{letter}{axis}" for letter, _ in groups for axis in "xyz"[:n])]
    columns = torch.cat([values.detach() for _, values in groups], dim=-1)
    radius = None if run.radius is None else run.radius.detach().expand(run.x.shape[-2])
    with path.open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file)
        lines.writerow(header if radius is None else [*header, "radius"])
        for t, bodies in zip(run.t.tolist(), columns, strict=True):
            for i, (name, row) in enumerate(zip(names_of(run, names), bodies, strict=True)):
                size = [] if radius is None else _texts(radius[i : i + 1])
                lines.writerow([repr(t), name, *_texts(row), *size])
    return path


def _texts(values: Tensor) -> list[str]:
    return [f"{value:#.17g}" for value in values.double().tolist()]
