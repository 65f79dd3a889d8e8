"""What the observer sees at one instant: positions and velocities, nothing else (G., Assumption 1).

A batch of B robots looks at the same M bodies: slot j is body j for every robot, and a mask says which bodies are there
and are not the robot itself. So a team of N robots is a batch of N with M = N slots, and no index list is ever needed.
In a fleet that would be N^2 rows: there each robot has the slots of its M nearest bodies (`neighbours`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.errors import InputError


class LeftOut(NamedTuple):
    """Bodies without a slot: none is nearer than `distance` [m] (infinite: there are none), faster than `speed` [m/s]
    or larger than `radius` [m]; NaN where unknown."""

    distance: Float[Tensor, "*batch"]
    speed: Float[Tensor, "*batch"]
    radius: Float[Tensor, "*batch"]


@dataclass(frozen=True)
class Measurement:
    """One instant of B robots among M bodies.

    Attributes:
        t: time [s].
        x: positions [m].
        u: commands executed from t on, i.e. velocities [m/s]; None before they are known (the forward model).
        bodies: positions of whatever may have to be avoided [m].
        present: slot j holds a body that is there at t and is not the robot itself.
        body_velocities: the bodies' velocities at t [m/s]; NaN where unknown.
        previous_body_velocities: their velocities one sample earlier [m/s]; NaN where unknown.
        radius, body_radii: [m], where known.
        observed: the robot was measured at t (None: all were). Where False, x and u are zeros, never NaN.
        position_error, body_position_error: bounds on the error of x and of bodies at this instant [m]; None: zero.
        velocity_error, body_velocity_error: likewise of u and of the bodies' velocities [m/s].
        left_out: the bodies without a slot (None: all have one). Samples that they could matter for are not used.
    """

    t: float
    x: Float[Tensor, "*batch n"]
    u: Float[Tensor, "*batch n"] | None
    bodies: Float[Tensor, "*batch m n"]
    present: Bool[Tensor, "*batch m"]
    body_velocities: Float[Tensor, "*batch m n"] | None = None
    previous_body_velocities: Float[Tensor, "*batch m n"] | None = None
    radius: Float[Tensor, "*batch"] | None = None
    body_radii: Float[Tensor, "*batch m"] | None = None
    observed: Bool[Tensor, "*batch"] | None = None
    position_error: Float[Tensor, "*batch"] | None = None
    body_position_error: Float[Tensor, "*batch m"] | None = None
    velocity_error: Float[Tensor, "*batch"] | None = None
    body_velocity_error: Float[Tensor, "*batch m"] | None = None
    left_out: LeftOut | None = None

    @classmethod
    def of_team(
        cls,
        t: float,
        x: Float[Tensor, "bodies n"],
        u: Float[Tensor, "bodies n"] | None = None,
        *,
        robots: Sequence[int] | None = None,
        previous_u: Float[Tensor, "bodies n"] | None = None,
        radius: Float[Tensor, "bodies"] | None = None,
        seen: Bool[Tensor, "bodies"] | None = None,
        position_error: Float[Tensor, "bodies"] | None = None,
        velocity_error: Float[Tensor, "bodies"] | None = None,
    ) -> Measurement:
        """The batch of the inferred `robots` (indices; default all) among all bodies of a team.

        `seen` marks the bodies measured at t: the others are no obstacles, and unobserved if they are robots.

        Raises:
            InputError: `x`, `u` are not (bodies, n).
        """
        x = torch.as_tensor(x).to(torch.float64)
        if x.ndim != 2:
            raise InputError("x", "positions (bodies, n)", tuple(x.shape))
        if u is not None and u.shape != x.shape:
            raise InputError("u", f"velocities of shape {tuple(x.shape)}", tuple(u.shape))
        count = x.shape[0]
        slot = torch.arange(count, device=x.device)
        index = slot if robots is None else slot[list(robots)]
        seen = torch.ones_like(slot, dtype=torch.bool) if seen is None else seen

        def for_each_robot(of_bodies: Tensor | None) -> Tensor | None:
            return None if of_bodies is None else of_bodies.to(torch.float64).expand(len(index), *of_bodies.shape)

        def own(of_bodies: Tensor | None) -> Tensor | None:
            return None if of_bodies is None else of_bodies.to(torch.float64)[index]

        bodies = for_each_robot(x)
        assert bodies is not None
        return cls(
            t=t,
            x=x[index],
            u=own(u),
            bodies=bodies,
            present=seen & (slot != index.unsqueeze(-1)),
            body_velocities=for_each_robot(u),
            previous_body_velocities=for_each_robot(previous_u),
            radius=own(radius),
            body_radii=for_each_robot(radius),
            observed=seen[index],
            position_error=own(position_error),
            body_position_error=for_each_robot(position_error),
            velocity_error=own(velocity_error),
            body_velocity_error=for_each_robot(velocity_error),
        )
