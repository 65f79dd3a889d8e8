"""The results folder: what a run leaves behind, in the files of the contract.

    estimates.csv   a row per robot and time, flushed as the run goes on: a crash loses nothing that was written
    regions.json    the final set of every robot, rows A theta <= b
    config.yaml     the resolved configuration, from which the run can be repeated

Columns of estimates.csv: t, robot, case, n_active, then of the set volume, diameter, centre_i (Chebyshev), radius,
centroid_i, then ukf_i, hybrid_i, status. Further sets follow with their name as prefix. `case` and `n_active` are empty
where the robot was not measured.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import torch
from torch import Tensor

from torchfsid.identification.kkt import CASES
from torchfsid.observers.hybrid import HybridEstimate
from torchfsid.observers.set_membership import SetEstimate, SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.measurement import Measurement
from torchfsid.sets.feasible_set import FeasibleSet

STATUS_NAMES = {Status.OK: "ok", Status.ALARM: "alarm", Status.INCONSISTENT: "inconsistent"}


class ResultsWriter:
    """Writes a results folder while a run goes on. Use it as a context manager: `regions.json` is written on leaving,
    also when the run broke off.

    Args:
        out: the folder; made if it is not there.
        robots: names of the inferred robots, in the order of the batch.
        observer: whose final sets go to regions.json.
        others: further observers, by the prefix of their columns.
    """

    def __init__(
        self,
        out: Path,
        robots: Sequence[str],
        observer: SetMembershipObserver,
        others: dict[str, SetMembershipObserver] | None = None,
    ):
        self.out, self.robots, self.observer, self.others = out, list(robots), observer, others or {}

    def __enter__(self) -> ResultsWriter:
        self.out.mkdir(parents=True, exist_ok=True)
        p = self.observer.feasible_set.dim
        header = [
            "t",
            "robot",
            "case",
            "n_active",
            *set_columns(p),
            *_indexed("ukf", p),
            *_indexed("hybrid", p),
            "status",
        ]
        for prefix in self.others:
            header += [f"{prefix}_{name}" for name in (*set_columns(p), "status")]
        self._file = (self.out / "estimates.csv").open("w", newline="", encoding="utf-8")
        self._csv = csv.writer(self._file)
        self._csv.writerow(header)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._file.close()
        write_json(self.out / "regions.json", regions(self.robots, self.observer))

    def write(
        self, measurement: Measurement, estimate: HybridEstimate, others: dict[str, SetEstimate] | None = None
    ) -> None:
        """One row per robot for the instant of `estimate`."""
        sets = estimate.set_estimate
        measured = (
            torch.ones(len(self.robots), dtype=torch.bool) if measurement.observed is None else measurement.observed
        )
        described, status = describe(sets.feasible_set), sets.status.tolist()
        extra = [(describe(other.feasible_set), other.status.tolist()) for other in (others or {}).values()]
        for i, robot in enumerate(self.robots):
            active = [CASES[int(sets.kkt.case[i])], int(sets.kkt.n_active[i])] if measured[i] else ["", ""]
            row = [_number(estimate.t), robot, *active, *described[i], *_numbers(estimate.ukf_estimate.theta[i])]
            row += [*_numbers(estimate.theta[i]), STATUS_NAMES[status[i]]]
            for columns, other_status in extra:
                row += [*columns[i], STATUS_NAMES[other_status[i]]]
            self._csv.writerow(row)
        self._file.flush()


def set_columns(p: int) -> list[str]:
    """Names of what `describe` returns."""
    return ["volume", "diameter", *_indexed("centre", p), "radius", *_indexed("centroid", p)]


def describe(sets: FeasibleSet) -> list[list[str]]:
    """Volume, diameter, Chebyshev centre and radius, centroid of each set, as text."""
    centre, radius = sets.chebyshev()
    columns = [sets.volume()[:, None], sets.diameter()[:, None], centre, radius[:, None], sets.centroid()]
    return [_numbers(row) for row in torch.cat(columns, dim=-1)]


def constraint_name(source: int, labels: Sequence[str]) -> str:
    """What a `source` of `critical_region` or `inverse_optimal_set` stands for, given the labels of the rows."""
    if source < 0:
        return "prior"
    return labels[source % len(labels)] if source < 2 * len(labels) else "nominal control"


def regions(robots: Sequence[str], observer: SetMembershipObserver) -> dict:
    """The final sets, as regions.json holds them.

    `last_cut` is null where the set never shrank; `facets` tells when and from which constraint each row came (`source`
    as in `critical_region` and `inverse_optimal_set`; -1: the prior).
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
            "vertices": _without_repeats(vertices[i]).tolist(),
            "volume": float(volume[i]),
            "centroid": centroid[i].tolist(),
            "diameter": float(diameter[i]),
            "chebyshev_centre": centre[i].tolist(),
            "chebyshev_radius": float(radius[i]),
            "status": STATUS_NAMES[Status(int(observer.status[i]))],
            "last_cut": _or_none(float(sets.last_cut[i])),
            "skipped": int(observer.skipped[i]),
            "facets": [
                {"time": _or_none(time), "source": source}
                for time, source in zip(facets.time[i][real].tolist(), facets.source[i][real].tolist(), strict=True)
            ],
            "events": [
                {
                    "t": event.t,
                    "status": STATUS_NAMES[event.status],
                    "reset": event.reset,
                    "rows": [{"time": _or_none(time), "source": source} for time, source in event.rows],
                }
                for event in events
            ],
        }
    return {"robots": of_robots}


def write_json(path: Path, content: object) -> None:
    """Write a file whole or not at all."""
    partial = path.with_suffix(path.suffix + ".partial")
    partial.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    partial.replace(path)


def _without_repeats(vertices: Tensor) -> Tensor:
    """Padding repeats the first vertex."""
    repeats = (vertices == vertices[0]).all(-1)
    repeats[0] = False
    return vertices[~repeats]


def _indexed(name: str, p: int) -> list[str]:
    return [f"{name}_{i}" for i in range(p)]


def _number(value: float) -> str:
    return f"{value:.12g}"


def _numbers(values: Tensor) -> list[str]:
    return [_number(value) for value in values.tolist()]


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value
