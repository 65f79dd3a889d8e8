"""Run the missing runs of a sweep, and write its tables.

Workers only compute, and only this process writes. The tables are made from the journal and sorted by run. So they are
identical for any number of workers and interruptions, except timings.csv.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from experiments.kinds import Track
from experiments.sweeps.config import SweepConfig
from experiments.sweeps.journal import Journal
from experiments.sweeps.record import observed
from experiments.sweeps.summary import summarise_sweep
from experiments.sweeps.tables import write_tables
from experiments.sweeps.workers import Workers, workers
from torchfsid.errors import FsidError, one_line


def run_sweep(config: SweepConfig, out: Path, track: Track, team: Workers | None = None) -> dict[str, Any]:
    """Finish the sweep in the folder `out`, and return its summary.

    After an interruption a second call goes on with the missing runs. Without a `team` this process does the work.
    """
    with Journal(out / "records.jsonl") as journal, workers() as alone:
        missing = [run for run in range(config.runs) if run not in journal.records]
        finished = config.runs - len(missing)
        try:
            calls = ((config, run) for run in missing)
            for done in track((team or alone)(record, calls), "Sweeping", config.runs, finished):
                journal.add(done)
        finally:
            write_tables(out, config, [journal.records[run] for run in sorted(journal.records)])
    return summarise_sweep(out, config)


def record(config: SweepConfig, run: int) -> dict[str, Any]:
    """The record of one run for the journal. A run that fails becomes a record with an error, and the sweep goes on."""
    try:
        return {"run": run, "error": "", **observed(config.scene(run), config.times)}
    except FsidError as error:
        return {"run": run, "error": one_line(error), "row": {}, "series": [], "seconds": 0.0}
