"""Robots that change their minds half-way, as their observer's user sees it."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from tests.logs import bounded_errors, write_log
from torchfsid.cli import main
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask

CONFIG = Path(__file__).parent.parent / "configs" / "goal_switch.yaml"
DT, SWITCH = 0.05, 40


def test_a_change_of_goal_is_reported_within_two_samples(tmp_path: Path) -> None:
    controller = CbfQpController(GoalTask(0.9), [CollisionAvoidance(ClassK(1.5), safety_distance=0.5)])
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3]], dtype=torch.float64)
    goals = torch.tensor([[[2.0, 0.1], [-2.0, 0.0]], [[0.5, -2.5], [-1.0, 2.5]]], dtype=torch.float64)
    before = simulate(controller, goals[0], start, dt=DT, steps=SWITCH - 1)
    after = simulate(controller, goals[1], before.x[-1] + DT * before.u[-1], dt=DT, steps=60)
    names = "x", "u", "nominal", "active", "feasible"
    run = Trajectory(
        DT * torch.arange(SWITCH + 61, dtype=torch.float64),
        *(torch.cat([getattr(before, name), getattr(after, name)]) for name in names),
    )
    log = write_log(tmp_path / "log.csv", run, ["ann", "bob"], bounded_errors(run, 2, 0.01, seed=1))
    assert main(["observe", str(log), "--config", str(CONFIG), "--out", str(tmp_path / "out")]) == 0
    regions = json.loads((tmp_path / "out" / "regions.json").read_text())["robots"]
    for robot, goal in zip(("ann", "bob"), goals[1].tolist(), strict=True):
        region = regions[robot]
        assert region["status"] == "ok"
        resets = [event["t"] for event in region["events"] if event["reset"]]
        assert len(resets) == 1
        assert 0 <= round(resets[0] / DT) - SWITCH <= 2
        assert all(
            sum(a * x for a, x in zip(row, goal, strict=True)) <= b + 1e-9
            for row, b in zip(region["A"], region["b"], strict=True)
        )
        assert region["diameter"] <= 2.1 * 0.01 / 0.9
