"""python -m benchmarks gradients [--repeats 5]

The cost and the error of gradients through Theta.

clips: the mean over B sets of log(area) after 20 clips of 16 rows, and its gradient with respect to all rows. A goal is
uniform in [-5, 5]^2, and the prior is [-10, 10]^2. Rows have random directions, at distances (0.2 .. 1) 10 0.9^k from
the goal. torchfsid (compiled clips and implicit differentiation) is compared with the same clips in torch
(tests/reference_clip.py). Times are CPU times of one thread for value and gradient, the fastest of some repetitions.
Errors are those of the derivative along a random direction against central differences, relative to the gradient's
norm.

probe: one gradient step of the probe design (configs/probe_placement.yaml, paths of 3 way-points): the mean log-area of
Theta(T) over placements and goals through closed loop, evidence and clips, and its gradient with respect to the
placements. `Probing.left` is compared with reading and clipping every sample in torch.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks import save
from experiments.design.probe import Probing
from experiments.design.search import Search
from experiments.kinds import load
from tests.reference_clip import Rings
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import evidence
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
    """The mean log-area by torchfsid: compiled clips and implicit differentiation."""
    theta = FeasibleSet.from_box(*corners(len(rows[0])))
    for A, b in zip(rows[::2], rows[1::2], strict=True):
        theta = theta.intersect(Halfspaces(A, b))
    return theta.volume().log().mean()


def by_torch_clips(rows: Rows) -> Tensor:
    """The mean log-area by clips in torch, the reference of the tests."""
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


def measured(
    mean: Callable[[Rows], Tensor], rows: Rows, along: Rows, difference: float, repeats: int
) -> dict[str, float]:
    """CPU time of a gradient [s], and its error along a direction."""
    spent = []
    for _ in range(repeats + 1):  # the first one compiles
        began = time.process_time()
        slopes = gradient(mean, rows)
        spent.append(time.process_time() - began)
    slope = sum(float((part * way).sum()) for part, way in zip(slopes, along, strict=True))
    norm = sum(float(part.square().sum()) for part in slopes) ** 0.5
    return {"seconds": min(spent[1:]), "error": abs(slope - difference) / norm}


def compared(
    what: str, batch: int, ways: dict[str, Callable[[Rows], Tensor]], rows: Rows, repeats: int
) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(1)
    along = [torch.randn(part.shape, dtype=part.dtype, generator=generator) for part in rows]
    with torch.no_grad():
        ahead, behind = (
            ways["implicit"]([part + sign * STEP * way for part, way in zip(rows, along, strict=True)])
            for sign in (1, -1)
        )
    difference = float(ahead - behind) / (2 * STEP)
    row: dict[str, Any] = {"batch": batch}
    row |= {name: measured(mean, rows, along, difference, repeats) for name, mean in ways.items()}
    row["ratio"] = row["torch"]["seconds"] / row["implicit"]["seconds"]
    print(
        f"{what}, B = {batch:5d}: {1e3 * row['implicit']['seconds']:8.1f} ms, in torch "
        f"{1e3 * row['torch']['seconds']:8.1f} ms, ratio {row['ratio']:5.1f}; errors "
        f"{row['implicit']['error']:.0e}, {row['torch']['error']:.0e}"
    )
    return row


def clips(repeats: int) -> list[dict[str, Any]]:
    """The measurements of `clips`, one entry per batch size."""
    ways = {"implicit": by_implicit_derivatives, "torch": by_torch_clips}
    return [compared("clips", batch, ways, workload(batch), repeats) for batch in BATCHES]


def probe(repeats: int) -> list[dict[str, Any]]:
    """The measurements of `probe`."""
    config = load(Path("configs/probe_placement.yaml"), [], "design")
    probing, found = Probing.of(config), []
    goals = probing.draw_goals(config.goals.train, 1)
    drawn = Search.of(probing, config.search, goals, 3, np.random.SeedSequence(0)).near_path(256)
    with torch.no_grad():
        left = probing.left(drawn, goals)
        drawn = drawn[left.sound.all(-1) & (left.area < probing.prior_area / 2).any(-1)]

    def by_the_design(rows: Rows) -> Tensor:
        return probing.left(rows[0], goals).area.log().mean()

    def sample_by_sample(rows: Rows) -> Tensor:
        lower, upper = (corner.expand(len(rows[0]) * len(goals), 2) for corner in probing.prior)
        rings, prior = Rings.boxes(lower, upper), probing.prior_of(len(lower))
        for sample in probing.loop(rows[0], goals):
            omega = evidence(probing.model, prior, sample.measurement, compiled=False).omega
            rings = rings.clip(omega.A, omega.b)
        return rings.area().log().mean()

    for placements in (1, 4, 32):
        ways = {"implicit": by_the_design, "torch": sample_by_sample}
        rows = [drawn[:placements].contiguous()]
        found.append(compared("probe", placements * len(goals), ways, rows, repeats))
    return found


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks gradients")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    results = {"clips": clips(options.repeats), "probe": probe(options.repeats)}
    print(f"saved: {save('gradients', results, ['torch', 'numpy', 'numba'])}")
