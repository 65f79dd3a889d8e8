r"""The set-membership observer: for each robot and at every moment, the set in which theta must lie.

Each measurement is processed for all robots in one batch. The barriers give the rows A u <= b, the task gives (C, d),
and the control shows which rows are active. The KKT conditions become half-spaces, with which Theta is intersected.

Failures of the data are reported:
    - an intersection is empty: the set stays as it was and the robot's status becomes INCONSISTENT. If robots are
      declared to change their tasks, the set starts again from the prior instead;
    - a hard row is violated by more than its bound: model or bounds are wrong. The sample is not used, the status is
      ALARM;
    - a sample says nothing of theta, for a reason listed in `evidence`: it is skipped and counted.

With `outliers: q` up to q samples of each robot may contradict the others or be alarming (`outliers`). Theta then holds
all parameters that explain the others, and the two failures above are those of the samples beyond the q.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal, get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InconsistentError, InputError
from torchfsid.identification.evidence import Evidence, ObservationModel, SetKind, evidence
from torchfsid.identification.kkt import KktSolution
from torchfsid.identification.windows import Windows
from torchfsid.observers.blocks import Course, depends_on_theta, joined, one_by_one, times_of
from torchfsid.observers.outliers import SetAside, possible, set_aside
from torchfsid.outcome import Status
from torchfsid.robots.arguments import require_choice, require_task
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Task
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.tolerances import ACTIVE_TOLERANCE

OnInconsistent = Literal["hold", "reset", "raise"]

MOST_SHOWN = 8
"""Robots in the text of an estimate."""


@dataclass(frozen=True)
class Event:
    """The first ALARM or INCONSISTENT of a robot, or a time at which its set was reset, with the rows that caused it.

    `rows` names each row as (time, source). For INCONSISTENT these are the half-spaces that contradict each other, with
    the sources of `critical_region` or `inverse_optimal_set`. For an ALARM it is the violated row.
    """

    t: float
    robot: int
    status: Status
    rows: tuple[tuple[float, int], ...]
    reset: bool = False


@dataclass(frozen=True)
class SetEstimate:
    """The sets at time t.

    Attributes:
        t: time [s].
        feasible_set: Theta(t) of every robot.
        evidence: the evidence of this measurement alone.
        informative: whether the sample was used: it has information, and some parameter of the set explains it.
        status: a `Status` per robot, the worst so far.
        safety: Psi of the team, batch (1,), or of every robot, where safety parameters are unknown (`SafetyObserver`).
    """

    t: float
    feasible_set: FeasibleSet
    evidence: Evidence
    informative: Bool[Tensor, "B"]
    status: Int[Tensor, "B"]
    safety: FeasibleSet | None = None

    @property
    def status_names(self) -> list[str]:
        """The statuses in words, one per robot."""
        return Status.names(self.status)

    def __repr__(self) -> str:
        return f"SetEstimate(t={self.t:g}, sets={self.feasible_set!r}, status={Status.names(self.status[:MOST_SHOWN])})"

    @property
    def kkt(self) -> KktSolution:
        """The control u* = G theta + f at the observed active set."""
        return self.evidence.kkt

    @cached_property
    def theta(self) -> Float[Tensor, "B p"]:
        """The centroid of each set. Unlike the Chebyshev centre it does not jump along an elongated set."""
        return self.feasible_set.centroid()


@dataclass(frozen=True)
class SetEstimates:
    """The sets at S times, one after the other. `estimates[s]` is the `SetEstimate` of time s.

    Attributes:
        t: times [s], on the CPU.
        sets: all sets Theta of all robots that there were, batch (K,).
        which: for each time and robot, its place in `sets`.
        evidence: the evidence of the S*B samples, time by time.
        informative: see `SetEstimate`.
        status: see `SetEstimate`.
        safety: see `SetEstimate`. It comes with single times only.
    """

    t: Float[Tensor, "S"]
    sets: FeasibleSet
    which: Int[Tensor, "S B"]
    evidence: Evidence
    informative: Bool[Tensor, "S B"]
    status: Int[Tensor, "S B"]
    safety: FeasibleSet | None = None

    @classmethod
    def of(cls, estimate: SetEstimate) -> SetEstimates:
        """An estimate as those of one time."""
        return cls(
            torch.tensor([estimate.t], dtype=torch.float64),
            estimate.feasible_set,
            torch.arange(len(estimate.status), device=estimate.status.device).unsqueeze(0),
            estimate.evidence,
            estimate.informative.unsqueeze(0),
            estimate.status.unsqueeze(0),
            estimate.safety,
        )

    @property
    def kkt(self) -> KktSolution:
        """See `SetEstimate`, for the S*B samples."""
        return self.evidence.kkt

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, s: int) -> SetEstimate:
        sets, evidence, (samples, robots) = self.sets, self.evidence, self.which.shape
        if samples > 1:
            place = range(samples)[s] * robots
            sets, evidence = (
                sets.select(self.which[s]),
                evidence.select(torch.arange(place, place + robots, device=self.status.device)),
            )
        return SetEstimate(self.t.tolist()[s], sets, evidence, self.informative[s], self.status[s], self.safety)


@dataclass
class SetMembershipObserver:
    """Theta(t) for a batch of robots that share a task and barriers.

    Attributes:
        task: see `ObservationModel`.
        barriers: see `ObservationModel`.
        feasible_set: Theta, batch (B,). It starts as the prior of every robot.
        kind: see `ObservationModel`.
        noise: see `ObservationModel`.
        active_tolerance: see `ObservationModel`.
        on_inconsistent: the effect of an empty intersection. `hold` keeps the set as it was. `reset` starts again from
            the prior, for robots that change their goal: the status stays OK, the event is recorded. `raise` raises
            `InconsistentError`.
        compiled: see `evidence`. The sets are the same up to round-off.
        windows: lengths of windows over positions [s] (`identification.windows`). None: each sample is read by itself.
        outliers: the number of samples per robot that may be left unexplained. Theta holds the truth if no more of them
            break the declared model or its bounds.
        model: the declared model as one record.
        prior: the initial sets.
        status: a `Status` per robot.
        skipped: the number of samples without information, per robot.
        infeasible: the number of those at which its controller may have found its rows infeasible and relaxed them.
        events: the first ALARM and INCONSISTENT of each robot, and the times at which sets were reset.

    Raises:
        InputError: the prior is not a batch (B,) over the task's parameters; `inverse_optimal` comes without `noise`;
            `outliers` is negative, or comes with windows or `reset`.
    """

    task: Task
    barriers: Sequence[Barrier]
    feasible_set: FeasibleSet
    kind: SetKind = "inverse_optimal"
    noise: NoiseBound | None = None
    active_tolerance: float = ACTIVE_TOLERANCE
    on_inconsistent: OnInconsistent = "hold"
    compiled: bool | None = None
    windows: Sequence[float] = ()
    outliers: int = 0
    model: ObservationModel = field(init=False)
    prior: FeasibleSet = field(init=False)
    status: Int[Tensor, "B"] = field(init=False)
    skipped: Int[Tensor, "B"] = field(init=False)
    infeasible: Int[Tensor, "B"] = field(init=False)
    events: list[Event] = field(init=False, default_factory=list)
    _below: tuple[FeasibleSet, ...] = field(init=False)

    def __post_init__(self) -> None:
        require_task(self.task)
        require_prior("feasible_set", self.feasible_set, self.task)
        require_choice("on_inconsistent", self.on_inconsistent, get_args(OnInconsistent))
        self.model = ObservationModel(self.task, self.barriers, self.kind, self.noise, self.active_tolerance)
        self._windows = Windows(self.model, self.windows) if self.windows else None
        if self.outliers < 0 or (self.outliers and (self.windows or self.on_inconsistent == "reset")):
            expected = "0 with windows and where sets are reset" if self.outliers > 0 else "a number of samples"
            raise InputError("outliers", expected, self.outliers)
        self._below = (self.feasible_set,) * self.outliers
        self.prior = self.feasible_set
        self.status = torch.zeros_like(self.feasible_set.outcome)
        self.skipped = self.infeasible = torch.zeros_like(self.status)

    def update(self, measurement: Measurement) -> SetEstimate:
        """Take in one measurement of all robots.

        Raises:
            InputError: see `evidence`, or the robots were measured at different times.
            InconsistentError: an intersection is empty, and `on_inconsistent` is `raise`.
        """
        if len(measurement.x) != len(self.status):
            raise InputError("measurement", f"{len(self.status)} robots", tuple(measurement.x.shape))
        return self._take_in(measurement)[0]

    def read(self, samples: Measurement) -> Iterator[SetEstimates]:
        """Take in several measurements of all robots, concatenated in the order of time.

        The sets are those of `update`. If what the samples say does not depend on the sets (`depends_on_theta`), it is
        computed for all of them at once, and their estimates come together. Otherwise estimates come one by one.

        Raises:
            InputError: see `update`.
            InconsistentError: see `update`. It is raised when all estimates before that sample have been returned.
        """
        robots = len(self.status)
        if len(samples.x) > robots and not depends_on_theta(self.model, samples.observed_only(), robots):
            windows = copy(self._windows)
            try:
                yield self._take_in(samples)
                return
            except InconsistentError:  # nothing was taken in: find the sample
                self._windows = windows
        for sample in one_by_one(samples, robots):
            yield self._take_in(sample)

    def _take_in(self, samples: Measurement) -> SetEstimates:
        robots, reset = len(self.status), self.on_inconsistent == "reset"
        times = times_of(samples, robots)
        shape = len(times), robots
        read = partial(evidence, self.model) if self._windows is None else self._windows.read
        found = read(self.feasible_set, samples, self.compiled)
        omega = possible(found) if self.outliers else found.omega
        course = Course((*self._below, self.feasible_set), omega, times, found.alarmed)
        course.run(self.prior if reset else None, contradicting)
        status = self.status.expand(shape)
        if course.proofs or course.any_alarm:
            status = self._report(times, found, course)
        *below, self.feasible_set = course.levels
        self._below, self.status = tuple(below), status[-1]
        informative = found.informative.view(shape)
        self.skipped = self.skipped + (~informative).sum(0)
        self.infeasible = self.infeasible + found.infeasible.view(shape).sum(0)
        explained = informative & course.explained
        return SetEstimates(times, joined(course.parts), course.which, found, explained, status)

    @property
    def windows_used(self) -> dict[float, float]:
        """For each length [s], the share of windows that were used."""
        if self._windows is None:
            return {}
        share = self._windows.used / self._windows.ended.clamp(min=1)
        return dict(zip(self.windows, share.tolist(), strict=True))

    @property
    def unexplained(self) -> Int[Tensor, "B"]:
        """How many samples of each robot are left unexplained, at least: up to `outliers`."""
        return sum((level.is_empty.long() for level in self._below), start=torch.zeros_like(self.status))

    def set_aside(self) -> list[SetAside]:
        """The samples that are left unexplained, robot by robot, in the order of time."""
        return set_aside((*self._below, self.feasible_set))

    def _report(self, times: Tensor, found: Evidence, course: Course) -> Tensor:
        """Record what went wrong for the first time. Returns the status after each sample.

        Raises:
            InconsistentError: a set is empty, and that is asked for. If there are several samples, nothing was changed.
        """
        reset, robots, lost = self.on_inconsistent == "reset", len(self.status), course.lost
        alarmed = found.alarmed.view(lost.shape)
        if self.outliers:  # alarms among outliers empty a level, those beyond the q the last one
            alarmed, lost = alarmed & lost, lost & ~alarmed
        raised = torch.where(alarmed, int(Status.ALARM), self.status)
        raised = raised if reset else torch.where(lost, int(Status.INCONSISTENT), raised)
        status = torch.maximum(raised.cummax(0).values, self.status)
        before = torch.cat([self.status.unsqueeze(0), status[:-1]])
        events = []
        for s, robot in (alarmed & (before < Status.ALARM)).nonzero().tolist():
            row = int(found.slack[s * robots + robot].argmin())
            events.append((s, Event(float(times[s]), robot, Status.ALARM, ((float(times[s]), row),))))
        for s, robot in (lost & (before < Status.INCONSISTENT)).nonzero().tolist():
            proof = course.proofs[s, robot]
            events.append((s, Event(float(times[s]), robot, Status.INCONSISTENT, proof, reset)))
        stops = self.on_inconsistent == "raise" and bool(lost.any())
        if not stops or len(times) == 1:
            self.events += [event for _, event in sorted(events, key=lambda found: found[0])]
            self.status = status[-1]
        if stops:
            s, robot = lost.nonzero()[0].tolist()
            raise InconsistentError(robot, float(times[s]), course.proofs[s, robot])
        return status


def rounded(theta: Float[Tensor, "B p"]) -> list[list[float]]:
    """The first parameters of a batch with four digits, for a line of text."""
    return [[float(f"{value:.4g}") for value in row] for row in theta[:MOST_SHOWN].tolist()]


def require_prior(name: str, prior: Any, task: Task) -> None:
    """Check the prior of a batch of robots.

    Raises:
        InputError: it is no batch (B,) of sets over the task's parameters.
    """
    p = len(task.parameter_names)
    expected = f"a FeasibleSet for each robot, a batch (B,) over the task's {p} parameters"
    if not isinstance(prior, FeasibleSet):
        raise InputError(name, f"{expected}, e.g. FeasibleSet.from_box(lower, upper) of (B, {p})", repr(prior))
    if len(prior.batch_shape) != 1 or prior.dim != p:
        raise InputError(name, expected, f"batch {tuple(prior.batch_shape)} over {prior.dim}")


def contradicting(sets: FeasibleSet, item: int) -> tuple[tuple[float, int], ...]:
    """The rows that contradict each other in an EMPTY item, as (time, source)."""
    against = sets.contradiction
    return tuple(zip(against.time[item].tolist(), against.source[item].tolist(), strict=True))
