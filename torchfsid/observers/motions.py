"""The control of a robot as a function of theta, from one measurement on. The filter predicts with it.

Motions are records, not closures, so that an observer can be pickled. They take an array of S parameters (S, p) and
return an array of S controls (S, n).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.robots.controller import solve_safe_qp
from torchfsid.robots.tasks import Saturation

Array = np.ndarray
Motion = Callable[[Array], Array]
"""Controls (S, n) as a function of parameters (S, p)."""


@dataclass(frozen=True)
class Wish:
    """The nominal control uhat = clip(C theta + d) + feedback (`Task`)."""

    C: Float[Tensor, "n p"]
    d: Float[Tensor, "n"]
    feedback: Float[Tensor, "n"]
    clip: Saturation | None

    def __call__(self, theta: Array) -> Float[Tensor, "s n"]:
        wish = torch.from_numpy(theta) @ self.C.T + self.d
        return (wish if self.clip is None else self.clip(wish)) + self.feedback


@dataclass(frozen=True)
class ObservedMotion:
    """The motion u = (I - P) uhat + A_a^+ b_a, which is G theta + f where nothing is clipped."""

    wish: Wish
    free: Float[Tensor, "n n"]
    offset: Float[Tensor, "n"]

    def __call__(self, theta: Array) -> Array:
        return (self.wish(theta) @ self.free.T + self.offset).numpy()


@dataclass(frozen=True)
class QpMotion:
    """The motion u = argmin |u - uhat|^2 over the safe controls. It is zero where there are none."""

    wish: Wish
    safe_controls: Halfspaces

    def __call__(self, theta: Array) -> Array:
        return solve_safe_qp(self.safe_controls, self.wish(theta)).u.numpy()
