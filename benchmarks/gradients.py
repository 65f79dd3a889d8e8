"""python -m benchmarks gradients [--repeats 5]

What a gradient through Theta costs, and whether it is right.

clips: the mean over B sets of log(area) after 20 clips of 16 rows, and its gradient with respect to all rows. A goal
uniform in [-5, 5]^2, the prior [-10, 10]^2, rows of random directions at distances (0.2 .. 1) 10 0.9^k from the goal.
torchfsid (compiled clips, then implicit derivatives) against the same clips with every step in torch
(tests/reference_clip.py). Times are CPU times of one thread for value and gradient, the fastest of some
repetitions. Errors are those of the derivative along a random direction, relative to the gradient's norm, against
central differences.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks import save
from tests.reference_clip import Rings
from torchfsid.halfspaces import Halfspaces
from torchfsid.sets.feasible_set import FeasibleSet

BATCHES = (1, 64, 1024)
CLIPS, ROWS, HALF = 20, 16, 10.0
STEP = 1e-6

Rows = list[Tensor]
"""A (B, ROWS, 2) and b (B, ROWS) of the first clip, then of the second, and so on."""


def corners(batch: int) -> tuple[Tensor, Tensor]:
    corner = torch.full((batch, 2), HALF, dtype=torch.float64)
    return -corner, corner


def by_implicit_derivatives(rows: Rows) -> Tensor:
    theta = FeasibleSet.from_box(*corners(len(rows[0])))
    for A, b in zip(rows[::2], rows[1::2], strict=True):
        theta = theta.intersect(Halfspaces(A, b))
    return theta.volume().log().mean()


def by_torch_clips(rows: Rows) -> Tensor:
    rings = Rings.boxes(*corners(len(rows[0])))
    for A, b in zip(rows[::2], rows[1::2], strict=True):
        rings = rings.clip(A, b)
    return rings.area().log().mean()


def workload(batch: int, seed: int = 0) -> Rows:
    rng, rows = np.random.default_rng(seed), []
    goal = rng.uniform(-5, 5, (batch, 1, 2))
    for k in range(CLIPS):
        angle, distance = rng.uniform(0, 2 * np.pi, (batch, ROWS)), rng.uniform(0.2, 1.0, (batch, ROWS))
        A = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        rows += [torch.from_numpy(A), torch.from_numpy((A * goal).sum(-1) + distance * HALF * 0.9**k)]
    return rows


def gradient(mean: Callable[[Rows], Tensor], rows: Rows) -> Rows:
    leaves = [part.clone().requires_grad_() for part in rows]
    return list(torch.autograd.grad(mean(leaves), leaves, allow_unused=True, materialize_grads=True))


def clips(repeats: int) -> list[dict[str, Any]]:
    found = []
    for batch in BATCHES:
        rows = workload(batch)
        generator = torch.Generator().manual_seed(1)
        along = [torch.randn(part.shape, dtype=part.dtype, generator=generator) for part in rows]
        ahead, behind = (
            by_implicit_derivatives([part + sign * STEP * way for part, way in zip(rows, along, strict=True)])
            for sign in (1, -1)
        )
        difference = float(ahead - behind) / (2 * STEP)
        row: dict[str, Any] = {"batch": batch}
        for name, mean in (("implicit", by_implicit_derivatives), ("torch", by_torch_clips)):
            spent = []
            for _ in range(repeats + 1):  # the first one compiles
                began = time.process_time()
                slopes = gradient(mean, rows)
                spent.append(time.process_time() - began)
            slope = sum(float((part * way).sum()) for part, way in zip(slopes, along, strict=True))
            norm = sum(float(part.square().sum()) for part in slopes) ** 0.5
            row[name] = {"seconds": min(spent[1:]), "error": abs(slope - difference) / norm}
        row["ratio"] = row["torch"]["seconds"] / row["implicit"]["seconds"]
        found.append(row)
        print(
            f"clips, B = {batch:5d}: {1e3 * row['implicit']['seconds']:8.1f} ms, in torch "
            f"{1e3 * row['torch']['seconds']:8.1f} ms, ratio {row['ratio']:5.1f}; errors "
            f"{row['implicit']['error']:.0e}, {row['torch']['error']:.0e}"
        )
    return found


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks gradients")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    results = {"clips": clips(options.repeats)}
    print(f"saved: {save('gradients', results, ['torch', 'numpy', 'numba'])}")
