"""Does a log fit its declared model? Asked of the log alone, without any truth, for `torchfsid check`.

Per robot: the smallest velocity bound that explains its motion, the residuals of its samples (`consistency`), and which
rows of the model stand behind the samples that contradict it at the declared bound. For the whole log: whether another
alignment of velocities with positions would fit better, since a shift of one sample breaks the KKT conditions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfsid.commands.declared_log import AUTO_FACTOR, DeclaredLog
from torchfsid.commands.results import constraint_name, seconds
from torchfsid.observers.consistency import Consistency
from torchfsid.sets.feasible_set import FeasibleSet

SHIFTS = (-2, -1, 1, 2)
"""Misalignments of velocities and positions that are looked for [samples]."""

BETTER = 0.8
"""Another alignment is better if it needs less than this fraction of the bound."""


@dataclass(frozen=True)
class Fault:
    """Samples of a robot at odds with the declared bounds because of one row of the model.

    Attributes:
        row: its label.
        soft: the controller may violate it.
        samples: how many there are.
        first: the time of the first [s].
        worst: the most by which a bound is exceeded [m/s].
    """

    row: str
    soft: bool
    samples: int
    first: float
    worst: float

    def to_json(self) -> dict:
        return {**vars(self), "worst": _finite(self.worst)}


@dataclass(frozen=True)
class RobotCheck:
    """What its own motion says about a robot. Bounds and residuals in m/s; infinite: above the largest speed.

    Attributes:
        smallest_bound: the smallest velocity bound that explains the motion.
        median, p95, worst: quantiles of the residuals of its samples.
        worst_time: when the worst was [s].
        samples: how many say something about theta.
        contradictions: samples that the best Theta cannot explain with the declared bound.
        violations: rows violated beyond their bound.
    """

    robot: str
    smallest_bound: float
    median: float
    p95: float
    worst: float
    worst_time: float
    samples: int
    contradictions: tuple[Fault, ...]
    violations: tuple[Fault, ...]


@dataclass(frozen=True)
class Check:
    """A log against its declared model.

    Attributes:
        declared: the velocity bound of the configuration [m/s], or what `auto` would take.
        is_auto: the configuration says `auto`.
        fastest: the largest speed in the log [m/s].
        shifts: `smallest_bound` if velocities are taken so many samples later; infinite: not below that of no shift.
    """

    robots: tuple[RobotCheck, ...]
    declared: float
    is_auto: bool
    fastest: float
    shifts: dict[int, float]

    @property
    def smallest_bound(self) -> float:
        """The largest of the robots' smallest bounds [m/s]."""
        return max(robot.smallest_bound for robot in self.robots)

    @property
    def best_shift(self) -> int:
        """How many samples later the velocities fit clearly better; 0: aligned as they are."""
        best = min(self.shifts, key=lambda shift: self.shifts[shift])
        return best if self.shifts[best] < BETTER * self.smallest_bound else 0

    def conclusions(self) -> list[str]:
        """In plain words."""
        lines = [self._fit()]
        if self.best_shift:
            later = "later" if self.best_shift > 0 else "earlier"
            lines.append(
                f"velocities logged {abs(self.best_shift)} sample(s) {later} fit better: "
                f"{self.shifts[self.best_shift]:.3g} m/s suffices; positions and velocities may be misaligned"
            )
        else:
            lines.append("velocities and positions are aligned: no shift by 1 or 2 samples fits better")
        for name, faults in (
            ("unexplained samples", [fault for robot in self.robots for fault in robot.contradictions]),
            ("samples that violate a hard row", [f for robot in self.robots for f in robot.violations if not f.soft]),
        ):
            if faults:
                first = min(faults, key=lambda fault: fault.first)
                most = max({fault.row for fault in faults}, key=lambda row: _count(faults, row))
                lines.append(
                    f"{name} at {self.declared:.3g} m/s: {_count(faults)}, the first at {seconds(first.first)} "
                    f"({first.row}), most by {most} ({_count(faults, most)})"
                )
        return lines

    def _fit(self) -> str:
        unexplained = [robot.robot for robot in self.robots if math.isinf(robot.smallest_bound)]
        if unexplained:
            return (
                f"the log contradicts the declared model: no velocity bound up to {self.fastest:.3g} m/s, "
                f"the largest speed, explains {', '.join(unexplained)}"
            )
        share = (
            f"{100 * self.smallest_bound / self.fastest:.2g} % of the largest speed" if self.fastest else "no motion"
        )
        line = f"the log is consistent with the declared model for velocity >= {self.smallest_bound:.3g} m/s ({share})"
        if self.is_auto:
            return f"{line}; auto takes {self.declared:.3g}"
        line = f"{line}; declared {self.declared:.3g}"
        short = [robot.robot for robot in self.robots if robot.smallest_bound > self.declared]
        if short:
            return f"{line}, too small for {', '.join(short)}"
        if self.smallest_bound > self.declared / AUTO_FACTOR:
            line += ", of which more than half is needed: an error of the model may have taken it"
        return line

    def to_json(self) -> dict:
        """As `check.json` holds it: what is infinite is null."""
        return {
            "smallest_bound": _finite(self.smallest_bound),
            "declared": self.declared,
            "auto": self.is_auto,
            "largest_speed": self.fastest,
            "best_shift": self.best_shift,
            "shifts": {str(shift): _finite(bound) for shift, bound in sorted(self.shifts.items())},
            "conclusions": self.conclusions(),
            "robots": {
                robot.robot: {
                    "smallest_bound": _finite(robot.smallest_bound),
                    "residual": {
                        "median": _finite(robot.median),
                        "p95": _finite(robot.p95),
                        "max": _finite(robot.worst),
                        "max_time": _finite(robot.worst_time),
                    },
                    "samples": robot.samples,
                    "contradictions": [fault.to_json() for fault in robot.contradictions],
                    "violations": [fault.to_json() for fault in robot.violations],
                }
                for robot in self.robots
            },
        }


def check(declared: DeclaredLog) -> Check:
    """Check a log against the model that is declared for it."""
    consistency = declared.consistency()
    fastest = consistency.fastest
    bounds = consistency.smallest_bounds(fastest)
    enough = bounds.clamp(max=fastest)
    overall = float(enough.max())
    bound = declared.config.noise.velocity
    velocity = AUTO_FACTOR * overall if bound == "auto" else bound

    shifts = {0: float(bounds.max())}
    for shift in SHIFTS:
        if len(declared.log.t) > abs(shift) + 1:
            shifts[shift] = float(declared.shifted(shift).consistency().smallest_bounds(overall).max())

    theta, _ = consistency.sets(enough)
    residuals = consistency.residuals(theta, fastest)
    faults = _Faults(declared.row_labels, consistency, theta, velocity, residuals)
    robots = []
    for i, robot in enumerate(declared.robots):
        of_robot = residuals[:, i]
        says = ~of_robot.isnan()
        some = of_robot[says]
        k = int(of_robot.nan_to_num(nan=-1.0, posinf=math.inf).argmax())
        robots.append(
            RobotCheck(
                robot=robot,
                smallest_bound=float(bounds[i]),
                median=_quantile(some, 0.5),
                p95=_quantile(some, 0.95),
                worst=_quantile(some, 1.0),
                worst_time=float(declared.log.t[k]) if len(some) else math.nan,
                samples=len(some),
                contradictions=faults.contradictions(i),
                violations=faults.violations(i),
            )
        )
    return Check(tuple(robots), velocity, bound == "auto", fastest, shifts)


class _Faults:
    """All samples at the declared bound: the row that each is at odds with, and by how much."""

    def __init__(
        self, labels: Sequence[str], consistency: Consistency, theta: FeasibleSet, velocity: float, residuals: Tensor
    ):
        self.labels = labels
        at_odds, blamed, excess, measured = [], [], [], []
        for block in consistency.blocks:
            reading = consistency.read(block, theta, block.repeated(torch.full_like(residuals[0], velocity)))
            # How far Theta is beyond each half-space [m/s]: rows come from unit normals over the control.
            corners = block.repeated(theta.vertices())
            beyond = (reading.omega.A @ corners.mT).amin(-1) - reading.omega.b
            worst = beyond.argmax(-1, keepdim=True)
            assert reading.omega.source is not None
            blamed.append(reading.omega.source.gather(-1, worst).squeeze(-1))
            at_odds.append(reading.informative)
            excess.append(reading.excess)
            measured.append(reading.informative | reading.alarmed)
            self.hard = reading.hard
        robots = residuals.shape[1]
        self.times = torch.cat([block.times for block in consistency.blocks])
        self.over = residuals - velocity
        self.at_odds = torch.cat(at_odds).unflatten(0, (-1, robots)) & (self.over > 0)
        self.blamed = torch.cat(blamed).unflatten(0, (-1, robots))
        self.excess = torch.cat(excess).unflatten(0, (-1, robots))
        self.measured = torch.cat(measured).unflatten(0, (-1, robots))

    def contradictions(self, robot: int) -> tuple[Fault, ...]:
        over, blamed = self.over[:, robot], self.blamed[:, robot]
        faults = []
        for source in blamed[self.at_odds[:, robot]].unique().tolist():
            at_odds = self.at_odds[:, robot] & (blamed == source)
            hard = source % len(self.labels) if source < 2 * len(self.labels) else None
            soft = hard is not None and not bool(self.hard[hard])
            faults.append(self._fault(constraint_name(source, self.labels), soft, at_odds, over))
        return tuple(faults)

    def violations(self, robot: int) -> tuple[Fault, ...]:
        faults = []
        for row, label in enumerate(self.labels):
            excess = self.excess[:, robot, row]
            violated = self.measured[:, robot] & (excess > 0)
            if bool(violated.any()):
                faults.append(self._fault(label, not bool(self.hard[row]), violated, excess))
        return tuple(faults)

    def _fault(self, label: str, soft: bool, samples: Tensor, over: Tensor) -> Fault:
        first = float(self.times[samples][0])
        return Fault(label, soft, int(samples.sum()), first, float(over[samples].max()))


def _count(faults: Sequence[Fault], row: str | None = None) -> int:
    return sum(fault.samples for fault in faults if row in (None, fault.row))


def _quantile(values: Tensor, q: float) -> float:
    """The smallest value that at least the fraction q does not exceed; NaN of nothing."""
    if len(values) == 0:
        return math.nan
    return float(values.sort().values[max(0, math.ceil(q * len(values)) - 1)])


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
