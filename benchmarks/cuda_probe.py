"""A gradient step of the probe design on a GPU and on one CPU core: a part of `python -m benchmarks cuda`.

The corridor of configs/probe_placement.yaml, with many placements of 3 way-points and 32 goals: the mean log-area of
Theta(T) through closed loop, evidence and clips, and its gradient with respect to all way-points. Times are wall times
of value and gradient with all tensors in place. On the device it is the median of some steps after a first one that
compiles. Values and gradients of both are compared.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from experiments.design.probe import Probing
from torchfsid.kernels.threads import get_num_threads, set_num_threads
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.tasks import GoalTask

PLACEMENTS, GOALS, STEPS = (256, 4096), 32, 5


def tensor(values: Sequence) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def corridor() -> Probing:
    """The scene of configs/probe_placement.yaml."""
    return Probing(
        task=GoalTask(1.0),
        avoidance=CollisionAvoidance(ClassK(1.0), safety_distance=0.4),
        obstacles=tensor([[0.6, 0.7], [0.6, -0.7], [1.5, 0.7], [1.5, -0.7]]),
        start=tensor([0.0, 0.0]),
        prior=tensor([[2.5, -0.5], [3.5, 0.5]]),
        room=tensor([[-0.5, -1.0], [3.5, 1.0]]),
        dt=0.05,
        steps=20,
        active_tolerance=1e-6,
    )


def drawn(scene: Probing, count: int) -> Tensor:
    """Placements beside the path that the robot takes without a probe, turned around it from way-point to way-point."""
    rng, path = np.random.default_rng(0), scene.run(None, scene.draw_goals(GOALS, 1)).x.mean(0)
    turned = rng.normal(size=(count, 3))
    turned[:, 0] = rng.uniform(0, 2 * np.pi, count)
    angle, away = (
        torch.from_numpy(turned.cumsum(-1)),
        torch.from_numpy(0.4 + 0.15 * abs(rng.normal(size=(count, 3, 1)))),
    )
    at = path[torch.linspace(0, len(path) - 1, 3).round().long()]
    return scene.allowed(at + away * torch.stack([angle.cos(), angle.sin()], dim=-1))


def step(scene: Probing, placements: Tensor, goals: Tensor) -> tuple[float, float, Tensor]:
    """The time of a step [s], the value, and the gradient."""
    leaf = placements.clone().requires_grad_()
    began = time.perf_counter()
    mean = scene.left(leaf, goals).area.log().mean()
    (gradient,) = torch.autograd.grad(mean, leaf)
    value = float(mean.detach())
    if leaf.is_cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - began, value, gradient


def compare(where: str = "cuda", placements: Sequence[int] = PLACEMENTS) -> dict:
    """Compare a device with one CPU core, and print a line for each number of placements."""
    results, threads = {}, (torch.get_num_threads(), get_num_threads())
    scene = corridor()
    goals, places, there = scene.draw_goals(GOALS, 1), drawn(scene, max(placements)), scene.to(where)
    torch.set_num_threads(1)
    set_num_threads(1)
    try:
        step(scene, places[:32], goals)  # compiles
        for count in placements:
            given = places[:count].to(where), goals.to(where)
            step(there, *given)
            on_device = [step(there, *given) for _ in range(STEPS)]
            spent, value, gradient = step(scene, places[:count], goals)
            taken = float(np.median([seconds for seconds, _, _ in on_device]))
            _, its_value, its_gradient = on_device[-1]
            row = {
                "items": count * GOALS,
                "device_s": taken,
                "one_core_s": spent,
                "ratio": spent / taken,
                "value_difference": abs(its_value - value),
                "gradient_difference": float((its_gradient.cpu() - gradient).norm() / gradient.norm()),
            }
            results[str(count)] = row
            print(
                f"  gradient step of the probe design, {count} x {GOALS} items: {where} {taken * 1e3:9.3f} ms, "
                f"one core {spent * 1e3:9.1f} ms, ratio {row['ratio']:.1f}; value {value:.6f}, differs by "
                f"{row['value_difference']:.0e}, gradient by {row['gradient_difference']:.0e} of its norm",
                flush=True,
            )
    finally:
        torch.set_num_threads(threads[0])
        set_num_threads(threads[1])
    return results
