r"""Optimal reciprocal collision avoidance (ORCA; van den Berg, Guy, Lin, Manocha, "Reciprocal n-Body Collision
Avoidance", ISRR 2009), as RVO2 and its bindings compute it.

With p = x_j - x_i, w_rel = v_i - v_j, v the velocities executed until t, R the sum of the radii, T the time horizon
(the time step while |p| <= R) and w = w_rel - p/T, each neighbour gives one row:

    n.u >= n.(v_i + v_j)/2 + beta
    circle   |p| <= R, or w.p < 0 and (w.p)^2 > R^2 |w|^2:   n = w/|w|,   beta = (R + n.p)/(2 T)
    leg      otherwise:   n is normal to the tangent from the origin to the disc of radius R around p, beta = 0;
             the left tangent where det(p, w) > 0, else the right one

The controller keeps the rows of the `count` nearest neighbours nearer than `distance`, and |u| <= max_speed. Where that
is impossible, it takes the control with the least violation, whatever its task (`relaxes`).

Bounds on errors, with e = rho_i + rho_j, eps = eps_i + eps_j, r = |p|, tau the error of 1/T, sigma that of R, and
q = 1/T + tau the largest 1/T. With T and R known, tau = sigma = 0.

    angle    leg: asin(e/r) + asin((R + sigma)/(r - e)) - asin(R/r)          circle: asin((eps + e q + r tau)/|w|)
    slack    eps/2 + 2 sin(angle/2) |u - (v_i + v_j)/2|
             [circle: + (tau |R + n.p| + q (sigma + e + 2 sin(angle/2) r))/2]

If the errors leave open which branch the controller took, a row covers all branches that it may have taken: its angle
reaches their directions, its slack reaches their slacks. The programs compute in single precision, so that positions
and velocities have errors of 2^-22 of their size at least.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.device import all_seen
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.robots.avoidance import NeighbourVelocity
from torchfsid.robots.bounds import ErrorBounds, RowErrors
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.speed_disc import SpeedDisc
from torchfsid.robots.tasks import Task
from torchfsid.robots.velocity_obstacle import (
    SINGLE,
    Geometry,
    Horizon,
    Pairs,
    Rows,
    branch_errors,
    geometry,
    is_open,
    over_branches,
    uncertainty,
)

_MEASURED = ("x", "velocity", "bodies", "previous_body_velocities", "radius", "body_radii")


@dataclass(frozen=True)
class Orca:
    """One row for each neighbour, and one for the speed limit (`SpeedDisc`).

    Attributes:
        time_horizon: T [s].
        time_step: of the controller, used while bodies overlap [s].
        max_speed: the speed limit [m/s].
        count: the largest number of neighbours.
        distance: the distance within which bodies are neighbours [m].
        margin: added to the sum of the radii [m].
        push_away: a neighbour nearer than R + this is taken to be there [m]; 0 for none (navground: 0.002).
        rate_error: tau, by which 1/time_horizon may be wrong [1/s].
        margin_error: sigma, by which `margin` may be wrong [m]. Rows then hold for all horizons and margins within.

    Raises:
        InputError: a value is not positive (margin, push_away and errors: not negative), `rate_error` reaches
            1/time_horizon, or bodies are pushed away to a distance that is not known. When called: the measurement has
            no radii or no velocities before t.
    """

    time_horizon: float
    time_step: float
    max_speed: float
    count: int
    distance: float
    margin: float = 0.0
    push_away: float = 0.0
    rate_error: float = 0.0
    margin_error: float = 0.0
    relaxes: ClassVar[bool] = True
    uncertain: ClassVar[bool] = True
    neighbour_velocity: ClassVar[NeighbourVelocity] = "previous"
    _looks: list[tuple[Measurement, Geometry]] = field(init=False, default_factory=list, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("time_horizon", "time_step", "max_speed", "count", "distance"):
            if not getattr(self, name) > 0:
                raise InputError(name, "a positive number", getattr(self, name))
        for name in ("margin", "push_away", "rate_error", "margin_error"):
            if not getattr(self, name) >= 0:
                raise InputError(name, "a number >= 0", getattr(self, name))
        if not self.rate_error < 1 / self.time_horizon:
            raise InputError("rate_error", f"less than 1/time_horizon = {1 / self.time_horizon:g}", self.rate_error)
        if self.push_away and self.margin_error:
            raise InputError("margin_error", "0 with push_away", self.margin_error)

    @property
    def soft(self) -> bool:
        return True

    @property
    def speed_limit(self) -> float:
        """The radius of the disc of controls, for controllers [m/s]."""
        return self.max_speed

    def __call__(self, measurement: Measurement) -> Halfspaces:
        look = self._look(measurement)
        return self._stacked(look.rows, self._nearest(measurement, look.pairs.r), measurement)

    def rows_within(self, measurement: Measurement, bounds: ErrorBounds) -> Halfspaces:
        """The rows of all bodies that may be among the chosen neighbours."""
        look = self._look(measurement)
        e = uncertainty(look.pairs, bounds).e
        return self._stacked(look.rows, self._chosen(measurement, look.pairs.r, e)[0], measurement)

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        """See the module docstring. A body that may not be among the neighbours has a row that may be violated."""
        assert measurement.u is not None
        look = self._look(measurement)
        pairs, rows = look.pairs, look.rows
        wrong = uncertainty(pairs, bounds, self.margin_error)
        may_be, must_be = self._chosen(measurement, pairs.r, wrong.e)
        ux, uy = (component.unsqueeze(-1).expand_as(wrong.e) for component in measurement.u.unbind(-1))
        angle, slack = branch_errors(pairs, rows, ux, uy, wrong, look.horizon, look.on_circle)
        open_at = (is_open(look, wrong) & may_be).nonzero(as_tuple=True)
        if len(open_at[0]):
            some, own = Pairs._make(v[open_at] for v in pairs), Rows._make(v[open_at] for v in rows)
            there = wrong._replace(e=wrong.e[open_at], eps=wrong.eps[open_at])
            wide = over_branches(some, own, ux[open_at], uy[open_at], there, *self._horizons)
            angle, slack = angle.index_put(open_at, wide.angle), slack.index_put(open_at, wide.slack)
        if not all_seen(must_be == may_be):
            violation = rows.low - rows.nx * ux - rows.ny * uy
            slack = torch.where(must_be, slack, torch.maximum(slack, violation))
        of_bodies = RowErrors(torch.where(may_be, angle, 0.0), torch.where(may_be, slack, 0.0))
        return RowErrors.stack([of_bodies, SpeedDisc(self.max_speed).errors(measurement, bounds)])

    def slack_left_out(self, measurement: Measurement) -> Float[Tensor, "*batch"]:
        """Infinite if bodies without a slot are no neighbours: too far, or behind `count` bodies that are nearer."""
        left_out = measurement.left_out
        assert left_out is not None
        r = (measurement.bodies - measurement.x.unsqueeze(-2)).norm(dim=-1)
        if measurement.body_position_error is not None:
            r = r + measurement.body_position_error
        least = left_out.distance * (1 - SINGLE)
        nearer = (measurement.present & (r * (1 + SINGLE) < least.unsqueeze(-1))).sum(-1)
        no_neighbour = (least >= self.distance) | (nearer >= self.count)
        return torch.where(no_neighbour, math.inf, -math.inf)

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return [*(f"avoid {body}" for body in bodies), "speed"]

    @property
    def _horizons(self) -> tuple[Horizon, Horizon]:
        """Of bodies that are apart, and of bodies that overlap."""
        return Horizon(self.time_horizon, self.rate_error), Horizon(self.time_step)

    def _look(self, measurement: Measurement) -> Geometry:
        """The rows' geometry. It is kept, since rows and errors of one measurement ask for it in turn."""
        if self._looks and self._looks[0][0] is measurement:
            return self._looks[0][1]
        look = geometry(self._pairs(measurement), *self._horizons)
        differentiable = any(getattr(measurement, name).requires_grad for name in _MEASURED)
        self._looks[:] = [] if differentiable else [(measurement, look)]  # a graph is followed once only
        return look

    def _pairs(self, measurement: Measurement) -> Pairs:
        v, others = measurement.velocity, measurement.previous_body_velocities
        if v is None or others is None:
            raise InputError("measurement", "the velocities of robots and bodies one sample earlier", None)
        if measurement.radius is None or measurement.body_radii is None:
            raise InputError("measurement.radius", "radii of robots and bodies", None)
        absent = ~measurement.present
        (x, y), (vx, vy) = (vector.unsqueeze(-1).unbind(-2) for vector in (measurement.x, v))
        (jx, jy), (jvx, jvy) = measurement.bodies.unbind(-1), others.unbind(-1)
        px, py = ((to - at).masked_fill(absent, 1.0) for to, at in ((jx, x), (jy, y)))
        jvx, jvy = jvx.masked_fill(absent, 0.0), jvy.masked_fill(absent, 0.0)
        r, R = (px * px + py * py).sqrt(), measurement.radius.unsqueeze(-1) + measurement.body_radii + self.margin
        scale = torch.ones_like(r)
        if self.push_away:
            near = (r < R + self.push_away) & (r > 0)
            scale = torch.where(near, (R + self.push_away) / torch.where(near, r, 1.0), 1.0)
            px, py, r = px * scale, py * scale, r * scale
        return Pairs(px, py, r, R, vx - jvx, vy - jvy, (vx + jvx) / 2, (vy + jvy) / 2, scale)

    def _stacked(self, rows: Rows, chosen: Bool[Tensor, "*batch m"], measurement: Measurement) -> Halfspaces:
        of_bodies = Halfspaces(torch.stack([-rows.nx, -rows.ny], dim=-1), -rows.low).where(chosen)
        return Halfspaces.stack([of_bodies, SpeedDisc(self.max_speed)(measurement)])

    def _nearest(self, measurement: Measurement, r: Float[Tensor, "*batch m"]) -> Bool[Tensor, "*batch m"]:
        """The neighbours that the controller chooses, if positions are exact."""
        near = measurement.present & (r < self.distance)
        if near.shape[-1] <= self.count:
            return near
        rank = r.masked_fill(~near, math.inf).argsort(dim=-1, stable=True).argsort(dim=-1)
        return near & (rank < self.count)

    def _chosen(
        self, measurement: Measurement, r: Float[Tensor, "*batch m"], e: Float[Tensor, "*batch m"]
    ) -> tuple[Bool[Tensor, "*batch m"], Bool[Tensor, "*batch m"]]:
        """The bodies that may be among the neighbours, and those that must be."""
        present = measurement.present
        least, most = (r - e).masked_fill(~present, math.inf), (r + e).masked_fill(~present, math.inf)
        may_be, must_be = present & (least < self.distance), present & (most < self.distance)
        if present.shape[-1] > self.count:
            may_be = may_be & (least <= most.kthvalue(self.count, dim=-1, keepdim=True).values)
            must_be = must_be & (most < least.kthvalue(self.count + 1, dim=-1, keepdim=True).values)
        return may_be, must_be


class OrcaController(CbfQpController):
    """The controller of RVO2: the velocity nearest to the task's that keeps the rows and the speed limit.

    Where no velocity does, it takes the least violation. Its preferred velocity is clip(C theta + d).
    """

    def __init__(self, task: Task, orca: Orca):
        super().__init__(task, (orca,))
