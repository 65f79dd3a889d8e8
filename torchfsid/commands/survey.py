"""What the bodies of a log do, in numbers: where they are, how fast, how close, who stands still.

From these a configuration is filled in (`init`). Guesses are named as such. The gain of a goal task is guessed from
the second half of the log, where robots are often free of each other, by least squares

    u = gain (theta - x) - damping v            theta: a constant for each robot; no damping at first order

The gain of an avoidance barrier, h = |dx|^2 - Ds^2, is the smallest that forbids nothing that was seen:

    h' + gain h >= 0        or      h'' + 2 gain h' + gain^2 h >= 0
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from torchfsid.logs.log import Log

STILL = 0.01
"""Share of the largest way and speed of a body, below which another one stands still."""

RESTLESS = 0.1
"""Change of velocity from one sample to the next, as a share of the typical speed, from which on differences of
positions are errors of measurement rather than commands."""

CLIPPED = 0.02
"""Controls are at their limit within this share of it."""

FITS = 0.1
"""Relative residual of a fit up to which it is a guess worth making."""

FITTING = 0.3
"""Share of the samples that have to fit."""

ROUNDS = 8
"""Fits, each without the samples that the one before explained badly."""

FEW = 10
"""Samples below which nothing is guessed."""

TURNED = 0.1
"""Headings that differ by less are none: whatever wrote the log has left orientations out [rad]."""

DRIFT = 0.25
"""Sine of the angle between velocity and heading below which a body drives along its heading, and is a unicycle."""


@dataclass(frozen=True)
class GoalGuess:
    """A guess of the task: gain [1/s], or gain [1/s2] and damping [1/s]."""

    gain: float
    damping: float | None = None


@dataclass(frozen=True)
class Survey:
    """What the bodies of a log do.

    Attributes:
        log: the log.
        moving: which bodies move. All, if none does.
        step: median time between samples [s].
        closest: the smallest distance between two bodies [m], infinite for one body.
        clearance: the smallest distance between the discs of two bodies [m], if the log has radii.
        controls: the controls: accelerations, velocities, or differences of positions.
        known: where they are known.
        fastest: the largest control of a moving body [m/s or m/s2].
        typical: the median of the controls of moving bodies, where they are not almost zero.
        jitter: three standard deviations of positions [m], as if all that differences of third order show were errors.
        is_restless: do positions alone not give velocities (`RESTLESS`)?
        is_unicycle: do bodies have headings, and drive along them?
        limited: `box` or `disc` if controls are often at a common limit, otherwise None.
        goal: a guess of the task, or None.
    """

    log: Log
    moving: Bool[np.ndarray, "bodies"]
    step: float
    closest: float
    clearance: float
    controls: Float[np.ndarray, "times bodies n"]
    known: Bool[np.ndarray, "times bodies"]
    fastest: float
    typical: float
    jitter: float
    is_restless: bool
    is_unicycle: bool
    limited: str | None
    goal: GoalGuess | None

    @property
    def names(self) -> tuple[list[str], list[str]]:
        """The bodies that move, and those that stand still."""
        pairs = list(zip(self.log.bodies, self.moving.tolist(), strict=True))
        return [body for body, moves in pairs if moves], [body for body, moves in pairs if not moves]

    @property
    def extent(self) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """The box in which the moving bodies were [m]."""
        x = self.log.x[:, self.moving][self.log.seen[:, self.moving]]
        return x.min(axis=0), x.max(axis=0)

    def least_gain(self, safety_distance: float) -> float | None:
        """The smallest gain of an avoidance barrier that forbids nothing seen [1/s]. None if there is none.

        Args:
            safety_distance: Ds [m].
        """
        if self.is_restless or (self.log.a is not None and self.log.u is None):
            return None
        return _least_gain(self, safety_distance)


def survey(log: Log) -> Survey:
    """Measure what the bodies of a log do.

    Raises:
        LogError: the log has positions only, and a difference quotient is not finite.
    """
    controls, known = log.controls
    has_controls = controls is not None
    if controls is None:
        differences = replace(log, heading=None, oriented=None).differentiated()
        assert differences.u is not None
        last = np.zeros_like(log.x[:1])
        controls = np.concatenate([differences.u, last])
        known = np.concatenate([differences.velocity_known, np.zeros_like(log.seen[:1])])
    moving = _moving(log, controls, known)
    u, there = controls[:, moving], known[:, moving]
    sizes = np.linalg.norm(u, axis=-1)[there]
    fastest = float(sizes.max(initial=0.0))
    awake = sizes[sizes > STILL * fastest]
    typical = float(np.median(awake)) if len(awake) else 0.0
    jumps = np.linalg.norm(np.diff(u, axis=0), axis=-1)[there[1:] & there[:-1]]
    is_restless = not has_controls and len(jumps) > 0 and float(np.median(jumps)) > RESTLESS * typical
    return Survey(
        log=log,
        moving=moving,
        step=float(np.median(np.diff(log.t))),
        closest=_closest(log, np.zeros(len(log.bodies))),
        clearance=_closest(log, np.zeros(len(log.bodies)) if log.radius is None else log.radius),
        controls=controls,
        known=known,
        fastest=fastest,
        typical=typical,
        jitter=_jitter(log),
        is_restless=is_restless,
        is_unicycle=_is_unicycle(log, controls, known, moving),
        limited=_limited(u[there]),
        goal=None if is_restless else _goal(log, controls, known, np.flatnonzero(moving)),
    )


def _moving(log: Log, controls: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Which bodies leave their place or have a control."""
    x = np.where(log.seen[..., None], log.x, np.nan)
    ways = np.array([np.linalg.norm(np.nanmax(of, axis=0) - np.nanmin(of, axis=0)) for of in x.swapaxes(0, 1)])
    speeds = np.where(known, np.linalg.norm(controls, axis=-1), 0.0)
    if log.u is None:  # differences of a body at rest are errors, however large
        speeds = np.zeros_like(speeds)
    fastest = speeds.max(axis=0)
    moving = (ways > STILL * ways.max()) | (fastest > STILL * fastest.max())
    return moving if moving.any() and ways.max() > 0 else np.ones(len(log.bodies), dtype=bool)


def _closest(log: Log, radius: np.ndarray) -> float:
    """The smallest distance between the discs of two bodies that are there at the same time."""
    closest = math.inf
    for i in range(len(log.bodies) - 1):
        apart = np.linalg.norm(log.x[:, i + 1 :] - log.x[:, i : i + 1], axis=-1) - radius[i + 1 :] - radius[i]
        closest = min(closest, float(apart[log.seen[:, i + 1 :] & log.seen[:, i : i + 1]].min(initial=math.inf)))
    return closest


def _jitter(log: Log) -> float:
    """Three standard deviations of positions. Third differences of white noise have 20 times its variance."""
    together = log.seen[3:] & log.seen[2:-1] & log.seen[1:-2] & log.seen[:-3]
    thirds = np.abs(np.diff(log.x, n=3, axis=0))[together]
    return 3 * float(np.median(thirds)) / 0.6745 / math.sqrt(20) if len(thirds) else 0.0


def _is_unicycle(log: Log, controls: np.ndarray, known: np.ndarray, moving: np.ndarray) -> bool:
    """Do the bodies drive along their headings, or against them?"""
    if log.heading is None or log.oriented is None or log.a is not None:
        return False
    speeds = np.linalg.norm(controls, axis=-1)
    chosen = known & log.oriented & moving & (speeds > 0.2 * speeds[known].max(initial=0.0))
    if chosen.sum() < FEW or float(np.ptp(np.unwrap(np.sort(log.heading[chosen])))) < TURNED:
        return False
    ahead = np.stack([np.cos(log.heading), np.sin(log.heading)], axis=-1)[chosen]
    u = controls[chosen]
    across = np.abs(ahead[:, 0] * u[:, 1] - ahead[:, 1] * u[:, 0]) / speeds[chosen]
    return float(np.median(across)) < DRIFT


def _limited(u: np.ndarray) -> str | None:
    """Are controls [m/s or m/s2] often at their largest: by axis, or by norm?"""
    if len(u) < FEW:
        return None
    sizes, axes = np.linalg.norm(u, axis=-1), np.abs(u)
    largest, by_axis = sizes.max(), axes.max(axis=0)
    if largest == 0:
        return None
    at_disc = float((sizes > (1 - CLIPPED) * largest).mean())
    at_box = float((axes > (1 - CLIPPED) * np.where(by_axis > 0, by_axis, np.inf)).any(axis=-1).mean())
    if max(at_disc, at_box) < 2 * CLIPPED:
        return None
    return "disc" if at_disc >= at_box else "box"


def _goal(log: Log, controls: np.ndarray, known: np.ndarray, robots: np.ndarray) -> GoalGuess | None:
    """The gain that explains the second half of the log best, if it explains it well (module docstring)."""
    sizes = np.linalg.norm(controls, axis=-1)
    largest = np.abs(controls[known]).max(axis=0, initial=0.0)
    columns, u, owner = [], [], []
    for j in robots.tolist():
        there = np.flatnonzero(known[:, j] & log.seen[:, j])
        tail = there[len(there) // 2 :]
        free = (sizes[tail, j] < 0.9 * sizes[known].max()) & (np.abs(controls[tail, j]) <= 0.9 * largest).all(axis=-1)
        tail = tail[free & (sizes[tail, j] > 1e-6 * sizes[known].max())]
        of_axes = [-log.x[tail, j]] if log.a is None or log.u is None else [-log.x[tail, j], -log.u[tail, j]]
        columns.append(np.stack(of_axes, axis=-1).reshape(-1, len(of_axes)))
        u.append(controls[tail, j].reshape(-1))
        owner.append(np.tile(j * log.x.shape[-1] + np.arange(log.x.shape[-1]), len(tail)))
    gains = _fitted(np.concatenate(columns), np.concatenate(u), np.concatenate(owner))
    if gains is None:
        return None
    return GoalGuess(gains[0], gains[1] if len(gains) > 1 else None)


def _fitted(columns: np.ndarray, u: np.ndarray, owner: np.ndarray) -> list[float] | None:
    """Least squares with a constant for each owner. Samples that fit badly are left out: other rows were active."""
    kept = np.ones(len(u), dtype=bool)
    gains, off = np.zeros(columns.shape[1]), np.zeros(len(u))
    for _ in range(ROUNDS):
        if kept.sum() < FEW * columns.shape[1]:
            return None
        centred = np.concatenate([columns, u[:, None]], axis=1)
        for one in np.unique(owner):
            mine = owner == one
            centred[mine] -= centred[mine & kept].mean(axis=0) if (mine & kept).any() else np.nan
        kept &= np.isfinite(centred).all(axis=1)
        gains, *_ = np.linalg.lstsq(centred[kept, :-1], centred[kept, -1], rcond=None)
        off = np.abs(centred[:, :-1] @ gains - centred[:, -1])
        size = float(np.sqrt((centred[kept, -1] ** 2).mean()))
        kept = off <= 2 * float(np.median(off[kept])) + 1e-9 * size
    fits = size > 0 and off[kept].max() < FITS * size and kept.sum() > FITTING * len(u)
    return gains.tolist() if fits and (gains > 0).all() else None


def _least_gain(seen: Survey, safety_distance: float) -> float | None:
    log, least = seen.log, 0.0
    speeds = seen.controls if log.a is None or log.u is None else log.u
    for i, j in combinations(range(len(log.bodies)), 2):
        there = seen.known[:, i] & seen.known[:, j] & log.seen[:, i] & log.seen[:, j]
        dx, dv, da = ((of[:, i] - of[:, j])[there] for of in (log.x, speeds, seen.controls))
        h, rate = (dx**2).sum(axis=-1) - safety_distance**2, 2 * (dx * dv).sum(axis=-1)
        if (h <= 0).any():
            return None
        if log.a is None:
            least = max(least, float((-rate / h).max(initial=0.0)))
            continue
        # gain^2 h + 2 gain h' + h'': beyond its larger root it is not negative
        bend = 2 * (dv**2).sum(axis=-1) + 2 * (dx * da).sum(axis=-1)
        root = np.sqrt(np.maximum(rate**2 - h * bend, 0.0))
        dips = rate**2 > h * bend
        least = max(least, float(((root - rate) / h)[dips].max(initial=0.0)))
    return least if least > 0 else None
