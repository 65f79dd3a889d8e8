"""The observers of an experiment, on the same measurements: each kind of set, the filter, the hybrid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch

from experiments.runs.config import ExperimentConfig
from experiments.runs.recording import Recording
from experiments.runs.tally import SetTally, Tally
from torchfsid.identification.evidence import SetKind
from torchfsid.observers.hybrid import HybridEstimate, HybridObserver
from torchfsid.observers.set_membership import SetEstimate, SetMembershipObserver
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Task


def build_sets(
    config: ExperimentConfig, kind: SetKind, task: Task, barriers: Sequence[Barrier], robots: int
) -> SetMembershipObserver:
    """The observer of one kind of set.

    The critical region uses the active tolerance as its only bound, also to decide on alarms.
    """
    noise = config.noise.build() if kind == "inverse_optimal" else None
    prior, tolerance = config.prior.build(robots), config.active_tolerance
    return SetMembershipObserver(task, barriers, prior, kind=kind, noise=noise, active_tolerance=tolerance)


@dataclass
class Observers:
    """The observers of a recording.

    Attributes:
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
        kinds = sorted(config.sets, key=lambda kind: kind != config.set)
        self.sets = {kind: build_sets(config, kind, task, barriers, robots) for kind in kinds}
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
