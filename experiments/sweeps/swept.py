"""The folder of a sweep, read back: all that its summary and its figures are made from. No torch in this module."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from experiments.figures.style import length
from experiments.results import Columns, reading
from experiments.sweeps.config import SweepConfig
from experiments.sweeps.tables import read_table
from torchfsid.errors import FigureError


@dataclass(frozen=True)
class Swept:
    """Columns of its tables are those of `experiments.sweeps.record`; runs that failed are left out."""

    folder: Path
    config: SweepConfig

    @cached_property
    def all_runs(self) -> Columns:
        return read_table(self.folder / "runs.parquet")

    @cached_property
    def runs(self) -> Columns:
        """Raises `FigureError` if not a single run succeeded."""
        succeeded = self.all_runs.where(error="")
        if not len(succeeded["run"]):
            raise FigureError(f"{self.folder}: every run failed, as with: {self.all_runs['error'][0]}")
        return succeeded

    @cached_property
    def failed(self) -> int:
        return len(self.all_runs["run"]) - len(self.runs["run"])

    @cached_property
    def series(self) -> Columns:
        return read_table(self.folder / "series.parquet")

    @cached_property
    def point_of(self) -> np.ndarray:
        """For each run number its point of the grid, as one index per line of the grid: (runs, lines)."""
        shape = [len(axis) for axis in self.config.axes]
        points = np.arange(self.config.runs) // self.config.repeats
        return np.stack(np.unravel_index(points, shape), axis=-1) if shape else np.zeros((len(points), 0), dtype=int)

    def chosen(self, table: Columns, levels: tuple[int, ...]) -> Columns:
        """Rows of `runs` or `series` at these entries of the first lines of the grid."""
        with reading(table.path):
            point = self.point_of[table["run"].astype(int)]
        return table.rows((point[:, : len(levels)] == levels).all(-1))

    def telling(self, axis: int) -> list[str]:
        """The first keys of a line of the grid: as many as tell its entries apart."""
        levels = self.config.axes[axis]
        keys = list(levels[0])
        for count in range(1, len(keys)):
            if len({str([level[key] for key in keys[:count]]) for level in levels}) == len(levels):
                return keys[:count]
        return keys

    def labels(self, axis: int) -> list[list[str]]:
        """The values of these keys, entry by entry."""
        keys = self.telling(axis)
        return [[_value(key, level[key]) for key in keys] for level in self.config.axes[axis]]


def quantiles(values: np.ndarray, at: Sequence[float]) -> np.ndarray:
    """Of the finite values: the others are of empty sets. NaN without any."""
    finite = values[np.isfinite(values)]
    return np.quantile(finite, at) if len(finite) else np.full(len(at), np.nan)


def short(key: str) -> str:
    """A key as people say it."""
    return key.rsplit(".", 1)[-1].replace("_", " ")


def _value(key: str, value: Any) -> str:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return str(value)
    if key.endswith("velocity"):
        return f"{length(value)}/s"
    return length(value) if key.endswith("position") else f"{value:g}"
