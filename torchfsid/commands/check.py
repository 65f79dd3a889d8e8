"""`torchfsid check`: does a log fit its declared model? Answered from the log alone, without the true parameter.

For each robot: the smallest bound on controls that explains its motion, the residuals of its samples (`consistency`),
and the rows of the model that contradict samples at the declared bound. For the whole log: whether another alignment of
controls with positions fits better, because a shift of one sample breaks the KKT conditions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from torchfsid.commands.alternatives import Alternative, best_alternative
from torchfsid.commands.check_safety import SafetyCheck, check_safety
from torchfsid.commands.clock import Clock
from torchfsid.commands.declared_log import AUTO_FACTOR, LARGEST_OF, DeclaredLog
from torchfsid.commands.faults import Fault, Faults
from torchfsid.commands.judged_bound import SUSPECTS, JudgedBound
from torchfsid.commands.narrowing import Narrowing, narrowed
from torchfsid.logs.commanded import Recovery

CONTROLS = {"velocity": "velocities", "acceleration": "accelerations"}
"""What controls are called."""

SHIFTS = (-2, -1, 1, 2)
"""Misalignments of controls and positions that are looked for [samples]."""

MUCH_BETTER = 0.5
"""A misalignment is suspected if another alignment needs less than this fraction of the bound."""

BETTER = 0.8
"""The same, of what the best change of a key needs: wrong keys often look like a shift."""


@dataclass(frozen=True)
class RobotCheck:
    """What a robot's motion says about the declared model, in units of the controls.

    A bound or residual is infinite above the largest control.

    Attributes:
        robot: name of the robot.
        smallest_bound: the smallest bound that explains the motion. NaN if no sample could be used.
        median: median of the residuals of the samples.
        p95: 95th percentile of the residuals.
        worst: largest residual.
        worst_time: time of the largest residual [s].
        samples: number of samples that say something about theta.
        contradictions: samples that the best Theta cannot explain with the declared bound.
        violations: samples at which a row is violated by more than its bound.
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
    """The result of checking a log against its declared model.

    Attributes:
        robots: one entry per robot.
        quantity: what the controls are, `velocity` or `acceleration`.
        declared: the bound of the configuration, or the one that `auto` takes.
        is_auto: the configuration says `auto`.
        fastest: the largest control in the log.
        bound: the larger of the declared and the smallest bound, judged by the controls seen.
        alternative: the change of one key with which the log needs a much smaller bound, if there is one.
        clock: how times are shown.
        shifts: number of samples by which controls are taken later, to the `smallest_bound` then. It is infinite if it
            is not below that without a shift.
        safety: what the log says about gain and safety distance. None where that is not asked.
        narrowing: what is left of the unknown numbers at the declared bound. All else holds for what is left.
        as_commanded: velocities are differences of positions, and taken for commands.
        recovery: how the commands of unicycles were recovered. None if robots are none.
    """

    robots: tuple[RobotCheck, ...]
    quantity: str
    declared: float
    is_auto: bool
    fastest: float
    bound: JudgedBound
    alternative: Alternative | None
    clock: Clock
    shifts: dict[int, float]
    safety: SafetyCheck | None
    as_commanded: bool
    recovery: Recovery | None
    narrowing: Narrowing | None = None

    @property
    def smallest_bound(self) -> float:
        """The largest of the robots' smallest bounds. NaN if no sample could be used."""
        return max((robot.smallest_bound for robot in self.robots if robot.samples), default=math.nan)

    @property
    def unit(self) -> str:
        """The unit of all bounds and residuals."""
        return self.bound.unit

    @property
    def best_shift(self) -> int:
        """The number of samples by which later controls fit clearly better. 0: no shift does."""
        best = min(self.shifts, key=lambda shift: self.shifts[shift])
        rival = math.inf if self.alternative is None else BETTER * self.alternative.bound
        return best if self.shifts[best] < min(MUCH_BETTER * self.smallest_bound, rival) else 0

    def conclusions(self) -> list[str]:
        """The conclusions as sentences, with remedies."""
        silent = [robot.robot for robot in self.robots if robot.samples == 0]
        lines = [] if self.recovery is None else [self.recovery.sentence()]
        lines += [f"nothing can be said of {', '.join(silent)}: no sample could be used"] if silent else []
        if len(silent) == len(self.robots):
            return lines
        lines += [] if self.narrowing is None else self.narrowing.said()
        lines += [self._fit(), *([] if self._suggestion is None else [self._suggestion])]
        controls = CONTROLS[self.quantity]
        if len(self.shifts) == 1:
            lines.append(f"nothing can be said of the alignment of {controls} and positions: the log is too short")
        elif not self.best_shift:
            lines.append(f"{controls} and positions are aligned: no shift by 1 or 2 samples fits much better")
        if self.bound.is_useless and not self._unexplained:
            is_needed = self.bound.bound <= AUTO_FACTOR * self.smallest_bound
            lines.append(self.bound.warning(is_needed, is_explained=self._suggestion is not None))
        if self.as_commanded and (self.bound.is_useless or self._unexplained):
            lines.append(
                "velocities are differences of positions, which are no commands where robots cannot move sideways: if "
                "they are unicycles, log their headings and declare the body"
            )
        for name, faults in (
            ("unexplained samples", [fault for robot in self.robots for fault in robot.contradictions]),
            ("samples that violate a hard row", [f for robot in self.robots for f in robot.violations if not f.soft]),
        ):
            if faults:
                first = min(faults, key=lambda fault: fault.first)
                most = max({fault.row for fault in faults}, key=lambda row: _count(faults, row))
                look_at = "" if self._suggestion else f": {next(f.look_at for f in faults if f.row == most)}"
                lines.append(
                    f"{name} at {self.declared:.3g} {self.unit}: {_count(faults)}, the first at "
                    f"{self.clock(first.first)} ({first.row}), most by {most} ({_count(faults, most)}){look_at}"
                )
        if self.safety is not None and not (self._suggestion and self.safety.verdict == "neither"):
            lines.append(self.safety.conclusion())  # if neither is wrong, something else is, which may be named already
        if self.smallest_bound <= self.declared:
            lines.append(self._consistent())
        return [*lines, *self.clock.sentence()]

    @property
    def _suggestion(self) -> str | None:
        """The likeliest cause if the log does not fit the declared model well."""
        if self.best_shift:
            later = "later" if self.best_shift > 0 else "earlier"
            controls = CONTROLS[self.quantity]
            return (
                f"{controls} logged {abs(self.best_shift)} sample(s) {later} fit better: "
                f"{self.shifts[self.best_shift]:.3g} {self.unit} suffices; positions and {controls} may be misaligned"
            )
        return None if self.alternative is None else self.alternative.sentence(self.unit)

    @property
    def _unexplained(self) -> list[str]:
        return [robot.robot for robot in self.robots if math.isinf(robot.smallest_bound)]

    def _fit(self) -> str:
        if self._unexplained:
            return (
                f"the log contradicts the declared model: no {self.quantity} bound up to "
                f"{self.fastest:.3g} {self.unit}, the largest {LARGEST_OF[self.quantity]}, "
                f"explains {', '.join(self._unexplained)}; suspect {SUSPECTS}"
            )
        share = replace(self.bound, bound=self.smallest_bound).compared()
        smallest = f"{self.quantity} >= {self.smallest_bound:.3g} {self.unit}"
        line = f"the log is consistent with the declared model for {smallest} ({share})"
        if self.is_auto:
            return f"{line}; auto takes {self.declared:.3g}"
        line = f"{line}; declared {self.declared:.3g}"
        short = [robot.robot for robot in self.robots if robot.smallest_bound > self.declared]
        if short:
            return f"{line}, too small for {', '.join(short)}"
        if self.smallest_bound > self.declared / AUTO_FACTOR:
            line += ", of which more than half is needed: an error of the model may have taken it"
        return line

    def _consistent(self) -> str:
        """The last word on a log without contradiction. It does not take back what was said before."""
        if self.bound.is_useless:
            return "no contradiction was seen; at a useless bound that says nothing of the model"
        if self.safety is not None and self.safety.verdict != "possible":
            return (
                f"no contradiction was seen at {self.declared:.3g} {self.unit}, but gain or {self.safety.what} do not "
                "fit (above)"
            )
        return "consistent: no contradiction was seen. That is no proof of the model"

    def to_json(self) -> dict:
        """The content of `check.json`. Infinite values are null."""
        return {
            "smallest_bound": _finite(self.smallest_bound),
            "declared": self.declared,
            "auto": self.is_auto,
            f"largest_{LARGEST_OF[self.quantity]}": self.fastest,
            "bound": {"judged": self.bound.bound, **self.bound.to_json()},
            "best_shift": self.best_shift,
            "shifts": {str(shift): _finite(bound) for shift, bound in sorted(self.shifts.items())},
            "alternative": None if self.alternative is None else vars(self.alternative),
            "conclusions": self.conclusions(),
            "safety": None if self.safety is None else self.safety.to_json(),
            "unknown_numbers": None if self.narrowing is None else self.narrowing.to_json(),
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
    """Check a log against the model that is declared for it. Its unknown numbers are narrowed first."""
    narrowing = None
    if declared.config.unknown_numbers:
        declared, narrowing = narrowed(declared)
    consistency = declared.consistency()
    fastest = consistency.fastest
    bounds = consistency.smallest_bounds(fastest)
    enough = bounds.clamp(max=fastest)
    overall = float(enough.max())
    noise = declared.config.noise
    bound = AUTO_FACTOR * overall if noise.control == "auto" else noise.control
    judged = declared.judged(max(bound, overall))

    shifts = {0: float(bounds.max())}
    for shift in SHIFTS:
        if len(declared.log.t) > abs(shift) + 1:
            shifts[shift] = float(declared.shifted(shift).consistency().smallest_bounds(overall).max())

    sets = consistency.sets(enough)
    residuals = consistency.residuals(sets, fastest)
    faults = Faults(declared.row_labels, declared.where_to_look, consistency, sets, bound, residuals)
    robots = []
    for i, robot in enumerate(declared.robots):
        of_robot = residuals[:, i]
        says = ~of_robot.isnan()
        some, samples = of_robot[says], int((says | faults.measured[:, i]).sum())
        k = int(of_robot.nan_to_num(nan=-1.0, posinf=math.inf).argmax())
        robots.append(
            RobotCheck(
                robot=robot,
                smallest_bound=float(bounds[i]) if samples else math.nan,
                median=_quantile(some, 0.5),
                p95=_quantile(some, 0.95),
                worst=_quantile(some, 1.0),
                worst_time=float(declared.log.t[k]) if len(some) else math.nan,
                samples=samples,
                contradictions=faults.contradictions(i),
                violations=faults.violations(i),
            )
        )
    alternative = best_alternative(declared, overall) if any(robot.samples for robot in robots) else None
    is_auto, safety = noise.control == "auto", check_safety(declared)
    config = declared.config
    as_commanded = config.velocity == "differentiated" and config.body is None and not config.is_second_order
    return Check(
        robots=tuple(robots),
        quantity=noise.quantity,
        declared=bound,
        is_auto=is_auto,
        fastest=fastest,
        bound=judged,
        alternative=alternative,
        clock=declared.clock,
        shifts=shifts,
        safety=safety,
        as_commanded=as_commanded,
        recovery=declared.recovery,
        narrowing=narrowing,
    )


def _count(faults: Sequence[Fault], row: str | None = None) -> int:
    return sum(fault.samples for fault in faults if row in (None, fault.row))


def _quantile(values: Tensor, q: float) -> float:
    """The smallest value that is not exceeded by at least the fraction q of the values. NaN if there are none."""
    if len(values) == 0:
        return math.nan
    return float(values.sort().values[max(0, math.ceil(q * len(values)) - 1)])


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
