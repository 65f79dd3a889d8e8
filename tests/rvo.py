"""Teams of RVO2 agents, by its Python binding pyrvo, and random scenes for them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyrvo
import torch

from torchfsid.robots.measurement import Measurement
from torchfsid.robots.orca import Orca


@dataclass
class Scene:
    """Agents with positions, velocities, radii [m, m/s], as RVO2 sees them (single precision)."""

    orca: Orca
    x: np.ndarray
    v: np.ndarray
    radius: np.ndarray

    def simulator(self) -> pyrvo.RVOSimulator:
        o = self.orca
        simulator = pyrvo.RVOSimulator(
            o.time_step, o.distance, o.count, o.time_horizon, o.time_horizon, 0.3, o.max_speed
        )
        for i, (x, v, radius) in enumerate(zip(self.x.tolist(), self.v.tolist(), self.radius.tolist(), strict=True)):
            simulator.add_agent(tuple(x))
            simulator.set_agent_velocity(i, tuple(v))
            simulator.set_agent_radius(i, radius)
            simulator.set_agent_max_neighbors(i, o.count)
            simulator.set_agent_neighbor_dist(i, o.distance)
            simulator.set_agent_time_horizon(i, o.time_horizon)
            simulator.set_agent_max_speed(i, o.max_speed)
        return simulator

    def measurement(self) -> Measurement:
        x, v, radius = (torch.from_numpy(values).double() for values in (self.x, self.v, self.radius))
        return Measurement.of_team(0.0, x, None, previous_u=v, radius=radius)


def random_orca(rng: np.random.Generator, max_speed: float) -> Orca:
    horizon, step, speed, distance = (
        float(np.float32(value))
        for value in (rng.uniform(0.8, 4), rng.choice([0.05, 0.1, 0.25]), max_speed, rng.uniform(3, 12))
    )
    return Orca(horizon, step, speed, int(rng.integers(1, 13)), distance)


def random_scene(rng: np.random.Generator) -> Scene:
    """Up to 25 agents, jammed or far apart, some of them overlapping."""
    agents, side = int(rng.integers(2, 26)), rng.uniform(1.5, 8)
    orca = random_orca(rng, rng.uniform(0.5, 2))
    v = rng.normal(0, 0.5 * orca.max_speed, (agents, 2))
    v *= np.minimum(1, orca.max_speed / np.linalg.norm(v, axis=1, keepdims=True))
    x, radius = rng.uniform(-side, side, (agents, 2)), rng.uniform(0.1, 0.5, agents)
    return Scene(orca, *(values.astype(np.float32) for values in (x, v, radius)))


def vectors(simulator: pyrvo.RVOSimulator, what: str, agents: int) -> np.ndarray:
    read = getattr(simulator, f"get_agent_{what}")
    return np.array([(read(i).x, read(i).y) for i in range(agents)])


def run(scene: Scene, goals: np.ndarray, gain: float, limit: float, steps: int) -> Iterator[Measurement]:
    """The samples of a team with u_pref = clip(gain (goal - x)), from the second on."""
    simulator, agents = scene.simulator(), len(scene.x)
    goals, gain, limit = goals.astype(np.float32), np.float32(gain), np.float32(limit)
    radius, before = torch.from_numpy(scene.radius).double(), np.zeros((agents, 2))
    for k in range(steps):
        x = vectors(simulator, "position", agents)
        for i, wish in enumerate(gain * (goals - x.astype(np.float32))):
            speed = np.float32(math.hypot(*wish))
            simulator.set_agent_pref_velocity(i, tuple(map(float, wish * (limit / speed) if speed > limit else wish)))
        simulator.do_step()
        u = vectors(simulator, "velocity", agents)
        if k > 0:
            yield Measurement.of_team(
                k * scene.orca.time_step, *map(torch.from_numpy, (x, u)),
                previous_u=torch.from_numpy(before), radius=radius,
            )  # fmt: skip
        before = u
