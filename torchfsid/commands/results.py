"""The files that an observation writes into its results folder.

    config.yaml     the resolved configuration, from which the run can be repeated (`results_folder`)
    estimates.csv   one line per robot and time, whole samples only, however the run ends
    regions.json    the final set of every robot, rows A theta <= b
    sets.csv        the sets over time (`history`)

Columns of estimates.csv, where i counts the entries of theta (0 and 1 are x and y of a goal), and m stands for the unit
of theta:

    t                 time of the sample, as logged [s]
    robot             its name
    case, n_active    case A to E and number of the active rows; empty where the robot was not measured
    volume            of the set [m^p]: in the plane its area [m^2]
    diameter          of the set [m]
    centre_i, radius  Chebyshev centre and radius: the largest ball in the set [m]
    centroid_i        of the set [m]: the estimate to use if there has to be one point
    ukf_i, hybrid_i   the filter's estimate, and the same moved into the set [m]; empty without a filter
    gain_low, ..      with unknown safety parameters: gain_low, gain_high [1/s for power 1 and squared distances],
                      distance_low, distance_high, of the declared safety distance or margin [m]
    status            ok (no contradiction seen, no proof of the model), alarm or inconsistent (not to be trusted)

Further sets follow with their name as prefix. Sizes and centres of an empty set are empty.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.commands.history import SetsFile
from torchfsid.commands.interruption import uninterrupted
from torchfsid.commands.results_folder import write_json
from torchfsid.commands.safety_results import COLUMNS, Distances, SafetyColumns, refutation, safety, without_repeats
from torchfsid.commands.table_file import TableFile, line_of, lines_of
from torchfsid.commands.where_to_look import constraint_name
from torchfsid.halfspaces import array
from torchfsid.identification.kkt import CASES
from torchfsid.observers.hybrid import HybridEstimate, HybridEstimates
from torchfsid.observers.safety import SafetyObserver, SetObserver
from torchfsid.observers.set_membership import SetEstimate, SetEstimates, SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.measurement import Measurement
from torchfsid.sets.feasible_set import FeasibleSet

STATUS_NAMES = {Status.OK: "ok", Status.ALARM: "alarm", Status.INCONSISTENT: "inconsistent"}

Estimate = SetEstimate | SetEstimates | HybridEstimate | HybridEstimates


class ResultsWriter:
    """Writes estimates.csv and sets.csv during a run, and regions.json on leaving, also if the run is broken off.

    Use it as a context manager. A file that cannot be written (full disk) does not end the run: it stops after its
    last whole sample, and the error is raised on leaving.

    Attributes:
        header: names of the columns of estimates.csv.

    Args:
        out: the folder. It is made if it does not exist.
        robots: names of the inferred robots, in the order of the batch.
        observer: the observer whose final sets go to regions.json.
        others: further observers, by the prefix of their columns.
        labels: labels of the rows of the model.
        bound: what regions.json says of the velocity bound.
        log: what it says of the log.
        truth: the true theta of some robots.
        made_from: the log and the version, see `provenance`.
    """

    def __init__(
        self,
        out: Path,
        robots: Sequence[str],
        observer: SetObserver,
        others: Mapping[str, SetMembershipObserver] = MappingProxyType({}),
        labels: Sequence[str] = (),
        bound: Mapping[str, object] = MappingProxyType({}),
        log: Mapping[str, object] = MappingProxyType({}),
        truth: Mapping[str, Sequence[float]] = MappingProxyType({}),
        made_from: Mapping[str, object] = MappingProxyType({}),
    ):
        self.out, self.robots, self.observer, self.others = out, list(robots), observer, others
        self._labels, self._seen, self._truth = labels, Distances(), truth
        self._names = [line_of([robot]) for robot in self.robots]
        told = (("bound", bound), ("log", log), ("made_from", made_from))
        self._told = {name: dict(content) for name, content in told if content}
        self._safety = SafetyColumns(observer) if isinstance(observer, SafetyObserver) else None
        self._described = {name: _Descriptions() for name in ("", *others)}

    def __enter__(self) -> ResultsWriter:
        self.out.mkdir(parents=True, exist_ok=True)
        p = self.observer.feasible_set.dim
        self.header = header = [
            "t",
            "robot",
            "case",
            "n_active",
            *set_columns(p),
            *_indexed("ukf", p),
            *_indexed("hybrid", p),
        ]
        header += [*([] if self._safety is None else COLUMNS), "status"]
        for prefix in self.others:
            header += [f"{prefix}_{name}" for name in (*set_columns(p), "status")]
        self._estimates = TableFile(self.out / "estimates.csv", header)
        name = partial(constraint_name, labels=self._labels)
        self._sets = SetsFile(self.out / "sets.csv", self.robots, p, name)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with uninterrupted():
            self._sets.finish(self.observer.feasible_set)
            problems = []
            for finish in (self._estimates.close, self._sets.close, self._write_regions):
                try:
                    finish()
                except OSError as problem:
                    problems.append(problem)
        if problems:
            raise problems[0]

    def _write_regions(self) -> None:
        found = regions(self.robots, self.observer, self._seen, self._labels, self._truth)
        write_json(self.out / "regions.json", found | self._told)

    def write(
        self,
        measurement: Measurement,
        estimate: Estimate,
        others: Mapping[str, SetEstimate] = MappingProxyType({}),
    ) -> list[str]:
        """Write one line per robot for the time of the estimate, or for each time of several.

        Returns these lines of estimates.csv, a text for each time.
        """
        sets = of_sets(estimate)
        samples, robots = sets.which.shape
        described = self._described[""](sets)
        filtered = isinstance(estimate, HybridEstimate | HybridEstimates)
        if filtered or self._safety is not None or others:
            first = place = np.arange(samples * robots)
        else:
            first, place = _alike(sets, measurement.observed)
        ends = self._ends(measurement, estimate, others, described, torch.from_numpy(first))
        lines = [ends[k] for k in place.tolist()]
        times = enumerate(lines_of(sets.t.unsqueeze(-1)))
        texts = [t.join(["", *lines[s * robots : (s + 1) * robots]]) for s, t in times]
        self._estimates.write_texts(texts)
        for s in sorted({0, *_changes(sets.which), samples - 1}):
            at = sets.which[s]
            self._sets.see(
                float(sets.t[s]), [described[place][:2] for place in at.tolist()], partial(sets.sets.select, at)
            )
        return texts

    def _ends(
        self,
        measurement: Measurement,
        estimate: Estimate,
        others: Mapping[str, SetEstimate],
        described: Sequence[_Description],
        items: Int[Tensor, "k"],
    ) -> list[str]:
        """The lines of some items, after their times. With safety parameters or `others` these are all items."""
        sets, blank = of_sets(estimate), "," * (self.observer.feasible_set.dim - 1)
        ukf = hybrid = [blank] * len(items)
        if isinstance(estimate, HybridEstimate | HybridEstimates):
            filtered = estimate.ukf_estimate if isinstance(estimate, HybridEstimate) else estimate.ukf_estimates
            ukf, hybrid = lines_of(filtered.theta.flatten(0, -2)), lines_of(estimate.theta.flatten(0, -2))
        cases, numbers, which, statuses = (
            array(of.flatten()[items]).tolist() for of in (sets.kkt.case, sets.kkt.n_active, sets.which, sets.status)
        )
        measured = [True] * len(items) if measurement.observed is None else measurement.observed[items].tolist()
        robots = [self._names[item % len(self.robots)] for item in items.tolist()]
        active = [f"{CASES[case]},{n}" if seen else "," for case, n, seen in zip(cases, numbers, measured, strict=True)]
        names = [STATUS_NAMES[status] for status in statuses]
        if self._safety is not None and sets.safety is not None:
            self._seen.see(measurement)
            names = [line_of([*cells, name]) for cells, name in zip(self._safety(sets.safety), names, strict=True)]
        for prefix, other in others.items():
            of_other = zip(names, self._described[prefix](of_sets(other)), other.status.tolist(), strict=True)
            names = [f"{name},{cells.text},{STATUS_NAMES[status]}" for name, cells, status in of_other]
        texts = [described[place].text for place in which]
        cells = zip(robots, active, texts, ukf, hybrid, names, strict=True)
        return [f",{','.join(of_item)}\r\n" for of_item in cells]


def of_sets(estimate: Estimate) -> SetEstimates:
    """The estimates of the sets alone."""
    if isinstance(estimate, HybridEstimates):
        return estimate.set_estimates
    found = estimate.set_estimate if isinstance(estimate, HybridEstimate) else estimate
    return found if isinstance(found, SetEstimates) else SetEstimates.of(found)


def holds(sets: FeasibleSet, i: int, theta: Sequence[float]) -> bool:
    """Is theta in the set of robot i?"""
    return bool(sets.select(torch.tensor([i])).contains(torch.tensor([theta], dtype=torch.float64)))


def set_columns(p: int) -> list[str]:
    """Names of the columns that `describe` fills."""
    return ["volume", "diameter", *_indexed("centre", p), "radius", *_indexed("centroid", p)]


def describe(sets: FeasibleSet) -> Float[Tensor, "B columns"]:
    """Volume, diameter, Chebyshev centre and radius, centroid of each set."""
    centre, radius = sets.chebyshev()
    return torch.cat([sets.volume()[:, None], sets.diameter()[:, None], centre, radius[:, None], sets.centroid()], -1)


class _Description(NamedTuple):
    """A set in numbers: its size, and the text of all of `describe`."""

    volume: float
    diameter: float
    text: str


class _Descriptions:
    """Descriptions of estimates, one after the other. Only sets that have changed are measured again."""

    def __init__(self) -> None:
        self._known: list[_Description] = []
        self._last_cut = torch.empty(0)

    def __call__(self, estimates: SetEstimates) -> list[_Description]:
        """The descriptions of `estimates.sets`, of which the first ones are those of all robots."""
        last_cut = estimates.sets.last_cut.nan_to_num(nan=-math.inf)  # of a set that was reset: never cut
        new, robots = torch.ones_like(last_cut, dtype=torch.bool), len(self._last_cut)
        new[:robots] = last_cut[:robots] != self._last_cut
        fresh: Iterator[_Description] = iter(())
        if bool(new.any()):
            values = describe(estimates.sets.select(new))
            columns = values[:, 0].tolist(), values[:, 1].tolist(), lines_of(values)
            fresh = map(_Description, *columns)
        found = [next(fresh) if is_new else self._known[k] for k, is_new in enumerate(new.tolist())]
        final = estimates.which[-1]
        self._known, self._last_cut = [found[place] for place in final.tolist()], last_cut[final]
        return found


def _alike(sets: SetEstimates, observed: Bool[Tensor, "items"] | None) -> tuple[np.ndarray, np.ndarray]:
    """Items (time, robot) whose lines differ by the time alone: the first of each kind, and the kind of every item."""
    kkt, which = sets.kkt, sets.which.flatten()
    seen = torch.ones_like(which) if observed is None else observed.long()
    told = [array(of) for of in (which, kkt.case, kkt.n_active, seen, sets.status.flatten())]
    _, first, kind = np.unique(
        np.ravel_multi_index(told, [of.max() + 1 for of in told]), return_index=True, return_inverse=True
    )
    return first, kind


def _changes(which: Int[Tensor, "S B"]) -> list[int]:
    """The samples at which some robot's set is another one than before."""
    return (1 + (which[1:] != which[:-1]).any(-1).nonzero().flatten()).tolist()


def regions(
    robots: Sequence[str],
    observer: SetObserver,
    seen: Distances | None = None,
    labels: Sequence[str] = (),
    truth: Mapping[str, Sequence[float]] = MappingProxyType({}),
) -> dict:
    """The content of regions.json: the final sets. NaN is null there.

    `last_cut` is NaN if the set never shrank. Sizes and centres are NaN if the set is empty. `facets` says at which
    time and from which constraint each row came (`source` as in `critical_region` and `inverse_optimal_set`, -1 for the
    prior; `constraint` is its name). The rows of `events` are named alike, and `prior` says whether sides of the prior
    are among them: it may be too small. Where a robot's `truth` is given, it is repeated, and whether it is inside.
    With `outliers` q > 0 every robot has an entry of that name: q, how many samples are left unexplained at
    least, and which (`SetAside`).
    """
    sets = observer.feasible_set
    facets, (centre, radius) = sets.facets(), sets.chebyshev()
    rows, vertices = facets.halfspaces, sets.vertices()
    volume, diameter, centroid = sets.volume(), sets.diameter(), sets.centroid()
    of_robots = {}
    for i, robot in enumerate(robots):
        real = (rows.A[i] != 0).any(-1)
        events = [event for event in observer.events if event.robot == i]
        of_robots[robot] = {
            "A": rows.A[i][real].tolist(),
            "b": rows.b[i][real].tolist(),
            "vertices": without_repeats(vertices[i]).tolist(),
            "volume": float(volume[i]),
            "centroid": centroid[i].tolist(),
            "diameter": float(diameter[i]),
            "chebyshev_centre": centre[i].tolist(),
            "chebyshev_radius": float(radius[i]),
            "status": STATUS_NAMES[Status(int(observer.status[i]))],
            "last_cut": float(sets.last_cut[i]),
            "skipped": int(observer.skipped[i]),
            "infeasible": int(observer.infeasible[i]),
            "facets": [
                {"time": time, "source": source, "constraint": constraint_name(source, labels)}
                for time, source in zip(facets.time[i][real].tolist(), facets.source[i][real].tolist(), strict=True)
            ],
            "events": [
                {
                    "t": float(event.t),
                    "status": STATUS_NAMES[event.status],
                    "reset": event.reset,
                    "prior": any(source < 0 for _, source in event.rows),
                    "rows": [
                        {"time": float(time), "source": source, "constraint": constraint_name(source, labels)}
                        for time, source in event.rows
                    ],
                }
                for event in events
            ],
        }
    for robot, theta in truth.items():
        of_robots[robot]["truth"] = {"theta": list(theta), "inside": holds(sets, robots.index(robot), theta)}
    if isinstance(observer, SetMembershipObserver) and observer.outliers:
        for robot, unexplained in zip(robots, observer.unexplained.tolist(), strict=True):
            of_robots[robot]["outliers"] = {"q": observer.outliers, "at_least": unexplained, "set_aside": []}
        for found in observer.set_aside():
            names = [constraint_name(source, labels) for source in found.sources]
            entry = {"t": found.t, "sources": found.sources, "constraints": names, "certain": found.is_certain}
            of_robots[robots[found.robot]]["outliers"]["set_aside"].append(entry)
    if not isinstance(observer, SafetyObserver):
        used = {f"{length:g}": share for length, share in observer.windows_used.items()}
        return {"robots": of_robots, "windows_used": used} if used else {"robots": of_robots}
    seen = seen or Distances()
    for i, robot in enumerate(robots):
        of_robots[robot]["safety"] = safety(observer, i, seen, robots, labels)
    whole: dict = {"safety": of_robots[robots[0]]["safety"]} if observer.is_shared else {}
    whole["refutations"] = [refutation(found, robots, labels) for found in observer.refutations]
    whole["odd"] = [robots[robot] for robot in observer.odd()]
    return {"robots": of_robots, **whole}


def _indexed(name: str, p: int) -> list[str]:
    return [f"{name}_{i}" for i in range(p)]
