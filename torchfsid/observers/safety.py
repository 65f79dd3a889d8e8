r"""The set-membership observer of robots whose safety parameters are unknown, too: gain and safety distance.

Two assumptions run side by side (`safety_sets`):

    team     all robots have the same psi. One Psi is cut by the motions of all.
    robot    each robot has a psi of its own, and with it a Theta of its own.

The sets shown are those of the team, until no parameters explain the motions of all. From then on they are those of
the single robots, so that one robot with other parameters does not silence the rest. `odd` names it. Until then the
single robots' sets may lag behind by a few samples, which are read together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Int
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.safety_parameters import LearningModel, Possible, Reading
from torchfsid.observers.blocks import one_by_one
from torchfsid.observers.safety_sets import Refutation, SafetySets
from torchfsid.observers.second_look import MOST_CELLS
from torchfsid.observers.set_membership import (
    Event,
    OnInconsistent,
    SetEstimate,
    SetEstimates,
    SetMembershipObserver,
    require_prior,
)
from torchfsid.outcome import Status
from torchfsid.robots.arguments import require_task
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Task
from torchfsid.robots.unknown_avoidance import UnknownAvoidance
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.tolerances import ACTIVE_TOLERANCE

LAG = 64
"""Samples by which the single robots' sets may lag behind while those of the team are shown."""


@dataclass
class SafetyObserver:
    """Theta(t) and Psi(t) for a batch of robots that share a task and barriers, one of them an `UnknownAvoidance`.

    Attributes:
        task: see `ObservationModel`.
        barriers: the barriers.
        prior: Theta of every robot at the start, batch (B,).
        noise: bounds on errors.
        active_tolerance: see `ObservationModel`. It matters only for the case label.
        on_inconsistent: see `SetMembershipObserver`. A reset of Theta leaves Psi as it is.
        compiled: see `evidence`.
        model: the declared model as one record.
        refutations: of the team, and of single robots.

    Raises:
        InputError: the prior is not a batch (B,) over the task's parameters, or see `LearningModel`.
    """

    task: Task
    barriers: Sequence[Barrier | UnknownAvoidance]
    prior: FeasibleSet
    noise: NoiseBound
    active_tolerance: float = ACTIVE_TOLERANCE
    on_inconsistent: OnInconsistent = "hold"
    compiled: bool | None = None
    model: LearningModel = field(init=False)
    _team: SafetySets | None = field(init=False, default=None)
    _alone: SafetySets = field(init=False)
    _refuted: list[Refutation] = field(init=False, default_factory=list)
    _unread: list[Measurement] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        require_task(self.task)
        require_prior("prior", self.prior, self.task)
        shape = self.prior.batch_shape
        self.model = LearningModel(self.task, self.barriers, self.noise, self.active_tolerance)
        robots, unknown = torch.arange(shape[0]), self.model.unknown
        alone = Possible(self.prior, unknown.prior(shape[0]), robots)
        self._alone = SafetySets(self.model, alone, self.on_inconsistent, self.compiled)
        if unknown.shared == "team" and shape[0] > 1:
            team = Possible(self.prior, unknown.prior(1), torch.zeros_like(robots))
            self._team = SafetySets(self.model, team, self.on_inconsistent, self.compiled)

    @property
    def robots(self) -> int:
        """The number of robots."""
        return self.prior.batch_shape[0]

    @property
    def kind(self) -> str:
        """The kind of the half-spaces of theta."""
        return "inverse_optimal"

    @property
    def is_shared(self) -> bool:
        """Are the sets shown those of a team with the same parameters?"""
        return self.model.unknown.shared == "team" and not self.team_is_refuted

    @property
    def team_is_refuted(self) -> bool:
        """Was it found that the robots have no safety parameters in common?"""
        return len(self._refuted) > 0

    @property
    def possible(self) -> Possible:
        """The sets shown: Theta of every robot, and Psi of the team or of every robot."""
        return self._shown.possible

    @property
    def of_single_robots(self) -> Possible:
        """The sets of robots that share nothing: Theta of every robot, and Psi of every robot."""
        self._catch_up()
        return self._alone.possible

    @property
    def feasible_set(self) -> FeasibleSet:
        """Theta of every robot, batch (B,)."""
        return self.possible.theta

    @property
    def safety(self) -> FeasibleSet:
        """Psi of every robot, batch (B,). For a team these are B times the same."""
        psi = self.possible.psi
        return psi if psi.batch_shape[0] == self.robots else psi.select(self.possible.owner)

    @property
    def status(self) -> Int[Tensor, "B"]:
        """A `Status` per robot."""
        return self._shown.status

    @property
    def skipped(self) -> Int[Tensor, "B"]:
        """The number of samples without information, per robot."""
        return self._shown.skipped

    @property
    def infeasible(self) -> Int[Tensor, "B"]:
        """See `SetMembershipObserver`."""
        return self._shown.infeasible

    @property
    def events(self) -> list[Event]:
        """See `SetMembershipObserver`, for the sets that are shown."""
        return self._shown.events

    @property
    def refutations(self) -> list[Refutation]:
        return [*self._refuted, *self._alone.refutations]

    @property
    def present_barriers(self) -> list[Barrier]:
        """The barriers of all robots, with the typical parameters of their Psi."""
        corners = self.possible.psi.vertices().detach()[self.possible.owner]
        return list(self.model.given(corners).barriers)

    def update(self, measurement: Measurement) -> SetEstimate:
        """Take in one measurement of all robots.

        Raises:
            InputError: see `evidence`, or the robots were measured at different times.
            InconsistentError: no parameters explain a robot's motion, and `on_inconsistent` is `raise`.
        """
        read = self._read(measurement)
        informative = read.evidence.informative & ~read.theta.is_empty
        psi = self.possible.psi
        return SetEstimate(measurement.time, self.feasible_set, read.evidence, informative, self.status, psi)

    def read(self, samples: Measurement) -> Iterator[SetEstimates]:
        """Take in several measurements of all robots, concatenated in the order of time. Estimates come one by one.

        Raises:
            InputError: see `update`.
            InconsistentError: see `update`.
        """
        for sample in one_by_one(samples, self.robots):
            yield SetEstimates.of(self.update(sample))

    def look_again(self, measurements: Sequence[Measurement], most: int = MOST_CELLS) -> None:
        """Read all measurements again, for smaller sets (`second_look`). Theta and Psi never grow.

        Nothing happens where goals may change. Robots that are not OK keep their sets. If it turns out that no
        parameters explain the team's motions, the sets of the single robots take their place.

        Args:
            measurements: what the observer has taken in.
            most: the largest number of cells into which each Psi is split.

        Raises:
            InconsistentError: see `update`.
        """
        if self.on_inconsistent == "reset" or len(measurements) == 0:
            return
        if self._team is not None:
            self._team.look_again(measurements, most)
            if self._team.refutations:
                self._catch_up()
                self._fall_back()
        if self._team is None:
            self._alone.look_again(measurements, most)

    def odd(self) -> list[int]:
        """The robots without whom all others can have the same parameters. Empty if there is none, or no need.

        While the sets Psi are wide, several robots may be named. `look_again` narrows them.
        """
        if not self.team_is_refuted:
            return []
        found, lost = [], (self.status >= Status.INCONSISTENT).nonzero().flatten().tolist()
        facets = self.safety.facets().halfspaces
        for robot in range(self.robots):
            others = [i for i in range(self.robots) if i != robot]
            if others and not set(lost) - {robot}:
                rows = Halfspaces(facets.A[others].flatten(0, 1)[None], facets.b[others].flatten()[None])
                if not self.safety.select(torch.tensor(others[:1])).intersect(rows).any_empty:
                    found.append(robot)
        return found

    @property
    def _shown(self) -> SafetySets:
        return self._alone if self._team is None else self._team

    def _read(self, measurement: Measurement) -> Reading:
        if self._team is None:
            return self._alone.update(measurement)
        read = self._team.update(measurement)
        if self._team.refutations:
            self._catch_up()
            self._fall_back()
            return self._alone.update(measurement)
        self._unread.append(measurement)
        if len(self._unread) >= (LAG if self.on_inconsistent == "hold" else 1):
            self._catch_up()
        return read

    def _catch_up(self) -> None:
        """Let the single robots' sets take in the samples that they have not."""
        self._alone.update_all(self._unread)
        self._unread = []

    def _fall_back(self) -> None:
        """Go on with the sets of the single robots."""
        assert self._team is not None
        self._refuted, self._team = self._team.refutations[:1], None


SetObserver = SetMembershipObserver | SafetyObserver
"""An observer of sets, with known or unknown safety parameters."""
