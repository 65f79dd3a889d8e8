"""A run of a scene: one robot among obstacles, or a team."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import torch

from experiments.kinds import Track
from experiments.results import write_rows
from experiments.runs.batch import Batch
from experiments.runs.config import SceneConfig
from experiments.runs.errors import measure
from experiments.runs.observe import Recording, observe
from experiments.runs.saved import Results
from experiments.runs.summary import summarise_scene
from torchfsid.robots.simulation import Trajectory


def run_scene(config: SceneConfig, out: Path, track: Track) -> dict[str, Any]:
    """Simulate, observe, and return the summary."""
    scene = simulate_scene(config)
    write_trajectory(out / "trajectory.csv", config.bodies, scene.measured)
    observed = observe(config, scene.recording, out, track)
    return summarise_scene(config, Results(out, config), observed, scene.true)


class SimulatedScene(NamedTuple):
    """A scene that was run: its true trajectory, the one measured with errors, and the recording of its robots."""

    true: Trajectory
    measured: Trajectory
    recording: Recording


def simulate_scene(config: SceneConfig) -> SimulatedScene:
    """Run the scene's robots from rest in closed loop, and measure them with the configured errors."""
    batch = Batch([config])
    model, measured = batch.model(batch.team), measure(batch).team(0)
    recording = Recording(
        robots=[robot.name for robot in config.robots],
        goals=batch.goals,
        task=model.task,
        barriers=model.barriers,
        labels=[label for barrier in model.barriers for label in barrier.labels(config.bodies)],
        measurements=measured.measurements(),
        samples=len(measured.t),
    )
    return SimulatedScene(batch.true.team(0), measured, recording)


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
