r"""The set-membership observer: for each robot and at every moment, the set in which theta must lie.

Per measurement, for all robots in one batch: the barriers give the rows A u <= b, the task gives (C, d), the motion
shows which rows are active, the KKT conditions become half-spaces, and Theta(t) is what they leave of Theta(t-).

What can go wrong with data is reported, never hidden in the set:
    - an empty intersection: the set stays as it was and the robot's status becomes INCONSISTENT, or, if it is known
      that robots change their minds, the set starts again from the prior;
    - a hard row violated by more than its bound: model or bounds are wrong, the sample is not used, status ALARM;
    - a sample that says nothing (`evidence` has the reasons: a controller that failed, something that was not measured,
      a body left out that could matter) is skipped and counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InconsistentError, InputError
from torchfsid.identification.evidence import Evidence, ObservationModel, SetKind, evidence
from torchfsid.identification.kkt import KktSolution
from torchfsid.outcome import Status
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Task
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.tolerances import ACTIVE_TOLERANCE

OnInconsistent = Literal["hold", "reset", "raise"]


@dataclass(frozen=True)
class Event:
    """The first time something went wrong for a robot, or a time at which its set was reset: when, what, the evidence.

    `rows` names, as (time, source), the half-spaces that contradict each other (INCONSISTENT) or, for an ALARM, the row
    that is violated; the sources are those of `critical_region` and `inverse_optimal_set`.
    """

    t: float
    robot: int
    status: Status
    rows: tuple[tuple[float, int], ...]
    reset: bool = False


@dataclass(frozen=True)
class SetEstimate:
    """What is known at time t.

    Attributes:
        t: time [s].
        feasible_set: Theta(t) of every robot.
        evidence: what the measurement says by itself.
        informative: the sample was used.
        status: a `Status` per robot; it stays at the worst it has been.
    """

    t: float
    feasible_set: FeasibleSet
    evidence: Evidence
    informative: Bool[Tensor, "B"]
    status: Int[Tensor, "B"]

    @property
    def kkt(self) -> KktSolution:
        """u* = G theta + f at the observed active set."""
        return self.evidence.kkt

    @cached_property
    def theta(self) -> Float[Tensor, "B p"]:
        """The centroid: unlike the Chebyshev centre it does not jump along a needle."""
        return self.feasible_set.centroid()


@dataclass
class SetMembershipObserver:
    """Theta(t) for a batch of robots that share a task and barriers.

    Attributes:
        task, barriers, kind, noise, active_tolerance: what is declared, see `ObservationModel`.
        feasible_set: Theta, at first the prior of every robot, batch (B,).
        on_inconsistent: what an empty intersection does: `hold` the set as it was, `reset` it to the prior and go on
            from there (a change of goal; the status stays OK, the event is recorded), or `raise` `InconsistentError`.
        compiled: see `evidence`; the sets are the same up to round-off.
        model: the declared model as one record.
        prior: the sets at first.
        status: a `Status` per robot.
        skipped: number of samples without information, per robot.
        events: the first ALARM and INCONSISTENT of each robot, and the times at which sets were reset.

    Raises:
        InputError: the prior is not a batch (B,) over the task's parameters; `inverse_optimal` comes without `noise`;
            `compiled` is True, but theta is not planar or the nominal control is clipped.
    """

    task: Task
    barriers: Sequence[Barrier]
    feasible_set: FeasibleSet
    kind: SetKind = "inverse_optimal"
    noise: NoiseBound | None = None
    active_tolerance: float = ACTIVE_TOLERANCE
    on_inconsistent: OnInconsistent = "hold"
    compiled: bool | None = None
    model: ObservationModel = field(init=False)
    prior: FeasibleSet = field(init=False)
    status: Int[Tensor, "B"] = field(init=False)
    skipped: Int[Tensor, "B"] = field(init=False)
    events: list[Event] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        p = len(self.task.parameter_names)
        if len(self.feasible_set.batch_shape) != 1 or self.feasible_set.dim != p:
            actual = (*self.feasible_set.batch_shape, self.feasible_set.dim)
            raise InputError("feasible_set", f"a batch (B,) of sets over the task's {p} parameters", actual)
        self.model = ObservationModel(self.task, self.barriers, self.kind, self.noise, self.active_tolerance)
        if self.compiled and not (p == 2 and self.task.saturation is None):
            raise InputError("compiled", "None or False unless theta is planar and nothing is clipped", True)
        self.prior = self.feasible_set
        self.status = torch.zeros_like(self.feasible_set.outcome)
        self.skipped = torch.zeros_like(self.status)

    def update(self, measurement: Measurement) -> SetEstimate:
        """Take in one measurement of all robots.

        Raises:
            InputError: see `evidence`; or the robots were measured at different times.
            InconsistentError: an intersection is empty, and `on_inconsistent` is `raise`.
        """
        t = measurement.time
        found = evidence(self.model, self.feasible_set, measurement, self.compiled)
        narrowed = self.feasible_set.intersect(found.omega, t)
        informative = found.informative
        if narrowed.any_empty or bool(found.alarmed.any()):
            self._report(t, found.alarmed, found.slack, narrowed)
            informative = informative & ~narrowed.is_empty
            narrowed = narrowed.where(~narrowed.is_empty, self._instead())
        self.feasible_set = narrowed
        self.skipped = self.skipped + ~found.informative
        return SetEstimate(t, self.feasible_set, found, informative, self.status)

    def _instead(self) -> FeasibleSet:
        """What takes the place of an empty set."""
        return self.feasible_set if self.on_inconsistent == "hold" else self.prior

    def _report(self, t: float, alarmed: Tensor, slack: Tensor, narrowed: FeasibleSet) -> None:
        """Record what went wrong for the first time, and raise the statuses."""
        evidence = narrowed.contradiction
        for robot in (alarmed & (self.status < Status.ALARM)).nonzero().flatten().tolist():
            row = int(slack[robot].argmin())
            self.events.append(Event(t, robot, Status.ALARM, ((t, row),)))
        reset = self.on_inconsistent == "reset"
        for robot in (narrowed.is_empty & (self.status < Status.INCONSISTENT)).nonzero().flatten().tolist():
            rows = tuple(zip(evidence.time[robot].tolist(), evidence.source[robot].tolist(), strict=True))
            self.events.append(Event(t, robot, Status.INCONSISTENT, rows, reset))
            if self.on_inconsistent == "raise":
                raise InconsistentError(
                    f"robot {robot} at t = {t}: no parameter explains the measurements; rows {rows}"
                )
        self.status = torch.where(alarmed, self.status.clamp(min=Status.ALARM), self.status)
        if not reset:
            self.status = torch.where(narrowed.is_empty, Status.INCONSISTENT, self.status)
