"""python -m benchmarks safety [--samples 1500] [--repeats 3]

The cost of not knowing gain and safety distance, for four robots that cross twice: the observer that is told them, and
the one that learns them, on the same log: sample by sample, and in one pass over blocks of 64 samples. Then the second
look at the whole log, which splits what is left. Results are wall-clock seconds, the least of all repeats, and ratios.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from benchmarks import save
from torchfsid.identification.safety_parameters import LearningModel, Possible
from torchfsid.observers.consistency import Consistency
from torchfsid.observers.safety import SafetyObserver
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask
from torchfsid.robots.unknown_avoidance import UnknownAvoidance
from torchfsid.sets.feasible_set import FeasibleSet

TASK, GAIN, DISTANCE, DT, ERROR = GoalTask(0.3), 1.5, 0.5, 0.01, 5e-3


def log(samples: int) -> list[Measurement]:
    """Four robots cross, with errors of up to `ERROR` in the velocities."""
    start = torch.tensor([[-3.0, 0.1], [3.0, -0.1], [0.1, -3.0], [-0.1, 3.0]], dtype=torch.float64)
    controller = CbfQpController(TASK, [CollisionAvoidance(ClassK(GAIN), safety_distance=DISTANCE)])
    run = simulate(controller, -start + 0.3, start, dt=DT, steps=samples - 1)
    turn = 2 * torch.pi * torch.rand(run.u.shape[:2], generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    u = run.u + ERROR / 2 * torch.stack([turn.cos(), turn.sin()], dim=-1)
    return [Measurement.of_team(float(t), x, v) for t, x, v in zip(run.t, run.x, u, strict=True)]


def seconds(work: Callable[[], object], repeats: int) -> float:
    """The least time that the work takes [s]."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks safety")
    parser.add_argument("--samples", type=int, default=1500)
    parser.add_argument("--repeats", type=int, default=3)
    chosen = parser.parse_args(arguments)
    torch.set_grad_enabled(False)
    samples, noise = log(chosen.samples), NoiseBound(ERROR)
    corner = torch.full((4, 2), 6.0, dtype=torch.float64)
    prior = FeasibleSet.from_box(-corner, corner)
    known = [CollisionAvoidance(ClassK(GAIN), safety_distance=DISTANCE)]
    unknown = [UnknownAvoidance((GAIN / 10, GAIN * 10), (DISTANCE / 2, DISTANCE * 2))]

    def watched(make: Callable[[], SetMembershipObserver | SafetyObserver]) -> Callable[[], object]:
        def work() -> None:
            observer = make()
            for sample in samples:
                observer.update(sample)

        return work

    told = seconds(watched(lambda: SetMembershipObserver(TASK, known, prior, noise=noise)), chosen.repeats)
    learning = seconds(watched(lambda: SafetyObserver(TASK, unknown, prior, noise)), chosen.repeats)
    consistency = Consistency(samples, TASK, known, prior)
    bound = torch.full((4,), ERROR, dtype=torch.float64)
    told_pass = seconds(lambda: consistency.sets(bound), chosen.repeats)

    def learning_pass() -> None:
        model = LearningModel(TASK, unknown, noise)
        sets = Possible(prior, unknown[0].prior(1), torch.zeros(4, dtype=torch.long))
        for block in consistency.blocks:
            read = model.read(sets, block.measurement)
            sets = replace(sets, theta=read.theta, psi=read.cuts.apply(sets.psi, sets.owner, block.of_items))

    learned_pass = seconds(learning_pass, chosen.repeats)
    looks = [_second_look(samples, unknown, prior, noise) for _ in range(chosen.repeats)]
    found = {
        "samples": chosen.samples,
        "known_s": told,
        "unknown_s": learning,
        "ratio": learning / told,
        "known_pass_s": told_pass,
        "unknown_pass_s": learned_pass,
        "pass_ratio": learned_pass / told_pass,
        "second_look_s": min(looks),
    }
    print(
        f"4 robots, {chosen.samples} samples\n"
        f"sample by sample   known {told:.3f} s   unknown {learning:.3f} s   {found['ratio']:.2f}x\n"
        f"one pass, blocks   known {told_pass:.3f} s   unknown {learned_pass:.3f} s   {found['pass_ratio']:.2f}x\n"
        f"second look        {found['second_look_s']:.3f} s"
    )
    save("safety", found, ["torch", "numpy", "numba"])


def _second_look(
    samples: Sequence[Measurement], unknown: list[UnknownAvoidance], prior: FeasibleSet, noise: NoiseBound
) -> float:
    observer = SafetyObserver(TASK, unknown, prior, noise)
    for sample in samples:
        observer.update(sample)
    began = time.perf_counter()
    observer.look_again(samples)
    return time.perf_counter() - began
