"""python -m benchmarks cuda [--sizes 10000 100000 1000000] [--steps 12]

A fleet's sets on a GPU (8 neighbours, noisy controls, see `scenario`), the exact layers (`cuda_layers`), a gradient
step of the probe design (`cuda_probe`) and robots in space (`cuda_space`). Each part prints its own lines and is saved
when it is done. One that fails prints why, and the others go on. Truths lost must be 0.

Read and clip: what a measurement says of each robot, and the cut of its set, from rows on the device that lie side by
side (`device`). Update: the whole `SetMembershipObserver.update`, rows from positions included. Times are of one after
the other, each until the device has done it; in brackets, how long the host was busy. Read and clip are also timed in a
row, without waiting in between. In the same run: the torch path on the same card, one CPU core with the same kernels,
and the time that a copy of the bytes takes which an update reads and writes. First steps, with the compilation, are not
counted.

Without a device it says so, and measures nothing.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from importlib import import_module
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks import save
from benchmarks.scenario import BARRIER, ERROR, TASK, Fleet, measured, observer
from torchfsid import device
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import Evidence, ObservationModel, Sample, read_sample, sample_of
from torchfsid.kernels.compiled import SIMULATED
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import LeftOut, Measurement
from torchfsid.sets.feasible_set import FeasibleSet

SIZES, SIMULATED_ROBOTS, ON_ONE_CORE, IN_TORCH, WARM, FEW = (10_000, 100_000, 1_000_000), 50_000, 100_000, 10_000, 3, 5
TARGETS = {10_000: 15e6, 1_000_000: 150e6}
"""Robot-updates a second on an H100, read and clip."""


@cache
def simulated(robots: int, steps: int) -> tuple[Fleet, list[Measurement]]:
    """A fleet and its measurements."""
    fleet = Fleet(robots, noisy=True)
    return fleet, [measured(*moment) for moment in itertools.islice(fleet, steps)]


def fleet_of(robots: int, steps: int, where: str) -> tuple[FeasibleSet, Tensor, list[Measurement]]:
    """The priors, the goals and the measurements of a fleet. A large one repeats one simulated on the CPU."""
    fleet, parts = simulated(min(robots, SIMULATED_ROBOTS), steps)
    times = robots // len(fleet.goals)

    def repeated(value: Any) -> Any:
        if isinstance(value, LeftOut):
            return LeftOut(*map(repeated, value))
        return value.to(where).repeat(times, *[1] * (value.ndim - 1)) if isinstance(value, Tensor) else value

    goals = repeated(fleet.goals)
    corner = torch.full_like(goals, fleet.half + 1)
    there = [replace(part, **{name: repeated(value) for name, value in vars(part).items()}) for part in parts]
    return FeasibleSet.from_box(-corner, corner), goals, there


def wait(where: str) -> None:
    if where == "cuda":
        torch.cuda.synchronize()


def timed(where: str, step: Callable[[], object]) -> tuple[float, float]:
    """How long a step takes until the device has done it, and how long the host was busy with it [s]."""
    began = time.perf_counter()
    step()
    left = time.perf_counter()
    wait(where)
    return time.perf_counter() - began, left - began


def laid_out(sample: Sample) -> Sample:
    """The sample with tensors as the device's kernels take them."""
    A, b = map(device.side_by_side, (sample.rows.A, sample.rows.b))
    C, d, u = map(device.side_by_side, (sample.C, sample.d, sample.u))
    return replace(sample, rows=Halfspaces(A, b), C=C, d=d, u=u)


def bytes_of(sample: Sample, read: Evidence, sets: FeasibleSet) -> int:
    """The bytes that an update reads and writes: rows and controls, half-spaces (twice) and sets (twice)."""
    rows, said = (sample.rows.A, sample.rows.b, sample.C, sample.d, sample.u), read.omega
    twice = said.A, said.b, *(() if said.source is None else (said.source,)), *sets.body.fields()
    return sum(part.nbytes for part in (*rows, *twice, *twice))


class Kernels:
    """The kernels alone: `read_sample` and the clip of the sets, from samples that are evaluated before."""

    def __init__(self, prior: FeasibleSet, measurements: Sequence[Measurement], where: str) -> None:
        self.model, self.sets, self.where = ObservationModel(TASK, [BARRIER], noise=NoiseBound(ERROR)), prior, where
        samples = [sample_of(self.model, prior, measurement) for measurement in measurements]
        self.samples = [laid_out(sample) if where == "cuda" else sample for sample in samples]
        self.read, self.stamp = read_sample(self.model, self.samples[0], True), prior.last_cut.new_zeros(())
        self.marks: list[Any] = []

    def step(self, sample: Sample) -> None:
        self.mark()
        self.read = read_sample(self.model, sample, True)
        omega, body = self.read.omega, self.sets.body
        self.mark()
        clipped = body.clip(omega.A, omega.b, self.stamp.expand_as(omega.b), omega.source, self.sets.max_facets)
        self.sets = replace(self.sets, body=clipped.body)
        self.mark()

    def mark(self) -> None:
        """Note the time on the device."""
        if self.where == "cuda":
            self.marks.append(torch.cuda.Event(enable_timing=True))
            self.marks[-1].record()

    def run(self) -> dict[str, float]:
        """Medians of a step's times [s]: in all, of the host, in a row, and of the two parts on the device."""
        prior = self.sets
        spent, busy = np.transpose([timed(self.where, partial(self.step, sample)) for sample in self.samples])
        marks, found, self.sets = self.marks, self.sets, prior
        found_times = {"kernels_s": float(np.median(spent[WARM:])), "kernels_host_s": float(np.median(busy[WARM:]))}
        for sample in self.samples[:WARM]:
            self.step(sample)
        wait(self.where)
        together, _ = timed(self.where, lambda: [self.step(sample) for sample in self.samples[WARM:]])
        found_times["in_a_row_s"] = together / len(self.samples[WARM:])
        for name, first in (("read_on_device_s", 0), ("clip_on_device_s", 1)) if marks else ():
            parts = zip(marks[first::3], marks[first + 1 :: 3], strict=False)
            found_times[name] = float(np.median([a.elapsed_time(b) for a, b in parts][WARM:])) / 1e3
        self.sets = found
        return found_times


def one(robots: int, steps: int, where: str, compiled: bool) -> dict:
    """Times of an update [s], by the kernels alone and by the whole observer, with the truths that are lost."""
    prior, goals, there = fleet_of(robots, steps, where)
    watching = observer(prior, compiled)
    result: dict = {"robots": robots, "where": where, "compiled": compiled}
    spent, busy = np.transpose([timed(where, partial(watching.update, seen)) for seen in there])
    result["update_s"], result["update_host_s"] = float(np.median(spent[WARM:])), float(np.median(busy[WARM:]))
    result["truths_lost"] = int((~watching.feasible_set.contains(goals)).sum())
    if compiled:
        del watching
        alone = Kernels(prior, there, where)
        result |= alone.run()
        result["bytes"] = bytes_of(alone.samples[0], alone.read, alone.sets)
        result["truths_lost"] += int((~alone.sets.contains(goals)).sum())
    return result


def copy_bandwidth() -> float:
    """Bytes a second that a copy on the device reads and writes."""
    source = torch.ones(2**27, dtype=torch.float64, device="cuda")
    target = torch.empty_like(source)
    spent = [timed("cuda", partial(target.copy_, source))[0] for _ in range(WARM + 10)]
    return 2 * source.nbytes / float(np.median(spent[WARM:]))


def line_of(run: dict, bandwidth: float) -> str:
    """A run in words."""
    robots, on_device = run["robots"], run["where"] == "cuda"
    name = "one core" if not on_device else "device" if run["compiled"] else "torch on it"
    line = f"  B = {robots:8d}, {name:12s} update {run['update_s'] * 1e3:9.3f} ms"
    line += f" ({robots / run['update_s'] / 1e6:.3f} M robot-updates/s)"
    if run["compiled"]:
        rate = robots / run["kernels_s"]
        line += f", read and clip {run['kernels_s'] * 1e3:9.3f} ms ({rate / 1e6:.2f} M/s"
        line += f", in a row {robots / run['in_a_row_s'] / 1e6:.2f} M/s)"
        if on_device and robots in TARGETS:
            met = "met" if rate >= TARGETS[robots] else "missed"
            line += f", target {TARGETS[robots] / 1e6:.0f} M/s: {met}"
    if run["compiled"] and on_device:
        share = run["bytes"] / bandwidth / run["kernels_s"]
        line += f"; {run['bytes'] / robots:.0f} bytes each, {share:.1%} of a copy's speed\n{'':27s}host busy "
        host, update = run["kernels_host_s"] * 1e3, run["update_host_s"] * 1e3
        line += f"{host:.3f} ms of read and clip, {update:.3f} ms of an update; on the device read "
        line += f"{run['read_on_device_s'] * 1e3:.3f} ms, clip {run['clip_on_device_s'] * 1e3:.3f} ms"
    return f"{line}; truths lost {run['truths_lost']}"


def fleets(sizes: Sequence[int], steps: int) -> dict:
    """Measure the fleets and print what was measured."""
    card, bandwidth = torch.cuda.get_device_name(), copy_bandwidth()
    print(f"{card}: a copy moves {bandwidth / 1e12:.2f} TB/s", flush=True)
    results: dict = {"card": card, "copy_bytes_per_second": bandwidth, "runs": []}
    for robots in sizes:
        ways = [("cuda", True, steps)]
        ways += [("cpu", True, steps)] if robots <= ON_ONE_CORE else []
        ways += [("cuda", False, FEW)] if robots <= IN_TORCH else []
        for way in ways:
            try:
                run = one(robots, way[2], *way[:2])
            except Exception:
                traceback.print_exc()
                run = {"robots": robots, "where": way[0], "compiled": way[1], "failed": traceback.format_exc()}
            else:
                print(line_of(run, bandwidth), flush=True)
            results["runs"].append(run)
            torch.cuda.empty_cache()
    return results


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
    parts: dict[str, Callable[[], dict]] = {
        "fleet": partial(fleets, options.sizes, options.steps),
        "layers": lambda: import_module("benchmarks.cuda_layers").compare(),
        "probe": lambda: import_module("benchmarks.cuda_probe").compare(),
        "space": lambda: import_module("benchmarks.cuda_space").compare(),
    }
    results, began = {}, time.perf_counter()
    for name, part in parts.items():
        try:
            results[name] = part()
        except Exception:
            traceback.print_exc()
            results[name] = {"failed": traceback.format_exc()}
        print(f"{name}: {time.perf_counter() - began:.0f} s so far", flush=True)
        path = save("cuda", results, ["torch", "numpy", "numba"])
    print(f"saved: {path}")
