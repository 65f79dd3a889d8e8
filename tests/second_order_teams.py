"""Teams of second order that cross a disc, and their measurements with errors at the declared bounds."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from torchfsid.robots.barriers import Barrier, SpeedBox
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.second_order import NeighbourAcceleration, SecondOrderAvoidance
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask, Saturation

TASKS: dict[str, GoalTask] = {
    "damped": GoalTask(0.6, damping=1.4),
    "clipped": GoalTask(0.8, damping=1.5, saturation=Saturation("norm", (0.5, 0.5))),
    "loop": GoalTask.in_velocity_loop(0.7, 1.8, Saturation("norm", (0.5, 0.5))),
}


def barriers_of(neighbour: NeighbourAcceleration) -> list[Barrier]:
    avoidance = SecondOrderAvoidance((1.5, 2.0), safety_distance=0.4, neighbour_acceleration=neighbour)
    return [avoidance, SpeedBox((1.5, 1.5), quantity="acceleration")]


@cache
def crossing(
    task: str, neighbour: NeighbourAcceleration, seed: int, robots: int = 4, steps: int = 60
) -> tuple[Tensor, Trajectory]:
    """The goals and the run of robots that cross the disc of radius 2, among one standing body."""
    generator = torch.Generator().manual_seed(seed)
    turn = 2 * math.pi * torch.arange(robots, dtype=torch.float64) / robots
    start = 2 * torch.stack([turn.cos(), turn.sin()], dim=-1)
    start = start + 0.2 * torch.randn(robots, 2, generator=generator, dtype=torch.float64)
    goals = -start + 0.2 * torch.randn(robots, 2, generator=generator, dtype=torch.float64)
    velocity = 0.2 * torch.randn(robots, 2, generator=generator, dtype=torch.float64)
    standing = torch.tensor([[0.3, 0.4]], dtype=torch.float64)
    controller = CbfQpController(TASKS[task], barriers_of(neighbour))
    return goals, simulate(controller, goals, start, dt=0.1, steps=steps, velocity=velocity, obstacles=standing)


def measured(run: Trajectory, noise: NoiseBound, generator: torch.Generator) -> Iterator[Measurement]:
    """The samples with an error of full length in a random direction in each vector, as the bounds declare them.

    Own velocities have errors up to `arrival`, other bodies' up to `neighbour_velocity`, and so on.
    """

    def wrong(values: Tensor, size: float | Tensor) -> Tensor:
        turn = 2 * math.pi * torch.rand(values.shape[:-1], generator=generator, dtype=torch.float64)
        return values + size * torch.stack([turn.cos(), turn.sin()], dim=-1)

    assert run.velocity is not None
    for k in range(len(run.t)):
        exact = run.measurement(k)
        assert exact.u is not None
        assert exact.velocity is not None
        assert exact.body_velocities is not None
        assert exact.body_accelerations is not None
        yield replace(
            exact,
            x=wrong(exact.x, noise.position),
            u=wrong(exact.u, noise.velocity),
            velocity=wrong(exact.velocity, noise.arrival),
            bodies=wrong(exact.bodies, noise.position),
            body_velocities=wrong(exact.body_velocities, noise.neighbour_velocity),
            body_accelerations=wrong(exact.body_accelerations, noise.neighbour_acceleration),
            observed=run.feasible[k],
        )
