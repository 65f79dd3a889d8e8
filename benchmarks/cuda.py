"""python -m benchmarks cuda [--sizes 10000 100000 1000000] [--steps 12]

Updates of a fleet's sets on a GPU, from the rows on: what a measurement says of each robot (8 neighbours, noisy
controls, see `scenario`), and the cut of its set. All numbers are on the device before, and the sets stay there. Each
size is also observed by the whole `SetMembershipObserver.update`, rows from positions included. In the same run: the
torch path on the same card, one CPU core with the same kernels, and the time a copy of the bytes takes that an update
must read and write. The first steps, with the compilation, are not counted. Truths lost must be 0.

Without a device it says so, and measures nothing.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from benchmarks import save
from benchmarks.scenario import Fleet, measured, observer
from torchfsid import device
from torchfsid.identification.evidence import Evidence, ObservationModel, Sample, read_sample, sample_of
from torchfsid.kernels.compiled import SIMULATED
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.measurement import Measurement
from torchfsid.sets.feasible_set import FeasibleSet

SIZES, ON_ONE_CORE, IN_TORCH, WARM = (10_000, 100_000, 1_000_000), 100_000, 100_000, 3


def moved(measurement: Measurement, to: str) -> Measurement:
    """The measurement on another device."""
    tensors = {name: value.to(to) for name, value in vars(measurement).items() if isinstance(value, Tensor)}
    return replace(measurement, **tensors)


def fleet_of(robots: int, steps: int) -> tuple[Fleet, list[Measurement]]:
    """A fleet and its measurements. A large one repeats a smaller one, since it is simulated on the CPU."""
    part = Fleet(min(robots, 100_000), noisy=True)
    times = robots // len(part.goals)
    parts = [measured(*moment) for moment in itertools.islice(part, steps)]
    tensors = ({name: value for name, value in vars(p).items() if isinstance(value, Tensor)} for p in parts)
    whole = [
        replace(p, **{name: value.repeat(times, *[1] * (value.ndim - 1)) for name, value in of.items() if value.ndim})
        for p, of in zip(parts, tensors, strict=True)
    ]
    part.goals = part.goals.repeat(times, 1)
    return part, whole


def timed(where: str, step: Callable[[], object]) -> float:
    """The time that a step takes until the device has done it [s]."""
    began = time.perf_counter()
    step()
    if where == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - began


def bytes_of(sample: Sample, read: Evidence, sets: FeasibleSet) -> int:
    """The bytes that an update reads and writes: rows and controls, what they say (twice), and sets (twice)."""
    rows = sample.rows.A, sample.rows.b, sample.C, sample.d, sample.u
    said = read.omega.A, read.omega.b, read.omega.source, read.slack, read.excess
    solved = read.kkt.G, read.kkt.f, read.kkt.projector, read.kkt.free, read.kkt.offset, read.kkt.active
    half_spaces, others = said[:3], (*rows, *said, *solved)
    return sum(part.nbytes for part in (*others, *half_spaces, *sets.body.fields(), *sets.body.fields()))


class Kernels:
    """The two kernels alone: `read_sample` and the clip of the sets, from samples that are evaluated before."""

    def __init__(self, model: ObservationModel, prior: FeasibleSet, measurements: list[Measurement]) -> None:
        self.model, self.sets = model, prior
        self.measurements = measurements
        self.sample, self.read = sample_of(model, prior, measurements[0]), None

    def steps(self) -> Iterator[Callable[[], object]]:
        for measurement in self.measurements:
            self.sample = sample_of(self.model, self.sets, measurement)
            if self.sample.u.is_cuda:
                torch.cuda.synchronize()
            yield self._step(measurement.time)

    def _step(self, t: float) -> Callable[[], object]:
        sample = self.sample
        stamp = sample.rows.b.new_full((len(sample.u), 1), t)

        def step() -> None:
            self.read = read_sample(self.model, sample, True)
            omega, body = self.read.omega, self.sets.body
            times = stamp.expand_as(omega.b)
            clipped = body.clip(omega.A, omega.b, times, omega.source, self.sets.max_facets)
            self.sets = replace(self.sets, body=clipped.body)

        return step


def one(robots: int, steps: int, where: str, compiled: bool) -> dict:
    """Times of an update [s], by the kernels alone and by the whole observer, with the truths that are lost."""
    fleet, measurements = fleet_of(robots, steps)
    corner = torch.full((robots, 2), fleet.half + 1, dtype=torch.float64, device=where)
    prior, goals = FeasibleSet.from_box(-corner, corner), fleet.goals.to(where)
    there = [moved(measurement, where) for measurement in measurements]
    watching: SetMembershipObserver = observer(prior, compiled)
    result: dict = {"robots": robots, "where": where, "compiled": compiled}
    spent = [timed(where, partial(watching.update, seen)) for seen in there]
    result["update_s"] = float(np.median(spent[WARM:]))
    result["truths_lost"] = int((~watching.feasible_set.contains(goals)).sum())
    if compiled:
        alone = Kernels(watching.model, prior, there)
        spent = [timed(where, step) for step in alone.steps()]
        result["kernels_s"] = float(np.median(spent[WARM:]))
        assert alone.read is not None
        result["bytes"] = bytes_of(alone.sample, alone.read, alone.sets)
        result["truths_lost"] += int((~alone.sets.contains(goals)).sum())
    return result


def copy_bandwidth() -> float:
    """Bytes a second that a copy on the device reads and writes."""
    source = torch.ones(2**27, dtype=torch.float64, device="cuda")
    target = torch.empty_like(source)
    spent = [timed("cuda", partial(target.copy_, source)) for _ in range(WARM + 10)]
    return 2 * source.nbytes / float(np.median(spent[WARM:]))


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks cuda")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--steps", type=int, default=12)
    options = parser.parse_args(arguments)
    if SIMULATED or not torch.cuda.is_available():
        print("benchmarks cuda: torch finds no CUDA device here, so that nothing was measured")
        return
    if device.missing():
        sys.exit(f"benchmarks cuda: {device.missing()}")
    torch.set_num_threads(1)
    bandwidth, card = copy_bandwidth(), torch.cuda.get_device_name()
    print(f"{card}: a copy moves {bandwidth / 1e12:.2f} TB/s")
    results: dict = {"card": card, "copy_bytes_per_second": bandwidth, "runs": []}
    for robots in options.sizes:
        ways = [("cuda", True)]
        ways += [("cpu", True)] if robots <= ON_ONE_CORE else []
        ways += [("cuda", False)] if robots <= IN_TORCH else []
        for where, compiled in ways:
            run = one(robots, options.steps, where, compiled)
            results["runs"].append(run)
            name = {"cpu": "one core", "cuda": "device" if compiled else "torch on it"}[where]
            line = f"  B = {robots:8d}, {name:12s} update {run['update_s'] * 1e3:9.3f} ms"
            line += f" ({robots / run['update_s'] / 1e6:.3f} M robot-updates/s)"
            if compiled:
                line += f", read and clip {run['kernels_s'] * 1e3:9.3f} ms ({robots / run['kernels_s'] / 1e6:.2f} M/s)"
            if where == "cuda" and compiled:
                run["share_of_copy"] = run["bytes"] / bandwidth / run["kernels_s"]
                line += f", {run['bytes'] / robots:.0f} bytes each, {run['share_of_copy']:.1%} of a copy's speed"
            print(f"{line}; truths lost {run['truths_lost']}", flush=True)
    print(f"saved: {save('cuda', results, ['torch', 'numpy', 'numba'])}")
