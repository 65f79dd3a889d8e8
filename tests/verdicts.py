"""A log of three robots that cross, its model, and a terminal to show verdicts in."""

import io
from pathlib import Path

import torch
from rich.console import Console

from tests.logs import bounded_errors, write_log
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.config.documents import validate
from torchfsid.config.observe import ObserveConfig
from torchfsid.logs.log import Log
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask

GOALS = {"ann": [2.0, 0.1], "bob": [-2.0, 0.0], "turtlebot_3": [0.0, 2.0]}
AVOIDANCE = {"kind": "avoidance", "safety_distance": 0.5, "class_k": {"gain": 1.5}, "neighbour_velocity": "current"}
RIGHT = {
    "task": {"kind": "goal", "gain": 0.9},
    "barriers": [AVOIDANCE],
    "prior": {"lower": [-5, -5], "upper": [5, 5]},
    "noise": {"velocity": 0.02},
    "ukf": False,
}


def crossing(folder: Path, task: GoalTask, t0: float = 0.0) -> Path:
    """The log of three robots that cross, by one QP over all of them, with errors of 0.01 m/s."""
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3], [0.1, -2.0]], dtype=torch.float64)
    goals = torch.tensor(list(GOALS.values()), dtype=torch.float64)
    avoidance = CollisionAvoidance(ClassK(1.5), safety_distance=0.5, neighbour_velocity="current")
    run = simulate(CbfQpController(task, [avoidance]), goals, start, dt=0.15, steps=32)
    run.t[:] += t0
    return write_log(folder / "log.csv", run, list(GOALS), bounded_errors(run, 3, 0.01, 0))


def declared(log: Log, **changes: object) -> DeclaredLog:
    return DeclaredLog(validate({**RIGHT, **changes}, ObserveConfig, "test"), log)


def console(width: int) -> Console:
    return Console(file=io.StringIO(), width=width)


def said(shown: Console) -> str:
    assert isinstance(shown.file, io.StringIO)
    return shown.file.getvalue()
