"""python -m benchmarks observer [--fleets 20]

One update of each observer on the same measurements of the same robots (`scenario`, noisy), for 1, 10 and 100 robots in
some fleets. The observers are the sets (compiled, and in torch), filterpy's UKF on [x; theta], and the hybrid of both.
Results are the wall-clock time per robot and update [us], the median over all updates, and the final distance to the
goals.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections import defaultdict
from collections.abc import Callable

import numpy as np
import torch

from benchmarks import save
from benchmarks.scenario import BARRIER, EPISODE, ERROR, TASK, Fleet, measured, observer
from torchfsid.observers.hybrid import HybridObserver
from torchfsid.observers.protocol import Observer
from torchfsid.observers.ukf import ParameterUkf

SIZES = (1, 10, 100)
AMONG = 9
"""The least number of bodies: a robot has 8 neighbours."""


def makers(fleet: Fleet, robots: range) -> dict[str, Callable[[], Observer]]:
    prior = fleet.prior().select(torch.tensor(list(robots)))
    spread = 2 * (fleet.half + 1) / np.sqrt(12)

    def ukf() -> ParameterUkf:
        return ParameterUkf(
            TASK,
            [BARRIER],
            mean=torch.zeros(len(robots), 2, dtype=torch.float64),
            spread=spread,
            active_tolerance=ERROR,
        )

    return {
        "set, torch": lambda: observer(prior, False),
        "set, compiled": lambda: observer(prior, True),
        "UKF (filterpy)": ukf,
        "hybrid": lambda: HybridObserver(observer(prior, True), ukf()),
    }


def run(robots: int, fleets: int) -> dict[str, dict]:
    """Observe some fleets, each until its robots are moved to new places, which a filter would take for a motion."""
    watched = range(robots)
    spent: dict[str, list[float]] = defaultdict(list)
    errors: dict[str, list[float]] = defaultdict(list)
    for seed in range(fleets):
        fleet = Fleet(max(robots, AMONG), noisy=True, seed=seed)
        watching, estimates = {name: make() for name, make in makers(fleet, watched).items()}, {}
        for t, x, u in itertools.islice(fleet, EPISODE):
            measurement = measured(t, x, u, watched)
            for name, one in watching.items():
                began = time.perf_counter()
                estimates[name] = one.update(measurement)
                spent[name].append(time.perf_counter() - began)
        for name, estimate in estimates.items():
            errors[name] += (estimate.theta - fleet.goals[:robots]).norm(dim=-1).tolist()
    return {
        name: {
            "microseconds": 1e6 * float(np.median(times)) / robots,
            "median_error": float(np.median(errors[name])),
            "mean_error": float(np.mean(errors[name])),
        }
        for name, times in spent.items()
    }


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks observer")
    parser.add_argument("--fleets", type=int, default=20)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    run(1, 1)  # compile the kernels and load lazy modules
    results: dict = {"fleets": options.fleets, "updates": EPISODE, "sizes": {}}
    for robots in SIZES:
        found = results["sizes"][robots] = run(robots, options.fleets)
        print(f"\nB = {robots}: per robot and update")
        reference = found["UKF (filterpy)"]["microseconds"]
        for name, what in found.items():
            ratio = reference / what["microseconds"]
            print(
                f"  {name:16s} {what['microseconds']:9.1f} us  {ratio:7.2f} x as fast as the UKF   "
                f"errors at the end: median {what['median_error']:.4f} m, mean {what['mean_error']:.4f} m"
            )
    print(f"saved: {save('observer', results, ['torch', 'numpy', 'filterpy', 'numba'])}")
