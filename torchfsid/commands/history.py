"""The course of a run in two thinned files, for pages and viewers.

    sets.csv      Theta(t): t, robot, A_i, b, row, row_t
    motion.csv    what was observed: t, robot, x, y[, z], vx, vy[, vz][, radius], active

sets.csv has one line for each facet A theta <= b of a set: the name of the constraint that it came from, and the time
of that measurement [s], empty for the prior. A set is written when it is first known, whenever its volume has changed
by `STEP` since it was last written (its diameter, if it is flat), and at the end. Sets only shrink, unless they are
reset. So the last set that was written is an outer bound until the next one.

motion.csv has at most `MOST_TIMES` times, evenly spaced in the samples. `active` names the rows that were read as
active, joined by "; ".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool

from torchfsid.commands.table_file import TableFile, line_of, lines_of, number, texts
from torchfsid.halfspaces import array
from torchfsid.logs.log import Log
from torchfsid.observers.set_membership import SetEstimates
from torchfsid.sets.feasible_set import FeasibleSet

STEP = 0.05
"""Least relative change of a set between two entries of sets.csv."""

MOST_TIMES = 2000
"""Most times in motion.csv."""


class SetsFile(TableFile):
    """sets.csv.

    Args:
        path: the file.
        robots: names of the robots, in the order of the batch.
        dim: the number of parameters.
        name: the name of the constraint behind a source, see `constraint_name`.
    """

    def __init__(self, path: Path, robots: Sequence[str], dim: int, name: Callable[[int], str]):
        super().__init__(path, ["t", "robot", *(f"A_{i}" for i in range(dim)), "b", "row", "row_t"])
        self._robots, self._name = robots, name
        self._written = [(math.nan, math.nan)] * len(robots)
        self._last_t = math.nan

    def see(self, t: float, sizes: Sequence[tuple[float, float]], sets: Callable[[], FeasibleSet]) -> None:
        """Take in the sets at a time [s], with the volume and diameter of each (NaN if it is empty)."""
        changed = [i for i, size in enumerate(sizes) if _differ(size, self._written[i])]
        for i in changed:
            self._written[i] = sizes[i]
        if changed:
            self._write(t, sets(), changed)
        self._last_t = t

    def finish(self, sets: FeasibleSet) -> None:
        """Write the final sets."""
        if not math.isnan(self._last_t):
            self._write(self._last_t, sets, range(len(self._robots)))

    def _write(self, t: float, sets: FeasibleSet, robots: Sequence[int]) -> None:
        facets = sets.select(torch.tensor(list(robots), device=sets.outcome.device)).facets()
        rows = facets.halfspaces
        lines = []
        for k, i in enumerate(robots):
            real = (rows.A[k] != 0).any(-1)
            values = texts(torch.cat([rows.A[k][real], rows.b[k][real, None]], dim=-1))
            origins = zip(facets.source[k][real].tolist(), facets.time[k][real].tolist(), strict=True)
            for row, (source, time) in zip(values, origins, strict=True):
                lines.append([number(t), self._robots[i], *row, self._name(source), number(time)])
        self.write(lines)


class MotionFile(TableFile):
    """motion.csv.

    Args:
        path: the file.
        log: the log.
        robots: the inferred bodies.
        labels: labels of the rows of the model.
    """

    def __init__(self, path: Path, log: Log, robots: Sequence[str], labels: Sequence[str]):
        axes, sizes = "xyz"[: log.x.shape[-1]], [] if log.radius is None else ["radius"]
        super().__init__(path, ["t", "robot", *axes, *(f"v{axis}" for axis in axes), *sizes, "active"])
        self._log, self._labels = log, labels
        self._robots = [log.bodies.index(robot) for robot in robots]
        self._names = [line_of([body]) for body in log.bodies]
        self._radius = [[]] * len(log.bodies) if log.radius is None else texts(log.radius[:, None])
        self._cells: dict[bytes, str] = {}
        self._stride, self._sample = max(1, math.ceil((len(log.t) - 1) / (MOST_TIMES - 1))), 0

    def see(self, estimates: SetEstimates) -> None:
        """Take in the next samples of the log."""
        first, self._sample = self._sample, self._sample + len(estimates)
        last = len(self._log.t) - 1
        kept = [k for k in range(first, self._sample) if k % self._stride == 0 or k == last]
        active = array(estimates.kkt.active).reshape(len(estimates), len(self._robots), -1)
        self.write_texts(["".join(self._lines(k, active[k - first])) for k in kept])

    def _lines(self, k: int, active: Bool[np.ndarray, "robots m"]) -> Iterator[str]:
        """The lines of sample k."""
        log, unknown = self._log, "," * (self._log.x.shape[-1] - 1)
        t, positions = number(log.t[k]), lines_of(log.x[k])
        velocities = [unknown] * len(log.bodies) if log.u is None else lines_of(log.u[k])
        known, names = log.velocity_known[k].tolist(), [""] * len(log.bodies)
        for j, rows in zip(self._robots, active, strict=True):
            names[j] = self._named(rows)
        for j in log.seen[k].nonzero()[0].tolist():
            velocity = velocities[j] if known[j] else unknown
            yield ",".join([t, self._names[j], positions[j], velocity, *self._radius[j], names[j]]) + "\r\n"

    def _named(self, active: Bool[np.ndarray, "m"]) -> str:
        """The cell that names the active rows. They are few, and often the same."""
        key = active.tobytes()
        if key not in self._cells:
            rows = active.nonzero()[0].tolist()
            self._cells[key] = line_of(["; ".join([self._labels[row] for row in rows])]) if rows else ""
        return self._cells[key]


def _differ(size: tuple[float, float], written: tuple[float, float]) -> bool:
    """Has a set changed by `STEP` or more? The diameter decides if the volume is 0."""
    new, old = (s[0] if s[0] > 0 or s[0] != s[0] else s[1] for s in (size, written))
    if math.isnan(new):
        return False
    return math.isnan(old) or not old * (1 - STEP) < new < old * (1 + STEP)
