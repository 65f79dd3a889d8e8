"""Random teams in closed loop under a disturbance, and other observers' estimates: the data to train gains on.

The executed velocity is u* + w, with w even in a disc of radius `noise`. Velocities and positions are measured exactly.
So all observers see the same disturbance: the filter through positions, the set through velocities. Theta(t), G and f
do not depend on the gain, so one run of a team serves all passes of the training.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from experiments.design.adaptive import Step
from experiments.design.config import LearnedObserverConfig
from torchfsid.observers.hybrid import HybridObserver
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.observers.ukf import ParameterUkf
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import closed_loop
from torchfsid.robots.tasks import GoalTask


@dataclass(frozen=True)
class Rollouts:
    """The samples of B robots, team after team, and other observers' estimates.

    Attributes:
        steps: the input of an adaptive observer, sample by sample.
        goals: the true goals [m].
        theta: centre of the prior [m].
        information: information matrix of the prior.
        estimates: estimates (T, B, 2) by observer [m]: `centroid`, and with filters `ukf` and `hybrid`.
        contains: share of samples at which Theta(t) holds the truth.
    """

    steps: list[Step]
    goals: Float[Tensor, "B 2"]
    theta: Float[Tensor, "B 2"]
    information: Float[Tensor, "B 2 2"]
    estimates: dict[str, Float[Tensor, "T B 2"]]
    contains: float


def roll_out(
    config: LearnedObserverConfig, noise: float, teams: int, seed: np.random.SeedSequence, filters: bool
) -> Rollouts:
    """Draw teams and run them in one batch.

    Args:
        config: the configuration.
        noise: bound of the disturbance [m/s].
        teams: number of teams.
        seed: seed of the teams and of the disturbance.
        filters: also run the UKF and the hybrid, which takes longest.
    """
    random = np.random.default_rng(seed)
    scenes = [config.team.draw(random) for _ in range(teams)]
    starts, goals = (
        torch.tensor([[robot[key] for robot in scene["robots"]] for scene in scenes], dtype=torch.float64)
        for key in ("start", "goal")
    )
    places = [[obstacle["position"] for obstacle in scene["obstacles"]] for scene in scenes]
    N, K = starts.shape[1], len(places[0])
    obstacles = torch.tensor(places, dtype=torch.float64).reshape(len(scenes), 1, K, 2).expand(-1, N, -1, -1)
    B = len(scenes) * N
    in_disc = random.uniform(size=(2, config.steps, B))
    radius, angle = torch.from_numpy(np.sqrt(in_disc[0])), torch.from_numpy(2 * np.pi * in_disc[1])
    disturbance = (noise * radius).unsqueeze(-1) * torch.stack([angle.cos(), angle.sin()], dim=-1)

    others = torch.cat([~torch.eye(N, dtype=torch.bool), torch.ones(N, K, dtype=torch.bool)], dim=1)
    present = others.repeat(len(scenes), 1)

    def around(t: float, x: Tensor, _: Tensor) -> Measurement:
        team = x.reshape(-1, 1, N, 2).expand(-1, N, -1, -1)
        return Measurement(t=t, x=x, u=None, bodies=torch.cat([team, obstacles], dim=2).flatten(0, 1), present=present)

    controller = CbfQpController(GoalTask(config.gain), [config.avoidance.build([])])
    truth, start, settings = goals.flatten(0, 1), starts.flatten(0, 1), {"dt": config.dt, "samples": config.steps}
    loop = closed_loop(controller, truth, start, around, disturbance=disturbance, **settings)
    prior, tolerance = config.prior.build(B), config.active_tolerance + noise
    sets = SetMembershipObserver(
        controller.task, controller.barriers, prior, noise=NoiseBound(noise), active_tolerance=tolerance
    )
    hybrid = _hybrid(config, sets, noise) if filters else None
    steps, estimates, contained = [], {"centroid": [], **({"ukf": [], "hybrid": []} if filters else {})}, []
    with torch.no_grad():
        for measurement, _ in loop:
            if hybrid is None:
                estimate = sets.update(measurement)
            else:
                both = hybrid.update(measurement)
                estimate = both.set_estimate
                estimates["ukf"].append(both.ukf_estimate.theta)
                estimates["hybrid"].append(both.theta)
            theta_set, u = estimate.feasible_set, measurement.u
            assert u is not None
            kkt = estimate.kkt
            # A sample that says nothing moves no estimate.
            G = torch.where(estimate.informative[:, None, None], kkt.G, 0.0)
            facets, area, centroid = theta_set.facets().halfspaces, theta_set.volume(), estimate.theta
            steps.append(Step(facets, area, centroid, kkt.case, G, kkt.f, u, noise))
            estimates["centroid"].append(centroid)
            contained.append(theta_set.contains(truth).double().mean())
    lower, upper = config.prior.corners(B)
    information = torch.diag_embed(1 / ((upper - lower) / 12**0.5) ** 2)
    others = {name: torch.stack(of) for name, of in estimates.items()}
    return Rollouts(steps, truth, (lower + upper) / 2, information, others, float(torch.stack(contained).mean()))


def _hybrid(config: LearnedObserverConfig, sets: SetMembershipObserver, noise: float) -> HybridObserver:
    """The hybrid observer. Its filter knows the disturbance: `noise`/2 along an axis, independent at every sample."""
    ukf = ParameterUkf.from_prior(
        sets.task,
        sets.barriers,
        *config.prior.corners(len(sets.status)),
        position_noise=config.ukf.position_noise,
        process_noise=config.ukf.process_noise,
        motion_noise=noise / 2 * config.dt**0.5,
        active_tolerance=sets.active_tolerance,
    )
    return HybridObserver(sets, ukf, feedback=config.ukf.feedback)
