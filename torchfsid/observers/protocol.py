"""What all observers have in common: measurements in, estimates out."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from torchfsid.robots.measurement import Measurement


@runtime_checkable
class Estimate(Protocol):
    """What every observer answers: the time [s] and a point estimate of theta."""

    @property
    def t(self) -> float: ...

    @property
    def theta(self) -> Float[Tensor, "*batch p"]: ...


@runtime_checkable
class Observer(Protocol):
    """Measurements in, estimates out, in the order of time."""

    def update(self, measurement: Measurement) -> Estimate: ...
