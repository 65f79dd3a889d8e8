"""Run the missing runs of a sweep, and write its tables.

Workers only compute, and only this process writes. Consecutive runs go to a worker together, which simulates and
observes those that are alike as one batch. The configuration alone decides which ones, and a part with a missing run is
run again as a whole. The tables are made from the journal and sorted by run. So they are identical for any number of
workers and interruptions, except timings.csv.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from experiments.kinds import Track
from experiments.results import Journal
from experiments.runs.batch import likeness
from experiments.runs.config import SceneConfig
from experiments.sweeps.config import SweepConfig
from experiments.sweeps.record import most_alike, observed
from experiments.sweeps.swept import summarise_sweep, write_tables
from experiments.sweeps.workers import Workers, workers
from torchfsid.errors import FsidError, one_line

LARGEST_PART, PARTS = 64, 16
"""Most runs of a part, and least number of parts while these have more than one run: for several workers."""

Record = dict[str, Any]


def run_sweep(config: SweepConfig, out: Path, track: Track, team: Workers | None = None) -> dict[str, Any]:
    """Finish the sweep in the folder `out`, and return its summary.

    After an interruption a second call goes on with the missing runs. Without a `team` this process does the work.
    """
    with Journal(out / "records.jsonl") as journal, workers() as alone:
        calls = ((config, part) for part in parts(config.runs) if not journal.records.keys() >= {*part})
        finished = len(journal.records)
        try:
            done = _written(journal, (team or alone)(records, calls))
            for _ in track(done, "Sweeping", config.runs, finished):
                pass
        finally:
            write_tables(out, config, [journal.records[run] for run in sorted(journal.records)])
    return summarise_sweep(out, config)


def parts(runs: int) -> list[range]:
    """Consecutive runs that a worker does together."""
    size = min(LARGEST_PART, max(1, runs // PARTS))
    return [range(first, min(first + size, runs)) for first in range(0, runs, size)]


def _written(journal: Journal, found: Iterable[list[Record]]) -> Iterator[Record]:
    """The records that are new, which are then in the journal."""
    for of_part in found:
        new = [record for record in of_part if record["run"] not in journal.records]
        journal.add(new)
        yield from new


def records(config: SweepConfig, runs: Iterable[int]) -> list[Record]:
    """The records of runs for the journal. A run that fails becomes a record with an error, and the sweep goes on."""
    found, batches = [], defaultdict(dict)
    for run in runs:
        try:
            scene = config.scene(run)
        except FsidError as error:
            found.append(_failed(run, error))
        else:
            alike = likeness(scene)
            batches[run if alike is None else alike][run] = scene
    for batch in batches.values():
        of_batch, most = list(batch.items()), min(map(most_alike, batch.values()))
        for first in range(0, len(of_batch), most):
            found += _observed(config, dict(of_batch[first : first + most]))
    return found


def _observed(config: SweepConfig, scenes: dict[int, SceneConfig]) -> list[Record]:
    try:
        found: Sequence[Record] = observed(list(scenes.values()), config.times)
    except FsidError as error:
        if len(scenes) == 1:
            return [_failed(run, error) for run in scenes]
        return [record for run, scene in scenes.items() for record in _observed(config, {run: scene})]
    return [{"run": run, "error": "", **record} for run, record in zip(scenes, found, strict=True)]


def _failed(run: int, error: FsidError) -> Record:
    return {"run": run, "error": one_line(error), "row": {}, "series": [], "seconds": 0.0}
