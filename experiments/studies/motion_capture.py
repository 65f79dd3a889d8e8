"""Sets from positions as motion capture measures them. `python -m experiments.studies.motion_capture` prints the table.

Teams of four robots cross at 100 Hz, by a joint QP or by rows of their own. Positions have errors in a disc of 0.5 mm,
or Gaussian ones of 0.5 mm per axis, cut at the declared 2.5 mm. With dropouts, a robot is missing for 50 to 300 ms
about every 1.5 s. The same log is read by differences of positions and by windows. docs/your_log.md has the table.
"""

from __future__ import annotations

import argparse
import math
from itertools import product
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfsid.logs.gaps import bridged
from torchfsid.logs.log import Log
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet

ROBOTS, DT, DURATION, GAIN, SIZE, CUT = 4, 0.01, 10.0, 0.6, 5e-4, 2.5e-3
WAYS: dict[str, tuple[float, ...]] = {"differences": (), "windows": (0.1, 0.25, 0.5, 1.0)}
Errors = Literal["disc", "Gauss"]


class Result(NamedTuple):
    """What one team gives: truths lost, robots flagged, diameters [m], the share of the windows of 0.5 s used."""

    lost: int
    flagged: int
    diameters: list[float]
    used: float


def measured(rng: np.random.Generator, x: np.ndarray, errors: Errors) -> tuple[np.ndarray, float]:
    """Positions with errors, and the bound on these [m]."""
    if errors == "disc":
        angle, size = rng.uniform(0, 2 * math.pi, x.shape[:-1]), SIZE * np.sqrt(rng.uniform(0, 1, x.shape[:-1]))
        return x + size[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1), SIZE
    error = rng.normal(0, SIZE, x.shape)
    length = np.linalg.norm(error, axis=-1, keepdims=True)
    return x + error * np.minimum(1, CUT / np.maximum(length, 1e-12)), CUT


def without_dropouts(rng: np.random.Generator, shape: tuple[int, int], dropouts: bool) -> np.ndarray:
    """Which robots are seen at which samples."""
    seen = np.ones(shape, dtype=bool)
    for robot in range(shape[1] if dropouts else 0):
        k = int(rng.uniform(20, 150))
        while k < shape[0]:
            missing = int(rng.integers(5, 31))
            seen[k : k + missing, robot] = False
            k += missing + int(rng.exponential(150))
    return seen


def run(seed: int, errors: Errors, joint: bool, dropouts: bool) -> dict[str, Result]:
    """Simulate and measure one team, and observe it both ways."""
    rng = np.random.default_rng(seed)
    angle = 2 * math.pi * np.arange(ROBOTS) / ROBOTS
    start = torch.from_numpy(1.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1) + rng.normal(0, 0.1, (ROBOTS, 2)))
    goals = -start + torch.from_numpy(rng.normal(0, 0.25, (ROBOTS, 2)))
    avoidance = CollisionAvoidance(ClassK(2.0), safety_distance=0.4, neighbour_velocity="current" if joint else "none")
    trajectory = simulate(CbfQpController(GoalTask(GAIN), [avoidance]), goals, start, dt=DT, steps=int(DURATION / DT))
    x, rho = measured(rng, trajectory.x.numpy(), errors)
    seen, names = without_dropouts(rng, x.shape[:2], dropouts), tuple(f"r{i}" for i in range(ROBOTS))
    log = Log("study", names, trajectory.t.numpy(), np.where(seen[..., None], x, 0.0), None, seen, seen)
    log = bridged(log.windowed(rho))
    return {way: _observed(log, names, goals, avoidance, rho, windows) for way, windows in WAYS.items()}


def _observed(
    log: Log,
    names: tuple[str, ...],
    goals: Tensor,
    avoidance: CollisionAvoidance,
    rho: float,
    windows: tuple[float, ...],
) -> Result:
    box, uses = torch.full_like(goals, 4.0), {avoidance.neighbour_velocity} - {"none"}
    observer = SetMembershipObserver(
        GoalTask(GAIN),
        [avoidance],
        FeasibleSet.from_box(-box, box),
        noise=NoiseBound(1e-6, position=rho),
        windows=windows,
    )
    for sample in log.measurements(names, uses):
        observer.update(sample)
    sets = observer.feasible_set
    lost, flagged = int((~sets.contains(goals)).sum()), int((observer.status != Status.OK).sum())
    return Result(lost, flagged, sets.diameter().tolist(), observer.windows_used.get(0.5, math.nan))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m experiments.studies.motion_capture")
    parser.add_argument("--seeds", type=int, default=20)
    options = parser.parse_args()
    torch.set_num_threads(1)
    heads = "errors | rows | dropouts | lost | flagged | differences: median (largest) | windows | ratio | 0.5 s used"
    print(f"| {heads} |\n|---|---|---|---:|---:|---:|---:|---:|---:|")
    kinds: tuple[Errors, ...] = ("disc", "Gauss")
    for errors, joint, dropouts in product(kinds, (True, False), (False, True)):
        found = [run(seed, errors, joint, dropouts) for seed in range(options.seeds)]
        both = [result for team in found for result in team.values()]
        far, near = (1e3 * np.array([d for team in found for d in team[way].diameters]) for way in WAYS)
        used = np.mean([team["windows"].used for team in found])
        print(
            f"| {errors} | {'joint' if joint else 'own'} | {'yes' if dropouts else 'no'} "
            f"| {sum(r.lost for r in both)} | {sum(r.flagged for r in both)} "
            f"| {np.median(far):.1f} ({far.max():.0f}) mm | {np.median(near):.1f} ({near.max():.0f}) mm "
            f"| {np.median(far / near):.1f} | {used:.0%} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
