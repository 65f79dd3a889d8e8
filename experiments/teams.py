"""Random teams: starts and goals of robots. This module does not import torch."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from experiments.runs.config import Count, WholeNumber
from torchfsid.config.documents import Strict, wrong
from torchfsid.config.quantities import NonNegative, Positive, require_interval
from torchfsid.errors import ConfigError

TRIES = 1000
"""Places tried for a body before there is no room for it."""


class TeamConfig(Strict):
    """What a team is drawn from.

    Attributes:
        robots: least and greatest number of robots, both included.
        obstacles: least and greatest number of obstacles, both included.
        place: `circle`: robots start on a circle and go to about the opposite point. `disc`: starts and goals are
            anywhere in a disc. `sphere` and `ball` are the same in space. Each team draws one of those given.
        radius: radius of the circle, disc, sphere or ball [m]. Obstacles stand in its inner half.
        separation: least distance between starts and obstacles, and between goals and obstacles [m].
    """

    robots: Annotated[tuple[Count, ...], Field(min_length=2, max_length=2)]
    obstacles: Annotated[tuple[WholeNumber, ...], Field(min_length=2, max_length=2)] = (0, 0)
    place: Annotated[tuple[Literal["circle", "disc", "sphere", "ball"], ...], Field(min_length=1)]
    radius: Positive
    separation: NonNegative

    @model_validator(mode="after")
    def _are_ranges(self) -> TeamConfig:
        require_interval("robots", self.robots)
        require_interval("obstacles", self.obstacles)
        if len({place in ("sphere", "ball") for place in self.place}) > 1:
            raise wrong("expected places in the plane (circle, disc), or in space (sphere, ball)", "place")
        return self

    @property
    def _n(self) -> int:
        """2 in the plane, 3 in space."""
        return 3 if self.place[0] in ("sphere", "ball") else 2

    def draw(self, random: np.random.Generator) -> dict[str, list[dict[str, Any]]]:
        """The `robots` and `obstacles` of a scene.

        Raises:
            ConfigError: there is no room for them.
        """
        robots, obstacles = (
            int(random.integers(least, greatest, endpoint=True)) for least, greatest in (self.robots, self.obstacles)
        )
        on_circle = self.place[random.integers(len(self.place))] in ("circle", "sphere")
        standing: list[np.ndarray] = []
        for _ in range(obstacles):
            standing.append(self._apart(standing, lambda: _inside(random, self.radius / 2, self._n)))
        starts, goals = list(standing), list(standing)
        for _ in range(robots):
            starts.append(self._apart(starts, lambda: self._start(random, on_circle)))
            goals.append(self._apart(goals, lambda: self._goal(random, on_circle, starts[-1])))
        pairs = zip(starts[obstacles:], goals[obstacles:], strict=True)
        return {
            "robots": [
                {"name": f"r{i}", "start": start.tolist(), "goal": goal.tolist()}
                for i, (start, goal) in enumerate(pairs, 1)
            ],
            "obstacles": [{"name": f"o{i}", "position": at.tolist()} for i, at in enumerate(standing, 1)],
        }

    def _start(self, random: np.random.Generator, on_circle: bool) -> np.ndarray:
        return self.radius * _direction(random, self._n) if on_circle else _inside(random, self.radius, self._n)

    def _goal(self, random: np.random.Generator, on_circle: bool, start: np.ndarray) -> np.ndarray:
        near = _inside(random, self.radius / 4 if on_circle else self.radius, self._n)
        return -start + near if on_circle else near

    def _apart(self, others: Sequence[np.ndarray], place: Callable[[], np.ndarray]) -> np.ndarray:
        for _ in range(TRIES):
            point = place()
            if all(math.dist(point, other) >= self.separation for other in others):
                return point
        raise ConfigError(f"team: no room for {len(others) + 1} bodies {self.separation} m apart")


def _direction(random: np.random.Generator, n: int) -> np.ndarray:
    if n == 3:
        towards = random.normal(size=3)
        return towards / np.linalg.norm(towards)
    angle = random.uniform(0, 2 * math.pi)
    return np.array([math.cos(angle), math.sin(angle)])


def _inside(random: np.random.Generator, radius: float, n: int) -> np.ndarray:
    return radius * (math.sqrt if n == 2 else math.cbrt)(random.uniform()) * _direction(random, n)
