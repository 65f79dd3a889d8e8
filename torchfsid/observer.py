r"""The set-membership observer: for each robot and at every moment, the set in which theta must lie.

Per measurement, for all robots in one batch: the barriers give the rows A u <= b, the task gives (C, d), the motion
shows which rows are active, the KKT conditions become half-spaces, and Theta(t) is what they leave of Theta(t-).

What can go wrong with data is reported, never hidden in the set:
    - an empty intersection: the set stays as it was, the robot's status becomes INCONSISTENT;
    - a hard row violated by more than its bound: model or bounds are wrong, the sample is not used, status ALARM;
    - a controller that failed (it commands exactly zero while a row is violated), a robot or a neighbour's velocity not
      measured: the sample says nothing, it is skipped and counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.active_set import ACTIVE_TOLERANCE, active_set
from torchfsid.barriers import Barrier
from torchfsid.critical_region import critical_region
from torchfsid.errors import InputError
from torchfsid.feasible_set import FeasibleSet
from torchfsid.halfspaces import Halfspaces
from torchfsid.inverse_optimal import NoiseBound, inverse_optimal_set
from torchfsid.kkt import KktSolution, solve_kkt
from torchfsid.measurement import Measurement
from torchfsid.tasks import Task

SetKind = Literal["critical_region", "inverse_optimal"]


class Status(IntEnum):
    """Can the set be trusted?"""

    OK = 0
    ALARM = 1  # a row was violated by more than its bound
    INCONSISTENT = 2  # an intersection came out empty


@dataclass(frozen=True)
class Event:
    """The first time something went wrong for a robot: when, what, and the evidence.

    `rows` names, as (time, source), the half-spaces that contradict each other (INCONSISTENT) or, for an ALARM, the row
    that is violated; the sources are those of `critical_region` and `inverse_optimal_set`.
    """

    t: float
    robot: int
    status: Status
    rows: tuple[tuple[float, int], ...]


@dataclass(frozen=True)
class SetEstimate:
    """What is known at time t.

    Attributes:
        t: time [s].
        feasible_set: Theta(t) of every robot.
        kkt: u* = G theta + f at the observed active set.
        informative: the sample was used.
        status: a `Status` per robot; it stays at the worst it has been.
    """

    t: float
    feasible_set: FeasibleSet
    kkt: KktSolution
    informative: Bool[Tensor, "B"]
    status: Int[Tensor, "B"]

    @cached_property
    def theta(self) -> Float[Tensor, "B p"]:
        """The centroid: unlike the Chebyshev centre it does not jump along a needle."""
        return self.feasible_set.centroid()


@dataclass
class SetMembershipObserver:
    """Theta(t) for a batch of robots that share a task and barriers.

    Attributes:
        task, barriers: the declared model.
        feasible_set: Theta, at first the prior of every robot, batch (B,).
        kind: `critical_region` (the paper's Omega: for exact data of exact controllers) or `inverse_optimal`.
        noise: bounds for `inverse_optimal` and for the alarm.
        active_tolerance: when a row counts as active for `critical_region`, for the case label and for (G, f) [m/s].
        status, skipped, events: per robot: `Status`, number of samples without information, first ALARM and
        INCONSISTENT.

    Raises:
        InputError: the prior is not a batch (B,) over the task's parameters; `inverse_optimal` comes without `noise`.
    """

    task: Task
    barriers: Sequence[Barrier]
    feasible_set: FeasibleSet
    kind: SetKind = "inverse_optimal"
    noise: NoiseBound | None = None
    active_tolerance: float = ACTIVE_TOLERANCE
    status: Int[Tensor, "B"] = field(init=False)
    skipped: Int[Tensor, "B"] = field(init=False)
    events: list[Event] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        p = len(self.task.parameter_names)
        if len(self.feasible_set.batch_shape) != 1 or self.feasible_set.dim != p:
            actual = (*self.feasible_set.batch_shape, self.feasible_set.dim)
            raise InputError("feasible_set", f"a batch (B,) of sets over the task's {p} parameters", actual)
        if self.kind == "inverse_optimal" and self.noise is None:
            raise InputError("noise", "a NoiseBound, since the set is inverse_optimal", None)
        self.status = torch.zeros(self.feasible_set.batch_shape, dtype=torch.long)
        self.skipped = torch.zeros_like(self.status)

    def update(self, measurement: Measurement) -> SetEstimate:
        """Take in one measurement of all robots.

        Raises:
            InputError: the measurement has no velocities, or they are not finite where the robot was observed.
        """
        u, t = measurement.u, measurement.t
        if u is None or not bool(u.isfinite().all()) or not bool(measurement.x.isfinite().all()):
            raise InputError("measurement", "finite positions and velocities", f"none or not finite at t = {t}")
        parts = [barrier(measurement) for barrier in self.barriers]
        rows = Halfspaces.stack(parts)
        known = rows.b.isfinite() & rows.A.isfinite().all(-1)
        safe_controls = rows.where(known)
        slack = safe_controls.slack(u)
        hard = torch.cat([torch.full((part.rows,), not b.soft) for part, b in zip(parts, self.barriers, strict=True)])
        bound = self.active_tolerance if self.noise is None else self.noise.slack
        broken = (slack < -bound) & hard
        failed = (u == 0).all(-1) & (slack < 0).any(-1)
        measured = known.all(-1) & ~failed
        if measurement.observed is not None:
            measured = measured & measurement.observed
        alarmed = measured & broken.any(-1)
        informative = measured & ~alarmed

        C, d = self.task(measurement)
        active = active_set(safe_controls, u, self.active_tolerance)
        if self.kind == "critical_region":
            omega = critical_region(safe_controls, active, C, d)
        else:
            assert self.noise is not None
            omega = inverse_optimal_set(safe_controls, u, C, d, self.noise)
        narrowed = self.feasible_set.intersect(omega.where(informative.unsqueeze(-1)), time=t)
        contradicted = narrowed.is_empty
        self._report(t, alarmed, slack, narrowed)
        self.feasible_set = narrowed.where(~contradicted, self.feasible_set)
        self.skipped = self.skipped + (~informative).long()
        kkt = solve_kkt(safe_controls, active, C, d)
        return SetEstimate(t, self.feasible_set, kkt, informative & ~contradicted, self.status)

    def _report(self, t: float, alarmed: Tensor, slack: Tensor, narrowed: FeasibleSet) -> None:
        """Record what went wrong for the first time, and raise the statuses."""
        evidence = narrowed.contradiction
        for robot in (alarmed & (self.status < Status.ALARM)).nonzero().flatten().tolist():
            row = int(slack[robot].argmin())
            self.events.append(Event(t, robot, Status.ALARM, ((t, row),)))
        for robot in (narrowed.is_empty & (self.status < Status.INCONSISTENT)).nonzero().flatten().tolist():
            rows = tuple(zip(evidence.time[robot].tolist(), evidence.source[robot].tolist(), strict=True))
            self.events.append(Event(t, robot, Status.INCONSISTENT, rows))
        self.status = torch.where(alarmed, self.status.clamp(min=Status.ALARM), self.status)
        self.status = torch.where(narrowed.is_empty, Status.INCONSISTENT, self.status)
