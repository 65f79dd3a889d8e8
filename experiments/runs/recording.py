"""A recording: the measurements of some robots, with the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

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


class SimulatedScene(NamedTuple):
    """A scene that was run: its true trajectory, the one measured with errors, and the recording of its robots."""

    true: Trajectory
    measured: Trajectory
    recording: Recording


def simulate_scene(config: SceneConfig) -> SimulatedScene:
    """Run the scene's robots from rest in closed loop, and measure them with the configured errors."""
    batch = Batch([config])
    model, measured = batch.model(batch.team), measure(batch).team(0)
    recording = Recording(
        robots=[robot.name for robot in config.robots],
        goals=batch.goals,
        task=model.task,
        barriers=model.barriers,
        labels=[label for barrier in model.barriers for label in barrier.labels(config.bodies)],
        measurements=measured.measurements(),
        samples=len(measured.t),
    )
    return SimulatedScene(batch.true.team(0), measured, recording)
