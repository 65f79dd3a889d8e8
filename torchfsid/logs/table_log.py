"""Logs in tables (CSV, Parquet).

A table has one table row per body and time. The table rows of one time stand together, and times increase. Other
columns are ignored.

    t, robot, x, y[, z][, vx, vy[, vz]][, ax, ay[, az]][, radius]          [s], a name, [m], [m/s], [m/s2], [m]
    [, position_error][, velocity_error][, acceleration_error]     bounds on the errors of this row, in the same units

Headings of unicycles [rad] are in a column of any name, and empty for other bodies. Where the cells of a velocity or an
acceleration are empty, it is unknown. A table row that repeats another one exactly is left out. Numbers that were
rounded when the log was written are wrong by up to half a unit per axis, which is added to the bounds.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchfsid.logs.large_csv import csv_table
from torchfsid.logs.log import Log
from torchfsid.logs.quantities import heading_in, quantities_in, radii_in, repeats_in, times_in
from torchfsid.logs.reading import UNITS, Reading
from torchfsid.logs.tables import ParquetTable, Table, require_column
from torchfsid.logs.units import require_units


def read_csv(path: str | Path, heading: str | None = None) -> Log:
    """The log in a CSV file (UTF-8, one header line).

    Args:
        path: the file.
        heading: the column of headings, if they are wanted.

    Raises:
        LogError: the file cannot be read, or is not such a log. The message names the line and the column.
    """
    return _log_in(csv_table(str(path)), heading)


def read_parquet(path: str | Path, heading: str | None = None) -> Log:
    """The log in a Parquet file with the same columns. Needs the extra `parquet`.

    Args:
        path: the file.
        heading: the column of headings, if they are wanted.

    Raises:
        LogError: the file cannot be read, or is not such a log. The message names the table row and the column.
    """
    return _log_in(ParquetTable(str(path)), heading)


def _log_in(table: Table, heading: str | None) -> Log:
    axes = [axis for axis in "xyz" if axis in "xy" or axis in table.header]
    velocities = [f"v{axis}" for axis in "xyz" if f"v{axis}" in table.header]
    accelerations = [f"a{axis}" for axis in axes]
    accelerations = accelerations if set(accelerations) <= set(table.header) else []
    errors = [f"{name}_error" for name in UNITS if f"{name}_error" in table.header]
    velocities = [f"v{axis}" for axis in axes] if velocities else []
    for name in ["t", "robot", *axes, *velocities, *accelerations, *errors]:
        require_column(table, name)
    if "z" not in axes and "vz" in table.header:
        raise table.header_error("column 'vz' without 'z'")

    t = times_in(table)
    time = np.concatenate([[0], np.cumsum(np.diff(t) > 0)])
    names = table.names("robot")
    bodies = tuple(dict.fromkeys(names))
    slot = {name: j for j, name in enumerate(bodies)}
    body = np.fromiter((slot[name] for name in names), dtype=np.int64, count=len(names))
    columns = {"position": axes, "velocity": velocities, "acceleration": accelerations, **heading_in(table, heading)}
    quantities = quantities_in(table, columns)
    place = time * len(bodies) + body
    repeats, same = repeats_in(place, quantities)
    if not same.all():
        i = int(repeats[~same].min())
        raise table.error(i, f"robot {names[i]!r} has another row at t = {t[i]}")

    def by_time_and_body(of_rows: np.ndarray) -> np.ndarray:
        values = np.zeros((time[-1] + 1, len(bodies), *of_rows.shape[1:]), dtype=of_rows.dtype)
        values[time, body] = of_rows
        return values

    def bounds(quantity: str) -> np.ndarray | None:
        found = quantities.get(quantity)
        return None if found is None or not found.error.any() else by_time_and_body(found.error)

    positions, u, a, turned = (quantities.get(quantity) for quantity in [*UNITS, "heading"])
    assert positions is not None
    seen = by_time_and_body(positions.known)
    log = Log(
        source=table.source,
        bodies=bodies,
        t=np.unique(t),
        x=by_time_and_body(positions.values),
        u=None if u is None else by_time_and_body(u.values),
        seen=seen,
        velocity_known=np.zeros_like(seen) if u is None else by_time_and_body(u.known),
        radius=radii_in(table, names, body) if "radius" in table.header else None,
        position_error=bounds("position"),
        velocity_error=bounds("velocity"),
        a=None if a is None else by_time_and_body(a.values),
        acceleration_known=None if a is None else by_time_and_body(a.known),
        acceleration_error=bounds("acceleration"),
        heading=None if turned is None else by_time_and_body(turned.values[:, 0]),
        oriented=None if turned is None else by_time_and_body(turned.known),
        reading=Reading(
            rounding={name: of.rounding for name, of in quantities.items() if of.rounding > 0}, duplicates=len(repeats)
        ),
    )
    require_units(log)
    return log
