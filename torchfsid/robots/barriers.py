"""Barriers: rows A(x) u <= b(x) that keep a robot's control safe. Several barriers are stacked.

A row 0.u <= 1 is padding. Generic code asks a barrier only through the interface `Barrier`. The rows between bodies are
in `avoidance`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import ClassVar, Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.device import all_seen, constant, on_host
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, lengths
from torchfsid.robots.arguments import require_each, require_numbers
from torchfsid.robots.avoidance import ClassK, NeighbourVelocity
from torchfsid.robots.bounds import ErrorBounds, RowErrors
from torchfsid.robots.measurement import Measurement


@runtime_checkable
class Barrier(Protocol):
    """Rows over the control u. docs/your_own_controller.md writes one, `torchfsid.testing` tries any.

    Two more members are optional. Where one is missing and matters for a sample, the sample is skipped.

        neighbour_velocity          The controls of other bodies that the rows use, velocities or, for robots of second
                                    order, accelerations: `none`, `current` (one QP decides for the whole team) or
                                    `previous`. If missing, it may be `current`.
        slack_left_out(measurement) (*batch): the least slack that the row of a body without a slot can have at the
                                    measured control, in its units, given `measurement.left_out`. It is infinite if
                                    bodies have no rows, and NaN or -inf if nothing is known. If missing, nothing is
                                    known.

    Five more are for barriers that need them:

        order                       2 if the controls are accelerations. Default: 1, velocities. It matters where
                                    `neighbour_velocity` is `current`.
        rows_within(measurement, bounds)  The rows that may exist, given bounds on the errors of the measurement, where
                                    errors may decide which rows there are. Default: `barrier(measurement)`.
        uncertain                   whether `errors` matter even if positions and other bodies' velocities are exact.
        relaxes                     whether the controller, if no control keeps its rows, takes the control with the
                                    least violation, whatever its task. Such a barrier is soft.
        speed_limit                 the radius of a disc that holds all controls [m/s]. Controllers keep it. Observers
                                    see it as a row through the measured control (`speed_disc`).

    Attributes:
        soft: the controller may violate the rows (it has slack variables), so that a violation is no alarm.
    """

    @property
    def soft(self) -> bool: ...

    def __call__(self, measurement: Measurement) -> Halfspaces: ...

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        """Bounds on the errors of the rows, given bounds on the errors of the measurement."""
        ...

    def labels(self, bodies: Sequence[str]) -> list[str]:
        """A name for each row, given the names of the bodies."""
        ...


def stack_barriers(barriers: Sequence[Barrier], measurement: Measurement) -> Halfspaces:
    """The safe controls: the rows of all barriers, one below the other."""
    return Halfspaces.stack([barrier(measurement) for barrier in barriers])


def possible_rows(barrier: Barrier, measurement: Measurement, bounds: ErrorBounds | None) -> Halfspaces:
    """The rows of a barrier that may exist, given bounds on the errors of the measurement."""
    if bounds is None or not hasattr(barrier, "rows_within"):
        return barrier(measurement)
    return barrier.rows_within(measurement, bounds)  # type: ignore[attr-defined]


def neighbours_controls(barriers: Sequence[Barrier]) -> Literal["body_velocities", "body_accelerations"]:
    """The field of `Measurement` that holds the controls of other bodies."""
    second_order = any(getattr(barrier, "order", 1) == 2 for barrier in barriers)
    return "body_accelerations" if second_order else "body_velocities"


def is_joint(barriers: Sequence[Barrier]) -> bool:
    """Does one QP decide for the whole team? It does if some rows use the neighbours' current controls."""
    return any(getattr(barrier, "neighbour_velocity", None) == "current" for barrier in barriers)


def row_errors(
    barriers: Sequence[Barrier], parts: Sequence[Halfspaces], measurement: Measurement, bounds: ErrorBounds
) -> RowErrors:
    """Bounds on the errors of the barriers' rows (`parts`). Nothing is known of a barrier that gives no bounds."""
    return RowErrors.stack(
        [
            barrier.errors(measurement, bounds) if hasattr(barrier, "errors") else RowErrors.unknown(part.b)
            for barrier, part in zip(barriers, parts, strict=True)
        ]
    )


def controller_failed(
    barriers: Sequence[Barrier],
    measurement: Measurement,
    rows: Halfspaces,
    errors: RowErrors | None = None,
    control_error: Float[Tensor, "*#batch"] | float = 0.0,
) -> Bool[Tensor, "*batch"]:
    """May the controller of a robot have found no solution? Then it commands exactly zero, which says nothing of theta.

    A robot's own QP has failed if its control is exactly zero and zero violates one of its `rows`. It may have failed
    if zero violates a row that is wrong by at most its `errors`. A control that is zero within `control_error` may be
    that of a failed QP, too, or of a controller that has switched its barriers off at the goal, if zero violates a row
    by more than all these errors. A joint QP that fails stops the whole team. So it may have failed whenever all
    controls are exactly zero.
    """
    assert measurement.u is not None
    error = control_error if isinstance(control_error, Tensor) else rows.b.new_full((), control_error)
    slow = measurement.u.norm(dim=-1) <= error
    if all_seen(~slow):
        return slow
    stopped, asked = (measurement.u == 0).all(-1), slow.unsqueeze(-1).expand_as(rows.b)
    if errors is None:
        asked = asked & (rows.b < 0)  # zero keeps the others
    sizes = _lengths_where(asked, rows)
    least = torch.zeros_like(rows.b) if errors is None else errors.slack * sizes
    clearly = rows.b < -least - error.unsqueeze(-1) * sizes
    failed = (asked & (stopped.unsqueeze(-1) & (rows.b < least) | clearly)).any(-1)
    perhaps_joint = any(getattr(barrier, "neighbour_velocity", None) in ("current", None) for barrier in barriers)
    controls = measurement.body_velocities if measurement.body_accelerations is None else measurement.body_accelerations
    if perhaps_joint and controls is not None:
        others_move = (measurement.present & (controls != 0).any(-1)).any(-1)
        failed = failed | (stopped & ~others_move)
    return failed


def _lengths_where(asked: Tensor, rows: Halfspaces) -> Tensor:
    """The lengths of rows where they are asked for. Those of the others are used by nobody."""
    if not on_host(asked):
        return reduce(torch.hypot, rows.A.detach().abs().unbind(-1))
    found, place = torch.zeros_like(rows.b), asked.nonzero(as_tuple=True)
    found[place] = lengths(rows.A.detach()[place])
    return found


class _OfNoBody:
    """The answers of a barrier whose rows do not depend on other bodies."""

    neighbour_velocity: ClassVar[NeighbourVelocity] = "none"

    def slack_left_out(self, measurement: Measurement) -> Float[Tensor, "*batch"]:
        return torch.full_like(measurement.x[..., 0], math.inf)


@dataclass(frozen=True)
class SpeedBox(_OfNoBody):
    """|u_i| <= limit_i on every axis, in the units of the control: 2n rows. `quantity` names it in labels."""

    limit: tuple[float, ...]
    soft: bool = False
    quantity: Literal["speed", "acceleration"] = "speed"

    def __post_init__(self) -> None:
        expected = "a positive limit for each axis, e.g. (1.0, 1.0)"
        require_numbers("limit", expected, self.limit, lambda limit: limit.ndim == 1 and bool((limit > 0).all()))

    def __call__(self, measurement: Measurement) -> Halfspaces:
        x = measurement.x
        identity = torch.eye(len(self.limit), dtype=torch.float64, device=x.device)
        limits = constant(self.limit * 2, x.device)
        return _constant(torch.cat([identity, -identity]), limits, measurement)

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        return RowErrors.none(self(measurement).b)

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return [f"{self.quantity} {sign}{axis}" for sign in "+-" for axis in "xyz"[: len(self.limit)]]


@dataclass(frozen=True)
class SpeedPolygon(_OfNoBody):
    """u inside a regular polygon of circumradius `limit` [m/s], with its first side across the first axis.

    It approximates |u| <= limit by u_1 <= limit cos(pi/sides) and its rotations. The Robotarium uses 8 sides.
    """

    sides: int
    limit: float
    soft: bool = False

    def __post_init__(self) -> None:
        require_numbers("sides", "a whole number >= 3", self.sides, lambda sides: sides >= 3)
        require_numbers("limit", "a positive speed [m/s]", self.limit, lambda limit: limit > 0)

    def __call__(self, measurement: Measurement) -> Halfspaces:
        side = torch.arange(self.sides, dtype=torch.float64, device=measurement.x.device)
        angles = side * (2 * math.pi / self.sides)
        normals = torch.stack([angles.cos(), angles.sin()], dim=-1)
        apothem = self.limit * math.cos(math.pi / self.sides)
        return _constant(normals, torch.full_like(angles, apothem), measurement)

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        return RowErrors.none(self(measurement).b)

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return [f"speed side {side}" for side in range(self.sides)]


@dataclass(frozen=True)
class Arena(_OfNoBody):
    """Stay `margin` [m] inside the box [lower, upper] [m]: h is the distance to each wall, +-u_i <= alpha(h)."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    class_k: ClassK
    margin: float = 0.0
    soft: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.class_k, ClassK):
            raise InputError("class_k", "a class-K function, e.g. ClassK(gain=1.0)", repr(self.class_k))
        if len(self.lower) != len(self.upper) or not all(a < b for a, b in zip(self.lower, self.upper, strict=True)):
            raise InputError("arena", "lower < upper on every axis [m]", (self.lower, self.upper))

    def __call__(self, measurement: Measurement) -> Halfspaces:
        require_each("class_k.gain", self.class_k.gain, measurement)
        h = self._distances(measurement.x)
        identity = torch.eye(len(self.lower), dtype=torch.float64, device=h.device)
        return Halfspaces(torch.cat([identity, -identity]).expand(*h.shape, len(self.lower)), self.class_k(h))

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        h, e = self._distances(measurement.x), bounds.position.unsqueeze(-1)
        nearer, here, further = (self.class_k(distance) for distance in (h - e, h, h + e))
        return RowErrors(torch.zeros_like(h), torch.maximum(here - nearer, further - here))

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return [f"wall {sign}{axis}" for sign in "+-" for axis in "xyz"[: len(self.lower)]]

    def _distances(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch 2*n"]:
        lower, upper = (constant(tuple(side), x.device) for side in (self.lower, self.upper))
        to_upper, to_lower = upper - self.margin - x, x - lower - self.margin
        return torch.cat([to_upper, to_lower], dim=-1)


def _constant(A: Tensor, b: Tensor, measurement: Measurement) -> Halfspaces:
    """The same rows for every robot of the batch."""
    batch = measurement.x.shape[:-1]
    return Halfspaces(A.expand(*batch, *A.shape), b.expand(*batch, *b.shape))
