r"""Logs that someone recorded, as measurements.

One row per body and time, the rows of one time together, times increasing, other columns ignored:

    t, robot, x, y[, z][, vx, vy[, vz]][, radius]          [s], a name, [m], [m/s], [m]

(vx, vy) is the control computed at t from the positions at t. It is held until the next sample t_+ (zero-order hold):
where it was not logged, it is (x(t_+) - x(t)) / (t_+ - t), exactly. A body without a row at t is not there at t.

Nothing here imports torch before the measurements are asked for, so that a wrong log is refused at once.
"""

from __future__ import annotations

import csv
import math
import reprlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from torchfsid.errors import LogError

if TYPE_CHECKING:
    from torchfsid.measurement import Measurement


@dataclass(frozen=True)
class Log:
    """T times of N bodies. Where something is unknown its entries are zeros, never NaN, and a mask says so.

    Attributes:
        source: the file.
        bodies: their names, in the order in which they appear.
        t: times [s], increasing.
        x: positions [m].
        u: velocities [m/s]; None if the log has none.
        seen: the body is there at t.
        velocity_known: and so is its velocity.
        radius: [m]; None if the log has none.
    """

    source: str
    bodies: tuple[str, ...]
    t: Float[np.ndarray, "times"]
    x: Float[np.ndarray, "times bodies n"]
    u: Float[np.ndarray, "times bodies n"] | None
    seen: Bool[np.ndarray, "times bodies"]
    velocity_known: Bool[np.ndarray, "times bodies"]
    radius: Float[np.ndarray, "bodies"] | None = None

    @property
    def previous_known(self) -> Bool[np.ndarray, "times bodies"]:
        """The body's velocity one sample earlier is known; so not at the first sample, nor at a body's first."""
        return np.concatenate([np.zeros_like(self.velocity_known[:1]), self.velocity_known[:-1]])

    def differentiated(self) -> Log:
        """The log with velocities from differences of its positions (module docstring), without its last time.

        The velocity of a body that is missing from the next sample is not known.

        Raises:
            LogError: a difference quotient is not a finite number.
        """
        known = self.seen[:-1] & self.seen[1:]
        with np.errstate(over="ignore", invalid="ignore"):
            u = np.where(known[..., None], np.diff(self.x, axis=0) / np.diff(self.t)[:, None, None], 0.0)
        if not np.isfinite(u).all():
            k = int(np.argmin(np.isfinite(u).all(axis=(1, 2))))
            raise LogError(f"{self.source}: no finite velocities from t = {self.t[k]} to {self.t[k + 1]}")
        return replace(self, t=self.t[:-1], x=self.x[:-1], u=u, seen=self.seen[:-1], velocity_known=known)

    def measurements(
        self, robots: Sequence[str], neighbour_velocities: Collection[str], required: Collection[str] = ()
    ) -> Iterator[Measurement]:
        """One measurement per time, of the batch of these robots among all bodies.

        A robot is `observed` where its velocity is known, the `required` bodies (the leader of a formation) are there,
        and the `neighbour_velocities` that its barriers use are known: for `current` the velocity of every body that is
        there, for `previous` that of every body that is there (the robot included) one sample earlier. A row with an
        unknown right-hand side cannot just be left out: it may be the active one, and the set would lose the truth.

        Raises:
            LogError: the log has no velocities, or no body of that name.
        """
        if self.u is None:
            raise LogError(f"{self.source}: no columns vx, vy: take `velocity: differentiated`, or log the velocities")
        if missing := [name for name in (*robots, *required) if name not in self.bodies]:
            raise LogError(f"{self.source}: no body is called {missing[0]!r}; there are {reprlib.repr(self.bodies)}")
        index, leaders = ([self.bodies.index(name) for name in names] for names in (robots, required))
        observed = self.velocity_known[:, index] & self.seen[:, leaders].all(axis=1, keepdims=True)
        if "current" in neighbour_velocities:
            observed &= (self.velocity_known | ~self.seen).all(axis=1, keepdims=True)
        if "previous" in neighbour_velocities:
            observed &= (self.previous_known | ~self.seen).all(axis=1, keepdims=True)
        return self._measurements(self.u, index, observed)

    def _measurements(self, velocities: np.ndarray, robots: list[int], observed: np.ndarray) -> Iterator[Measurement]:
        import torch

        from torchfsid.measurement import Measurement

        x, u, seen, observes = (torch.from_numpy(array) for array in (self.x, velocities, self.seen, observed))
        radius = None if self.radius is None else torch.from_numpy(self.radius)
        previous_u = torch.zeros_like(u[0])
        for k, t in enumerate(self.t.tolist()):
            team = Measurement.of_team(t, x[k], u[k], robots=robots, previous_u=previous_u, radius=radius, seen=seen[k])
            yield replace(team, observed=observes[k])
            previous_u = u[k]


def read_csv(path: str | Path) -> Log:
    """The log in a CSV file (UTF-8, one header line).

    Raises:
        LogError: the file cannot be read, or is not such a log; the message names the line, and the column.
    """
    source = str(path)
    table = _Table(source)
    axes = [axis for axis in "xyz" if axis in "xy" or axis in table.header]
    velocities = [f"v{axis}" for axis in "xyz" if f"v{axis}" in table.header]
    for name in ["t", "robot", *axes, *(f"v{axis}" for axis in axes if velocities)]:
        table.require(name)
    if "z" not in axes and "vz" in velocities:
        raise LogError(f"{source} line 1: column 'vz' without 'z'")

    t = table.numbers("t")
    steps = np.diff(t)
    if (steps < 0).any():
        i = int(np.argmax(steps < 0))
        raise table.error(i + 1, f"times must not decrease, got {t[i + 1]} after {t[i]}")
    if not (steps > 0).any():
        raise table.error(len(t) - 1, f"the log ends after a single time, t = {t[0]}")
    time = np.concatenate([[0], np.cumsum(steps > 0)])

    names = table.names("robot")
    bodies = tuple(dict.fromkeys(names))
    slot = {name: j for j, name in enumerate(bodies)}
    body = np.fromiter((slot[name] for name in names), dtype=np.int64, count=len(names))
    cell = time * len(bodies) + body
    order = np.argsort(cell, kind="stable")
    repeats = np.flatnonzero(np.diff(cell[order]) == 0)
    if len(repeats):
        i = int(order[repeats + 1].min())
        raise table.error(i, f"robot {names[i]!r} has another row at t = {t[i]}")

    def by_time_and_body(columns: list[str]) -> np.ndarray:
        values = np.zeros((time[-1] + 1, len(bodies), len(columns)))
        values[time, body] = np.stack([table.numbers(column) for column in columns], axis=-1)
        return values

    seen = np.zeros((time[-1] + 1, len(bodies)), dtype=bool)
    seen[time, body] = True
    return Log(
        source=source,
        bodies=bodies,
        t=t[np.concatenate([[True], steps > 0])],
        x=by_time_and_body(axes),
        u=by_time_and_body(velocities) if velocities else None,
        seen=seen,
        velocity_known=seen if velocities else np.zeros_like(seen),
        radius=_radius(table, names, body) if "radius" in table.header else None,
    )


def _radius(table: _Table, names: list[str], body: np.ndarray) -> Float[np.ndarray, "bodies"]:
    values = table.numbers("radius")
    if (values < 0).any():
        i = int(np.argmax(values < 0))
        raise table.error(i, f"column 'radius': expected a number >= 0, got {values[i]}")
    radius = values[np.unique(body, return_index=True)[1]]
    changed = values != radius[body]
    if changed.any():
        i = int(np.argmax(changed))
        raise table.error(i, f"the radius of robot {names[i]!r} changes from {radius[body[i]]} to {values[i]}")
    return radius


class _Table:
    """The cells of a CSV file, as text, with the line of the file that each row stands on."""

    def __init__(self, source: str):
        self.source = source
        self.lines: list[int] = []
        records: list[list[str]] = []
        try:
            with open(source, encoding="utf-8-sig", newline="") as file:
                reader = csv.reader(file, strict=True)
                for record in reader:
                    if len(record) > 1 or "".join(record).strip():  # not a blank line
                        records.append(record)
                        self.lines.append(reader.line_num)
        except OSError as error:
            raise LogError(f"{source}: cannot be read: {error.strerror or error}") from error
        except UnicodeDecodeError as error:
            raise LogError(f"{source}: not text in UTF-8") from error
        except csv.Error as error:
            raise LogError(f"{source} line {reader.line_num}: not valid CSV: {error}") from error
        if not records:
            raise LogError(f"{source}: the file is empty")
        self.header = [name.strip() for name in records.pop(0)]
        self.rows = records
        header_line = self.lines.pop(0)
        if not records:
            raise LogError(f"{source} line {header_line}: no rows after the header")
        for i, row in enumerate(records):
            if len(row) != len(self.header):
                raise self.error(i, f"expected {len(self.header)} cells as in the header, got {len(row)}")

    def error(self, row: int, message: str) -> LogError:
        return LogError(f"{self.source} line {self.lines[row]}: {message}")

    def require(self, name: str) -> None:
        count = self.header.count(name)
        if count != 1:
            problem = f"{count} columns are called" if count else "no column"
            raise LogError(f"{self.source} line 1: {problem} {name!r}, the header has {reprlib.repr(self.header)}")

    def names(self, column: str) -> list[str]:
        index = self.header.index(column)
        names = [row[index].strip() for row in self.rows]
        if "" in names:
            raise self.error(names.index(""), f"column {column!r} is empty")
        return names

    def numbers(self, column: str) -> Float[np.ndarray, "rows"]:
        index = self.header.index(column)
        cells = [row[index] for row in self.rows]
        try:
            values = np.fromiter(map(float, cells), dtype=np.float64, count=len(cells))
        except ValueError:
            values = np.array([math.nan])
        if np.isfinite(values).all():
            return values
        i = next(i for i, cell in enumerate(cells) if not _is_finite(cell))
        raise self.error(i, f"column {column!r}: expected a finite number, got {reprlib.repr(cells[i])}")


def _is_finite(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False
