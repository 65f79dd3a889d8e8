"""The log of the examples, crossing.csv: four robots and a pillar, simulated with the seed below. Run it to remake it.

The robots go to goals with the gain 0.8 /s, keep 0.5 m from every body by one QP for the team, and drive at most
0.8 m/s along each axis. Every logged velocity is wrong by up to 4 mm/s in a random direction.
"""

from __future__ import annotations

import csv
from pathlib import Path

import torch

import torchfsid as fsid

SEED = 7
NAMES = ("r1", "r2", "r3", "r4", "pillar")
STARTS = torch.tensor([[-2.0, -0.4], [2.0, 0.1], [0.5, -2.0], [-0.6, 2.0]])
GOALS = torch.tensor([[1.8, 0.5], [-1.9, -0.3], [0.1, 1.7], [-0.2, -1.8]])
PILLAR = torch.tensor([[1.2, -0.6]])
TASK = fsid.GoalTask(gain=0.8)
BARRIERS = [
    fsid.CollisionAvoidance(fsid.ClassK(2.0), safety_distance=0.5, neighbour_velocity="current"),
    fsid.SpeedBox((0.8, 0.8)),
]


def main() -> None:
    run = fsid.simulate(fsid.CbfQpController(TASK, BARRIERS), GOALS, STARTS, obstacles=PILLAR, dt=0.05, steps=120)
    angle, share = torch.rand(2, *run.u.shape[:2], generator=torch.Generator().manual_seed(SEED))
    error = 0.004 * share.sqrt()[..., None] * torch.stack(((6.2832 * angle).cos(), (6.2832 * angle).sin()), dim=-1)
    error[:, NAMES.index("pillar")] = 0
    with Path(__file__).with_name("crossing.csv").open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["t", "robot", "x", "y", "vx", "vy"])
        for t, positions, velocities in zip(run.t, run.x, run.u + error, strict=True):
            for name, (x, y), (vx, vy) in zip(NAMES, positions.tolist(), velocities.tolist(), strict=True):
                table.writerow([f"{float(t):.2f}", name, *(f"{value:.6f}" for value in (x, y, vx, vy))])


if __name__ == "__main__":
    main()
