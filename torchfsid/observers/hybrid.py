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

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InputError, SolverError
from torchfsid.observers.blocks import one_by_one
from torchfsid.observers.safety import SafetyObserver, SetObserver
from torchfsid.observers.set_membership import SetEstimate, SetEstimates, rounded
from torchfsid.observers.ukf import ParameterUkf
from torchfsid.observers.ukf_estimates import UkfEstimate, UkfEstimates
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


@dataclass(frozen=True)
class HybridEstimates:
    """The estimates of both observers at S times. `estimates[s]` is the `HybridEstimate` of time s.

    Attributes:
        theta: see `HybridEstimate`.
        set_estimates: those of the set-membership observer.
        ukf_estimates: those of the filter.
        status: see `HybridEstimate`.
    """

    theta: Float[Tensor, "S B p"]
    set_estimates: SetEstimates
    ukf_estimates: UkfEstimates
    status: Int[Tensor, "S B"]

    def __len__(self) -> int:
        return len(self.set_estimates)

    def __getitem__(self, s: int) -> HybridEstimate:
        sets, ukf = self.set_estimates[s], self.ukf_estimates[s]
        return HybridEstimate(sets.t, self.theta[s], sets, ukf, self.status[s])


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
        set_estimates = SetEstimates.of(self.sets.update(measurement))
        return self._with_filter(set_estimates, measurement)[0]

    def read(self, samples: Measurement) -> Iterator[HybridEstimates]:
        """Take in several measurements, see `SetMembershipObserver.read`. With feedback, estimates come one by one.

        Raises:
            InputError: see `update`.
            InconsistentError: see `SetMembershipObserver.read`.
        """
        robots, first = len(self.ukf.mean), 0
        if self.feedback and len(samples.x) > robots:
            for sample in one_by_one(samples, robots):
                yield from self.read(sample)
            return
        for set_estimates in self.sets.read(samples):
            end = first + len(set_estimates) * robots
            yield self._with_filter(set_estimates, samples.select(slice(first, end)))
            first = end

    def _with_filter(self, set_estimates: SetEstimates, samples: Measurement) -> HybridEstimates:
        if isinstance(self.sets, SafetyObserver):
            self.ukf.barriers = self.sets.present_barriers
        found = self.ukf.read(samples)
        sets, which = set_estimates.sets, set_estimates.which
        sets = sets if len(which) == 1 else sets.select(which.flatten())
        theta, status = _into(sets, found.theta.flatten(0, 1), found.covariance.flatten(0, 1))
        if self.feedback and bool(theta.isfinite().all()):
            self.ukf.correct(theta)
        return HybridEstimates(theta.view(*which.shape, -1), set_estimates, found, status.view(which.shape))


def _into(
    sets: FeasibleSet, theta: Float[Tensor, "B p"], covariance: Float[Tensor, "B p p"]
) -> tuple[Float[Tensor, "B p"], Int[Tensor, "B"]]:
    """The filters' estimates projected onto the sets, and a `Status` for each."""
    metric, usable = _information_metric(covariance)
    known = theta.isfinite().all(-1)
    start = torch.where(known.unsqueeze(-1), theta, 0.0)
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
