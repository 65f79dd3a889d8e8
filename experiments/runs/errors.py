"""Measurements of a trajectory: all robots' positions, velocities, accelerations, with errors within the bounds.

The adversary knows the truth, the observer's model and its bounds. At every sample it tries `DIRECTIONS` errors of the
position times `DIRECTIONS` errors of the velocity for each robot. It takes the pair whose half-spaces leave the true
parameter the least room, given the neighbours' errors one sample before. Directions are counted from the normal of the
robot's nearest row. So "away from the neighbour", which makes an active row look inactive, is always among them. An
error that makes the observer report a violated row is preferred to all others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from experiments.runs.batch import Batch
from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.robots.barriers import stack_barriers
from torchfsid.robots.simulation import Trajectory

DIRECTIONS = 8


def measure(batch: Batch) -> Trajectory:
    """The batch's true trajectories with errors of measurement. Obstacles are known exactly."""
    true, generators = batch.true, [np.random.default_rng(np.random.SeedSequence(of.seed)) for of in batch.scenes]
    if batch.scenes[0].measurement_noise.shape == "adversarial":
        return _worst(batch, generators)
    x, u, velocity = true.x.clone(), true.u.clone(), None if true.velocity is None else true.velocity.clone()
    (inside, surface) = (in_disc, on_circle) if x.shape[-1] == 2 else (_in_ball, _on_sphere)
    for i, (scene, random) in enumerate(zip(batch.scenes, generators, strict=True)):
        noise, robots = scene.measurement_noise, len(scene.robots)
        draw, shape = (inside, (len(true.t), robots)) if noise.shape == "uniform" else (surface, (robots,))
        of_control = noise.velocity if velocity is None else noise.acceleration
        x[:, i, :robots] += draw(random, noise.position, shape)
        if velocity is not None:
            velocity[:, i, :robots] += draw(random, noise.velocity, shape)
        u[:, i, :robots] += draw(random, of_control, shape)
    return replace(true, x=x, u=u, velocity=velocity)


def _worst(batch: Batch, generators: Sequence[np.random.Generator]) -> Trajectory:
    true, team, robots, places = batch.true, batch.team, batch.robots, batch.places
    noises = [scene.measurement_noise for scene in batch.scenes]
    lengths = torch.tensor([[noise.position, noise.velocity] for noise in noises], dtype=torch.float64)[team].T
    compass = 2 * math.pi * torch.arange(DIRECTIONS, dtype=torch.float64) / DIRECTIONS
    # A length of zero needs no direction.
    turns = torch.cartesian_prod(*(compass if bool(length.any()) else compass[:1] for length in lengths))
    candidates, tries = batch.goals.repeat(len(turns), 1), torch.arange(len(team)).repeat(len(turns))
    model, of_tries = batch.model(team), batch.model(team[tries])
    declared = ObservationModel(of_tries.task, of_tries.barriers, noise=of_tries.noise)
    prior = batch.scenes[0].prior.build(len(candidates))
    measured = replace(true, x=true.x.clone(), u=true.u.clone())
    for i, (noise, random) in enumerate(zip(noises, generators, strict=True)):
        count = (int((team == i).sum()),)
        measured.x[0, i, : count[0]] += on_circle(random, noise.position, count)
        measured.u[0, i, : count[0]] += on_circle(random, noise.velocity, count)
    for k in range(len(true.t)):
        if k > 0:  # until they are chosen, the errors are those of one sample before
            for seen, exact in ((measured.x, true.x), (measured.u, true.u)):
                seen[k] += seen[k - 1] - exact[k - 1]
        exact, seen = batch.of_robots(true.measurement(k)), batch.of_robots(measured.measurement(k))
        rows = stack_barriers(model.barriers, exact).normalised()
        assert exact.u is not None
        nearest = rows.slack(exact.u).argmin(-1)
        normal = rows.A[torch.arange(len(team)), nearest]
        angles = torch.atan2(normal[:, 1], normal[:, 0]) + turns.T.unsqueeze(-1)  # (position or velocity, turn, robot)
        x_moves, u_moves = lengths[:, None, :, None] * _towards(angles)
        tried = replace(seen.select(tries), x=(exact.x + x_moves).flatten(0, 1), u=(exact.u + u_moves).flatten(0, 1))
        found = evidence(declared, prior, tried)
        room = found.omega.slack(candidates).amin(-1).masked_fill(found.alarmed, -math.inf)
        worst = room.reshape(len(turns), len(team)).argmin(0)
        for of_bodies, exactly, moves in ((measured.x, exact.x, x_moves), (measured.u, exact.u, u_moves)):
            chosen = exactly + moves[worst, torch.arange(len(team))]
            of_bodies[k, team, places % robots] = chosen
    return measured


def in_disc(random: np.random.Generator, radius: float, shape: tuple[int, ...]) -> Float[Tensor, "*shape 2"]:
    """Points uniformly distributed in a disc."""
    distance = radius * np.sqrt(random.uniform(size=shape))
    angle = random.uniform(0, 2 * np.pi, size=shape)
    return torch.from_numpy(np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=-1))


def on_circle(random: np.random.Generator, radius: float, shape: tuple[int, ...]) -> Float[Tensor, "*shape 2"]:
    """Points uniformly distributed on a circle."""
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
