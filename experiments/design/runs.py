"""Runs of one robot among bodies with known paths: found once, by compiled code, and differentiated by it.

The code runs where the tensors are: on the CPU, or on a device with kernels.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchfsid import device
from torchfsid.halfspaces import array
from torchfsid.kernels.runs import return_to_path, run_to_goals
from torchfsid.robots.avoidance import CollisionAvoidance
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import GoalTask

Robot = tuple[float, float, tuple[float, bool, float, float]]
"""The numbers of a robot, see `kernels.runs.run_to_goals`."""


class Runs(NamedTuple):
    """T samples of the B = P x S robots that go to S goals among P groups of M bodies, without gradients.

    Attributes:
        goals: the goals [m].
        around: positions of the bodies [m].
        robot: the robot's numbers.
        x: positions [m].
        u: controls [m/s]; zero where infeasible.
        rows: the active rows, each that of one body.
        filled: the places of `rows` that hold an active row.
        feasible: whether the QP had a solution.
    """

    goals: Float[Tensor, "S 2"]
    around: Float[Tensor, "P T M 2"]
    robot: Robot
    x: Float[Tensor, "B T 2"]
    u: Float[Tensor, "B T 2"]
    rows: Int[Tensor, "B T 2"]
    filled: Bool[Tensor, "B T 2"]
    feasible: Bool[Tensor, "B T"]

    @property
    def bodies(self) -> Float[Tensor, "B T M 2"]:
        """The positions of the bodies around each robot [m]."""
        return self.around.repeat_interleave(len(self.goals), dim=0)

    def measurement(self) -> Measurement:
        """All samples as one measurement, robot by robot."""
        bodies, (_, dt, _) = self.bodies, self.robot
        time = dt * torch.arange(self.x.shape[1], dtype=torch.float64, device=self.x.device)
        return Measurement(
            t=time.repeat(len(self.x)),
            x=self.x.flatten(0, 1),
            u=self.u.flatten(0, 1),
            bodies=bodies.flatten(0, 1),
            present=torch.ones(bodies.shape[:3], dtype=torch.bool, device=bodies.device).flatten(0, 1),
        )

    def along(self, path: Float[Tensor, "P T 2"]) -> tuple[Float[Tensor, "B T 2"], Float[Tensor, "B T 2"]]:
        """Positions and controls with their derivatives with respect to the path of the last body."""
        return _Along.apply(path, self)  # type: ignore[return-value]


def run(
    task: GoalTask,
    avoidance: CollisionAvoidance,
    start: Float[Tensor, "2"],
    goals: Float[Tensor, "S 2"],
    bodies: Float[Tensor, "P T M 2"],
    dt: float,
) -> Runs:
    """Run the robot from `start` among every one of the P groups of bodies to every goal: P x S items."""
    class_k, distance = avoidance.class_k, avoidance.safety_distance
    assert distance is not None
    keeping = float(distance), avoidance.distance == "squared", float(class_k.gain), float(class_k.power)
    robot: Robot = float(task.gain), dt, keeping
    shape = len(goals) * len(bodies), bodies.shape[1]
    if device.has_kernels(start, goals, bodies):
        kinds = torch.float64, torch.float64, torch.long, torch.bool
        x, u, rows, filled = (device.empty((*shape, 2), start, kind) for kind in kinds)
        feasible = device.empty(shape, start, torch.bool)
        device.launch("runs.run_to_goals", ((start, goals, bodies),), robot, ((x, u, rows, filled, feasible),))
    else:
        found = run_to_goals(*map(array, (start, goals, bodies)), robot)
        x, u, rows, filled, feasible = map(torch.from_numpy, found)
    return Runs(goals, bodies, robot, x, u, rows, filled, feasible)


class _Along(torch.autograd.Function):
    """(the path of the last body, the runs) -> x and u as functions of the path."""

    @staticmethod
    def forward(ctx: Any, path: Tensor, runs: Runs) -> tuple[Tensor, Tensor]:
        ctx.runs = runs
        return runs.x.clone(), runs.u.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_x: Tensor, grad_u: Tensor) -> tuple[Tensor, None]:
        goals, bodies, robot, *of_run = ctx.runs
        if device.has_kernels(grad_x, grad_u, *of_run):
            grad = device.empty(grad_x.shape, grad_x)
            device.launch("runs.return_to_path", ((goals, bodies), of_run, (grad_x, grad_u)), robot, ((grad,),))
        else:
            run = tuple(map(array, of_run))
            grad = torch.from_numpy(
                return_to_path(array(goals), array(bodies), robot, run, array(grad_x), array(grad_u))
            )
        return grad.unflatten(0, (len(bodies), len(goals))).sum(1), None
