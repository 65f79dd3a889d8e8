"""python -m benchmarks polyhedra [--batch 1000] [--updates 60] [--alone 12]

Sets of three parameters: [-10, 10]^3 and updates of 12 half-spaces, as in `geometry`. Each update intersects, drops
redundant rows, merges to 32 facets and asks for volume, centroid and diameter. Compared are, on the same rows:

    polyhedron    compiled (`sets.Polyhedron`), a batch, and one set at a time
    polytope      numpy, for any dimension (`sets.Polytope`): what sets of three parameters were before
    Qhull         scipy's HalfspaceIntersection about HiGHS' Chebyshev centre, and ConvexHull

Times are CPU times of one thread, per set and update. An update fails by an exception, by a truth outside of its rows,
or by a volume that is off by more than 1 %, against the hull of the vertices in exact rationals. After a failure the
peer starts again from the exact set. In `round` all rows nearly touch a ball that shrinks: every row cuts, and a dozen
facets are merged in each update. `unknown gain` observes one robot in the plane whose gain is unknown.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from fractions import Fraction
from itertools import islice
from math import inf

import numpy as np
import torch
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection

from benchmarks import save
from tests.polytopes import exact_vertices
from torchfsid.halfspaces import Halfspaces
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import UnknownGainGoalTask
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.sets.polytope import Polytope

WIDTHS = {"ordinary": None, "1e-4": 1e-4, "1e-6": 1e-6, "1e-8": 1e-8}
ROWS, HALF, WRONG = 12, 10.0, 0.01

Rows = tuple[np.ndarray, np.ndarray]
Answer = tuple[float, np.ndarray, np.ndarray]
"""Volume, and the rows A and b of the set."""


def truths(batch: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-5, 5, (batch, 3))


def workload(batch: int, width: float | None) -> Iterator[Rows]:
    """A (batch, 12, 3) and b (batch, 12) for each update. If thin, two rows face each other from the second one on. An
    infinite width stands for `round`."""
    rng, truth, k = np.random.default_rng(1), truths(batch), 0
    across = rng.normal(size=(batch, 3))
    while True:
        A, distance = rng.normal(size=(batch, ROWS, 3)), rng.uniform(0.2, 1.0, (batch, ROWS)) * HALF * 0.98**k
        if width == inf:
            distance = rng.uniform(0.95, 1.0, (batch, ROWS)) * HALF / 2 * 0.98**k
        elif width is not None and k > 0:
            A[:, 0] = across + width * rng.uniform(-0.25, 0.25, (batch, 3))
            A[:, 1] = width * rng.uniform(-0.25, 0.25, (batch, 3)) - across
            distance[:, :2] = rng.uniform(0.25, 0.5, (batch, 2)) * width
        A /= np.linalg.norm(A, axis=-1, keepdims=True)
        yield A, (A * truth[:, None]).sum(-1) + distance
        k += 1


def prior(batch: int, numpy: bool = False) -> FeasibleSet:
    """The sets to begin with, as polyhedra or in numpy."""
    corner = torch.full((batch, 3), HALF, dtype=torch.float64)
    start = FeasibleSet.from_box(-corner, corner)
    return replace(start, body=Polytope.from_box(-corner, corner)) if numpy else start


class Ours:
    """One set of torchfsid."""

    def __init__(self, numpy: bool) -> None:
        self.numpy = numpy

    def start(self, A: np.ndarray, b: np.ndarray) -> None:
        self.set = prior(1, self.numpy).intersect(Halfspaces(torch.from_numpy(A)[None], torch.from_numpy(b)[None]))

    def update(self, A: np.ndarray, b: np.ndarray) -> Answer:
        self.set = self.set.intersect(Halfspaces(torch.from_numpy(A)[None], torch.from_numpy(b)[None]))
        volume, _, _ = self.set.volume(), self.set.centroid(), self.set.diameter()
        facets = self.set.facets().halfspaces
        return float(volume), facets.A[0].numpy(), facets.b[0].numpy()


class Qhull:
    """HiGHS and Qhull, as their manuals say."""

    def start(self, A: np.ndarray, b: np.ndarray) -> None:
        self.A, self.b = A, b

    def update(self, A: np.ndarray, b: np.ndarray) -> Answer:
        A, b = np.vstack([self.A, A]), np.append(self.b, b)
        rows = np.column_stack([A, np.linalg.norm(A, axis=1)])
        ball = linprog([0, 0, 0, -1], A_ub=rows, b_ub=b, bounds=[(None, None)] * 3 + [(0, None)])
        found = HalfspaceIntersection(np.column_stack([A, -b]), ball.x[:3])
        self.A, self.b = A[found.dual_vertices], b[found.dual_vertices]
        return ConvexHull(found.intersections).volume, self.A, self.b


def exact_volume(A: np.ndarray, b: np.ndarray) -> float:
    """The volume of the hull of the exact vertices, in the frame of the set."""
    vertices = exact_vertices(A, b)
    y = np.array([[float(x - x0) for x, x0 in zip(z, vertices[0], strict=True)] for z in vertices])
    y -= y.mean(0)
    _, spread, axes = np.linalg.svd(y, full_matrices=False)
    return ConvexHull(y @ axes.T / spread, qhull_options="QJ").volume * float(spread.prod())


def needed(A: np.ndarray, b: np.ndarray) -> Rows:
    """The rows on which an exact vertex lies."""
    points, kept = exact_vertices(A, b), []
    for i, row in enumerate(np.column_stack([A, b]).tolist()):
        *a, c = map(Fraction, row)
        if sum(sum(x * z for x, z in zip(a, point, strict=True)) == c for point in points) >= 3:
            kept.append(i)
    return A[kept], b[kept]


def alone(make: Callable, rows: list[Rows], exact: list[tuple[float, Rows]], truth: np.ndarray) -> dict:
    """CPU times and failures of one set, update by update."""
    peer, spent, failures = make(), [], Counter()
    peer.start(*box())
    for (A, b), (volume, facets) in zip(rows, exact, strict=True):
        began = time.process_time()
        try:
            found, own_A, own_b = peer.update(A, b)
            spent.append(time.process_time() - began)
            lost = (own_A @ truth > own_b).any()
            failure = "truth lost" if lost else "volume" if abs(found - volume) > WRONG * volume else None
        except Exception as error:  # any exception of a library is its answer
            failure = type(error).__name__
        if failure is not None:
            failures[failure] += 1
            peer = make()
            peer.start(*facets)
    best = 1e6 * float(np.median(spent)) if spent else None
    return {"microseconds": best, "failed": sum(failures.values()), "of": len(rows), "failures": dict(failures)}


def box() -> Rows:
    return np.vstack([-np.eye(3), np.eye(3)]), np.full(6, HALF)


def exact_sets(rows: list[Rows]) -> list[tuple[float, Rows]]:
    """The exact volume and facets after each update."""
    (A, b), found = box(), []
    for more_A, more_b in rows:
        A, b = needed(np.vstack([A, more_A]), np.append(b, more_b))
        found.append((exact_volume(A, b), (A, b)))
    return found


def batch_of(sets: FeasibleSet, rows: list[Rows], truth: np.ndarray) -> dict:
    """CPU times of a batch, per set and update: of clips alone, and of clips with volume, centroid and diameter."""
    clips = measures = 0.0
    for k, (A, b) in enumerate(rows):
        halfspaces, began = Halfspaces(torch.from_numpy(A), torch.from_numpy(b)), time.process_time()
        sets = sets.intersect(halfspaces, float(k))
        clips += time.process_time() - began
        sets.volume(), sets.centroid(), sets.diameter()
        measures += time.process_time() - began
    updates = len(rows) * len(truth)
    lost = int((~sets.contains(torch.from_numpy(truth)) | sets.is_empty).sum())
    return {"clip": 1e6 * clips / updates, "update": 1e6 * measures / updates, "truths_lost": lost}


def unknown_gain(numpy: bool, steps: int) -> dict:
    """The median and the mean CPU time of an update of one robot in the plane with an unknown gain [us]."""
    task, avoidance = UnknownGainGoalTask(), CollisionAvoidance(ClassK(1.5), safety_distance=0.5)
    theta, start = torch.tensor([[0.9, 1.8, 0.09]]).double(), torch.tensor([[-2.0, 0.0]]).double()
    obstacle = torch.tensor([[0.2, 0.3]]).double()
    run = simulate(CbfQpController(task, [avoidance]), theta, start, dt=0.02, steps=200, obstacles=obstacle)
    lower, upper = torch.tensor([[0.1, -5, -5]]).double(), torch.tensor([[3.0, 5, 5]]).double()
    sets = FeasibleSet.from_box(lower, upper)
    sets = replace(sets, body=Polytope.from_box(lower, upper)) if numpy else sets
    watching, spent = SetMembershipObserver(task, [avoidance], sets, noise=NoiseBound(1e-3)), []
    for measurement in islice(run.measurements(), steps):
        began = time.process_time()
        watching.update(measurement)
        spent.append(time.process_time() - began)
    spent = 1e6 * np.array(spent[1:])
    return {"median": float(np.median(spent)), "mean": float(spent.mean()), "steps": steps}


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks polyhedra")
    parser.add_argument("--batch", type=int, default=1000)
    parser.add_argument("--updates", type=int, default=60, help="of the batch")
    parser.add_argument("--alone", type=int, default=12, help="updates of one set, each of them judged")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore")
    batch_of(prior(2), [(A[:2], b[:2]) for A, b in islice(workload(2, None), 2)], truths(2))  # compile
    results: dict = {"batch": options.batch, "updates": options.updates, "workloads": {}}
    for name, width in WIDTHS.items():
        rows, truth = list(islice(workload(options.batch, width), options.updates)), truths(options.batch)
        one = [(A[0], b[0]) for A, b in rows[: options.alone]]
        exact = exact_sets(one)
        peers = {"polyhedron": lambda: Ours(False), "polytope": lambda: Ours(True), "Qhull": Qhull}
        found: dict = {peer: alone(make, one, exact, truth[0]) for peer, make in peers.items()}
        found["batch"] = batch_of(prior(options.batch), rows, truth)
        few = [(A[:8], b[:8]) for A, b in rows[: options.alone]]
        found["batch, polytope"] = batch_of(prior(8, numpy=True), few, truth[:8])
        results["workloads"][name] = found
        print(f"\n{name if width is None else 'thin, width ' + name}")
        for who in ("batch", "batch, polytope"):
            what = found[who]
            print(
                f"  {who:20s} clip {what['clip']:9.1f} us = {1e6 / what['clip']:9.0f} updates/s, with volume, centroid,"
                f" diameter {what['update']:9.1f} us, truths lost {what['truths_lost']}"
            )
        for peer in peers:
            what = found[peer]
            failed = f"failed {what['failed']} of {what['of']} {what['failures'] or ''}"
            print(f"  one set, {peer:11s} {what['microseconds'] or np.nan:9.1f} us, {failed}")
    rows, truth = list(islice(workload(options.batch, inf), options.updates)), truths(options.batch)
    few = [(A[:2], b[:2]) for A, b in rows[:10]]
    found = {"batch": batch_of(prior(options.batch), rows, truth)}
    found["batch, polytope"] = batch_of(prior(2, numpy=True), few, truth[:2])
    results["workloads"]["round"] = found
    print("\nround")
    for who, what in found.items():
        print(f"  {who:20s} clip {what['clip']:9.1f} us = {1e6 / what['clip']:9.0f} updates/s")
    gain = {"polyhedron": unknown_gain(False, 200), "polytope": unknown_gain(True, 100)}
    results["unknown gain"] = gain
    print("\nunknown gain, one robot")
    for who, what in gain.items():
        print(f"  {who:12s} median {what['median']:9.0f} us, mean {what['mean']:9.0f} us over {what['steps']} steps")
    print(f"saved: {save('polyhedra', results, ['torch', 'numpy', 'numba', 'scipy'])}")
