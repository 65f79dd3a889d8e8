r"""Tasks: nominal controls that are affine in an unknown parameter (G., Sec. III, Assumption 3).

    uhat(x; theta) = C(x) theta + d(x),      C (*batch, n, p),  d (*batch, n).

The control uhat is a velocity [m/s], or an acceleration [m/s2] for robots of second order. Every task is a frozen
record. Called with a `Measurement`, it returns (C, d). The robots of the paper use `GoalTask`: C = kp I, d = -kp x.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.device import constant
from torchfsid.errors import InputError
from torchfsid.robots.arguments import for_samples, require_each, require_names, require_numbers
from torchfsid.robots.bounds import ErrorBounds
from torchfsid.robots.measurement import Measurement

Affine = tuple[Float[Tensor, "*batch n p"], Float[Tensor, "*batch n"]]


@dataclass(frozen=True)
class Saturation:
    """The clipped nominal control uhat = clip(C theta + d), which is zero where |C theta + d| is below `dead_speed`.

    With `dead_speed` equal to the limit of a norm, the robot goes at a constant speed until it stops.

    Attributes:
        shape: `norm` for |uhat| <= v, `box` for |uhat_i| <= v_i.
        limits: the v_i, in the units of the control. For `norm` all are v. Infinite if there is a dead zone only.
        dead_speed: the size below which the control is zero, in its units. For a goal it is the gain times the radius
            of the dead zone.
    """

    shape: Literal["norm", "box"]
    limits: tuple[float, ...]
    dead_speed: float = 0.0

    def __post_init__(self) -> None:
        if not (min(self.limits) >= self.dead_speed >= 0 and min(self.limits) > 0):
            raise InputError("saturation", "positive limits >= dead_speed >= 0", (self.limits, self.dead_speed))
        if self.shape == "norm" and min(self.limits) != max(self.limits):
            raise InputError("saturation.limits", "the same limit for each axis, for a norm", self.limits)

    def scaled(self, factor: float) -> Saturation:
        """The saturation of `factor` times the control."""
        return Saturation(self.shape, tuple(factor * limit for limit in self.limits), factor * self.dead_speed)

    def __call__(self, y: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
        speed = y.square().sum(-1, keepdim=True).clamp(min=1e-300).sqrt()
        if self.shape == "norm":
            clipped = y if math.isinf(self.limits[0]) else y * (self.limits[0] / speed).clamp(max=1.0)
        else:
            limits = constant(tuple(self.limits), y.device)
            clipped = y.clamp(-limits, limits)
        return torch.where(speed < self.dead_speed, 0.0, clipped)


@runtime_checkable
class Task(Protocol):
    """A nominal control uhat = C theta + d, clipped if `saturation` is not None.

    Two more members are optional, for tasks that are not known exactly:

        uncertain                           whether this one is not.
        uncertainty(measurement, corners)   (*batch): a bound on the error of C theta + d [m/s], for theta in the hull
                                            of the corners (*batch, v, p).

    Two more are for tasks whose robots add a known control after clipping, uhat = clip(C theta + d) + feedback:

        feedback(measurement)               (*batch, n), or None.
        feedback_error(bounds)              (*batch): a bound on its error.

    `parameter_names` names the p entries of theta. `task(measurement)` returns C (*batch, n, p) and d (*batch, n).
    """

    @property
    def parameter_names(self) -> tuple[str, ...]: ...

    @property
    def saturation(self) -> Saturation | None: ...

    def __call__(self, measurement: Measurement) -> Affine: ...

    def drift(self, bounds: ErrorBounds, largest: Float[Tensor, "*batch p"]) -> Float[Tensor, "*batch"]:
        """A bound on the error of C theta + d [m/s], given `bounds` on the measurement and |theta_i| <= largest_i."""
        ...


def feedback_of(task: Task, measurement: Measurement) -> Float[Tensor, "*batch n"] | None:
    """The known control that the task adds after clipping. None if it adds none."""
    return task.feedback(measurement) if hasattr(task, "feedback") else None  # type: ignore[attr-defined]


def _positive(name: str, value: float | Tensor) -> None:
    require_numbers(name, "a positive number", value, lambda number: number > 0)


def _identity_like(x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n n"]:
    return torch.eye(x.shape[-1], dtype=x.dtype, device=x.device).expand(*x.shape, x.shape[-1])


def _named(name: str, dimension: int) -> tuple[str, ...]:
    """The names of a vector's entries in the plane (2) or in space (3)."""
    return tuple(f"{name}_{axis}" for axis in "xyz"[:dimension])


def _velocity(measurement: Measurement) -> Float[Tensor, "*batch n"]:
    if measurement.velocity is None:
        raise InputError("measurement.velocity", "the velocities of the robots, of second order", None)
    return measurement.velocity


@dataclass(frozen=True)
class GoalTask:
    """Go to a goal: uhat = gain (theta - x), theta the goal [m], gain [1/s] (G., Sec. III).

    For robots of second order uhat is an acceleration and the gain in [1/s2]:

        uhat = clip(gain (theta - x) - damping v) - loop v

    Attributes:
        gain: the gain, one number or one for each robot (*batch,), also of several samples.
        dimension: 2 in the plane, 3 in space.
        saturation: how the nominal control is clipped.
        gain_error: a bound on the error of the gain.
        damping, loop: of the velocity v, before and after clipping [1/s] (`in_velocity_loop`).
    """

    gain: float | Tensor
    dimension: int = 2
    saturation: Saturation | None = None
    gain_error: float = 0.0
    damping: float = 0.0
    loop: float = 0.0

    def __post_init__(self) -> None:
        _positive("gain", self.gain)
        for name in ("gain_error", "damping", "loop"):
            if not getattr(self, name) >= 0:
                raise InputError(name, "a number >= 0", getattr(self, name))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return _named("goal", self.dimension)

    @classmethod
    def in_velocity_loop(
        cls,
        gain: float,
        loop: float,
        saturation: Saturation | None = None,
        gain_error: float = 0.0,
        dimension: int = 2,
    ) -> GoalTask:
        """Robots whose velocity follows a goal task: uhat = loop (clip(gain (theta - x)) - v), an acceleration.

        Args:
            gain: of the velocity that is followed [1/s].
            loop: of the velocity loop [1/s].
            saturation: of that velocity, limits in [m/s].
            gain_error: a bound on the error of the gain [1/s].
            dimension: 2 in the plane, 3 in space.
        """
        scaled = None if saturation is None else saturation.scaled(loop)
        return cls(loop * gain, dimension, scaled, loop * gain_error, loop=loop)

    @property
    def uncertain(self) -> bool:
        return self.gain_error > 0

    def uncertainty(self, measurement: Measurement, corners: Float[Tensor, "*batch v p"]) -> Float[Tensor, "*batch"]:
        """`gain_error` times the largest distance to a possible goal [m/s]."""
        return self.gain_error * (corners - measurement.x.unsqueeze(-2)).norm(dim=-1).amax(-1)

    def __call__(self, measurement: Measurement) -> Affine:
        require_each("task.gain", self.gain, measurement)
        gain, first = for_samples("task.gain", self.gain, measurement.x.shape[:-1]), measurement.x[..., 0]
        gain = torch.ones_like(first) * gain if isinstance(gain, Tensor) else torch.full_like(first, gain)
        brake = self.damping * _velocity(measurement) if self.damping > 0 else 0.0
        return gain[..., None, None] * _identity_like(measurement.x), -gain.unsqueeze(-1) * measurement.x - brake

    def drift(self, bounds: ErrorBounds, largest: Tensor) -> Tensor:
        gain = for_samples("task.gain", self.gain, bounds.position.shape) + self.gain_error
        return gain * bounds.position + self.damping * bounds.velocity

    def feedback(self, measurement: Measurement) -> Float[Tensor, "*batch n"] | None:
        return -self.loop * _velocity(measurement) if self.loop > 0 else None

    def feedback_error(self, bounds: ErrorBounds) -> Float[Tensor, "*batch"]:
        return self.loop * bounds.velocity


@dataclass(frozen=True)
class UnknownGainGoalTask:
    """Go to a goal with an unknown gain: uhat = k (x_d - x) is linear in theta = (k, k x_d), so C = [-x  I], d = 0."""

    dimension: int = 2
    saturation: Saturation | None = None

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return ("gain", *_named("gain_goal", self.dimension))

    def __call__(self, measurement: Measurement) -> Affine:
        x = measurement.x
        return torch.cat([-x.unsqueeze(-1), _identity_like(x)], dim=-1), torch.zeros_like(x)

    def drift(self, bounds: ErrorBounds, largest: Tensor) -> Tensor:
        return largest[..., 0] * bounds.position


@dataclass(frozen=True)
class VelocityTask:
    """Keep a constant velocity theta [m/s]: uhat = theta."""

    dimension: int = 2
    saturation: Saturation | None = None

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return _named("velocity", self.dimension)

    def __call__(self, measurement: Measurement) -> Affine:
        return _identity_like(measurement.x), torch.zeros_like(measurement.x)

    def drift(self, bounds: ErrorBounds, largest: Tensor) -> Tensor:
        return torch.zeros_like(bounds.position)


@dataclass(frozen=True)
class FormationTask:
    """Keep an offset theta [m] to a leader, the body in slot `leader`: uhat = gain (x_leader + theta - x).

    Where the leader is not present, d is NaN, since the nominal control is unknown.
    """

    gain: float | Tensor
    leader: int
    dimension: int = 2
    saturation: Saturation | None = None

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return _named("offset", self.dimension)

    def __post_init__(self) -> None:
        _positive("gain", self.gain)

    def __call__(self, measurement: Measurement) -> Affine:
        seen = measurement.present[..., self.leader, None]
        to_leader = torch.where(seen, measurement.bodies[..., self.leader, :] - measurement.x, torch.nan)
        return self.gain * _identity_like(measurement.x), self.gain * to_leader

    def drift(self, bounds: ErrorBounds, largest: Tensor) -> Tensor:
        return self.gain * (bounds.position + bounds.body_position[..., self.leader])


@dataclass(frozen=True)
class OrbitTask:
    """Circle a centre theta [m] in the plane at a known rate [rad/s]: uhat = rate J (x - theta), J a turn by 90 deg."""

    rate: float | Tensor
    parameter_names: tuple[str, ...] = ("centre_x", "centre_y")
    saturation: Saturation | None = None

    def __call__(self, measurement: Measurement) -> Affine:
        turn = self.rate * constant(((0.0, -1.0), (1.0, 0.0)), measurement.x.device)
        return -turn.expand(*measurement.x.shape, 2), measurement.x @ turn.T

    def drift(self, bounds: ErrorBounds, largest: Tensor) -> Tensor:
        return abs(self.rate) * bounds.position


@dataclass(frozen=True)
class PatrolTask:
    """Follow a closed path r(t) = c + sum_k (a_k cos(k w t) + b_k sin(k w t)), w the `rate` [rad/s].

    uhat = gain (r - x) + dr/dt is linear in theta = (c, a_1, b_1, ...) [m], p = `dimension` (1 + 2 `harmonics`).
    """

    gain: float
    rate: float
    harmonics: int = 1
    dimension: int = 2
    saturation: Saturation | None = None

    def __post_init__(self) -> None:
        _positive("gain", self.gain)
        _positive("harmonics", self.harmonics)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        waves = [f"{wave}{k}" for k in range(1, self.harmonics + 1) for wave in ("cos", "sin")]
        return tuple(name for part in ("centre", *waves) for name in _named(part, self.dimension))

    def __call__(self, measurement: Measurement) -> Affine:
        identity = _identity_like(measurement.x)
        t = torch.as_tensor(measurement.t, dtype=torch.float64, device=identity.device)[..., None, None]
        blocks = [self.gain * identity]
        for k in range(1, self.harmonics + 1):
            w = k * self.rate
            cos, sin = (w * t).cos(), (w * t).sin()
            blocks += [(self.gain * cos - w * sin) * identity, (self.gain * sin + w * cos) * identity]
        return torch.cat(blocks, dim=-1), -self.gain * measurement.x

    def drift(self, bounds: ErrorBounds, largest: Tensor) -> Tensor:
        return self.gain * bounds.position


@dataclass(frozen=True)
class AffineTask:
    """Any task that is affine in theta, with C (n, p) and d (n,) given as tensors or as functions of the measurement.

    A function sees the batch of robots: for a measurement with x (B, n) it returns C (B, n, p), or d (B, n).

    `sensitivity` bounds the rate at which C theta + d changes with any position [1/s]. It is needed only if positions
    have errors.
    """

    C: Tensor | Callable[[Measurement], Tensor]
    d: Tensor | Callable[[Measurement], Tensor]
    parameter_names: tuple[str, ...]
    saturation: Saturation | None = None
    sensitivity: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameter_names", require_names("parameter_names", self.parameter_names))

    def __call__(self, measurement: Measurement) -> Affine:
        C = self.C(measurement) if callable(self.C) else self.C
        d = self.d(measurement) if callable(self.d) else self.d
        shape = measurement.x.shape
        if C.shape[-2:] != (shape[-1], len(self.parameter_names)) or d.shape[-1:] != shape[-1:]:
            expected = f"C (*batch, {shape[-1]}, {len(self.parameter_names)}) and d (*batch, {shape[-1]})"
            raise InputError("AffineTask(C, d)", expected, (tuple(C.shape), tuple(d.shape)))
        return C.to(torch.float64).expand(*shape[:-1], *C.shape[-2:]), d.to(torch.float64).expand(shape)

    def drift(self, bounds: ErrorBounds, largest: Tensor) -> Tensor:
        if self.sensitivity is None and bool((bounds.position > 0).any() | (bounds.body_position > 0).any()):
            raise InputError("AffineTask.sensitivity", "how fast C theta + d changes with positions [1/s]", None)
        of_bodies = bounds.body_position.amax(-1) if bounds.body_position.shape[-1] else 0.0
        return (self.sensitivity or 0.0) * (bounds.position + of_bodies)
