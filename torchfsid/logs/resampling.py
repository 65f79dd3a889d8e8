r"""Bodies that were measured at different times, brought onto one clock with bounds on the errors.

Between two consecutive samples of a body, h seconds apart, at s_k + l h with 0 <= l <= 1,

    x = (1 - l) x_k + l x_{k+1}       error <= l (1 - l) h V
    u = (1 - l) u_k + l u_{k+1}       error <= 2 l (1 - l) V

Assumption: between two samples the velocity changes by no more than V. V is the largest change of velocity in this
interval and the two beside it: from one sample to the next, and from a sample to the mean velocity (x_{k+1} - x_k) / h.
The bound on u also assumes that u changes no faster than V / h. As in every log, (vx, vy) at t is the command for the
positions at t, and these change continuously even where a command is held. Both errors are zero at samples.

Bounds on the errors of the samples are interpolated with the same weights and added. A mean velocity is wrong by (e_k +
e_{k+1}) / h, with e_k the bounds for the positions.

Accelerations have samples of their own, and so have the commands of unicycles. They are interpolated like u, with V the
largest change from one of their samples to the next.

Proof: with m, m' the mean velocities before and after, x(t) = x_k + l h m and x_{k+1} - x_k = h (l m + (1 - l) m'), so
the error of x is l (1 - l) h (m - m'), and |m - m'| <= V. And |u(t) - u_k| <= l V, |u(t) - u_{k+1}| <= (1 - l) V.

A body without logged velocities has mean velocities only. Its V is the sum of the changes of the mean velocity to the
interval before and to the interval after, where these exist. If the means are taken as velocities (`differentiated`),
their error is at most V, also at the samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from torchfsid.errors import LogError
from torchfsid.logs.log import Log
from torchfsid.logs.motion import Motion

MAX_GAP = 2.5
"""Median periods that a body's samples may lie apart to be joined: one message may be lost, not two."""

MIN_RUN = 3
"""Intervals without a gap that it takes to judge how a velocity changes."""


@dataclass(frozen=True)
class Series:
    """Accelerations [m/s2] or commands [m/s] at their own stamps [ns], increasing.

    Values that are unknown are NaN. `error` bounds the errors of the values. None means zero.
    """

    stamps: Int[np.ndarray, "samples"]
    values: Float[np.ndarray, "samples n"]
    error: Float[np.ndarray, "samples"] | None = None


@dataclass(frozen=True)
class Track:
    """The samples of one body.

    Attributes:
        body: the name.
        stamps: times [ns], increasing.
        x: positions [m].
        u: velocities [m/s], or None if not measured.
        acceleration: accelerations, or None if not measured.
        position_error: bounds on the errors of x [m]. None means zero.
        velocity_error: bounds on the errors of u [m/s]. None means zero.
        heading: headings [rad], NaN where unknown, or None if they were not asked for.
        command: the commands that the body follows, in place of velocities, or None.
    """

    body: str
    stamps: Int[np.ndarray, "samples"]
    x: Float[np.ndarray, "samples n"]
    u: Float[np.ndarray, "samples n"] | None
    acceleration: Series | None = None
    position_error: Float[np.ndarray, "samples"] | None = None
    velocity_error: Float[np.ndarray, "samples"] | None = None
    heading: Float[np.ndarray, "samples"] | None = None
    command: Series | None = None

    @classmethod
    def of(cls, body: str, motion: Motion, acceleration: Series | None = None, n: int = 2) -> Track:
        """The motion of a body in the plane (n = 2) or in space (n = 3)."""
        u = None if motion.u is None else motion.u[:, :n]
        errors = [error if error.any() else None for error in (motion.position_error, motion.velocity_error)]
        return cls(body, motion.stamps, motion.x[:, :n], u, acceleration, *errors, heading=motion.heading)


@dataclass(frozen=True)
class ResampledLog(Log):
    """A log whose bodies were measured at other times than its own. A body that is not seen is `lost`.

    Attributes:
        tracks: the bodies' own samples.
        clock: the times of the log [ns].
    """

    tracks: tuple[Track, ...] = ()
    clock: Int[np.ndarray, "times"] | None = None

    @property
    def with_headings(self) -> tuple[str, ...]:
        has = (track.heading is not None and bool(np.isfinite(track.heading).any()) for track in self.tracks)
        return tuple(track.body for track, known in zip(self.tracks, has, strict=True) if known)

    def differentiated(self) -> Log:
        """The log with velocities from differences of the bodies' own samples (module docstring)."""
        assert self.clock is not None
        positions = [replace(track, u=None) for track in self.tracks]
        log = resampled(self.source, positions, self.clock, self.radius, differentiate=True)
        return replace(log, reading=self.reading)

    def accelerated(self, velocity_error: float) -> Log:
        """Not possible: between the times of the clock the accelerations are not held."""
        raise LogError(
            f"{self.source}: no accelerations from differences where bodies were measured at different times: "
            "record them (bag.accelerations)"
        )


def log_of_tracks(
    source: str,
    tracks: Sequence[Track],
    clock: Int[np.ndarray, "times"] | None,
    radius: Float[np.ndarray, "bodies"] | None,
) -> Log:
    """The tracks as one log.

    If all bodies have the same stamps, these are the times. Otherwise the bodies are resampled.

    Args:
        source: the file, for messages.
        tracks: one per body.
        clock: times onto which the bodies are resampled [ns]. Default: the stamps of the first body.
        radius: radii of the bodies [m], or None.

    Raises:
        LogError: at no time of the clock are all bodies known.
    """
    first = tracks[0]
    stamps = [track.stamps for track in tracks] + [of.acceleration.stamps for of in tracks if of.acceleration]
    if not all(np.array_equal(others, first.stamps) for others in stamps):
        return resampled(source, tracks, first.stamps if clock is None else clock, radius, differentiate=False)
    seen = np.ones((len(first.stamps), len(tracks)), dtype=bool)
    with_velocity = [track.u is not None for track in tracks]
    u = np.stack([np.zeros_like(track.x) if track.u is None else track.u for track in tracks], axis=1)
    accelerated = [track.acceleration is not None for track in tracks]
    a = [np.zeros_like(track.x) if track.acceleration is None else track.acceleration.values for track in tracks]
    nowhere = np.full(len(first.stamps), np.nan)
    heading = np.stack([nowhere if track.heading is None else track.heading for track in tracks], axis=1)
    has_headings = any(track.heading is not None for track in tracks)
    return Log(
        source=source,
        bodies=tuple(track.body for track in tracks),
        t=seconds(first.stamps),
        x=np.stack([track.x for track in tracks], axis=1),
        u=u if any(with_velocity) else None,
        seen=seen,
        velocity_known=seen & np.array(with_velocity),
        radius=radius,
        a=np.stack(a, axis=1) if any(accelerated) else None,
        acceleration_known=seen & np.array(accelerated) if any(accelerated) else None,
        position_error=_stacked([track.position_error for track in tracks], len(seen)),
        velocity_error=_stacked([track.velocity_error for track in tracks], len(seen)),
        heading=np.nan_to_num(heading) if has_headings else None,
        oriented=np.isfinite(heading) if has_headings else None,
    )


def _stacked(errors: Sequence[np.ndarray | None], samples: int) -> Float[np.ndarray, "samples bodies"] | None:
    """The bounds of all tracks. None if no track has any."""
    found = [np.zeros(samples) if error is None else error for error in errors]
    return np.stack(found, axis=1) if any(error is not None for error in errors) else None


def seconds(stamps: Int[np.ndarray, "times"]) -> Float[np.ndarray, "times"]:
    """[ns] to [s], rounded once. A time that was written as a decimal gives back the same decimal."""
    return np.array([stamp / 1_000_000_000 for stamp in stamps.tolist()])


class _Samples(NamedTuple):
    """One body on the clock. Entries are zero where the body is not seen or its velocity is unknown."""

    x: Float[np.ndarray, "times n"]
    u: Float[np.ndarray, "times n"]
    seen: Bool[np.ndarray, "times"]
    velocity_known: Bool[np.ndarray, "times"]
    position_error: Float[np.ndarray, "times"]
    velocity_error: Float[np.ndarray, "times"]
    a: Float[np.ndarray, "times n"]
    acceleration_known: Bool[np.ndarray, "times"]
    acceleration_error: Float[np.ndarray, "times"]


def resampled(
    source: str,
    tracks: Sequence[Track],
    clock: Int[np.ndarray, "times"],
    radius: Float[np.ndarray, "bodies"] | None,
    differentiate: bool,
) -> ResampledLog:
    """The tracks on the clock, with bounds on the errors (module docstring).

    Args:
        source: the file, for messages.
        tracks: one per body.
        clock: times onto which the bodies are resampled [ns].
        radius: radii of the bodies [m], or None.
        differentiate: velocities are mean velocities, except those of bodies with commands.

    Raises:
        LogError: at no time of the clock are all bodies known.
    """
    of_each = [_sample(track, clock, differentiate) for track in tracks]
    bodies = _Samples(*(np.stack(of_bodies, axis=1) for of_bodies in zip(*of_each, strict=True)))
    if not bodies.seen.all(axis=1).any():
        raise LogError(f"{source}: at no time of the clock are all bodies known: {_spans(tracks)}")
    accelerated = any(track.acceleration is not None for track in tracks)
    return ResampledLog(
        source=source,
        bodies=tuple(track.body for track in tracks),
        t=seconds(clock),
        x=bodies.x,
        u=bodies.u if bodies.velocity_known.any() else None,
        seen=bodies.seen,
        velocity_known=bodies.velocity_known,
        radius=radius,
        position_error=bodies.position_error,
        velocity_error=bodies.velocity_error,
        a=bodies.a if accelerated else None,
        acceleration_known=bodies.acceleration_known if accelerated else None,
        acceleration_error=bodies.acceleration_error if accelerated else None,
        lost=~bodies.seen,
        tracks=tuple(tracks),
        clock=clock,
    )


def _spans(tracks: Sequence[Track]) -> str:
    spans = (seconds(track.stamps[[0, -1]]) for track in tracks)
    return ", ".join(
        f"{track.body!r} from {start} to {end} s" for track, (start, end) in zip(tracks, spans, strict=True)
    )


def _sample(track: Track, clock: Int[np.ndarray, "times"], differentiate: bool) -> _Samples:
    stamps, periods = track.stamps, np.diff(track.stamps)
    interval = np.clip(np.searchsorted(stamps, clock, side="right") - 1, 0, len(periods) - 1)
    after = (clock - stamps[interval]) / periods[interval]
    weight = np.clip(after * (1 - after), 0.0, None)
    at_sample = (after == 0) | (after == 1)
    change = _change_of_velocity(track)
    joined = np.isfinite(change[interval]) & (after > 0) & (after < 1)
    seen = joined | at_sample
    bound = np.where(np.isfinite(change[interval]), change[interval], 0.0)

    def at_clock(values: np.ndarray, known: np.ndarray) -> np.ndarray:
        mean = (1 - after)[:, None] * values[interval] + after[:, None] * values[interval + 1]
        return np.where(known[:, None], mean, 0.0)

    def errors_at_clock(errors: np.ndarray | None) -> np.ndarray:
        return np.zeros(len(clock)) if errors is None else at_clock(errors[:, None], seen)[:, 0]

    if track.command is not None:
        u, known, u_error = _interpolated(track.command, clock)
    elif differentiate:
        known = (after >= 0) & (after < 1) & np.isfinite(change[interval])
        u, u_error = np.where(known[:, None], _mean_velocities(track)[interval], 0.0), bound
        if track.position_error is not None:
            ends = track.position_error[:-1] + track.position_error[1:]
            u_error = bound + (ends / (periods * 1e-9))[interval]
    else:
        known = seen if track.u is not None else np.zeros_like(seen)
        u = np.zeros((len(clock), track.x.shape[-1])) if track.u is None else at_clock(track.u, known)
        u_error = 2 * weight * bound + errors_at_clock(track.velocity_error)
    return _Samples(
        x=at_clock(track.x, seen),
        u=u,
        seen=seen,
        velocity_known=known,
        position_error=np.where(joined, weight * periods[interval] * 1e-9 * bound, 0.0)
        + errors_at_clock(track.position_error),
        velocity_error=np.where(known, u_error, 0.0),
        **_accelerations(track.acceleration, clock, track.x.shape[-1]),
    )


def _accelerations(series: Series | None, clock: Int[np.ndarray, "times"], n: int) -> dict[str, np.ndarray]:
    """The accelerations on the clock. Zero where they are unknown."""
    names = ("a", "acceleration_known", "acceleration_error")
    if series is None:
        nothing = np.zeros(len(clock))
        return dict(zip(names, (np.zeros((len(clock), n)), nothing > 0, nothing), strict=True))
    return dict(zip(names, _interpolated(series, clock), strict=True))


def _interpolated(series: Series, clock: Int[np.ndarray, "times"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The values on the clock, where they are known, and bounds on their errors. Zero where they are unknown."""
    stamps, periods = series.stamps, np.diff(series.stamps)
    interval = np.clip(np.searchsorted(stamps, clock, side="right") - 1, 0, len(periods) - 1)
    after = (clock - stamps[interval]) / periods[interval]
    change = _around(periods, np.linalg.norm(np.diff(series.values, axis=0), axis=-1))[interval]
    before, then = series.values[interval], series.values[interval + 1]
    between = (1 - after)[:, None] * before + after[:, None] * then
    values = np.where((after == 0)[:, None], before, np.where((after == 1)[:, None], then, between))
    known = (np.isfinite(change) & (after > 0) & (after < 1)) | (after == 0) | (after == 1)
    known &= np.isfinite(values).all(axis=-1)
    error = 2 * np.clip(after * (1 - after), 0.0, None) * np.where(np.isfinite(change), change, 0.0)
    if series.error is not None:
        error = error + np.maximum(series.error[interval], series.error[interval + 1])
    return np.where(known[:, None], values, 0.0), known, np.where(known, error, 0.0)


def _mean_velocities(track: Track) -> Float[np.ndarray, "intervals n"]:
    with np.errstate(over="ignore"):
        return np.diff(track.x, axis=0) / (np.diff(track.stamps) * 1e-9)[:, None]


def _change_of_velocity(track: Track) -> Float[np.ndarray, "intervals"]:
    """V of each interval between samples [m/s]. It is NaN in gaps, and where there are too few consecutive samples."""
    periods, means = np.diff(track.stamps), _mean_velocities(track)
    change = np.full(len(periods), np.nan)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is no bound
        if track.u is None:
            to_next = np.linalg.norm(np.diff(means, axis=0), axis=1)
            for run in _runs(periods):
                change[run[1:-1]] = to_next[run[:-2]] + to_next[run[1:-1]]
        else:
            seen = [track.u[1:] - track.u[:-1], means - track.u[:-1], means - track.u[1:]]
            change = _around(periods, np.linalg.norm(seen, axis=-1).max(axis=0))
    return change


def _around(periods: Int[np.ndarray, "intervals"], inside: Float[np.ndarray, "intervals"]) -> np.ndarray:
    """The largest value of each interval and the two beside it. NaN in gaps, and without enough intervals."""
    largest = np.full(len(periods), np.nan)
    for run in _runs(periods):
        of_three = np.lib.stride_tricks.sliding_window_view(inside[run], MIN_RUN).max(axis=-1)
        largest[run] = of_three[np.clip(np.arange(len(run)) - 1, 0, len(run) - MIN_RUN)]
    return largest


def _runs(periods: Int[np.ndarray, "intervals"]) -> list[Int[np.ndarray, "run"]]:
    """The runs of intervals without a gap that are long enough."""
    joined = np.flatnonzero(periods <= MAX_GAP * np.median(periods))
    return [run for run in np.split(joined, np.flatnonzero(np.diff(joined) > 1) + 1) if len(run) >= MIN_RUN]
