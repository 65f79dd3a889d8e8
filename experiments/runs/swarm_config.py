"""The files of `kind: swarm`: many robots in a square. This module does not import torch."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from experiments.runs.config import Count, ExperimentConfig, MeasurementNoiseConfig, WholeNumber
from torchfsid.config.documents import wrong
from torchfsid.config.quantities import NonNegative, Positive


class SwarmConfig(ExperimentConfig):
    """Many robots in a square, each of which avoids its nearest neighbours only. There is no filter.

    Attributes:
        robots: number of robots.
        side: side of the square [m].
        separation: least distance between starts [m].
        travel: goals lie in discs of this radius around the starts, within the square [m].
        neighbours: number of nearest neighbours that a robot avoids.
        sensing_radius: distance within which neighbours are avoided [m].
        seed: seed of all random numbers.
        measurement_noise: errors of the measurements.
        snapshots: times of the figure's panels [s].
    """

    kind: Literal["swarm"]
    robots: Count
    side: Positive
    separation: NonNegative
    travel: Positive
    neighbours: Count
    sensing_radius: Positive
    seed: WholeNumber
    measurement_noise: MeasurementNoiseConfig = MeasurementNoiseConfig()
    snapshots: Annotated[tuple[NonNegative, ...], Field(min_length=1, max_length=4)]

    @property
    def spacing(self) -> float:
        """The spacing of the grid from whose points starts are displaced [m]."""
        return self.side / math.ceil(math.sqrt(self.robots))

    @model_validator(mode="after")
    def _is_a_swarm(self) -> SwarmConfig:
        self._require_in_prior((-self.side / 2, -self.side / 2), "side")
        self._require_in_prior((self.side / 2, self.side / 2), "side")
        if self.separation > self.spacing:
            raise wrong(f"no room for {self.robots} robots {self.separation} m apart", "side")
        if self.measurement_noise.position > 0 or self.measurement_noise.shape != "uniform":
            raise wrong("a swarm knows uniform errors of velocities only", "measurement_noise")
        for i, barrier in enumerate(self.barriers):
            if barrier.neighbour_velocity == "current":
                raise wrong("no joint QP over a swarm: none or previous", f"barriers[{i}].neighbour_velocity")
        if self.dynamics != "single_integrator":
            raise wrong("robots of a swarm are driven by velocities", "dynamics")
        if any(barrier.uses_radius for barrier in self.barriers):
            raise wrong("bodies of a swarm have no radius: give safety_distance", "barriers")
        self._require_in_time(self.snapshots)
        return self
