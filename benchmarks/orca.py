"""python -m benchmarks orca [--steps 40]

The whole observer update for fleets of ORCA robots with 10 neighbours each: rows from positions and velocities, their
errors, active set, half-spaces, clipping. The robots go to goals past each other on a square, 4 m^2 each, with clipped
nominal controls (1 m/s) or linear ones. Their controls are those of `CbfQpController` with the same barrier. One
thread. The search of the neighbours and the controllers are not part of the observer. Data are exact (declared bound
1e-5 m/s), or positions are wrong by 5 mm.

The peer is the same observer in torch, on the same measurements in the same run.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
import torch

from benchmarks import save
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.neighbours import nearest_bodies
from torchfsid.robots.orca import Orca
from torchfsid.robots.tasks import GoalTask, Saturation
from torchfsid.sets.feasible_set import FeasibleSet

STEP, EPISODE, NEIGHBOURS, RADIUS = 0.1, 40, 10, 0.3
ORCA = Orca(time_horizon=2.0, time_step=STEP, max_speed=1.2, count=NEIGHBOURS, distance=6.0)
TASKS = {"clipped": GoalTask(0.5, saturation=Saturation("norm", (1.0, 1.0))), "linear": GoalTask(0.1)}


def measurements(
    robots: int, steps: int, task: GoalTask, rho: float, seed: int
) -> tuple[list[Measurement], torch.Tensor, float]:
    """The samples of a fleet, its goals, and the time of a controller per robot and step [us]."""
    rng, side, spent = np.random.default_rng(seed), int(np.ceil(np.sqrt(robots))), 0.0

    def places() -> torch.Tensor:
        cell = rng.permutation(side * side)[:robots]
        corner = np.stack([cell % side, cell // side], axis=-1) * 2.0 - side
        return torch.from_numpy(corner + rng.uniform(0.4, 1.6, (robots, 2)))

    goals, radius, found = places(), np.full(robots, RADIUS), []
    controller = CbfQpController(task, [ORCA])
    slots = NEIGHBOURS + (3 if rho else 1)  # bodies beyond them are proved to be no neighbours
    for k in range(steps):
        if k % EPISODE == 0:
            x, before = places(), torch.zeros(robots, 2, dtype=torch.float64)
        seen = nearest_bodies(STEP * k, x, count=slots, previous_u=before, radius=radius)
        began = time.process_time()
        u = controller(seen, goals).u
        spent += time.process_time() - began
        direction = torch.from_numpy(rng.normal(size=(robots, 2)))
        wrong = x + rho * direction / direction.norm(dim=-1, keepdim=True)
        measured = nearest_bodies(STEP * k, wrong, u, count=slots, previous_u=before, radius=radius)
        found.append(measured)
        x, before = x + STEP * u, u
    return found, goals, 1e6 * spent / robots / steps


def run(robots: int, steps: int, task: GoalTask, rho: float, ways: dict[str, bool]) -> dict:
    """Observe a fleet from the prior on, in each way. Times are per robot and update [us]."""
    samples, goals, control = measurements(robots, steps, task, rho, seed=0)
    corner = torch.full_like(goals, float(goals.abs().max()) + 2)
    result: dict = {"robots": robots, "steps": steps, "rho": rho, "controller_microseconds": control}
    for way, compiled in ways.items():
        prior, noise = FeasibleSet.from_box(-corner, corner), NoiseBound(1e-5, position=rho)
        observer = SetMembershipObserver(task, [ORCA], prior, noise=noise, compiled=compiled)
        for sample in samples[:2]:
            observer.update(replace(sample, t=sample.time - 1e3))
        observer.feasible_set = prior
        began = time.process_time()
        for sample in samples:
            observer.update(sample)
        spent = time.process_time() - began
        result[way] = {
            "microseconds": 1e6 * spent / robots / steps,
            "per_second": robots * steps / spent,
            "lost": int((~observer.feasible_set.contains(goals)).sum()),
            "flagged": int((observer.status > 0).sum()),
            "used": 1 - float(observer.skipped.double().mean()) / (steps + 2),
            "infeasible": float(observer.infeasible.double().mean()) / (steps + 2),
        }
    return result


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks orca")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--robots", type=int, nargs="+", default=[1000, 4000, 10_000])
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    ways, results = {"compiled": True, "torch": False}, []
    for name, task in TASKS.items():
        for rho in (0.0, 5e-3):
            for robots in options.robots:
                row = {"task": name, **run(robots, options.steps, task, rho, ways)}
                results.append(row)
                fast, slow = row["compiled"], row["torch"]
                print(
                    f"{name:8s} B = {robots:6d}, positions {'exact' if rho == 0 else f'{rho:g} m'}: "
                    f"{fast['per_second']:9.0f} updates/s, {fast['microseconds']:.2f} us each, torch "
                    f"{slow['microseconds']:.1f} us: {slow['microseconds'] / fast['microseconds']:.1f}x; used "
                    f"{fast['used']:.0%}, infeasible {fast['infeasible']:.1%}, lost {fast['lost']}, flagged "
                    f"{fast['flagged']}; controller {row['controller_microseconds']:.1f} us"
                )
    print(f"saved: {save('orca', {'rows': results}, ['torch', 'numpy', 'scipy', 'numba'])}")
