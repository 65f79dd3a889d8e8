r"""Evidence: the half-spaces of theta that follow from one measurement of positions and controls, for B robots at once.

    rows A u <= b, task (C, d), control u  ->  slacks  ->  active rows  ->  KKT conditions  ->  half-spaces of theta

A sample is informative only if
    - the robot was observed, and its controller had a solution (`controller_failed`);
    - the model could be evaluated: no row, C or d is NaN or infinite;
    - the rows of bodies without a slot are provably inactive (`neighbours`);
    - the controller cannot have taken the least violation of its rows instead of its task (`Barrier.relaxes`);
    - no hard row is violated by more than its bound. Otherwise model or bounds are wrong, and the sample is alarming;
    - every row that may be active has a known direction. It has none if a body is at the robot's own place, within the
      errors of positions.

A controller that relaxes infeasible rows takes a control at which rows with the largest violation, the speed limit
among them, hold each other: some positive combination of them is zero. So the sample says nothing of theta if the cone
of the rows that may be active contains a line. If it contains none, no row of such a barrier may be violated. Since
controllers are not exact where it nearly contains one, a violation is then no alarm, either (`RELAXED_OPENING`).

The measurements of a whole log can be concatenated into one batch. In the plane and in space, where no gradient is
needed, compiled code computes the same from the slacks on (`compiled_evidence`, `compiled_in_space`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.device import all_seen, constant, on_host
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, dot, finite
from torchfsid.identification import compiled_evidence
from torchfsid.identification.active_set import touched
from torchfsid.identification.critical_region import region_of
from torchfsid.identification.inverse_optimal import normals_of, per_row, set_around, without_direction
from torchfsid.identification.kkt import KktSolution, solve_unit
from torchfsid.robots.arguments import require_barriers, require_choice, require_task
from torchfsid.robots.barriers import Barrier, controller_failed, possible_rows, row_errors
from torchfsid.robots.bounds import ErrorBounds, NoiseBound, RowErrors
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.neighbours import left_out_inactive, within_bounds
from torchfsid.robots.tasks import Task, feedback_of
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.tolerances import ACTIVE_TOLERANCE, RELAXED_OPENING, ROUND_OFF

SetKind = Literal["critical_region", "inverse_optimal"]


@dataclass(frozen=True)
class ObservationModel:
    """The declared model of the robots, and the kind of half-spaces that follow from their motions.

    Attributes:
        task: the task of all robots.
        barriers: the barriers of all robots.
        kind: `critical_region` (the paper's Omega, for exact data of exact controllers) or `inverse_optimal`.
        noise: bounds on errors, for `inverse_optimal` and for the alarm.
        active_tolerance: the slack below which a row counts as active for `critical_region`, the case label and
            (G, f) [units of the control].

    Raises:
        InputError: `inverse_optimal` comes without `noise`, `critical_region` with a clipped nominal control, or
            `active_tolerance` is not positive.
    """

    task: Task
    barriers: Sequence[Barrier]
    kind: SetKind = "inverse_optimal"
    noise: NoiseBound | None = None
    active_tolerance: float = ACTIVE_TOLERANCE

    def __post_init__(self) -> None:
        require_task(self.task)
        require_barriers(self.barriers)
        require_choice("kind", self.kind, get_args(SetKind))
        if not isinstance(self.noise, NoiseBound) and (self.noise is not None or self.kind == "inverse_optimal"):
            raise InputError("noise", "a NoiseBound, e.g. NoiseBound(velocity=0.02)", repr(self.noise))
        for barrier in self.barriers:
            if not callable(barrier):
                raise InputError("barriers", "barriers with known parameters (or a SafetyObserver)", barrier)
        if self.kind == "critical_region" and self.task.saturation is not None:
            raise InputError("kind", "inverse_optimal, since the nominal control is clipped", self.kind)
        if self.kind == "critical_region" and getattr(self.task, "uncertain", False):
            raise InputError("kind", "inverse_optimal, since the task is not known exactly", self.kind)
        if self.kind == "critical_region" and any(getattr(barrier, "uncertain", False) for barrier in self.barriers):
            raise InputError("kind", "inverse_optimal, since some rows are not known exactly", self.kind)
        if not self.active_tolerance > 0:
            raise InputError("active_tolerance", "a positive number [units of the control]", self.active_tolerance)

    @cached_property
    def bounds(self) -> NoiseBound:
        """The declared bounds. The critical region without any needs the slack of its active rows only."""
        return NoiseBound(0.0, self.active_tolerance) if self.noise is None else self.noise

    @cached_property
    def relaxes(self) -> bool:
        """Does the controller take the least violation of rows that are infeasible (`Barrier.relaxes`)?"""
        return any(getattr(barrier, "relaxes", False) for barrier in self.barriers)


@dataclass(frozen=True)
class Evidence:
    """What one measurement says by itself.

    Slacks and KKT conditions in the plane are computed when they are first used.

    Attributes:
        omega: half-spaces of theta, all padding where the sample is not used. Their sources are those of
            `critical_region` or `inverse_optimal_set`.
        informative: whether the sample is used.
        alarmed: whether it is not used because a hard row is violated beyond its bound.
        infeasible: whether it is not used because the controller may have found its rows infeasible and relaxed them.
        hard: the rows that no controller may violate.
        slacks: computes `slack` and `excess`. Use these instead.
        solve: solves the KKT conditions. Use `kkt` instead.
        omega_without: the half-spaces of theta for k items if a row of each were inactive: called with (items, rows).
    """

    omega: Halfspaces
    informative: Bool[Tensor, "B"]
    alarmed: Bool[Tensor, "B"]
    infeasible: Bool[Tensor, "B"]
    hard: Bool[Tensor, "m"]
    slacks: Callable[[], tuple[Tensor, Tensor]]
    solve: Callable[[], KktSolution]
    omega_without: Callable[[Int[Tensor, "k"], Int[Tensor, "k"]], Halfspaces]

    @cached_property
    def _measured(self) -> tuple[Tensor, Tensor]:
        return self.slacks()

    @property
    def slack(self) -> Float[Tensor, "B m"]:
        """The slack of every row at the measured control, in its units."""
        return self._measured[0]

    @property
    def excess(self) -> Float[Tensor, "B m"]:
        """The violation of every row beyond its bound, in its units; positive if it is violated."""
        return self._measured[1]

    @cached_property
    def kkt(self) -> KktSolution:
        """The control u* = G theta + f at the observed active set, without the task's feedback. It is solved once."""
        return self.solve()

    def select(self, items: Int[Tensor, "k"]) -> Evidence:
        """The evidence of some items of the batch."""
        source = None if self.omega.source is None else self.omega.source[items]
        return Evidence(
            Halfspaces(self.omega.A[items], self.omega.b[items], source), self.informative[items],
            self.alarmed[items], self.infeasible[items], self.hard,
            lambda: (self.slack[items], self.excess[items]), lambda: self.kkt.select(items),
            lambda chosen, rows: self.omega_without(items[chosen], rows),
        )  # fmt: skip


@dataclass(frozen=True)
class Sample:
    """The model at one measurement. Its numbers are NaN or infinite where it could not be evaluated.

    Attributes:
        rows: the rows A u <= b.
        hard: the rows that no controller may violate.
        relaxed: the rows of which the controller takes the least violation if they are infeasible.
        u: the measured control, without the task's feedback.
        C: of the nominal control C theta + d.
        d: of the nominal control C theta + d.
        usable: whether the sample may be informative, before the rows are tested.
        bound: the largest slack of an active row, broadcasting with (B, m).
        ball: a bound on the error of u, broadcasting with (B,).
        drift: a bound on the error of C theta + d, broadcasting with (B,).
        row_errors: bounds on the errors of the rows; None if their directions are exact.
        corners: the vertices of Theta; None if they are not needed.
    """

    rows: Halfspaces
    hard: Bool[Tensor, "m"]
    relaxed: Bool[Tensor, "m"]
    u: Float[Tensor, "B n"]
    C: Float[Tensor, "B n p"]
    d: Float[Tensor, "B n"]
    usable: Bool[Tensor, "B"]
    bound: Float[Tensor, "*#rows"]
    ball: Float[Tensor, "*#B"]
    drift: Float[Tensor, "*#B"]
    row_errors: RowErrors | None
    corners: Float[Tensor, "B v p"] | None

    def omega_without(self, model: ObservationModel) -> Callable[[Tensor, Tensor], Halfspaces]:
        """`Evidence.omega_without` of these samples."""
        return lambda items, rows: read_sample(model, self.without(items, rows), None).omega

    def without(self, items: Int[Tensor, "k"], rows: Int[Tensor, "k"]) -> Sample:
        """The samples at the places `items`, as if the row of the same place in `rows` were inactive."""
        k, m = torch.arange(len(items), device=items.device), self.rows.rows
        errors = self.row_errors
        return Sample(
            Halfspaces(self.rows.A[items], self.rows.b[items]), torch.zeros_like(self.hard), self.relaxed,
            self.u[items], self.C[items], self.d[items], self.usable[items],
            self.bound.expand(len(self.u), m)[items].index_put((k, rows), self.bound.new_tensor(-torch.inf)),
            self.ball.expand(len(self.u))[items], self.drift.expand(len(self.u))[items],
            None if errors is None else RowErrors(errors.angle[items], errors.slack[items]),
            None if self.corners is None else self.corners[items],
        )  # fmt: skip


def evidence(
    model: ObservationModel, theta: FeasibleSet, measurement: Measurement, compiled: bool | None = None
) -> Evidence:
    """What a measurement says about theta.

    Args:
        model: the declared model.
        theta: the robots' sets so far, batch (B,). They are used only for clipped nominal controls, for tasks that are
            not known exactly, and for position errors of tasks with an unknown gain.
        measurement: a measurement of these robots, or several concatenated.
        compiled: whether to run compiled code instead of torch. None chooses compiled code wherever it is possible:
            controls are in the plane or in space, no gradient is needed, and tensors are on the CPU, or on CUDA if the
            extra `cuda` is installed. In the plane a nominal control is clipped only if theta is planar. In space no
            rows are relaxed.

    Raises:
        InputError: the measurement has no velocities, they are not finite for an observed robot, the measurement does
            not fit theta, or `compiled` is True where it is not possible.
    """
    return read_sample(model, sample_of(model, theta, measurement.observed_only()), compiled)


def read_sample(model: ObservationModel, sample: Sample, compiled: bool | None) -> Evidence:
    """`evidence` of a sample that is already evaluated."""
    if not compiled_evidence.can_be_compiled(model, sample, compiled):
        return _in_torch(model, sample)
    omega, judged, details = compiled_evidence.read(model, sample)
    return Evidence(
        omega, *judged, sample.hard, lambda: details()[:2], lambda: details()[2], sample.omega_without(model)
    )


def sample_of(model: ObservationModel, theta: FeasibleSet, measurement: Measurement) -> Sample:
    """The model at one measurement."""
    assert measurement.u is not None
    robots, items = theta.batch_shape.numel(), len(measurement.x)
    u = measurement.u.to(torch.float64, copy=True)  # it is read again later, when the caller may have changed it
    if measurement.x.ndim != 2 or len(theta.batch_shape) != 1 or items % max(robots, 1) != 0:
        expected = f"a batch of {tuple(theta.batch_shape)} robots, or several of them"
        raise InputError("measurement", expected, tuple(measurement.x.shape))
    noise = model.bounds.of_samples(robots, items)
    errors, of_rows, corners = ErrorBounds.of(measurement, noise), None, None
    if errors is None and any(getattr(barrier, "uncertain", False) for barrier in model.barriers):
        errors = ErrorBounds.of_controls(measurement, noise)
    parts = [possible_rows(barrier, measurement, errors) for barrier in model.barriers]
    rows, (C, d) = Halfspaces.stack(parts), model.task(measurement)
    owners = [barrier for barrier, part in zip(model.barriers, parts, strict=True) for _ in range(part.rows)]
    hard = constant(tuple(not barrier.soft for barrier in owners), u.device, torch.bool)
    relaxed = constant(tuple(getattr(barrier, "relaxes", False) for barrier in owners), u.device, torch.bool)

    bound, ball, drift = per_row(noise.slack, u), per_row(noise.velocity, u).squeeze(-1), u.new_zeros(())
    if measurement.velocity_error is not None:
        bound, ball = bound + measurement.velocity_error.unsqueeze(-1), ball + measurement.velocity_error
    largest = bound.squeeze(-1)  # slack of an active row whose position is exact
    uncertain = getattr(model.task, "uncertain", False)
    if errors is not None or model.task.saturation is not None or uncertain:
        corners = theta.vertices().expand(items // max(robots, 1), -1, -1, -1).flatten(0, 1)
        if errors is not None:
            drift = model.task.drift(errors, corners.abs().amax(-2))
        if uncertain:
            drift = drift + model.task.uncertainty(measurement, corners)  # type: ignore[attr-defined]
    if errors is not None:
        of_rows = row_errors(model.barriers, parts, measurement, errors)
        bound = bound + of_rows.slack
    usable = ~controller_failed(model.barriers, measurement, rows, of_rows, ball)
    if measurement.observed is not None:
        usable = usable & measurement.observed
    if measurement.left_out is not None:
        error = u.new_zeros(()) + 2 * noise.position
        if measurement.position_error is not None:
            error = error + measurement.position_error
        usable = usable & left_out_inactive(model.barriers, within_bounds(measurement, noise), largest, error)
    feedback = feedback_of(model.task, measurement)
    if feedback is not None:  # what is clipped is w = u - feedback, and A u <= b is A w <= b - A feedback
        known = feedback.isfinite().all(-1)
        feedback, usable = torch.where(known.unsqueeze(-1), feedback.to(torch.float64), 0.0), usable & known
        u, rows = u - feedback, Halfspaces(rows.A, rows.b - dot(rows.A, feedback.unsqueeze(-2)))
        if errors is not None:
            ball = ball + model.task.feedback_error(errors)  # type: ignore[attr-defined]

    turned = None if of_rows is None or all_seen(of_rows.angle == 0) else of_rows
    return Sample(
        rows, hard, relaxed, u, C.to(torch.float64), d.to(torch.float64), usable, bound, ball, drift, turned, corners,
    )  # fmt: skip


def _in_torch(model: ObservationModel, sample: Sample) -> Evidence:
    rows, C, d, usable, u = sample.rows, sample.C, sample.d, sample.usable, sample.u
    if not (on_host(u) and finite(rows.A, rows.b, C, d)):  # padding and zeros in place of what could not be evaluated
        are_known = rows.b.isfinite() & rows.A.isfinite().all(-1)
        wish_known = C.isfinite().all(-1).all(-1) & d.isfinite().all(-1)
        C, d = torch.where(wish_known[:, None, None], C, 0.0), torch.where(wish_known[:, None], d, 0.0)
        rows, usable = rows.where(are_known), usable & are_known.all(-1) & wish_known
    unit = rows.normalised()
    slack = unit.b - dot(unit.A, u.unsqueeze(-2))
    room = sample.bound + ROUND_OFF * (dot(unit.A.abs(), u.abs().unsqueeze(-2)) + unit.b.abs()).detach()
    excess, near = -slack - room, slack <= room
    alarmed, infeasible = usable & ((excess > 0) & sample.hard).any(-1), torch.zeros_like(usable)
    outward = None if model.kind == "critical_region" else normals_of(unit, near, sample.row_errors)
    if outward is not None and model.relaxes:
        strained = ((excess > 0) & sample.relaxed).any(-1)
        alarmed = alarmed | usable & strained & (outward.opening > RELAXED_OPENING)
        infeasible = usable & ~alarmed & (strained | (outward.opening == 0))
    informative = usable & ~alarmed & ~infeasible
    if sample.row_errors is not None:
        informative = informative & ~(near & without_direction(unit, sample.row_errors)).any(-1)
    solve = partial(solve_unit, unit, touched(unit, slack, model.active_tolerance), C, d)
    if outward is None:
        kkt = solve()
        omega, solve = region_of(unit, kkt, C, d), lambda: kkt
    else:
        omega = set_around(
            outward, unit.rows, u, C, d, sample.ball, sample.drift,
            model.task.saturation, None if sample.corners is None else sample.corners @ C.mT + d.unsqueeze(-2),
        )  # fmt: skip
    omega = omega.where(informative.unsqueeze(-1))
    return Evidence(
        omega, informative, alarmed, infeasible, sample.hard, lambda: (slack, excess), solve,
        sample.omega_without(model),
    )  # fmt: skip
