r"""Velocity obstacles: the rows of ORCA for pairs of a robot and a neighbour, and their errors.

`orca` has the formulas. Here they are computed component by component, because two-vectors at the end of a tensor would
be several times slower.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.robots.bounds import ErrorBounds, RowErrors

SINGLE = 2.0**-22
"""Relative errors of differences that are computed in single precision."""


class Pairs(NamedTuple):
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


class PairErrors(NamedTuple):
    """Bounds on the errors of pairs.

    Attributes:
        e: of p [m].
        eps: of v_i and v_j together [m/s].
        sigma: of the sum of the radii [m].
    """

    e: Float[Tensor, "*batch"]
    eps: Float[Tensor, "*batch"]
    sigma: float = 0.0


class Horizon(NamedTuple):
    """T [s], of one branch or of every pair, and tau, a bound on the error of 1/T [1/s]."""

    T: float | Float[Tensor, "*batch"]
    tau: float | Float[Tensor, "*batch"] = 0.0


class Rows(NamedTuple):
    """Rows n.u >= low of one branch, and |w| [m/s], which decides how well n is known on a circle."""

    nx: Float[Tensor, "*batch"]
    ny: Float[Tensor, "*batch"]
    low: Float[Tensor, "*batch"]
    speed: Float[Tensor, "*batch"]


class Geometry(NamedTuple):
    """What the rows of a measurement are made of.

    Attributes:
        pairs: robots and neighbours.
        horizon: the time horizon, or the time step while bodies overlap.
        touches: whether bodies overlap.
        beyond: how far w is beyond the legs, -w.p - R |w| [m^2/s]; positive for a circle.
        turn: det(p, w) [m^2/s].
        on_circle: whether the row is that of a circle.
        rows: the rows of the branches that follow from the numbers as they are.
    """

    pairs: Pairs
    horizon: Horizon
    touches: Bool[Tensor, "*batch m"]
    beyond: Float[Tensor, "*batch m"]
    turn: Float[Tensor, "*batch m"]
    on_circle: Bool[Tensor, "*batch m"]
    rows: Rows


def geometry(pairs: Pairs, apart: Horizon, overlapping: Horizon) -> Geometry:
    """The rows of pairs, and what decides about their branches."""
    touches = pairs.r <= pairs.R
    T, tau = (torch.where(touches, near, far) for near, far in zip(overlapping, apart, strict=True))
    wx, wy = pairs.wx - pairs.px / T, pairs.wy - pairs.py / T
    of_circle = circle(pairs, wx, wy, T)
    beyond = -(wx * pairs.px + wy * pairs.py) - pairs.R * of_circle.speed
    turn = pairs.px * wy - pairs.py * wx
    on_circle = touches | (beyond > 0)
    of_leg = leg(pairs, torch.where(turn > 0, 1.0, -1.0), of_circle.speed)
    nx, ny, low = (torch.where(on_circle, a, b) for a, b in zip(of_circle[:3], of_leg[:3], strict=True))
    return Geometry(pairs, Horizon(T, tau), touches, beyond, turn, on_circle, Rows(nx, ny, low, of_circle.speed))


def is_open(look: Geometry, wrong: PairErrors) -> Bool[Tensor, "*batch m"]:
    """May the controller have taken another branch?"""
    (e, eps, sigma), (T, tau), r, speed = wrong, look.horizon, look.pairs.r, look.rows.speed
    at_T = eps + e / T
    of_w = at_T + (e + r) * tau
    slow = speed <= of_w
    # 2 sin(asin(s)/2) = s sqrt(2/(1 + sqrt(1 - s^2))) <= sqrt(2) s bounds the turn of w/|w|.
    room = (math.sqrt(2) * r) * of_w + speed * (e + sigma)
    cutoff, ahead = look.beyond.abs() <= room, look.beyond <= room
    sides = look.turn.abs() <= r * at_T + e * speed  # det(p, w) does not depend on T
    return ((r - look.pairs.R).abs() <= e + sigma) | (~look.touches & (cutoff | slow | (sides & ahead)))


def uncertainty(pairs: Pairs, bounds: ErrorBounds, sigma: float = 0.0) -> PairErrors:
    """The errors of pairs, single precision included.

    Velocities before t were measured as the controls are, so they are no better known.
    """
    e = pairs.scale * (bounds.position.unsqueeze(-1) + bounds.body_position) + SINGLE * pairs.r
    speeds = pairs.mx.abs() + pairs.my.abs() + pairs.wx.abs() + pairs.wy.abs()
    control = bounds.control.unsqueeze(-1)
    own, others = torch.maximum(bounds.velocity.unsqueeze(-1), control), torch.maximum(bounds.body_velocity, control)
    return PairErrors(e, own + others + SINGLE * speeds, sigma)


def branch_errors(
    pairs: Pairs,
    rows: Rows,
    ux: Float[Tensor, "*batch"],
    uy: Float[Tensor, "*batch"],
    wrong: PairErrors,
    horizon: Horizon,
    on_circle: Bool[Tensor, "*batch"],
) -> RowErrors:
    """The errors of rows whose branch is known."""
    (e, eps, sigma), (T, tau) = wrong, horizon
    clear = pairs.r > e
    r = torch.where(clear, pairs.r, 1.0)
    half = _asin(pairs.R / r)
    nearer = _asin((pairs.R + sigma) / torch.where(clear, r - e, 1.0)) - half
    farther = half - _asin((pairs.R - sigma).clamp(min=0.0) / (r + e))
    legs = torch.where(clear, _asin(e / r) + torch.maximum(nearer, farther), math.pi)
    most = 1 / T + tau
    error = eps + e * most + pairs.r * tau
    known = rows.speed > error
    circles = torch.where(known, _asin(error / torch.where(known, rows.speed, 1.0)), math.pi)
    angle = torch.where(on_circle, circles, legs)
    chord = 2 * (angle / 2).sin()
    from_mean = ((ux - pairs.mx).square() + (uy - pairs.my).square()).sqrt()
    across = (pairs.R + rows.nx * pairs.px + rows.ny * pairs.py).abs()  # 2 T beta
    of_beta = (tau * across + most * (sigma + e + chord * pairs.r)) / 2
    slack = eps / 2 + chord * from_mean + torch.where(on_circle, of_beta, 0.0)
    return RowErrors(angle, slack.masked_fill(angle >= math.pi, math.inf))


def circle(
    pairs: Pairs, wx: Float[Tensor, "*batch"], wy: Float[Tensor, "*batch"], T: float | Float[Tensor, "*batch"]
) -> Rows:
    speed = (wx * wx + wy * wy).sqrt()
    one = 1 / speed  # at w = 0 the direction is unknown: the row is NaN
    nx, ny = wx * one, wy * one
    low = nx * pairs.mx + ny * pairs.my + (pairs.R + nx * pairs.px + ny * pairs.py) / (2 * T)
    return Rows(nx, ny, low, speed)


def leg(pairs: Pairs, side: Float[Tensor, "*batch"], speed: Float[Tensor, "*batch"]) -> Rows:
    """The left (side 1) or right (side -1) leg. Where bodies overlap it is the one of bodies that just touch."""
    squared = pairs.r.square()
    length = side * (squared - pairs.R.square()).clamp(min=0.0).sqrt()
    R, scale = torch.minimum(pairs.R, pairs.r), 1 / squared.clamp(min=1e-300)
    nx, ny = -(R * pairs.px + length * pairs.py) * scale, (length * pairs.px - R * pairs.py) * scale
    return Rows(nx, ny, nx * pairs.mx + ny * pairs.my, speed)


def _asin(ratio: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    return ratio.clamp(max=1).arcsin()


def over_branches(
    pairs: Pairs, rows: Rows, ux: Tensor, uy: Tensor, wrong: PairErrors, apart: Horizon, overlapping: Horizon
) -> RowErrors:
    """The errors of rows that cover every branch possible within the bounds, for selected pairs (k,)."""
    far = pairs.r + wrong.e + wrong.sigma > pairs.R
    near = pairs.r - wrong.e - wrong.sigma <= pairs.R
    no, yes, one = torch.zeros_like(far), torch.ones_like(far), torch.ones_like(pairs.r)
    far_circle, overlap = (
        circle(pairs, pairs.wx - pairs.px / T, pairs.wy - pairs.py / T, T) for T in (apart.T, overlapping.T)
    )
    slack = rows.nx * ux + rows.ny * uy - rows.low
    worst = RowErrors.none(pairs.r)
    for branch, horizon, is_circle, possible in (
        (far_circle, apart, yes, far),
        (leg(pairs, one, far_circle.speed), apart, no, far),
        (leg(pairs, -one, far_circle.speed), apart, no, far),
        (overlap, overlapping, yes, near),
    ):
        own, room = branch_errors(pairs, branch, ux, uy, wrong, horizon, is_circle)
        sin, cos = rows.nx * branch.ny - rows.ny * branch.nx, rows.nx * branch.nx + rows.ny * branch.ny
        room = room + (slack - branch.nx * ux - branch.ny * uy + branch.low).abs()
        worst = RowErrors(
            torch.where(possible, torch.maximum(worst.angle, own + torch.atan2(sin.abs(), cos)), worst.angle),
            torch.where(possible, torch.maximum(worst.slack, room), worst.slack),
        )
    return worst
