r"""The controller: the safety QP, and its control as a differentiable function of all that it depends on.

    u* = argmin |u - uhat|^2  s.t.  A u <= b,      uhat = C theta + d                       (G., Eq. (5))
    uhat - u* = 1/2 sum_j mu_j a_j,   mu_j >= 0,   mu_j (a_j.u* - b_j) = 0                  (G., Eqs. (7)-(10))

Some barriers limit the speed as well, |u| <= limit (`Barrier.speed_limit`), and some controllers take the control with
the least violation where their rows are infeasible (`Barrier.relaxes`). See `speed_disc`.

The control u* is the safe control nearest to uhat (`programmes.nearest_point`), a velocity, or an acceleration for
robots of second order. It is exact. It is differentiable in theta, positions, gains and distances while the active set
does not switch. At a switch the derivative is that of one side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.device import on_host
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.outcome import Status
from torchfsid.programmes.differentiable import broadcast, nearest
from torchfsid.robots.arguments import require_barriers, require_task
from torchfsid.robots.barriers import Barrier, is_joint, neighbours_controls
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.speed_disc import least_violation, nearest_in_disc
from torchfsid.robots.tasks import Task, feedback_of


class QpSolution(NamedTuple):
    """The solution of a batch of safety QPs.

    Attributes:
        u: the controls; zero where infeasible.
        active: the rows with a positive multiplier, at most n. So it marks one of two equal rows, and two of three
            rows at a vertex.
        multipliers: mu_j >= 0 with uhat - u = 1/2 sum_j mu_j a_j, for the given rows a_j.
        feasible: whether some control satisfies the rows.
    """

    u: Float[Tensor, "*batch n"]
    active: Bool[Tensor, "*batch m"]
    multipliers: Float[Tensor, "*batch m"]
    feasible: Bool[Tensor, "*batch"]


def solve_safe_qp(safe_controls: Halfspaces, uhat: Float[Tensor, "*batch n"]) -> QpSolution:
    """The control closest to `uhat` among the safe ones, with gradients. Batches broadcast.

    An item whose rows or nominal control are not finite counts as infeasible. Two bodies at one place are an example.

    Raises:
        InputError: `uhat` has another dimension than the rows.
    """
    m, n = safe_controls.rows, safe_controls.dim
    if uhat.shape[-1:] != (n,):
        raise InputError("uhat", f"(*batch, {n})", tuple(uhat.shape))
    rows, y, _ = broadcast(safe_controls, uhat)
    nearest_control, mu, places, filled, status = nearest(rows, y)
    feasible = status == Status.OK
    u = torch.where(feasible.unsqueeze(-1), nearest_control, 0.0)
    held = torch.where(filled, 2 * mu.clamp(min=0), 0.0)
    multipliers = torch.zeros_like(rows.b).scatter_add(-1, places, held)[..., :m]
    return QpSolution(u, multipliers > 0, multipliers, feasible)


@dataclass(frozen=True)
class Control:
    """The controls of a batch of robots.

    Attributes:
        u: the control, a velocity [m/s] or an acceleration [m/s2]; where infeasible, zero or the control with the least
            violation (`Barrier.relaxes`).
        nominal: the nominal control uhat of the task, in the same units.
        active: the rows with a positive multiplier (see `QpSolution`).
        feasible: whether some control satisfies the rows and the limit.
    """

    u: Float[Tensor, "*batch n"]
    nominal: Float[Tensor, "*batch n"]
    active: Bool[Tensor, "*batch m"]
    feasible: Bool[Tensor, "*batch"]


@dataclass(frozen=True)
class CbfQpController:
    """Follow the task as closely as the barriers allow: `controller(measurement, theta)`.

    A barrier may use the neighbours' current controls. If the measurement does not hold them, one QP decides for all
    robots of a team. The last dimension of the batch is then a team whose robot i is the body in slot i, and the
    controls of other bodies are zero. One infeasible robot sets the controls of its whole team to zero.

    The controller keeps soft barriers like all others. `soft` matters only to observers.

    Raises:
        InputError: there is no barrier, or another one beside a barrier that is relaxed: which of them would give way?
    """

    task: Task
    barriers: Sequence[Barrier]

    def __post_init__(self) -> None:
        require_task(self.task)
        require_barriers(self.barriers)
        if len(self.barriers) == 0:
            raise InputError("barriers", "at least one barrier", self.barriers)
        if len(self.barriers) > 1 and any(getattr(barrier, "relaxes", False) for barrier in self.barriers):
            raise InputError("barriers", "no other barrier beside one that is relaxed (ORCA)", self.barriers)

    def __call__(self, measurement: Measurement, theta: Float[Tensor, "*theta_batch p"]) -> Control:
        """The controls for the parameters `theta` (*theta_batch, p). Its batch and the measurement's broadcast.

        Raises:
            InputError: `theta` does not fit the task, or is not finite. On a device robots whose parameters are not
                finite count as infeasible, since looking would wait for the device at every step.
        """
        C, d = self.task(measurement)
        if theta.shape[-1:] != C.shape[-1:]:
            raise InputError("theta", f"(*batch, {C.shape[-1]}): {self.task.parameter_names}", tuple(theta.shape))
        if on_host(theta) and not bool(theta.isfinite().all()):
            raise InputError("theta", "finite parameters", theta.detach())
        try:
            uhat = (C.to(torch.float64) @ theta.to(torch.float64).unsqueeze(-1)).squeeze(-1) + d
            uhat = uhat if self.task.saturation is None else self.task.saturation(uhat)
            feedback = feedback_of(self.task, measurement)
            uhat = uhat if feedback is None else uhat + feedback
        except RuntimeError as error:
            raise InputError("theta", f"a batch that fits {tuple(d.shape[:-1])}", tuple(theta.shape)) from error
        if is_joint(self.barriers) and getattr(measurement, neighbours_controls(self.barriers)) is None:
            return self._team_control(measurement, uhat)
        safe_controls = Halfspaces.stack([barrier(measurement) for barrier in self.barriers])
        return self._within_limits(_control(safe_controls, uhat), safe_controls)

    def _within_limits(self, control: Control, safe_controls: Halfspaces) -> Control:
        """The control within the disc of the speed limit, or with the least violation of rows that are relaxed."""
        limit, shape = min(getattr(barrier, "speed_limit", math.inf) for barrier in self.barriers), control.u.shape[:-1]
        if limit == math.inf:
            return control
        if safe_controls.dim != 2:
            raise InputError("barriers", "a speed box instead of a ball, for controllers in space", self.barriers)
        rows = Halfspaces(
            safe_controls.A.expand(*shape, -1, -1).reshape(-1, safe_controls.rows, 2),
            safe_controls.b.expand(*shape, -1).reshape(-1, safe_controls.rows),
        )
        u, uhat, active = control.u.reshape(-1, 2), control.nominal.reshape(-1, 2), control.active.flatten(0, -2)
        feasible = control.feasible.flatten()
        outside = (feasible & (u.norm(dim=-1) > limit)).nonzero().flatten()
        if len(outside):
            of_circle, on, found = nearest_in_disc(rows.select(outside), uhat[outside], limit)
            u, active = u.index_put((outside,), of_circle), active.index_put((outside,), on)
            feasible = feasible.index_put((outside,), found)
        relaxed = (~feasible & rows.A.isfinite().flatten(1).all(-1) & rows.b.isfinite().all(-1)).nonzero().flatten()
        u = torch.where(feasible.unsqueeze(-1), u, 0.0)
        if len(relaxed) and any(getattr(barrier, "relaxes", False) for barrier in self.barriers):
            best, decide = least_violation(rows.select(relaxed), limit)
            u, active = u.index_put((relaxed,), best), active.index_put((relaxed,), decide)
        return Control(u.reshape(*shape, 2), control.nominal, active.reshape(*shape, -1), feasible.reshape(shape))

    def _team_control(self, measurement: Measurement, uhat: Tensor) -> Control:
        """One QP for all controls of a team. It holds the row a.u_i - a.u_j <= b of a pair (i, j) for i and for j."""
        if any(hasattr(barrier, "speed_limit") for barrier in self.barriers):
            raise InputError("barriers", "a speed polygon or box instead of a disc, for a joint QP", self.barriers)
        if uhat.ndim < 2 or uhat.shape != measurement.x.shape:
            raise InputError("measurement, theta", "teams (*teams, robots, n), for a joint QP", tuple(uhat.shape))
        if bool(measurement.present.diagonal(dim1=-2, dim2=-1).any()):
            raise InputError("measurement", "robot i to be the body in slot i, for a joint QP", "another order")
        robots, n = uhat.shape[-2:]
        still = replace(measurement, **{neighbours_controls(self.barriers): torch.zeros_like(measurement.bodies)})
        parts = [barrier(still) for barrier in self.barriers]
        own = torch.eye(robots, dtype=torch.float64, device=uhat.device).unsqueeze(1)
        blocks, pair_columns, column = [], [], 0
        for barrier, part in zip(self.barriers, parts, strict=True):
            share = own.expand(robots, part.rows, robots)
            if is_joint([barrier]):
                share = share - torch.eye(part.rows, robots, dtype=torch.float64, device=uhat.device)
                pair_columns.append(slice(column, column + robots))
            blocks.append((share.unsqueeze(-1) * part.A.unsqueeze(-2)).flatten(-2))
            column += part.rows
        rows = torch.cat(blocks, dim=-2).flatten(-3, -2)
        joint = Halfspaces(rows, torch.cat([part.b for part in parts], dim=-1).flatten(-2))
        if measurement.observed is not None:  # an empty slot must not stop the team
            joint = joint.where(measurement.observed.repeat_interleave(column, dim=-1))
        control = _control(joint, uhat.flatten(-2))
        active = control.active.unflatten(-1, (robots, column)).clone()
        for columns in pair_columns:
            of_pairs = active[..., columns]
            active[..., columns] = of_pairs | of_pairs.mT
        feasible = control.feasible.unsqueeze(-1).expand(uhat.shape[:-1])
        return Control(control.u.unflatten(-1, (robots, n)), uhat, active, feasible)


def _control(safe_controls: Halfspaces, uhat: Tensor) -> Control:
    u, active, _, feasible = solve_safe_qp(safe_controls, uhat)
    return Control(u, uhat.expand(u.shape), active, feasible)
