r"""A probing obstacle near a robot, and how it shrinks the set of possible goals.

The robot avoids the probe like any other body. So the probe changes which rows are active, and with them what the
motion says about the goal (the paper's first future work). A placement is K way-points q_1 .. q_K [m]. The probe stands
still at q_1 (K = 1), or moves along the way-points at equal times from the first sample to the last.

The objective is the mean of A or of log A over goals theta drawn from the current set Theta_0. A(theta, q) is the area
of the observer's final set Theta(T) if theta is the true goal.

The gradient of a mean over goals is not the mean of the gradients. As a function of q each goal's A is smooth except
where the history of active sets switches. There it jumps, and automatic differentiation does not see jumps. Let the
histories be i = 1, 2, ... . If Theta(T) is the same set for all goals of a history, namely the set of these goals, the
probability of history i is P_i = A_i/A_0. For phi_i = phi(A_i),

    grad sum_i P_i phi_i = sum_i P_i grad phi_i + sum_i phi_i grad P_i = mean(grad phi) + mean(phi grad log A),

since grad P_i = P_i grad log A_i. As sum_i grad P_i = 0, any constant may be subtracted from phi. The second term is
the contribution of the changing probabilities. Automatic differentiation of

    L = mean(phi) + mean((phi - mean phi).detach() log A)

gives both. Without the second term mean(grad log A) = grad (sum_i A_i)/A_0 = 0: no gradient at all. For phi = A the
first term alone is exactly half of the gradient, since A grad log A = grad A. The condition holds for critical regions
at the first sample, and as long as the motion does not depend on the goal (G = 0). Goals with different motions cut the
set differently. Then L is an approximation (docs/design.md measures it). A tolerance of the active set breaks the
condition, too: goals within it of a switch get a wrong active set, and with it a small set that may not hold them.

A goal counts as not learned from (A = A_0, no gradient) if a QP has no solution, an intersection is empty, there is an
alarm, the probe comes closer to the robot than the safety distance, or Theta(T) does not hold the goal. Otherwise an
optimiser would exploit these failures.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from experiments.design.config import BoxConfig, ProbePlacementConfig
from experiments.design.runs import Runs, follow, run
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Sample, closed_loop
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet

Objective = Literal["area", "log_area"]

TOUCHING = 1e-9
"""Round-off allowed in the distance between probe and robot, and of a goal from its set [m]."""


class Left(NamedTuple):
    """What is left of Theta.

    Attributes:
        area: area of Theta(T) [m^2]. Where nothing is learned it is the area of Theta_0.
        sound: something may be learned from this placement and goal.
    """

    area: Float[Tensor, "P S"]
    sound: Bool[Tensor, "P S"]


@dataclass(frozen=True)
class Probing:
    """A robot in a corridor, the prior of its goal, and the room for a probe.

    Attributes:
        config: the configuration.
        obstacles: obstacles of the corridor [m].
        start: start of the robot [m].
    """

    config: ProbePlacementConfig
    obstacles: Float[Tensor, "m 2"]
    start: Float[Tensor, "2"]

    @classmethod
    def of(cls, config: ProbePlacementConfig, shift: Float[Tensor, "m 2"] | float = 0.0) -> Probing:
        """The scene of the configuration, with its obstacles moved by `shift` [m]."""
        obstacles = torch.tensor(config.obstacles, dtype=torch.float64) + shift
        return cls(config, obstacles, torch.tensor(config.start, dtype=torch.float64))

    @property
    def prior(self) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
        """Lower and upper corner of Theta_0 [m]."""
        return _corners(self.config.prior)

    @property
    def room(self) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
        """Lower and upper corner of the room for way-points [m]."""
        return _corners(self.config.room)

    @property
    def prior_area(self) -> float:
        """The area A_0 of Theta_0 [m^2]."""
        lower, upper = self.prior
        return float((upper - lower).prod())

    def draw_goals(self, count: int, seed: int) -> Float[Tensor, "count 2"]:
        """Goals evenly spread over Theta_0 (scrambled Sobol points) [m]."""
        lower, upper = self.prior
        return lower + (upper - lower) * torch.quasirandom.SobolEngine(2, True, seed).draw(count, dtype=torch.float64)

    def grid(self, columns: int, rows: int) -> Float[Tensor, "places 2"]:
        """Centres of the cells of a grid over the room, row by row [m]."""
        lower, upper = self.room
        x, y = ((torch.arange(count, dtype=torch.float64) + 0.5) / count for count in (columns, rows))
        return lower + (upper - lower) * torch.cartesian_prod(y, x).flip(-1)

    def allowed(self, placements: Float[Tensor, "P K 2"]) -> Float[Tensor, "P K 2"]:
        """The nearest allowed placements [m].

        All way-points are in the room, and the first keeps the safety distance from the robot's start.
        """
        lower, upper = self.room
        placements = placements.clamp(lower, upper)
        away = placements[:, 0] - self.start
        distance = away.norm(dim=-1, keepdim=True)
        outward = torch.where(distance > 0, away / distance, away.new_tensor([1.0, 0.0]))
        Ds = self.config.safety_distance
        first = torch.where(distance < Ds, self.start + Ds * (1 + TOUCHING) * outward, placements[:, 0])
        return torch.cat([first.unsqueeze(1), placements[:, 1:]], dim=1)

    @property
    def controller(self) -> CbfQpController:
        """The robot's controller."""
        return CbfQpController(GoalTask(self.config.gain), [self.config.avoidance.build([])])

    @property
    def model(self) -> ObservationModel:
        """The model of the robot that the observer assumes."""
        config, controller = self.config, self.controller
        noise = NoiseBound(config.velocity_noise) if config.set == "inverse_optimal" else None
        return ObservationModel(controller.task, controller.barriers, config.set, noise, config.active_tolerance)

    def loop(self, placements: Float[Tensor, "P K 2"] | None, goals: Float[Tensor, "S 2"]) -> Iterator[Sample]:
        """The robot in closed loop, with every placement [m] (None: no probe) and every goal [m]: P x S items."""
        bodies = self._bodies(placements, self.config.steps).repeat_interleave(len(goals), dim=1)
        (T, B), dt, present = bodies.shape[:2], self.config.dt, torch.ones(bodies.shape[1:3], dtype=torch.bool)

        def around(t: float, x: Tensor, _: Tensor) -> Measurement:
            return Measurement(t=t, x=x, u=None, bodies=bodies[round(t / dt)], present=present)

        theta, start = goals.repeat(B // len(goals), 1), self.start.expand(B, 2)
        return closed_loop(self.controller, theta, start, around, dt=dt, samples=T)

    def run(
        self, placements: Float[Tensor, "P K 2"] | None, goals: Float[Tensor, "S 2"], steps: int | None = None
    ) -> Runs:
        """The same closed loop in compiled code, all samples at once, without gradients."""
        with torch.no_grad():
            return run(self.config, self.start, goals, self._bodies(placements, steps or self.config.steps))

    def _bodies(self, placements: Float[Tensor, "P K 2"] | None, samples: int) -> Float[Tensor, "T P M 2"]:
        """The obstacles and the probe at each sample [m]."""
        if placements is None:
            return self.obstacles.expand(samples, 1, -1, -1)
        path = self.path(placements, samples)
        return torch.cat([self.obstacles.expand(*path.shape[:2], -1, -1), path.unsqueeze(2)], dim=2)

    def path(self, placements: Float[Tensor, "P K 2"], samples: int) -> Float[Tensor, "T P 2"]:
        """The positions of the probe at the first samples [m]."""
        return along(placements, torch.arange(samples, dtype=torch.float64) / max(self.config.steps - 1, 1))

    def prior_of(self, items: int) -> FeasibleSet:
        """Theta_0, once for each item."""
        return self.config.prior.build(items)

    def left(
        self, placements: Float[Tensor, "P K 2"] | None, goals: Float[Tensor, "S 2"], steps: int | None = None
    ) -> Left:
        """What is left of Theta with every placement and every goal.

        The evidence of a sample does not depend on Theta, so all samples are read at once. Samples with a facet in
        Theta(T) are read once more with gradients. The others do not change it.

        Args:
            placements: way-points [m], or None for no probe.
            goals: goals [m].
            steps: number of samples. Default: the whole run.
        """
        runs, model, dt = self.run(placements, goals, steps), self.model, self.config.dt
        T, B = runs.feasible.shape
        seen, prior, theta = runs.measurement(dt), self.prior_of(B), goals.repeat(B // len(goals), 1)
        with torch.no_grad():
            found = evidence(model, prior, seen)
            A, b = (rows.unflatten(0, (T, B)).transpose(0, 1).flatten(1, 2) for rows in (found.omega.A, found.omega.b))
            theta_set = prior.intersect(Halfspaces(A, b))
        sound = runs.feasible.all(0) & ~theta_set.is_empty & ~found.alarmed.reshape(T, B).any(0)
        if placements is not None:
            apart = (runs.x - runs.bodies[:, :, -1]).norm(dim=-1)
            sound = sound & (apart >= self.config.safety_distance - TOUCHING).all(0)
        sound = sound & theta_set.contains(theta, TOUCHING)
        if torch.is_grad_enabled() and placements is not None and placements.requires_grad:
            sample = theta_set.facets().source // found.omega.rows  # negative: a facet of the prior
            needed = torch.zeros(T + 1, B, dtype=torch.bool).scatter(0, sample.T % (T + 1), True)[:T] & sound
            probe = self.path(placements, T).repeat_interleave(len(goals), dim=1)
            x, u = follow(self.controller, theta, runs, probe, needed, dt)
            again = seen.select(needed.flatten())
            bodies = torch.cat([again.bodies[:, :-1], probe[needed].unsqueeze(1)], dim=1)
            again = replace(again, x=x[needed], u=u[needed], bodies=bodies)
            told = evidence(model, self.prior_of(len(again.x)), again).omega
            theta_set = prior.intersect(_by_item(told, needed))
        area = torch.where(sound, theta_set.volume(), self.prior_area)
        return Left(area.reshape(-1, len(goals)), sound.reshape(-1, len(goals)))


def along(placements: Float[Tensor, "P K 2"], fraction: float | Float[Tensor, "T"]) -> Float[Tensor, "*T P 2"]:
    """The position of the probe after this fraction of the run [m]."""
    K = placements.shape[1]
    way = (K - 1) * torch.as_tensor(fraction, dtype=torch.float64).unsqueeze(-1)
    weights = (1 - (way - torch.arange(K)).abs()).clamp(min=0)  # of the two way-points before and after it
    return (weights[..., None, :, None] * placements).sum(-2)


def expectation(area: Float[Tensor, "P S"], objective: Objective) -> Float[Tensor, "P"]:
    """The mean over goals of A or log A, with the gradient of that mean.

    This is L of the module docstring. Its value is mean(phi), because the second term has mean zero.
    """
    log_area = area.log()
    phi = area if objective == "area" else log_area
    weight = (phi - phi.mean(-1, keepdim=True)).detach()
    return phi.mean(-1) + (weight * (log_area - log_area.detach())).mean(-1)


def slope(value: Float[Tensor, ""], placements: Float[Tensor, "P K 2"]) -> Float[Tensor, "P K 2"]:
    """The gradient of a sum over placements. It is zero if no placement changes anything."""
    return torch.autograd.grad(value, placements)[0] if value.requires_grad else torch.zeros_like(placements)


def _by_item(rows: Halfspaces, used: Bool[Tensor, "T B"]) -> Halfspaces:
    """The rows of the `used` samples, stacked for each item.

    `rows` has these samples only, in the order of time.
    """
    B, item, slot = used.shape[1], used.nonzero()[:, 1], (used.long().cumsum(0) - 1)[used]
    most = int(used.sum(0).max())
    A, b = rows.A.new_zeros(B, most, *rows.A.shape[1:]), rows.b.new_ones(B, most, rows.rows)
    A, b = A.index_put((item, slot), rows.A), b.index_put((item, slot), rows.b)
    return Halfspaces(A.flatten(1, 2), b.flatten(1, 2))


def _corners(box: BoxConfig) -> tuple[Tensor, Tensor]:
    (lower,), (upper,) = box.corners(1)
    return lower, upper
