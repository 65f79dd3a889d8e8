"""The observers of an experiment, on the same measurements: both kinds of set, the filter, the hybrid."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from experiments.runs.config import ExperimentConfig
from experiments.runs.recording import Recording
from experiments.runs.saved import SETS
from experiments.runs.tally import SetTally, Tally
from torchfsid.observers.hybrid import HybridEstimate, HybridObserver
from torchfsid.observers.set_membership import SetEstimate, SetMembershipObserver
from torchfsid.robots.measurement import Measurement


@dataclass
class Observers:
    """The observers of a recording.

    Attributes:
        config: the configuration.
        recording: the recording.
        sets: one observer per kind of set. The first is the configuration's `set`.
        hybrid: combines the first set with the filter.
        tally: the counts so far.
    """

    config: ExperimentConfig
    recording: Recording
    sets: dict[str, SetMembershipObserver] = field(init=False)
    hybrid: HybridObserver = field(init=False)
    tally: Tally = field(init=False)

    def __post_init__(self) -> None:
        config, recording = self.config, self.recording
        task, barriers, robots = recording.task, recording.barriers, len(recording.robots)
        kinds = sorted(SETS, key=lambda kind: kind != config.set)
        self.sets = {kind: config.build_sets(kind, task, barriers, robots) for kind in kinds}
        ukf = config.ukf.build(task, barriers, config.prior, robots, config.active_tolerance)
        self.hybrid = HybridObserver(self.sets[config.set], ukf, feedback=config.ukf.feedback)
        volumes = {kind: SetTally(of.feasible_set.volume()) for kind, of in self.sets.items()}
        variances = torch.tensor(config.ukf.spread(config.prior), dtype=torch.float64) ** 2
        self.tally = Tally(recording.goals, volumes, torch.diag(variances).expand(robots, -1, -1))

    def update(self, measurement: Measurement) -> tuple[HybridEstimate, dict[str, SetEstimate]]:
        """The estimates of the hybrid and of all kinds of set, after one more measurement."""
        estimate = self.hybrid.update(measurement)
        first, *others = self.sets
        sets = {first: estimate.set_estimate, **{kind: self.sets[kind].update(measurement) for kind in others}}
        self.tally.update(estimate, sets, self.config.dt)
        return estimate, sets
