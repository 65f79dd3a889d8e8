"""A swarm in closed loop, observed as it moves. Neither the trajectory nor past sets are kept.

Every robot avoids its nearest neighbours within the sensing radius, and the observer sees each robot among these
bodies. The observer does not assume that the robots ignore all others. A sample is not used if the row of a body left
out might have been active (`torchfsid.neighbours`).

estimates.csv has the robots at the snapshots only, to keep it small.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from experiments.kinds import Track
from experiments.results import RowWriter
from experiments.runs.errors import in_disc
from experiments.runs.observe import build_sets
from experiments.runs.swarm_config import SwarmConfig
from torchfsid.commands.results import STATUS_NAMES, ResultsWriter
from torchfsid.identification.kkt import CASES
from torchfsid.observers.set_membership import SetEstimate
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.neighbours import nearest_bodies
from torchfsid.robots.simulation import Sample, closed_loop

QUANTILES = (0.1, 0.5, 0.9, 1.0)


def run_swarm(config: SwarmConfig, out: Path, track: Track) -> dict[str, Any]:
    """Simulate, observe, and return the summary."""
    began = time.perf_counter()
    placing, measuring = map(np.random.default_rng, np.random.SeedSequence(config.seed).spawn(2))
    starts, goals = place(config, placing)
    task = config.task.build([], config.dimension)
    controller = CbfQpController(task, [barrier.build([]) for barrier in config.barriers])
    observer = build_sets(config, config.set, controller.task, controller.barriers, config.robots)
    lost, infeasible, closest = torch.zeros(config.robots, dtype=torch.bool), 0, float("inf")
    shown = {round(t / config.dt) for t in config.snapshots}
    loop, total = measurements(config, controller, starts, goals, measuring), config.steps + 1
    with (
        ResultsWriter(out, [str(i) for i in range(config.robots)], observer) as estimates,
        RowWriter(out / "sizes.csv") as sizes,
        RowWriter(out / "snapshots.csv") as snapshots,
    ):
        for k, (measurement, sample) in enumerate(track(loop, "Observing", total)):
            estimate = observer.update(measurement)
            lost |= ~estimate.feasible_set.contains(goals)
            infeasible += int((~sample.control.feasible).sum())
            away = (measurement.bodies - measurement.x.unsqueeze(-2)).norm(dim=-1)
            closest = min(closest, float(torch.where(measurement.present, away, torch.inf).min()))
            size = estimate.feasible_set.volume().sqrt()
            quantiles = torch.quantile(size, torch.tensor(QUANTILES, dtype=torch.float64)).tolist()
            shares = {"lost": float(lost.double().mean()), "still": float(sample.still.double().mean())}
            of_sizes = {f"sqrt_area_{q:g}": value for q, value in zip(QUANTILES, quantiles, strict=True)}
            sizes.write([_rounded({"t": measurement.t, **of_sizes, **shares, "memory_mib": memory_mib()})])
            if k in shown:
                estimates.write(measurement, estimate)
                snapshots.write(_snapshot(measurement, estimate, size, goals))
    status = observer.status.tolist()
    return {
        "title": config.title,
        "robots": config.robots,
        "steps": config.steps,
        "truth_outside": int(lost.sum()),
        "status": {name: status.count(value) for value, name in STATUS_NAMES.items()},
        "samples_not_used": int(observer.skipped.sum()),
        "sqrt_area": dict(zip(map(str, QUANTILES), quantiles, strict=True)),
        "still": int(sample.still.sum()),
        "infeasible_steps": infeasible,
        "closest": closest,
        "seconds": round(time.perf_counter() - began, 1),
        "peak_memory_mib": memory_mib(),
    }


def place(config: SwarmConfig, random: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Starts, each in its own cell of a grid, and goals [m]."""
    cells = np.arange(config.robots)
    columns = round(config.side / config.spacing)
    centres = (np.stack([cells % columns, cells // columns], axis=-1) + 0.5) * config.spacing - config.side / 2
    room = (config.spacing - config.separation) / 2
    starts = torch.from_numpy(centres + random.uniform(-room, room, size=centres.shape))
    goals = starts + in_disc(random, config.travel, (config.robots,))
    return starts, goals.clamp(-config.side / 2, config.side / 2)


def measurements(
    config: SwarmConfig, controller: CbfQpController, starts: Tensor, goals: Tensor, random: np.random.Generator
) -> Iterator[tuple[Measurement, Sample]]:
    """Run the robots. For each sample, what is measured and what the robots did."""

    def among_nearest(t: float, x: Tensor, previous_u: Tensor, u: Tensor | None = None) -> Measurement:
        return nearest_bodies(t, x, u, previous_u=previous_u, count=config.neighbours, within=config.sensing_radius)

    before = torch.zeros_like(starts)
    for sample in closed_loop(controller, goals, starts, among_nearest, dt=config.dt, samples=config.steps + 1):
        seen = sample.control.u + in_disc(random, config.measurement_noise.velocity, (config.robots,))
        measurement = among_nearest(sample.measurement.time, sample.measurement.x, before, seen)
        yield replace(measurement, observed=sample.control.feasible), sample
        before = seen


def memory_mib() -> float:
    """The peak memory of this process so far [MiB]."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


def _snapshot(measurement: Measurement, estimate: SetEstimate, size: Tensor, goals: Tensor) -> Iterator[dict[str, Any]]:
    columns = "x", "y", "goal_x", "goal_y", "sqrt_area"
    numbers = torch.cat([measurement.x, goals, size.unsqueeze(-1)], dim=-1).tolist()
    for i, (place, case) in enumerate(zip(numbers, estimate.kkt.case.tolist(), strict=True)):
        yield _rounded({"t": measurement.t, "robot": i, **dict(zip(columns, place, strict=True)), "case": CASES[case]})


def _rounded(row: dict[str, Any]) -> dict[str, Any]:
    """The table row with six significant digits, for people and figures."""
    return {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()}


def print_swarm(summary: dict[str, Any], console: Console) -> None:
    """Print the summary."""
    for name, value in summary.items():
        console.print(f"{name.replace('_', ' ')}: {value}", highlight=False)
