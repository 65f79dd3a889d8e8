r"""Table I: a robot held in one of the paper's cases by bodies that move along with it.

A body at x + r n, n a unit vector, leaves the robot in this direction a speed that grows with its distance,

    n.u <= gamma/2 (r - Ds^2/r) = s      <=>      r = (s + sqrt(s^2 + gamma^2 Ds^2)) / gamma.

So rows with any normals can be made to meet in one control: s = n.meet. The bodies are placed anew around the robot at
every step, from nothing but its position; what it then does is the solution of its safety QP, and it moves on by that.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from experiments.runs.config import CaseConfig, CasesConfig
from experiments.runs.recording import Recording
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement


def record_cases(config: CasesConfig) -> Recording:
    """All cases as one batch of robots, each among its own bodies."""
    goals = torch.tensor(config.goal, dtype=torch.float64).expand(len(config.cases), 2)
    controller = CbfQpController(config.task.build([]), [barrier.build([]) for barrier in config.barriers])
    return Recording(
        robots=[case.name for case in config.cases],
        goals=goals,
        task=controller.task,
        barriers=list(controller.barriers),
        row_names=[str(j + 1) for j in range(_slots(config))],
        measurements=_measurements(config, controller, goals),
        samples=config.steps + 1,
    )


def _measurements(config: CasesConfig, controller: CbfQpController, goals: Tensor) -> Iterator[Measurement]:
    x = torch.tensor(config.start, dtype=torch.float64).expand(len(config.cases), 2)
    places = [_places(case, config) for case in config.cases]
    offsets, radii, present = (torch.stack(parts) for parts in zip(*places, strict=True))
    for k in range(config.steps + 1):
        t = k * config.dt
        measurement = Measurement(
            t=t,
            x=x,
            u=None,
            bodies=x.unsqueeze(-2) + offsets @ _rotation(math.radians(config.spin) * t).T,
            present=present,
            radius=torch.full(goals.shape[:1], config.radius, dtype=torch.float64),
            body_radii=radii,
        )
        u = controller(measurement, goals).u
        yield replace(measurement, u=u)
        x = x + config.dt * u


def _places(case: CaseConfig, config: CasesConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets (m, 2) of the bodies from the robot at the start, their radii (m,), and which slots are taken (m,)."""
    slots, taken = _slots(config), len(case.bodies)
    gamma, margin = config.avoidance.class_k.gain, config.avoidance.margin
    assert margin is not None
    offsets = torch.ones(slots, 2, dtype=torch.float64)
    radii = torch.ones(slots, dtype=torch.float64)
    for j, body in enumerate(case.bodies):
        angle = math.radians(body.direction)
        normal = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
        speed = body.speed if body.speed is not None else float(normal @ torch.tensor(case.meet, dtype=torch.float64))
        safety_distance = config.radius + body.radius + margin
        distance = (speed + math.hypot(speed, gamma * safety_distance)) / gamma
        offsets[j] = distance * normal
        radii[j] = body.radius
    return offsets, radii, torch.arange(slots) < taken


def _slots(config: CasesConfig) -> int:
    return max(len(case.bodies) for case in config.cases)


def _rotation(angle: float) -> Float[Tensor, "2 2"]:
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
