r"""Runs of one robot among bodies with known paths: found once, without gradients, and then differentiated.

Compiled code finds the positions x_t, the controls u_t and their active rows. Given these rows, u_t is a formula of x_t
and of the probe's position q_t. So all samples are one batch of one graph, and two vector-Jacobian products give all
J_t = du_t/dx_t and K_t = du_t/dq_t. Let g_t and l_t be the derivatives of a loss with respect to u_t and x_t, with all
that follows from these. Then from the last sample to the first

    g_t = dL/du_t + dt l_(t+1),      l_t = dL/dx_t + l_(t+1) + J_t' g_t,      dL/dq_t = K_t' g_t.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from experiments.design.config import DesignConfig
from torchfsid.halfspaces import array, dot
from torchfsid.kernels.runs import run_to_goals
from torchfsid.programmes.differentiable import times
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.sets.derivatives import solution


class Runs(NamedTuple):
    """T samples of B robots among M bodies, without gradients.

    Attributes:
        x: positions [m].
        u: controls [m/s]; zero where infeasible.
        bodies: positions of the bodies [m].
        rows: the active rows, each that of one body.
        filled: the places of `rows` that hold an active row.
        feasible: whether the QP had a solution.
    """

    x: Float[Tensor, "T B 2"]
    u: Float[Tensor, "T B 2"]
    bodies: Float[Tensor, "T B M 2"]
    rows: Int[Tensor, "T B 2"]
    filled: Bool[Tensor, "T B 2"]
    feasible: Bool[Tensor, "T B"]

    def measurement(self, dt: float) -> Measurement:
        """All samples as one measurement, in the order of time."""
        (T, B, M, _), time = self.bodies.shape, dt * torch.arange(len(self.x), dtype=torch.float64)
        return Measurement(
            t=time.repeat_interleave(B),
            x=self.x.flatten(0, 1),
            u=self.u.flatten(0, 1),
            bodies=self.bodies.flatten(0, 1),
            present=torch.ones(T * B, M, dtype=torch.bool),
        )


def run(
    config: DesignConfig, start: Float[Tensor, "2"], goals: Float[Tensor, "S 2"], bodies: Float[Tensor, "T P M 2"]
) -> Runs:
    """Run the robot from `start` among every one of the P groups of bodies to every goal: P x S items."""
    avoidance, class_k = config.avoidance, config.avoidance.class_k
    x, u, rows, filled, feasible = map(
        torch.from_numpy,
        run_to_goals(
            *map(array, (start, goals, bodies)), config.gain,
            config.safety_distance, avoidance.distance == "squared", class_k.gain, class_k.power, config.dt,
        ),
    )  # fmt: skip
    return Runs(x, u, bodies.repeat_interleave(len(goals), dim=1), rows, filled, feasible)


def follow(
    controller: CbfQpController,
    theta: Float[Tensor, "B 2"],
    runs: Runs,
    probe: Float[Tensor, "T B 2"],
    needed: Bool[Tensor, "T B"],
    dt: float,
) -> tuple[Float[Tensor, "T B 2"], Float[Tensor, "T B 2"]]:
    """Positions and controls of the runs as functions of the probe's path, up to the last sample that is `needed`.

    Args:
        controller: the robot's controller.
        theta: the goals [m].
        runs: the runs. The probe is their last body.
        probe: the probe's path [m], with gradients.
        needed: the samples whose positions and controls are used.
        dt: time between samples [s].
    """
    used = needed.flip(0).cummax(0).values.flip(0) & runs.feasible
    du_dx, du_dq = probe.new_zeros(*used.shape, 2, 2), probe.new_zeros(*used.shape, 2, 2)
    du_dx[used], du_dq[used] = _jacobians(controller, theta.expand_as(runs.x)[used], runs, used)
    return _Run.apply(probe, runs.x, runs.u, du_dx, du_dq, dt)  # type: ignore[return-value]


def _jacobians(
    controller: CbfQpController, theta: Float[Tensor, "N 2"], runs: Runs, used: Bool[Tensor, "T B"]
) -> tuple[Float[Tensor, "N 2 2"], Float[Tensor, "N 2 2"]]:
    """The derivatives of u with respect to x and to the last body, for the samples `used`."""
    rows, filled, bodies = runs.rows[used], runs.filled[used], runs.bodies[used]
    x, near = runs.x[used].requires_grad_(), bodies.gather(1, rows.unsqueeze(-1).expand(-1, -1, 2)).requires_grad_()
    with torch.enable_grad():
        seen = Measurement(t=0.0, x=x, u=None, bodies=near, present=filled)
        (safe_controls,), (C, d) = (barrier(seen) for barrier in controller.barriers), controller.task(seen)
        uhat = times(C, theta) + d
        # Two equations M u = right: an active row each, or no motion across them.
        first, second = safe_controls.A.unbind(1)
        along = torch.stack([-first[:, 1], first[:, 0]], dim=-1)
        one, two = filled.unbind(-1)
        M = torch.stack([first, torch.where(two.unsqueeze(-1), second, along)], dim=1)
        M = torch.where(one[:, None, None], M, torch.eye(2, dtype=M.dtype))
        right = torch.where(filled, safe_controls.b, dot(M, uhat.unsqueeze(-2)))
        u = solution(runs.u[used], M, right, torch.ones_like(one))
        parts = [torch.autograd.grad(part.sum(), (x, near), retain_graph=True) for part in u.unbind(-1)]
    by_x, by_near = (torch.stack(part, dim=1) for part in zip(*parts, strict=True))
    is_probe = filled & (rows == bodies.shape[1] - 1)
    first, second = torch.where(is_probe[:, None, :, None], by_near, 0.0).unbind(2)
    return by_x, first + second


class _Run(torch.autograd.Function):
    """(probe, x and u as numbers, du/dx, du/dq, dt) -> x and u as functions of the probe's path."""

    @staticmethod
    def forward(
        ctx: Any, probe: Tensor, x: Tensor, u: Tensor, du_dx: Tensor, du_dq: Tensor, dt: float
    ) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(du_dx, du_dq)
        ctx.dt = dt
        return x.clone(), u.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_x: Tensor, grad_u: Tensor) -> tuple[Tensor | None, ...]:
        du_dx, du_dq = ctx.saved_tensors
        later, grads = torch.zeros_like(grad_x[0]), []
        for J, of_x, of_u in zip(du_dx.flip(0), grad_x.flip(0), grad_u.flip(0), strict=True):
            of_u = of_u + ctx.dt * later
            later = later + of_x + _times(of_u, J)
            grads.append(of_u)
        return _times(torch.stack(grads).flip(0), du_dq), None, None, None, None, None


def _times(v: Float[Tensor, "*B 2"], M: Float[Tensor, "*B 2 2"]) -> Float[Tensor, "*B 2"]:
    return dot(v.unsqueeze(-2), M.mT)
