"""What filters say of theta, at one time or at several."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from torchfsid.outcome import Status


@dataclass(frozen=True)
class UkfEstimate:
    """The filters' estimates at time t.

    Attributes:
        t: time [s].
        theta: the mean of theta.
        covariance: the covariance of theta.
        status: a `Status` per robot, for this measurement alone.
    """

    t: float
    theta: Float[Tensor, "B p"]
    covariance: Float[Tensor, "B p p"]
    status: Int[Tensor, "B"]

    @property
    def status_names(self) -> list[str]:
        """The statuses in words, one per robot."""
        return Status.names(self.status)


@dataclass(frozen=True)
class UkfEstimates:
    """The filters' estimates at S times. `estimates[s]` is the `UkfEstimate` of time s.

    Attributes:
        t: times [s].
        theta: see `UkfEstimate`.
        covariance: see `UkfEstimate`.
        status: see `UkfEstimate`.
    """

    t: Float[Tensor, "S"]
    theta: Float[Tensor, "S B p"]
    covariance: Float[Tensor, "S B p p"]
    status: Int[Tensor, "S B"]

    def __getitem__(self, s: int) -> UkfEstimate:
        return UkfEstimate(float(self.t[s]), self.theta[s], self.covariance[s], self.status[s])
