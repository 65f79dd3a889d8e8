"""Observe a recording into a results folder: estimates.csv, regions.json and regions.jsonl."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from experiments.kinds import Track
from experiments.results import Appender
from experiments.runs.config import ExperimentConfig
from experiments.runs.observers import Observers
from experiments.runs.recording import Recording
from experiments.runs.tally import Tally
from torchfsid.commands.results import ResultsWriter
from torchfsid.commands.safety_results import without_repeats
from torchfsid.observers.set_membership import SetEstimate
from torchfsid.programmes.differentiable import times
from torchfsid.robots.barriers import stack_barriers
from torchfsid.robots.measurement import Measurement


def observe(config: ExperimentConfig, recording: Recording, out: Path, track: Track) -> tuple[Observers, Tally]:
    """Observe the recording and write the files. A sample is on disk before the next one is observed."""
    observers = Observers(config, recording.task, recording.barriers, len(recording.robots))
    tally = Tally.before(config, recording.goals)
    first, *others = observers.sets
    alongside = {kind: observers.sets[kind] for kind in others}
    with (
        ResultsWriter(out, recording.robots, observers.sets[first], alongside, recording.labels) as results,
        Appender(out / "regions.jsonl") as regions,
    ):
        for measurement in track(recording.measurements, "Observing", recording.samples):
            estimate, sets = observers.update(measurement)
            tally.update(estimate, sets, config.dt)
            results.write(measurement, estimate, {kind: sets[kind] for kind in others})
            regions.append("".join(json.dumps(line) + "\n" for line in _regions(recording, measurement, sets)))
    return observers, tally


def _regions(recording: Recording, measurement: Measurement, sets: dict[str, SetEstimate]) -> Iterator[dict[str, Any]]:
    assert measurement.u is not None
    rows = stack_barriers(recording.barriers, measurement).normalised()
    real = (rows.A != 0).any(-1)
    active = next(iter(sets.values())).kkt.active
    C, d = recording.task(measurement)
    nominal = times(C, recording.goals) + d
    vertices = {kind: estimate.feasible_set.vertices() for kind, estimate in sets.items()}
    for i, robot in enumerate(recording.robots):
        yield {
            "t": measurement.t,
            "robot": robot,
            "x": measurement.x[i].tolist(),
            "u": measurement.u[i].tolist(),
            "nominal": nominal[i].tolist(),
            "active": [recording.labels[j].removeprefix("avoid ") for j in active[i].nonzero().flatten().tolist()],
            "rows": torch.cat([rows.A[i], rows.b[i].unsqueeze(-1)], dim=-1)[real[i]].tolist(),
            **{kind: _vertices(of_kind[i]) for kind, of_kind in vertices.items()},
        }


def _vertices(padded: Float[Tensor, "V 2"]) -> list[list[float]]:
    return without_repeats(padded).tolist() if padded.isfinite().all() else []
