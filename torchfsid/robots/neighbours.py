r"""Fleets: each robot has M slots for its nearest of N bodies, and the rows of the others are proved inactive.

A body without a slot has no row, and an observer that lacks a truly active row may lose the truth. So a robot's sample
is used only if the rows left out are provably inactive. The row of a body at distance r allows the robot to approach it
at the speed

    phi(r) = alpha(h)/|dh/dx|    [m/s],   which grows with r,

So at the robot's control u its slack is at least phi(r) - |u| - |u_j|, the last term only if the row uses the
neighbour's velocity. (`second_order` has the bound for accelerations.) Let R be the least distance of a body without a
slot, V the largest speed of these bodies, and `bound` the largest slack of an active row. The rows left out are
inactive if

    phi(R) - |u| - V > bound.

Each barrier computes this least slack (`slack_left_out`). For a barrier that does not, nothing is proved. Bodies beyond
a sensing radius follow the same rule, with R at most the radius.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.device import all_seen
from torchfsid.errors import InputError
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import LeftOut, Measurement


def nearest_bodies(
    t: float,
    x: Float[Tensor, "bodies n"] | Float[np.ndarray, "bodies n"],
    u: Float[Tensor, "bodies n"] | Float[np.ndarray, "bodies n"] | None = None,
    *,
    count: int,
    within: float = math.inf,
    robots: Sequence[int] | None = None,
    previous_u: Float[Tensor, "bodies n"] | Float[np.ndarray, "bodies n"] | None = None,
    radius: Float[Tensor, "bodies"] | Float[np.ndarray, "bodies"] | None = None,
    seen: Bool[Tensor, "bodies"] | Bool[np.ndarray, "bodies"] | None = None,
    position_error: Float[Tensor, "bodies"] | Float[np.ndarray, "bodies"] | None = None,
    velocity_error: Float[Tensor, "bodies"] | Float[np.ndarray, "bodies"] | None = None,
    acceleration: Float[Tensor, "bodies n"] | Float[np.ndarray, "bodies n"] | None = None,
    acceleration_error: Float[Tensor, "bodies"] | Float[np.ndarray, "bodies"] | None = None,
) -> Measurement:
    """The batch of the inferred `robots`, each with slots for its `count` nearest bodies `within` a distance [m].

    They are found by a k-d tree, at a cost that grows as N log N. `left_out` describes the other bodies.

    Args:
        t: time [s].
        x: positions of all bodies [m].
        u: their velocities [m/s].
        count: the number of slots of each robot.
        within: the distance beyond which bodies get no slot [m].
        robots: indices of the bodies that are inferred; default all.
        previous_u: velocities one sample earlier [m/s].
        radius: radii of the bodies [m].
        seen: the bodies measured at t; default all. Others are no obstacles, and unobserved if they are robots.
        position_error: bounds on the errors of `x` [m].
        velocity_error: bounds on the errors of `u` and `previous_u` [m/s].
        acceleration: accelerations from t on, the controls of robots of second order [m/s2]. Their `u` is a state.
        acceleration_error: bounds on the errors of `acceleration` [m/s2].

    Raises:
        InputError: an argument has the wrong shape or type, there are accelerations without velocities, an index in
            `robots` is no body, a position of a body that was seen is not finite, or `count` or `within` is not
            positive.
    """
    x = _numbers("x", x)
    if x.ndim != 2:
        raise InputError("x", "positions (bodies, n)", tuple(x.shape))
    if not isinstance(count, numbers.Integral) or isinstance(count, bool) or count < 1:
        raise InputError("count", "a positive whole number of slots", count)
    if not within > 0:
        raise InputError("within", "a positive distance [m]", within)
    index = _indices(robots, x)
    vectors = {"u": u, "previous_u": previous_u, "acceleration": acceleration}
    u, previous_u, acceleration = (_of_bodies(name, v, x.shape, x) for name, v in vectors.items())
    if acceleration is not None and u is None:
        raise InputError("u", "velocities, beside the accelerations", None)
    errors = {"position_error": position_error, "velocity_error": velocity_error}
    sized = {"radius": radius, **errors, "acceleration_error": acceleration_error}
    radius, position_error, velocity_error, acceleration_error = (
        _of_bodies(name, v, x.shape[:1], x) for name, v in sized.items()
    )
    state, control, control_error = previous_u, u, velocity_error
    if acceleration is not None:
        state, control, control_error = u, acceleration, acceleration_error
    was_seen = torch.ones(len(x), dtype=torch.bool, device=x.device) if seen is None else _seen(seen, x)
    lost = (was_seen & ~x.isfinite().all(-1)).nonzero().flatten().tolist()
    if lost:
        raise InputError("x", "finite positions of the bodies seen", f"{x[lost[0]].tolist()} of body {lost[0]}")
    distance, slots = _nearest(x, index, was_seen, int(count))
    present = (distance[:, :-1] <= within) & distance[:, :-1].isfinite()
    slots = torch.where(present, slots[:, :-1], 0)

    def own(of_bodies: Tensor | None) -> Tensor | None:
        return None if of_bodies is None else of_bodies[index]

    def of_slots(of_bodies: Tensor | None) -> Tensor | None:
        return None if of_bodies is None else of_bodies[slots]

    def largest(of_bodies: Tensor | None, default: float = math.nan) -> Tensor:
        there = None if of_bodies is None else of_bodies.detach()[was_seen]
        return x.new_tensor(default) if there is None or len(there) == 0 else there.max()

    left_out, next_one = None, distance[:, -1]
    if not bool(next_one.isinf().all() & present.all()):
        speeds = [v.norm(dim=-1) for v in (u, previous_u) if v is not None]
        speed = largest(torch.stack(speeds).amax(0) if speeds else None) + largest(velocity_error, 0.0)
        pull = largest(None if acceleration is None else acceleration.norm(dim=-1)) + largest(acceleration_error, 0.0)
        away = (next_one.clamp(max=within) - largest(position_error, 0.0)).clamp(min=0.0)
        left_out = LeftOut(away, *(bound.expand(len(index)) for bound in (speed, largest(radius), pull)))
    return Measurement(
        t=t,
        x=x[index],
        u=own(control),
        bodies=x[slots],
        present=present,
        velocity=own(state),
        body_velocities=of_slots(u),
        previous_body_velocities=of_slots(previous_u),
        body_accelerations=of_slots(acceleration),
        radius=own(radius),
        body_radii=of_slots(radius),
        observed=None if seen is None else was_seen[index],
        position_error=own(position_error),
        body_position_error=of_slots(position_error),
        velocity_error=own(control_error),
        body_velocity_error=of_slots(velocity_error),
        arrival_error=own(velocity_error),
        body_acceleration_error=of_slots(acceleration_error),
        left_out=left_out,
    )


def within_bounds(measurement: Measurement, noise: NoiseBound) -> Measurement:
    """The measurement with the declared bounds on velocities and accelerations added to what it says of itself.

    That is, to `arrival_error`, and to what the bodies without a slot may do.
    """
    left_out, error = measurement.left_out, measurement.arrival_error
    assert left_out is not None
    arrival = torch.zeros_like(measurement.x[..., 0]) + noise.arrival
    faster = left_out._replace(
        speed=left_out.speed + noise.neighbour_velocity,
        acceleration=left_out.acceleration + noise.neighbour_acceleration,
    )
    return replace(measurement, arrival_error=arrival if error is None else arrival + error, left_out=faster)


def left_out_inactive(
    barriers: Sequence[Barrier],
    measurement: Measurement,
    bound: Float[Tensor, "*#batch"],
    error: Float[Tensor, "*#batch"],
) -> Bool[Tensor, "*batch"]:
    """Are the rows of all bodies without a slot provably inactive?

    Args:
        barriers: the barriers of the robots.
        measurement: the measurement, with the bodies that it leaves out.
        bound: the largest slack of an active row, in units of the control.
        error: a bound on the error of the distance to a body [m].

    Raises:
        InputError: class_k.power < 1/2 with squared distances, so that phi would not grow with the distance.
    """
    left_out = measurement.left_out
    assert left_out is not None
    # Twice the error, since the other bodies, to which a barrier may compare them, may be that much further.
    nearer = replace(measurement, left_out=left_out._replace(distance=left_out.distance - 2 * error))
    inactive = left_out.distance.isinf()  # no body is left out
    if all_seen(inactive):
        return inactive
    proven = torch.ones_like(inactive)
    for barrier in barriers:
        if not hasattr(barrier, "slack_left_out"):
            return inactive
        slack: Tensor = barrier.slack_left_out(nearer)  # type: ignore[attr-defined]
        proven = proven & (slack > bound)
    return inactive | proven


def _numbers(name: str, value: Any) -> Tensor:
    try:
        return torch.as_tensor(value).to(torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(name, "an array of numbers", type(value).__name__) from error


def _of_bodies(name: str, value: Any, shape: torch.Size, x: Tensor) -> Tensor | None:
    """The argument as a tensor with a number or vector for each body. Raises `InputError` for another shape."""
    if value is None:
        return None
    value = _numbers(name, value).to(x.device)
    if value.shape != shape:
        raise InputError(name, f"the shape {tuple(shape)}", tuple(value.shape))
    if name.endswith("_error") and bool((value < 0).any()):
        raise InputError(name, "bounds >= 0", value.min().item())
    return value


def _seen(seen: Any, x: Tensor) -> Bool[Tensor, "bodies"]:
    seen = torch.as_tensor(seen).to(x.device)
    if seen.dtype != torch.bool or seen.shape != x.shape[:1]:
        raise InputError("seen", f"booleans of the shape ({len(x)},)", (seen.dtype, tuple(seen.shape)))
    return seen


def _indices(robots: Sequence[int] | None, x: Tensor) -> Tensor:
    if robots is None:
        return torch.arange(len(x), device=x.device)
    for robot in robots:
        if not isinstance(robot, numbers.Integral) or isinstance(robot, bool) or not 0 <= robot < len(x):
            raise InputError("robots", f"indices of bodies, 0 to {len(x) - 1}", robot)
    return torch.tensor([int(robot) for robot in robots], dtype=torch.int64, device=x.device)


def _nearest(x: Tensor, index: Tensor, seen: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The distances [m] and indices of the count + 1 nearest bodies that were seen. Missing ones are infinitely far."""
    from scipy.spatial import KDTree

    places, robot, shown = x.detach().cpu().numpy(), index.cpu().numpy(), seen.nonzero().flatten().cpu().numpy()
    here = np.where(np.isin(robot, shown)[:, None], places[robot], 0.0)
    # One more for the robot itself, one more for the nearest body without a slot. Missing ones are infinitely far.
    distance, found = KDTree(places[shown]).query(here, k=count + 2)
    body = np.append(shown, -1)[found]
    distance[body == robot[:, None]] = -1.0  # the robot itself comes first, also where bodies share its place
    order = np.argsort(distance, axis=1, kind="stable")[:, 1:]
    nearest = (torch.from_numpy(np.take_along_axis(values, order, 1)).to(x.device) for values in (distance, body))
    return tuple(nearest)  # type: ignore[return-value]
