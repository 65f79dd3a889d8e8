"""The columns of a table of a log: times, vectors with bounds on the errors of each row, radii."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from torchfsid.logs.tables import Table

LONGEST_STEP = 1e4
"""Median time between samples above which times are in another unit [s]: nobody records a motion every three hours, and
stamps in nanoseconds of up to 100 kHz, or in microseconds of up to 100 Hz, are further apart than this."""


class Quantity(NamedTuple):
    """One vector in each table row.

    Attributes:
        values: the vectors. Zero where they are unknown.
        known: the cells are not empty.
        error: bounds on the lengths of their errors: the column `<quantity>_error`, and the rounding.
        rounding: the largest part of these bounds that comes from rounding.
    """

    values: Float[np.ndarray, "rows n"]
    known: Bool[np.ndarray, "rows"]
    error: Float[np.ndarray, "rows"]
    rounding: float

    def equal(self, first: Int[np.ndarray, "k"], second: Int[np.ndarray, "k"]) -> Bool[np.ndarray, "k"]:
        """Do these rows say the same?"""
        same = (self.values[first] == self.values[second]).all(axis=1) & (self.error[first] == self.error[second])
        return same & (self.known[first] == self.known[second])


def times_in(table: Table) -> Float[np.ndarray, "rows"]:
    """The column `t`, as it stands in the table.

    Raises:
        LogError: times decrease, are all the same, or are not in seconds.
    """
    t = table.numbers("t")
    steps = np.diff(t)
    if (steps < 0).any():
        i = int(np.argmax(steps < 0))
        raise table.error(i + 1, f"times must not decrease, got {t[i + 1]} after {t[i]}")
    if not (steps > 0).any():
        raise table.error(len(t) - 1, f"the log ends after a single time, t = {t[0]}")
    step = float(np.median(steps[steps > 0]))
    if step > LONGEST_STEP:
        raise table.header_error(f"column 't': the median step is {step:g} s; stamps in nanoseconds? Expected seconds")
    return t


def heading_in(table: Table, column: str | None) -> dict[str, list[str]]:
    """The quantity `heading` and its column [rad], if it is wanted.

    Raises:
        LogError: there is no such column.
    """
    if column is None:
        return {}
    if table.header.count(column) != 1:
        raise table.header_error(f"body.heading: no single {column!r} in the header {reprlib.repr(table.header)}")
    return {"heading": [column]}


def radii_in(table: Table, names: Sequence[str], body: Int[np.ndarray, "rows"]) -> Float[np.ndarray, "bodies"]:
    """The column `radius`, one number for each body.

    Args:
        table: the table.
        names: the body of each table row.
        body: its index.

    Raises:
        LogError: a radius is negative, or changes.
    """
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


def repeats_in(
    place: Int[np.ndarray, "rows"], quantities: Mapping[str, Quantity]
) -> tuple[Int[np.ndarray, "k"], Bool[np.ndarray, "k"]]:
    """The table rows that have the same place as an earlier one, and whether they say the same."""
    order = np.argsort(place, kind="stable")
    repeats = np.flatnonzero(np.diff(place[order]) == 0)
    first, again = order[repeats], order[repeats + 1]
    return again, np.all([quantity.equal(first, again) for quantity in quantities.values()], axis=0)


def quantities_in(table: Table, columns: Mapping[str, Sequence[str]]) -> dict[str, Quantity]:
    """The quantities in a table, each with its columns, one per axis. Those that are nowhere known are left out.

    Raises:
        LogError: a cell is not a number, some cells of a vector are empty and others are not, a bound is negative, or
            there are bounds for a quantity that the table does not have.
    """
    for name, of_axes in columns.items():
        if not of_axes and f"{name}_error" in table.header:
            raise table.header_error(f"column '{name}_error' without a {name}")
    found = {name: _quantity(table, name, of_axes) for name, of_axes in columns.items() if of_axes}
    return {name: quantity for name, quantity in found.items() if quantity.known.any()}


def _quantity(table: Table, name: str, columns: Sequence[str]) -> Quantity:
    may_be_empty = name != "position"
    cells = np.stack([table.numbers(column, may_be_empty) for column in columns], axis=-1)
    empty = np.isnan(cells)
    known = np.logical_not(empty.any(axis=1))
    torn = empty.any(axis=1) & ~empty.all(axis=1)
    if torn.any():
        i = int(np.argmax(torn))
        column = columns[int(np.argmax(empty[i]))]
        raise table.error(i, f"column {column!r} is empty, and other columns of this {name} are not")
    rounding = np.where(known, np.linalg.norm(table.rounding(columns, cells), axis=-1), 0.0)
    declared = np.zeros(len(cells))
    if (column := f"{name}_error") in table.header:
        given = table.numbers(column, may_be_empty)
        wrong = known & ~(given >= 0)
        if wrong.any():
            i = int(np.argmax(wrong))
            got = "nothing" if np.isnan(given[i]) else given[i]
            raise table.error(i, f"column {column!r}: expected a bound >= 0, got {got}")
        declared = np.where(known, given, 0.0)
    return Quantity(np.where(known[:, None], cells, 0.0), known, declared + rounding, float(rounding.max()))
