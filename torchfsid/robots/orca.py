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

Bounds on errors, with e = rho_i + rho_j, eps = eps_i + eps_j and r = |p|:

    angle    leg: asin(e/r) + asin(R/(r - e)) - asin(R/r)          circle: asin((eps + e/T)/|w|)
    slack    eps/2 + 2 sin(angle/2) |u - (v_i + v_j)/2|     [circle: + (e + 2 sin(angle/2) r)/(2 T)]

If the errors leave open which branch the controller took, a row covers all branches that it may have taken: its angle
reaches their directions, its slack reaches their slacks. The programs compute in single precision, so that positions
and velocities have errors of 2^-22 of their size at least.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, dot
from torchfsid.robots.avoidance import NeighbourVelocity
from torchfsid.robots.bounds import ErrorBounds, RowErrors
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.speed_disc import SpeedDisc

SINGLE = 2.0**-22
"""Relative errors of differences that are computed in single precision."""


class _Pairs(NamedTuple):
    """Robots and neighbours: p [m], r = |p|, R [m], w_rel and the mean velocity (v_i + v_j)/2 [m/s].

    Where a neighbour is pushed away, p was multiplied by `scale`.
    """

    p: Float[Tensor, "*batch 2"]
    r: Float[Tensor, "*batch"]
    R: Float[Tensor, "*batch"]
    w_rel: Float[Tensor, "*batch 2"]
    mean: Float[Tensor, "*batch 2"]
    scale: Float[Tensor, "*batch"]


class _Rows(NamedTuple):
    """Rows n.u >= low of one branch, and |w| [m/s], which decides how well n is known on a circle."""

    n: Float[Tensor, "*batch 2"]
    low: Float[Tensor, "*batch"]
    speed: Float[Tensor, "*batch"]


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

    Raises:
        InputError: a value is not positive (margin and push_away: not negative). When called: the measurement has no
            radii or no velocities before t.
    """

    time_horizon: float
    time_step: float
    max_speed: float
    count: int
    distance: float
    margin: float = 0.0
    push_away: float = 0.0
    relaxes: ClassVar[bool] = True
    uncertain: ClassVar[bool] = True
    neighbour_velocity: ClassVar[NeighbourVelocity] = "previous"

    def __post_init__(self) -> None:
        for name in ("time_horizon", "time_step", "max_speed", "count", "distance"):
            if not getattr(self, name) > 0:
                raise InputError(name, "a positive number", getattr(self, name))
        for name in ("margin", "push_away"):
            if not getattr(self, name) >= 0:
                raise InputError(name, "a distance >= 0 [m]", getattr(self, name))

    @property
    def soft(self) -> bool:
        return True

    @property
    def speed_limit(self) -> float:
        """The radius of the disc of controls, for controllers [m/s]."""
        return self.max_speed

    def __call__(self, measurement: Measurement) -> Halfspaces:
        pairs = self._pairs(measurement)
        return self._stacked(pairs, self._nearest(measurement, pairs.r), measurement)

    def rows_within(self, measurement: Measurement, bounds: ErrorBounds) -> Halfspaces:
        """The rows of all bodies that may be among the chosen neighbours."""
        pairs = self._pairs(measurement)
        e, _ = _uncertainty(pairs, bounds)
        return self._stacked(pairs, self._chosen(measurement, pairs.r, e)[0], measurement)

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        """See the module docstring. A body that may not be among the neighbours has a row that may be violated."""
        u = measurement.u
        assert u is not None
        pairs = self._pairs(measurement)
        e, eps = _uncertainty(pairs, bounds)
        may_be, must_be = self._chosen(measurement, pairs.r, e)
        u = u.unsqueeze(-2).expand_as(pairs.p)
        touches = pairs.r <= pairs.R
        on_circle = touches | _beyond_cutoff(pairs, self._w(pairs, touches))
        T = torch.where(touches, self.time_step, self.time_horizon)
        rows = self._rows(pairs)
        angle, slack = _branch_errors(pairs, rows, u, e, eps, T, on_circle)
        open_at = (self._is_open(pairs, rows, e, eps, touches) & may_be).nonzero(as_tuple=True)
        if len(open_at[0]):
            some, drawn = _Pairs(*(v[open_at] for v in pairs)), _Rows(*(v[open_at] for v in rows))
            wide = self._over_branches(some, drawn, u[open_at], e[open_at], eps[open_at])
            angle, slack = angle.index_put(open_at, wide.angle), slack.index_put(open_at, wide.slack)
        violated = (rows.low - dot(rows.n, u)).clamp(min=0.0)
        slack = torch.where(must_be, slack, torch.maximum(slack, violated))
        of_bodies = RowErrors(torch.where(may_be, angle, 0.0), torch.where(may_be, slack, 0.0))
        return RowErrors.stack([of_bodies, SpeedDisc(self.max_speed).errors(measurement, bounds)])

    def slack_left_out(self, measurement: Measurement) -> Float[Tensor, "*batch"]:
        """Infinite if bodies without a slot are no neighbours: too far, or behind `count` bodies that are nearer."""
        left_out = measurement.left_out
        assert left_out is not None
        r = (measurement.bodies - measurement.x.unsqueeze(-2)).norm(dim=-1)
        nearer = (measurement.present & (r < left_out.distance.unsqueeze(-1))).sum(-1)
        no_neighbour = (left_out.distance >= self.distance) | (nearer >= self.count)
        return torch.where(no_neighbour, math.inf, -math.inf)

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return [*(f"avoid {body}" for body in bodies), "speed"]

    def _pairs(self, measurement: Measurement) -> _Pairs:
        v, others = measurement.velocity, measurement.previous_body_velocities
        if v is None or others is None:
            raise InputError("measurement", "the velocities of robots and bodies one sample earlier", None)
        if measurement.radius is None or measurement.body_radii is None:
            raise InputError("measurement.radius", "radii of robots and bodies", None)
        there = measurement.present.unsqueeze(-1)
        p = torch.where(there, measurement.bodies - measurement.x.unsqueeze(-2), 1.0)
        own = v.unsqueeze(-2)
        others = torch.where(there, others, 0.0)
        r, R = p.norm(dim=-1), measurement.radius.unsqueeze(-1) + measurement.body_radii + self.margin
        scale = torch.ones_like(r)
        if self.push_away:
            near = (r < R + self.push_away) & (r > 0)
            scale = torch.where(near, (R + self.push_away) / torch.where(near, r, 1.0), 1.0)
        return _Pairs(p * scale.unsqueeze(-1), r * scale, R, own - others, (own + others) / 2, scale)

    def _w(self, pairs: _Pairs, touches: Bool[Tensor, "*batch"]) -> Float[Tensor, "*batch 2"]:
        T = torch.where(touches, self.time_step, self.time_horizon)
        return pairs.w_rel - pairs.p / T.unsqueeze(-1)

    def _rows(self, pairs: _Pairs) -> _Rows:
        """The rows of the branches that follow from the numbers as they are."""
        touches = pairs.r <= pairs.R
        w = self._w(pairs, touches)
        circle = _circle(pairs, w, torch.where(touches, self.time_step, self.time_horizon))
        leg = _leg(pairs, torch.where(_det(pairs.p, w) > 0, 1.0, -1.0), circle.speed)
        on_circle = touches | _beyond_cutoff(pairs, w)
        n = torch.where(on_circle.unsqueeze(-1), circle.n, leg.n)
        return _Rows(n, torch.where(on_circle, circle.low, leg.low), circle.speed)

    def _stacked(self, pairs: _Pairs, chosen: Bool[Tensor, "*batch m"], measurement: Measurement) -> Halfspaces:
        rows = self._rows(pairs)
        of_bodies = Halfspaces(-rows.n, -rows.low).where(chosen)
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

    def _is_open(
        self, pairs: _Pairs, rows: _Rows, e: Tensor, eps: Tensor, touches: Bool[Tensor, "*batch"]
    ) -> Bool[Tensor, "*batch"]:
        """May the controller have taken another branch?"""
        w = self._w(pairs, touches)
        T = torch.where(touches, self.time_step, self.time_horizon)
        of_w = eps + e / T
        slow = rows.speed <= of_w
        turned = 2 * (_asin(of_w / torch.where(slow, 1.0, rows.speed)) / 2).sin()
        beyond = -dot(w, pairs.p) - pairs.R * rows.speed
        cutoff = beyond.abs() <= rows.speed * (turned * pairs.r + e)
        sides = _det(pairs.p, w).abs() <= pairs.r * of_w + e * rows.speed
        ahead = beyond <= rows.speed * (turned * pairs.r + e)
        contact = (pairs.r - pairs.R).abs() <= e
        return contact | (~touches & (cutoff | slow | (sides & ahead)))

    def _over_branches(self, pairs: _Pairs, rows: _Rows, u: Tensor, e: Tensor, eps: Tensor) -> RowErrors:
        """The errors of rows that cover every branch possible within the bounds, for selected pairs (k,)."""
        apart, touching = pairs.r + e > pairs.R, pairs.r - e <= pairs.R
        none = torch.zeros_like(apart)
        w, w_touching = self._w(pairs, none), self._w(pairs, ~none)
        far, near = (torch.full_like(pairs.r, T) for T in (self.time_horizon, self.time_step))
        circle, overlap = _circle(pairs, w, far), _circle(pairs, w_touching, near)
        slack = dot(rows.n, u) - rows.low
        worst = RowErrors.none(pairs.r)
        for branch, T, is_circle, possible in (
            (circle, far, ~none, apart),
            (_leg(pairs, torch.ones_like(pairs.r), circle.speed), far, none, apart),
            (_leg(pairs, -torch.ones_like(pairs.r), circle.speed), far, none, apart),
            (overlap, near, ~none, touching),
        ):
            own, room = _branch_errors(pairs, branch, u, e, eps, T, is_circle)
            between = torch.atan2(_det(rows.n, branch.n).abs(), dot(rows.n, branch.n))
            room = room + (slack - dot(branch.n, u) + branch.low).abs()
            worst = RowErrors(
                torch.where(possible, torch.maximum(worst.angle, own + between), worst.angle),
                torch.where(possible, torch.maximum(worst.slack, room), worst.slack),
            )
        return worst


def _uncertainty(pairs: _Pairs, bounds: ErrorBounds) -> tuple[Float[Tensor, "*batch m"], Float[Tensor, "*batch m"]]:
    """e [m] and eps [m/s], single precision included."""
    e = pairs.scale * (bounds.position.unsqueeze(-1) + bounds.body_position) + SINGLE * pairs.r
    speeds = pairs.mean.abs().sum(-1) + pairs.w_rel.abs().sum(-1)
    return e, bounds.velocity.unsqueeze(-1) + bounds.body_velocity + SINGLE * speeds


def _branch_errors(
    pairs: _Pairs,
    rows: _Rows,
    u: Float[Tensor, "*batch 2"],
    e: Float[Tensor, "*batch"],
    eps: Float[Tensor, "*batch"],
    T: Float[Tensor, "*batch"],
    on_circle: Bool[Tensor, "*batch"],
) -> RowErrors:
    """The errors of rows whose branch is known."""
    clear = pairs.r > e
    r = torch.where(clear, pairs.r, 1.0)
    half = _asin(pairs.R / r)
    nearer, farther = _asin(pairs.R / torch.where(clear, r - e, 1.0)) - half, half - _asin(pairs.R / (r + e))
    legs = torch.where(clear, _asin(e / r) + torch.maximum(nearer, farther), math.pi)
    error = eps + e / T
    known = rows.speed > error
    circle = torch.where(known, _asin(error / torch.where(known, rows.speed, 1.0)), math.pi)
    angle = torch.where(on_circle, circle, legs)
    chord = 2 * (angle / 2).sin()
    slack = eps / 2 + chord * (u - pairs.mean).norm(dim=-1)
    slack = slack + torch.where(on_circle, (e + chord * pairs.r) / (2 * T), 0.0)
    return RowErrors(angle, torch.where(angle < math.pi, slack, math.inf))


def _circle(pairs: _Pairs, w: Float[Tensor, "*batch 2"], T: Float[Tensor, "*batch"]) -> _Rows:
    speed = w.norm(dim=-1)
    known = speed > 0  # otherwise the direction is unknown: the row is NaN
    n = torch.where(known.unsqueeze(-1), w / torch.where(known, speed, 1.0).unsqueeze(-1), math.nan)
    return _Rows(n, dot(n, pairs.mean) + (pairs.R + dot(n, pairs.p)) / (2 * T), speed)


def _leg(pairs: _Pairs, side: Float[Tensor, "*batch"], speed: Float[Tensor, "*batch"]) -> _Rows:
    """The left (side 1) or right (side -1) leg. Where bodies overlap it is the one of bodies that just touch."""
    x, y = pairs.p.unbind(-1)
    apart = pairs.r > pairs.R
    length = torch.where(apart, pairs.r.square() - pairs.R.square(), 1.0).sqrt() * apart
    turned = side * torch.minimum(pairs.R, pairs.r)
    size = torch.where(pairs.r > 0, pairs.r.square(), 1.0)
    n = torch.stack([-(turned * x + y * length), x * length - turned * y], dim=-1) * (side / size).unsqueeze(-1)
    return _Rows(n, dot(n, pairs.mean), speed)


def _beyond_cutoff(pairs: _Pairs, w: Float[Tensor, "*batch 2"]) -> Bool[Tensor, "*batch"]:
    """Is the relative velocity nearer to the cut-off circle than to the legs?"""
    towards = dot(w, pairs.p)
    return (towards < 0) & (towards.square() > pairs.R.square() * w.square().sum(-1))


def _det(a: Float[Tensor, "*batch 2"], b: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _asin(ratio: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    return ratio.clamp(0, 1).arcsin()
