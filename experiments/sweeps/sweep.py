"""Run what is missing of a sweep, on this machine's cores or on a Dask cluster, and write its tables.

    DIR/config.yaml                  the resolved sweep
    DIR/records.jsonl                a line per finished run, in the order in which they finished: the journal
    DIR/runs.csv, runs.parquet       a row per run; DIR/series.*: rows per run, time and robot (`experiments.sweeps.record`)
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

from experiments.sweeps.config import SweepConfig
from experiments.sweeps.journal import Journal
from experiments.sweeps.record import outcome
from experiments.sweeps.tables import write_tables
from torchfsid.config.documents import dump
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
    with _workers(jobs, dask) as workers, _journal(out) as journal:
        _claim(out / "config.yaml", dump(config))
        missing = [run for run in range(config.runs) if run not in journal.records]
        try:
            for done in track(
                workers(joblib.delayed(record)(config, run) for run in missing), config.runs, config.runs - len(missing)
            ):
                journal.append(done)
        finally:
            write_tables(out, config, [journal.records[run] for run in sorted(journal.records)])


def _claim(path: Path, content: str) -> None:
    if not path.exists():
        partial = path.with_suffix(".partial")
        partial.write_text(content, encoding="utf-8")
        partial.replace(path)
    elif path.read_text(encoding="utf-8") != content:
        raise ConfigError(f"{path.parent}: holds another sweep; choose another --out, or remove it")


def _journal(out: Path) -> Journal:
    out.mkdir(parents=True, exist_ok=True)
    return Journal(out / "records.jsonl")


@contextmanager
def _workers(jobs: int, dask: str | None) -> Iterator[Any]:
    """Call it with tasks: results come as they finish."""
    if dask is None:
        yield _parallel(jobs)
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
        yield _parallel(jobs)


def _parallel(jobs: int) -> Any:
    # In larger batches, finished runs would wait for others and be lost with them. (joblib annotates it as a text.)
    return joblib.Parallel(n_jobs=jobs, batch_size=1, return_as="generator_unordered")  # type: ignore[arg-type]


def record(config: SweepConfig, run: int) -> dict[str, Any]:
    """Run number `run`, as the journal keeps it. A run that fails on purpose is a row with an error, not the end."""
    try:
        found = outcome(config.scene(run), config.times)
    except FsidError as error:
        return {"run": run, "error": one_line(error), "row": {}, "series": [], "seconds": 0.0}
    return {"run": run, "error": "", "row": found.row, "series": found.series, "seconds": round(found.seconds, 3)}
