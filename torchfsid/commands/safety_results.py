"""What the results say about unknown safety parameters: columns of estimates.csv, and `safety` in regions.json.

    safety: {
      A, b, vertices         the polygon of psi = (beta, beta D), see `robots.unknown_avoidance`
      gain: [low, high]
      safety_distance: [low, high]         with a margin also that, and this is for the pair of the commonest radii
      bounded_by_data: {gain: [.., ..], safety_distance: [.., ..]}         false: only the prior bounds this end
      approach_speed: [[r, low, high], ...]       how fast a robot may approach a standing body at distance r
      largest_speed          of a robot in the log [m/s]
      facets                 from which sample each row of A, b came, null for the prior
    }

It stands beside `robots` for a team with the same parameters, and in the entry of every robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchfsid.observers.safety import SafetyObserver
from torchfsid.observers.safety_sets import Refutation
from torchfsid.robots.measurement import Measurement
from torchfsid.sets.feasible_set import FeasibleSet

COLUMNS = ("gain_low", "gain_high", "distance_low", "distance_high")

POINTS = 65
"""Distances at which the band of speeds is written."""


class Distances:
    """The least and the largest distance between a robot and another body [m], and the largest speed [m/s]."""

    def __init__(self) -> None:
        self.least, self.largest, self.fastest = math.inf, 0.0, 0.0

    def see(self, measurement: Measurement) -> None:
        """Take in one sample."""
        present = measurement.present
        if measurement.observed is not None:
            present = present & measurement.observed.unsqueeze(-1)
        r = (measurement.x.unsqueeze(-2) - measurement.bodies).norm(dim=-1)[present]
        r = r[r.isfinite() & (r > 0)]
        if measurement.u is not None:
            speeds = measurement.u.norm(dim=-1)[present.any(-1)]
            self.fastest = max([self.fastest, *speeds[speeds.isfinite()].tolist()])
        if len(r):
            self.least, self.largest = min(self.least, float(r.min())), max(self.largest, float(r.max()))

    def points(self) -> Tensor:
        """Distances from the least to the largest [m]. None if no body was seen."""
        if self.largest <= 0:
            return torch.zeros(0, dtype=torch.float64)
        return torch.linspace(math.log(self.least), math.log(self.largest), POINTS, dtype=torch.float64).exp()


class SafetyColumns:
    """The columns of estimates.csv, sample by sample. They are computed only for sets Psi that have changed."""

    def __init__(self, observer: SafetyObserver):
        self._unknown, self._robots = observer.model.unknown, observer.robots
        self._last, self._texts = None, []

    def __call__(self, psi: FeasibleSet) -> list[list[str]]:
        if psi is not self._last:
            found = self._unknown.intervals(psi)
            rows = torch.cat([found.gain, found.distance], dim=-1).tolist()
            texts = [[f"{value:.15g}" for value in row] for row in rows]
            self._last, self._texts = psi, texts if len(texts) == self._robots else texts * self._robots
        return self._texts


def safety(observer: SafetyObserver, robot: int, seen: Distances, robots: Sequence[str], labels: Sequence[str]) -> dict:
    """The entry `safety` of a robot, or of the team if it shares its parameters."""
    unknown, psi = observer.model.unknown, observer.safety.select(torch.tensor([robot]))
    facets, intervals = psi.facets(), unknown.intervals(psi)
    of_gain, of_distance = unknown.bounded_by_data(psi)
    real, m, shared = (facets.halfspaces.A[0] != 0).any(-1), len(labels), observer.is_shared
    r = seen.points()
    band = unknown.approach_speed(psi, r)[0] if len(r) else torch.zeros(0, 2)
    entry: dict[str, Any] = {
        "A": facets.halfspaces.A[0][real].tolist(),
        "b": facets.halfspaces.b[0][real].tolist(),
        "vertices": without_repeats(psi.vertices()[0]).tolist(),
        "power": unknown.power,
        "distance": unknown.distance,
        "gain": intervals.gain[0].tolist(),
        "safety_distance": (intervals.distance[0] + (0.0 if unknown.margin is None else unknown.reference)).tolist(),
        "bounded_by_data": {"gain": of_gain[0].tolist(), "safety_distance": of_distance[0].tolist()},
        "approach_speed": torch.cat([r.unsqueeze(-1), band], dim=-1).tolist(),
        "largest_speed": seen.fastest,
        "facets": [
            None
            if source < 0
            else _origin(time, source // m % len(robots) if shared else robot, source % m, robots, labels)
            for time, source in zip(facets.time[0][real].tolist(), facets.source[0][real].tolist(), strict=True)
        ],
    }
    if unknown.margin is not None:
        entry["margin"] = intervals.distance[0].tolist()
        entry["bounded_by_data"]["margin"] = of_distance[0].tolist()
    return entry


def refutation(found: Refutation, robots: Sequence[str], labels: Sequence[str]) -> dict:
    """The entry of one refutation: of the team (`robot` null) or of a robot."""
    return {
        "t": found.t,
        "robot": None if found.robot is None else robots[found.robot],
        "rows": [_origin(time, robot, row, robots, labels) for time, robot, row in found.rows],
        "unexplained": [robots[robot] for robot in found.unexplained],
    }


def _origin(time: float, robot: int, row: int, robots: Sequence[str], labels: Sequence[str]) -> dict:
    return {"time": time, "robot": robots[robot], "row": labels[row]}


def without_repeats(vertices: Tensor) -> Tensor:
    """The vertices without padding, which repeats the first vertex."""
    repeats = (vertices == vertices[0]).all(-1)
    repeats[0] = False
    return vertices[~repeats]
