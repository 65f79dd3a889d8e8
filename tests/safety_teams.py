"""Teams whose gain and safety distance are hidden, too: closed loops, measured with errors up to their bounds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchfsid.observers.safety import SafetyObserver
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask, Task
from torchfsid.robots.unknown_avoidance import UnknownAvoidance
from torchfsid.sets.feasible_set import MAX_FACETS, FeasibleSet


@dataclass(frozen=True)
class Team:
    """A run, what was measured of it, and the truth behind it."""

    task: Task
    unknown: UnknownAvoidance
    others: Sequence[Barrier]
    noise: NoiseBound
    theta: Tensor
    true_gain: float
    true_distance: float
    run: Trajectory
    measurements: list[Measurement] = field(default_factory=list)

    @property
    def psi(self) -> Tensor:
        """The true (beta, beta D)."""
        beta, length = self.true_gain ** (1 / self.unknown.power), self.true_distance
        if self.unknown.margin is not None and self.unknown.distance == "squared":
            length += self.unknown.reference
        D = length**2 if self.unknown.distance == "squared" else length
        return torch.tensor([beta, beta * D], dtype=torch.float64)

    def observer(self, facets: int = MAX_FACETS, **options) -> SafetyObserver:
        half = torch.full(self.theta.shape, 6.0, dtype=torch.float64)
        prior = FeasibleSet.from_box(-half, half, facets)
        return SafetyObserver(self.task, [self.unknown, *self.others], prior, self.noise, **options)

    def watched(self, **options) -> SafetyObserver:
        """The observer after all measurements."""
        observer = self.observer(**options)
        for measurement in self.measurements:
            observer.update(measurement)
        return observer

    def holds_truth(self, observer: SafetyObserver) -> bool:
        """Is the truth of every robot inside, of theta and of psi?"""
        inside = observer.feasible_set.contains(self.theta) & observer.safety.contains(
            self.psi.expand(len(self.theta), 2)
        )
        return bool(inside.all())


def crossing(
    seed: int,
    *,
    robots: int = 3,
    steps: int = 30,
    gain: float = 1.5,
    distance: float = 0.4,
    known: CollisionAvoidance | None = None,
    shape: dict | None = None,
    unknown: dict | None = None,
    task: Task | None = None,
    others: Sequence[Barrier] = (),
    obstacles: Tensor | None = None,
    radius: Tensor | None = None,
    velocity: float = 1e-3,
    position: float = 0.0,
    **errors,
) -> Team:
    """Robots that change places across a circle.

    `shape` are the arguments that the true barrier and the unknown one share, `unknown` those of the unknown one alone.
    """
    generator = torch.Generator().manual_seed(seed)
    shape, task = shape or {}, task or GoalTask(0.9)
    by_margin = radius is not None
    truth = CollisionAvoidance(
        ClassK(gain, shape.get("power", 1.0)),
        None if by_margin else distance,
        distance if by_margin else None,
        shape.get("distance", "squared"),
        shape.get("neighbour_velocity", "none"),
    )
    turn = 2 * math.pi * (torch.arange(robots, dtype=torch.float64) + 0.2 * noise_like(robots, generator)) / robots
    start = (1.5 + 0.3 * noise_like((robots, 1), generator)) * torch.stack([turn.cos(), turn.sin()], dim=-1)
    goals = -start + 0.3 * noise_like((robots, 2), generator)
    theta = goals if len(task.parameter_names) == 2 else torch.cat([torch.full((robots, 1), 0.9), 0.9 * goals], -1)
    run = simulate(
        CbfQpController(task, [truth, *others]), theta, start, dt=0.1, steps=steps, obstacles=obstacles, radius=radius
    )
    interval = (distance / 2, 2 * distance) if distance > 0 else (2 * distance, -2 * distance)
    parameters = {"gain": (gain / 10, 10 * gain), ("margin" if by_margin else "safety_distance"): interval}
    declared = UnknownAvoidance(**{**parameters, **shape, **(unknown or {})})
    neighbours = velocity if shape.get("neighbour_velocity", "none") != "none" else 0.0
    noise = NoiseBound(velocity, position=position, neighbour_velocity=neighbours)
    team = Team(task, declared, others, noise, theta, gain, distance, run)
    return replace(team, measurements=measured(team, generator, **errors))


def measured(team: Team, generator: torch.Generator, size: float | None = 1.0) -> list[Measurement]:
    """All samples, with errors of `size` times their bounds; None for a random fraction."""
    run, robots = team.run, team.run.robots
    found, previous = [], torch.zeros_like(run.u[0])

    def error(bound: float, bodies: int) -> Tensor:
        angle = 2 * math.pi * torch.rand(bodies, 1, generator=generator, dtype=torch.float64)
        length = size if size is not None else torch.rand(bodies, 1, generator=generator, dtype=torch.float64)
        return 0.999999 * bound * length * torch.cat([angle.cos(), angle.sin()], dim=-1)

    for k in range(len(run.t)):
        x = run.x[k] + error(team.noise.position, len(run.x[k]))
        u = run.u[k] + error(float(team.noise.velocity), len(run.x[k]))
        u[robots:] = 0.0
        u[:robots][~run.feasible[k]] = 0.0
        found.append(
            Measurement.of_team(float(run.t[k]), x, u, robots=range(robots), previous_u=previous, radius=run.radius)
        )
        previous = u
    return found


def noise_like(shape: int | tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Uniform numbers in [-1, 1]."""
    return 2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1
