r"""The commands of unicycles, recovered from their poses.

A unicycle at x with heading theta drives at v along e = (cos theta, sin theta) and turns at w. It follows the command u
of a single integrator by a map. With e' the unit vector across e, on its left,

    si_to_uni    v = g e.u,   w = (2/pi) c angle,   angle = atan2(e'.u, e.u)        g: linear_gain, c: angular_limit
    look_ahead   v = e.u,     w = e'.u / l,         and u is computed for the point p = x + l e      l: distance

(v, w) is held from t to t_+. Simulators (rps) take a straight step, others and real robots move on an arc. With
h = t_+ - t, y = wrap(theta_+ - theta) / 2 and d = x_+ - x,

    w = 2 y / h,     v = e.d / h                                   a straight step along e
                     v = (y / sin y) e_y.d / h                     an arc; its chord is along e_y, at theta + y
    si_to_uni    u = v/g (e + tan(angle) e'),  angle = (pi/2) w/c;     scaled_angle: u = v (e/g + tan(angle) e')
    look_ahead   u = v e + l w e'

The angle of rps 2 is that of the command. In rps 1, and in both where robots may drive backwards, it is that of
(g e.u, e'.u), of (|v|, +-e'.u) if they do: `scaled_angle`. tan has the period pi, so driving backwards needs no case.

**What the poses do not determine.** A command across the heading gives v = 0, whatever its size. If a wheel,
v +- w b/2, or the turn rate is at its limit, (v, w) is not what the map asked for. Commands are then unknown.

**Errors.** Let positions be wrong by rho and rho_+, headings by eps, and V = |d|/h + (rho + rho_+)/h. Then

    |v error| <= a = f ((rho + rho_+)/h + V (1 - cos eps)) + (f_+ - f) V      f = 1 for a straight step
    |w error| <= 2 eps / h                                    f = y / sin y, f_+ the same at |y| + eps, for an arc

The components of u along e and e' are wrong by at most a/g and, with A = |angle| folded into [0, pi/2) and A_+ = A +
(pi/2) (2 eps/h) / c, by (|v| + a)(tan A_+ - tan A) + a tan A, or by a and 2 l eps/h for look_ahead. Together these are
wrong by r, their root sum of squares, and e by 2 sin(eps/2): |u error| <= r + 2 sin(eps/2) (|u| + r).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from torchfsid.config.bodies import UnicycleConfig
from torchfsid.errors import ConfigError

STILL = 1e-9
"""A unicycle that drives more slowly stands [m/s]. By si_to_uni it then turns only if a wheel is at its limit."""

AT_LIMIT = 1e-3
"""A wheel or turn rate this close to its limit, relative to it, beside its error, may be at it."""

ACROSS = 1e-6
"""A command closer than this to the direction across the heading is not determined [rad]."""

SIDEWAYS = 0.5
"""Share of the way across the headings above which they are no headings of unicycles. Of random headings it is 0.64."""


@dataclass(frozen=True)
class Poses:
    """Poses of bodies at the same times.

    Attributes:
        t: times [s].
        x: positions [m].
        heading: headings [rad].
        known: the pose is known.
        position_error: bounds on the errors of positions [m].
        heading_error: a bound on the errors of headings [rad].
    """

    t: Float[np.ndarray, "times"]
    x: Float[np.ndarray, "times bodies 2"]
    heading: Float[np.ndarray, "times bodies"]
    known: Bool[np.ndarray, "times bodies"]
    position_error: Float[np.ndarray, "times bodies"]
    heading_error: float

    @property
    def along(self) -> Float[np.ndarray, "times bodies 2"]:
        """The unit vectors along the headings."""
        return _unit(self.heading)

    def ahead(self, body: UnicycleConfig) -> Float[np.ndarray, "times bodies 2"]:
        """The points that are commanded [m]. Where the pose is unknown, the position."""
        return self.x + np.where(self.known[..., None], (body.distance or 0.0) * self.along, 0.0)

    def ahead_error(self, body: UnicycleConfig) -> float:
        """A bound on what headings add to the errors of these points [m]."""
        return 2 * (body.distance or 0.0) * math.sin(min(self.heading_error, math.pi) / 2)

    def sideways(self, is_arc: bool) -> tuple[float, float, float]:
        """How far the bodies move sideways, from each pose to the next. Ways within errors of positions do not count.

        Args:
            is_arc: along arcs, or along straight steps.

        Returns:
            The sum of squares of the sideways parts [m2], their sum, and the sum of the ways [m].
        """
        d = np.diff(self.x, axis=0)
        way = np.linalg.norm(d, axis=-1)
        error = self.position_error[:-1] + self.position_error[1:]
        moves = self.known[:-1] & self.known[1:] & (way > 2 * error)
        direction = _unit(self.heading[:-1] + (self.half_turn if is_arc else 0.0))
        across = np.abs(_dot(_left(direction), d))[moves]
        return float((across**2).sum()), float(across.sum()), float(way[moves].sum())

    @property
    def half_turn(self) -> Float[np.ndarray, "intervals bodies"]:
        """Half the turn from each pose to the next [rad]."""
        turn = np.diff(self.heading, axis=0)
        return np.arctan2(np.sin(turn), np.cos(turn)) / 2


@dataclass(frozen=True)
class Commands:
    """The commands from each pose but the last. They are zero where unknown.

    Attributes:
        u: the commands [m/s].
        error: bounds on their errors [m/s].
        known: the command is known.
        limited: it is unknown because a wheel or the turn rate may be at its limit.
        undetermined: it is unknown because the poses do not determine it.
    """

    u: Float[np.ndarray, "intervals bodies 2"]
    error: Float[np.ndarray, "intervals bodies"]
    known: Bool[np.ndarray, "intervals bodies"]
    limited: Bool[np.ndarray, "intervals bodies"]
    undetermined: Bool[np.ndarray, "intervals bodies"]

    def of_body(self, j: int) -> Commands:
        """The commands of one of the bodies."""
        return Commands(self.u[:, [j]], *(mask[:, [j]] for mask in list(vars(self).values())[1:]))


@dataclass(frozen=True)
class Motion:
    """What bodies did from each pose to the next.

    Attributes:
        v: speeds along the headings [m/s].
        w: turn rates [rad/s].
        v_error: bounds on the errors of `v` [m/s].
        w_error: bounds on the errors of `w` [rad/s].
        known: both poses are known, and the turn between them was less than half a turn.
    """

    v: Float[np.ndarray, "intervals bodies"]
    w: Float[np.ndarray, "intervals bodies"]
    v_error: Float[np.ndarray, "intervals bodies"]
    w_error: Float[np.ndarray, "intervals bodies"]
    known: Bool[np.ndarray, "intervals bodies"]

    @classmethod
    def of(cls, poses: Poses, is_arc: bool) -> Motion:
        """The motion by straight steps, or along arcs (module docstring)."""
        h, eps = np.diff(poses.t)[:, None], poses.heading_error
        y, d = poses.half_turn, np.diff(poses.x, axis=0)
        reach = (poses.position_error[:-1] + poses.position_error[1:]) / h
        largest = np.linalg.norm(d, axis=-1) / h + reach
        unwound = 2 * (np.abs(y) + eps) < math.pi
        f = f_beyond = np.ones_like(y)
        chord = poses.along[:-1]
        if is_arc:
            f, f_beyond = (_arc_to_chord(np.where(unwound, angle, 0.0)) for angle in (np.abs(y), np.abs(y) + eps))
            chord = _unit(poses.heading[:-1] + y)
        v_error = f * (reach + largest * (1 - math.cos(min(eps, math.pi)))) + (f_beyond - f) * largest
        return cls(
            v=f * _dot(chord, d) / h,
            w=2 * y / h,
            v_error=v_error,
            w_error=np.broadcast_to(2 * eps / h, y.shape),
            known=poses.known[:-1] & poses.known[1:] & unwound,
        )


class WheelLimit(NamedTuple):
    """No wheel drives faster than `speed` [m/s]; the wheels are `base` [m] apart.

    A motion may be at the limit from `speed - margin` on, beside its error.
    """

    speed: float
    base: float
    margin: float


def commands(poses: Poses, motion: Motion, body: UnicycleConfig, limits: Sequence[WheelLimit] = ()) -> Commands:
    """The commands of unicycles with these poses and this motion, see the module docstring."""
    e, eps = poses.along[:-1], poses.heading_error
    v, w, v_error, w_error = motion.v, motion.w, motion.v_error, motion.w_error
    limited = np.zeros_like(motion.known)
    for limit in limits:
        half = limit.base / 2
        limited |= np.abs(v) + half * np.abs(w) + v_error + half * w_error >= limit.speed - limit.margin
    undetermined = ~motion.known
    if body.distance is not None:
        if body.angular_limit is not None:
            limited |= np.abs(w) + w_error >= (1 - AT_LIMIT) * body.angular_limit
        ahead, left = v, body.distance * w
        ahead_error, left_error = v_error, body.distance * w_error
    else:
        per_rate = math.pi / 2 / body.rate_across
        angle = per_rate * w
        folded = np.abs(np.remainder(angle + math.pi / 2, math.pi) - math.pi / 2)
        beyond = folded + per_rate * w_error
        undetermined |= (beyond >= math.pi / 2 - ACROSS) | (
            np.abs(angle) > math.pi * (1 + AT_LIMIT) + per_rate * w_error
        )
        undetermined |= (np.abs(v) <= STILL) & (folded > ACROSS)
        gain_across = 1.0 if body.scaled_angle else body.linear_gain
        slope, steepest = np.tan(folded), np.tan(np.where(undetermined, folded, beyond))
        ahead, ahead_error = v / body.linear_gain, v_error / body.linear_gain
        left = v * np.tan(angle) / gain_across
        left_error = ((np.abs(v) + v_error) * (steepest - slope) + v_error * slope) / gain_across
    known = motion.known & ~limited & ~undetermined
    u = ahead[..., None] * e + left[..., None] * _left(e)
    error = np.hypot(ahead_error, left_error)
    error = error + 2 * math.sin(min(eps, math.pi) / 2) * (np.linalg.norm(u, axis=-1) + error)
    there = poses.known[:-1] & poses.known[1:]
    return Commands(
        u=np.where(known[..., None], u, 0.0),
        error=np.where(known, error, 0.0),
        known=known,
        limited=there & limited,
        undetermined=there & undetermined & ~limited,
    )


def moves_on_arcs(of_bodies: Sequence[Poses]) -> bool:
    """Do the bodies move on arcs rather than by straight steps? Decided by what leaves less of the way sideways.

    Raises:
        ConfigError: either way much of the way is sideways, so that the headings are wrong.
    """
    straight, arcs = (np.sum([poses.sideways(is_arc) for poses in of_bodies], axis=0) for is_arc in (False, True))
    is_arc = bool(arcs[0] < straight[0])
    _, across, way = (arcs if is_arc else straight).tolist()
    if across > SIDEWAYS * way:
        raise ConfigError(
            f"body.heading: unicycles cannot move sideways, but {100 * across / way:.0f} % of the way in this log is "
            "across the headings: expected radians, anticlockwise from the x-axis (not degrees), and noise.position"
        )
    return is_arc


def _unit(angle: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _left(e: np.ndarray) -> np.ndarray:
    """The vectors turned by 90 degrees to the left."""
    return np.stack([-e[..., 1], e[..., 0]], axis=-1)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(axis=-1)


def _arc_to_chord(angle: np.ndarray) -> np.ndarray:
    """The length of an arc, divided by that of its chord, for half its turn >= 0 [rad]."""
    return 1 / np.sinc(angle / math.pi)
