"""The folder of a sweep, read back: all that its summary and its figures are made from. No torch in this module."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from experiments.figures.style import length
from experiments.sweeps.config import SweepConfig, load_sweep
from experiments.sweeps.tables import read_table


@dataclass(frozen=True)
class Swept:
    """Columns of its tables are those of `experiments.sweeps.record`; runs that failed are left out."""

    folder: Path

    @cached_property
    def config(self) -> SweepConfig:
        return load_sweep(self.folder / "config.yaml")

    @cached_property
    def runs(self) -> dict[str, np.ndarray]:
        table = read_table(self.folder / "runs.parquet")
        return {name: column[table["error"] == ""] for name, column in table.items()}

    @cached_property
    def failed(self) -> int:
        return int((read_table(self.folder / "runs.parquet")["error"] != "").sum())

    @cached_property
    def series(self) -> dict[str, np.ndarray]:
        return read_table(self.folder / "series.parquet")

    @cached_property
    def point_of(self) -> np.ndarray:
        """For each run number its point of the grid, as one index per line of the grid: (runs, lines)."""
        shape = [len(axis) for axis in self.config.axes]
        points = np.arange(self.config.runs) // self.config.repeats
        return np.stack(np.unravel_index(points, shape), axis=-1) if shape else np.zeros((len(points), 0), dtype=int)

    def chosen(self, table: dict[str, np.ndarray], levels: tuple[int | None, ...]) -> dict[str, np.ndarray]:
        """Rows of `runs` or `series` at these entries of the first lines of the grid; None: at any."""
        point = self.point_of[table["run"]]
        rows = np.ones(len(point), dtype=bool)
        for axis, level in enumerate(levels):
            if level is not None:
                rows &= point[:, axis] == level
        return {name: column[rows] for name, column in table.items()}

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


def short(key: str) -> str:
    """A key as people say it."""
    return key.rsplit(".", 1)[-1].replace("_", " ")


def _value(key: str, value: Any) -> str:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return str(value)
    if key.endswith("velocity"):
        return f"{length(value)}/s"
    return length(value) if key.endswith("position") else f"{value:g}"
