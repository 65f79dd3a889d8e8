"""How wrong what is measured may be: every record of bounds on errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.errors import InputError


@dataclass(frozen=True)
class NoiseBound:
    """Bounds on the errors of what is measured.

    Attributes:
        velocity: |u - u*|, of the measured control and of the controller's solver [m/s].
        slack: how far from its boundary an active row may be measured [m/s]; default: `velocity`.
        position: of every measured position [m].
        neighbour_velocity: of the velocities of other bodies, where rows use them [m/s].

    `velocity` and `slack` may be tensors (*batch,), a bound for each robot.
    """

    velocity: float | Float[Tensor, "*batch"]
    slack: float | Float[Tensor, "*batch"]
    position: float
    neighbour_velocity: float

    def __init__(
        self,
        velocity: float | Float[Tensor, "*batch"],
        slack: float | Float[Tensor, "*batch"] | None = None,
        position: float = 0.0,
        neighbour_velocity: float = 0.0,
    ):
        slack = velocity if slack is None else slack
        bounds = {"velocity": velocity, "slack": slack, "position": position, "neighbour_velocity": neighbour_velocity}
        for name, bound in bounds.items():
            if not bool((torch.as_tensor(bound) >= 0).all()):
                raise InputError(f"noise.{name}", "a bound >= 0", bound)
            object.__setattr__(self, name, bound)


class ErrorBounds(NamedTuple):
    """Bounds at one instant: on the robots' positions, on those of the bodies [m], on the bodies' velocities [m/s]."""

    position: Float[Tensor, "*batch"]
    body_position: Float[Tensor, "*batch m"]
    body_velocity: Float[Tensor, "*batch m"]


class RowErrors(NamedTuple):
    """How far the rows of a barrier may be off: their direction [rad], and what they say of a control's slack [m/s]."""

    angle: Float[Tensor, "*batch m"]
    slack: Float[Tensor, "*batch m"]


class Uncertainty(NamedTuple):
    """What the bounds come to at one instant, on top of `NoiseBound.velocity` and `.slack`.

    Attributes:
        velocity: more error of the control [m/s].
        slack: more error of each row's slack [m/s]. angle: error of each row's direction [rad].
        drift: error of C theta + d [m/s].
    """

    velocity: Float[Tensor, "*batch"]
    slack: Float[Tensor, "*batch m"]
    angle: Float[Tensor, "*batch m"]
    drift: Float[Tensor, "*batch"]
