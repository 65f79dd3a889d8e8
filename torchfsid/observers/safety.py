r"""The set-membership observer of robots whose safety parameters are unknown, too: gain and safety distance.

Each measurement contracts Theta of every robot and the sets Psi of safety parameters (`safety_parameters`). Two
hypotheses run side by side:

    team     all robots have the same psi. One Psi is cut by the motions of all.
    robot    each robot has a psi of its own, with a Theta of its own.

The sets shown are those of the team, until no parameters explain the motions of all. From then on they are those of
the single robots, so that one robot with other parameters does not silence the rest. `odd` names it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from jaxtyping import Int
from torch import Tensor

from torchfsid.errors import InconsistentError, InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import SetKind
from torchfsid.identification.safety_parameters import Cuts, LearningModel, Possible, Reading
from torchfsid.observers.second_look import MOST_CELLS, second_look
from torchfsid.observers.set_membership import Event, OnInconsistent, SetEstimate
from torchfsid.outcome import Status
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Task
from torchfsid.robots.unknown_avoidance import UnknownAvoidance
from torchfsid.sets.feasible_set import Facets, FeasibleSet
from torchfsid.tolerances import ACTIVE_TOLERANCE

SETTLED = 20
"""Samples of a robot after which a row that had to be active is believed, if robots may change their goals. A change is
usually noticed within two."""


@dataclass(frozen=True)
class Refutation:
    """What no safety parameters explain together.

    Attributes:
        t: when this was found [s].
        robot: the robot whose own parameters are meant, or None for those of the team.
        rows: the half-planes of psi that contradict each other as (time, robot, row), without those of the prior. None
            if not Psi is empty, but the Theta of some robot.
        unexplained: the robots whose Theta is empty.
    """

    t: float
    robot: int | None
    rows: tuple[tuple[float, int, int], ...]
    unexplained: tuple[int, ...]


@dataclass
class SafetyObserver:
    """Theta(t) and Psi(t) for a batch of robots that share a task and barriers, one of them an `UnknownAvoidance`.

    Attributes:
        task: see `ObservationModel`.
        barriers: the barriers.
        feasible_set: Theta, batch (B,). It starts as the prior of every robot.
        noise: bounds on errors.
        active_tolerance: see `ObservationModel`. It matters only for the case label.
        on_inconsistent: see `SetMembershipObserver`. A reset of Theta leaves Psi as it is.
        compiled: see `evidence`.
        model: the declared model as one record.
        prior: the initial sets Theta.
        safety: Psi of every robot, batch (B,).
        status: a `Status` per robot.
        skipped: the number of samples without information, per robot.
        events: see `SetMembershipObserver`, for the sets that are shown.
        refutations: of the team, and of single robots.

    Raises:
        InputError: the prior is not a batch (B,) over the task's parameters, or see `LearningModel`.
    """

    task: Task
    barriers: Sequence[Barrier | UnknownAvoidance]
    feasible_set: FeasibleSet
    noise: NoiseBound
    active_tolerance: float = ACTIVE_TOLERANCE
    on_inconsistent: OnInconsistent = "hold"
    compiled: bool | None = None
    kind: ClassVar[SetKind] = "inverse_optimal"
    model: LearningModel = field(init=False)
    prior: FeasibleSet = field(init=False)
    safety: FeasibleSet = field(init=False)
    status: Int[Tensor, "B"] = field(init=False)
    skipped: Int[Tensor, "B"] = field(init=False)
    refutations: list[Refutation] = field(init=False, default_factory=list)
    possible: Possible = field(init=False)
    _of: Int[Tensor, "items"] = field(init=False)
    _status: Int[Tensor, "items"] = field(init=False)
    _skipped: Int[Tensor, "items"] = field(init=False)
    _events: list[Event] = field(init=False, default_factory=list)
    _model_rows: int = field(init=False, default=1)
    _shown: tuple[FeasibleSet | None, FeasibleSet | None] = field(init=False, default=(None, None))
    _waiting: list[tuple[int, float, Cuts]] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        p, shape = len(self.task.parameter_names), self.feasible_set.batch_shape
        if len(shape) != 1 or self.feasible_set.dim != p:
            actual = (*shape, self.feasible_set.dim)
            raise InputError("feasible_set", f"a batch (B,) of sets over the task's {p} parameters", actual)
        self.model = LearningModel(self.task, self.barriers, self.noise, self.active_tolerance)
        self.prior, robots = self.feasible_set, torch.arange(shape[0])
        unknown = self.model.unknown
        alone = Possible(self.prior, unknown.prior(shape[0]), robots)
        self._of, self.possible = robots, alone
        if unknown.shared == "team":
            owner = torch.cat([torch.zeros_like(robots), robots + 1])
            self._of = torch.cat([robots, robots])
            self.possible = Possible(self.prior.select(self._of), unknown.prior(shape[0] + 1), owner)
        self._status, self._skipped = torch.zeros_like(self._of), torch.zeros_like(self._of)
        self._show()

    @property
    def robots(self) -> int:
        """The number of robots."""
        return self.prior.batch_shape[0]

    @property
    def is_shared(self) -> bool:
        """Are the sets shown those of a team with the same parameters?"""
        return len(self._of) > self.robots

    @property
    def events(self) -> list[Event]:
        """The first ALARM and INCONSISTENT of each robot, and the times at which sets were reset."""
        return [event for event in self._events if event.robot < self.robots]

    @property
    def present_barriers(self) -> list[Barrier]:
        """The barriers of all robots, with the typical parameters of their Psi."""
        return list(self.model.given(self.safety.vertices().detach()).barriers)

    def update(self, measurement: Measurement) -> SetEstimate:
        """Take in one measurement of all robots.

        Raises:
            InputError: see `evidence`, or the robots were measured at different times.
            InconsistentError: no parameters explain a robot's motion, and `on_inconsistent` is `raise`.
        """
        t, before = measurement.time, self.possible
        many = measurement.select(self._of) if self.is_shared else measurement
        read = self.model.read(before, many, self.compiled, self._status < Status.INCONSISTENT)
        psi, self._model_rows = before.psi, read.evidence.slack.shape[-1]
        for then, cuts in self._believed(read.cuts, t):
            psi = cuts.apply(psi, before.owner, then)
        informative = read.evidence.informative
        if read.theta.any_empty or psi.any_empty or bool(read.evidence.alarmed.any()):
            informative = informative & ~read.theta.is_empty
            theta, psi = self._report(t, read, psi)
        else:
            theta = read.theta
        self.possible = Possible(theta, psi, before.owner)
        self._skipped = self._skipped + ~read.evidence.informative
        evidence, shown = read.evidence, torch.arange(self.robots)
        if self.is_shared:
            if any(refutation.robot is None for refutation in self.refutations):
                shown = shown + self.robots
                self._fall_back()
            evidence, informative = evidence.select(shown), informative[shown]
        self._show()
        return SetEstimate(t, self.feasible_set, evidence, informative, self.status, self.safety)

    def look_again(self, measurements: Sequence[Measurement], most: int = MOST_CELLS) -> None:
        """Read all measurements again, for smaller sets (`second_look`). Theta and Psi never grow.

        Nothing happens where goals may change. Robots that are not `ok` keep their sets. If it turns out that no
        parameters explain the team's motions, the sets of the single robots take their place.

        Args:
            measurements: what the observer has taken in.
            most: the largest number of cells into which each Psi is split.
        """
        if self.on_inconsistent == "reset" or len(measurements) == 0:
            return
        t = measurements[-1].time
        if self.is_shared:
            self._look(torch.arange(self.robots), 0, measurements, t, most)
            if any(refutation.robot is None for refutation in self.refutations):
                self._fall_back()
        if not self.is_shared:
            for robot in (self._status < Status.INCONSISTENT).nonzero().flatten().tolist():
                one = torch.tensor([robot])
                self._look(one, robot, [measurement.select(one) for measurement in measurements], t, most)
        self._show()

    def _look(self, items: Tensor, place: int, measurements: Sequence[Measurement], t: float, most: int) -> None:
        """Look again at the items that share the Psi at `place`."""
        before, mine = self.possible, torch.isin(torch.arange(len(self._of)), items)
        own = Possible(before.theta.select(items), before.psi.select(torch.tensor([place])), torch.zeros_like(items))
        after = second_look(self.model, own, measurements, most)
        if bool(after.is_empty.any()):
            robot = None if self.is_shared else place
            against = _rows(after.psi.contradiction, 0) if after.psi.any_empty else ()
            unexplained = tuple(items[after.theta.is_empty].tolist())
            self.refutations.append(Refutation(t, robot, self._named(against, robot), unexplained))
            if robot is not None:
                rows = _rows(after.theta.contradiction, 0) if after.theta.any_empty else ()
                self._events.append(Event(t, robot, Status.INCONSISTENT, rows))
                self._status = torch.where(mine, Status.INCONSISTENT, self._status)
            return
        of = torch.zeros_like(self._of).index_copy(0, items, torch.arange(len(items)))
        theta = after.theta.select(of).where(mine, before.theta)
        there = torch.arange(before.psi.batch_shape[0]) == place
        psi = after.psi.select(torch.zeros(len(there), dtype=torch.long)).where(there, before.psi)
        psi = replace(psi, last_cut=before.psi.last_cut)
        self.possible = Possible(replace(theta, last_cut=before.theta.last_cut), psi, before.owner)

    def odd(self) -> list[int]:
        """The robots without whom all others can have the same parameters. Empty if there is none, or no need."""
        if self.is_shared or not any(refutation.robot is None for refutation in self.refutations):
            return []
        found, trusted = [], (self.status < Status.INCONSISTENT).tolist()
        facets = self.safety.facets().halfspaces
        for robot in range(self.robots):
            others = [i for i in range(self.robots) if i != robot and trusted[i]]
            if others:
                first = self.safety.select(torch.tensor(others[:1]))
                rows = Halfspaces(facets.A[others].flatten(0, 1)[None], facets.b[others].flatten()[None])
                if not first.intersect(rows).any_empty:
                    found.append(robot)
        return found

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
        lost = theta.is_empty | psi.is_empty[owner]
        reset = self.on_inconsistent == "reset"
        for item in (alarmed & (self._status < Status.ALARM)).nonzero().flatten().tolist():
            row = int(read.evidence.slack[item].argmin())
            self._events.append(Event(t, item, Status.ALARM, ((t, row),)))
        against = theta.contradiction
        for item in (lost & (self._status < Status.INCONSISTENT)).nonzero().flatten().tolist():
            rows = () if not theta.is_empty[item] else _rows(against, item)
            self._events.append(Event(t, item, Status.INCONSISTENT, rows, reset and bool(theta.is_empty[item])))
            if self.on_inconsistent == "raise" and not (self.is_shared and item < self.robots):
                robot = int(self._of[item])
                raise InconsistentError(f"robot {robot} at t = {t}: no parameters explain the measurements; {rows}")
        self._refute(t, theta, psi)
        self._status = torch.where(alarmed, self._status.clamp(min=Status.ALARM), self._status)
        contradicted = psi.is_empty[owner] if reset else lost
        self._status = torch.where(contradicted, Status.INCONSISTENT, self._status)
        if reset:
            changed = theta.is_empty.nonzero().flatten()
            self._waiting = [(age, then, c.select(~torch.isin(c.item, changed))) for age, then, c in self._waiting]
        instead = self.prior.select(self._of) if reset else self.possible.theta
        return theta.where(~theta.is_empty, instead), psi.where(~psi.is_empty, self.possible.psi)

    def _refute(self, t: float, theta: FeasibleSet, psi: FeasibleSet) -> None:
        """Record the sets Psi that are refuted for the first time."""
        owner = self.possible.owner
        lost = psi.is_empty if self.on_inconsistent == "reset" else Possible(theta, psi, owner).is_empty
        known = {refutation.robot for refutation in self.refutations}
        for place in lost.nonzero().flatten().tolist():
            robot = None if self.is_shared and place == 0 else place - self.is_shared
            if robot in known:
                continue
            against = _rows(psi.contradiction, place) if bool(psi.is_empty[place]) else ()
            unexplained = (theta.is_empty & (owner == place)).nonzero().flatten()
            self.refutations.append(
                Refutation(t, robot, self._named(against, robot), tuple(self._of[unexplained].tolist()))
            )

    def _named(self, rows: tuple[tuple[float, int], ...], robot: int | None) -> tuple[tuple[float, int, int], ...]:
        """Half-planes of psi, given by time and source, as (time, robot, row). Those of the prior are left out.

        All rows of a single robot's Psi are its own.
        """
        m, team = self._model_rows, self.robots
        return tuple(
            (t, source // m % team if robot is None else robot, source % m) for t, source in rows if source >= 0
        )

    def _fall_back(self) -> None:
        """Go on with the sets of the single robots."""
        alone = torch.arange(self.robots) + self.robots
        possible = self.possible
        psi = possible.psi.select(possible.owner[alone])
        self.possible = Possible(possible.theta.select(alone), psi, torch.arange(self.robots))
        self._of, self._status, self._skipped = self._of[alone], self._status[alone], self._skipped[alone]
        self._events = [replace(e, robot=e.robot - self.robots) for e in self._events if e.robot >= self.robots]
        self._waiting = []

    def _show(self) -> None:
        """Bring the public attributes up to date. Sets that have not changed are the same objects as before."""
        theta, psi, owner = self.possible.theta, self.possible.psi, self.possible.owner
        if self.is_shared:
            shown = torch.arange(self.robots)
            if theta is not self._shown[0]:
                self.feasible_set = theta.select(shown)
            if psi is not self._shown[1]:
                self.safety = psi.select(owner[shown])
            self.status, self.skipped = self._status[: self.robots], self._skipped[: self.robots]
        else:
            self.feasible_set, self.safety, self.status, self.skipped = theta, psi, self._status, self._skipped
        self._shown = (theta, psi)


def _rows(against: Facets, place: int) -> tuple[tuple[float, int], ...]:
    """The rows that contradict each other, as (time, source)."""
    return tuple(zip(against.time[place].tolist(), against.source[place].tolist(), strict=True))
