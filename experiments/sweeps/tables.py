"""The tables of a sweep: written from its journal as CSV and Parquet, and read back. No import of torch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from experiments.results import Columns, reading
from experiments.sweeps.config import SweepConfig
from torchfsid.commands.results_folder import whole


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
