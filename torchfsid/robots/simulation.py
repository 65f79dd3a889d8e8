r"""Sampled simulation of robots in closed loop: the measurements for an observer, together with the truth.

    x_i(t + dt) = x_i(t) + dt (u_i(t) + w_i(t)),     u_i(t) = u*(x(t); theta_i)        (G., Eqs. (4), (5))

Robots of second order are driven by accelerations u. With their velocities v,

    x(t + dt) = x(t) + dt v(t) + dt^2/2 (u(t) + w(t)),     v(t + dt) = v(t) + dt (u(t) + w(t)).

The control is held for dt, so both are exact. The disturbance w is optional. All robots compute at the same time, from
the positions (and velocities) at t. `closed_loop` runs robots in any surroundings, sample by sample. `simulate` runs
teams: every robot avoids every other and the obstacles, which stand still. Both are differentiable in theta, start, the
positions of the bodies, gains and distances.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.robots.controller import CbfQpController, Control
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.recording import write_run

STILL = 1e-3
"""A robot stands still where its speed is at most this fraction of its nominal speed ..."""

IDLE = 1e-6
"""... and that nominal speed is above this one [m/s]: below it, it has nowhere to go."""

AT_REST = 1e-3
"""A robot of second order rests where its speed is at most this [m/s]."""

Surroundings = Callable[[float, Tensor, Tensor], Measurement]
"""What the robots have around them, as a measurement without controls: (t, x, v) -> measurement.

`t` is the time [s], `x` are the robots' positions [m], `v` the velocities with which they arrive there [m/s]: those of
one sample earlier, or the states of robots of second order.
"""


class Sample(NamedTuple):
    """One instant of a closed loop.

    Attributes:
        measurement: the input of the controller, with the controls that the robots executed from then on.
        control: the output of the controller. Where the QP is infeasible it is zero.
    """

    measurement: Measurement
    control: Control

    @property
    def still(self) -> Bool[Tensor, "*batch"]:
        """Whether the robot stands still although its nominal control is not zero."""
        return stands_still(self.control.u, self.control.nominal)


def closed_loop(
    controller: CbfQpController,
    theta: Float[Tensor, "*batch p"],
    start: Float[Tensor, "*batch n"],
    surroundings: Surroundings,
    *,
    dt: float,
    samples: int,
    velocity: Float[Tensor, "*batch n"] | None = None,
    disturbance: Float[Tensor, "samples *batch n"] | None = None,
) -> Iterator[Sample]:
    """Run a batch of robots and yield one sample after the other. Past samples are not kept.

    Args:
        controller: the controller of all robots.
        theta: the robots' parameters.
        start: their positions at the first sample [m].
        surroundings: a function that returns the measurement of the robots' surroundings, called at every sample.
        dt: time between samples [s].
        samples: the number of samples.
        velocity: the velocities of robots of second order at the first sample [m/s]. None: of first order.
        disturbance: added to the controls, in their units.
    """
    x = start.to(torch.float64)
    v = torch.zeros_like(x) if velocity is None else velocity.to(torch.float64)
    for k in range(samples):
        seen = surroundings(k * dt, x, v)
        control = controller(seen, theta)
        u = control.u if disturbance is None else control.u + disturbance[k]
        yield Sample(replace(seen, u=u), control)
        if velocity is None:
            x, v = x + dt * u, u
        else:
            x, v = x + dt * v + dt**2 / 2 * u, v + dt * u


@dataclass(frozen=True)
class Trajectory:
    """T samples of a team of N robots and K obstacles, or of a batch of such teams. The robots come first.

    Attributes:
        t: times [s].
        x: positions of all bodies [m].
        u: their controls from t on, velocities [m/s] or accelerations [m/s2]; zero for obstacles, and for a robot
            whose QP is infeasible.
        nominal: the nominal controls of the robots' tasks.
        active: the robots' rows with a positive multiplier, in the order of the controller's barriers.
        feasible: whether the robot's QP had a solution.
        radius: the radii of all bodies [m], if given.
        velocity: the velocities of all bodies at t [m/s], among robots of second order.
        present: the slots of bodies that are there, see `simulate`. None: all are.
    """

    t: Float[Tensor, "samples"]
    x: Float[Tensor, "samples *teams bodies n"]
    u: Float[Tensor, "samples *teams bodies n"]
    nominal: Float[Tensor, "samples *teams robots n"]
    active: Bool[Tensor, "samples *teams robots m"]
    feasible: Bool[Tensor, "samples *teams robots"]
    radius: Float[Tensor, "*#teams bodies"] | None = None
    velocity: Float[Tensor, "samples *teams bodies n"] | None = None
    present: Bool[Tensor, "*#teams bodies"] | None = None

    @property
    def robots(self) -> int:
        """The number of robots, which come first among the bodies."""
        return self.nominal.shape[-2]

    @property
    def deadlocked_since(self) -> Float[Tensor, "*teams robots"]:
        """The time from which a robot stands still until the end although its nominal control is not zero [s].

        It is NaN for a robot that is not deadlocked, and for an empty slot. A robot stopped by an infeasible QP counts
        as deadlocked; `feasible` tells the two apart.
        """
        with torch.no_grad():
            stuck = stands_still(self.u[..., : self.robots, :], self.nominal)
            if self.velocity is not None:
                stuck = stuck & (self.velocity[..., : self.robots, :].norm(dim=-1) <= AT_REST)
            if self.present is not None:
                stuck = stuck & self.present[..., : self.robots]
            until_the_end = stuck.flip(0).long().cumprod(0).sum(0)
            since = self.t[(len(self.t) - until_the_end).clamp(max=len(self.t) - 1)]
            return torch.where(until_the_end > 0, since, torch.nan)

    def measurement(self, k: int) -> Measurement:
        """The measurement of the robots at sample `k`. Before the first sample all velocities are zero."""
        if self.velocity is None:
            arrival = torch.zeros_like(self.u[k]) if k == 0 else self.u[k - 1]
        else:
            arrival = self.velocity[k]
        t, second_order = float(self.t[k]), self.velocity is not None
        return _of_teams(t, self.x[k], arrival, self.u[k], self.robots, self.radius, second_order, self.present)

    def block(self, first: int = 0, last: int | None = None) -> Measurement:
        """The measurements of samples `first` to `last - 1` as one, batch (samples, *teams, robots)."""
        part, u = slice(first, last), self.u[slice(first, last)]
        if self.velocity is None:
            before = self.u[first - 1 : first] if first > 0 else torch.zeros_like(self.u[:1])
            arrival = torch.cat([before, u[:-1]])
        else:
            arrival = self.velocity[part]
        t = self.t[part].reshape(-1, *[1] * (u.ndim - 2)).expand(*u.shape[:-2], self.robots)
        second_order = self.velocity is not None
        return _of_teams(t, self.x[part], arrival, u, self.robots, self.radius, second_order, self.present)

    def team(self, i: int) -> Trajectory:
        """The run of one team of a batch (teams,)."""
        return replace(
            self,
            **{name: getattr(self, name)[:, i] for name in ("x", "u", "nominal", "active", "feasible")},
            radius=self.radius if self.radius is None or self.radius.ndim == 1 else self.radius[i],
            velocity=None if self.velocity is None else self.velocity[:, i],
            present=None if self.present is None else self.present[i],
        )

    def measurements(self) -> Iterator[Measurement]:
        """All samples, in the order of time."""
        return (self.measurement(k) for k in range(len(self.t)))

    def save(self, path: str | Path, names: Sequence[str] | None = None) -> Path:
        """Write the run of one team as a log (CSV), which `fsid.read_log` and `torchfsid observe` read.

        A log begins with its first sample. So where rows use the neighbours' previous velocities, observers of the log
        skip that sample, and observers of `measurements` do not.

        Args:
            path: the file, *.csv.
            names: the names of all bodies, robots first. Default: "0", "1", ... and "obstacle_0", ...

        Raises:
            InputError: it is a batch of teams, names do not fit, or the suffix is not .csv.
            OSError: the file cannot be written.
        """
        return write_run(self, path, names)


def simulate(
    controller: CbfQpController,
    theta: Float[Tensor, "*teams robots p"],
    start: Float[Tensor, "*teams robots n"],
    *,
    dt: float,
    steps: int,
    velocity: Float[Tensor, "*teams robots n"] | None = None,
    obstacles: Float[Tensor, "*#teams obstacles n"] | None = None,
    radius: Float[Tensor, "*#teams bodies"] | None = None,
    present: Bool[Tensor, "*#teams bodies"] | None = None,
) -> Trajectory:
    """Run a team, or a batch of teams, for `steps` steps. The result has steps + 1 samples, all with controls.

    The barriers choose the neighbours' velocities: none, those of one sample ago (zero at the first), or the current
    ones. Current velocities (of robots of second order: accelerations) need one QP over the team. A robot whose QP is
    infeasible has the control zero for that step, and the run goes on.

    Args:
        controller: the controller of all robots.
        theta: the robots' parameters.
        start: their first positions [m].
        dt: length of a step [s].
        steps: the number of steps.
        velocity: the velocities of robots of second order at the start [m/s]. None: the robots are of first order.
        obstacles: positions of bodies that stand still [m]. Their slots come after the robots'.
        radius: radii of all bodies, robots first [m], for barriers given by a margin.
        present: the slots that hold a body, for teams of different sizes. Nobody avoids the others, and what they do
            means nothing. None: all do.

    Raises:
        InputError: shapes do not fit, positions are not finite, `dt` or `steps` is not positive.
    """
    if start.ndim < 2 or not bool(start.isfinite().all()):
        raise InputError("start", "finite positions (*teams, robots, n)", start)
    *teams, robots, n = start.shape
    obstacles = start.new_zeros(0, n) if obstacles is None else obstacles
    if obstacles.ndim < 2 or obstacles.shape[-1] != n or not bool(obstacles.isfinite().all()):
        raise InputError("obstacles", f"finite positions (*teams, obstacles, {n})", obstacles)
    bodies = robots + obstacles.shape[-2]
    if theta.ndim != start.ndim or theta.shape[:-1] != start.shape[:-1]:
        expected = f"parameters ({', '.join(map(str, (*teams, robots)))}, p), one row per robot"
        raise InputError("theta", expected, tuple(theta.shape))
    if velocity is not None and (velocity.shape != start.shape or not bool(velocity.isfinite().all())):
        raise InputError("velocity", f"finite velocities {tuple(start.shape)}", velocity)
    if radius is not None and radius.shape[-1:] != (bodies,):
        raise InputError("radius", f"(*teams, {bodies}), robots first, then obstacles", tuple(radius.shape))
    if present is not None and present.shape[-1:] != (bodies,):
        raise InputError("present", f"(*teams, {bodies}), robots first, then obstacles", tuple(present.shape))
    if not (dt > 0 and steps > 0):
        raise InputError("dt, steps", "positive", (dt, steps))
    try:
        standing = obstacles.to(torch.float64).expand(*teams, -1, -1)
    except RuntimeError as error:
        raise InputError("obstacles", f"teams {tuple(teams)}, or none", tuple(obstacles.shape)) from error
    at_rest = torch.zeros_like(standing)

    def with_obstacles(of_robots: Tensor, of_obstacles: Tensor) -> Tensor:
        return torch.cat([of_robots, of_obstacles], dim=-2)

    states = []

    def surroundings(t: float, x: Tensor, v: Tensor) -> Measurement:
        x, v = with_obstacles(x, standing), with_obstacles(v, at_rest)
        states.append((x, v))
        return _of_teams(t, x, v, None, robots, radius, velocity is not None, present)

    samples = list(closed_loop(controller, theta, start, surroundings, dt=dt, samples=steps + 1, velocity=velocity))
    controls = [sample.control for sample in samples]
    return Trajectory(
        t=dt * torch.arange(steps + 1, dtype=torch.float64, device=start.device),
        x=torch.stack([x for x, _ in states]),
        u=torch.stack([with_obstacles(control.u, at_rest) for control in controls]),
        nominal=torch.stack([control.nominal for control in controls]),
        active=torch.stack([control.active for control in controls]),
        feasible=torch.stack([control.feasible for control in controls]),
        radius=radius,
        velocity=None if velocity is None else torch.stack([v for _, v in states]),
        present=present,
    )


def stands_still(u: Float[Tensor, "*batch n"], nominal: Float[Tensor, "*batch n"]) -> Bool[Tensor, "*batch"]:
    """Does a robot stand still although its nominal control is not zero?"""
    speed = nominal.norm(dim=-1)
    return (u.norm(dim=-1) <= STILL * speed) & (speed > IDLE)


def _of_teams(
    t: float | Tensor,
    x: Tensor,
    v: Tensor,
    u: Tensor | None,
    robots: int,
    radius: Tensor | None,
    second_order: bool,
    present: Tensor | None,
) -> Measurement:
    """`Measurement.of_team` for a batch of teams whose first bodies are the robots, which arrive with velocities v."""
    teams, bodies = x.shape[:-2], x.shape[-2]
    slot = torch.arange(bodies, device=x.device)
    others = (slot != slot[:robots, None]).expand(*teams, robots, bodies)
    if present is not None:
        others = others & present.unsqueeze(-2) & present[..., :robots].unsqueeze(-1)
    radius = None if radius is None else radius.to(torch.float64).expand(*teams, bodies)

    def among(of_bodies: Tensor) -> Tensor:
        return of_bodies.unsqueeze(len(teams)).expand(*teams, robots, *of_bodies.shape[len(teams) :])

    controls = None if u is None else among(u)
    return Measurement(
        t=t,
        x=x[..., :robots, :],
        u=None if u is None else u[..., :robots, :],
        bodies=among(x),
        present=others,
        velocity=v[..., :robots, :],
        body_velocities=among(v) if second_order else controls,
        previous_body_velocities=None if second_order else among(v),
        body_accelerations=controls if second_order else None,
        radius=None if radius is None else radius[..., :robots],
        body_radii=None if radius is None else among(radius),
        observed=None if present is None else present[..., :robots].expand(*teams, robots),
    )
