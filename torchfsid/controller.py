r"""What a robot does: the safety QP, and the control as a differentiable function of everything it depends on.

    u* = argmin |u - uhat|^2  s.t.  A u <= b,      uhat = C theta + d                       (G., Eq. (5))
    uhat - u* = 1/2 sum_j mu_j a_j,   mu_j >= 0,   mu_j (a_j.u* - b_j) = 0                  (G., Eqs. (7)-(10))

daqp finds the rows with positive multipliers, without gradients. The control is then recomputed from these rows alone,
u* = (I - P) uhat + A_a^+ b_a: the same number to round-off, and differentiable in theta, positions, gains and distances
wherever the active set does not switch; at a switch the derivative is that of one side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import daqp
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.barriers import Barrier, is_joint
from torchfsid.errors import InputError, SolverError
from torchfsid.halfspaces import Halfspaces
from torchfsid.kkt import solve_kkt
from torchfsid.measurement import Measurement
from torchfsid.tasks import Task

OPTIMAL, INFEASIBLE = 1, -1
"""Exit flags of daqp; all others are failures of the solver."""

DAQP_TOLERANCES = {"primal_tol": 1e-12, "zero_tol": 1e-14, "sing_tol": 1e-14}
"""Relative to the speeds of the problem. `sing_tol` is the square of the angle [rad] below which daqp takes rows for
parallel: its default calls every wedge thinner than 6e-6 rad infeasible. This one is 1e-7 rad, like
`kkt.RANK_TOLERANCE`, so that the rows daqp tells apart are apart for `solve_kkt` too."""


class QpSolution(NamedTuple):
    """The solution of a batch of safety QPs.

    Attributes:
        u: the controls [m/s]; zero where infeasible.
        active: rows with a positive multiplier; at most n of them, so one of two equal rows, two of three at a vertex.
        multipliers: mu_j >= 0 with uhat - u = 1/2 sum_j mu_j a_j, for the rows a_j as they were given.
        feasible: some control satisfies the rows.
    """

    u: Float[Tensor, "*batch n"]
    active: Bool[Tensor, "*batch m"]
    multipliers: Float[Tensor, "*batch m"]
    feasible: Bool[Tensor, "*batch"]


@torch.no_grad()
def solve_safe_qp(safe_controls: Halfspaces, uhat: Float[Tensor, "*batch n"]) -> QpSolution:
    """The control closest to `uhat` among the safe ones, by daqp, without gradients. Batches broadcast.

    An item whose rows or nominal control are not finite (two bodies at one place, say) counts as infeasible.

    Raises:
        InputError: `uhat` has another dimension than the rows.
        SolverError: daqp ended in any other way than optimal or infeasible.
    """
    m, n = safe_controls.rows, safe_controls.dim
    if uhat.shape[-1:] != (n,):
        raise InputError("uhat", f"(*batch, {n})", tuple(uhat.shape))
    batch = torch.broadcast_shapes(safe_controls.batch_shape, uhat.shape[:-1])
    unit = safe_controls.normalised()
    A = _items(unit.A, batch, (m, n))
    b = _items(unit.b, batch, (m,))
    norms = _items(safe_controls.norms(), batch, (m,))
    nominal = _items(uhat, batch, (n,))

    is_row = (A != 0).any(-1)
    finite = np.isfinite(A).all((-1, -2)) & np.isfinite(b).all(-1) & np.isfinite(nominal).all(-1)
    feasible = finite & ~(~is_row & (b < 0)).any(-1)
    with np.errstate(invalid="ignore"):
        violation = ((A @ nominal[..., None])[..., 0] - b).max(-1, initial=0.0)

    u = np.where(feasible[:, None], nominal, 0.0)
    multipliers = np.zeros_like(b)
    for item in np.flatnonzero(feasible & (violation > 0)):
        rows = is_row[item]
        # In units of the speeds at hand, so that daqp's absolute tolerances are relative ones.
        speed = max(np.abs(nominal[item]).max(), violation[item])
        solution, _, flag, info = daqp.solve(
            np.eye(n), -nominal[item] / speed, A[item][rows], b[item][rows] / speed, **DAQP_TOLERANCES
        )
        if flag not in (OPTIMAL, INFEASIBLE):
            raise SolverError(f"daqp stopped with exit flag {flag}, neither optimal nor infeasible, at item {item}")
        feasible[item] = flag == OPTIMAL
        u[item] = solution * speed if flag == OPTIMAL else 0.0
        if flag == OPTIMAL:
            multipliers[item, rows] = 2 * speed * info["lam"].clip(min=0) / norms[item, rows]

    def shaped(items: np.ndarray) -> Tensor:
        return torch.from_numpy(items).to(uhat.device).reshape((*batch, *items.shape[1:]))

    mu = shaped(multipliers)
    return QpSolution(shaped(u), mu > 0, mu, shaped(feasible))


def _items(values: Tensor, batch: torch.Size, shape: tuple[int, ...]) -> np.ndarray:
    """One item per leading index, for the loop over a batch."""
    values = values.to("cpu", torch.float64).expand(*batch, *shape)
    return values.reshape(batch.numel(), *shape).numpy()


@dataclass(frozen=True)
class Control:
    """What the robots do, and why.

    Attributes:
        u: the control [m/s]; zero where infeasible.
        nominal: uhat, what the task alone would do [m/s].
        active: rows with a positive multiplier (see `QpSolution`).
        feasible: some control satisfies the rows.
    """

    u: Float[Tensor, "*batch n"]
    nominal: Float[Tensor, "*batch n"]
    active: Bool[Tensor, "*batch m"]
    feasible: Bool[Tensor, "*batch"]


@dataclass(frozen=True)
class CbfQpController:
    """Do the task, as closely as the barriers allow: `controller(measurement, theta)`.

    If a barrier counts the neighbours' current velocities and the measurement does not hold them, nobody has decided
    yet: the batch is then a team whose robot i is the body in slot i, the other bodies stand still, and one QP decides
    for all of them (one infeasible robot then stops the team).

    Soft barriers are kept like the others: `soft` is what an observer may forgive.

    Raises `InputError` if there is no barrier.
    """

    task: Task
    barriers: Sequence[Barrier]

    def __post_init__(self) -> None:
        if len(self.barriers) == 0:
            raise InputError("barriers", "at least one barrier", self.barriers)

    def __call__(self, measurement: Measurement, theta: Float[Tensor, "*theta_batch p"]) -> Control:
        """The controls for the parameters `theta`; its batch and the measurement's broadcast.

        Raises:
            InputError: `theta` does not fit the task, or is not finite.
            SolverError: see `solve_safe_qp`.
        """
        C, d = self.task(measurement)
        if theta.shape[-1:] != C.shape[-1:]:
            raise InputError("theta", f"(*batch, {C.shape[-1]}): {self.task.parameter_names}", tuple(theta.shape))
        if not bool(theta.isfinite().all()):
            raise InputError("theta", "finite parameters", theta.detach())
        try:
            uhat = (C.to(torch.float64) @ theta.to(torch.float64).unsqueeze(-1)).squeeze(-1) + d
            uhat = uhat if self.task.saturation is None else self.task.saturation(uhat)
        except RuntimeError as error:
            raise InputError("theta", f"a batch that fits {tuple(d.shape[:-1])}", tuple(theta.shape)) from error
        if measurement.body_velocities is None and is_joint(self.barriers):
            return self._team_control(measurement, uhat)
        safe_controls = Halfspaces.stack([barrier(measurement) for barrier in self.barriers])
        return _control(safe_controls, uhat)

    def _team_control(self, measurement: Measurement, uhat: Tensor) -> Control:
        """One QP over the stacked controls. Row a.u_i - a.u_j <= b of the pair (i, j) stands in it for i and for j."""
        if uhat.ndim != 2 or uhat.shape != measurement.x.shape:
            raise InputError("measurement, theta", "one team (robots, n), for a joint QP", tuple(uhat.shape))
        if bool(measurement.present.diagonal().any()):
            raise InputError("measurement", "robot i to be the body in slot i, for a joint QP", "another order")
        robots, n = uhat.shape
        still = replace(measurement, body_velocities=torch.zeros_like(measurement.bodies))
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
        rows = torch.cat(blocks, dim=1).flatten(0, 1)
        joint = Halfspaces(rows, torch.cat([part.b for part in parts], dim=-1).flatten())
        control = _control(joint, uhat.flatten())
        active = control.active.reshape(robots, column).clone()
        for columns in pair_columns:
            of_pairs = active[:, columns]
            active[:, columns] = of_pairs | of_pairs.T
        return Control(control.u.reshape(robots, n), uhat, active, control.feasible.expand(robots))


def _control(safe_controls: Halfspaces, uhat: Tensor) -> Control:
    """daqp decides which rows are active, and the KKT conditions at these rows give the control."""
    batch = torch.broadcast_shapes(safe_controls.batch_shape, uhat.shape[:-1])
    uhat = uhat.expand(*batch, uhat.shape[-1])
    rows = Halfspaces(
        safe_controls.A.expand(*batch, *safe_controls.A.shape[-2:]),
        safe_controls.b.expand(*batch, safe_controls.rows),
    )
    _, active, _, feasible = solve_safe_qp(rows, uhat)
    # With no parameter, p = 0, and d = uhat, the offset f is the control itself.
    u = solve_kkt(rows, active, uhat.new_zeros(*uhat.shape, 0), uhat).f
    return Control(torch.where(feasible.unsqueeze(-1), u, 0.0), uhat, active, feasible)
