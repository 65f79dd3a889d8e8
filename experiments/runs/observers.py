"""The observers of an experiment, on the same measurements: each kind of set, the filter, the hybrid."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from experiments.runs.config import ExperimentConfig
from torchfsid.identification.evidence import SetKind
from torchfsid.observers.hybrid import HybridEstimate, HybridEstimates, HybridObserver
from torchfsid.observers.set_membership import SetEstimate, SetEstimates, SetMembershipObserver
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Task


def build_sets(
    config: ExperimentConfig,
    kind: SetKind,
    task: Task,
    barriers: Sequence[Barrier],
    robots: int,
    noise: NoiseBound | None = None,
) -> SetMembershipObserver:
    """The observer of one kind of set, with the configured bounds on errors or others.

    The critical region uses the active tolerance as its only bound, also to decide on alarms.
    """
    bounds = (noise or config.noise.build()) if kind == "inverse_optimal" else None
    prior, tolerance = config.prior.build(robots), config.active_tolerance
    return SetMembershipObserver(task, barriers, prior, kind=kind, noise=bounds, active_tolerance=tolerance)


class Observers:
    """The observers of some robots.

    Attributes:
        sets: one observer per kind of set. The first is the configuration's `set`.
        hybrid: combines the first set with the filter.
    """

    def __init__(
        self,
        config: ExperimentConfig,
        task: Task,
        barriers: Sequence[Barrier],
        robots: int,
        noise: NoiseBound | None = None,
    ):
        kinds = sorted(config.sets, key=lambda kind: kind != config.set)
        self.sets = {kind: build_sets(config, kind, task, barriers, robots, noise) for kind in kinds}
        ukf = config.ukf.build(task, barriers, config.prior, robots, config.active_tolerance)
        self.hybrid = HybridObserver(self.sets[config.set], ukf, feedback=config.ukf.feedback)

    def update(self, measurement: Measurement) -> tuple[HybridEstimate, dict[str, SetEstimate]]:
        """The estimates of the hybrid and of all kinds of set, after one more measurement."""
        (estimate, sets), *_ = self.read(measurement)
        return estimate[0], {kind: of_kind[0] for kind, of_kind in sets.items()}

    def read(self, samples: Measurement) -> Iterator[tuple[HybridEstimates, dict[str, SetEstimates]]]:
        """The same after several more measurements, concatenated in the order of time."""
        first, *others = self.sets
        of_others = (self.sets[kind].read(samples) for kind in others)
        for estimates, *sets in zip(self.hybrid.read(samples), *of_others, strict=True):
            yield estimates, {first: estimates.set_estimates, **dict(zip(others, sets, strict=True))}
