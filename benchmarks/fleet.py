"""python -m benchmarks fleet [--steps 40] [--long 10000]

The whole observer update (rows from positions, active set, KKT conditions, half-spaces, clipping) for fleets of 1 to
100 000 robots with 8 neighbours each (`scenario`), starting from the prior. The result is robot-updates per second of
CPU time on one thread. The search of the neighbours is not part of the observer and is timed separately. Ten fleets of
1000 robots give that size as many robots as the others.

Further tables: the same robots among more or fewer neighbours; robots whose nominal control is clipped; one robot,
update by update; and a fleet over many steps, whose cost must not grow.
"""

from __future__ import annotations

import argparse
import itertools
import resource
import time
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from benchmarks import save
from benchmarks.scenario import NEIGHBOURS, SHARES, Clip, Fleet, measured, observer

SIZES, LEAST, BLOCK = (1_000, 10_000, 100_000), 10_000, 10
CROWDS = (4, 8, 16, 32)


def _blocks(fleet: Fleet, steps: int) -> Iterator[list[tuple[float, Tensor, Tensor]]]:
    """The measurements in blocks of some times. Simulating a block at once leaves the observer's caches alone."""
    moments = itertools.islice(fleet, steps)
    while block := list(itertools.islice(moments, BLOCK)):
        yield block


def run(
    robots: int,
    steps: int,
    noisy: bool,
    compiled: bool,
    fleets: int = 1,
    neighbours: int = NEIGHBOURS,
    clip: Clip | None = None,
) -> dict:
    """Observe some fleets from the prior on, one after the other. Times are per robot and update [us]."""
    spent, search, cut, used, active, lost = [], 0.0, 0, 0, 0, 0
    for seed in range(fleets):
        fleet = Fleet(robots, noisy, seed, clip)
        watching = observer(fleet.prior(), compiled, fleet.task)
        for moments in _blocks(fleet, steps):
            began = time.process_time()
            block = [measured(*moment, neighbours=neighbours) for moment in moments]
            search += time.process_time() - began
            for measurement in block:
                began = time.process_time()
                estimate = watching.update(measurement)
                spent.append(time.process_time() - began)
                cut += int((estimate.feasible_set.last_cut == measurement.t).sum())
                used += int(estimate.informative.sum())
                active += int((estimate.kkt.n_active > 0).sum())
        lost += int((~watching.feasible_set.contains(fleet.goals)).sum())
    body, count = watching.feasible_set.body, robots * steps * fleets
    late = np.array(spent).reshape(fleets, steps)[:, -steps // 4 :]
    return {
        "robots": robots,
        "neighbours": neighbours,
        "fleets": fleets,
        "steps": steps,
        "noisy": noisy,
        "clip": clip,
        "per_second": count / sum(spent),
        "microseconds": 1e6 * sum(spent) / count,
        "last_microseconds": 1e6 * float(np.median(late)) / robots,
        "search_microseconds": 1e6 * search / count,
        "share_cut": cut / count,
        "share_used": used / count,
        "share_active": active / count,
        "truths_lost": lost,
        "set_bytes_per_robot": sum(field.nbytes for field in body.fields()) / robots,
        "facets": float(body.count.double().mean()),
    }


def run_alone(steps: int, compiled: bool) -> dict:
    """Observe one robot among nine. Wall-clock times of single updates [us], which are what its user waits for."""
    fleet, spent = Fleet(NEIGHBOURS + 1), []
    watching = observer(fleet.prior().select(torch.tensor([0])), compiled)
    for t, x, u in itertools.islice(fleet, steps):
        measurement, began = measured(t, x, u, range(1)), time.perf_counter()
        watching.update(measurement)
        spent.append(1e6 * (time.perf_counter() - began))
    return {"steps": steps, **dict(zip(("median", "p90"), np.quantile(spent[5:], (0.5, 0.9)).tolist(), strict=True))}


def run_long(robots: int, steps: int, compiled: bool) -> dict:
    """Cost per robot and update [us], and slots of the sets, along a long run in ten parts."""
    fleet, spent, slots = Fleet(robots, noisy=True), [], []
    watching = observer(fleet.prior(), compiled)
    for t, x, u in itertools.islice(fleet, steps):
        measurement, began = measured(t, x, u), time.process_time()
        watching.update(measurement)
        spent.append(time.process_time() - began)
        slots.append(watching.feasible_set.body.slots)
    pieces = np.array_split(np.array(spent), 10)
    return {
        "robots": robots,
        "steps": steps,
        "microseconds": [1e6 * float(np.median(piece)) / robots for piece in pieces],
        "slots": [int(piece[-1]) for piece in np.array_split(np.array(slots), 10)],
        "truths_lost": int((~watching.feasible_set.contains(fleet.goals)).sum()),
    }


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks fleet")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--long", type=int, default=10_000)
    parser.add_argument("--largest", type=int, default=SIZES[-1])
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    ways = {"torch": False, "compiled": True}
    results: dict = {"neighbours": NEIGHBOURS}
    for way, compiled in ways.items():
        run(1000, 2, True, compiled)  # compile the kernels and load lazy modules
        sizes = [(robots, noisy) for noisy in (False, True) for robots in SIZES if robots <= options.largest]
        rows = [run(B, options.steps, noisy, compiled, max(1, LEAST // B)) for B, noisy in sizes]
        crowds = [run(1000, options.steps, True, compiled, LEAST // 1000, M) for M in CROWDS]
        clips = [run(LEAST, options.steps, True, compiled, clip=clip) for clip in SHARES]
        alone, long = run_alone(2000, compiled), run_long(200, options.long, compiled)
        results[way] = {"fleets": rows, "crowds": crowds, "clipped": clips, "alone": alone, "long": long}
        print(f"\n{way}")
        for row in rows:
            print(
                f"  B = {row['robots']:7d}, {'noisy' if row['noisy'] else 'exact'}: "
                f"{row['per_second']:9.0f} updates/s, "
                f"{row['microseconds']:.2f} us each (last quarter {row['last_microseconds']:.2f}); "
                f"cut {row['share_cut']:.0%}, active {row['share_active']:.0%}, used {row['share_used']:.1%}, "
                f"truths lost {row['truths_lost']}; {row['set_bytes_per_robot']:.0f} bytes; "
                f"neighbours {row['search_microseconds']:.2f} us"
            )
        print("  B = 1000, noisy: " + ", ".join(f"M = {c['neighbours']}: {c['microseconds']:.2f} us" for c in crowds))
        print(f"  B = 1: median {alone['median']:.0f} us, 90 % below {alone['p90']:.0f} us")
        along, slots = ", ".join(f"{cost:.2f}" for cost in long["microseconds"]), long["slots"]
        print(f"  {long['steps']} steps of {long['robots']} robots: {along} us; slots {slots[0]}..{slots[-1]}")
    for before, after in zip(results["torch"]["clipped"], results["compiled"]["clipped"], strict=True):
        slow, fast = before["microseconds"], after["microseconds"]
        print(
            f"  B = {after['robots']}, noisy, clipped by {after['clip']}: torch {slow:.2f} us, compiled {fast:.2f} us, "
            f"{slow / fast:.1f} x as fast; truths lost {after['truths_lost']}"
        )
    results["peak_memory_MiB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\npeak memory {results['peak_memory_MiB']:.0f} MiB")
    print(f"saved: {save('fleet', results, ['torch', 'numpy', 'scipy', 'numba'])}")
