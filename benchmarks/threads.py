"""python -m benchmarks threads [--robots 100000] [--steps 10]

Wall-clock time of the same work on one thread and on more: the observer update of a fleet (`scenario`, 8 neighbours,
noisy), and the exact layers forward and backward (m = 24, p = 3). Numbers of threads take turns, and the best of the
turns counts. The results must be equal, bit for bit.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from benchmarks import save
from benchmarks.scenario import Fleet, measured, observer
from torchfsid import ChebyshevCentre, FleetObserver, Halfspaces, ProjectOnto, get_num_threads, set_num_threads

TURNS, ITEMS, ROWS, DIM = 3, 65_536, 24, 3


def fleet(robots: int, steps: int) -> Callable[[int], tuple[float, Tensor]]:
    """The work on a fleet: with a number of threads, the seconds for all updates, and b of all facets."""
    team = Fleet(robots, noisy=True)
    samples = [measured(*moment) for moment in itertools.islice(team, steps)]

    def work(threads: int) -> tuple[float, Tensor]:
        watching = FleetObserver(observer(team.prior(), True, team.task), threads)
        began = time.perf_counter()
        for sample in samples:
            watching.update(sample)
        spent, sets = time.perf_counter() - began, watching.feasible_set.body
        return spent, sets.b[sets.valid]

    return work


def layer(kind: type) -> Callable[[int], tuple[float, Tensor]]:
    """The work on a layer: with a number of threads, the seconds for value and gradient, and both."""
    of = torch.Generator().manual_seed(0)
    A, point = (torch.randn(*shape, DIM, generator=of, dtype=torch.float64) for shape in ((ITEMS, ROWS), (ITEMS,)))
    b = 0.5 + torch.rand(ITEMS, ROWS, generator=of, dtype=torch.float64)

    def work(threads: int) -> tuple[float, Tensor]:
        set_num_threads(threads)
        rows = A.clone().requires_grad_()
        began = time.perf_counter()
        found = kind()(Halfspaces(rows, b), *([3 * point] if kind is ProjectOnto else []))[0]
        found.nan_to_num().square().sum().backward()  # NaN: a set without a largest ball
        spent = time.perf_counter() - began
        assert rows.grad is not None
        return spent, torch.cat([found.detach().nan_to_num().flatten(), rows.grad.flatten()])

    return work


def compare(work: Callable[[int], tuple[float, Tensor]], numbers: list[int]) -> dict[int, float]:
    """The best seconds for each number of threads."""
    best = dict.fromkeys(numbers, float("inf"))
    _, first = work(numbers[0])
    for _ in range(TURNS):
        for threads in numbers:
            seconds, answer = work(threads)
            assert torch.equal(answer, first)
            best[threads] = min(best[threads], seconds)
    return best


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks threads")
    parser.add_argument("--robots", type=int, default=100_000)
    parser.add_argument("--steps", type=int, default=10)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    numbers = sorted({1, 2, get_num_threads()})
    of = {f"fleet of {options.robots}, {options.steps} updates": fleet(options.robots, options.steps)}
    for kind in (ProjectOnto, ChebyshevCentre):
        of[f"{kind.__name__}, B = {ITEMS}, m = {ROWS}, p = {DIM}"] = layer(kind)
    results: list[dict[str, Any]] = []
    for name, work in of.items():
        seconds = compare(work, numbers)
        results.append({"work": name, "seconds": {str(threads): spent for threads, spent in seconds.items()}})
        print(f"{name}: " + ", ".join(f"{n} threads {s:.3f} s ({seconds[1] / s:.2f}x)" for n, s in seconds.items()))
    print(f"saved: {save('threads', results, ['torch', 'numpy', 'numba'])}")
