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
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from experiments.design.runs import Runs, run
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.active_set import active_set
from torchfsid.identification.critical_region import critical_region
from torchfsid.identification.evidence import ObservationModel, SetKind, evidence
from torchfsid.identification.inverse_optimal import inverse_optimal_set
from torchfsid.robots.avoidance import CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Sample, closed_loop
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.sets.provenance import carried
from torchfsid.tolerances import ACTIVE_TOLERANCE

if TYPE_CHECKING:
    from experiments.design.config import ProbePlacementConfig

Objective = Literal["area", "log_area"]

TOUCHING = 1e-9
"""Round-off allowed in the distance between probe and robot, and of a goal from its set [m]."""

Box = Float[Tensor, "2 2"]
"""Lower and upper corner of a rectangle [m]."""


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

    Its methods compute where the placements and goals are that they are given.

    Attributes:
        task: the robot's task.
        avoidance: its barrier by a safety distance, which ignores neighbours' velocities.
        obstacles: obstacles of the corridor [m].
        start: start of the robot [m].
        prior: Theta_0 [m].
        room: the room for way-points [m].
        dt: sampling time [s].
        steps: number of samples of a run.
        kind: the set that the observer uses.
        noise: its bounds, see `ObservationModel`.
        active_tolerance: see `ObservationModel`.
    """

    task: GoalTask
    avoidance: CollisionAvoidance
    obstacles: Float[Tensor, "m 2"]
    start: Float[Tensor, "2"]
    prior: Box
    room: Box
    dt: float
    steps: int
    kind: SetKind = "critical_region"
    noise: NoiseBound | None = None
    active_tolerance: float = ACTIVE_TOLERANCE

    @classmethod
    def of(cls, config: ProbePlacementConfig, shift: Float[Tensor, "m 2"] | float = 0.0) -> Probing:
        """The scene of the configuration, with its obstacles moved by `shift` [m]."""
        prior, room = (torch.tensor([box.lower, box.upper], dtype=torch.float64) for box in (config.prior, config.room))
        return cls(
            GoalTask(config.gain),
            config.avoidance.build([]),  # type: ignore[arg-type]
            torch.tensor(config.obstacles, dtype=torch.float64) + shift,
            torch.tensor(config.start, dtype=torch.float64),
            prior,
            room,
            config.dt,
            config.steps,
            config.set,
            NoiseBound(config.velocity_noise) if config.set == "inverse_optimal" else None,
            config.active_tolerance,
        )

    @cached_property
    def model(self) -> ObservationModel:
        """The model of the robot that the observer assumes, which is that of the robot itself."""
        return ObservationModel(self.task, [self.avoidance], self.kind, self.noise, self.active_tolerance)

    def to(self, device: torch.device | str) -> Probing:
        """The scene on another device."""
        tensors: dict[str, Any] = {name: part for name, part in vars(self).items() if isinstance(part, Tensor)}
        if all(part.device == torch.device(device) for part in tensors.values()):
            return self
        return replace(self, **{name: part.to(device) for name, part in tensors.items()})

    @property
    def safety_distance(self) -> float:
        """The safety distance of the robot's barrier [m]."""
        return float(self.avoidance.safety_distance)  # type: ignore[arg-type]

    @property
    def prior_area(self) -> float:
        """The area A_0 of Theta_0 [m^2]."""
        return float((self.prior[1] - self.prior[0]).prod())

    def draw_goals(self, count: int, seed: int) -> Float[Tensor, "count 2"]:
        """Goals evenly spread over Theta_0 (scrambled Sobol points) [m]."""
        lower, upper = self.prior
        even = torch.quasirandom.SobolEngine(2, True, seed).draw(count, dtype=torch.float64)
        return lower + (upper - lower) * even.to(lower)

    def grid(self, columns: int, rows: int) -> Float[Tensor, "places 2"]:
        """Centres of the cells of a grid over the room, row by row [m]."""
        lower, upper = self.room
        x, y = ((torch.arange(count).to(lower) + 0.5) / count for count in (columns, rows))
        return lower + (upper - lower) * torch.cartesian_prod(y, x).flip(-1)

    def allowed(self, placements: Float[Tensor, "P K 2"]) -> Float[Tensor, "P K 2"]:
        """The nearest allowed placements [m].

        All way-points are in the room, and the first keeps the safety distance from the robot's start.
        """
        scene, Ds = self.to(placements.device), self.safety_distance
        placements = placements.clamp(*scene.room)
        away = placements[:, 0] - scene.start
        distance = away.norm(dim=-1, keepdim=True)
        outward = torch.where(distance > 0, away / distance, away.new_tensor([1.0, 0.0]))
        first = torch.where(distance < Ds, scene.start + Ds * (1 + TOUCHING) * outward, placements[:, 0])
        return torch.cat([first.unsqueeze(1), placements[:, 1:]], dim=1)

    def loop(self, placements: Float[Tensor, "P K 2"] | None, goals: Float[Tensor, "S 2"]) -> Iterator[Sample]:
        """The robot in closed loop, with every placement [m] (None: no probe) and every goal [m]: P x S items."""
        scene, dt = self.to(goals.device), self.dt
        bodies = scene._bodies(placements, self.steps).repeat_interleave(len(goals), dim=0)
        B, present = len(bodies), torch.ones_like(bodies[:, 0, :, 0], dtype=torch.bool)

        def around(t: float, x: Tensor, _: Tensor) -> Measurement:
            return Measurement(t=t, x=x, u=None, bodies=bodies[:, round(t / dt)], present=present)

        theta, controller = goals.repeat(B // len(goals), 1), CbfQpController(self.task, [self.avoidance])
        return closed_loop(controller, theta, scene.start.expand(B, 2), around, dt=dt, samples=self.steps)

    @torch.no_grad()
    def run(
        self, placements: Float[Tensor, "P K 2"] | None, goals: Float[Tensor, "S 2"], steps: int | None = None
    ) -> Runs:
        """The same closed loop in compiled code, all samples at once, without gradients."""
        scene = self.to(goals.device)
        return run(
            self.task, self.avoidance, scene.start, goals, scene._bodies(placements, steps or self.steps), self.dt
        )

    def _bodies(self, placements: Float[Tensor, "P K 2"] | None, samples: int) -> Float[Tensor, "P T M 2"]:
        """The obstacles and the probe at each sample [m]."""
        if placements is None:
            return self.obstacles.expand(1, samples, -1, -1)
        path = self.path(placements, samples)
        return torch.cat([self.obstacles.expand(*path.shape[:2], -1, -1), path.unsqueeze(2)], dim=2)

    def path(self, placements: Float[Tensor, "P K 2"], samples: int) -> Float[Tensor, "P T 2"]:
        """The positions of the probe at the first samples [m]."""
        return along(placements, torch.arange(samples).to(placements) / max(self.steps - 1, 1))

    def prior_of(self, items: int) -> FeasibleSet:
        """Theta_0, once for each item."""
        lower, upper = self.prior.unsqueeze(1).expand(2, items, 2)
        return FeasibleSet.from_box(lower, upper)

    def left(
        self, placements: Float[Tensor, "P K 2"] | None, goals: Float[Tensor, "S 2"], steps: int | None = None
    ) -> Left:
        """What is left of Theta with every placement and every goal.

        The evidence of a sample does not depend on Theta, so all samples are read at once. Samples with a facet in
        Theta(T) become half-spaces once more, with gradients, which these facets then carry. The others do not change
        Theta(T).

        Args:
            placements: way-points [m], or None for no probe.
            goals: goals [m].
            steps: number of samples. Default: the whole run.
        """
        scene, runs = self.to(goals.device), self.run(placements, goals, steps)
        (B, T), seen, prior = runs.feasible.shape, runs.measurement(), scene.prior_of(1)
        with torch.no_grad():
            found = evidence(self.model, prior, seen)
            omega, R = found.omega, found.omega.rows
            parts = (part.unflatten(0, (B, T)).flatten(1, 2) for part in (omega.A, omega.b))
            theta = scene.prior_of(B).intersect(Halfspaces(*parts))
            sound = runs.feasible.all(1) & ~theta.is_empty & ~found.alarmed.view(B, T).any(1)
            if placements is not None:
                apart = (runs.x - seen.bodies[:, -1].view_as(runs.x)).norm(dim=-1)
                sound = sound & (apart >= self.safety_distance - TOUCHING).all(1)
            sound = sound & theta.contains(goals.repeat(B // len(goals), 1), TOUCHING)
        if torch.is_grad_enabled() and placements is not None and placements.requires_grad:
            facets = theta.facets()
            here = (facets.source >= 0) & sound.unsqueeze(1)  # it is negative for facets of the prior
            item, slot = here.nonzero(as_tuple=True)
            sample, of_facet = (item * T + facets.source[item, slot] // R).unique(return_inverse=True)
            again, path = seen.select(sample), self.path(placements, T)
            x, u = (part.flatten(0, 1).index_select(0, sample) for part in runs.along(path))
            probe = path.flatten(0, 1).index_select(0, sample // (T * len(goals)) * T + sample % T)
            bodies = torch.cat([again.bodies[:, :-1], probe.unsqueeze(1)], dim=1)
            told = self._omega(replace(again, x=x, u=u, bodies=bodies))
            theta = carried(theta, (item, slot), told.select(of_facet))
        area = torch.where(sound, theta.volume(), self.prior_area)
        return Left(area.reshape(-1, len(goals)), sound.reshape(-1, len(goals)))

    def _omega(self, informative: Measurement) -> Halfspaces:
        """The half-spaces of `evidence`, with gradients."""
        rows, (C, d), u = self.avoidance(informative), self.task(informative), informative.u
        assert u is not None
        if self.kind == "critical_region":
            with torch.no_grad():
                active = active_set(rows, u, self.active_tolerance)
            return critical_region(rows, active, C, d)
        assert self.noise is not None
        return inverse_optimal_set(rows, u, C, d, self.noise)


def along(placements: Float[Tensor, "P K 2"], fraction: float | Float[Tensor, "T"]) -> Float[Tensor, "P *T 2"]:
    """The position of the probe after this fraction of the run [m]."""
    K = placements.shape[1]
    way = (K - 1) * torch.as_tensor(fraction, dtype=torch.float64, device=placements.device).unsqueeze(-1)
    return (1 - (way - torch.arange(K, device=way.device)).abs()).clamp(min=0) @ placements


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
