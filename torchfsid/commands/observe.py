"""The observation of a log: from its measurements and a declared model to a results folder and a line per robot."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import torch

from torchfsid.commands.figures import draw_observation
from torchfsid.commands.results import STATUS_NAMES, ResultsWriter, write_json
from torchfsid.commands.scene import AUTO_FACTOR, Scene, automatic_bound
from torchfsid.config.documents import dump
from torchfsid.config.observe import ObserveConfig
from torchfsid.identification.kkt import CASES
from torchfsid.logs.log import Log
from torchfsid.observers.hybrid import HybridObserver
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.observers.ukf import ParameterUkf
from torchfsid.outcome import Status


@dataclass(frozen=True)
class Verdict:
    """What a log says about one robot: `cases` counts the samples of each case; `no_information_since` is the time at
    which the set last shrank [s], None if it never did; `resets` are the times of changes of its mind [s]."""

    robot: str
    cases: dict[str, int]
    skipped: int
    volume: float
    diameter: float
    centroid: tuple[float, ...]
    centre: tuple[float, ...]
    radius: float
    no_information_since: float | None
    resets: tuple[float, ...]
    status: str


@dataclass
class Observation:
    """A log and the declared model, ready to run.

    Attributes:
        config: with the velocity bound that was found, if it said `auto`.
        smallest_bounds: for each robot the smallest velocity bound that explains its motion [m/s], if it said `auto`.

    Raises:
        ConfigError: see `Scene` and `automatic_bound`.
    """

    config: ObserveConfig
    log: Log
    scene: Scene = field(init=False)
    robots: list[str] = field(init=False)
    sets: SetMembershipObserver = field(init=False)
    hybrid: HybridObserver = field(init=False)
    smallest_bounds: dict[str, float] | None = field(init=False, default=None)
    _cases: dict[str, Counter[str]] = field(init=False)

    def __post_init__(self) -> None:
        self.scene = scene = Scene(self.config, self.log)
        if self.config.noise.velocity == "auto":
            self.smallest_bounds = scene.smallest_bounds()
            self.config = self.config.with_velocity_bound(automatic_bound(self.smallest_bounds))
        config, self.log, self.robots = self.config, scene.log, scene.robots
        self._cases = {robot: Counter() for robot in self.robots}
        self.sets = SetMembershipObserver(
            scene.task,
            scene.barriers,
            scene.prior,
            kind=config.set,
            noise=config.noise.build(),
            active_tolerance=config.active_tolerance,
            on_inconsistent=config.on_inconsistent,
        )
        lower, upper = (
            torch.tensor(bound, dtype=torch.float64).expand(len(self.robots), -1)
            for bound in (config.prior.lower, config.prior.upper)
        )
        ukf = ParameterUkf(
            scene.task,
            scene.barriers,
            mean=(lower + upper) / 2,
            spread=(upper - lower) / math.sqrt(12) if config.ukf.prior_std is None else config.ukf.prior_std,
            position_noise=config.ukf.position_noise,
            process_noise=config.ukf.process_noise,
            active_tolerance=config.active_tolerance,
            qp_inside=config.ukf.qp_inside,
        )
        self.hybrid = HybridObserver(self.sets, ukf, feedback=config.ukf.feedback)

    @property
    def samples(self) -> int:
        """How many there are to read."""
        return len(self.log.t)

    @property
    def velocity_bound(self) -> float:
        """The bound in use [m/s]."""
        assert self.config.noise.velocity != "auto"
        return self.config.noise.velocity

    def strained(self) -> list[str]:
        """Robots that ended ok but need more than half of the velocity bound: an error of the model may have taken it.

        No alarm, since errors may be as large as declared. Not asked where it means nothing (the bound was found, sets
        start again, the paper's set) or takes too long (theta is not planar).
        """
        config, sets = self.config, self.sets
        if self.smallest_bounds is not None or config.on_inconsistent == "reset" or sets.kind == "critical_region":
            return []
        if sets.prior.dim != 2:
            return []
        half = torch.full((len(self.robots),), self.velocity_bound / AUTO_FACTOR, dtype=torch.float64)
        _, suffices = self.scene.consistency().sets(half)
        needs_more = (sets.status == Status.OK) & ~suffices
        return [robot for robot, strained in zip(self.robots, needs_more.tolist(), strict=True) if strained]

    def run(self, out: Path) -> Iterator[float]:
        """Observe the whole log into the folder `out`, yielding the time of each sample done; the figure comes last."""
        with ResultsWriter(out, self.robots, self.sets) as results:
            (out / "config.yaml").write_text(dump(self.config), encoding="utf-8")
            if self.smallest_bounds is not None:
                found = {"smallest": self.smallest_bounds, "factor": AUTO_FACTOR, "used": self.velocity_bound}
                write_json(out / "velocity_bound.json", found)
            for measurement in self.scene.measurements():
                estimate = self.hybrid.update(measurement)
                results.write(measurement, estimate)
                informative = estimate.set_estimate.informative.tolist()
                for robot, case, used in zip(
                    self.robots, estimate.set_estimate.kkt.case.tolist(), informative, strict=True
                ):
                    self._cases[robot].update([CASES[case]] if used else [])
                yield measurement.t
        draw_observation(out, self.log.x, self.log.seen, self.log.bodies)

    def verdicts(self) -> list[Verdict]:
        """A line per robot, as things stand."""
        sets = self.sets.feasible_set
        centre, radius = sets.chebyshev()
        volume, diameter, centroid = sets.volume(), sets.diameter(), sets.centroid()
        return [
            Verdict(
                robot=robot,
                cases={case: self._cases[robot][case] for case in CASES},
                skipped=int(self.sets.skipped[i]),
                volume=float(volume[i]),
                diameter=float(diameter[i]),
                centroid=tuple(centroid[i].tolist()),
                centre=tuple(centre[i].tolist()),
                radius=float(radius[i]),
                no_information_since=None if sets.last_cut[i].isnan() else float(sets.last_cut[i]),
                resets=tuple(event.t for event in self.sets.events if event.robot == i and event.reset),
                status=STATUS_NAMES[Status(int(self.sets.status[i]))],
            )
            for i, robot in enumerate(self.robots)
        ]
