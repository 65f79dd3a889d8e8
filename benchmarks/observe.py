"""python -m benchmarks observe [--robots 10] [--samples 100000] [--short 1000]

`torchfsid observe` on a long log: a team that crosses its own way, and then stands, with errors of the velocities. The
log is written as CSV and observed with and without the filter, in blocks (as the command does it) and sample by sample.
The latter runs on the first samples only (`--short`), with filterpy. Results are the CPU time per sample of
reading the file, of observing (with all results written) and of the figures, and the largest memory of the process.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch

from benchmarks import save
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.figures import draw_observation
from torchfsid.commands.observe import Observation
from torchfsid.config.observe import ObserveConfig
from torchfsid.logs.read import read_log
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask

DT, GAIN, DISTANCE, ALPHA, ERROR = 0.02, 0.6, 0.3, 2.0, 4e-4
MOVING = 1500
"""Samples until the team stands."""


def write_log(path: Path, robots: int, samples: int) -> None:
    """Robots on a circle with goals opposite."""
    rng = np.random.default_rng(7)
    angle = 2 * np.pi * np.arange(robots) / robots
    circle = 0.3 * max(robots, 4) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    start = torch.from_numpy(circle + rng.normal(0, 0.1, (robots, 2)))
    goals = -start + torch.from_numpy(rng.normal(0, 0.25, (robots, 2)))
    controller = CbfQpController(GoalTask(GAIN), [CollisionAvoidance(ClassK(ALPHA), safety_distance=DISTANCE)])
    run = simulate(controller, goals, start, dt=DT, steps=min(samples, MOVING))
    with path.open("w", encoding="utf-8") as file:
        file.write("t,robot,x,y,vx,vy\n")
        for k in range(samples):
            x, u = run.x[min(k, MOVING)].numpy(), run.u[min(k, MOVING)].numpy()
            u = u + ERROR / np.sqrt(2) * rng.uniform(-1, 1, u.shape)
            for i, row in enumerate(np.hstack([x, u]).tolist()):
                file.write(f"{k * DT:.2f},r{i},{','.join(map(repr, row))}\n")


def config(ukf: bool | dict) -> ObserveConfig:
    return ObserveConfig.model_validate(
        {
            "task": {"kind": "goal", "gain": GAIN},
            "barriers": [{"kind": "avoidance", "safety_distance": DISTANCE, "class_k": {"gain": ALPHA}}],
            "prior": {"lower": [-9, -9], "upper": [9, 9]},
            "noise": {"velocity": ERROR},
            "ukf": ukf,
        }
    )


def seconds(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def observed(path: Path, out: Path, ukf: bool | dict, block: int | None = None) -> dict[str, float]:
    """Microseconds of CPU per sample, by stage."""
    out.mkdir(exist_ok=True)
    logs = []
    spent = {"read": seconds(lambda: logs.append(read_log(path)))}
    observation = Observation(DeclaredLog(config(ukf), logs[0]))
    with patch("torchfsid.commands.observe.BLOCK", block) if block else nullcontext():
        spent["observe"] = seconds(lambda: observation.run(out))
    spent["draw"] = seconds(lambda: draw_observation(out, logs[0].x, logs[0].seen, logs[0].bodies))
    return {stage: 1e6 * value / observation.samples for stage, value in spent.items()}


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks observe")
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--short", type=int, default=1000)
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    found: dict = {"robots": chosen.robots, "samples": chosen.samples, "short": chosen.short}
    with tempfile.TemporaryDirectory() as folder:
        long, short, out = (Path(folder) / name for name in ("long.csv", "short.csv", "out"))
        write_log(long, chosen.robots, chosen.samples)
        write_log(short, chosen.robots, chosen.short)
        for name, blocks, single in (("without", False, False), ("with", {}, {"engine": "filterpy"})):
            observed(short, out, blocks)  # compile the kernels and load lazy modules
            by_sample = observed(short, out, single, block=1)
            in_blocks = observed(long, out, blocks)
            found[f"{name} the filter"] = {"sample by sample": by_sample, "in blocks": in_blocks}
    found["memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    print(f"{chosen.robots} robots, {chosen.samples} samples: microseconds of CPU per sample")
    for name in ("without the filter", "with the filter"):
        for path, spent in found[name].items():
            print(f"  {name:18s} {path:16s} " + "  ".join(f"{stage} {value:8.1f}" for stage, value in spent.items()))
        by_sample, in_blocks = found[name].values()
        print(f"  {name:18s} observe: {by_sample['observe'] / in_blocks['observe']:.1f} x as fast in blocks")
    print(f"largest memory: {found['memory_mb']} MB")
    print(f"saved: {save('observe', found, ['torch', 'numpy', 'numba', 'filterpy'])}")
