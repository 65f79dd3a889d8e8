"""A run of a scene: one robot among obstacles, or a team."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from experiments.kinds import Track
from experiments.results import write_rows
from experiments.runs.config import SceneConfig
from experiments.runs.observe import observe
from experiments.runs.recording import simulate_scene
from experiments.runs.saved import Results
from experiments.runs.summary import summarise_scene
from torchfsid.robots.simulation import Trajectory


def run_scene(config: SceneConfig, out: Path, track: Track) -> dict[str, Any]:
    """Simulate, observe, and return the summary."""
    scene = simulate_scene(config)
    write_trajectory(out / "trajectory.csv", config.bodies, scene.measured)
    observers, tally = observe(config, scene.recording, out, track)
    return summarise_scene(config, Results(out, config), observers, tally, scene.true)


def write_trajectory(path: Path, bodies: list[str], measured: Trajectory) -> None:
    """Write the measured trajectory with all digits, so that an observer of the log sees the same numbers."""
    axes = "xyz"[: measured.x.shape[-1]]
    columns, names = [measured.x], [*axes, *(f"v{axis}" for axis in axes)]
    if measured.velocity is not None:
        columns, names = [*columns, measured.velocity], [*names, *(f"a{axis}" for axis in axes)]
    columns.append(measured.u)
    if measured.radius is not None:
        columns, names = [*columns, measured.radius.expand(measured.x.shape[:-1]).unsqueeze(-1)], [*names, "radius"]
    numbers = torch.cat(columns, dim=-1).tolist()
    write_rows(
        path,
        (
            {"t": t, "robot": body, **dict(zip(names, of_body, strict=True))}
            for t, of_bodies in zip(measured.t.tolist(), numbers, strict=True)
            for body, of_body in zip(bodies, of_bodies, strict=True)
        ),
    )
