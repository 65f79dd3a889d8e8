r"""What a robot wants: nominal controls that are affine in an unknown parameter (G., Sec. III, Assumption 3).

    uhat(x; theta) = C(x) theta + d(x),      C (*batch, n, p),  d (*batch, n).

Every task is a frozen record, called with a `Measurement`, that returns (C, d). The paper asks for such a library of
task-to-function mappings; the robots of its experiments use `GoalTask`: C = kp I, d = -kp x, theta = x_d.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.measurement import Measurement

Affine = tuple[Float[Tensor, "*batch n p"], Float[Tensor, "*batch n"]]


@runtime_checkable
class Task(Protocol):
    """uhat = C theta + d. `parameter_names` names the entries of theta, so p = len(parameter_names)."""

    @property
    def parameter_names(self) -> tuple[str, ...]: ...

    def __call__(self, measurement: Measurement) -> Affine: ...


def _positive(name: str, value: float | Tensor) -> None:
    if not bool(torch.as_tensor(value) > 0):
        raise InputError(name, "a positive number", value)


def _identity_like(x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n n"]:
    return torch.eye(x.shape[-1], dtype=x.dtype, device=x.device).expand(*x.shape, x.shape[-1])


@dataclass(frozen=True)
class GoalTask:
    """Go to a goal: uhat = gain (theta - x), theta the goal [m], gain [1/s] (G., Sec. III)."""

    gain: float | Tensor
    parameter_names: tuple[str, ...] = ("goal_x", "goal_y")

    def __post_init__(self) -> None:
        _positive("gain", self.gain)

    def __call__(self, measurement: Measurement) -> Affine:
        return self.gain * _identity_like(measurement.x), -self.gain * measurement.x


@dataclass(frozen=True)
class UnknownGainGoalTask:
    """Go to a goal with an unknown gain: uhat = k (x_d - x) is linear in theta = (k, k x_d), so C = [-x  I], d = 0."""

    parameter_names: tuple[str, ...] = ("gain", "gain_goal_x", "gain_goal_y")

    def __call__(self, measurement: Measurement) -> Affine:
        x = measurement.x
        return torch.cat([-x.unsqueeze(-1), _identity_like(x)], dim=-1), torch.zeros_like(x)


@dataclass(frozen=True)
class VelocityTask:
    """Keep a constant velocity theta [m/s]: uhat = theta."""

    parameter_names: tuple[str, ...] = ("velocity_x", "velocity_y")

    def __call__(self, measurement: Measurement) -> Affine:
        return _identity_like(measurement.x), torch.zeros_like(measurement.x)


@dataclass(frozen=True)
class FormationTask:
    """Keep an offset theta [m] to a leader, the body in slot `leader`: uhat = gain (x_leader + theta - x)."""

    gain: float | Tensor
    leader: int
    parameter_names: tuple[str, ...] = ("offset_x", "offset_y")

    def __post_init__(self) -> None:
        _positive("gain", self.gain)

    def __call__(self, measurement: Measurement) -> Affine:
        to_leader = measurement.bodies[..., self.leader, :] - measurement.x
        return self.gain * _identity_like(measurement.x), self.gain * to_leader


@dataclass(frozen=True)
class OrbitTask:
    """Circle a centre theta [m] at a known angular rate [rad/s]: uhat = rate J (x - theta), J a turn by 90 deg."""

    rate: float | Tensor
    parameter_names: tuple[str, ...] = ("centre_x", "centre_y")

    def __call__(self, measurement: Measurement) -> Affine:
        turn = self.rate * measurement.x.new_tensor([[0.0, -1.0], [1.0, 0.0]])
        return -turn.expand(*measurement.x.shape, 2), measurement.x @ turn.T


@dataclass(frozen=True)
class PatrolTask:
    """Follow a closed path r(t) = c + sum_k a_k cos(k w t) + b_k sin(k w t), w the `rate` [rad/s].

    uhat = gain (r - x) + dr/dt is linear in theta = (c, a_1, b_1, ...) [m], p = 2 + 4 `harmonics`.
    """

    gain: float
    rate: float
    harmonics: int = 1

    def __post_init__(self) -> None:
        _positive("gain", self.gain)
        _positive("harmonics", self.harmonics)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        waves = [f"{wave}{k}_{axis}" for k in range(1, self.harmonics + 1) for wave in ("cos", "sin") for axis in "xy"]
        return ("centre_x", "centre_y", *waves)

    def __call__(self, measurement: Measurement) -> Affine:
        identity = _identity_like(measurement.x)
        blocks = [self.gain * identity]
        for k in range(1, self.harmonics + 1):
            w = k * self.rate
            cos, sin = math.cos(w * measurement.t), math.sin(w * measurement.t)
            blocks += [(self.gain * cos - w * sin) * identity, (self.gain * sin + w * cos) * identity]
        return torch.cat(blocks, dim=-1), -self.gain * measurement.x


@dataclass(frozen=True)
class AffineTask:
    """Any task that is affine in theta: C (n, p) and d (n,), given as tensors or as functions of the measurement."""

    C: Tensor | Callable[[Measurement], Tensor]
    d: Tensor | Callable[[Measurement], Tensor]
    parameter_names: tuple[str, ...]

    def __call__(self, measurement: Measurement) -> Affine:
        C = self.C(measurement) if callable(self.C) else self.C
        d = self.d(measurement) if callable(self.d) else self.d
        shape = measurement.x.shape
        if C.shape[-2:] != (shape[-1], len(self.parameter_names)) or d.shape[-1:] != shape[-1:]:
            expected = f"C (*batch, {shape[-1]}, {len(self.parameter_names)}) and d (*batch, {shape[-1]})"
            raise InputError("AffineTask(C, d)", expected, (tuple(C.shape), tuple(d.shape)))
        return C.to(torch.float64).expand(*shape[:-1], *C.shape[-2:]), d.to(torch.float64).expand(shape)
