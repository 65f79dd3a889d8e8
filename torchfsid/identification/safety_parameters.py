r"""Safety parameters psi learned together with theta: which (psi, theta_1, ..., theta_B) explain the motions?

While it is fixed which rows may be active, psi and theta do not occur in one formula. So the solutions lie in a product
Psi x Theta_1 x ... x Theta_B, whose factors are contracted in turn (docs/theory.md proves each rule):

    1. a hard row is kept:            Psi  <-  Psi  ^  { w_j >= low_j }
    2. the rows that may be active for some psi in Psi, J = { j : min w_j <= high_j }, are the generators:
                                      Theta_i  <-  Theta_i  ^  InverseOptimal(J)
    3. an empty Theta_i or Psi: no parameters explain the motions
    4. if Theta_i ^ InverseOptimal(J without j) is empty, row j must be active:
                                      Psi  <-  Psi  ^  { w_j <= high_j }

Only rule 4 bounds Psi on the permissive side. The true psi stays in Psi and the true theta_i in Theta_i whenever the
declared model and bounds hold. Psi, low, high and w are those of `robots.unknown_avoidance` and `avoidance_within`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.by_robot import by_robot
from torchfsid.identification.evidence import Evidence, ObservationModel, evidence
from torchfsid.identification.inverse_optimal import per_row
from torchfsid.outcome import Status
from torchfsid.robots.arguments import require_barriers, require_task
from torchfsid.robots.avoidance_within import AvoidanceWithin, SafetyRows
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import ErrorBounds, NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Task
from torchfsid.robots.unknown_avoidance import UnknownAvoidance
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.tolerances import ACTIVE_TOLERANCE


@dataclass(frozen=True)
class Possible:
    """The sets in which psi and theta lie.

    Attributes:
        theta: Theta of each robot, batch (B,).
        psi: sets of safety parameters, batch (G,).
        owner: the place of each robot's psi in this batch.
    """

    theta: FeasibleSet
    psi: FeasibleSet
    owner: Int[Tensor, "B"]

    @property
    def is_empty(self) -> Bool[Tensor, "G"]:
        """Does no parameter explain the motions of the robots that share a psi (rule 3)?"""
        lost = self.theta.is_empty
        return self.psi.is_empty.scatter_reduce(0, self.owner, lost, "amax") if bool(lost.any()) else self.psi.is_empty


@dataclass(frozen=True)
class Cuts:
    """Half-planes of psi: w_j >= low_j for rows that are kept, w_j <= high_j for rows that must be active.

    Attributes:
        rows: k half-planes. `source` is item * m + j for row j of the m rows of an item.
        item: the item that each comes from, a robot or a robot's sample.
        active: whether it is w_j <= high_j.
    """

    rows: Halfspaces
    item: Int[Tensor, "k"]
    active: Bool[Tensor, "k"]

    @classmethod
    def none(cls) -> Cuts:
        """No half-planes."""
        none = torch.zeros(0, dtype=torch.long)
        return cls(Halfspaces(torch.zeros(0, 2), torch.zeros(0), none), none, none.bool())

    def select(self, which: Bool[Tensor, "k"]) -> Cuts:
        """Some of the half-planes."""
        source = None if self.rows.source is None else self.rows.source[which]
        return Cuts(Halfspaces(self.rows.A[which], self.rows.b[which], source), self.item[which], self.active[which])

    def apply(self, psi: FeasibleSet, owner: Int[Tensor, "B"], times: float | Float[Tensor, "items"]) -> FeasibleSet:
        """The part of each Psi inside its own half-planes. `times` are those of the items [s]."""
        if len(self.item) == 0:
            return psi
        assert self.rows.source is not None
        A, b, source, items = self.rows.A, self.rows.b, self.rows.source, self.item
        sets = psi.batch_shape[0]
        if sets == 1:
            stamps = times[items] if isinstance(times, Tensor) else times
            return psi.intersect(Halfspaces(A[None], b[None], source[None]), stamps)
        of = owner[items % len(owner)]
        order = of.argsort(stable=True)
        of, items, counts = of[order], items[order], torch.bincount(of, minlength=sets)
        place, most = torch.arange(len(of), device=of.device) - (counts.cumsum(0) - counts)[of], int(counts.max())
        rows = Halfspaces(
            A.new_zeros(sets, most, 2).index_put((of, place), A[order]),
            b.new_ones(sets, most).index_put((of, place), b[order]),
            torch.full((sets, most), -1).index_put((of, place), source[order]),
        )
        if not isinstance(times, Tensor):
            return psi.intersect(rows, times)
        return psi.intersect(rows, A.new_full((sets, most), torch.nan).index_put((of, place), times[items]))


@dataclass(frozen=True)
class Reading:
    """What a measurement says about theta and psi.

    Attributes:
        theta: Theta of each robot after the measurement.
        cuts: the half-planes of psi, those only that cut it.
        evidence: the evidence about theta.
        undecided: for each item and row of the unknown barrier, whether Psi leaves open that the row is active.
        rows: what the rows of the unknown barrier say about psi.
    """

    theta: FeasibleSet
    cuts: Cuts
    evidence: Evidence
    undecided: Bool[Tensor, "items m"]
    rows: SafetyRows


@dataclass(frozen=True)
class LearningModel:
    """A declared model of robots, one of whose barriers has unknown safety parameters.

    Attributes:
        task: the task of all robots.
        barriers: the barriers. Exactly one of them is an `UnknownAvoidance`.
        noise: bounds on errors.
        active_tolerance: see `ObservationModel`.

    Raises:
        InputError: not exactly one barrier has unknown parameters, or see `ObservationModel`.
    """

    task: Task
    barriers: Sequence[Barrier | UnknownAvoidance]
    noise: NoiseBound
    active_tolerance: float = ACTIVE_TOLERANCE

    def __post_init__(self) -> None:
        require_task(self.task)
        require_barriers(self.barriers)
        if not isinstance(self.noise, NoiseBound):
            raise InputError("noise", "a bound, e.g. NoiseBound(velocity=0.02)", repr(self.noise))
        unknown = [barrier for barrier in self.barriers if isinstance(barrier, UnknownAvoidance)]
        if len(unknown) != 1:
            raise InputError("barriers", "exactly one UnknownAvoidance", len(unknown))

    @property
    def unknown(self) -> UnknownAvoidance:
        """The barrier with unknown parameters."""
        return next(barrier for barrier in self.barriers if isinstance(barrier, UnknownAvoidance))

    def given(self, psi: Float[Tensor, "B v 2"]) -> ObservationModel:
        """The model of robots whose psi lies in the hull of these vertices."""
        barriers = [AvoidanceWithin(b, psi) if isinstance(b, UnknownAvoidance) else b for b in self.barriers]
        return ObservationModel(self.task, barriers, "inverse_optimal", self.noise, self.active_tolerance)

    def read(
        self,
        possible: Possible,
        measurement: Measurement,
        compiled: bool | None = None,
        tested: Bool[Tensor, "items"] | None = None,
    ) -> Reading:
        """Rules 1, 2 and 4 for one measurement of the robots, or for several samples concatenated.

        Args:
            possible: the sets so far. None is EMPTY.
            measurement: the measurement.
            compiled: see `evidence`.
            tested: the items to which rule 4 applies; default all.
        """
        measurement, robots = measurement.observed_only(), len(possible.owner)
        corners = possible.psi.vertices().detach()[possible.owner].repeat(len(measurement.x) // max(robots, 1), 1, 1)
        model = self.given(corners)
        found = evidence(model, possible.theta, measurement, compiled)
        theta = possible.theta.intersect(*by_robot(found.omega, measurement.t, robots))

        place = next(i for i, b in enumerate(self.barriers) if isinstance(b, UnknownAvoidance))
        within = model.barriers[place]
        assert isinstance(within, AvoidanceWithin)
        first = sum(model.barriers[i](measurement).rows for i in range(place))
        rows = within.safety_rows(measurement, *self._bounds(measurement, robots))
        undecided = rows.undecided & found.informative.unsqueeze(-1)
        if theta.any_empty:
            undecided = undecided & ~theta.is_empty.repeat(len(measurement.x) // max(robots, 1)).unsqueeze(-1)
        tests = undecided if tested is None else undecided & tested.unsqueeze(-1)
        must = _must_be_active(tests, found, theta, first)
        kept = rows.cuts & found.informative.unsqueeze(-1) & (not self.unknown.soft)
        return Reading(theta, _cuts(rows, kept, must, len(found.hard), first), found, undecided & ~must, rows)

    def _bounds(self, measurement: Measurement, robots: int) -> tuple[ErrorBounds, Tensor]:
        noise = self.noise.of_samples(robots, len(measurement.x))
        errors = ErrorBounds.of(measurement, noise) or ErrorBounds.none(measurement)
        slack = per_row(noise.slack, measurement.x)
        if measurement.velocity_error is not None:
            slack = slack + measurement.velocity_error.unsqueeze(-1)
        return errors, slack


def active_halfplanes(rows: SafetyRows, items: Int[Tensor, "k"], row: Int[Tensor, "k"]) -> Halfspaces:
    """The half-planes w_j <= high_j of some rows of some items, k rows."""
    q = rows.active_q[items, row]
    return Halfspaces(torch.stack([q, -torch.ones_like(q)], dim=-1), rows.high[items, row])


def _cuts(rows: SafetyRows, kept: Bool[Tensor, "items m"], must: Bool[Tensor, "items m"], m: int, first: int) -> Cuts:
    """The half-planes of the rows that are kept, and of those that must be active, of a model with m rows."""
    if not (bool(kept.any()) or bool(must.any())):
        return Cuts.none()
    (item, row), (active_item, active_row) = kept.nonzero().unbind(-1), must.nonzero().unbind(-1)
    q, active = rows.kept_q[item, row], active_halfplanes(rows, active_item, active_row)
    A = torch.cat([torch.stack([-q, torch.ones_like(q)], dim=-1), active.A])
    b, items = torch.cat([-rows.low[item, row], active.b]), torch.cat([item, active_item])
    source = items * m + first + torch.cat([row, active_row])
    return Cuts(Halfspaces(A, b, source), items, torch.arange(len(items), device=items.device) >= len(item))


def _must_be_active(
    tests: Bool[Tensor, "items m"], found: Evidence, theta: FeasibleSet, first: int
) -> Bool[Tensor, "items m"]:
    """Rule 4: the rows without which no theta explains the motion."""
    must = torch.zeros_like(tests)
    if not bool(tests.any()):
        return must
    items, rows = tests.nonzero().unbind(-1)
    with torch.no_grad():
        robot = items % theta.batch_shape[0]
        omega = found.omega_without(items, rows + first)
        corners = theta.vertices()[robot]
        explained = (omega.A @ corners.mT <= omega.b.unsqueeze(-1)).all(-2).any(-1)
        left = (~explained).nonzero().flatten()
        if len(left):
            sets = theta.select(robot[left]).intersect(Halfspaces(omega.A[left], omega.b[left]))
            must[items[left], rows[left]] = sets.outcome == Status.EMPTY
    return must
