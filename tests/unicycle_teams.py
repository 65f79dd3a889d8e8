"""Teams of unicycles that follow the commands of a joint QP, as the Robotarium's simulators drive them, robot by robot.

`MAPS` transcribes the maps of rps: of version 2, of version 1 (`scaled`, the angle of the scaled command; `clipped`, a
limit of the turn rate), and those with which robots may drive backwards.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import SpeedPolygon
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import GoalTask, Saturation

DT, WHEEL_RADIUS, WHEEL_BASE, WHEEL_RATE, AHEAD = 0.05, 0.016, 0.11, 12.5, 0.05
Map = Callable[[float, float, float], tuple[float, float]]


def wrapped(angle: float) -> float:
    return math.atan2(math.sin(angle), math.cos(angle))


def plain(gain: float, limit: float = math.pi, scaled: bool = False) -> Map:
    def of(ux: float, uy: float, theta: float) -> tuple[float, float]:
        ahead, left = ux * math.cos(theta) + uy * math.sin(theta), uy * math.cos(theta) - ux * math.sin(theta)
        return gain * ahead, limit * math.atan2(left, gain * ahead if scaled else ahead) / (math.pi / 2)

    return of


def backwards(gain: float) -> Map:
    def of(ux: float, uy: float, theta: float) -> tuple[float, float]:
        forward = abs(wrapped(math.atan2(uy, ux) - theta)) < math.pi / 2
        h = theta if forward else wrapped(theta + math.pi)
        v = gain * (ux * math.cos(h) + uy * math.sin(h))
        return (v if forward else -v), math.pi * math.atan2(uy * math.cos(h) - ux * math.sin(h), v) / (math.pi / 2)

    return of


def ahead(limit: float = math.inf) -> Map:
    def of(ux: float, uy: float, theta: float) -> tuple[float, float]:
        w = (uy * math.cos(theta) - ux * math.sin(theta)) / AHEAD
        return ux * math.cos(theta) + uy * math.sin(theta), max(-limit, min(limit, w))

    return of


SI, LOOK = {"kind": "unicycle", "map": "si_to_uni"}, {"kind": "unicycle", "map": "look_ahead", "distance": AHEAD}
MAPS: dict[str, tuple[Map, dict]] = {
    "plain": (plain(1.0), SI),
    "gain": (plain(0.8, 2.0), {**SI, "linear_gain": 0.8, "angular_limit": 2.0}),
    "scaled": (plain(0.8, scaled=True), {**SI, "linear_gain": 0.8, "scaled_angle": True}),
    "backwards": (backwards(0.8), {**SI, "linear_gain": 0.8, "scaled_angle": True}),
    "ahead": (ahead(), LOOK),
    "clipped": (ahead(math.pi), {**LOOK, "angular_limit": math.pi}),
}
WHEELS = {"wheel_limit": WHEEL_RADIUS * WHEEL_RATE, "wheel_base": WHEEL_BASE}
MODEL = {
    "task": {"kind": "goal", "gain": 0.8, "saturation": {"kind": "norm", "limit": 0.15}},
    "barriers": [
        {
            "kind": "avoidance",
            "distance": "squared",
            "safety_distance": 0.15,
            "class_k": {"gain": 100.0, "power": 3},
            "neighbour_velocity": "current",
        },
        {"kind": "speed_polygon", "sides": 8, "limit": 0.2},
    ],
    "prior": {"lower": [-1.2, -1.2], "upper": [1.2, 1.2]},
    "ukf": False,
}


@dataclass(frozen=True)
class Run:
    """T poses [m, m, rad] of N robots, their commands [m/s], the goals [m], and where a limit changed (v, w)."""

    poses: Tensor
    u: Tensor
    goals: Tensor
    limited: Tensor

    @property
    def t(self) -> list[float]:
        return [round(DT * k, 6) for k in range(len(self.poses))]


@cache
def driven(kind: str, seed: int, arcs: bool = False, wheels: bool = True, steps: int = 240) -> Run:
    """Four robots that cross a square, from random headings."""
    generator = torch.Generator().manual_seed(seed)
    corners = torch.tensor([[0.5, 0.0], [-0.5, 0.05], [0.0, 0.5], [0.05, -0.5]], dtype=torch.float64)
    start = corners + 0.05 * torch.randn(4, 2, generator=generator, dtype=torch.float64)
    goals = -corners + 0.05 * torch.randn(4, 2, generator=generator, dtype=torch.float64)
    theta = 2 * math.pi * torch.rand(4, generator=generator, dtype=torch.float64) - math.pi
    poses = torch.cat([start, theta.unsqueeze(-1)], dim=-1)
    avoidance = CollisionAvoidance(ClassK(100.0, 3), 0.15, neighbour_velocity="current")
    controller = CbfQpController(
        GoalTask(0.8, saturation=Saturation("norm", (0.15, 0.15))), [avoidance, SpeedPolygon(8, 0.2)]
    )
    of, shift, found, commands, limits = MAPS[kind][0], AHEAD if kind in ("ahead", "clipped") else 0.0, [], [], []
    for k in range(steps):
        e = torch.stack([poses[:, 2].cos(), poses[:, 2].sin()], dim=-1)
        u = controller(Measurement.of_team(k * DT, poses[:, :2] + shift * e), goals).u
        found.append(poses)
        commands.append(u)
        moved, limited = [], []
        for (x, y, angle), (ux, uy) in zip(poses.tolist(), u.tolist(), strict=True):
            v, w = of(ux, uy, angle)
            rates = [(2 * v + side * WHEEL_BASE * w) / (2 * WHEEL_RADIUS) for side in (-1, 1)]
            if wheels:
                rates = [max(-WHEEL_RATE, min(WHEEL_RATE, rate)) for rate in rates]
            v_now, w_now = WHEEL_RADIUS / 2 * sum(rates), WHEEL_RADIUS / WHEEL_BASE * (rates[1] - rates[0])
            across = (uy * math.cos(angle) - ux * math.sin(angle)) / AHEAD
            limited.append(max(abs(v - v_now), abs(w - w_now)) > 1e-9 or (kind == "clipped" and abs(across - w) > 1e-9))
            if arcs:
                turn = w_now * DT / 2
                chord = v_now * DT * (math.sin(turn) / turn if turn else 1.0)
                step = chord * math.cos(angle + turn), chord * math.sin(angle + turn)
            else:
                step = v_now * DT * math.cos(angle), v_now * DT * math.sin(angle)
            moved.append([x + step[0], y + step[1], wrapped(angle + w_now * DT)])
        poses = torch.tensor(moved, dtype=torch.float64)
        limits.append(limited)
    return Run(torch.stack(found), torch.stack(commands), goals, torch.tensor(limits))


def write_poses(path: Path, t: list[float], poses: Tensor, heading: str = "theta", digits: int | None = None) -> Path:
    """The poses as a CSV log of the robots r0, r1, ... Headings that are NaN are left empty."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "robot", "x", "y", heading])
        for time, of_robots in zip(t, poses.tolist(), strict=True):
            for j, pose in enumerate(of_robots):
                cells = [value if digits is None else round(value, digits) for value in pose]
                writer.writerow([time, f"r{j}", *("" if math.isnan(value) else value for value in cells)])
    return path
