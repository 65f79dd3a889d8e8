"""The folder of a sweep: tables from its journal as CSV and Parquet, read back for its summary and its figures.

The summary is about each point of the grid. This module does not import torch.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from rich.console import Console

from experiments.figures.style import length
from experiments.results import Columns, reading
from experiments.runs.config import SETS, SetKind
from experiments.sweeps.config import SweepConfig
from experiments.tables import table
from torchfsid.commands.results_folder import whole
from torchfsid.errors import FigureError

SIZES = ("sqrt_area", "diameter", "centroid_error")
COUNTS = ("lost_and_inconsistent", "lost_in_silence", "alarm", "inconsistent")
QUANTILES = (0.1, 0.5, 0.9)


def write_tables(out: Path, config: SweepConfig, records: list[dict[str, Any]]) -> None:
    """Write runs, series and timings of the finished runs, each file whole or not at all."""
    if not records:
        return
    tables = {
        "runs": [
            {"run": record["run"], "error": record["error"], **_varied(config, record["run"]), **record["row"]}
            for record in records
        ],
        "series": [{"run": record["run"], **row} for record in records for row in record["series"]],
        "timings": [{"run": record["run"], "seconds": record["seconds"]} for record in records],
    }
    for name, rows in tables.items():
        table = _table(rows)
        with whole(out / f"{name}.csv") as path:
            pyarrow.csv.write_csv(table, path)
        if name != "timings":
            with whole(out / f"{name}.parquet") as path:
                pyarrow.parquet.write_table(table, path)


def read_table(path: Path) -> Columns:
    """The columns of a Parquet file. Missing numbers are NaN."""
    with reading(path):
        table = pyarrow.parquet.read_table(path)
        return Columns(path, {name: table[name].to_numpy() for name in table.column_names})


def _varied(config: SweepConfig, run: int) -> dict[str, Any]:
    """The values that the grid and the drawing give this run. Lists and the like are JSON."""
    values = {**config.point(run), **config.drawn(run)}
    return {key: value if isinstance(value, int | float | str) else json.dumps(value) for key, value in values.items()}


def _table(rows: list[dict[str, Any]]) -> pa.Table:
    """A table with columns in the order in which they first appear. A failed run may lack some."""
    names = dict.fromkeys(["run", *(name for row in rows for name in row)])
    return pa.table({name: _column([row.get(name) for row in rows]) for name in names})


def _column(values: list[Any]) -> pa.Array:
    """A column of numbers, or of texts if not all values are numbers."""
    if all(value is None for value in values):
        return pa.array(values, pa.float64())
    if all(isinstance(value, int | float | None) for value in values):
        return pa.array(values)
    return pa.array([value if isinstance(value, str | None) else json.dumps(value) for value in values])


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


def summarise_sweep(folder: Path, config: SweepConfig) -> dict[str, Any]:
    """The content of summary.json. Sizes are quantiles over the robots at the last of the sweep's times."""
    swept = Swept(folder, config)
    levels = itertools.product(*(range(len(axis)) for axis in config.axes))
    return {
        "title": config.title,
        "runs": len(swept.runs["run"]),
        "failed": swept.failed,
        "keys": [", ".join(map(short, swept.telling(axis))) for axis in range(len(config.axes))],
        "points": [_point(swept, at) for at in levels],
    }


def _point(swept: Swept, at: tuple[int, ...]) -> dict[str, Any]:
    runs, series = swept.chosen(swept.runs, at), swept.chosen(swept.series, at)
    last = series["t"] == series["t"].max(initial=0.0)
    robots = int(runs["robots"].sum())
    found: dict[str, Any] = {
        "point": [", ".join(swept.labels(axis)[level]) for axis, level in enumerate(at)],
        "runs": len(runs["run"]),
        "robots": robots,
        "infeasible_steps": int(runs["infeasible_steps"].sum()),
        "relaxed_samples": int(runs["relaxed_samples"].sum()),
        "deadlocked": int(runs["deadlocked"].sum()),
        "cases": {letter: _mean(runs[f"case_{letter}"], runs["robots"]) for letter in "ABCDE"},
        "active_set_seen": _mean(runs["active_set_seen"], runs["robots"]),
    }
    for kind in swept.kinds(runs):
        lost = runs[f"{kind}_lost"]
        counts = {name: int(runs[f"{kind}_{name}"].sum()) for name in COUNTS}
        found[kind] = {"runs_lost": int((lost > 0).sum()), "lost": int(lost.sum()), **counts}
        found[kind] |= {name: _quantiles(series[f"{kind}_{name}"][last]) for name in SIZES}
    return found | {name: _quantiles(series[name][last]) for name in ("ukf_error", "hybrid_error")}


def _mean(values: np.ndarray, weights: np.ndarray) -> float | None:
    return round(float(np.average(values, weights=weights)), 4) if len(values) else None


def _quantiles(values: np.ndarray) -> list[float] | None:
    found = quantiles(values, QUANTILES)
    return None if np.isnan(found).any() else [float(f"{x:.4g}") for x in found]


def print_sweep(summary: dict[str, Any], console: Console) -> None:
    """Print for each point of the grid the robots whose set lost the truth, and medians at the end."""
    numbers = "runs", "robots", "paper's lost", "silently", "√area", "inv.-opt. lost", "√area", "UKF", "hybrid"
    texts, numbers = ([heading.replace(" ", "\n") for heading in of] for of in (summary["keys"], numbers))
    shown = table(texts, numbers)
    for point in summary["points"]:
        paper, ours = point.get("critical_region"), point["inverse_optimal"]
        cells = [str(point["runs"]), str(point["robots"]), "", "", ""]
        if paper is not None:
            cells[2:] = str(paper["lost"]), str(paper["lost_in_silence"]), _median(paper["sqrt_area"])
        cells += str(ours["lost"]), _median(ours["sqrt_area"])
        shown.add_row(*point["point"], *cells, _median(point["ukf_error"]), _median(point["hybrid_error"]))
    console.print(shown)
    if summary["failed"]:
        console.print(f"[red]{summary['failed']} runs failed: see the column error of runs.csv")


def _median(quantiles: list[float] | None) -> str:
    return "" if quantiles is None else length(quantiles[QUANTILES.index(0.5)])
