"""The interface of all observers: they take measurements and return estimates."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from torchfsid.robots.measurement import Measurement


@runtime_checkable
class Estimate(Protocol):
    """The result of every observer: the time [s] and a point estimate of theta."""

    @property
    def t(self) -> float: ...

    @property
    def theta(self) -> Float[Tensor, "*batch p"]: ...


@runtime_checkable
class Observer(Protocol):
    """An observer takes measurements in the order of time and returns an estimate for each."""

    def update(self, measurement: Measurement) -> Estimate: ...
