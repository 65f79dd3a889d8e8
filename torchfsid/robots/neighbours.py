r"""Fleets: each robot among its nearest bodies only, M slots for N bodies, and what the others may still do.

A body without a slot has no row, and an observer that is missing a truly active row loses the truth. So a robot's
sample is used only if the rows left out are provably inactive. The row of a body at distance r allows the robot to
approach at

    phi(r) = alpha(h)/|dh/dx|    [m/s],   which grows with r,

so at the robot's control u its slack is at least phi(r) - |u| - |u_j| (the last if the row counts the neighbour's
velocity). With R the least distance of a body without a slot, V their largest speed, and `bound` the largest slack of
an active row, the rows left out are inactive if

    phi(R) - |u| - V > bound.

Bodies beyond a sensing radius are at least that far away: the same rule, with R no more than the radius.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.robots.barriers import Barrier, CollisionAvoidance
from torchfsid.robots.measurement import LeftOut, Measurement


def nearest_bodies(
    t: float,
    x: Float[Tensor, "bodies n"],
    u: Float[Tensor, "bodies n"] | None = None,
    *,
    count: int,
    within: float = math.inf,
    robots: Sequence[int] | None = None,
    previous_u: Float[Tensor, "bodies n"] | None = None,
    radius: Float[Tensor, "bodies"] | None = None,
) -> Measurement:
    """The batch of the inferred `robots` (indices; default all), each among its `count` nearest bodies `within` [m].

    Found by a k-d tree: the cost grows with N log N. `left_out` says what is known of the others.

    Raises:
        InputError: `x`, `u` are not (bodies, n), a position is not finite, or `count` or `within` is not positive.
    """
    from scipy.spatial import KDTree

    x = torch.as_tensor(x).to(torch.float64)
    if x.ndim != 2 or not bool(x.isfinite().all()):
        raise InputError("x", "finite positions (bodies, n)", tuple(x.shape))
    if u is not None and u.shape != x.shape:
        raise InputError("u", f"velocities of shape {tuple(x.shape)}", tuple(u.shape))
    if count < 1 or not within > 0:
        raise InputError("count, within", "positive", (count, within))
    places = x.detach().cpu().numpy()
    robot = np.arange(len(x)) if robots is None else np.asarray(robots, dtype=np.int64)
    # One more for the robot itself, one more for the nearest body without a slot; missing ones are infinitely far.
    distance, body = KDTree(places).query(places[robot], k=count + 2)
    distance[body == robot[:, None]] = -1.0  # the robot itself comes first, also where bodies share its place
    order = np.argsort(distance, axis=1, kind="stable")[:, 1:]
    distance, body = np.take_along_axis(distance, order, 1), np.take_along_axis(body, order, 1)
    there = (distance[:, :count] <= within) & np.isfinite(distance[:, :count])
    arrays = (distance[:, count], there, np.where(there, body[:, :count], 0), robot)
    next_one, present, slots, index = (torch.from_numpy(array).to(x.device) for array in arrays)

    def own(of_bodies: Tensor | None) -> Tensor | None:
        return None if of_bodies is None else of_bodies.to(torch.float64)[index]

    def of_slots(of_bodies: Tensor | None) -> Tensor | None:
        return None if of_bodies is None else of_bodies.to(torch.float64)[slots]

    def largest(of_bodies: Tensor | None) -> Float[Tensor, "robots"]:
        size = x.new_tensor(math.nan) if of_bodies is None else of_bodies.detach().to(torch.float64).max()
        return size.expand(len(index))

    bodies, left_out = of_slots(x), None
    assert bodies is not None
    if not bool(next_one.isinf().all() & present.all()):
        speeds = [v.norm(dim=-1) for v in (u, previous_u) if v is not None]
        speed = largest(torch.cat(speeds) if speeds else None)
        left_out = LeftOut(next_one.clamp(max=within), speed, largest(radius))
    return Measurement(
        t=t,
        x=x[index],
        u=own(u),
        bodies=bodies,
        present=present,
        body_velocities=of_slots(u),
        previous_body_velocities=of_slots(previous_u),
        radius=own(radius),
        body_radii=of_slots(radius),
        left_out=left_out,
    )


def left_out_inactive(
    barriers: Sequence[Barrier],
    measurement: Measurement,
    bound: Float[Tensor, "*#batch"],
    error: Float[Tensor, "*#batch"],
) -> Bool[Tensor, "*batch"]:
    """Are the rows of all bodies without a slot provably inactive? An unknown speed of theirs proves nothing.

    Args:
        bound: the largest slack of an active row [m/s]. error: of the distance to a body [m].

    Raises:
        InputError: class_k.power < 1/2 with squared distances: phi would not grow.
    """
    left_out, u = measurement.left_out, measurement.u
    assert left_out is not None
    assert u is not None
    inactive = torch.ones_like(left_out.distance, dtype=torch.bool)
    nearest = (left_out.distance - error).clamp(min=1e-9)
    somewhere = nearest.isfinite()
    ahead = torch.zeros_like(measurement.x)
    ahead[..., 0] = torch.where(somewhere, nearest, 1.0)
    standing = torch.zeros_like(ahead).unsqueeze(-2)
    for barrier in barriers:
        if not isinstance(barrier, CollisionAvoidance):
            continue
        if barrier.distance == "squared" and barrier.class_k.power < 0.5:
            raise InputError("class_k.power", "at least 1/2 where bodies are left out", barrier.class_k.power)
        if isinstance(barrier.safety_distance, Tensor):
            barrier = replace(barrier, safety_distance=barrier.safety_distance.max())
        row = barrier(
            Measurement(
                t=measurement.t,
                x=measurement.x,
                u=u,
                bodies=(measurement.x + ahead).unsqueeze(-2),
                present=torch.ones_like(inactive).unsqueeze(-1),
                body_velocities=standing,
                previous_body_velocities=standing,
                radius=measurement.radius,
                body_radii=left_out.radius.unsqueeze(-1),
            )
        )
        phi = (row.slack(torch.zeros_like(u)) - row.round_off(u)).squeeze(-1)
        slack = phi - u.norm(dim=-1)
        if barrier.neighbour_velocity != "none":
            slack = slack - left_out.speed
        inactive = inactive & (slack > bound) | ~somewhere
    return inactive
