"""Run what is missing of a sweep, on this machine's cores or on a Dask cluster, and write its tables.

    DIR/config.yaml                  the resolved sweep
    DIR/records.jsonl                a line per finished run, in the order in which they finished: the journal
    DIR/runs.csv, runs.parquet       a row per run; DIR/series.*: rows per run, time and robot (`experiments.outcome`)
    DIR/timings.csv                  how long each run took: the only table that differs from one sweep to the next

Workers only compute; this process alone writes. The tables are made from the journal and sorted by run, so they are the
same, byte for byte, for any number of workers and interruptions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import joblib

from experiments.journal import Journal
from experiments.outcome import outcome
from experiments.sweep_config import SweepConfig
from experiments.sweep_tables import write_tables
from torchfsid.documents import dump
from torchfsid.errors import ConfigError, FsidError, one_line

DASK_TIMEOUT = 10
"""To reach a scheduler [s]."""

Track = Callable[[Iterable[Any], int, int], Iterable[Any]]
"""Passes results on and shows how far they have come; the numbers are how many there are, and were there before."""


def sweep(config: SweepConfig, out: Path, *, jobs: int = 1, dask: str | None = None, track: Track) -> None:
    """Finish the sweep in folder `out`. Interrupted in whatever way, it goes on from there when called again.

    Args:
        jobs: processes on this machine; -1: one per core. dask: address of a Dask scheduler to use instead.

    Raises:
        ConfigError: the folder holds another sweep, or another process is at work there, or there is no such cluster.
    """
    out.mkdir(parents=True, exist_ok=True)
    with Journal(out / "records.jsonl") as journal:
        _claim(out / "config.yaml", dump(config))
        missing = [run for run in range(config.runs) if run not in journal.records]
        try:
            for record in track(_records(config, missing, jobs, dask), config.runs, config.runs - len(missing)):
                journal.append(record)
        finally:
            write_tables(out, config, [journal.records[run] for run in sorted(journal.records)])


def _claim(path: Path, content: str) -> None:
    if not path.exists():
        partial = path.with_suffix(".partial")
        partial.write_text(content, encoding="utf-8")
        partial.replace(path)
    elif path.read_text(encoding="utf-8") != content:
        raise ConfigError(f"{path.parent}: holds another sweep; choose another --out, or remove it")


def _records(config: SweepConfig, runs: list[int], jobs: int, dask: str | None) -> Iterator[dict[str, Any]]:
    """One record per run, as they finish."""
    with _backend(dask):
        # joblib's annotation of batch_size says str; with "auto" runs would be lost in bunches.
        parallel: Any = joblib.Parallel(n_jobs=jobs, batch_size=1, return_as="generator_unordered")  # type: ignore[arg-type]
        yield from parallel(joblib.delayed(record)(config, run) for run in runs)


@contextmanager
def _backend(dask: str | None) -> Iterator[None]:
    if dask is None:
        yield
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigError("--dask: install torchfsid[dask]") from error
    try:
        client = Client(dask, timeout=DASK_TIMEOUT)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--dask {dask}: {one_line(error)}") from error
    with client, joblib.parallel_config(backend="dask", client=client):
        yield


def record(config: SweepConfig, run: int) -> dict[str, Any]:
    """Run number `run`, as the journal keeps it. A run that fails on purpose is a row with an error, not the end."""
    try:
        found = outcome(config.scene(run), config.times)
    except FsidError as error:
        return {"run": run, "error": one_line(error), "row": {}, "series": [], "seconds": 0.0}
    return {"run": run, "error": "", "row": found.row, "series": found.series, "seconds": round(found.seconds, 3)}
