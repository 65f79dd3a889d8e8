"""python -m benchmarks geometry [--batch 10000] [--updates 300]

Sets in the plane: [-10, 10]^2 and 300 updates of 6 half-spaces. Each update intersects, drops redundant rows and asks
for area, vertices and the Chebyshev centre. torchfsid updates a batch of sets. Its peers update the first set of the
same batch, one at a time. Times are CPU times of one thread, per set and update.

The workload. A truth is uniform in [-5, 5]^2. Rows have random directions, at distances (0.2 .. 1) w_k from it, with
w_k = 10, 9.8, ... down to 0.02: most updates cut. In `thin`, from the second update on, two of the six rows face each
other at a distance `width`, turned by up to a quarter of it. So sets are needles that go on being cut.

An update fails, against the same update in exact rationals, by an exception, an empty or unbounded answer, a truth
outside the hull of the vertices, or an area that is off by more than 1 %. After a failure the peer starts again from
the exact set, so that no update is blamed for an earlier one.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from fractions import Fraction

import numpy as np
import torch

from benchmarks import save
from benchmarks.peers import BOX, PEERS, Answer, installed
from torchfsid.halfspaces import Halfspaces
from torchfsid.sets.feasible_set import FeasibleSet

WIDTHS = {"ordinary": None, "1e-4": 1e-4, "1e-6": 1e-6, "1e-8": 1e-8, "2e-9": 2e-9}
WRONG = 0.01
"""Relative error of the area that counts as a failure."""

Rows = tuple[np.ndarray, np.ndarray]
Edge = tuple[Fraction, Fraction, Fraction]


def truths(batch: int, seed: int) -> np.ndarray:
    """True points, (batch, 2)."""
    return np.random.default_rng(seed).uniform(-5, 5, (batch, 2))


def workload(batch: int, updates: int, width: float | None, seed: int = 0) -> Iterator[Rows]:
    """A (batch, 6, 2) and b (batch, 6) for each update."""
    rng, truth = np.random.default_rng(seed + 1), truths(batch, seed)
    heading = rng.uniform(0, 2 * np.pi, batch)
    for k in range(updates):
        angle, distance = rng.uniform(0, 2 * np.pi, (batch, 6)), rng.uniform(0.2, 1.0, (batch, 6)) * 10 * 0.98**k
        if width is not None and k > 0:
            turned = heading[:, None] + rng.uniform(-0.25, 0.25, (batch, 2)) * width
            angle[:, :2], distance[:, :2] = turned + np.array([0, np.pi]), rng.uniform(0.25, 0.5, (batch, 2)) * width
        A = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        yield A, (A * truth[:, None]).sum(-1) + distance


# The exact answer ---------------------------------------------------------------------------------------------------


class Exact:
    """The set in rationals: a ring of vertices, each with the row of the edge that starts there."""

    def __init__(self) -> None:
        corners = [(-10, -10), (10, -10), (10, 10), (-10, 10)]
        edges = [(0, -1), (1, 0), (0, 1), (-1, 0)]
        self.ring = [
            ((Fraction(x), Fraction(y)), (Fraction(p), Fraction(q), Fraction(10)))
            for (x, y), (p, q) in zip(corners, edges, strict=True)
        ]

    def update(self, A: np.ndarray, b: np.ndarray) -> None:
        """Intersect with A z <= b."""
        for (p, q), c in zip(A.tolist(), b.tolist(), strict=True):
            row = Fraction(p), Fraction(q), Fraction(c)
            over = [row[0] * x + row[1] * y - row[2] for (x, y), _ in self.ring]
            if max(over) <= 0:
                continue
            kept = []
            for i, ((x, y), edge) in enumerate(self.ring):
                j = (i + 1) % len(self.ring)
                if over[i] <= 0:
                    kept.append(((x, y), row if over[i] == 0 < over[j] else edge))
                if over[i] * over[j] < 0:
                    (v, w), share = self.ring[j][0], over[i] / (over[i] - over[j])
                    kept.append(((x + share * (v - x), y + share * (w - y)), row if over[i] < 0 else edge))
            self.ring = kept

    def area(self) -> float:
        """The area, rounded to a double."""
        points = [point for point, _ in self.ring]
        following = points[1:] + points[:1]
        return float(sum((x * w - y * v for (x, y), (v, w) in zip(points, following, strict=True)), Fraction(0)) / 2)

    def rows(self) -> Rows:
        """The irredundant rows as doubles."""
        table = np.array([[float(part) for part in edge] for _, edge in self.ring])
        return table[:, :2], table[:, 2]


# Runs ---------------------------------------------------------------------------------------------------------------


class Ours:
    """torchfsid with one set at a time, judged as the peers are."""

    def start(self, A: np.ndarray, b: np.ndarray) -> None:
        corner = torch.full((1, 2), 10.0, dtype=torch.float64)
        self.set = FeasibleSet.from_box(-corner, corner)
        self.set = self.set.intersect(Halfspaces(torch.from_numpy(A)[None], torch.from_numpy(b)[None]))

    def update(self, A: np.ndarray, b: np.ndarray) -> Answer:
        self.set = self.set.intersect(Halfspaces(torch.from_numpy(A)[None], torch.from_numpy(b)[None]))
        centre = self.set.chebyshev()[0]
        return float(self.set.volume()), self.set.vertices()[0].numpy(), centre[0].numpy()


def judge(answer: Answer, area: float, truth: np.ndarray) -> str | None:
    """What is wrong with an answer, in words. None if it is right."""
    found, ring, _ = answer
    if not np.isfinite(found) or len(ring) < 3:
        return "empty"
    start, end = ring - truth, np.roll(ring, -1, axis=0) - truth
    turn = start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]
    across = turn * np.sign(turn.sum()) / np.maximum(np.linalg.norm(end - start, axis=1), 1e-300)
    if across.min() < -1e-13:  # the truth is outside, by more than the round-off of coordinates of size 10
        return "truth lost"
    return "area" if abs(found - area) > WRONG * area else None


def run_alone(make: Callable, rows: list[Rows], truth: np.ndarray) -> dict:
    """CPU times, failures and errors of one set, update by update."""
    exact, peer, spent, failures, errors = Exact(), make(), [], Counter(), []
    peer.start(*BOX)
    for A, b in rows:
        exact.update(A, b)
        area, began = exact.area(), time.process_time()
        try:
            answer = peer.update(A, b)
            spent.append(time.process_time() - began)
            failure = judge(answer, area, truth)
        except Exception as error:  # any exception of a library is its answer
            answer, failure = None, type(error).__name__
        if failure is None:
            assert answer is not None
            errors.append(abs(answer[0] - area) / area)
        else:
            failures[failure] += 1
            peer = make()
            peer.start(*exact.rows())
    return {
        "microseconds": 1e6 * float(np.mean(spent)) if spent else None,
        "failed": sum(failures.values()) / len(rows),
        "failures": dict(failures),
        "worst_area_error": max(errors, default=None),
    }


def run_batch(batch: int, updates: int, width: float | None) -> dict:
    """CPU time of a batch, per set and update [s], and the number of lost truths."""
    corner = torch.full((batch, 2), 10.0, dtype=torch.float64)
    sets, truth, spent, cut = FeasibleSet.from_box(-corner, corner), torch.from_numpy(truths(batch, 0)), 0.0, 0
    for k, (A, b) in enumerate(workload(batch, updates, width)):
        halfspaces, began = Halfspaces(torch.from_numpy(A), torch.from_numpy(b)), time.process_time()
        sets = sets.intersect(halfspaces, float(k))
        sets.volume(), sets.vertices(), sets.chebyshev()
        spent += time.process_time() - began
        cut += int((sets.last_cut == k).sum())
    lost = int((~sets.contains(truth) | sets.is_empty).sum())
    return {"microseconds": 1e6 * spent / batch / updates, "share_cut": cut / batch / updates, "truths_lost": lost}


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks geometry")
    parser.add_argument("--batch", type=int, default=10_000)
    parser.add_argument("--updates", type=int, default=300)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    run_batch(2, 3, None)  # compile
    names = installed()
    results: dict = {"batch": options.batch, "updates": options.updates, "wrong": WRONG, "workloads": {}}
    for name, width in WIDTHS.items():
        rows, truth = (
            [(A[0], b[0]) for A, b in workload(options.batch, options.updates, width)],
            truths(options.batch, 0)[0],
        )
        found = {
            "torchfsid, batch": run_batch(options.batch, options.updates, width),
            "torchfsid, one set": run_alone(Ours, rows, truth),
        }
        found |= {peer: run_alone(PEERS[peer], rows, truth) for peer in names}
        results["workloads"][name] = found
        times = {peer: found[peer]["microseconds"] or np.inf for peer in names}
        fastest = min(times, key=times.__getitem__)
        found["fastest peer"] = {"name": fastest, "microseconds": times[fastest]}
        print(f"\n{name if width is None else 'thin, width ' + name}")
        for who, what in found.items():
            if "name" in what:
                continue
            ratio = found[fastest]["microseconds"] / what["microseconds"] if what["microseconds"] else float("nan")
            how = f"failed {what['failed']:6.1%} {what['failures'] or ''}" if "failed" in what else (
                f"truths lost {what['truths_lost']} of {options.batch}, {what['share_cut']:.0%} of the sets cut"
            )  # fmt: skip
            print(
                f"  {who:28s} {what['microseconds'] or float('nan'):9.1f} us  {ratio:7.2f} x the fastest peer   {how}"
            )
    missing = sorted(set(PEERS) - set(names))
    results["missing"] = missing
    if missing:
        print(f"not installed: {', '.join(missing)} (extra bench, docs/benchmarks.md)")
    packages = ["torch", "numpy", "numba", *(package for peer in names for package in PEERS[peer]().packages)]
    print(f"saved: {save('geometry', results, packages)}")
