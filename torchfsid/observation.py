"""The observation of a log: from its measurements and a declared model to a results folder and a line per robot."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import torch

from torchfsid.config import ObserveConfig
from torchfsid.documents import dump
from torchfsid.errors import ConfigError
from torchfsid.feasible_set import FeasibleSet
from torchfsid.figures import draw_observation
from torchfsid.hybrid import HybridObserver
from torchfsid.kkt import CASES
from torchfsid.logs import Log
from torchfsid.observer import SetMembershipObserver, Status
from torchfsid.results import STATUS_NAMES, ResultsWriter
from torchfsid.ukf import ParameterUkf


@dataclass(frozen=True)
class Verdict:
    """What a log says about one robot: `cases` counts the samples of each case; `no_information_since` is the time at
    which the set last shrank [s], None if it never did."""

    robot: str
    cases: dict[str, int]
    skipped: int
    volume: float
    diameter: float
    centroid: tuple[float, ...]
    centre: tuple[float, ...]
    radius: float
    no_information_since: float | None
    status: str


@dataclass
class Observation:
    """A log and the declared model, checked against each other and ready to run.

    Raises:
        ConfigError: the model needs what the log does not have (a body, velocities, radii, planar positions).
    """

    config: ObserveConfig
    log: Log
    robots: list[str] = field(init=False)
    sets: SetMembershipObserver = field(init=False)
    hybrid: HybridObserver = field(init=False)
    _cases: dict[str, Counter[str]] = field(init=False)

    def __post_init__(self) -> None:
        config = self.config
        if self.log.x.shape[-1] != 2:
            raise ConfigError("task: planar controllers only, but the log has a column z")
        if config.velocity == "logged" and self.log.u is None:
            raise ConfigError("velocity: 'logged', but the log has no columns vx, vy (use 'differentiated')")
        margins = [b.margin for b in config.barriers if b.kind == "avoidance" and b.margin is not None]
        if margins and self.log.radius is None:
            raise ConfigError("barriers: a margin needs the radii, but the log has no column radius")
        if margins and self.log.radius is not None and min(margins) + sorted(self.log.radius)[0] <= 0:
            raise ConfigError("barriers: a margin of 0 needs positive radii")
        if len(self.log.bodies) > 1 and not (self.log.seen.sum(axis=1) > 1).any():
            raise ConfigError(f"{self.log.source}: no two bodies share a time, so none would ever see another")
        if config.velocity == "differentiated":
            self.log = self.log.differentiated()
        self.robots = config.robots(self.log.bodies)
        self._cases = {robot: Counter() for robot in self.robots}

        task = config.task.build(self.log.bodies)
        barriers = [barrier.build() for barrier in config.barriers]
        lower, upper = (
            torch.tensor(bound, dtype=torch.float64).expand(len(self.robots), -1)
            for bound in (config.prior.lower, config.prior.upper)
        )
        self.sets = SetMembershipObserver(
            task,
            barriers,
            FeasibleSet.from_box(lower, upper),
            kind=config.set,
            noise=config.noise.build(),
            active_tolerance=config.active_tolerance,
            on_inconsistent=config.on_inconsistent,
        )
        ukf = ParameterUkf(
            task,
            barriers,
            mean=(lower + upper) / 2,
            spread=(upper - lower) / math.sqrt(12) if config.ukf.prior_std is None else config.ukf.prior_std,
            position_noise=config.ukf.position_noise,
            process_noise=config.ukf.process_noise,
            active_tolerance=config.active_tolerance,
            qp_inside=config.ukf.qp_inside,
        )
        self.hybrid = HybridObserver(self.sets, ukf, feedback=config.ukf.feedback)

    def run(self, out: Path) -> Iterator[float]:
        """Observe the whole log into the folder `out`, yielding the time of each sample done; the figure comes last."""
        measurements = self.log.measurements(self.robots, self.config.neighbour_velocities, self.config.required)
        with ResultsWriter(out, self.robots, self.sets) as results:
            (out / "config.yaml").write_text(dump(self.config), encoding="utf-8")
            for measurement in measurements:
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
                status=STATUS_NAMES[Status(int(self.sets.status[i]))],
            )
            for i, robot in enumerate(self.robots)
        ]
