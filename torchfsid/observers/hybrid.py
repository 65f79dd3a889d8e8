r"""The hybrid observer: the filter's estimate, brought into the set that must hold the truth (G., Sec. I).

    theta_hybrid = argmin (theta - theta_ukf)' P^-1 (theta - theta_ukf)   s.t.  theta in Theta(t)

P is the filter's covariance of theta: among the possible parameters, this is the most likely one. A projection onto a
convex set comes closer, in its own metric, to every point of the set, hence to the truth whenever Theta holds it.
P itself is never cut by the set: the same set seen at every step would be counted as new information at every step.

The filter is a companion of the set and never decides its life. Where P is not a covariance any more, the projection is
Euclidean; and where the filter's estimate is not finite, or so far away that its projection has no digits left, the
centroid of the set takes its place; `status` says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InputError, SolverError
from torchfsid.observers.set_membership import SetEstimate, SetMembershipObserver
from torchfsid.observers.ukf import ParameterUkf, UkfEstimate
from torchfsid.outcome import HybridStatus
from torchfsid.robots.measurement import Measurement
from torchfsid.sets.feasible_set import FeasibleSet

CONDITION = 1e10
"""Largest condition number of the metric: beyond it, the projection would lose its digits before it gained anything."""


@dataclass(frozen=True)
class HybridEstimate:
    """What both know at time t.

    Attributes:
        t: time [s].
        theta: the filter's estimate projected onto Theta(t).
        set_estimate, ukf_estimate: what each of the two observers says by itself (with feedback: after it was fed).
        status: a `HybridStatus` per robot.
    """

    t: float
    theta: Float[Tensor, "B p"]
    set_estimate: SetEstimate
    ukf_estimate: UkfEstimate
    status: Int[Tensor, "B"]


@dataclass
class HybridObserver:
    """A set-membership observer and a filter on the same measurements.

    Attributes:
        sets, ukf: the two observers, of the same robots.
        feedback: the projected mean replaces the filter's own, its covariance stays. Otherwise the filter runs alone.

    Raises:
        InputError: the observers have other robots or parameters.
    """

    sets: SetMembershipObserver
    ukf: ParameterUkf
    feedback: bool = False

    def __post_init__(self) -> None:
        sets = self.sets.feasible_set
        if self.ukf.mean.shape != (*sets.batch_shape, sets.dim):
            raise InputError("ukf", f"means of shape {(*sets.batch_shape, sets.dim)}", tuple(self.ukf.mean.shape))

    def update(self, measurement: Measurement) -> HybridEstimate:
        """Take in one measurement of all robots.

        Raises:
            InputError: see the two observers.
        """
        set_estimate = self.sets.update(measurement)
        ukf_estimate = self.ukf.update(measurement)
        theta, status = _into(set_estimate.feasible_set, ukf_estimate)
        if self.feedback and bool(theta.isfinite().all()):
            self.ukf.correct(theta)
        return HybridEstimate(set_estimate.t, theta, set_estimate, ukf_estimate, status)


def _into(sets: FeasibleSet, estimate: UkfEstimate) -> tuple[Float[Tensor, "B p"], Int[Tensor, "B"]]:
    """The filter's estimates, brought into the sets."""
    metric, usable = _information_metric(estimate.covariance)
    known = estimate.theta.isfinite().all(-1)
    start = torch.where(known.unsqueeze(-1), estimate.theta, 0.0)
    try:
        theta = sets.project(start, metric)
    except SolverError:
        theta = torch.full_like(start, torch.nan)
    status = torch.where(usable, HybridStatus.OK, HybridStatus.EUCLIDEAN)
    found = known & theta.isfinite().all(-1) & sets.contains(theta)
    if not bool(found.all()):
        theta = torch.where(found.unsqueeze(-1), theta, sets.centroid())
        status = torch.where(found, status, HybridStatus.CENTROID)
    return theta, status


def _information_metric(covariance: Float[Tensor, "B p p"]) -> tuple[Float[Tensor, "B p p"], Bool[Tensor, "B"]]:
    """P^-1, scaled so that its largest eigenvalue is 1 (the nearest point does not depend on the scale); the identity
    where P is not a covariance. And where it is one."""
    identity = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    size = covariance.abs().amax((-2, -1), keepdim=True)
    finite = (size.isfinite() & (size > 0)).flatten()
    scaled = torch.where(finite[:, None, None], covariance / size, identity)
    variances, axes = torch.linalg.eigh(scaled)
    usable = finite & (variances[:, 0] > -1 / CONDITION)
    variances = variances.clamp(min=variances[:, -1:] / CONDITION)
    metric = (axes * (variances[:, :1] / variances).unsqueeze(-2)) @ axes.mT
    return torch.where(usable[:, None, None], (metric + metric.mT) / 2, identity), usable
