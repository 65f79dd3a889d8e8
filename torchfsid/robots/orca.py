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
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.robots.avoidance import NeighbourVelocity
from torchfsid.robots.bounds import ErrorBounds, RowErrors
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.speed_disc import SpeedDisc

SINGLE = 2.0**-22
"""Relative errors of differences that are computed in single precision."""


class _Pairs(NamedTuple):
    """Robots and neighbours, component by component: two-vectors at the end of a tensor would be several times slower.

    Attributes:
        px, py: p [m].
        r: |p| [m].
        R: the sum of the radii [m].
        wx, wy: w_rel [m/s].
        mx, my: the mean velocity (v_i + v_j)/2 [m/s].
        scale: by which p was multiplied where a neighbour is pushed away.
    """

    px: Float[Tensor, "*batch"]
    py: Float[Tensor, "*batch"]
    r: Float[Tensor, "*batch"]
    R: Float[Tensor, "*batch"]
    wx: Float[Tensor, "*batch"]
    wy: Float[Tensor, "*batch"]
    mx: Float[Tensor, "*batch"]
    my: Float[Tensor, "*batch"]
    scale: Float[Tensor, "*batch"]


class _Rows(NamedTuple):
    """Rows n.u >= low of one branch, and |w| [m/s], which decides how well n is known on a circle."""

    nx: Float[Tensor, "*batch"]
    ny: Float[Tensor, "*batch"]
    low: Float[Tensor, "*batch"]
    speed: Float[Tensor, "*batch"]


class _Look(NamedTuple):
    """What the rows of a measurement are made of.

    Attributes:
        measurement: the measurement.
        pairs: robots and neighbours.
        T: time horizon, or time step while bodies overlap [s].
        touches: whether bodies overlap.
        beyond: how far w is beyond the legs, -w.p - R |w| [m^2/s]; positive for a circle.
        turn: det(p, w) [m^2/s].
        on_circle: whether the row is that of a circle.
        rows: the rows of the branches that follow from the numbers as they are.
    """

    measurement: Measurement
    pairs: _Pairs
    T: Float[Tensor, "*batch m"]
    touches: Bool[Tensor, "*batch m"]
    beyond: Float[Tensor, "*batch m"]
    turn: Float[Tensor, "*batch m"]
    on_circle: Bool[Tensor, "*batch m"]
    rows: _Rows


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
    _looks: list[_Look] = field(init=False, default_factory=list, repr=False, compare=False)

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
        look = self._look(measurement)
        return self._stacked(look, self._nearest(measurement, look.pairs.r))

    def rows_within(self, measurement: Measurement, bounds: ErrorBounds) -> Halfspaces:
        """The rows of all bodies that may be among the chosen neighbours."""
        look = self._look(measurement)
        e, _ = _uncertainty(look.pairs, bounds)
        return self._stacked(look, self._chosen(measurement, look.pairs.r, e)[0])

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        """See the module docstring. A body that may not be among the neighbours has a row that may be violated."""
        assert measurement.u is not None
        look = self._look(measurement)
        pairs, rows = look.pairs, look.rows
        e, eps = _uncertainty(pairs, bounds)
        may_be, must_be = self._chosen(measurement, pairs.r, e)
        ux, uy = (component.unsqueeze(-1).expand_as(e) for component in measurement.u.unbind(-1))
        angle, slack = _branch_errors(pairs, rows, ux, uy, e, eps, look.T, look.on_circle)
        open_at = (_is_open(look, e, eps) & may_be).nonzero(as_tuple=True)
        if len(open_at[0]):
            some, own = _Pairs(*(v[open_at] for v in pairs)), _Rows(*(v[open_at] for v in rows))
            wide = self._over_branches(some, own, *(v[open_at] for v in (ux, uy, e, eps)))
            angle, slack = angle.index_put(open_at, wide.angle), slack.index_put(open_at, wide.slack)
        if not bool((must_be == may_be).all()):
            violated = (rows.low - rows.nx * ux - rows.ny * uy).clamp(min=0.0)
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

    def _look(self, measurement: Measurement) -> _Look:
        """The rows' geometry. It is kept, since rows and errors of one measurement ask for it in turn."""
        last = self._looks[-1] if self._looks else None
        if last is None or last.measurement is not measurement:
            pairs = self._pairs(measurement)
            touches = pairs.r <= pairs.R
            T = torch.where(touches, self.time_step, self.time_horizon)
            wx, wy = pairs.wx - pairs.px / T, pairs.wy - pairs.py / T
            circle = _circle(pairs, wx, wy, T)
            beyond = -(wx * pairs.px + wy * pairs.py) - pairs.R * circle.speed
            turn = pairs.px * wy - pairs.py * wx
            on_circle = touches | (beyond > 0)
            leg = _leg(pairs, torch.where(turn > 0, 1.0, -1.0), circle.speed)
            nx, ny, low = (torch.where(on_circle, one, other) for one, other in zip(circle[:3], leg[:3], strict=True))
            rows = _Rows(nx, ny, low, circle.speed)
            last = _Look(measurement, pairs, T, touches, beyond, turn, on_circle, rows)
            self._looks[:] = [] if rows.low.requires_grad else [last]  # a graph can be followed once only
        return last

    def _pairs(self, measurement: Measurement) -> _Pairs:
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
        return _Pairs(px, py, r, R, vx - jvx, vy - jvy, (vx + jvx) / 2, (vy + jvy) / 2, scale)

    def _stacked(self, look: _Look, chosen: Bool[Tensor, "*batch m"]) -> Halfspaces:
        n = torch.stack([-look.rows.nx, -look.rows.ny], dim=-1)
        of_bodies = Halfspaces(n, -look.rows.low).where(chosen)
        return Halfspaces.stack([of_bodies, SpeedDisc(self.max_speed)(look.measurement)])

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

    def _over_branches(self, pairs: _Pairs, rows: _Rows, ux: Tensor, uy: Tensor, e: Tensor, eps: Tensor) -> RowErrors:
        """The errors of rows that cover every branch possible within the bounds, for selected pairs (k,)."""
        apart, touching = pairs.r + e > pairs.R, pairs.r - e <= pairs.R
        no, yes, one = torch.zeros_like(apart), torch.ones_like(apart), torch.ones_like(pairs.r)
        far, near = self.time_horizon * one, self.time_step * one
        circle, overlap = (_circle(pairs, pairs.wx - pairs.px / T, pairs.wy - pairs.py / T, T) for T in (far, near))
        slack = rows.nx * ux + rows.ny * uy - rows.low
        worst = RowErrors.none(pairs.r)
        for branch, T, is_circle, possible in (
            (circle, far, yes, apart),
            (_leg(pairs, one, circle.speed), far, no, apart),
            (_leg(pairs, -one, circle.speed), far, no, apart),
            (overlap, near, yes, touching),
        ):
            own, room = _branch_errors(pairs, branch, ux, uy, e, eps, T, is_circle)
            sin, cos = rows.nx * branch.ny - rows.ny * branch.nx, rows.nx * branch.nx + rows.ny * branch.ny
            room = room + (slack - branch.nx * ux - branch.ny * uy + branch.low).abs()
            worst = RowErrors(
                torch.where(possible, torch.maximum(worst.angle, own + torch.atan2(sin.abs(), cos)), worst.angle),
                torch.where(possible, torch.maximum(worst.slack, room), worst.slack),
            )
        return worst


def _is_open(look: _Look, e: Float[Tensor, "*batch m"], eps: Float[Tensor, "*batch m"]) -> Bool[Tensor, "*batch m"]:
    """May the controller have taken another branch?"""
    r, speed = look.pairs.r, look.rows.speed
    of_w = eps + e / look.T
    slow = speed <= of_w
    # 2 sin(asin(s)/2) = s sqrt(2/(1 + sqrt(1 - s^2))) <= sqrt(2) s bounds the turn of w/|w|.
    room = (math.sqrt(2) * r) * of_w + speed * e
    cutoff, ahead = look.beyond.abs() <= room, look.beyond <= room
    sides = look.turn.abs() <= r * of_w + e * speed
    return ((r - look.pairs.R).abs() <= e) | (~look.touches & (cutoff | slow | (sides & ahead)))


def _uncertainty(pairs: _Pairs, bounds: ErrorBounds) -> tuple[Float[Tensor, "*batch m"], Float[Tensor, "*batch m"]]:
    """e [m] and eps [m/s], single precision included."""
    e = pairs.scale * (bounds.position.unsqueeze(-1) + bounds.body_position) + SINGLE * pairs.r
    speeds = pairs.mx.abs() + pairs.my.abs() + pairs.wx.abs() + pairs.wy.abs()
    return e, bounds.velocity.unsqueeze(-1) + bounds.body_velocity + SINGLE * speeds


def _branch_errors(
    pairs: _Pairs,
    rows: _Rows,
    ux: Float[Tensor, "*batch"],
    uy: Float[Tensor, "*batch"],
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
    from_mean = ((ux - pairs.mx).square() + (uy - pairs.my).square()).sqrt()
    slack = eps / 2 + chord * from_mean + on_circle * ((e + chord * pairs.r) / (2 * T))
    return RowErrors(angle, slack.masked_fill(angle >= math.pi, math.inf))


def _circle(
    pairs: _Pairs, wx: Float[Tensor, "*batch"], wy: Float[Tensor, "*batch"], T: Float[Tensor, "*batch"]
) -> _Rows:
    speed = (wx * wx + wy * wy).sqrt()
    one = 1 / speed  # at w = 0 the direction is unknown: the row is NaN
    nx, ny = wx * one, wy * one
    low = nx * pairs.mx + ny * pairs.my + (pairs.R + nx * pairs.px + ny * pairs.py) / (2 * T)
    return _Rows(nx, ny, low, speed)


def _leg(pairs: _Pairs, side: Float[Tensor, "*batch"], speed: Float[Tensor, "*batch"]) -> _Rows:
    """The left (side 1) or right (side -1) leg. Where bodies overlap it is the one of bodies that just touch."""
    squared = pairs.r.square()
    length = side * (squared - pairs.R.square()).clamp(min=0.0).sqrt()
    R, scale = torch.minimum(pairs.R, pairs.r), 1 / squared.clamp(min=1e-300)
    nx, ny = -(R * pairs.px + length * pairs.py) * scale, (length * pairs.px - R * pairs.py) * scale
    return _Rows(nx, ny, nx * pairs.mx + ny * pairs.my, speed)


def _asin(ratio: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    return ratio.clamp(max=1).arcsin()
