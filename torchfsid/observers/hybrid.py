r"""The hybrid observer: the filter's estimate, brought into the set that must hold the truth (G., Sec. I).

    theta_hybrid = argmin (theta - theta_ukf)' P^-1 (theta - theta_ukf)   s.t.  theta in Theta(t)

P is the filter's covariance of theta: among the possible parameters, this is the most likely one. A projection onto a
convex set comes closer, in its own metric, to every point of the set, hence to the truth whenever Theta holds it.
P itself is never cut by the set: the same set seen at every step would be counted as new information at every step.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.observers.set_membership import SetEstimate, SetMembershipObserver
from torchfsid.observers.ukf import ParameterUkf, UkfEstimate
from torchfsid.robots.measurement import Measurement

CONDITION = 1e10
"""Largest condition number of the metric: beyond it, the projection would lose its digits before it gained anything."""


@dataclass(frozen=True)
class HybridEstimate:
    """What both know at time t.

    Attributes:
        t: time [s].
        theta: the filter's estimate projected onto Theta(t).
        set_estimate, ukf_estimate: what each of the two observers says by itself (with feedback: after it was fed).
    """

    t: float
    theta: Float[Tensor, "B p"]
    set_estimate: SetEstimate
    ukf_estimate: UkfEstimate


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
        metric = _information_metric(ukf_estimate.covariance)
        theta = set_estimate.feasible_set.project(ukf_estimate.theta, metric)
        if self.feedback:
            self.ukf.correct(theta)
        return HybridEstimate(measurement.t, theta, set_estimate, ukf_estimate)


def _information_metric(covariance: Float[Tensor, "B p p"]) -> Float[Tensor, "B p p"]:
    """P^-1, scaled so that its largest eigenvalue is 1 (the nearest point does not depend on the scale)."""
    variances, axes = torch.linalg.eigh(covariance)
    variances = variances.clamp(min=variances[:, -1:] / CONDITION)
    metric = (axes * (variances[:, :1] / variances).unsqueeze(-2)) @ axes.mT
    return (metric + metric.mT) / 2
