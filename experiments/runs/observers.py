"""The observers of an experiment, on the same data: both kinds of set, the filter, the hybrid."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch

from experiments.runs.config import ExperimentConfig
from experiments.runs.recording import Recording
from experiments.runs.saved import SETS
from experiments.runs.tally import SetTally, Tally
from torchfsid.observers.hybrid import HybridEstimate, HybridObserver
from torchfsid.observers.set_membership import SetEstimate, SetMembershipObserver
from torchfsid.observers.ukf import ParameterUkf
from torchfsid.robots.measurement import Measurement
from torchfsid.sets.feasible_set import FeasibleSet


@dataclass
class Observers:
    """Attributes:
    sets: an observer per kind of set; the config's `set` is the first.
    hybrid: joins the first with the filter.
    tally: what was counted so far.
    """

    config: ExperimentConfig
    recording: Recording
    sets: dict[str, SetMembershipObserver] = field(init=False)
    hybrid: HybridObserver = field(init=False)
    tally: Tally = field(init=False)

    def __post_init__(self) -> None:
        config, recording = self.config, self.recording
        shape = recording.goals.shape
        lower = torch.tensor(config.prior.lower, dtype=torch.float64).expand(shape)
        upper = torch.tensor(config.prior.upper, dtype=torch.float64).expand(shape)
        prior = FeasibleSet.from_box(lower, upper)
        self.sets = {
            kind: SetMembershipObserver(
                recording.task,
                recording.barriers,
                prior,
                kind=kind,
                # The bound also decides on alarms. The critical region has no bound but its active tolerance.
                noise=config.noise.build() if kind == "inverse_optimal" else None,
                active_tolerance=config.active_tolerance,
            )
            for kind in sorted(SETS, key=lambda kind: kind != config.set)
        }
        spread = (upper - lower) / math.sqrt(12) if config.ukf.prior_std is None else config.ukf.prior_std
        spread = torch.as_tensor(spread, dtype=torch.float64).expand(shape)
        settings = config.ukf.model_dump(exclude={"prior_std", "feedback"})
        ukf = ParameterUkf(
            recording.task,
            recording.barriers,
            (lower + upper) / 2,
            spread,
            active_tolerance=config.active_tolerance,
            **settings,
        )
        self.hybrid = HybridObserver(self.sets[config.set], ukf, feedback=config.ukf.feedback)
        volumes = {kind: SetTally(prior.volume()) for kind in self.sets}
        self.tally = Tally(recording.goals, volumes, torch.diag_embed(spread**2))

    def update(self, measurement: Measurement) -> tuple[HybridEstimate, dict[str, SetEstimate]]:
        """What the hybrid says, and the estimates of all kinds of set."""
        estimate = self.hybrid.update(measurement)
        first, *others = self.sets
        sets = {first: estimate.set_estimate, **{kind: self.sets[kind].update(measurement) for kind in others}}
        self.tally.update(estimate, sets, self.config.dt)
        return estimate, sets
