"""Logs of motion capture, in the forms in which programs export them (`exports`).

Cells that are empty are gaps. Rows that repeat another one exactly are left out and counted. With the y-axis up, the
plane is (x, -z), seen from above, and positions in space are (x, -z, y). Bodies of one table have its times, and are
missing where their cells are empty. Files of one body each have the same times if most of their times are shared with
another file. Otherwise they are resampled (`resampling`). Times since 1970 are counted from the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from torchfsid.config.motion_capture import LogConfig
from torchfsid.errors import ConfigError, LogError
from torchfsid.logs.exports import Recorded, recorded
from torchfsid.logs.log import Log
from torchfsid.logs.motion import Motion, heading_of, rotation_of, start_of
from torchfsid.logs.quantities import LONGEST_STEP
from torchfsid.logs.reading import Reading, half_units
from torchfsid.logs.resampling import Track, log_of_tracks, seconds

SHARED = 0.5
"""Part of a body's times that another one has too, from which on their times are the same, with samples missing."""


def read_motion_capture(path: str | Path, form: LogConfig, with_headings: bool = False, in_space: bool = False) -> Log:
    """The log in an export of motion capture.

    Args:
        path: the file or folder.
        form: what the export is.
        with_headings: read the orientations, too.
        in_space: robots are in space. Otherwise they are in the plane, and their height has to stay the same.

    Raises:
        LogError: a file cannot be read, or is not of that form. The message names the line.
        ConfigError: a body or a column that the form names is not there.
    """
    source, bodies = str(path), recorded(Path(path), form)
    start = start_of(int(of.stamps.min()) for of in bodies)
    tracks, rounding, n = [], {"position": 0.0, "velocity": 0.0}, 3 if in_space else 2
    repeats: dict[str, int] = {}
    for of in bodies:
        first, times = _first_rows(of)
        repeats[of.table.source] = len(of.stamps) - len(first)
        motion = _motion(of, first, times - start, form, n)
        if with_headings:
            motion = motion._replace(heading=_headings(of, first[np.isin(times - start, motion.stamps)], form))
        where = f"{of.table.source}: {of.body!r}"
        if len(motion.stamps) < 2:
            raise LogError(f"{where}: expected at least 2 samples, got {len(motion.stamps)}")
        if not in_space:
            motion.require_level(where)
        rounding["position"] = max(rounding["position"], float(motion.position_error.max()))
        rounding["velocity"] = max(rounding["velocity"], float(motion.velocity_error.max()))
        tracks.append(Track.of(of.body, motion, n=n))
    reading = Reading(
        rounding={name: size for name, size in rounding.items() if size > 0},
        duplicates=sum(repeats.values()),
        time_origin=start / 1_000_000_000 if start else None,
    )
    in_one_table = len(repeats) == 1
    return replace(_log(source, tracks, _radius(source, tracks, form), in_one_table), reading=reading)


def _first_rows(of: Recorded) -> tuple[np.ndarray, np.ndarray]:
    """The table rows without those that repeat the one before, and their times [ns]."""
    steps = np.diff(of.stamps)
    if (steps < 0).any():
        i = int(np.argmax(steps < 0)) + 1
        raise of.table.error(i, f"times must not decrease, got {of.stamps[i] / 1e9} s after {of.stamps[i - 1] / 1e9} s")
    for i in np.flatnonzero(steps == 0).tolist():
        if of.table.rows[i] != of.table.rows[i + 1]:
            raise of.table.error(i + 1, "another row has the same time and says something else")
    if len(steps) and np.median(steps[steps > 0]) > LONGEST_STEP * 1e9:
        step = float(np.median(steps[steps > 0])) / 1e9
        raise of.table.header_error(f"the median step is {step:g} s; times in another unit (log.time_unit)?")
    kept = np.flatnonzero(np.concatenate([[True], steps > 0]))
    return kept, of.stamps[kept]


def _motion(of: Recorded, rows: np.ndarray, stamps: np.ndarray, form: LogConfig, n: int) -> Motion:
    scale, plane = 10.0**of.power, form.plane
    for prefix in ("", "v") if n == 3 else ():
        if f"{prefix}{plane[0]}" in of.columns and f"{prefix}{form.vertical}" not in of.columns:
            missing = f"log.bodies.{of.body}.{prefix}{form.vertical}"
            raise ConfigError(f"{missing}: required key is missing, robots are in space")

    def vectors(prefix: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The vectors (plane, height), where they are known, and bounds on their rounding."""
        names = [of.columns.get(f"{prefix}{axis}") for axis in (*plane, form.vertical)]
        there = [name for name in names if name is not None]
        cells = np.stack(
            [np.zeros(len(rows)) if n is None else of.table.numbers(n, True)[rows] for n in names], axis=-1
        )
        empty = np.isnan(cells)
        torn = empty.any(axis=1) & ~empty[:, [name is not None for name in names]].all(axis=1)
        if torn.any():
            i = int(np.argmax(torn))
            column = names[int(np.argmax(empty[i]))]
            raise of.table.error(int(rows[i]), f"column {column!r} is empty, and others of {of.body!r} are not")
        values = np.nan_to_num(cells) * scale
        rounding = half_units((text for name in there for text in of.table.texts(name)), values[:, :n], of.power)
        if form.vertical == "y":
            values = values * [1.0, -1.0, 1.0]
        return values, np.logical_not(empty.any(axis=1)), np.linalg.norm(rounding, axis=-1)

    x, seen, x_error = vectors("")
    u, u_error = None, np.zeros(len(rows))
    if f"v{plane[0]}" in of.columns:
        u, moving, u_error = vectors("v")
        lacking = seen & ~moving
        if lacking.any():
            raise of.table.error(int(rows[int(np.argmax(lacking))]), f"{of.body!r} has a position and no velocity")
        u = u[seen]
    return Motion(stamps[seen], x[seen], u, x_error[seen], u_error[seen])


def _headings(of: Recorded, rows: np.ndarray, form: LogConfig) -> Float[np.ndarray, "samples"]:
    """The headings in these table rows [rad], NaN where they are unknown."""
    cells = [of.table.numbers(column, True)[rows] for column in of.heading]
    if len(cells) == 1:
        return cells[0] * of.angle
    headings = np.full(len(rows), np.nan)
    for k, quaternion in enumerate(zip(*cells, strict=True)):
        turn = rotation_of(*quaternion)
        if turn is not None:
            x, y, z = turn[:, 0]
            headings[k] = heading_of(np.array([x, -z, y] if form.vertical == "y" else [x, y, z]))
    return headings


def _log(source: str, tracks: Sequence[Track], radius: Float[np.ndarray, "bodies"] | None, in_one_table: bool) -> Log:
    """The tracks as one log: with common times and gaps, or resampled."""
    everyones = np.concatenate([track.stamps for track in tracks])
    stamps, count = np.unique(everyones, return_counts=True)
    shared = [float((count[np.searchsorted(stamps, track.stamps)] > 1).mean()) for track in tracks]
    if not in_one_table and len(tracks) > 1 and min(shared) < SHARED:
        return log_of_tracks(source, tracks, None, radius)
    shape, n = (len(stamps), len(tracks)), tracks[0].x.shape[-1]
    seen, x, u = np.zeros(shape, dtype=bool), np.zeros((*shape, n)), np.zeros((*shape, n))
    heading = np.full(shape, np.nan)
    position_error, velocity_error, known = np.zeros(shape), np.zeros(shape), np.zeros(shape, dtype=bool)
    has_headings = any(track.heading is not None for track in tracks)
    for j, track in enumerate(tracks):
        rows = np.searchsorted(stamps, track.stamps)
        seen[rows, j], x[rows, j] = True, track.x
        position_error[rows, j] = 0.0 if track.position_error is None else track.position_error
        heading[rows, j] = np.nan if track.heading is None else track.heading
        if track.u is not None:
            known[rows, j], u[rows, j] = True, track.u
            velocity_error[rows, j] = 0.0 if track.velocity_error is None else track.velocity_error
    return Log(
        source=source,
        bodies=tuple(track.body for track in tracks),
        t=seconds(stamps),
        x=x,
        u=u if known.any() else None,
        seen=seen,
        velocity_known=known,
        radius=radius,
        position_error=position_error if position_error.any() else None,
        velocity_error=velocity_error if velocity_error.any() else None,
        heading=np.nan_to_num(heading) if has_headings else None,
        oriented=np.isfinite(heading) if has_headings else None,
    )


def _radius(source: str, tracks: Sequence[Track], form: LogConfig) -> Float[np.ndarray, "bodies"] | None:
    if form.radius is None:
        return None
    bodies = [track.body for track in tracks]
    if set(form.radius) != set(bodies):
        raise ConfigError(f"log.radius: {source}: expected a radius for each of {bodies}, got {sorted(form.radius)}")
    return np.array([form.radius[body] for body in bodies])
