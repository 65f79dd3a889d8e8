"""The files of `python -m experiments sweep`: many runs of a scene, over a grid, with random teams.

`experiment` is a scene (`experiments.runs.config`) without what the sweep fills in: `title`, `seed`, `snapshots`, and
with a `team`, `robots` and `obstacles`. Every point of the grid is run `repeats` times. Run i draws all its random
numbers from child i of one `numpy.random.SeedSequence`. So it is the same run in any order, on any number of workers.
The filter is the compiled one where it can be used, unless `ukf.engine` says otherwise. This module does not import
torch.
"""

from __future__ import annotations

import itertools
from collections import ChainMap
from collections.abc import Iterable
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from experiments.runs.config import Count, SceneConfig, Text, WholeNumber, require_increasing
from experiments.teams import TeamConfig
from torchfsid.config.documents import Strict, apply_overrides, validate, with_value, wrong
from torchfsid.config.quantities import NonNegative, PlanarVector, require_interval
from torchfsid.errors import ConfigError

MAX_RUNS = 1_000_000
"""More is a slip of the pen in the grid."""

FILLED_IN = ("title", "seed", "snapshots")


class SweepConfig(Strict):
    """A sweep.

    Attributes:
        title: title of the figures.
        seed: seed of all random numbers.
        repeats: runs per point of the grid.
        times: times at which sizes and errors are recorded [s].
        experiment: the scene. In `draw` and `grid` its keys are written with dots, as in `barriers.0.safety_distance`.
        draw: keys of the experiment that each run draws uniformly between two numbers.
        grid: the axes of the grid: keys of the experiment, and the values that they take. Keys joined by commas take
            values together, and each entry is then a list with one value per key. Figures compare the entries of the
            first axis.
    """

    kind: Literal["sweep"]
    title: Text
    seed: WholeNumber
    repeats: Count
    times: Annotated[tuple[NonNegative, ...], Field(min_length=1)]
    experiment: dict[str, Any]
    draw: dict[str, PlanarVector] = Field(default_factory=dict)
    grid: dict[str, Annotated[list[Any], Field(min_length=1)]] = Field(default_factory=dict)

    @property
    def runs(self) -> int:
        """The number of runs."""
        return len(self.points) * self.repeats

    @cached_property
    def axes(self) -> list[list[dict[str, Any]]]:
        """The axes of the grid. Each entry of an axis has a value for each of its keys."""
        return [[_level(keys, values) for values in entries] for keys, entries in self.grid.items()]

    @cached_property
    def points(self) -> list[dict[str, Any]]:
        """The points of the grid, with a value for each key."""
        return [dict(ChainMap(*reversed(levels))) for levels in itertools.product(*self.axes)]

    def point(self, run: int) -> dict[str, Any]:
        """The point of the grid of a run."""
        return self.points[run // self.repeats]

    def scene(self, run: int) -> SceneConfig:
        """The scene of a run.

        Args:
            run: number of the run, from 0.

        Raises:
            ConfigError: it is not a valid scene.
        """
        return validate(self.scene_mapping(run), SceneConfig, f"experiment of run {run}{_told(self.point(run))}")

    def scene_mapping(self, run: int) -> dict[str, Any]:
        """The scene of a run as a mapping, not yet validated."""
        values = {**self.point(run), **self.drawn(run)}
        mapping: Any = self.experiment
        for key, value in values.items():
            mapping = with_value(mapping, [part.strip() for part in key.split(".")], value, f"grid, draw: {key}")
        _, placing, measuring = self._seeds(run)
        if "team" in mapping:
            team = validate({"team": mapping.pop("team")}, _Team, "experiment").team
            mapping |= team.draw(np.random.default_rng(placing))
        seed = int(measuring.generate_state(1, np.uint64)[0])
        return {**mapping, "title": self.title, "seed": seed, "snapshots": [0.0]}

    def drawn(self, run: int) -> dict[str, float]:
        """The values that this run draws."""
        random = np.random.default_rng(self._seeds(run)[0])
        return {key: float(random.uniform(low, high)) for key, (low, high) in self.draw.items()}

    def check_runs(self, source: str) -> None:
        """Check the first run of every point of the grid.

        Raises:
            ConfigError: it is not a valid scene. The message names `source`.
        """
        for run in range(0, self.runs, self.repeats):
            try:
                scene = self.scene(run)
            except ConfigError as error:
                raise ConfigError(f"{source}: {error}") from error
            if self.times[-1] > scene.duration:
                raise ConfigError(
                    f"{source}: times: must not be after the end, {scene.duration} s, got {self.times[-1]}"
                )

    def _seeds(self, run: int) -> list[np.random.SeedSequence]:
        """Seeds for drawing values, for placing the team, and for measuring."""
        return np.random.SeedSequence(self.seed, spawn_key=(run,)).spawn(3)

    @model_validator(mode="after")
    def _is_a_grid(self) -> SweepConfig:
        require_increasing(self.times, "times")
        for joined, entries in self.grid.items():
            count = len(_keys(joined))
            for i, entry in enumerate(entries):
                if count > 1 and not (isinstance(entry, list) and len(entry) == count):
                    raise wrong(f"expected {count} values, one per key, got {entry!r}", f"grid.{joined}[{i}]")
        keys = [*itertools.chain(*map(_keys, self.grid)), *self.draw]
        if repeated := [key for i, key in enumerate(keys) if key in keys[:i]]:
            raise wrong(f"{repeated[0]} is varied twice", "grid, draw")
        for key, bounds in self.draw.items():
            require_interval(f"draw.{key}", bounds)
        if taken := [key for key in FILLED_IN if key in self.experiment or key in keys]:
            raise wrong("the sweep fills it in", f"experiment.{taken[0]}")
        if "team" in self.experiment and (given := {"robots", "obstacles"} & self.experiment.keys()):
            raise wrong("a team is drawn: leave it out", f"experiment.{min(given)}")
        if self.runs > MAX_RUNS:
            raise wrong(f"expected at most {MAX_RUNS} runs, got {self.runs}", "repeats, grid")
        return self


class _Team(Strict):
    team: TeamConfig


def override_sweep(mapping: dict[Any, Any], overrides: Iterable[str]) -> dict[Any, Any]:
    """`apply_overrides` for a sweep. What follows `draw.` or `grid.` is one key, dots and commas included.

    An example is "draw.task.gain=[1, 2]".

    Raises:
        ConfigError: see `apply_overrides`.
    """
    for override in overrides:
        path, _, text = override.partition("=")
        section, dot, joined = path.partition(".")
        section = section.strip()
        if not (dot and section in ("draw", "grid") and _keys(joined)[0]):
            mapping = apply_overrides(mapping, [override])
            continue
        value = apply_overrides({}, [f"{section}={text}"])[section]
        lines = mapping.get(section) or {}
        if not isinstance(lines, dict):
            raise ConfigError(f"override {override!r}: {section} is no mapping")
        same = next((key for key in lines if _keys(str(key)) == _keys(joined)), joined.strip())
        mapping = {**mapping, section: {**lines, same: value}}
    return mapping


def _keys(joined: str) -> list[str]:
    return [key.strip() for key in joined.split(",")]


def _level(joined: str, values: Any) -> dict[str, Any]:
    keys = _keys(joined)
    return dict(zip(keys, [values] if len(keys) == 1 else values, strict=True))


def _told(point: dict[str, Any]) -> str:
    return f" ({', '.join(f'{key} = {value}' for key, value in point.items())})" if point else ""
