"""The results folder of a scene or of constructed cases, read back. This module does not import torch.

Sizes of sets and errors of estimates are all lengths. Those of a set are its diameter and the square root of its area,
in space the cube root of its volume. That of an estimate is its distance to the goal.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from experiments.results import Columns, read_columns, read_json, reading, require_length
from experiments.runs.config import CasesConfig, ExperimentConfig, SceneConfig

ROOT_NAMES = {2: "sqrt_area", 3: "cbrt_volume"}
"""Names of the length of a set's volume, by dimension."""

ROOTS = {2: np.sqrt, 3: np.cbrt}

ROUND_OFF = 1e-9
"""Relative change of a volume that is round-off."""


@dataclass(frozen=True)
class Region:
    """A line of regions.jsonl: one robot at one time.

    Attributes:
        active: names of the active rows.
        vertices: vertices of each kind of set [m].
        rows: unit rows (a, b) over the control.
        u: the control [m/s].
        nominal: the nominal control [m/s].
    """

    active: list[str]
    vertices: dict[str, np.ndarray]
    rows: np.ndarray
    u: np.ndarray
    nominal: np.ndarray


@dataclass(frozen=True)
class Results:
    """The folder of a run. Robots have the order of the configuration, and times increase."""

    folder: Path
    config: SceneConfig | CasesConfig

    @cached_property
    def robots(self) -> list[str]:
        """The names of the robots, or of the cases."""
        named = self.config.cases if isinstance(self.config, CasesConfig) else self.config.robots
        return [robot.name for robot in named]

    @cached_property
    def goals(self) -> np.ndarray:
        """True goals: (robots, 2) [m]."""
        if isinstance(self.config, CasesConfig):
            return np.array([self.config.goal] * len(self.robots))
        return np.array([robot.goal for robot in self.config.robots])

    @cached_property
    def t(self) -> np.ndarray:
        """Times [s]."""
        return self.numbers("t")[:, 0]

    def numbers(self, *columns: str) -> np.ndarray:
        """Columns of estimates.csv: (times, robots), or with more than one column (times, robots, columns)."""
        values = np.stack([self._by_robot(self._table.numbers(column)) for column in columns], axis=-1)
        return values[..., 0] if len(columns) == 1 else values

    def of_set(self, kind: str, *columns: str) -> np.ndarray:
        """As `numbers`, for the columns of one kind of set."""
        prefix = "" if kind == self.config.set else f"{kind}_"
        return self.numbers(*(prefix + column for column in columns))

    def error(self, *columns: str) -> np.ndarray:
        """Distances of point estimates to the goals: (times, robots) [m]."""
        return np.linalg.norm(self.numbers(*columns) - self.goals, axis=-1)

    @cached_property
    def lengths(self) -> dict[str, np.ndarray]:
        """All sizes and errors by name: (times, robots) [m]."""
        n = self.config.dimension
        measures = {of: self.error(*(f"{of}_{i}" for i in range(n))) for of in ("ukf", "hybrid")}
        for kind in self.config.sets:
            measures[f"{kind} {ROOT_NAMES[n]}"] = ROOTS[n](self.of_set(kind, "volume"))
            measures[f"{kind} diameter"] = self.of_set(kind, "diameter")
            for point in ("centroid", "centre"):
                estimate = self.of_set(kind, *(f"{point}_{i}" for i in range(n)))
                measures[f"{kind} {point}"] = np.linalg.norm(estimate - self.goals, axis=-1)
        return measures

    @cached_property
    def prior_lengths(self) -> dict[str, np.ndarray]:
        """The same lengths before the first measurement: (robots,) [m]."""
        lower, upper = np.array(self.config.prior.lower), np.array(self.config.prior.upper)
        distance = np.linalg.norm((lower + upper) / 2 - self.goals, axis=-1)
        root, diameter = ROOTS[len(lower)](self.prior_volume), np.linalg.norm(upper - lower)
        before = {"ukf": distance, "hybrid": distance}
        for kind in self.config.sets:
            before[f"{kind} {ROOT_NAMES[len(lower)]}"] = np.full_like(distance, root)
            before[f"{kind} diameter"] = np.full_like(distance, diameter)
            before |= {f"{kind} centroid": distance, f"{kind} centre": distance}
        return before

    @property
    def prior_volume(self) -> float:
        """The volume of the prior [m^n]."""
        return float(np.prod(np.array(self.config.prior.upper) - self.config.prior.lower))

    def changes(self, kind: str) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of samples at which the volume of a set grew, and at which it shrank: (robots,) each."""
        volumes = np.vstack([np.full(len(self.robots), self.prior_volume), self.of_set(kind, "volume")])
        before, after = volumes[:-1], volumes[1:]
        return (after > before * (1 + ROUND_OFF)).sum(0), (after < before * (1 - ROUND_OFF)).sum(0)

    def cases(self) -> np.ndarray:
        """Letters of the cases: (times, robots)."""
        return self._by_robot(self._table["case"])

    def n_active(self) -> np.ndarray:
        """Numbers of active rows: (times, robots)."""
        return self.numbers("n_active").astype(int)

    def at(self, t: float) -> int:
        """The index of the sample nearest to a time [s]."""
        return int(np.abs(self.t - t).argmin())

    @cached_property
    def regions(self) -> list[list[Region]]:
        """The regions by sample, then robot."""
        path, count = self.folder / "regions.jsonl", len(self.robots)
        with reading(path), path.open(encoding="utf-8") as file:
            lines = [_region(json.loads(line), self.config) for line in file]
        require_length(path, len(lines), count * len(self.t))
        return [lines[i : i + count] for i in range(0, len(lines), count)]

    @cached_property
    def paths(self) -> dict[str, np.ndarray]:
        """The positions of every body: (times, n) [m]."""
        assert isinstance(self.config, SceneConfig)
        table, paths = read_columns(self.folder / "trajectory.csv"), {}
        for body in self.config.bodies:
            of_body = table.where(robot=body).of_length(len(self.t))
            paths[body] = np.stack([of_body.numbers(axis) for axis in "xyz"[: self.config.dimension]], axis=-1)
        return paths

    @cached_property
    def summary(self) -> dict[str, Any]:
        """The content of summary.json."""
        return read_json(self.folder / "summary.json")

    @cached_property
    def _table(self) -> Columns:
        return read_columns(self.folder / "estimates.csv").of_length((self.config.steps + 1) * len(self.robots))

    def _by_robot(self, column: np.ndarray) -> np.ndarray:
        return column.reshape(-1, len(self.robots))


def _region(line: dict[str, Any], config: ExperimentConfig) -> Region:
    n = config.dimension
    return Region(
        active=[str(name) for name in line["active"]],
        vertices={kind: np.array(line[kind], dtype=float).reshape(-1, n) for kind in config.sets},
        rows=np.array(line["rows"], dtype=float).reshape(-1, n + 1),
        u=np.array(line["u"], dtype=float).reshape(n),
        nominal=np.array(line["nominal"], dtype=float).reshape(n),
    )
