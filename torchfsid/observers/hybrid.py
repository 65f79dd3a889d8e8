r"""The hybrid observer: the filter's estimate, brought into the set that must hold the truth (G., Sec. I).

    theta_hybrid = argmin (theta - theta_ukf)' P^-1 (theta - theta_ukf)   s.t.  theta in Theta(t)

P is the filter's covariance of theta, so this is the most likely of the possible parameters. A projection onto a convex
set reduces, in its own metric, the distance to every point of the set. So it comes closer to the truth if Theta
contains it. P itself is never cut by the set, because the same set would count as new information at every step.

Where safety parameters are unknown, the filter takes the typical ones of Psi.

The set does not depend on the filter. Where P is no longer a covariance, the projection is Euclidean. Where the
filter's estimate is not finite, or so far away that its projection has no accurate digits, the centroid of the set
replaces it. `status` reports both.

Gradients flow through the set and the projection. The filter's mean and covariance count as constants, so with feedback
the gradient leaves out what earlier projections changed in the filter.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InputError, SolverError
from torchfsid.observers.safety import SafetyObserver, SetObserver
from torchfsid.observers.set_membership import SetEstimate, rounded
from torchfsid.observers.ukf import ParameterUkf, UkfEstimate
from torchfsid.outcome import Status
from torchfsid.robots.measurement import Measurement
from torchfsid.sets.feasible_set import FeasibleSet

CONDITION = 1e10
"""Largest condition number of the metric: beyond it, the projection would lose its digits before it gained anything."""


@dataclass(frozen=True)
class HybridEstimate:
    """The estimates of both observers at time t.

    Attributes:
        t: time [s].
        theta: the filter's estimate projected onto Theta(t).
        set_estimate: the estimate of the set-membership observer.
        ukf_estimate: the estimate of the filter, with feedback after its mean was replaced.
        status: a `Status` per robot.
    """

    t: float
    theta: Float[Tensor, "B p"]
    set_estimate: SetEstimate
    ukf_estimate: UkfEstimate
    status: Int[Tensor, "B"]

    @property
    def status_names(self) -> list[str]:
        """The statuses in words, one per robot."""
        return Status.names(self.status)

    def __repr__(self) -> str:
        return f"HybridEstimate(t={self.t:g}, theta={rounded(self.theta)}, {self.set_estimate!r})"


@dataclass
class HybridObserver:
    """A set-membership observer and a filter on the same measurements.

    Attributes:
        sets: the set-membership observer.
        ukf: the filter, for the same robots.
        feedback: whether the projected mean replaces the filter's own. Its covariance stays in either case.

    Raises:
        InputError: the two observers have different robots or parameters.
    """

    sets: SetObserver
    ukf: ParameterUkf
    feedback: bool = False

    def __post_init__(self) -> None:
        sets = self.sets.feasible_set
        if self.ukf.mean.shape != (*sets.batch_shape, sets.dim):
            raise InputError("ukf", f"means of shape {(*sets.batch_shape, sets.dim)}", tuple(self.ukf.mean.shape))

    def update(self, measurement: Measurement) -> HybridEstimate:
        """Take in one measurement of all robots.

        Raises:
            InputError: see `SetMembershipObserver.update` and `ParameterUkf.update`.
        """
        set_estimate = self.sets.update(measurement)
        if isinstance(self.sets, SafetyObserver):
            self.ukf.barriers = self.sets.present_barriers
        ukf_estimate = self.ukf.update(measurement)
        theta, status = _into(set_estimate.feasible_set, ukf_estimate)
        if self.feedback and bool(theta.isfinite().all()):
            self.ukf.correct(theta)
        return HybridEstimate(set_estimate.t, theta, set_estimate, ukf_estimate, status)


def _into(sets: FeasibleSet, estimate: UkfEstimate) -> tuple[Float[Tensor, "B p"], Int[Tensor, "B"]]:
    """The filter's estimates projected onto the sets, and a `Status` for each robot."""
    metric, usable = _information_metric(estimate.covariance)
    known = estimate.theta.isfinite().all(-1)
    start = torch.where(known.unsqueeze(-1), estimate.theta, 0.0)
    try:
        theta = sets.project(start, metric)
    except SolverError:
        theta = torch.full_like(start, torch.nan)
    status = torch.where(usable, Status.OK, Status.EUCLIDEAN)
    found = known & theta.isfinite().all(-1) & sets.contains(theta)
    if not bool(found.all()):
        theta = torch.where(found.unsqueeze(-1), theta, sets.centroid())
        status = torch.where(found, status, Status.CENTROID)
    return theta, status


def _information_metric(covariance: Float[Tensor, "B p p"]) -> tuple[Float[Tensor, "B p p"], Bool[Tensor, "B"]]:
    """The metric P^-1, scaled to the largest eigenvalue 1, and a mask of the items where P is a covariance.

    The nearest point does not depend on the scale. Where P is not a covariance, the metric is the identity.
    """
    identity = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    size = covariance.abs().amax((-2, -1), keepdim=True)
    finite = (size.isfinite() & (size > 0)).flatten()
    scaled = torch.where(finite[:, None, None], covariance / size, identity)
    variances, axes = torch.linalg.eigh(scaled)
    usable = finite & (variances[:, 0] > -1 / CONDITION)
    variances = variances.clamp(min=variances[:, -1:] / CONDITION)
    metric = (axes * (variances[:, :1] / variances).unsqueeze(-2)) @ axes.mT
    return torch.where(usable[:, None, None], (metric + metric.mT) / 2, identity), usable
