"""A swarm in closed loop, observed as it goes: neither the trajectory nor the sets of the past are kept.

Every robot avoids its nearest neighbours within the sensing radius, and the observer sees each robot among the same
bodies. It does not count on the robots' ignoring all others: where the row of a body left out might have been active,
a sample is not used (`torchfsid.neighbours`).

    sizes.csv       over time: quantiles of the square root of the sets' areas, shares of lost and deadlocked robots
    snapshots.csv   at the snapshots, of every robot: where it is, its goal, the size of its set, the paper's case
    summary.json    what was lost, how long it took, how much memory at most
"""

from __future__ import annotations

import csv
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from experiments.runs.config import SwarmConfig
from experiments.runs.errors import in_disc
from torchfsid.commands.results import STATUS_NAMES, write_json
from torchfsid.config.documents import dump
from torchfsid.identification.kkt import CASES
from torchfsid.observers.set_membership import SetEstimate, SetMembershipObserver
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.neighbours import nearest_bodies
from torchfsid.robots.simulation import IDLE, STILL
from torchfsid.sets.feasible_set import FeasibleSet

QUANTILES = (0.1, 0.5, 0.9, 1.0)
SIZES = ("t", *(f"sqrt_area_{q:g}" for q in QUANTILES), "lost", "still", "memory_mib")
SNAPSHOTS = ("t", "robot", "x", "y", "goal_x", "goal_y", "sqrt_area", "case")


@dataclass
class Swarm:
    """The robots, and what happened to them so far.

    Attributes:
        starts, goals: [m]. x: where they are [m]. still: they stand though they have somewhere to go.
        infeasible: steps without a feasible control. closest: the least distance between two robots so far [m].
    """

    config: SwarmConfig
    starts: Tensor = field(init=False)
    goals: Tensor = field(init=False)
    x: Tensor = field(init=False)
    still: Tensor = field(init=False)
    infeasible: int = 0
    closest: float = float("inf")

    def __post_init__(self) -> None:
        config = self.config
        self._placing, self._measuring = map(np.random.default_rng, np.random.SeedSequence(config.seed).spawn(2))
        cells = np.arange(config.robots)
        columns = round(config.side / config.spacing)
        centres = (np.stack([cells % columns, cells // columns], axis=-1) + 0.5) * config.spacing - config.side / 2
        room = (config.spacing - config.separation) / 2
        self.starts = torch.from_numpy(centres + self._placing.uniform(-room, room, size=centres.shape))
        goals = self.starts + in_disc(self._placing, config.travel, (config.robots,))
        self.goals = goals.clamp(-config.side / 2, config.side / 2)
        self.x = self.starts

    def measurements(self, controller: CbfQpController) -> Iterator[Measurement]:
        """Run the robots; what is seen of them, sample by sample."""
        config = self.config
        seen_before = u = torch.zeros_like(self.x)
        for k in range(config.steps + 1):
            t, among = k * config.dt, {"count": config.neighbours, "within": config.sensing_radius}
            control = controller(nearest_bodies(t, self.x, previous_u=u, **among), self.goals)
            u, speed = control.u, control.u.norm(dim=-1)
            nominal = control.nominal.norm(dim=-1)
            self.still = (speed <= STILL * nominal) & (nominal > IDLE)
            self.infeasible += int((~control.feasible).sum())
            seen = u + in_disc(self._measuring, config.measurement_noise.velocity, (config.robots,))
            measurement = nearest_bodies(t, self.x, seen, previous_u=seen_before, **among)
            away = (measurement.bodies - measurement.x.unsqueeze(-2)).norm(dim=-1)
            self.closest = min(self.closest, float(torch.where(measurement.present, away, torch.inf).min()))
            yield replace(measurement, observed=control.feasible)
            self.x, seen_before = self.x + config.dt * u, seen


def run_swarm(config: SwarmConfig, out: Path, track: Any) -> dict[str, Any]:
    """Simulate, observe, and write everything but the figure; returns the summary."""
    began = time.perf_counter()
    swarm = Swarm(config)
    controller = CbfQpController(config.task.build([]), [barrier.build([]) for barrier in config.barriers])
    lower, upper = (
        torch.tensor(corner).expand(swarm.goals.shape) for corner in (config.prior.lower, config.prior.upper)
    )
    observer = SetMembershipObserver(
        controller.task,
        controller.barriers,
        FeasibleSet.from_box(lower, upper),
        kind=config.set,
        noise=config.noise.build() if config.set == "inverse_optimal" else None,
        active_tolerance=config.active_tolerance,
    )
    out.mkdir(parents=True, exist_ok=True)
    (out / "config.yaml").write_text(dump(config), encoding="utf-8")
    lost = torch.zeros(config.robots, dtype=torch.bool)
    shown = {round(t / config.dt) for t in config.snapshots}
    with _table(out / "sizes.csv", SIZES) as sizes, _table(out / "snapshots.csv", SNAPSHOTS) as snapshots:
        for k, measurement in enumerate(track(swarm.measurements(controller), config.steps + 1)):
            estimate = observer.update(measurement)
            lost |= ~estimate.feasible_set.contains(swarm.goals)
            size = estimate.feasible_set.volume().sqrt()
            quantiles = torch.quantile(size, torch.tensor(QUANTILES, dtype=torch.float64)).tolist()
            shares = float(lost.double().mean()), float(swarm.still.double().mean())
            sizes(measurement.t, *quantiles, *shares, memory_mib())
            if k in shown:
                for row in _snapshot(measurement, estimate, size, swarm.goals):
                    snapshots(*row)
    status = observer.status.tolist()
    summary = {
        "title": config.title,
        "robots": config.robots,
        "steps": config.steps,
        "truth_outside": int(lost.sum()),
        "status": {name: status.count(value) for value, name in STATUS_NAMES.items()},
        "samples_not_used": int(observer.skipped.sum()),
        "sqrt_area": dict(zip(map(str, QUANTILES), quantiles, strict=True)),
        "still": int(swarm.still.sum()),
        "infeasible_steps": swarm.infeasible,
        "closest": swarm.closest,
        "seconds": round(time.perf_counter() - began, 1),
        "peak_memory_mib": memory_mib(),
    }
    write_json(out / "summary.json", summary)
    return summary


def memory_mib() -> float:
    """The most memory that this process has held so far."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


@contextmanager
def _table(path: Path, header: Sequence[str]) -> Iterator[Callable[..., None]]:
    """Call it with the cells of a row."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        yield lambda *cells: writer.writerow([f"{cell:.6g}" if isinstance(cell, float) else cell for cell in cells])


def _snapshot(measurement: Measurement, estimate: SetEstimate, size: Tensor, goals: Tensor) -> Iterator[list[Any]]:
    places = torch.cat([measurement.x, goals, size.unsqueeze(-1)], dim=-1).tolist()
    for i, (place, case) in enumerate(zip(places, estimate.kkt.case.tolist(), strict=True)):
        yield [measurement.t, i, *place, CASES[case]]


def print_swarm(summary: dict[str, Any], console: Console) -> None:
    for name, value in summary.items():
        console.print(f"{name.replace('_', ' ')}: {value}", highlight=False)
