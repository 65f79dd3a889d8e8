"""What the test kit draws: true situations, the motions of robots in them, and measurements within bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import torch
from torch import Tensor

from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import VelocityTask

DRAWS = 20
"""Measurements of each situation, in checks of what is random."""

ROUND_OFF_OF_QPS = 1e-9
"""What the controls of the kit's own robots may be off [m/s]."""


def random_situations(seed: int = 0, robots: int = 100, bodies: int = 4, n: int = 2) -> Measurement:
    """Robots within a metre or two of the origin, bodies 0.1 to 4 m away from them; some slots are empty.

    Velocities and accelerations are of the order of one.
    """
    draw = generator(seed)
    here, there = (torch.zeros(shape, dtype=torch.float64) for shape in [(robots, n), (robots, bodies, n)])
    x, distance = 0.7 * normal(here, draw), 0.1 * (3.7 * uniform(there[..., :1], draw)).exp()
    return Measurement(
        t=9 * uniform(here[:, 0], draw),
        x=x,
        u=normal(here, draw),
        bodies=x.unsqueeze(1) + distance * direction(there, draw),
        present=uniform(there[..., 0], draw) < 0.9,
        velocity=0.5 * normal(here, draw),
        body_velocities=0.5 * normal(there, draw),
        previous_body_velocities=0.5 * normal(there, draw),
        body_accelerations=0.5 * normal(there, draw),
        radius=0.05 + 0.1 * uniform(here[:, 0], draw),
        body_radii=0.05 + 0.1 * uniform(there[..., 0], draw),
    )


def first_order(measurement: Measurement, dt: float) -> Measurement:
    """Everything after `dt` seconds, where controls are velocities."""
    assert measurement.u is not None
    v = measurement.body_velocities
    bodies = measurement.bodies if v is None else measurement.bodies + dt * v
    return replace(measurement, x=measurement.x + dt * measurement.u, bodies=bodies)


def second_order(measurement: Measurement, dt: float) -> Measurement:
    """Everything after `dt` seconds, to first order in dt, where controls are accelerations."""
    x, v, u = measurement.x, measurement.velocity, measurement.u
    bodies, body_v, body_a = measurement.bodies, measurement.body_velocities, measurement.body_accelerations
    assert v is not None
    assert u is not None
    return replace(
        measurement,
        x=x + dt * v,
        velocity=v + dt * u,
        bodies=bodies if body_v is None else bodies + dt * body_v,
        body_velocities=body_v if body_v is None or body_a is None else body_v + dt * body_a,
    )


def measured(true: Measurement, size: float, draw: torch.Generator) -> tuple[Measurement, NoiseBound]:
    """A measurement of the situation with a bound of its own for every number, at most `size`, and the noise bound.

    The errors of half of the robots are as large as their bounds, and bring robot and bodies nearer to each other or
    away from each other along one line.
    """
    noise = NoiseBound(ROUND_OFF_OF_QPS)
    if size == 0:
        return true, noise
    line, at_bounds = direction(true.x, draw), uniform(true.x[:, :1], draw) < 0.5

    def with_error(value: Tensor | None, bound: Tensor, sign: float) -> Tensor | None:
        if value is None:
            return None
        shape = (-1, *(1,) * (value.ndim - 2), line.shape[-1])
        somewhere = direction(value, draw) * uniform(value[..., :1], draw)
        error = torch.where(at_bounds.reshape(*shape[:-1], 1), sign * line.reshape(shape), somewhere)
        return value + bound.unsqueeze(-1) * error

    of_robots, of_bodies = true.x[:, 0], true.bodies[..., 0]
    position, control, arrival = (size * uniform(of_robots, draw) for _ in range(3))
    body_position, body_velocity, body_acceleration = (size * uniform(of_bodies, draw) for _ in range(3))
    x, bodies = with_error(true.x, position, 1.0), with_error(true.bodies, body_position, -1.0)
    assert x is not None
    assert bodies is not None
    seen = replace(
        true,
        x=x,
        u=with_error(true.u, control, 1.0),
        bodies=bodies,
        velocity=with_error(true.velocity, arrival, 1.0),
        body_velocities=with_error(true.body_velocities, body_velocity, -1.0),
        previous_body_velocities=with_error(true.previous_body_velocities, body_velocity, -1.0),
        body_accelerations=with_error(true.body_accelerations, body_acceleration, -1.0),
        position_error=position,
        body_position_error=body_position,
        velocity_error=control,
        body_velocity_error=body_velocity,
        arrival_error=arrival,
        body_acceleration_error=body_acceleration,
    )
    return seen, noise


def on_boundary(
    barrier: Barrier, true: Measurement, j: int, draw: torch.Generator
) -> tuple[Measurement, Tensor, Tensor]:
    """The situation with controls on the boundary of row j, this unit row (B, 1, n), and where it exists (B,)."""
    u = 2 * normal(true.x, draw)
    for _ in range(5):  # rows may depend on the control: the tangent of a disc does
        row = barrier(replace(true, u=u)).normalised()
        beyond = ((row.A[:, j] * u).sum(-1) - row.b[:, j]) * (row.A[:, j] != 0).any(-1)
        u = torch.where(beyond.isfinite().unsqueeze(-1), u - beyond.unsqueeze(-1) * row.A[:, j], u)
    active = replace(true, u=u)
    row = barrier(active).normalised()
    exists = (row.A[:, j] != 0).any(-1) & (row.slack(u)[:, j].abs() <= 1e-10 * (1 + u.norm(dim=-1)))
    return active, row.A[:, j : j + 1], exists


def motions(barrier: Barrier, situations: Measurement, draw: torch.Generator) -> tuple[Measurement, Tensor]:
    """What robots do that want random velocities, from slow to very fast ones, and these velocities.

    Robots whose QP has no solution are left out, unless they take the least violation (`Barrier.relaxes`).
    """
    wish = 0.1 * (5 * uniform(situations.x[:, :1], draw)).exp() * direction(situations.x, draw)
    control = CbfQpController(VelocityTask(situations.x.shape[-1]), [barrier])(replace(situations, u=None), wish)
    moves = control.feasible | (control.u != 0).any(-1)
    return replace(situations, u=control.u).select(moves), wish[moves]


def of_tensors(measurement: Measurement, change: Callable[[str, Tensor], Tensor]) -> Measurement:
    """The measurement with every tensor in it changed, those of `left_out` too."""
    changed = {}
    for field in fields(measurement):
        value = getattr(measurement, field.name)
        if isinstance(value, Tensor) and value.ndim > 0:
            changed[field.name] = change(field.name, value)
    if measurement.left_out is not None:
        bounds = (change("left_out", bound) for bound in measurement.left_out)
        changed["left_out"] = type(measurement.left_out)(*bounds)
    return replace(measurement, **changed)


def repeated(situations: Measurement) -> Measurement:
    """Every situation `DRAWS` times."""
    return situations.select(torch.arange(len(situations.x), device=situations.x.device).repeat(DRAWS))


def spoilt(present: Tensor, garbage: float, name: str, value: Tensor) -> Tensor:
    """The field `name` of a measurement, with garbage in the slots of absent bodies."""
    if not name.startswith(("bod", "previous_bod")):
        return value
    return torch.where(present.unsqueeze(-1) if value.ndim > present.ndim else present, value, garbage)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def uniform(like: Tensor, draw: torch.Generator) -> Tensor:
    return torch.rand(like.shape, generator=draw, dtype=torch.float64).to(like.device)


def normal(like: Tensor, draw: torch.Generator) -> Tensor:
    return torch.randn(like.shape, generator=draw, dtype=torch.float64).to(like.device)


def direction(like: Tensor, draw: torch.Generator) -> Tensor:
    return torch.nn.functional.normalize(normal(like, draw), dim=-1)
