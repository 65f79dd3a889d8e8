"""Logs of poses with the commands that unicycles follow (`unicycles`) in place of velocities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from torchfsid.config.bodies import UnicycleConfig
from torchfsid.logs.log import Log
from torchfsid.logs.resampling import ResampledLog, Series, Track, resampled, seconds
from torchfsid.logs.unicycles import AT_LIMIT, Commands, Motion, Poses, WheelLimit, commands, moves_on_arcs
from torchfsid.logs.wheel_limits import limits_seen


@dataclass(frozen=True)
class Recovery:
    """How the commands of unicycles were recovered.

    Attributes:
        is_arc: they move on arcs, not by straight steps.
        undeclared: what is to be said of a wheel limit that is not declared.
        counts: for each body, the numbers of its poses of which the command is known, of those at which a wheel or the
            turn rate may be at its limit, and of those that do not determine the command.
    """

    is_arc: bool
    undeclared: str = ""
    counts: dict[str, tuple[int, ...]] = field(default_factory=dict)

    def counted(self, found: Mapping[str, Commands]) -> Recovery:
        """The same with the counts of these bodies' commands."""
        masks = {name: (one.known, one.limited, one.undetermined) for name, one in found.items()}
        return replace(self, counts={name: tuple(int(mask.sum()) for mask in of) for name, of in masks.items()})

    def sentence(self) -> str:
        """This in words."""
        known, total = sum(of[0] for of in self.counts.values()), sum(map(sum, self.counts.values()))
        steps = "on arcs" if self.is_arc else "by straight steps"
        text = f"unicycles, {steps}: the commands of {known} of {total} poses were recovered"
        reasons = "a wheel or the turn rate may be at its limit", "the poses do not determine the command"
        for i, reason in enumerate(reasons, start=1):
            if some := [f"{name} {of[i]}" for name, of in self.counts.items() if of[i]]:
                text += f"; {reason}: {', '.join(some)}"
        return f"{text}; {self.undeclared}" if self.undeclared else text


def commanded(log: Log, body: UnicycleConfig, position_error: float, heading_error: float) -> tuple[Log, Recovery]:
    """The log with the commands of its unicycles, without its last time, and what became of its poses.

    Positions are those of the points that are commanded. Bodies without any heading are no unicycles: their velocities
    are differences of positions. A unicycle is not seen while its heading is unknown.

    Args:
        log: a log that was read with headings.
        body: the map by which unicycles follow commands.
        position_error: a bound on the errors of all positions [m], beside `position_error` of the log.
        heading_error: a bound on the errors of all headings [rad].

    Raises:
        ConfigError: the headings cannot be those of unicycles.
        LogError: a difference quotient is not finite.
    """
    heading_error = heading_error + log.reading.rounding.get("heading", 0.0)
    if isinstance(log, ResampledLog):
        return _resampled(log, body, position_error, heading_error)
    assert log.heading is not None
    assert log.oriented is not None
    turns = np.array([body in log.with_headings for body in log.bodies])
    seen = log.seen & (log.oriented | ~turns)
    known_error = np.zeros(seen.shape) if log.position_error is None else log.position_error
    error = position_error + known_error
    poses = Poses(log.t, log.x, log.heading, log.oriented, error, heading_error)
    (found,), recovery = recovered([poses], body)
    positions = replace(log, seen=seen, heading=None, oriented=None, position_error=None, velocity_error=None)
    plain = positions.differentiated()
    assert plain.u is not None
    log_of_commands = replace(
        plain,
        x=poses.ahead(body)[:-1],
        u=np.where(turns[:, None], found.u, plain.u),
        velocity_known=np.where(turns, found.known, plain.velocity_known),
        position_error=(known_error + np.where(turns, poses.ahead_error(body), 0.0))[:-1],
        velocity_error=np.where(turns, found.error, (error[:-1] + error[1:]) / np.diff(log.t)[:, None]),
    )
    names = [(log.bodies[j], found.of_body(j)) for j in np.flatnonzero(turns).tolist()]
    return log_of_commands, recovery.counted(dict(names))


def recovered(of_bodies: Sequence[Poses], body: UnicycleConfig) -> tuple[list[Commands], Recovery]:
    """The commands of unicycles with these poses, and how they were recovered.

    Raises:
        ConfigError: the headings cannot be those of unicycles.
    """
    is_arc = moves_on_arcs(of_bodies)
    motions = [Motion.of(poses, is_arc) for poses in of_bodies]
    if body.wheel_limit is not None and body.wheel_base is not None:
        limits = [WheelLimit(body.wheel_limit, body.wheel_base, AT_LIMIT * body.wheel_limit)]
        recovery = Recovery(is_arc)
    else:
        limits = limits_seen(motions)
        recovery = Recovery(is_arc, "" if limits == [] else _undeclared(limits))
    found = [commands(poses, motion, body, limits or ()) for poses, motion in zip(of_bodies, motions, strict=True)]
    return found, recovery


def _undeclared(limits: Sequence[WheelLimit] | None) -> str:
    """What is to be said of wheel limits that were looked for because none is declared."""
    if limits is None:
        return "no wheel_limit is declared, so none is recognised"
    speed, base, _ = limits[0]
    return f"no wheel_limit is declared, but there seems to be one: {speed:.4g}, with wheel_base: {base:.4g}"


def _resampled(
    log: ResampledLog, body: UnicycleConfig, position_error: float, heading_error: float
) -> tuple[Log, Recovery]:
    """Commands are recovered at the bodies' own poses, and then interpolated like accelerations (`resampling`)."""
    assert log.clock is not None
    tracks = [_oriented(track) for track in log.tracks]
    poses = {track.body: _poses(track, position_error, heading_error) for track in tracks if track.heading is not None}
    of_bodies, recovery = recovered(list(poses.values()), body)
    found = dict(zip(poses, of_bodies, strict=True))
    points = []
    for track in tracks:
        point = replace(track, u=None)
        if track.body in poses:
            u, error, known = (
                values[:, 0] for values in (vars(found[track.body])[key] for key in ("u", "error", "known"))
            )
            command = Series(track.stamps[:-1], np.where(known[:, None], u, np.nan), error)
            point = replace(point, x=poses[track.body].ahead(body)[:, 0], command=command)
        points.append(point)
    result = resampled(log.source, points, log.clock, log.radius, differentiate=True)
    assert result.position_error is not None
    assert result.velocity_error is not None
    of_points = [poses[name].ahead_error(body) if name in poses else 0.0 for name in log.bodies]
    shortest = [float(np.diff(track.stamps).min()) * 1e-9 for track in tracks]
    of_means = [
        0.0 if track.body in poses else 2 * position_error / h for track, h in zip(tracks, shortest, strict=True)
    ]
    result = replace(
        result,
        reading=log.reading,
        position_error=result.position_error + np.array(of_points),
        velocity_error=result.velocity_error + np.array(of_means),
    )
    return result, recovery.counted(found)


def _oriented(track: Track) -> Track:
    """The samples of a unicycle whose headings are known. Other bodies have no headings."""
    if track.heading is None or not (known := np.isfinite(track.heading)).any():
        return replace(track, heading=None)
    error = None if track.position_error is None else track.position_error[known]
    return replace(
        track, stamps=track.stamps[known], x=track.x[known], u=None, heading=track.heading[known], position_error=error
    )


def _poses(track: Track, position_error: float, heading_error: float) -> Poses:
    assert track.heading is not None
    every = np.ones((len(track.stamps), 1))
    return Poses(
        t=seconds(track.stamps),
        x=track.x[:, None],
        heading=track.heading[:, None],
        known=every > 0,
        position_error=position_error
        + (0.0 * every if track.position_error is None else track.position_error[:, None]),
        heading_error=heading_error,
    )
