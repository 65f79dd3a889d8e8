r"""The set-membership observer: for each robot and at every moment, the set in which theta must lie.

Per measurement, for all robots in one batch: the barriers give the rows A u <= b, the task gives (C, d), the motion
shows which rows are active, the KKT conditions become half-spaces, and Theta(t) is what they leave of Theta(t-).

What can go wrong with data is reported, never hidden in the set:
    - an empty intersection: the set stays as it was and the robot's status becomes INCONSISTENT, or, if it is known
      that robots change their minds, the set starts again from the prior;
    - a hard row violated by more than its bound: model or bounds are wrong, the sample is not used, status ALARM;
    - a controller that failed (it commands exactly zero, see `controller_failed`), a robot or a neighbour's velocity
      not measured, a body left out that could matter (`neighbours`): the sample says nothing, is skipped and counted.
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
from torchfsid.halfspaces import Halfspaces, finite
from torchfsid.identification.evidence import Bounds, Model, Reading, SetKind, read
from torchfsid.identification.inverse_optimal import per_row
from torchfsid.identification.kkt import KktSolution
from torchfsid.kernels.compiled import installed
from torchfsid.outcome import Status
from torchfsid.robots.barriers import Barrier, controller_failed
from torchfsid.robots.bounds import ErrorBounds, NoiseBound, Uncertainty
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.neighbours import left_out_inactive
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
        on_inconsistent: what an empty intersection does: `hold` the set as it was, `reset` it to the prior and go on
            from there (a change of goal; the status stays OK, the event is recorded), or `raise` `InconsistentError`.
        compiled: use the compiled kernels (extra `fast`); None: wherever they can, that is where theta is planar and no
            gradient is needed. The sets are the same up to round-off.
        status, skipped, events: per robot: `Status`, number of samples without information, first ALARM and
        INCONSISTENT.

    Raises:
        InputError: the prior is not a batch (B,) over the task's parameters; `inverse_optimal` comes without `noise`;
            `compiled` is True, but theta is not planar, the nominal control is clipped or numba is not installed.
    """

    task: Task
    barriers: Sequence[Barrier]
    feasible_set: FeasibleSet
    kind: SetKind = "inverse_optimal"
    noise: NoiseBound | None = None
    active_tolerance: float = ACTIVE_TOLERANCE
    on_inconsistent: OnInconsistent = "hold"
    compiled: bool | None = None
    prior: FeasibleSet = field(init=False)
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
        if self.kind == "critical_region" and self.task.saturation is not None:
            raise InputError("kind", "inverse_optimal, since the nominal control is clipped", self.kind)
        if not self.active_tolerance > 0:
            raise InputError("active_tolerance", "a positive speed [m/s]", self.active_tolerance)
        if self.compiled and not (p == 2 and self.task.saturation is None and installed()):
            expected = "None or False unless theta is planar, nothing is clipped and numba is installed"
            raise InputError("compiled", expected, True)
        self.prior = self.feasible_set
        self.status = torch.zeros_like(self.feasible_set.outcome)
        self.skipped = torch.zeros_like(self.status)

    def update(self, measurement: Measurement) -> SetEstimate:
        """Take in one measurement of all robots.

        Raises:
            InputError: see `read`.
            InconsistentError: an intersection is empty, and `on_inconsistent` is `raise`.
        """
        reading, t = self.read(measurement), measurement.t
        narrowed = self.feasible_set.intersect(reading.omega, t)
        informative = reading.informative
        if narrowed.any_empty or bool(reading.alarmed.any()):
            self._report(t, reading.alarmed, reading.slack, narrowed)
            informative = informative & ~narrowed.is_empty
            narrowed = narrowed.where(~narrowed.is_empty, self._instead())
        self.feasible_set = narrowed
        self.skipped = self.skipped + ~reading.informative
        return SetEstimate(t, self.feasible_set, reading.kkt, informative, self.status)

    def read(self, measurement: Measurement) -> Reading:
        """What a measurement of all robots says about theta; nothing is changed.

        Raises:
            InputError: the measurement has no velocities, or they are not finite where the robot was observed.
        """
        u, t = measurement.u, measurement.t
        if u is None or not finite(u, measurement.x):
            raise InputError("measurement", "finite positions and velocities", f"none or not finite at t = {t}")
        parts = [barrier(measurement) for barrier in self.barriers]
        C, d = self.task(measurement)
        model = Model(
            safe_controls=Halfspaces.stack(parts),
            hard=torch.tensor(
                [not b.soft for part, b in zip(parts, self.barriers, strict=True) for _ in range(part.rows)],
                device=u.device,
            ),
            C=C.to(torch.float64),
            d=d.to(torch.float64),
            saturation=self.task.saturation,
            possible=None if self.task.saturation is None else self._possible(C, d),
        )
        usable = ~controller_failed(self.barriers, measurement, model.safe_controls)
        if measurement.observed is not None:
            usable = usable & measurement.observed
        bounds = Bounds(self.noise, self._uncertainty(measurement), self.active_tolerance)
        if measurement.left_out is not None:
            usable = usable & self._complete(measurement)
        return read(self.kind, model, u.to(torch.float64), usable, bounds, self.compiled)

    def _complete(self, measurement: Measurement) -> Bool[Tensor, "B"]:
        """Are all rows that may be active among the measurement's slots?"""
        noise = NoiseBound(self.active_tolerance) if self.noise is None else self.noise
        bound = per_row(noise.slack, measurement.x).squeeze(-1) + noise.neighbour_velocity
        if measurement.velocity_error is not None:
            bound = bound + measurement.velocity_error
        error = bound.new_tensor(2 * noise.position)
        if measurement.position_error is not None:
            error = error + measurement.position_error
        return left_out_inactive(self.barriers, measurement, bound, error)

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

    def _possible(self, C: Float[Tensor, "B n p"], d: Float[Tensor, "B n"]) -> Float[Tensor, "B v n"]:
        """C theta + d at the corners of Theta."""
        return self.feasible_set.vertices() @ C.mT + d.unsqueeze(-2)

    def _uncertainty(self, measurement: Measurement) -> Uncertainty | None:
        """What bounds beyond those on the control come to, for the rows and for C theta + d; None if there are none."""
        noise = NoiseBound(0.0) if self.noise is None else self.noise
        measured = (measurement.position_error, measurement.body_position_error)
        measured += (measurement.velocity_error, measurement.body_velocity_error)
        if noise.position == noise.neighbour_velocity == 0 and all(error is None for error in measured):
            return None
        own, bodies = torch.zeros_like(measurement.x[..., 0]), torch.zeros_like(measurement.bodies[..., 0])

        def total(declared: float, measured: Tensor | None, like: Tensor) -> Tensor:
            return like + declared + (0.0 if measured is None else measured)

        bounds = ErrorBounds(
            total(noise.position, measurement.position_error, own),
            total(noise.position, measurement.body_position_error, bodies),
            total(noise.neighbour_velocity, measurement.body_velocity_error, bodies),
        )
        rows = [barrier.errors(measurement, bounds) for barrier in self.barriers]
        velocity = total(0.0, measurement.velocity_error, own)
        return Uncertainty(
            velocity=velocity,
            slack=torch.cat([row.slack for row in rows], dim=-1) + velocity.unsqueeze(-1),
            angle=torch.cat([row.angle for row in rows], dim=-1),
            drift=self.task.drift(bounds, self.feasible_set.vertices().abs().amax(-2)),
        )
