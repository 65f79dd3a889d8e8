r"""Buffered Voronoi cells, as the firmware of the Crazyflie computes them (`collision_avoidance.c`).

With ellipsoids E = diag(radii) around the robots and dx = x - x_j, robot i stays on its side of the plane halfway
between the two, less its own ellipsoid, until the horizon T has passed at its velocity u:

    -(E^-2 dx).u / |E^-1 dx|  <=  (|E^-1 dx|/2 - 1)/T,        |u_i| <= max_speed on every axis

In the coordinates E^-1 x this is the row of euclidean avoidance with the safety distance 2 and alpha(h) = h/(2T)
(`Ellipsoid`). The firmware's fence is an `Arena` with alpha(h) = h/T. A velocity command is projected onto the cell,
u = argmin |u - uhat|^2, which is the QP. Two rules of the firmware are no projection of the command:

- **Sidestep.** If the wall ahead of the command is nearer than `sidestep` (.25 m by default), the command is turned to
  the right before it is projected. By how much depends on the command, which is unknown.
- **Outside of the cell** the robot goes to the nearest point of its cell, whatever the command is. If the projection
  does not converge, it commands exactly zero.

So a sample says nothing of the task if a wall is within `sidestep` of the robot in any direction, if the robot may be
outside of its cell, or if its command is zero: rows then count as rows of unknown direction. With the parameter
colAv.sidestepThrsh = 0 the first rule is off, and the other samples are kept.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance, NeighbourVelocity
from torchfsid.robots.barriers import SpeedBox
from torchfsid.robots.bounds import ErrorBounds, RowErrors
from torchfsid.robots.ellipsoid import Ellipsoid
from torchfsid.robots.measurement import Measurement


@dataclass(frozen=True)
class BufferedVoronoi:
    """One row per body and two per axis.

    Attributes:
        ellipsoid: the radii of one robot's ellipsoid, one per axis [m].
        horizon: the time T for which the velocity is kept [s].
        max_speed: the largest speed on every axis [m/s].
        sidestep: the distance of a wall below which commands may be turned [m].
        soft: the controller may violate the rows.

    Raises:
        InputError: a number is not positive (`sidestep`: is negative), or the limit of the speed is such a wall always.
    """

    ellipsoid: tuple[float, ...]
    horizon: float
    max_speed: float
    sidestep: float = 0.25
    soft: bool = False
    uncertain: ClassVar[bool] = True
    neighbour_velocity: ClassVar[NeighbourVelocity] = "none"

    def __post_init__(self) -> None:
        if not (self.horizon > 0 and self.max_speed > 0 and self.sidestep >= 0):
            raise InputError("buffered_voronoi", "horizon > 0, max_speed > 0, sidestep >= 0", self)
        if self.horizon * self.max_speed <= self.sidestep:
            expected = f"less than horizon * max_speed = {self.horizon * self.max_speed:g} m"
            raise InputError("sidestep", expected, self.sidestep)

    @cached_property
    def _between(self) -> Ellipsoid:
        avoidance = CollisionAvoidance(ClassK(1 / (2 * self.horizon)), 2.0, distance="euclidean", soft=self.soft)
        return Ellipsoid(avoidance, self.ellipsoid)

    @cached_property
    def _speed(self) -> SpeedBox:
        return SpeedBox((self.max_speed,) * len(self.ellipsoid), self.soft)

    def __call__(self, measurement: Measurement) -> Halfspaces:
        return Halfspaces.stack([self._between(measurement), self._speed(measurement)])

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        """Those of the rows. All is unknown of a row whose wall may be as near as `sidestep`, or behind the robot."""
        between = self._between.errors(measurement, bounds)
        standing = self._of_still(measurement)
        moved = self._between.errors(standing, bounds).slack
        wall = self.horizon * (self._between(standing).normalised().b - moved)
        perhaps = measurement.present & (wall <= self.sidestep)
        if measurement.u is not None:
            perhaps = perhaps | (measurement.present & (measurement.u == 0).all(-1, keepdim=True))
        between = RowErrors(torch.where(perhaps, math.pi, between.angle), torch.where(perhaps, math.inf, between.slack))
        return RowErrors.stack([between, self._speed.errors(measurement, bounds)])

    def slack_left_out(self, measurement: Measurement) -> Float[Tensor, "*batch"]:
        """That of the rows; -inf if a body without a slot may be the reason for a sidestep."""
        wall = self.horizon * self._between.slack_left_out(self._of_still(measurement))
        slack = self._between.slack_left_out(measurement)
        return torch.where(wall > self.sidestep, slack, -math.inf)

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return [*self._between.labels(bodies), *self._speed.labels(bodies)]

    @staticmethod
    def _of_still(measurement: Measurement) -> Measurement:
        """The measurement, as if the robots stood still."""
        return replace(measurement, u=torch.zeros_like(measurement.x))
