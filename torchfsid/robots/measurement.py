"""A measurement: the positions and velocities that the observer sees at one instant (G., Assumption 1).

A batch of B robots shares the same M bodies. Slot j is body j for every robot, and a mask says which bodies are present
and are not the robot itself. So a team of N robots is a batch of N with M = N slots. A fleet would need N^2 rows.
There, each robot has slots for its M nearest bodies only (`neighbours`).

Each robot may have its own time, so that the samples of a whole log can be concatenated into one batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.device import on_host
from torchfsid.errors import InputError
from torchfsid.halfspaces import finite


class LeftOut(NamedTuple):
    """Bodies without a slot.

    Attributes:
        distance: a lower bound on their distances [m]; infinite if there are none.
        speed: an upper bound on their speeds [m/s]; NaN if unknown.
        radius: an upper bound on their radii [m]; NaN if unknown.
        acceleration: an upper bound on their accelerations [m/s2]; NaN if unknown.
    """

    distance: Float[Tensor, "*batch"]
    speed: Float[Tensor, "*batch"]
    radius: Float[Tensor, "*batch"]
    acceleration: Float[Tensor, "*batch"]


@dataclass(frozen=True)
class Measurement:
    """One instant of B robots among M bodies, or several instants concatenated.

    Attributes:
        t: time [s]; a tensor where the robots were measured at different times.
        x: positions [m].
        u: the robots' controls from t on; None before they are known (the forward model). Robots of first order are
            driven by velocities [m/s], robots of second order by accelerations [m/s2].
        bodies: positions of the bodies that may have to be avoided [m].
        present: whether slot j holds a body that is present at t and is not the robot itself.
        body_velocities: the bodies' velocities at t [m/s]; NaN where unknown.
        previous_body_velocities: their velocities one sample earlier [m/s]; NaN where unknown.
        radius: the robots' radii [m], if known.
        body_radii: the bodies' radii [m], if known.
        observed: whether the robot was measured at t; None if all were. Where False, x and u are not used.
        position_error: bounds on the error of `x` at this instant [m]; None for zero.
        body_position_error: bounds on the error of `bodies` [m]; None for zero.
        velocity_error: bounds on the error of `u`, in its units; None for zero.
        body_velocity_error: bounds on the errors of the bodies' velocities [m/s]; None for zero.
        left_out: the bodies without a slot; None if all have one. A sample for which they could matter is not used.
        velocity: velocities with which the robots arrive at t [m/s]: the state of robots of second order, and the
            controls of one sample earlier of robots of first order. None if unknown.
        body_accelerations: the bodies' accelerations from t on [m/s2]; NaN where unknown. None, unless the robots are
            of second order and the controls are known.
        arrival_error: bounds on the error of `velocity` [m/s]; None for zero.
        body_acceleration_error: bounds on the errors of `body_accelerations` [m/s2]; None for zero.
    """

    t: float | Float[Tensor, "*batch"]
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
    velocity: Float[Tensor, "*batch n"] | None = None
    body_accelerations: Float[Tensor, "*batch m n"] | None = None
    arrival_error: Float[Tensor, "*batch"] | None = None
    body_acceleration_error: Float[Tensor, "*batch m"] | None = None

    @classmethod
    def of_team(
        cls,
        t: float | Float[Tensor, "times"],
        x: Float[Tensor, "*times bodies n"],
        u: Float[Tensor, "*times bodies n"] | None = None,
        *,
        robots: Sequence[int] | None = None,
        previous_u: Float[Tensor, "*times bodies n"] | None = None,
        acceleration: Float[Tensor, "*times bodies n"] | None = None,
        radius: Float[Tensor, "bodies"] | None = None,
        seen: Bool[Tensor, "*times bodies"] | None = None,
        position_error: Float[Tensor, "*times bodies"] | None = None,
        velocity_error: Float[Tensor, "*times bodies"] | None = None,
        acceleration_error: Float[Tensor, "*times bodies"] | None = None,
        neighbour_error: Float[Tensor, "*times bodies"] | None = None,
    ) -> Measurement:
        """The batch of the inferred `robots` among all bodies of a team, at one time, or at several concatenated.

        Args:
            t: time [s].
            x: positions of all bodies [m].
            u: their velocities [m/s].
            robots: indices of the bodies that are inferred; default all.
            previous_u: velocities one sample earlier [m/s].
            acceleration: accelerations from t on, the controls of robots of second order [m/s2]. Their `u` is a state.
            radius: radii of the bodies [m].
            seen: the bodies measured at t; default all. Others are no obstacles, and unobserved if they are robots.
            position_error: bounds on the errors of `x` [m].
            velocity_error: bounds on the errors of `u` and `previous_u` [m/s].
            acceleration_error: bounds on the errors of `acceleration` [m/s2].
            neighbour_error: other bounds than `velocity_error` where bodies are neighbours, and on arrival [m/s].

        Raises:
            InputError: `x`, `u`, `acceleration` are not (bodies, n) for each time, or there are accelerations without
                velocities.
        """
        x = torch.as_tensor(x).to(torch.float64)
        times = torch.as_tensor(t).shape
        if x.ndim != len(times) + 2 or x.shape[: len(times)] != times:
            raise InputError("x", f"positions ({', '.join(map(str, (*times, 'bodies, n')))})", tuple(x.shape))
        if u is not None and u.shape != x.shape:
            raise InputError("u", f"velocities of shape {tuple(x.shape)}", tuple(u.shape))
        second_order = acceleration is not None
        if second_order and (u is None or acceleration.shape != x.shape):
            expected = f"accelerations of shape {tuple(x.shape)}, and velocities u"
            raise InputError("acceleration", expected, tuple(acceleration.shape))
        axis, slot = len(times), torch.arange(x.shape[-2], device=x.device)
        index = slot if robots is None else slot[list(robots)]
        seen = slot.new_ones((*times, len(slot)), dtype=torch.bool) if seen is None else seen
        is_another = slot != index.unsqueeze(-1)
        neighbour_error = velocity_error if neighbour_error is None else neighbour_error

        def for_each_robot(of_bodies: Tensor | None) -> Tensor | None:
            if of_bodies is None:
                return None
            inner = of_bodies.shape[axis:]
            return of_bodies.to(torch.float64).unsqueeze(axis).expand(*times, len(index), *inner).flatten(0, axis)

        def own(of_bodies: Tensor | None) -> Tensor | None:
            return None if of_bodies is None else of_bodies.to(torch.float64).index_select(axis, index).flatten(0, axis)

        radius = None if radius is None else radius.expand(*times, -1)
        positions, bodies = own(x), for_each_robot(x)
        assert positions is not None
        assert bodies is not None
        return cls(
            t=torch.as_tensor(t, dtype=torch.float64).repeat_interleave(len(index)) if times else t,
            x=positions,
            u=own(acceleration if second_order else u),
            bodies=bodies,
            present=(seen.unsqueeze(axis) & is_another).flatten(0, axis),
            velocity=own(u if second_order else previous_u),
            body_velocities=for_each_robot(u),
            previous_body_velocities=for_each_robot(previous_u),
            body_accelerations=for_each_robot(acceleration),
            radius=own(radius),
            body_radii=for_each_robot(radius),
            observed=seen.index_select(axis, index).flatten(0, axis),
            position_error=own(position_error),
            body_position_error=for_each_robot(position_error),
            velocity_error=own(acceleration_error if second_order else velocity_error),
            body_velocity_error=for_each_robot(neighbour_error),
            arrival_error=own(neighbour_error),
            body_acceleration_error=for_each_robot(acceleration_error),
        )

    @property
    def is_second_order(self) -> bool:
        """Are the controls accelerations?"""
        return self.body_accelerations is not None

    @property
    def time(self) -> float:
        """The common time of all robots [s].

        Raises:
            InputError: the robots were measured at different times.
        """
        if not isinstance(self.t, Tensor):
            return self.t
        times = self.t.detach().flatten()
        if len(times) == 0 or not bool((times == times[0]).all()):
            raise InputError("measurement.t", "one time for all robots", f"{len(times.unique())} different times")
        return float(times[0])

    def select(self, items: Int[Tensor, "k"] | Bool[Tensor, "B"] | slice) -> Measurement:
        """The robots at the places `items` of a batch (B,). A place may occur twice. A slice copies nothing."""
        chosen = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor) and value.ndim > 0:
                chosen[field.name] = value[items]
        if self.left_out is not None:
            chosen["left_out"] = LeftOut(*(bound[items] for bound in self.left_out))
        return replace(self, **chosen)

    def flattened(self) -> Measurement:
        """A batch of any shape as one of shape (B,). Nothing is copied unless it has to be."""
        last = self.x.ndim - 2
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        flat = {name: of.flatten(0, last) for name, of in values.items() if isinstance(of, Tensor) and of.ndim > 0}
        left_out = None if self.left_out is None else LeftOut(*(bound.flatten(0, last) for bound in self.left_out))
        return replace(self, **flat, left_out=left_out)

    @classmethod
    def concatenate(cls, parts: Sequence[Measurement]) -> Measurement:
        """Several batches as one, one after the other. The time becomes a tensor.

        A field that only some parts have is filled in the others: no body left out, no error, all robots observed,
        velocities other than controls unknown (NaN).

        Raises:
            InputError: there are no parts, their numbers of slots differ, or only some have controls or radii.
        """
        if len({(part.x.shape[1:], part.bodies.shape[1:]) for part in parts}) != 1 or parts[0].x.ndim != 2:
            shapes = [(tuple(part.x.shape), tuple(part.bodies.shape)) for part in parts[:3]]
            raise InputError("parts", "batches (B, n) of robots, all with the same number of slots", shapes)

        def joined(name: str) -> Tensor | None:
            values = [getattr(part, name) for part in parts]
            if all(value is None for value in values):
                return None
            return torch.cat([_unknown(name, p) if v is None else v for v, p in zip(values, parts, strict=True)])

        names = [field.name for field in fields(cls) if field.name not in ("t", "left_out")]
        times = [torch.as_tensor(p.t, dtype=torch.float64, device=p.x.device).expand(len(p.x)) for p in parts]
        left_out = None
        if any(part.left_out is not None for part in parts):
            nobody = [part.x.new_tensor([[torch.inf], [0.0], [0.0], [0.0]]).expand(4, len(part.x)) for part in parts]
            columns = zip(*(p.left_out or none.unbind() for p, none in zip(parts, nobody, strict=True)), strict=True)
            left_out = LeftOut(*map(torch.cat, columns))
        return cls(t=torch.cat(times), left_out=left_out, **{name: joined(name) for name in names})  # type: ignore[arg-type]

    def observed_only(self) -> Measurement:
        """This measurement, with zeros for the positions and controls of unobserved robots that are not finite.

        On a device nothing waits for the check, and a robot with a number that is not finite is not observed.

        Raises:
            InputError: there are no controls, or a number of an observed robot is not finite.
        """
        if self.u is None:
            raise InputError("measurement.u", "velocities", None)
        if on_host(self.x, self.u) and finite(self.x, self.u):
            return self
        known = (self.x.sum(-1) + self.u.sum(-1)) * 0 == 0  # 0 times NaN or infinity is NaN
        observed = torch.ones_like(known) if self.observed is None else self.observed
        if not on_host(self.x, self.u):
            observed = observed & known
        elif bool((observed & ~known).any()):
            robot = (observed & ~known).nonzero()[0].tolist()
            raise InputError(
                "measurement", "finite positions and velocities of observed robots", f"others, of robot {robot}"
            )
        keep = known.unsqueeze(-1)
        x, u = torch.where(keep, self.x, 0.0), torch.where(keep, self.u, 0.0)
        return replace(self, x=x, u=u, observed=observed)


def _unknown(name: str, part: Measurement) -> Tensor:
    """The default value of a field that `part` does not have and another measurement has."""
    if name == "observed":
        return torch.ones_like(part.x[..., 0], dtype=torch.bool)
    if name.endswith("_error"):
        return torch.zeros_like(part.bodies[..., 0] if name.startswith("body") else part.x[..., 0])
    if name == "velocity":
        return torch.full_like(part.x, torch.nan)
    if name.endswith("body_velocities"):
        return torch.full_like(part.bodies, torch.nan)
    raise InputError(f"parts.{name}", "in all of the measurements or in none", "in some of them")
