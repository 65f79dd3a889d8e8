"""The observation of a log: from its measurements and a declared model to a results folder and a verdict per robot."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import torch
from jaxtyping import Int
from torch import Tensor

from torchfsid.commands.alternatives import Alternative, best_alternative
from torchfsid.commands.declared_log import AUTO_FACTOR, DeclaredLog, automatic_bound
from torchfsid.commands.history import MotionFile
from torchfsid.commands.judged_bound import JudgedBound
from torchfsid.commands.narrowing import Narrowing, narrowed
from torchfsid.commands.results import STATUS_NAMES, ResultsWriter, holds, of_sets
from torchfsid.commands.run_in_mcap import RunInMcap
from torchfsid.commands.where_to_look import constraint_name
from torchfsid.config.observe import ObserveConfig
from torchfsid.errors import FsidError, InconsistentError
from torchfsid.identification.kkt import CASES
from torchfsid.logs.log import Log
from torchfsid.observers.hybrid import HybridEstimates, HybridObserver
from torchfsid.observers.outliers import SetAside
from torchfsid.observers.safety import SafetyObserver, SetObserver
from torchfsid.observers.set_membership import SetEstimates, SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.measurement import Measurement

HARDLY_CUT = 0.5
"""Share of its prior beyond which a set says little."""

BLOCK = 512
"""Samples that are read at once, at most."""

BLOCK_ROWS = 200_000
"""Rows of barriers that are read at once, about: what all robots see of all bodies. It bounds memory."""

BLOCK_UPDATES = 2000
"""Updates of filterpy's filters for each block: about a second's, since results are written block by block."""

Estimated = tuple[Measurement, SetEstimates | HybridEstimates]
"""Samples, and the estimates after each of them."""


def times_in(item: Estimated) -> int:
    """The number of samples."""
    return len(item[1])


Track = Callable[[Iterable[Estimated]], Iterable[Estimated]]
"""Passes estimates on, and shows how far they have come."""


@dataclass(frozen=True)
class Verdict:
    """What a log says about one robot. Sizes and centres of an empty set are NaN, as in `FeasibleSet`.

    Attributes:
        robot: name of the robot.
        cases: number of samples used, by case.
        skipped: number of samples not used.
        infeasible: number of those at which the controller may have relaxed infeasible rows.
        volume: volume of the set [units of theta, to the power p].
        diameter: diameter of the set.
        centroid: centroid of the set.
        centre: Chebyshev centre of the set.
        radius: Chebyshev radius of the set.
        no_information_since: when the set last shrank [s]. None: it never did.
        resets: times at which the set started again from the prior [s].
        unexplained: number of samples that are left unexplained, at least: up to `outliers`.
        set_aside: the samples that may be these.
        status: `ok`, `alarm` or `inconsistent`, see `Status`.
        holds_truth: whether the declared truth is in the set. None if there is none.
    """

    robot: str
    cases: dict[str, int]
    skipped: int
    infeasible: int
    volume: float
    diameter: float
    centroid: tuple[float, ...]
    centre: tuple[float, ...]
    radius: float
    no_information_since: float | None
    resets: tuple[float, ...]
    unexplained: int
    set_aside: tuple[SetAside, ...]
    status: str
    holds_truth: bool | None


@dataclass
class Observation:
    """A log and the declared model, ready to run.

    Attributes:
        declared: the log and the model. With `auto`, with the bound that was determined.
        stated: the configuration to repeat the run with.
        sets: the observer of the sets.
        observer: `sets` alone, or combined with the filter if the configuration has one.
        smallest_bounds: with `auto`, each robot's smallest bound on controls that explains its motion [`noise.unit`].
        bound: the bound in use, judged by the controls seen.
        narrowing: where numbers of the model are unknown, what is left of them. `declared` has that. Robots that no
            values explain are `inconsistent` from the start.

    Raises:
        ConfigError: no bound explains some robot, see `automatic_bound`.
    """

    declared: DeclaredLog
    sets: SetObserver = field(init=False)
    observer: SetObserver | HybridObserver = field(init=False)
    stated: ObserveConfig = field(init=False)
    smallest_bounds: dict[str, float] | None = field(init=False, default=None)
    bound: JudgedBound = field(init=False)
    narrowing: Narrowing | None = field(init=False, default=None)
    _cases: Int[Tensor, "robots cases"] = field(init=False)

    def __post_init__(self) -> None:
        if self.config.noise.control == "auto":
            self.smallest_bounds = self.declared.smallest_bounds()
            found = automatic_bound(self.smallest_bounds, self.config.noise.quantity)
            self.declared = self.declared.with_bound(found)
        self.stated = self.declared.config
        self.bound = self.declared.judged(self.bound_used)
        if self.config.unknown_numbers:
            self.declared, self.narrowing = narrowed(self.declared)
        self._cases = torch.zeros(len(self.robots), len(CASES), dtype=torch.long)
        self.observer = self.config.build_observer(self.declared.task, self.declared.barriers, len(self.robots))
        self.sets = self.observer.sets if isinstance(self.observer, HybridObserver) else self.observer
        if self.narrowing is not None and isinstance(self.sets, SetMembershipObserver):
            unexplained = torch.tensor([robot in self.narrowing.unexplained for robot in self.robots])
            self.sets.status = torch.where(unexplained, Status.INCONSISTENT, self.sets.status)

    @property
    def config(self) -> ObserveConfig:
        """The configuration of the declared model."""
        return self.declared.config

    @property
    def log(self) -> Log:
        """The log as it is observed, see `DeclaredLog`."""
        return self.declared.log

    @property
    def robots(self) -> list[str]:
        """The bodies to infer."""
        return self.declared.robots

    @property
    def samples(self) -> int:
        """The number of samples."""
        return len(self.log.t)

    @property
    def bound_used(self) -> float:
        """The bound on controls in use [`noise.unit`]."""
        assert self.config.noise.control != "auto"
        return self.config.noise.control

    def strained(self) -> list[str]:
        """Robots that end `ok` but need more than half of the bound on controls: it may hide an error of the model.

        This is no alarm, since errors may be as large as declared. The list is empty where the question has no meaning
        (the bound was determined from the log, sets are reset, critical regions, windows over positions) or takes too
        long (theta is not planar).
        """
        config, sets = self.config, self.sets
        if self.smallest_bounds is not None or config.on_inconsistent == "reset" or sets.kind == "critical_region":
            return []
        if sets.prior.dim != 2 or config.velocity == "windows":
            return []
        half = torch.full((len(self.robots),), self.bound_used / AUTO_FACTOR, dtype=torch.float64)
        suffices = self.declared.consistency().sets(half).fits
        needs_more = (sets.status == Status.OK) & ~suffices
        if isinstance(sets, SetMembershipObserver):  # an outlier would need any bound
            needs_more = needs_more & (sets.unexplained == 0)
        return [robot for robot, strained in zip(self.robots, needs_more.tolist(), strict=True) if strained]

    @cached_property
    def alternative(self) -> Alternative | None:
        """With `auto`: the change of one key with which the log needs a much smaller bound, if there is one.

        The bound was then made for the model. A fixed bound would have been `strained`.
        """
        if self.smallest_bounds is None:
            return None
        return best_alternative(self.declared, max(self.smallest_bounds.values()))

    def hardly_cut(self) -> list[str]:
        """Robots that end `ok` with more than half of their prior: the log says little of them, with this bound."""
        sets = self.sets
        large = (sets.status == Status.OK) & (sets.feasible_set.volume() > HARDLY_CUT * sets.prior.volume())
        return [robot for robot, is_large in zip(self.robots, large.tolist(), strict=True) if is_large]

    def run(
        self,
        out: Path,
        track: Track = iter,
        made_from: Mapping[str, str] = MappingProxyType({}),
        mcap: Path | None = None,
        bag: Path | None = None,
    ) -> None:
        """Observe the whole log. Write what `results` and `history` describe into the existing folder `out`.

        With unknown safety parameters the log is then read again (`second_look`), for the sets of regions.json.

        Args:
            out: the folder.
            track: shows how far it has come.
            made_from: goes to regions.json, see `provenance`.
            mcap: a new file for the run as ROS messages (`run_in_mcap`). None: there is none.
            bag: a bag whose messages are copied into it. None: none are.

        Raises:
            FsidError: no parameter explains a robot, and `on_inconsistent` is `raise`. It names robot and rows.
            OSError: a file could not be written. The log was still observed to its end.
        """
        labels = self.declared.row_labels
        told = {
            "labels": labels,
            "bound": {"used": self.bound_used, **self.bound.to_json()},
            "log": self.log.reading.to_json(),
            "truth": self.config.truth or {},
            "made_from": made_from,
        }
        with (
            ResultsWriter(out, self.robots, self.sets, **told) as results,
            closing(MotionFile(out / "motion.csv", self.log, self.robots, labels)) as motion,
            nullcontext() if mcap is None else RunInMcap(mcap, self.declared, results.header, bag) as viewed,
        ):
            for samples, estimates in track(self._estimates()):
                texts = results.write(samples, estimates)
                sets = of_sets(estimates)
                motion.see(sets)
                if viewed is not None:
                    for s, (t, text) in enumerate(zip(sets.t.tolist(), texts, strict=True)):
                        shown = sets.sets.select(sets.which[s])
                        viewed.see(t, shown, sets.status[s].tolist(), list(csv.reader(io.StringIO(text, newline=""))))
                kinds = torch.arange(len(self.robots)).unsqueeze(-1) * len(CASES) + sets.kkt.case.view_as(sets.which).mT
                self._cases += kinds[sets.informative.mT].bincount(minlength=self._cases.numel()).view_as(self._cases)
            if isinstance(self.sets, SafetyObserver):
                try:
                    self.sets.look_again(list(self.declared.measurements()))
                except InconsistentError as error:
                    raise FsidError(self._named(error)) from error
            if viewed is not None:
                viewed.finish(self.sets.feasible_set, self.sets.status.tolist())

    def _estimates(self) -> Iterator[Estimated]:
        """The samples in blocks, with their estimates."""
        robots = len(self.robots)
        rows = robots * len(self.log.bodies)
        block = min(BLOCK, BLOCK_ROWS // rows)
        if isinstance(self.observer, HybridObserver) and self.observer.ukf.engine == "filterpy":
            block = min(block, BLOCK_UPDATES // robots)
        for samples in self.declared.measurements(max(1, block)):
            first = 0
            try:
                for estimates in self.observer.read(samples):
                    last = first + len(estimates) * robots
                    yield samples.select(slice(first, last)), estimates
                    first = last
            except InconsistentError as error:
                raise FsidError(self._named(error)) from error

    def _named(self, error: InconsistentError) -> str:
        """The error with the names of robot and rows."""
        labels, clock = self.declared.row_labels, self.declared.clock
        rows = [
            constraint_name(source, labels) + ("" if math.isnan(time) else f" at {clock(time)}")
            for time, source in error.rows
        ]
        return (
            f"robot {self.robots[error.robot]!r} at {clock(error.t)}: no parameter explains the measurements; "
            f"these contradict each other: {', '.join(dict.fromkeys(rows))}"
        )

    def verdicts(self) -> list[Verdict]:
        """The present verdict on each robot."""
        sets = self.sets.feasible_set
        centre, radius = sets.chebyshev()
        volume, diameter, centroid = sets.volume(), sets.diameter(), sets.centroid()
        aside, unexplained = [], [0] * len(self.robots)
        if isinstance(self.sets, SetMembershipObserver):
            aside, unexplained = self.sets.set_aside(), self.sets.unexplained.tolist()
        return [
            Verdict(
                robot=robot,
                cases=dict(zip(CASES, self._cases[i].tolist(), strict=True)),
                skipped=int(self.sets.skipped[i]),
                infeasible=int(self.sets.infeasible[i]),
                volume=float(volume[i]),
                diameter=float(diameter[i]),
                centroid=tuple(centroid[i].tolist()),
                centre=tuple(centre[i].tolist()),
                radius=float(radius[i]),
                no_information_since=None if sets.last_cut[i].isnan() else float(sets.last_cut[i]),
                resets=tuple(float(event.t) for event in self.sets.events if event.robot == i and event.reset),
                unexplained=unexplained[i],
                set_aside=tuple(sample for sample in aside if sample.robot == i),
                status=STATUS_NAMES[Status(int(self.sets.status[i]))],
                holds_truth=self._holds_truth(i),
            )
            for i, robot in enumerate(self.robots)
        ]

    def _holds_truth(self, i: int) -> bool | None:
        theta = (self.config.truth or {}).get(self.robots[i])
        return None if theta is None else holds(self.sets.feasible_set, i, theta)
