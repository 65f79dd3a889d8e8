"""Measurements of a trajectory: all robots' positions, velocities, accelerations, with errors within the bounds.

The adversary knows the truth, the observer's model and its bounds. At every sample it tries `DIRECTIONS` errors of the
position times `DIRECTIONS` errors of the velocity for each robot. It takes the pair whose half-spaces leave the true
parameter the least room, given the neighbours' errors one sample before. Directions are counted from the normal of the
robot's nearest row. So "away from the neighbour", which makes an active row look inactive, is always among them. An
error that makes the observer report a violated row is preferred to all others.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from experiments.runs.config import SceneConfig
from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.robots.barriers import Barrier, stack_barriers
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Trajectory

DIRECTIONS = 8


def measure(true: Trajectory, config: SceneConfig) -> Trajectory:
    """The trajectory with errors of measurement. Obstacles are known exactly."""
    random = np.random.default_rng(np.random.SeedSequence(config.seed))
    noise, robots = config.measurement_noise, true.robots
    if noise.shape == "adversarial":
        return _worst(true, config, random)
    of_all = (len(true.t), robots)
    (inside, surface) = (in_disc, _on_circle) if true.x.shape[-1] == 2 else (_in_ball, _on_sphere)
    draw, shape = (inside, of_all) if noise.shape == "uniform" else (surface, (robots,))
    x, u = true.x.clone(), true.u.clone()
    x[:, :robots] += draw(random, noise.position, shape)
    if true.velocity is None:
        u[:, :robots] += draw(random, noise.velocity, shape)
        return replace(true, x=x, u=u)
    velocity = true.velocity.clone()
    velocity[:, :robots] += draw(random, noise.velocity, shape)
    u[:, :robots] += draw(random, noise.acceleration, shape)
    return replace(true, x=x, u=u, velocity=velocity)


def _worst(true: Trajectory, config: SceneConfig, random: np.random.Generator) -> Trajectory:
    noise, robots = config.measurement_noise, true.robots
    goals = torch.tensor([robot.goal for robot in config.robots], dtype=torch.float64)
    barriers: list[Barrier] = [barrier.build(config.bodies) for barrier in config.barriers]
    compass = 2 * math.pi * torch.arange(DIRECTIONS, dtype=torch.float64) / DIRECTIONS
    # A length of zero needs no direction.
    turns = torch.cartesian_prod(compass if noise.position else compass[:1], compass if noise.velocity else compass[:1])
    candidates = goals.repeat(len(turns), 1)
    model = ObservationModel(config.task.build(config.bodies, config.dimension), barriers, noise=config.noise.build())
    prior = config.prior.build(len(candidates))
    x, u = true.x.clone(), true.u.clone()
    x[0, :robots] += _on_circle(random, noise.position, (robots,))
    u[0, :robots] += _on_circle(random, noise.velocity, (robots,))
    for k in range(len(true.t)):
        x_error, u_error = (seen[max(k - 1, 0)] - exact[max(k - 1, 0)] for seen, exact in ((x, true.x), (u, true.u)))
        before = u[k - 1] if k > 0 else torch.zeros_like(u[0])
        seen = Measurement.of_team(
            float(true.t[k]), true.x[k] + x_error, true.u[k] + u_error,
            robots=range(robots), previous_u=before, radius=true.radius,
        )  # fmt: skip
        exact = true.measurement(k)
        rows = stack_barriers(barriers, exact).normalised()
        assert exact.u is not None
        nearest = rows.slack(exact.u).argmin(-1)
        normal = rows.A[torch.arange(robots), nearest]
        angles = torch.atan2(normal[:, 1], normal[:, 0]) + turns.T.unsqueeze(-1)  # (position or velocity, turn, robot)
        x_moves, u_moves = noise.position * _towards(angles[0]), noise.velocity * _towards(angles[1])
        tried = replace(
            seen.select(torch.arange(robots).repeat(len(turns))),
            x=(exact.x + x_moves).flatten(0, 1),
            u=(exact.u + u_moves).flatten(0, 1),
        )
        found = evidence(model, prior, tried)
        room = found.omega.slack(candidates).amin(-1).masked_fill(found.alarmed, -math.inf)
        worst = room.reshape(len(turns), robots).argmin(0)
        x[k, :robots] = exact.x + x_moves[worst, torch.arange(robots)]
        u[k, :robots] = exact.u + u_moves[worst, torch.arange(robots)]
    return replace(true, x=x, u=u)


def in_disc(random: np.random.Generator, radius: float, shape: tuple[int, ...]) -> Float[Tensor, "*shape 2"]:
    """Points uniformly distributed in a disc."""
    distance = radius * np.sqrt(random.uniform(size=shape))
    angle = random.uniform(0, 2 * np.pi, size=shape)
    return torch.from_numpy(np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=-1))


def _on_circle(random: np.random.Generator, radius: float, shape: tuple[int, ...]) -> Float[Tensor, "*shape 2"]:
    return radius * _towards(torch.from_numpy(random.uniform(0, 2 * np.pi, size=shape)))


def _in_ball(random: np.random.Generator, radius: float, shape: tuple[int, ...]) -> Float[Tensor, "*shape 3"]:
    """Points uniformly distributed in a ball."""
    share = torch.from_numpy(np.cbrt(random.uniform(size=(*shape, 1))))
    return share * _on_sphere(random, radius, shape)


def _on_sphere(random: np.random.Generator, radius: float, shape: tuple[int, ...]) -> Float[Tensor, "*shape 3"]:
    towards = random.normal(size=(*shape, 3))
    return torch.from_numpy(radius * towards / np.linalg.norm(towards, axis=-1, keepdims=True))


def _towards(angle: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape 2"]:
    return torch.stack([angle.cos(), angle.sin()], dim=-1)
