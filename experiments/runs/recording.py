"""A recording: the measurements of some robots, with the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from experiments.runs.batch import Batch
from experiments.runs.config import SceneConfig
from experiments.runs.errors import measure
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Trajectory
from torchfsid.robots.tasks import Task


@dataclass(frozen=True)
class Recording:
    """Measurements of a batch of robots, in the order of time.

    Attributes:
        robots: names of the robots.
        goals: true goals [m].
        task: the task, also of the observers.
        barriers: the barriers, also of the observers.
        labels: labels of the rows of the barriers.
        measurements: the measurements.
        samples: number of measurements.
    """

    robots: list[str]
    goals: Float[Tensor, "B n"]
    task: Task
    barriers: list[Barrier]
    labels: list[str]
    measurements: Iterator[Measurement]
    samples: int


@dataclass(frozen=True)
class SimulatedScene:
    """A scene that was run: its true trajectory, and the one measured with errors."""

    config: SceneConfig
    task: Task
    barriers: list[Barrier]
    goals: Float[Tensor, "robots n"]
    true: Trajectory
    measured: Trajectory

    def recording(self) -> Recording:
        """The recording of the scene's robots."""
        return Recording(
            robots=[robot.name for robot in self.config.robots],
            goals=self.goals,
            task=self.task,
            barriers=self.barriers,
            labels=[label for barrier in self.barriers for label in barrier.labels(self.config.bodies)],
            measurements=self.measured.measurements(),
            samples=len(self.measured.t),
        )


def simulate_scene(config: SceneConfig) -> SimulatedScene:
    """Run the scene's robots from rest in closed loop, and measure them with the configured errors."""
    batch = Batch([config])
    model = batch.model(batch.team)
    return SimulatedScene(config, model.task, model.barriers, batch.goals, batch.true.team(0), measure(batch).team(0))
