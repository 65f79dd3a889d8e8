r"""A team of robots in closed loop, sampled: what an observer gets to see, with the truth beside it.

    x_i(t + dt) = x_i(t) + dt u_i(t),     u_i(t) = u*(x(t); theta_i)        (G., Eqs. (4), (5), the control held for dt)

All robots compute at the same time, from the positions at t. Every robot avoids every other and the obstacles, which
stand still. The trajectory is differentiable in theta, start, obstacles, gains and distances.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.robots.controller import CbfQpController, Control
from torchfsid.robots.measurement import Measurement

STILL = 1e-3
"""A robot stands still where its speed is at most this fraction of its nominal speed ..."""

IDLE = 1e-6
"""... and that nominal speed is above this one [m/s]: below it, it has nowhere to go."""


@dataclass(frozen=True)
class Trajectory:
    """T samples of N robots, which come first, and K obstacles.

    Attributes:
        t: times [s].
        x: positions of all bodies [m].
        u: their velocities from t on [m/s]; zero for obstacles, and for a robot whose QP is infeasible.
        nominal: what the robots' tasks alone would do [m/s].
        active: the robots' rows with a positive multiplier, in the order of the controller's barriers.
        feasible: the robot's QP had a solution.
        radius: of all bodies [m], if given.
    """

    t: Float[Tensor, "samples"]
    x: Float[Tensor, "samples bodies n"]
    u: Float[Tensor, "samples bodies n"]
    nominal: Float[Tensor, "samples robots n"]
    active: Bool[Tensor, "samples robots m"]
    feasible: Bool[Tensor, "samples robots"]
    radius: Float[Tensor, "bodies"] | None = None

    @property
    def robots(self) -> int:
        return self.nominal.shape[1]

    @property
    def deadlocked_since(self) -> Float[Tensor, "robots"]:
        """The time from which a robot stands still until the end though it has somewhere to go; NaN if it does not [s].

        A robot stopped by an infeasible QP counts too: `feasible` tells the two apart.
        """
        with torch.no_grad():
            speed, nominal_speed = self.u[:, : self.robots].norm(dim=-1), self.nominal.norm(dim=-1)
            stuck = (speed <= STILL * nominal_speed) & (nominal_speed > IDLE)
            until_the_end = stuck.flip(0).long().cumprod(0).sum(0)
            since = self.t[(len(self.t) - until_the_end).clamp(max=len(self.t) - 1)]
            return torch.where(until_the_end > 0, since, torch.nan)

    def measurement(self, k: int) -> Measurement:
        """What is seen of the robots at sample `k`. Before the first sample, everything stood still."""
        before = torch.zeros_like(self.u[k]) if k == 0 else self.u[k - 1]
        return _seen(float(self.t[k]), self.x[k], self.u[k], before, self.robots, self.radius)

    def measurements(self) -> Iterator[Measurement]:
        """All samples, in the order of time."""
        return (self.measurement(k) for k in range(len(self.t)))


def simulate(
    controller: CbfQpController,
    theta: Float[Tensor, "robots p"],
    start: Float[Tensor, "robots n"],
    *,
    dt: float,
    steps: int,
    obstacles: Float[Tensor, "obstacles n"] | None = None,
    radius: Float[Tensor, "bodies"] | None = None,
) -> Trajectory:
    """Run the closed loop for `steps` steps of `dt` [s]: steps + 1 samples, the last with its control too.

    Args:
        theta: the robots' parameters. start: their first positions [m].
        obstacles: positions of what stands still [m]; their slots come after the robots'.
        radius: of all bodies, robots first [m]; for barriers given by a margin.

    Neighbours' velocities are what the barrier says: none, of one sample ago (zero at the first), or current (one QP
    over the team). A robot whose QP is infeasible stands still for that step, and the run goes on.

    Raises:
        InputError: shapes do not fit, positions are not finite, `dt` or `steps` is not positive.
    """
    if start.ndim != 2 or not bool(start.isfinite().all()):
        raise InputError("start", "finite positions (robots, n)", start)
    robots, n = start.shape
    obstacles = start.new_zeros(0, n) if obstacles is None else obstacles
    if obstacles.ndim != 2 or obstacles.shape[-1] != n or not bool(obstacles.isfinite().all()):
        raise InputError("obstacles", f"finite positions (obstacles, {n})", obstacles)
    bodies = robots + len(obstacles)
    if theta.ndim != 2 or len(theta) != robots:
        raise InputError("theta", f"parameters ({robots}, p), one row per robot", tuple(theta.shape))
    if radius is not None and radius.shape != (bodies,):
        raise InputError("radius", f"({bodies},), robots first, then obstacles", tuple(radius.shape))
    if not (dt > 0 and steps > 0):
        raise InputError("dt, steps", "positive", (dt, steps))

    standing = torch.zeros(len(obstacles), n, dtype=torch.float64, device=start.device)
    x = torch.cat([start, obstacles]).to(torch.float64)
    u = torch.zeros_like(x)
    t = dt * torch.arange(steps + 1, dtype=torch.float64, device=start.device)
    positions: list[Tensor] = []
    velocities: list[Tensor] = []
    controls: list[Control] = []
    for k in range(steps + 1):
        control = controller(_seen(k * dt, x, None, u, robots, radius), theta)
        u = torch.cat([control.u, standing])
        positions.append(x)
        velocities.append(u)
        controls.append(control)
        x = x + dt * u
    return Trajectory(
        t=t,
        x=torch.stack(positions),
        u=torch.stack(velocities),
        nominal=torch.stack([control.nominal for control in controls]),
        active=torch.stack([control.active for control in controls]),
        feasible=torch.stack([control.feasible for control in controls]),
        radius=radius,
    )


def _seen(t: float, x: Tensor, u: Tensor | None, previous_u: Tensor, robots: int, radius: Tensor | None) -> Measurement:
    return Measurement.of_team(t, x, u, robots=range(robots), previous_u=previous_u, radius=radius)
