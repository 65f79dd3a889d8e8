r"""Recorded logs, as measurements.

(vx, vy) is the control computed at t from the positions at t. It is held until the next sample t_+ (zero-order hold).
If it was not logged, it is exactly (x(t_+) - x(t)) / (t_+ - t). Of robots that are driven by accelerations, (vx, vy) is
the velocity at t, and (ax, ay) the control. If that was not logged, it is exactly (v(t_+) - v(t)) / (t_+ - t). A body
without a sample at t is not there at t. If it has samples before and after, see `gaps`.

PyTorch is imported only when the measurements are asked for, so that a wrong log is refused at once.
"""

from __future__ import annotations

import reprlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from torchfsid.errors import LogError
from torchfsid.logs.reading import Reading

if TYPE_CHECKING:
    from torchfsid.robots.measurement import Measurement


@dataclass(frozen=True)
class Log:
    """T times of N bodies. Unknown entries are zeros, never NaN, and a mask marks them.

    Attributes:
        source: the file.
        bodies: the names, in the order in which they appear.
        t: times [s], increasing.
        x: positions [m].
        u: velocities [m/s], or None if the log has none.
        a: accelerations [m/s2], the controls of robots of second order, or None if the log has none.
        seen: the body is there at t.
        velocity_known: the body is there at t and its velocity is known.
        acceleration_known: the body is there at t and its acceleration is known. None if the log has none.
        radius: radii [m], or None if the log has none.
        position_error: bounds on the errors of x [m]. None means zero.
        velocity_error: bounds on the errors of u [m/s]. None means zero.
        acceleration_error: bounds on the errors of a [m/s2]. None means zero.
        lost: the body is there at t but its position is unknown. None means that a body that is not seen is not there.
        bridged: the body was not measured at t, and its position is interpolated (see `gaps`). It is then not observed
            itself.
        heading: headings of unicycles [rad], or None if they were not asked for.
        oriented: the body is there at t and its heading is known. None if headings were not asked for.
        reading: what was found while the log was read.
        frame: name of the frame of the positions, if the log has one.
    """

    source: str
    bodies: tuple[str, ...]
    t: Float[np.ndarray, "times"]
    x: Float[np.ndarray, "times bodies n"]
    u: Float[np.ndarray, "times bodies n"] | None
    seen: Bool[np.ndarray, "times bodies"]
    velocity_known: Bool[np.ndarray, "times bodies"]
    radius: Float[np.ndarray, "bodies"] | None = None
    position_error: Float[np.ndarray, "times bodies"] | None = None
    velocity_error: Float[np.ndarray, "times bodies"] | None = None
    lost: Bool[np.ndarray, "times bodies"] | None = None
    bridged: Bool[np.ndarray, "times bodies"] | None = None
    a: Float[np.ndarray, "times bodies n"] | None = None
    acceleration_known: Bool[np.ndarray, "times bodies"] | None = None
    acceleration_error: Float[np.ndarray, "times bodies"] | None = None
    heading: Float[np.ndarray, "times bodies"] | None = None
    oriented: Bool[np.ndarray, "times bodies"] | None = None
    reading: Reading = field(default_factory=Reading)
    frame: str | None = None

    def __repr__(self) -> str:
        shown, ends = reprlib.repr(list(self.bodies)), self.t[[0, -1]].tolist() if len(self.t) else []
        span = " to ".join(f"{t:.15g}" for t in ends)
        given = [name for name in ("u", "a", "radius", "heading") if getattr(self, name) is not None]
        return f"Log({self.source!r}, bodies={shown}, times={len(self.t)}, t={span} s, with {', '.join(['x', *given])})"

    @property
    def with_headings(self) -> tuple[str, ...]:
        """The bodies of which some heading is known."""
        if self.oriented is None:
            return ()
        return tuple(body for j, body in enumerate(self.bodies) if self.oriented[:, j].any())

    @property
    def controls(self) -> tuple[Float[np.ndarray, "times bodies n"] | None, Bool[np.ndarray, "times bodies"]]:
        """The controls, and where they are known: accelerations if there are any, otherwise velocities."""
        if self.a is None or self.acceleration_known is None:
            return self.u, self.velocity_known
        return self.a, self.acceleration_known

    def of_first_order(self) -> Log:
        """The log without accelerations: its velocities are the controls."""
        return replace(self, a=None, acceleration_known=None, acceleration_error=None)

    @property
    def previous_known(self) -> Bool[np.ndarray, "times bodies"]:
        """Is the body's velocity one sample earlier known? Not at the first sample of the log or of the body."""
        return _one_earlier(self.velocity_known)

    def differentiated(self) -> Log:
        """The log with velocities from differences of its positions (module docstring), without its last time.

        The velocity of a body that is missing from the next sample is unknown. Positions that are wrong by e and e_+
        make a velocity wrong by at most (e + e_+) / (t_+ - t).

        Raises:
            LogError: a difference quotient is not finite.
        """
        known = self.seen[:-1] & self.seen[1:]
        u = self._quotients(self.x, known, "velocities")
        error = self.position_error
        return replace(
            self,
            t=self.t[:-1],
            x=self.x[:-1],
            u=u,
            seen=self.seen[:-1],
            velocity_known=known,
            position_error=None if error is None else error[:-1],
            velocity_error=None if error is None else (error[:-1] + error[1:]) / np.diff(self.t)[:, None],
        )

    def windowed(self, position_error: float) -> Log:
        """`differentiated`, with bounds on the errors of these velocities, (rho + rho_+) / (t_+ - t).

        Args:
            position_error: a bound on the errors of all positions [m], beside `position_error` of the log.
        """
        rho = np.full(self.seen.shape, position_error) + (0.0 if self.position_error is None else self.position_error)
        error = (rho[:-1] + rho[1:]) / np.diff(self.t)[:, None]
        log = Log.differentiated(self)  # differences of these positions, whatever else the log knows
        kept = None if self.position_error is None else self.position_error[:-1]
        return replace(log, position_error=kept, velocity_error=error)

    def accelerated(self, velocity_error: float) -> Log:
        """The log with accelerations from differences of its velocities (module docstring), without its last time.

        Velocities that are wrong by e and e_+ make an acceleration wrong by at most (e + e_+) / (t_+ - t).

        Args:
            velocity_error: a bound on the errors of all velocities [m/s], beside `velocity_error` of the log.

        Raises:
            LogError: the log has no velocities, or a difference quotient is not finite.
        """
        if self.u is None:
            raise LogError(f"{self.source}: no velocities (vx, vy) from which accelerations could follow")
        known = self.velocity_known[:-1] & self.velocity_known[1:]
        error = np.full(self.seen.shape, velocity_error) + (0.0 if self.velocity_error is None else self.velocity_error)
        return replace(
            self,
            t=self.t[:-1],
            x=self.x[:-1],
            u=self.u[:-1],
            seen=self.seen[:-1],
            velocity_known=self.velocity_known[:-1],
            position_error=None if self.position_error is None else self.position_error[:-1],
            velocity_error=None if self.velocity_error is None else self.velocity_error[:-1],
            a=self._quotients(self.u, known, "accelerations"),
            acceleration_known=known,
            acceleration_error=(error[:-1] + error[1:]) / np.diff(self.t)[:, None],
        )

    def _quotients(self, values: np.ndarray, known: np.ndarray, name: str) -> np.ndarray:
        """The difference quotients of values in time, zero where unknown."""
        with np.errstate(over="ignore", invalid="ignore"):
            found = np.where(known[..., None], np.diff(values, axis=0) / np.diff(self.t)[:, None, None], 0.0)
        if not np.isfinite(found).all():
            k = int(np.argmin(np.isfinite(found).all(axis=(1, 2))))
            raise LogError(f"{self.source}: no finite {name} from t = {self.t[k]} to {self.t[k + 1]}")
        return found

    def measurements(
        self,
        robots: Sequence[str],
        neighbour_velocities: Collection[str],
        required: Collection[str] = (),
        arrival_errors: Float[np.ndarray, "times bodies"] | None = None,
        block: int | None = None,
    ) -> Iterator[Measurement]:
        """One measurement per time, of the batch of these robots among all bodies, or several concatenated.

        If the log has accelerations, they are the controls. A robot is `observed` where its control is known, the
        `required` bodies are there, and what the rows use of other bodies is known: the `neighbour_velocities`, and all
        velocities if there are accelerations. A row with an unknown right-hand side cannot be left out: it may be the
        active one, and the set would lose the truth. For the same reason no robot is observed while a body is `lost`. A
        `bridged` body is not observed, but other robots avoid it.

        Args:
            robots: names of the robots of the batch.
            neighbour_velocities: what the barriers use. `current` needs the control of every body that is there.
                `previous` needs the same one sample earlier, the robot's own included.
            required: bodies without which a measurement says nothing, such as the leader of a formation.
            arrival_errors: how far velocities on arrival at the next sample may be from those logged (`contacts`)
                [m/s].
            block: how many times are concatenated to one measurement. None: each measurement has one time.

        Raises:
            LogError: the log has no velocities, or no body of that name.
        """
        if self.u is None:
            raise LogError(f"{self.source}: no velocities (vx, vy): take `velocity: differentiated`, or log them")
        if missing := [name for name in (*robots, *required) if name not in self.bodies]:
            raise LogError(f"{self.source}: no body is called {missing[0]!r}; there are {reprlib.repr(self.bodies)}")
        index, leaders = ([self.bodies.index(name) for name in names] for names in (robots, required))
        _, control_known = self.controls
        observed = control_known[:, index] & self.seen[:, leaders].all(axis=1, keepdims=True)
        if self.a is not None:
            observed &= self.velocity_known[:, index] & (self.velocity_known | ~self.seen).all(axis=1, keepdims=True)
        if "current" in neighbour_velocities:
            observed &= (control_known | ~self.seen).all(axis=1, keepdims=True)
        if "previous" in neighbour_velocities:
            observed &= (self.previous_known | ~self.seen).all(axis=1, keepdims=True)
        if self.lost is not None:
            observed &= ~self.lost.any(axis=1, keepdims=True)
        if self.bridged is not None:
            observed &= ~self.bridged[:, index]
        neighbour_error = self.velocity_error
        if "previous" in neighbour_velocities:  # one bound for both times
            if neighbour_error is not None:
                neighbour_error = np.maximum(neighbour_error, _one_earlier(neighbour_error))
            if arrival_errors is not None and arrival_errors.any():
                pushed = _one_earlier(arrival_errors)
                neighbour_error = pushed if neighbour_error is None else neighbour_error + pushed
        return self._measurements(self.u, index, observed, neighbour_error, block)

    def _measurements(
        self,
        velocities: np.ndarray,
        robots: list[int],
        observed: np.ndarray,
        neighbour_error: np.ndarray | None,
        block: int | None,
    ) -> Iterator[Measurement]:
        import torch

        from torchfsid.robots.measurement import Measurement

        fields = {
            "x": self.x,
            "u": velocities,
            "previous_u": _one_earlier(velocities),
            "acceleration": self.a,
            "acceleration_error": self.acceleration_error,
            "seen": self.seen,
            "position_error": self.position_error,
            "velocity_error": self.velocity_error,
            "neighbour_error": neighbour_error if self.a is None else None,
        }
        series = {name: torch.from_numpy(array) for name, array in fields.items() if array is not None}
        radius = None if self.radius is None else torch.from_numpy(self.radius)
        observes, times = torch.from_numpy(observed), self.t.tolist()
        for k in range(0, len(times), block or 1):
            part = k if block is None else slice(k, k + block)
            t = times[k] if block is None else torch.tensor(times[k : k + block], dtype=torch.float64)
            at_times = {name: values[part] for name, values in series.items()}
            team = Measurement.of_team(t, **at_times, robots=robots, radius=radius)
            yield replace(team, observed=observes[part].flatten())


def _one_earlier(values: np.ndarray) -> np.ndarray:
    """The values one sample earlier. They are zero at the first sample."""
    return np.concatenate([np.zeros_like(values[:1]), values[:-1]])
