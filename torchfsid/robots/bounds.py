"""The records of bounds on errors.

NoiseBound    declared once for a whole log: errors of controls, slacks, positions, velocities
ErrorBounds   at one instant: the declared bounds plus those that the measurement itself gives
RowErrors     errors of a barrier's rows that follow from errors of positions (`Barrier.errors`)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.robots.arguments import require_numbers
from torchfsid.robots.measurement import Measurement


@dataclass(frozen=True)
class NoiseBound:
    """Bounds on measurement errors, the same at all times.

    The control u of robots of first order is a velocity. That of robots of second order is an acceleration, and
    `velocity` and `slack` are accelerations as well [m/s2].

    Attributes:
        velocity: a bound on |u - u*|, which counts errors of the measured control and of the controller's solver [m/s].
        slack: the largest measured slack of a truly active row [m/s]; default: `velocity`.
        position: a bound on the error of every measured position [m].
        neighbour_velocity: a bound on the errors of other bodies' velocities, where rows use them [m/s].
        neighbour_acceleration: a bound on the errors of other bodies' accelerations, where rows use them [m/s2].
        arrival: a bound on the errors of the robots' own `Measurement.velocity` [m/s].

    Each may be a tensor (*batch,), a bound for each robot.
    """

    velocity: float | Float[Tensor, "*batch"]
    slack: float | Float[Tensor, "*batch"]
    position: float | Float[Tensor, "*batch"]
    neighbour_velocity: float | Float[Tensor, "*batch"]
    neighbour_acceleration: float | Float[Tensor, "*batch"]
    arrival: float | Float[Tensor, "*batch"]

    def __init__(
        self,
        velocity: float | Float[Tensor, "*batch"],
        slack: float | Float[Tensor, "*batch"] | None = None,
        position: float | Float[Tensor, "*batch"] = 0.0,
        neighbour_velocity: float | Float[Tensor, "*batch"] = 0.0,
        neighbour_acceleration: float | Float[Tensor, "*batch"] = 0.0,
        arrival: float | Float[Tensor, "*batch"] = 0.0,
    ):
        slack = velocity if slack is None else slack
        bounds = {"velocity": velocity, "slack": slack, "position": position, "neighbour_velocity": neighbour_velocity}
        bounds |= {"neighbour_acceleration": neighbour_acceleration, "arrival": arrival}
        for name, bound in bounds.items():
            require_numbers(f"noise.{name}", "a bound >= 0", bound, lambda size: size >= 0)
            object.__setattr__(self, name, bound)

    def select(self, robots: Int[Tensor, "k"]) -> NoiseBound:
        """The bounds of some robots."""

        def of_these(bound: float | Tensor) -> float | Tensor:
            return bound[robots] if isinstance(bound, Tensor) and bound.ndim > 0 and len(bound) > 1 else bound

        return self._each(of_these)

    def of_samples(self, robots: int, items: int) -> NoiseBound:
        """The bounds of all `items` of one or several samples of these robots, concatenated.

        Raises:
            InputError: there are bounds for each robot, of another number of robots.
        """

        def repeated(bound: float | Tensor) -> float | Tensor:
            if not isinstance(bound, Tensor) or bound.ndim != 1 or len(bound) in (1, items):
                return bound
            if len(bound) != robots:
                raise InputError("noise", f"a bound for each of {robots} robots, or one for all", tuple(bound.shape))
            return bound.repeat(items // max(robots, 1))

        return self._each(repeated)

    def _each(self, changed: Callable[[float | Tensor], float | Tensor]) -> NoiseBound:
        bounds = {field.name: getattr(self, field.name) for field in fields(self)}
        new = {name: changed(bound) for name, bound in bounds.items() if isinstance(bound, Tensor)}
        return replace(self, **new) if any(bound is not bounds[name] for name, bound in new.items()) else self


class ErrorBounds(NamedTuple):
    """Bounds on the errors of one measurement.

    Attributes:
        position: bound for the robots' positions [m].
        body_position: bound for the bodies' positions [m].
        body_velocity: bound for the bodies' velocities [m/s].
        velocity: bound for the robots' velocities on arrival [m/s].
        body_acceleration: bound for the bodies' accelerations [m/s2].
        control: bound for the robots' controls, in their units.
    """

    position: Float[Tensor, "*batch"]
    body_position: Float[Tensor, "*batch m"]
    body_velocity: Float[Tensor, "*batch m"]
    velocity: Float[Tensor, "*batch"]
    body_acceleration: Float[Tensor, "*batch m"]
    control: Float[Tensor, "*batch"]

    @classmethod
    def of(cls, measurement: Measurement, noise: NoiseBound | None) -> ErrorBounds | None:
        """The declared bounds plus those of the measurement. None if all but the controls is exact."""
        noise, m = NoiseBound(0.0) if noise is None else noise, measurement
        declared = noise.position, noise.position, noise.neighbour_velocity, noise.arrival, noise.neighbour_acceleration
        added = (
            m.position_error, m.body_position_error, m.body_velocity_error, m.arrival_error, m.body_acceleration_error,
        )  # fmt: skip
        if all(error is None for error in added) and not any(map(_is_positive, declared)):
            return None
        known = cls.of_controls(measurement, noise)
        position, body_position, body_velocity, velocity, body_acceleration = (
            bound + _beside(bound, size) if error is None else bound + _beside(bound, size) + error
            for bound, size, error in zip(known[:-1], declared, added, strict=True)
        )
        return cls(position, body_position, body_velocity, velocity, body_acceleration, known.control)

    @classmethod
    def of_controls(cls, measurement: Measurement, noise: NoiseBound | None) -> ErrorBounds:
        """The bounds where all but the controls is exact."""
        none = cls.none(measurement)
        control = none.control + (0.0 if noise is None else noise.velocity)
        return none._replace(
            control=control if measurement.velocity_error is None else control + measurement.velocity_error
        )

    @classmethod
    def none(cls, measurement: Measurement) -> ErrorBounds:
        """The bounds of an exact measurement: zero."""
        robots, bodies = torch.zeros_like(measurement.x[..., 0]), torch.zeros_like(measurement.bodies[..., 0])
        return cls(robots, bodies, bodies, robots, bodies, robots)

    @property
    def exact(self) -> bool:
        """Is all but the controls exact?"""
        return not any(bool((bound > 0).any()) for bound in self[:-1])


def _is_positive(bound: float | Tensor) -> bool:
    return bool((bound > 0).any()) if isinstance(bound, Tensor) else bound > 0


def _beside(bounds: Tensor, size: float | Tensor) -> float | Tensor:
    """A bound for each robot, so that it can be added to `bounds` of robots or of the bodies that they see."""
    return size.unsqueeze(-1) if isinstance(size, Tensor) and 0 < size.ndim < bounds.ndim else size


class RowErrors(NamedTuple):
    """Bounds on the errors of a barrier's rows.

    Attributes:
        angle: bound on the error of each row's direction [rad]. From pi on, the direction is unknown.
        slack: the additional slack with which an active row may be measured, and the violation with which a row that is
            kept may be measured [m/s]. Infinite if unknown.
    """

    angle: Float[Tensor, "*batch m"]
    slack: Float[Tensor, "*batch m"]

    @classmethod
    def none(cls, like: Float[Tensor, "*batch m"]) -> RowErrors:
        """The errors of exact rows: zero."""
        nothing = torch.zeros_like(like)
        return cls(nothing, nothing)

    @classmethod
    def unknown(cls, like: Float[Tensor, "*batch m"]) -> RowErrors:
        """The errors of rows whose direction and slack are unknown."""
        return cls(torch.full_like(like, math.pi), torch.full_like(like, math.inf))

    @classmethod
    def stack(cls, parts: Sequence[RowErrors]) -> RowErrors:
        """The errors of several barriers, in the order of their stacked rows. NaN counts as unknown."""
        angle, slack = (torch.cat(columns, dim=-1) for columns in zip(*parts, strict=True))
        return cls(
            torch.where(angle.isnan(), math.pi, angle),
            torch.where(slack.isnan(), math.inf, slack),
        )
