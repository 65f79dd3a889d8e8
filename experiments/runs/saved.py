"""A results folder, read back: all that the summary and the figures are made from. No torch in this module."""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from experiments.runs.config import CasesConfig, SceneConfig, SwarmConfig, load_experiment

SETS: tuple[Literal["critical_region", "inverse_optimal"], ...] = ("critical_region", "inverse_optimal")


@dataclass(frozen=True)
class Region:
    """What regions.jsonl says about a robot at one time: names of the active rows, vertices of both sets, and of a
    constructed case the unit rows (a_x, a_y, b) over the control, the control and the nominal control."""

    active: list[str]
    vertices: dict[str, np.ndarray]
    rows: np.ndarray
    u: np.ndarray
    nominal: np.ndarray


@dataclass(frozen=True)
class Results:
    """The folder of a run. Robots come in the order of the config, times increase."""

    folder: Path

    @cached_property
    def config(self) -> SceneConfig | CasesConfig:
        config = load_experiment(self.folder / "config.yaml")
        assert not isinstance(config, SwarmConfig)
        return config

    @cached_property
    def robots(self) -> list[str]:
        named = self.config.cases if isinstance(self.config, CasesConfig) else self.config.robots
        return [robot.name for robot in named]

    @cached_property
    def goals(self) -> np.ndarray:
        """(robots, 2) [m]"""
        if isinstance(self.config, CasesConfig):
            return np.array([self.config.goal] * len(self.robots))
        return np.array([robot.goal for robot in self.config.robots])

    @cached_property
    def t(self) -> np.ndarray:
        return np.array([float(text) for text in self._table["t"][:, 0]])

    def numbers(self, *columns: str) -> np.ndarray:
        """Columns of estimates.csv: (times, robots), or with more than one (times, robots, columns)."""
        values = np.stack([self._table[column].astype(float) for column in columns], axis=-1)
        return values[..., 0] if len(columns) == 1 else values

    def of_set(self, kind: str, *columns: str) -> np.ndarray:
        """The same for the columns of one kind of set."""
        prefix = "" if kind == self.config.set else f"{kind}_"
        return self.numbers(*(prefix + column for column in columns))

    def error(self, *columns: str) -> np.ndarray:
        """Distances of point estimates to the goals: (times, robots) [m]"""
        return np.linalg.norm(self.numbers(*columns) - self.goals, axis=-1)

    def cases(self) -> np.ndarray:
        """Letters, (times, robots)."""
        return self._table["case"]

    def n_active(self) -> np.ndarray:
        """(times, robots)"""
        return self.numbers("n_active").astype(int)

    def at(self, t: float) -> int:
        """The sample nearest to a time."""
        return int(np.abs(self.t - t).argmin())

    @cached_property
    def regions(self) -> list[list[Region]]:
        """By sample, then robot."""
        with (self.folder / "regions.jsonl").open(encoding="utf-8") as file:
            lines = [_region(json.loads(line)) for line in file]
        return [lines[i : i + len(self.robots)] for i in range(0, len(lines), len(self.robots))]

    @cached_property
    def paths(self) -> dict[str, np.ndarray]:
        """Of every body: (times, 2) [m]."""
        paths: dict[str, list] = defaultdict(list)
        for row in _read_csv(self.folder / "trajectory.csv"):
            paths[row["robot"]].append((float(row["x"]), float(row["y"])))
        return {body: np.array(path) for body, path in paths.items()}

    @cached_property
    def summary(self) -> dict[str, Any]:
        return json.loads((self.folder / "summary.json").read_text(encoding="utf-8"))

    @cached_property
    def _table(self) -> dict[str, np.ndarray]:
        columns: dict[str, list[str]] = defaultdict(list)
        for row in _read_csv(self.folder / "estimates.csv"):
            for name, cell in row.items():
                columns[name].append(cell)
        return {name: np.array(cells).reshape(-1, len(self.robots)) for name, cells in columns.items()}


def _read_csv(path: Path) -> Iterator[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        yield from csv.DictReader(file)


def _region(line: dict[str, Any]) -> Region:
    return Region(
        active=line["active"],
        vertices={kind: np.array(line[kind]) for kind in SETS},
        rows=np.array(line["rows"]).reshape(-1, 3),
        u=np.array(line["u"]),
        nominal=np.array(line["nominal"]),
    )
