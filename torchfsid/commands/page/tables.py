"""Tables of a results folder as columns of texts, and numbers rounded for the page."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchfsid.errors import FigureError, one_line

Rounded = list[Any]


class Table:
    """The columns of a CSV file, as texts.

    Raises:
        FigureError: the file is missing or damaged.
    """

    def __init__(self, path: Path):
        self.path = path
        try:
            with path.open(newline="", encoding="utf-8") as file:
                self.header, *rows = csv.reader(file, strict=True)
            columns = zip(*rows, strict=True) if rows else ([] for _ in self.header)
            self.columns = dict(zip(self.header, columns, strict=True))
        except (OSError, ValueError, csv.Error) as error:
            raise FigureError(f"{path}: missing or damaged: {one_line(error)}") from error
        self.rows = len(rows)

    def texts(self, name: str) -> Sequence[str]:
        """A column.

        Raises:
            FigureError: there is none of this name.
        """
        if name not in self.columns:
            raise FigureError(f"{self.path}: is damaged: it has no column {name!r}")
        return self.columns[name]

    def numbers(self, *names: str) -> np.ndarray:
        """Columns as numbers, (rows, names). Empty cells are NaN.

        Raises:
            FigureError: there is none of this name, or a cell is no number.
        """
        try:
            columns = [[float(text or "nan") for text in self.texts(name)] for name in names]
        except ValueError as error:
            raise FigureError(f"{self.path}: is damaged: {one_line(error)}") from error
        return np.array(columns, dtype=float).reshape(len(names), self.rows).T

    def indexed(self, name: str) -> list[str]:
        """The names of the columns name_0, name_1, ..., in order."""
        names = []
        while f"{name}_{len(names)}" in self.columns:
            names.append(f"{name}_{len(names)}")
        return names


def rounded(values: np.ndarray, resolution: float) -> Rounded:
    """The values as nested lists, rounded to about this resolution or finer. NaN and infinities are None."""
    digits = 0 if resolution <= 0 or not math.isfinite(resolution) else max(0, math.ceil(-math.log10(resolution)))
    return _finite(np.round(values, digits).tolist())


def significant(values: Iterable[float], digits: int = 5) -> Rounded:
    """The values with so many significant digits. NaN and infinities are None."""
    return [float(f"{value:.{digits}g}") if math.isfinite(value) else None for value in values]


def _finite(values: Any) -> Any:
    if isinstance(values, list):
        return [_finite(value) for value in values]
    return values if math.isfinite(values) else None


def thinned(count: int, most: int, always: Iterable[int] = ()) -> np.ndarray:
    """Indices of at most `most` of `count` items, evenly, with the first and the last one, and those of `always`."""
    evenly = np.round(np.linspace(0, count - 1, min(count, max(most, 2)))).astype(int)
    return np.unique(np.concatenate([evenly, np.fromiter(always, dtype=int)]))
