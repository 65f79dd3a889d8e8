"""Observe an experiment: each kind of set, the filter and the hybrid, on the same measurements.

`observe` reads a recording, and writes estimates.csv, sets.csv, regions.json and regions.jsonl.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from experiments.kinds import Track
from experiments.results import Appender
from experiments.runs.config import ExperimentConfig
from torchfsid.commands.results import ResultsWriter
from torchfsid.commands.safety_results import without_repeats
from torchfsid.identification.evidence import SetKind
from torchfsid.observers.hybrid import HybridEstimate, HybridEstimates, HybridObserver
from torchfsid.observers.set_membership import SetEstimate, SetEstimates, SetMembershipObserver
from torchfsid.programmes.differentiable import times
from torchfsid.robots.barriers import Barrier, stack_barriers
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


@dataclass(frozen=True)
class Recording:
    """Measurements of a batch of robots in the order of time, with the truth.

    Attributes:
        robots: names of the robots.
        goals: true goals [m].
        task: the task, also of the observers.
        barriers: the barriers, also of the observers.
        labels: labels of the rows of the barriers.
        measurements: the measurements.
        samples: number of measurements.
    """

    robots: list[str]
    goals: Float[Tensor, "B n"]
    task: Task
    barriers: list[Barrier]
    labels: list[str]
    measurements: Iterator[Measurement]
    samples: int


class Observed:
    """The observers of a recording, and counts that need the sets and the truth at every sample.

    Attributes:
        observers: the observers, after the last sample.
        outside: numbers of samples at which the truth was not in the set, by kind of set and robot.
        ukf_outside: the same of the filter's estimate.
        information: sum of G'G dt. Its rank is the number of directions in which the motion can show the parameter.
        rank: the largest rank of G at any sample.
        covariance: the filter's covariance of the parameter after the last sample.
    """

    covariance: Float[Tensor, "B n n"]

    def __init__(self, config: ExperimentConfig, recording: Recording):
        count = len(recording.robots)
        self.observers = Observers(config, recording.task, recording.barriers, count)
        self.outside, self.ukf_outside = (
            {kind: torch.zeros(count, dtype=torch.long) for kind in config.sets} for _ in range(2)
        )
        self.information = torch.zeros(count, config.dimension, config.dimension, dtype=torch.float64)
        self.rank = torch.zeros(count, dtype=torch.long)
        self._goals, self._dt = recording.goals, config.dt

    def update(self, measurement: Measurement) -> tuple[HybridEstimate, dict[str, SetEstimate]]:
        """Take in one more measurement, as `Observers.update`."""
        estimate, sets = self.observers.update(measurement)
        for kind, of_kind in sets.items():
            self.outside[kind] += ~of_kind.feasible_set.contains(self._goals)
            self.ukf_outside[kind] += ~of_kind.feasible_set.contains(estimate.ukf_estimate.theta)
        kkt = estimate.set_estimate.kkt
        self.information += kkt.G.mT @ kkt.G * self._dt
        self.rank = torch.maximum(self.rank, kkt.G.shape[-2] - kkt.rank)
        self.covariance = estimate.ukf_estimate.covariance
        return estimate, sets


def observe(config: ExperimentConfig, recording: Recording, out: Path, track: Track) -> Observed:
    """Observe the recording and write the files. A sample is on disk before the next one is observed."""
    observed = Observed(config, recording)
    first, *others = (observers := observed.observers.sets)
    alongside = {kind: observers[kind] for kind in others}
    with (
        ResultsWriter(out, recording.robots, observers[first], alongside, recording.labels) as results,
        Appender(out / "regions.jsonl") as regions,
    ):
        for measurement in track(recording.measurements, "Observing", recording.samples):
            estimate, sets = observed.update(measurement)
            results.write(measurement, estimate, {kind: sets[kind] for kind in others})
            regions.append("".join(json.dumps(line) + "\n" for line in _regions(recording, measurement, sets)))
    return observed


def _regions(recording: Recording, measurement: Measurement, sets: dict[str, SetEstimate]) -> Iterator[dict[str, Any]]:
    assert measurement.u is not None
    rows = stack_barriers(recording.barriers, measurement).normalised()
    real = (rows.A != 0).any(-1)
    active = next(iter(sets.values())).kkt.active
    C, d = recording.task(measurement)
    nominal = times(C, recording.goals) + d
    vertices = {kind: estimate.feasible_set.vertices() for kind, estimate in sets.items()}
    for i, robot in enumerate(recording.robots):
        yield {
            "t": measurement.t,
            "robot": robot,
            "x": measurement.x[i].tolist(),
            "u": measurement.u[i].tolist(),
            "nominal": nominal[i].tolist(),
            "active": [recording.labels[j].removeprefix("avoid ") for j in active[i].nonzero().flatten().tolist()],
            "rows": torch.cat([rows.A[i], rows.b[i].unsqueeze(-1)], dim=-1)[real[i]].tolist(),
            **{kind: _vertices(of_kind[i]) for kind, of_kind in vertices.items()},
        }


def _vertices(padded: Float[Tensor, "V 2"]) -> list[list[float]]:
    return without_repeats(padded).tolist() if padded.isfinite().all() else []
