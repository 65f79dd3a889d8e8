r"""Table I: a robot is held in one of the paper's cases by bodies that move along with it.

A body at x + r n, with n a unit vector, limits the robot's speed in this direction. The limit s grows with r:

    n.u <= gamma/2 (r - Ds^2/r) = s      <=>      r = (s + sqrt(s^2 + gamma^2 Ds^2)) / gamma.

So rows with any normals can be made to meet in one control, with s = n.meet. At every step the bodies are placed anew
around the robot, from its position alone. The robot then moves by the solution of its safety QP.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from experiments.kinds import Track
from experiments.results import write_rows
from experiments.runs.config import CaseConfig, CasesConfig
from experiments.runs.observe import observe
from experiments.runs.recording import Recording
from experiments.runs.saved import Results
from experiments.runs.table import measure_cases
from torchfsid.config.quantities import known
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import closed_loop


def run_cases(config: CasesConfig, out: Path, track: Track) -> dict[str, Any]:
    """Simulate, observe, and return the summary."""
    observers, tally = observe(config, record_cases(config), out, track)
    summary = measure_cases(config, Results(out, config), observers, tally)
    write_rows(out / "cases.csv", summary["cases"])
    return summary


def record_cases(config: CasesConfig) -> Recording:
    """All cases as one batch of robots, each among its own bodies."""
    count = len(config.cases)
    goals, start = (torch.tensor(at, dtype=torch.float64).expand(count, 2) for at in (config.goal, config.start))
    task = config.task.build([], config.dimension)
    controller = CbfQpController(task, [barrier.build([]) for barrier in config.barriers])
    places = [_places(case, config) for case in config.cases]
    offsets, radii, present = (torch.stack(parts) for parts in zip(*places, strict=True))
    radius = torch.full((count,), config.radius, dtype=torch.float64)

    def around(t: float, x: Tensor, _: Tensor) -> Measurement:
        bodies = x.unsqueeze(-2) + offsets @ _rotation(math.radians(config.spin) * t).T
        return Measurement(t=t, x=x, u=None, bodies=bodies, present=present, radius=radius, body_radii=radii)

    samples = config.steps + 1
    return Recording(
        robots=[case.name for case in config.cases],
        goals=goals,
        task=controller.task,
        barriers=list(controller.barriers),
        labels=[f"avoid {j + 1}" for j in range(config.slots)],
        measurements=(
            sample.measurement
            for sample in closed_loop(controller, goals, start, around, dt=config.dt, samples=samples)
        ),
        samples=samples,
    )


def _places(case: CaseConfig, config: CasesConfig) -> tuple[Tensor, Tensor, Tensor]:
    """The bodies of a case.

    Returns:
        Offsets (m, 2) from the robot at the start [m], radii (m,) [m], and which slots hold a body (m,).
    """
    slots, taken = config.slots, len(case.bodies)
    (avoidance,) = config.barriers
    gamma, margin = known(avoidance.class_k.gain), known(avoidance.margin)
    assert gamma is not None
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


def _rotation(angle: float) -> Float[Tensor, "2 2"]:
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
