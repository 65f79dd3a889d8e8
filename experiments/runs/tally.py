"""Counts taken during a run, while the sets and the truth are both in memory."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from experiments.runs.config import ExperimentConfig
from torchfsid.observers.hybrid import HybridEstimate
from torchfsid.observers.set_membership import SetEstimate
from torchfsid.sets.feasible_set import FeasibleSet

ROUND_OFF = 1e-9
"""Relative change of an area that is round-off."""


@dataclass
class SetTally:
    """Numbers of samples, per robot, for one kind of set.

    Attributes:
        volume: area of the set after the last sample, at first that of the prior.
        outside: samples at which the truth was not in the set.
        grew: samples at which the area grew.
        shrank: samples at which the area shrank.
        ukf_outside: samples at which the filter's estimate was not in the set.
    """

    volume: Float[Tensor, "B"]
    outside: Int[Tensor, "B"] = field(init=False)
    grew: Int[Tensor, "B"] = field(init=False)
    shrank: Int[Tensor, "B"] = field(init=False)
    ukf_outside: Int[Tensor, "B"] = field(init=False)

    def __post_init__(self) -> None:
        nothing = torch.zeros(self.volume.shape, dtype=torch.long)
        self.outside, self.grew, self.shrank, self.ukf_outside = nothing, nothing, nothing, nothing

    def update(self, sets: FeasibleSet, goals: Float[Tensor, "B 2"], ukf: Float[Tensor, "B 2"]) -> None:
        """Count one more sample."""
        volume = sets.volume()
        self.outside = self.outside + ~sets.contains(goals)
        self.ukf_outside = self.ukf_outside + ~sets.contains(ukf)
        self.grew = self.grew + (volume > self.volume * (1 + ROUND_OFF))
        self.shrank = self.shrank + (volume < self.volume * (1 - ROUND_OFF))
        self.volume = volume


@dataclass
class Tally:
    """Counts of a run for each kind of set, and how much the motions depended on the parameter.

    Attributes:
        goals: true goals [m].
        sets: counts by kind of set.
        prior_covariance: the filter's covariance of the parameter before the first sample.
        covariance: the filter's covariance of the parameter after the last sample.
        samples: number of samples so far.
        information: sum of G'G dt. Its rank is the number of directions in which the motion can show the parameter.
        rank: the largest rank of G at any sample.
    """

    goals: Float[Tensor, "B 2"]
    sets: dict[str, SetTally]
    prior_covariance: Float[Tensor, "B 2 2"]
    covariance: Float[Tensor, "B 2 2"] = field(init=False)
    samples: int = 0
    information: Float[Tensor, "B 2 2"] = field(init=False)
    rank: Int[Tensor, "B"] = field(init=False)

    @classmethod
    def before(cls, config: ExperimentConfig, goals: Float[Tensor, "B 2"]) -> Tally:
        """The counts before the first sample."""
        volume = config.prior.build(len(goals)).volume()
        variances = torch.tensor(config.ukf.spread(config.prior), dtype=torch.float64) ** 2
        counts = {kind: SetTally(volume) for kind in config.sets}
        return cls(goals, counts, torch.diag(variances).expand(len(goals), -1, -1))

    def __post_init__(self) -> None:
        self.covariance = self.prior_covariance
        self.information = torch.zeros_like(self.prior_covariance)
        self.rank = torch.zeros(len(self.goals), dtype=torch.long)

    def update(self, estimate: HybridEstimate, sets: dict[str, SetEstimate], dt: float) -> None:
        """Count one more sample of length `dt` [s]."""
        ukf = estimate.ukf_estimate
        for kind, of_kind in sets.items():
            self.sets[kind].update(of_kind.feasible_set, self.goals, ukf.theta)
        kkt = estimate.set_estimate.kkt
        self.information = self.information + kkt.G.mT @ kkt.G * dt
        self.rank = torch.maximum(self.rank, kkt.G.shape[-2] - kkt.rank)
        self.covariance = ukf.covariance
        self.samples += 1
