"""Run what is missing of a sweep, and write its tables.

Workers only compute; this process alone writes. The tables are made from the journal and sorted by run, so they are the
same, byte for byte, for any number of workers and interruptions. timings.csv alone is not.
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
    """Finish the sweep in folder `out`, and return its summary. Interrupted in whatever way, it goes on from there when
    called again. Without a `team`, this process does the work."""
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
    """Run number `run`, as the journal keeps it. A run that fails on purpose is a row with an error, not the end."""
    try:
        return {"run": run, "error": "", **observed(config.scene(run), config.times)}
    except FsidError as error:
        return {"run": run, "error": one_line(error), "row": {}, "series": [], "seconds": 0.0}
