r"""Theta and Psi under one assumption: which robots share their safety parameters.

A measurement contracts the sets (`safety_parameters`). An empty Theta or Psi means that no parameters explain the
motions, under this assumption.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchfsid.errors import InconsistentError
from torchfsid.identification.safety_parameters import Cuts, LearningModel, Possible, Reading
from torchfsid.observers.second_look import second_look
from torchfsid.observers.set_membership import Event, OnInconsistent, contradicting
from torchfsid.outcome import Status
from torchfsid.robots.measurement import Measurement
from torchfsid.sets.feasible_set import FeasibleSet

SETTLED = 20
"""Samples of a robot after which a row that had to be active is believed, if robots may change their goals. A change is
usually noticed within two."""


@dataclass(frozen=True)
class Refutation:
    """What no safety parameters explain together.

    Attributes:
        t: when this was found [s].
        robot: the robot whose own parameters are meant, or None for those of the team.
        rows: the half-planes of psi that contradict each other as (time, robot, row), without those of the prior. Empty
            if not Psi is empty, but the Theta of some robot.
        unexplained: the robots whose Theta is empty.
    """

    t: float
    robot: int | None
    rows: tuple[tuple[float, int, int], ...]
    unexplained: tuple[int, ...]


@dataclass
class SafetySets:
    """The sets of B robots, all with the same psi or each with its own.

    Attributes:
        model: the declared model.
        possible: Theta, batch (B,), and Psi, batch (1,) or (B,).
        on_inconsistent: see `SetMembershipObserver`. A reset of Theta leaves Psi as it is.
        compiled: see `evidence`.
        prior: the initial sets Theta.
        status: a `Status` per robot.
        skipped: the number of samples without information, per robot.
        infeasible: see `SetMembershipObserver`.
        events: the first ALARM and INCONSISTENT of each robot, and the times at which sets were reset.
        refutations: of Psi.
    """

    model: LearningModel
    possible: Possible
    on_inconsistent: OnInconsistent
    compiled: bool | None
    prior: FeasibleSet = field(init=False)
    status: Int[Tensor, "B"] = field(init=False)
    skipped: Int[Tensor, "B"] = field(init=False)
    infeasible: Int[Tensor, "B"] = field(init=False)
    events: list[Event] = field(init=False, default_factory=list)
    refutations: list[Refutation] = field(init=False, default_factory=list)
    _waiting: list[tuple[int, float, Cuts]] = field(init=False, default_factory=list)
    _rows: int = field(init=False, default=1)

    def __post_init__(self) -> None:
        self.prior = self.possible.theta
        self.status = torch.zeros_like(self.possible.owner)
        self.skipped = self.infeasible = torch.zeros_like(self.status)

    @property
    def robots(self) -> int:
        """The number of robots."""
        return len(self.status)

    @property
    def is_shared(self) -> bool:
        """Have all robots the same psi? (A single robot shares it with nobody.)"""
        return self.possible.psi.batch_shape[0] < self.robots

    def update(self, measurement: Measurement) -> Reading:
        """Take in one measurement of all robots.

        Raises:
            InconsistentError: no parameters explain a robot's motion, psi is not shared, and `on_inconsistent` is
                `raise`.
        """
        t, before = measurement.time, self.possible
        read = self.model.read(before, measurement, self.compiled, self.status < Status.INCONSISTENT)
        psi, self._rows = before.psi, len(read.evidence.hard)
        for then, cuts in self._believed(read.cuts, t):
            psi = cuts.apply(psi, before.owner, then)
        theta = read.theta
        if theta.any_empty or psi.any_empty or bool(read.evidence.alarmed.any()):
            theta, psi = self._report(t, read, psi)
        self.possible = replace(before, theta=theta, psi=psi)
        self.skipped = self.skipped + ~read.evidence.informative
        self.infeasible = self.infeasible + read.evidence.infeasible
        return read

    def update_all(self, measurements: Sequence[Measurement]) -> None:
        """Take in several measurements at once, which is faster. Where something is wrong, they are taken in turn."""
        if len(measurements) > 1 and self.on_inconsistent == "hold":
            together, before = Measurement.concatenate(measurements), self.possible
            tested = (self.status < Status.INCONSISTENT).repeat(len(measurements))
            read = self.model.read(before, together, self.compiled, tested)
            assert isinstance(together.t, Tensor)
            psi = read.cuts.apply(before.psi, before.owner, together.t)
            if not (read.theta.any_empty or psi.any_empty or bool(read.evidence.alarmed.any())):
                self.possible = replace(before, theta=read.theta, psi=psi)
                unused, infeasible = ~read.evidence.informative, read.evidence.infeasible
                self.skipped = self.skipped + unused.unflatten(0, (-1, self.robots)).sum(0)
                self.infeasible = self.infeasible + infeasible.unflatten(0, (-1, self.robots)).sum(0)
                return
        for measurement in measurements:
            self.update(measurement)

    def look_again(self, measurements: Sequence[Measurement], most: int) -> None:
        """Read all measurements again, for smaller sets (`second_look`). Robots that are not OK keep theirs.

        Raises:
            InconsistentError: see `update`.
        """
        if self.is_shared:
            self._look(torch.arange(self.robots), 0, measurements, most)
            return
        for robot in (self.status < Status.INCONSISTENT).nonzero().flatten().tolist():
            one = torch.tensor([robot])
            self._look(one, robot, [measurement.select(one) for measurement in measurements], most)

    def _look(self, items: Tensor, place: int, measurements: Sequence[Measurement], most: int) -> None:
        """Look again at the robots `items`, who share the Psi at `place`."""
        before, t = self.possible, measurements[-1].time
        own = Possible(before.theta.select(items), before.psi.select(torch.tensor([place])), torch.zeros_like(items))
        model = replace(self.model, noise=self.model.noise.select(items))
        after = second_look(model, own, measurements, most)
        mine = torch.isin(torch.arange(self.robots), items)
        if bool(after.is_empty.any()):
            against = contradicting(after.psi, 0) if after.psi.any_empty else ()
            robot = None if self.is_shared else place
            unexplained = tuple(items[after.theta.is_empty].tolist())
            self.refutations.append(Refutation(t, robot, self._named(against, robot), unexplained))
            if robot is not None:
                rows = contradicting(after.theta, 0) if after.theta.any_empty else ()
                self.events.append(Event(t, robot, Status.INCONSISTENT, rows))
                self.status = torch.where(mine, Status.INCONSISTENT, self.status)
                if self.on_inconsistent == "raise":
                    raise InconsistentError(robot, t, rows)
            return
        of = torch.zeros_like(self.status).index_copy(0, items, torch.arange(len(items)))
        theta = after.theta.select(of).where(mine, before.theta)
        there = torch.arange(before.psi.batch_shape[0]) == place
        psi = after.psi.select(torch.zeros_like(there, dtype=torch.long)).where(there, before.psi)
        self.possible = replace(
            before,
            theta=replace(theta, last_cut=before.theta.last_cut),
            psi=replace(psi, last_cut=before.psi.last_cut),
        )

    def _believed(self, cuts: Cuts, t: float) -> list[tuple[float, Cuts]]:
        """The half-planes that apply now, with their times. Where goals may change, `SETTLED` holds back some."""
        if self.on_inconsistent != "reset":
            return [(t, cuts)]
        due = [(then, waiting) for age, then, waiting in self._waiting if age == SETTLED]
        self._waiting = [(age + 1, then, waiting) for age, then, waiting in self._waiting if age < SETTLED]
        if bool(cuts.active.any()):
            self._waiting.append((0, t, cuts.select(cuts.active)))
        return [*due, (t, cuts.select(~cuts.active))]

    def _report(self, t: float, read: Reading, psi: FeasibleSet) -> tuple[FeasibleSet, FeasibleSet]:
        """Record what went wrong for the first time. Returns Theta and Psi with empty sets replaced."""
        theta, owner, alarmed = read.theta, self.possible.owner, read.evidence.alarmed
        lost, reset = theta.is_empty | psi.is_empty[owner], self.on_inconsistent == "reset"
        for robot in (alarmed & (self.status < Status.ALARM)).nonzero().flatten().tolist():
            row = int(read.evidence.slack[robot].argmin())
            self.events.append(Event(t, robot, Status.ALARM, ((t, row),)))
        for robot in (lost & (self.status < Status.INCONSISTENT)).nonzero().flatten().tolist():
            rows, of_theta = self._against(theta, psi, robot), bool(theta.is_empty[robot])
            self.events.append(Event(t, robot, Status.INCONSISTENT, rows, reset and of_theta))
        self._refute(t, psi.is_empty if reset else replace(self.possible, theta=theta, psi=psi).is_empty, theta, psi)
        self.status = torch.where(alarmed, self.status.clamp(min=Status.ALARM), self.status)
        self.status = torch.where(psi.is_empty[owner] if reset else lost, Status.INCONSISTENT, self.status)
        if self.on_inconsistent == "raise" and not self.is_shared and bool(lost.any()):
            robot = int(lost.int().argmax())
            raise InconsistentError(robot, t, self._against(theta, psi, robot))
        if reset:
            changed = theta.is_empty.nonzero().flatten()
            self._waiting = [(age, then, c.select(~torch.isin(c.item, changed))) for age, then, c in self._waiting]
        instead = self.prior if reset else self.possible.theta
        return theta.where(~theta.is_empty, instead), psi.where(~psi.is_empty, self.possible.psi)

    def _against(self, theta: FeasibleSet, psi: FeasibleSet, robot: int) -> tuple[tuple[float, int], ...]:
        """The rows that contradict each other in an empty Theta, or else in an empty Psi, as (time, source)."""
        if theta.is_empty[robot]:
            return contradicting(theta, robot)
        rows = contradicting(psi, int(self.possible.owner[robot]))
        return tuple((time, row) for time, _, row in self._named(rows, robot))

    def _refute(self, t: float, lost: Bool[Tensor, "G"], theta: FeasibleSet, psi: FeasibleSet) -> None:
        """Record the sets Psi that are refuted for the first time."""
        known = {refutation.robot for refutation in self.refutations}
        for place in lost.nonzero().flatten().tolist():
            robot = None if self.is_shared else place
            if robot not in known:
                against = contradicting(psi, place) if bool(psi.is_empty[place]) else ()
                unexplained = (theta.is_empty & (self.possible.owner == place)).nonzero().flatten()
                self.refutations.append(Refutation(t, robot, self._named(against, robot), tuple(unexplained.tolist())))

    def _named(self, rows: Sequence[tuple[float, int]], robot: int | None) -> tuple[tuple[float, int, int], ...]:
        """Half-planes of psi, given by time and source, as (time, robot, row). Those of the prior are left out.

        All rows of a single robot's Psi are its own.
        """
        m, team = self._rows, self.robots
        return tuple(
            (time, robot if robot is not None and not self.is_shared else source // m % team, source % m)
            for time, source in rows
            if source >= 0
        )
