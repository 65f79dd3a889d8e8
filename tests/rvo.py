"""Teams of RVO2 agents, by its Python binding pyrvo, and random scenes. `python -m tests.rvo` observes many of them."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pyrvo
import torch

from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.orca import Orca
from torchfsid.robots.tasks import GoalTask, Saturation
from torchfsid.sets.feasible_set import FeasibleSet


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


def random_team(rng: np.random.Generator) -> tuple[Scene, np.ndarray, float]:
    """10 to 40 agents on a circle, or spread over a square, with goals on the other side or anywhere, and a limit."""
    agents, orca = (
        int(rng.integers(10, 41)),
        replace(random_orca(rng, rng.uniform(1, 2)), count=int(rng.integers(5, 13))),
    )
    orca, reach = replace(orca, time_step=float(np.float32(rng.choice([0.05, 0.1])))), max(3.0, agents / 4)
    if rng.random() < 0.4:
        angle = 2 * math.pi * np.arange(agents) / agents
        x = reach * np.stack([np.cos(angle), np.sin(angle)], axis=1) + rng.normal(0, 0.01, (agents, 2))
        goals = -x
    else:
        side = int(np.ceil(2 * reach))
        cells = rng.permutation(side * side)[:agents]
        x = np.stack([cells % side, cells // side], axis=1) - side / 2 + rng.uniform(-0.05, 0.05, (agents, 2))
        goals = -x if rng.random() < 0.5 else rng.permutation(x) + rng.normal(0, 0.2, (agents, 2))
    radius = rng.uniform(0.15, 0.4, agents) if rng.random() < 0.5 else np.full(agents, 0.3)
    scene = Scene(orca, *(v.astype(np.float32) for v in (x, np.zeros_like(x), radius)))
    return scene, goals.astype(np.float32), float(np.float32(rng.uniform(0.6, 1) * orca.max_speed))


def main() -> None:
    """Random teams against the observer at a bound of 1e-5 m/s: truths lost, robots flagged, infeasible samples."""
    parser = argparse.ArgumentParser(prog="python -m tests.rvo")
    parser.add_argument("--teams", type=int, default=20)
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--wrong", type=float, default=0.0, help="positions are wrong by this much [m]")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    steps = lost = flagged = infeasible = robots = 0
    for seed in range(chosen.seed, chosen.seed + chosen.teams):
        rng = np.random.default_rng(seed)
        scene, goals, limit = random_team(rng)
        box = torch.full(goals.shape, float(np.abs(goals).max()) + 3, dtype=torch.float64)
        task = GoalTask(0.5, saturation=Saturation("norm", (limit, limit)))
        noise = NoiseBound(1e-5, position=chosen.wrong)
        observer = SetMembershipObserver(task, [scene.orca], FeasibleSet.from_box(-box, box), noise=noise)
        for sample in run(scene, goals, 0.5, limit, chosen.steps):
            direction = torch.from_numpy(rng.normal(size=goals.shape))
            wrong = sample.bodies[0] + chosen.wrong * direction / direction.norm(dim=-1, keepdim=True)
            observer.update(replace(sample, x=wrong, bodies=wrong.expand_as(sample.bodies)))
        robots, steps = robots + len(goals), steps + len(goals) * (chosen.steps - 1)
        lost += int((~observer.feasible_set.contains(torch.from_numpy(goals).double())).sum())
        flagged += int((observer.status > 0).sum())
        infeasible += int(observer.infeasible.sum())
    print(
        f"{chosen.teams} teams, {robots} robots, {steps} robot-steps: {lost} truths lost, {flagged} robots flagged, "
        f"{infeasible / steps:.1%} of the samples infeasible"
    )


if __name__ == "__main__":
    main()
