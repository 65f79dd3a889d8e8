"""Robots in space on a GPU: a section of `python -m benchmarks cuda`.

B robots with unknown goals among 4 bodies, controls exact to 1 mm/s, once with a nominal control that is clipped by
norm. Each update reads a measurement, cuts the polyhedra and asks for their volumes. In the same run: one CPU core with
the same kernels, and the largest relative difference of the volumes. Truths lost must be 0. The first updates, with the
compilation, are not counted.
"""

from __future__ import annotations

import time
from dataclasses import replace
from statistics import median

import numpy as np
import torch
from torch import Tensor

from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import GoalTask, Saturation
from torchfsid.sets.feasible_set import FeasibleSet

ROBOTS, STEPS, WARM, ERROR, HALF = 10_000, 6, 2, 1e-3, 4.0
BARRIER = CollisionAvoidance(ClassK(1.5), safety_distance=0.3)
TASKS = {
    "linear": GoalTask(0.8, dimension=3),
    "clipped": GoalTask(0.8, dimension=3, saturation=Saturation("norm", (1.0, 1.0, 1.0))),
}


def scene(robots: int, steps: int, task: GoalTask) -> tuple[Tensor, list[Measurement]]:
    """Goals, and measurements at random places, all bodies in safe distance."""
    rng = np.random.default_rng(0)
    goals, controller, seen = torch.from_numpy(rng.uniform(-3, 3, (robots, 3))), CbfQpController(task, [BARRIER]), []
    for step in range(steps):
        x, direction = torch.from_numpy(rng.uniform(-3, 3, (robots, 3))), rng.normal(size=(robots, 4, 3))
        direction *= rng.uniform(0.4, 2.0, (robots, 4, 1)) / np.linalg.norm(direction, axis=-1, keepdims=True)
        bodies = x.unsqueeze(1) + torch.from_numpy(direction)
        moment = Measurement(float(step), x, None, bodies, torch.ones(robots, 4, dtype=torch.bool))
        u = controller(moment, goals).u
        off = rng.normal(size=(robots, 3))
        off *= ERROR / 2 / np.linalg.norm(off, axis=-1, keepdims=True)
        seen.append(replace(moment, u=u + torch.from_numpy(off)))
    return goals, seen


def observed(where: str, task: GoalTask, goals: Tensor, seen: list[Measurement]) -> tuple[float, int, Tensor]:
    """The median time of an update with the volumes [s], the number of truths lost, and the volumes at last."""
    corner = torch.full_like(goals, HALF).to(where)
    watching = SetMembershipObserver(
        task, [BARRIER], FeasibleSet.from_box(-corner, corner), noise=NoiseBound(ERROR), compiled=True
    )
    spent, volume = [], corner
    for moment in seen:
        there = replace(
            moment, **{name: part.to(where) for name, part in vars(moment).items() if isinstance(part, Tensor)}
        )
        began = time.perf_counter()
        volume = watching.update(there).feasible_set.volume()
        if where == "cuda":
            torch.cuda.synchronize()
        spent.append(time.perf_counter() - began)
    lost = int((~watching.feasible_set.contains(goals.to(where))).sum())
    return median(spent[WARM:]), lost, volume.cpu()


def compare(robots: int = ROBOTS, where: str = "cuda", steps: int = STEPS) -> dict:
    """Measure the two tasks and print what was measured."""
    torch.set_num_threads(1)
    runs = []
    for name, task in TASKS.items():
        goals, seen = scene(robots, steps, task)
        began = time.perf_counter()
        spent, lost, volume = observed(where, task, goals, seen)
        whole = time.perf_counter() - began
        core, _, expected = observed("cpu", task, goals, seen)
        apart = float(((volume - expected).abs() / expected.clamp(min=1e-12)).max())
        run = {"task": name, "robots": robots, "update_s": spent, "one_core_s": core, "truths_lost": lost}
        runs.append({**run, "largest_relative_difference": apart, "with_compilation_s": whole})
        print(
            f"  in space, {name:8s} B = {robots:6d}: update {spent * 1e3:8.2f} ms, one core {core * 1e3:8.1f} ms "
            f"({core / spent:.0f} x); volumes differ by {apart:.1e}, truths lost {lost}, {whole:.0f} s in all",
            flush=True,
        )
    return {"runs": runs}
