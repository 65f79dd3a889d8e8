"""Logs and configurations written to files, for what reads them."""

import csv
from collections.abc import Sequence
from pathlib import Path

import torch
import yaml
from torch import Tensor

from torchfsid.robots.simulation import Trajectory


def write_log(path: Path, run: Trajectory, bodies: Sequence[str], errors: Tensor | None = None) -> Path:
    """A run as CSV, with its radii if it has any, and errors (samples, bodies, 2) added to its controls."""
    u = run.u if errors is None else run.u + errors
    columns = {"x": run.x, "v": u} if run.velocity is None else {"x": run.x, "v": run.velocity, "a": u}
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        radius = [[] for _ in bodies] if run.radius is None else run.radius.unsqueeze(-1).tolist()
        axes = "xyz"[: run.x.shape[-1]]
        names = ["t", "robot", *(f"{of}{axis}" for of in ("", "v", "a")[: len(columns)] for axis in axes)]
        writer.writerow([*names, *(["radius"] if run.radius is not None else [])])
        for k, t in enumerate(run.t.tolist()):
            for j, body in enumerate(bodies):
                writer.writerow(
                    [t, body, *(value for of in columns.values() for value in of[k, j].tolist()), *radius[j]]
                )
    return path


def write_config(path: Path, config: dict) -> Path:
    path.write_text(yaml.safe_dump(config))
    return path


def bounded_errors(run: Trajectory, robots: int, size: float, seed: int) -> Tensor:
    """Errors of length `size` in random directions for the robots, none for the obstacles."""
    generator = torch.Generator().manual_seed(seed)
    turn = 2 * torch.pi * torch.rand(run.u.shape[:2], generator=generator, dtype=torch.float64)
    errors = size * torch.stack([turn.cos(), turn.sin()], dim=-1)
    errors[:, robots:] = 0.0
    return errors
