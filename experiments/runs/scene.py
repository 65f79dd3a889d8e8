"""One run: from a validated configuration to a results folder. Figures are drawn later, from what stands in it.

Beside the files of every results folder (`torchfsid.results`) a run leaves

    regions.jsonl    a line per time and robot: its rows, controls and active rows, the vertices of both kinds of set
    trajectory.csv   of a scene: what was measured of every body, as a log that `torchfsid observe` reads
    cases.csv        of constructed cases: Table I, measured
    summary.json     what the run shows
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from experiments.runs.cases import record_cases
from experiments.runs.config import CasesConfig, RunConfig, SwarmConfig
from experiments.runs.observers import Observers
from experiments.runs.recording import Recording, simulate_scene
from experiments.runs.saved import Results
from experiments.runs.summary import summarise_scene
from experiments.runs.swarm import run_swarm
from experiments.runs.table import measure_cases
from torchfsid.commands.results import ResultsWriter, write_json
from torchfsid.config.documents import dump
from torchfsid.observers.set_membership import SetEstimate
from torchfsid.robots.barriers import stack_barriers
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Trajectory

Track = Callable[[Iterable[Measurement], int], Iterable[Measurement]]
"""Passes measurements on and shows how far they have come; the number is how many there are."""


def run(config: RunConfig, out: Path, track: Track) -> dict[str, Any]:
    """Simulate, observe, and write everything but the figures; returns the summary."""
    if isinstance(config, SwarmConfig):
        return run_swarm(config, out, track)
    if isinstance(config, CasesConfig):
        observers = Observers(config, record_cases(config))
        _observe(observers, out, track)
        summary = measure_cases(Results(out), observers)
        _write_rows(out / "cases.csv", summary["cases"])
    else:
        scene = simulate_scene(config)
        observers = Observers(config, scene.recording())
        _observe(observers, out, track)
        write_trajectory(out / "trajectory.csv", config.bodies, scene.measured)
        summary = summarise_scene(Results(out), observers, scene.true)
    write_json(out / "summary.json", summary)
    return summary


def _observe(observers: Observers, out: Path, track: Track) -> None:
    """Writes estimates.csv, regions.jsonl, regions.json and config.yaml."""
    recording, config = observers.recording, observers.config
    first, *others = observers.sets
    alongside = {kind: observers.sets[kind] for kind in others}
    with (
        ResultsWriter(out, recording.robots, observers.sets[first], alongside) as results,
        (out / "regions.jsonl").open("w", encoding="utf-8") as regions,
    ):
        (out / "config.yaml").write_text(dump(config), encoding="utf-8")
        for measurement in track(recording.measurements, recording.samples):
            estimate, sets = observers.update(measurement)
            results.write(measurement, estimate, {kind: sets[kind] for kind in others})
            regions.writelines(json.dumps(line) + "\n" for line in _regions(recording, measurement, sets))


def _regions(recording: Recording, measurement: Measurement, sets: dict[str, SetEstimate]) -> Iterable[dict[str, Any]]:
    assert measurement.u is not None
    rows = stack_barriers(recording.barriers, measurement).normalised()
    real = (rows.A != 0).any(-1)
    active = next(iter(sets.values())).kkt.active
    C, d = recording.task(measurement)
    nominal = (C @ recording.goals.unsqueeze(-1)).squeeze(-1) + d
    vertices = {kind: estimate.feasible_set.vertices() for kind, estimate in sets.items()}
    for i, robot in enumerate(recording.robots):
        yield {
            "t": measurement.t,
            "robot": robot,
            "x": measurement.x[i].tolist(),
            "u": measurement.u[i].tolist(),
            "nominal": nominal[i].tolist(),
            "active": [recording.row_names[j] for j in active[i].nonzero().flatten().tolist()],
            "rows": torch.cat([rows.A[i], rows.b[i].unsqueeze(-1)], dim=-1)[real[i]].tolist(),
            **{kind: _distinct(of_kind[i]).tolist() for kind, of_kind in vertices.items()},
        }


def _distinct(vertices: Tensor) -> Tensor:
    """Padding repeats the first vertex at the end."""
    padding = (vertices == vertices[0]).all(-1)
    padding[0] = False
    return vertices[~padding]


def write_trajectory(path: Path, bodies: list[str], measured: Trajectory) -> None:
    """All digits, so that an observer of the log sees what the observers of the run saw."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "robot", "x", "y", "vx", "vy"])
        for t, x, u in zip(measured.t.tolist(), measured.x.tolist(), measured.u.tolist(), strict=True):
            writer.writerows([t, body, *x[j], *u[j]] for j, body in enumerate(bodies))


def _write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
