"""The folder of a sweep, read back for its summary and its figures. This module does not import torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from experiments.figures.style import length
from experiments.results import Columns, reading
from experiments.runs.config import SETS, SetKind
from experiments.sweeps.config import SweepConfig
from experiments.sweeps.tables import read_table
from torchfsid.errors import FigureError


@dataclass(frozen=True)
class Swept:
    """The tables of a sweep, with the columns of `experiments.sweeps.record`. Failed runs are left out."""

    folder: Path
    config: SweepConfig

    @cached_property
    def all_runs(self) -> Columns:
        """All finished runs, the failed ones included."""
        return read_table(self.folder / "runs.parquet")

    @cached_property
    def runs(self) -> Columns:
        """The runs that succeeded.

        Raises:
            FigureError: every run failed.
        """
        succeeded = self.all_runs.where(error="")
        if not len(succeeded["run"]):
            raise FigureError(f"{self.folder}: every run failed, as with: {self.all_runs['error'][0]}")
        return succeeded

    @cached_property
    def failed(self) -> int:
        """The number of failed runs."""
        return len(self.all_runs["run"]) - len(self.runs["run"])

    @cached_property
    def series(self) -> Columns:
        """Sizes and errors over time."""
        return read_table(self.folder / "series.parquet")

    @cached_property
    def point_of(self) -> np.ndarray:
        """The point of the grid of each run, as one index per axis: (runs, axes)."""
        shape = [len(axis) for axis in self.config.axes]
        points = np.arange(self.config.runs) // self.config.repeats
        return np.stack(np.unravel_index(points, shape), axis=-1) if shape else np.zeros((len(points), 0), dtype=int)

    def chosen(self, table: Columns, levels: tuple[int, ...]) -> Columns:
        """Table rows of `runs` or `series` at these entries of the first axes."""
        with reading(table.path):
            point = self.point_of[table["run"].astype(int)]
        return table.rows((point[:, : len(levels)] == levels).all(-1))

    @staticmethod
    def kinds(runs: Columns) -> list[SetKind]:
        """The kinds of set that these rows of `runs` have."""
        return [kind for kind in SETS if f"{kind}_lost" in runs and np.isfinite(runs[f"{kind}_lost"]).all()]

    def telling(self, axis: int) -> list[str]:
        """The first keys of an axis, as many as distinguish its entries."""
        levels = self.config.axes[axis]
        keys = list(levels[0])
        for count in range(1, len(keys)):
            if len({str([level[key] for key in keys[:count]]) for level in levels}) == len(levels):
                return keys[:count]
        return keys

    def labels(self, axis: int) -> list[list[str]]:
        """The values of the keys `telling(axis)`, for each entry of the axis."""
        keys = self.telling(axis)
        return [[_value(key, level[key]) for key in keys] for level in self.config.axes[axis]]


def quantiles(values: np.ndarray, at: Sequence[float]) -> np.ndarray:
    """Quantiles of the finite values. The others belong to empty sets. NaN if no value is finite."""
    finite = values[np.isfinite(values)]
    return np.quantile(finite, at) if len(finite) else np.full(len(at), np.nan)


def short(key: str) -> str:
    """The last part of a key, with spaces."""
    return key.rsplit(".", 1)[-1].replace("_", " ")


def _value(key: str, value: Any) -> str:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return str(value)
    if key.endswith("velocity"):
        return f"{length(value)}/s"
    if key.endswith("acceleration"):
        return f"{length(value)}/s2"
    return length(value) if key.endswith("position") else f"{value:g}"
