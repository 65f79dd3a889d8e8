"""Scenes side by side: runs that differ in numbers only, as a batch of teams, each robot among the bodies of its own.

Scenes are alike if all but these is the same: the numbers of robots and obstacles, starts and goals, seeds, gains and
safety distances of avoidance, the sizes of errors and the declared bounds. Numbers that differ become tensors with one
entry per robot. Teams have slots for as many bodies as the largest one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from experiments.runs.config import SceneConfig
from torchfsid.config.avoidance import AvoidanceConfig
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import Task

SEPARATE = {"title", "seed", "snapshots", "expected", "robots", "obstacles", "task", "barriers", "noise"}
"""Keys of a scene that may differ within a batch, or are compared by themselves."""


def likeness(scene: SceneConfig) -> str | None:
    """A text that scenes have in common if they are alike. None: the scene is run by itself.

    What a clipped control says depends on the set so far, and with feedback the filter does. So their samples are read
    one by one.
    """
    distances = any(getattr(barrier, "safety_distances", None) for barrier in scene.barriers)
    if scene.task.is_clipped or scene.ukf.feedback or distances:
        return None
    numbers = {"safety_distance": True, "class_k": {"gain"}}
    shared = [
        scene.model_dump(exclude={*SEPARATE, "measurement_noise"}),
        scene.measurement_noise.shape,
        scene.task.model_dump(exclude={"gain"}),
        [
            barrier.model_dump(exclude=numbers if isinstance(barrier, AvoidanceConfig) else None)
            for barrier in scene.barriers
        ],
        # Exact data take another way than data with errors.
        [(name, size is None or size > 0) for name, size in scene.noise],
        [(name, size > 0) for name, size in scene.measurement_noise if name != "shape"],
    ]
    return repr(shared)


@dataclass(frozen=True)
class Model:
    """The declared model of robots, and the bounds on errors."""

    task: Task
    barriers: list[Barrier]
    noise: NoiseBound

    @classmethod
    def of_scene(cls, scene: SceneConfig) -> Model:
        """The model of a scene's robots."""
        barriers: list[Barrier] = [barrier.build(scene.bodies) for barrier in scene.barriers]
        return cls(scene.task.build(scene.bodies, scene.dimension), barriers, scene.noise.build())


class Batch:
    """Scenes that are alike, or one scene.

    Attributes:
        scenes: the scenes.
        robots: the number of slots for robots. Those for obstacles follow.
        present: the slots (teams, bodies) that hold a body.
        places: the place of each robot among all slots for robots, team by team.
        team: the team of each robot.
        goals: the true goals [m].
    """

    def __init__(self, scenes: Sequence[SceneConfig]):
        self.scenes = list(scenes)
        self._models = [Model.of_scene(scene) for scene in scenes]
        self._start, of_robots = self._padded(lambda scene: [robot.start for robot in scene.robots])
        self._theta, _ = self._padded(lambda scene: [robot.goal for robot in scene.robots])
        self._standing, of_obstacles = self._padded(lambda scene: [body.position for body in scene.obstacles])
        self.robots, self.present = of_robots.shape[1], torch.cat([of_robots, of_obstacles], dim=1)
        self.places = of_robots.flatten().nonzero().flatten()
        self.team, self.goals = self.places // self.robots, self._theta.flatten(0, 1)[self.places]

    def model(self, of: Int[Tensor, "*batch"]) -> Model:
        """The model of a batch of robots, given the scene of each."""
        task = _joined([model.task for model in self._models], of)
        barriers = zip(*(model.barriers for model in self._models), strict=True)
        noise = _joined([model.noise for model in self._models], of)
        return Model(task, [_joined(same, of.unsqueeze(-1)) for same in barriers], noise)

    @cached_property
    def true(self) -> Trajectory:
        """The trajectories of the robots in closed loop, from rest."""
        first, bodies = self.scenes[0], self.present.shape[1]
        model = self.model(torch.arange(len(self.scenes)).unsqueeze(-1))
        return simulate(
            CbfQpController(model.task, model.barriers),
            self._theta,
            self._start,
            dt=first.dt,
            steps=first.steps,
            velocity=torch.zeros_like(self._start) if first.dynamics == "double_integrator" else None,
            obstacles=self._standing,
            radius=None if first.radius is None else torch.full((bodies,), first.radius, dtype=torch.float64),
            present=None if bool(self.present.all()) else self.present,
        )

    def of_robots(self, samples: Measurement) -> Measurement:
        """The measurements (samples, teams, slots) of the robots that are there, in the order of time.

        One sample (teams, slots) is allowed, too.
        """
        first = torch.arange(0, samples.x.shape[:-1].numel(), self.robots * len(self.scenes))
        return samples.flattened().select((first.unsqueeze(-1) + self.places).flatten())

    def _padded(
        self, points: Callable[[SceneConfig], Sequence[tuple[float, ...]]]
    ) -> tuple[Float[Tensor, "teams slots n"], Bool[Tensor, "teams slots"]]:
        """Points of each scene, zeros behind them, and which are points."""
        of_scenes = [points(scene) for scene in self.scenes]
        padded = torch.zeros(len(of_scenes), max(map(len, of_scenes)), self.scenes[0].dimension, dtype=torch.float64)
        there = torch.zeros(padded.shape[:2], dtype=torch.bool)
        for i, found in enumerate(of_scenes):
            there[i, : len(found)] = True
            padded[i, : len(found)] = torch.tensor(found, dtype=torch.float64).reshape(len(found), padded.shape[-1])
        return padded, there


def _joined(of_scenes: Sequence[Any], of: Int[Tensor, "*batch"]) -> Any:
    """The value of all scenes. If it differs, records are joined field by field, numbers as a tensor of the batch."""
    first = of_scenes[0]
    if all(other == first for other in of_scenes[1:]):
        return first
    if is_dataclass(first):
        names = [field.name for field in fields(first)]
        return replace(first, **{name: _joined([getattr(value, name) for value in of_scenes], of) for name in names})  # type: ignore[type-var]
    return torch.tensor(of_scenes, dtype=torch.float64)[of]
