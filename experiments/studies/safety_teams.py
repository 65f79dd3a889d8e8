"""Random teams whose gain and safety distance are drawn, what is logged of them, and what is declared.

True motions are exact. Errors are in the logged velocities, and in the logged positions if asked for. A velocity that
is exactly zero, since a QP is infeasible, is logged as such.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from experiments.runs.errors import in_disc, on_circle
from experiments.teams import TeamConfig
from torchfsid.halfspaces import dot
from torchfsid.identification.safety_parameters import Possible
from torchfsid.observers.safety import SafetyObserver
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance, NeighbourVelocity
from torchfsid.robots.barriers import stack_barriers
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask
from torchfsid.robots.unknown_avoidance import Interval, UnknownAvoidance
from torchfsid.sets.feasible_set import FeasibleSet

DT = 0.05
"""Between samples [s]."""

GAINS = {1: (0.5, 5.0), 3: (0.5, 10.0)}
"""Gains are drawn from these, by power."""

DISTANCES = (0.25, 0.6)
"""Safety distances are drawn from these [m]."""

REACH = 6.0
"""Half the side of the square in which the goals are known to lie [m]."""

SOLVER = 1e-9
"""Added to the declared bound of velocities, for the solver's round-off [m/s]."""

DIRECTIONS = 8
"""Directions among which the adversary chooses."""

Errors = Literal["exact", "tenth", "uniform", "circle", "fixed", "alternating", "adversarial"]


@dataclass(frozen=True)
class Form:
    """The known form of a barrier."""

    rows: NeighbourVelocity
    power: Literal[1, 3]
    distance: Literal["squared", "euclidean"]


@dataclass(frozen=True)
class Setting:
    """What is wrong with the logged data.

    Attributes:
        errors: the shape of the errors of velocities. `exact`: none. `tenth`: uniform in a disc of a tenth of the
            bound. The others reach the bound. `uniform`: in a disc. `circle`: random directions. `fixed`: one for each
            robot. `alternating`: towards and away from the robot's nearest row in turn. `adversarial`: see `_worst`.
        velocity: the declared bound of velocities [m/s].
        position: the declared bound of positions, which errors in random directions reach [m].
    """

    errors: Errors
    velocity: float
    position: float = 0.0

    @property
    def noise(self) -> NoiseBound:
        """The declared bounds."""
        return NoiseBound(self.velocity + SOLVER, position=self.position, neighbour_velocity=self.velocity)


@dataclass(frozen=True)
class Prior:
    """How well the gain and the safety distance are known before, as factors between the ends of their intervals."""

    gain: float = 100.0
    distance: float = 4.0


@dataclass(frozen=True)
class Team:
    """A team, its true parameters and its motion.

    Attributes:
        form: the form of the barrier.
        gain: the class-K gain of each robot.
        distance: the safety distance [m].
        task: the task of all robots.
        goals: their goals [m].
        places: where in its prior, as a share of the logarithmic width, each of the two parameters lies.
        true: the exact motion.
    """

    form: Form
    gain: Float[Tensor, "robots"]
    distance: float
    task: GoalTask
    goals: Float[Tensor, "robots 2"]
    places: tuple[float, float]
    true: Trajectory

    @property
    def robots(self) -> int:
        """The number of robots."""
        return len(self.goals)

    @property
    def active(self) -> int:
        """The number of the robots' samples at which a row is active."""
        return int(self.true.active.any(-1).sum())

    @cached_property
    def barrier(self) -> CollisionAvoidance:
        """The true barrier."""
        form = self.form
        class_k = ClassK(self.gain.unsqueeze(-1), form.power)
        return CollisionAvoidance(class_k, self.distance, distance=form.distance, neighbour_velocity=form.rows)

    @property
    def psi(self) -> Float[Tensor, "robots 2"]:
        """The true safety parameters in the coordinates of Psi."""
        beta = self.gain ** (1 / self.form.power)
        D = self.distance**2 if self.form.distance == "squared" else self.distance
        return torch.stack([beta, beta * D], dim=-1)

    @property
    def differs(self) -> Bool[Tensor, "robots"]:
        """Which robot has another gain than most."""
        return self.gain != self.gain.median()

    def unknown(self, prior: Prior) -> UnknownAvoidance:
        """The barrier as declared."""
        gain = _around(float(self.gain.median()), prior.gain, self.places[0])
        distance = _around(self.distance, prior.distance, self.places[1])
        form = self.form
        return UnknownAvoidance(gain, distance, power=form.power, distance=form.distance, neighbour_velocity=form.rows)

    def learner(self, setting: Setting, prior: Prior) -> SafetyObserver:
        """An observer to which gain and distance are unknown."""
        return SafetyObserver(self.task, [self.unknown(prior)], self._goals_before, noise=setting.noise)

    def knowing(self, setting: Setting) -> SetMembershipObserver:
        """An observer that is told the true gain and distance."""
        return SetMembershipObserver(self.task, [self.barrier], self._goals_before, noise=setting.noise)

    @property
    def _goals_before(self) -> FeasibleSet:
        reach = torch.full_like(self.goals, REACH)
        return FeasibleSet.from_box(-reach, reach)


def draw(form: Form, random: np.random.Generator, robots: tuple[int, int] = (2, 5), odd: float | None = None) -> Team:
    """A random team and its motion. With `odd` a robot's gain, drawn among them, is multiplied by this factor."""
    gain, distance = _log_uniform(random, GAINS[form.power]), _log_uniform(random, DISTANCES)
    place = ("circle", "disc") if odd is None else ("circle",)
    setup = TeamConfig(robots=robots, obstacles=(0, 1), place=place, radius=1.6, separation=1.1 * distance).draw(random)
    start, goals = (
        torch.tensor([robot[name] for robot in setup["robots"]], dtype=torch.float64) for name in ("start", "goal")
    )
    still = [obstacle["position"] for obstacle in setup["obstacles"]]
    gains = torch.full((len(goals),), gain, dtype=torch.float64)
    if odd is not None:
        gains[random.integers(len(gains))] *= odd
    task, samples = GoalTask(random.uniform(0.4, 0.9)), int(random.integers(160, 200, endpoint=True))
    edge = 0.0 if odd is None else 0.3  # the other gain is to lie in the prior, too
    places = random.uniform(edge, 1 - edge), random.uniform(edge, 1 - edge)
    nothing = torch.empty(0)
    team = Team(form, gains, distance, task, goals, places, Trajectory(*[nothing] * 6))
    obstacles = torch.tensor(still, dtype=torch.float64).reshape(-1, 2)
    controller = CbfQpController(task, [team.barrier])
    return replace(team, true=simulate(controller, goals, start, dt=DT, steps=samples - 1, obstacles=obstacles))


def logged(team: Team, setting: Setting, random: np.random.Generator) -> Trajectory:
    """The motion with errors. Obstacles are known exactly."""
    true, robots = team.true, team.robots
    of_all = len(true.t), robots
    x = true.x.clone()
    x[:, :robots] += setting.position * on_circle(random, 1.0, of_all)
    seen, moving = replace(true, x=x), (true.u[:, :robots] != 0).any(-1, keepdim=True)
    if setting.errors == "adversarial":
        return _worst(team, seen, setting, random)
    shapes: dict[str, Callable[[], Tensor]] = {
        "exact": lambda: torch.zeros(*of_all, 2, dtype=torch.float64),
        "tenth": lambda: in_disc(random, 0.1, of_all),
        "uniform": lambda: in_disc(random, 1.0, of_all),
        "circle": lambda: on_circle(random, 1.0, of_all),
        "fixed": lambda: on_circle(random, 1.0, (1, robots)),
        "alternating": lambda: _alternating(team),
    }
    u = true.u.clone()
    u[:, :robots] += torch.where(moving, setting.velocity * shapes[setting.errors](), 0.0)
    return replace(seen, u=u)


def _alternating(team: Team) -> Tensor:
    """Unit vectors along the normal of each robot's nearest row, of alternating sign."""
    normals = torch.stack([_nearest_normal(team, sample) for sample in range(len(team.true.t))])
    return normals * (1 - 2 * (torch.arange(len(normals)) % 2))[:, None, None]


def _nearest_normal(team: Team, k: int) -> Float[Tensor, "robots 2"]:
    """The unit normals of the rows with the least slack."""
    exact = team.true.measurement(k)
    rows = stack_barriers([team.barrier], exact).normalised()
    assert exact.u is not None
    slack = torch.where(exact.present, rows.slack(exact.u), math.inf)
    return rows.A[torch.arange(team.robots), slack.argmin(-1)]


def _worst(team: Team, seen: Trajectory, setting: Setting, random: np.random.Generator) -> Trajectory:
    """Errors of an adversary who sees what an observer has learned so far.

    For each robot he tries `DIRECTIONS`, counted from the normal of the nearest row. He takes the one that leaves the
    true goal (at even samples) or the true safety parameters (at odd samples) the least room in the new half-planes.
    """
    robots, true = team.robots, team.true
    u = true.u.clone()
    observer = team.learner(setting, Prior())
    turns = (2 * math.pi * torch.arange(DIRECTIONS, dtype=torch.float64) / DIRECTIONS).repeat_interleave(robots)
    robot = torch.arange(robots).repeat(DIRECTIONS)
    error = on_circle(random, 1.0, (robots,))
    for k in range(len(true.t)):
        moving = (true.u[k, :robots] != 0).any(-1, keepdim=True)
        u[k, :robots] += torch.where(moving, setting.velocity * error, 0.0)
        normal = _nearest_normal(team, k)[robot]
        angle = torch.atan2(normal[:, 1], normal[:, 0]) + turns
        tried = torch.stack([angle.cos(), angle.sin()], dim=-1)
        measurement = replace(seen, u=u).measurement(k).select(robot)
        measurement = replace(
            measurement, u=true.u[k, robot] + torch.where(moving[robot], setting.velocity * tried, 0.0)
        )
        before, first = observer.possible, torch.zeros(1, dtype=torch.long)
        possible = Possible(before.theta.select(robot), before.psi.select(first), torch.zeros_like(robot))
        read = observer.model.read(possible, measurement)
        room = read.evidence.omega.slack(team.goals[robot]).amin(-1)
        if k % 2:
            rows, item = read.cuts.rows, read.cuts.item
            of_cuts = (rows.b - dot(rows.A, team.psi[robot[item]])) / rows.A.norm(dim=-1)
            room = torch.ones_like(room).scatter_reduce(0, item, of_cuts, "amin")
        room = room.masked_fill(read.evidence.alarmed, -math.inf)
        chosen = room.unflatten(0, (DIRECTIONS, robots)).argmin(0)
        error = tried.unflatten(0, (DIRECTIONS, robots))[chosen, torch.arange(robots)]
        u[k, :robots] = true.u[k, :robots] + torch.where(moving, setting.velocity * error, 0.0)
        observer.update(replace(seen, u=u).measurement(k))
    return replace(seen, u=u)


def _log_uniform(random: np.random.Generator, ends: Interval) -> float:
    return float(math.exp(random.uniform(math.log(ends[0]), math.log(ends[1]))))


def _around(truth: float, factor: float, place: float) -> Interval:
    """An interval whose ends differ by a factor, in which the truth has this place."""
    low = truth * factor**-place
    return low, low * factor
