"""Random teams, and the errors with which they are measured."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
import torch

from experiments.kinds import load
from experiments.runs.config import SceneConfig
from experiments.runs.scene import simulate_scene
from experiments.sweeps.config import SweepConfig
from experiments.teams import TeamConfig
from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.sets.feasible_set import FeasibleSet

MONTE_CARLO = Path(__file__).parents[1] / "configs" / "monte_carlo.yaml"


@pytest.fixture(scope="module", autouse=True)
def _shapes_are_checked_elsewhere() -> Iterator[None]:
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def scene(shape: str, **noise: float) -> SceneConfig:
    """A short run of the Monte Carlo study."""
    errors = {"velocity": 0.02, "position": 0.01, **noise}
    sweep = load(MONTE_CARLO)
    assert isinstance(sweep, SweepConfig)
    drawn = sweep.scene(725).model_dump()
    bound = {"velocity": errors["velocity"] + 1e-9, "position": errors["position"], "neighbour_velocity": 0.02}
    changed = {"duration": 1.0, "measurement_noise": {**errors, "shape": shape}, "noise": bound}
    return SceneConfig.model_validate({**drawn, **changed})


@pytest.mark.parametrize("shape", ["uniform", "bias", "adversarial"])
def test_errors_keep_their_bounds_and_spare_obstacles(shape: str):
    config = scene(shape)
    measured, robots = simulate_scene(config), len(config.robots)
    assert len(config.obstacles) > 0
    for seen, true, bound in (
        (measured.measured.x, measured.true.x, 0.01),
        (measured.measured.u, measured.true.u, 0.02),
    ):
        error = (seen - true).norm(dim=-1)
        assert error[:, robots:].max() == 0
        assert error.max() <= bound * (1 + 1e-12)
        if shape == "uniform":
            assert error[:, :robots].std() > 0.1 * bound
        else:
            assert error[:, :robots].min() >= bound * (1 - 1e-12)
    x_error = (measured.measured.x - measured.true.x)[:, :robots]
    assert (x_error.std(0).max() < 1e-12) == (shape == "bias")


@pytest.mark.parametrize("noise", [{}, {"position": 0.0}, {"velocity": 0.0}])
def test_the_adversary_leaves_less_room_than_chance(noise: dict[str, float]):
    worst, chance = (room(scene(shape, **noise)) for shape in ("adversarial", "uniform"))
    assert worst.min() > -1e-12  # and yet the set is sound
    assert worst.median() < 0.2 * chance.median()


def room(config: SceneConfig) -> torch.Tensor:
    """Distance of each true goal to the nearest half-space of each sample, where there is one [m]."""
    recording = simulate_scene(config).recording
    prior = FeasibleSet.from_box(recording.goals - 9.0, recording.goals + 9.0)
    model = ObservationModel(recording.task, recording.barriers, noise=config.noise.build())
    said = [evidence(model, prior, seen).omega for seen in recording.measurements]
    rows = torch.stack([omega.slack(recording.goals).amin(-1) for omega in said])
    return rows[rows < 0.99]  # padding has a slack of 1


@pytest.mark.parametrize("place", ["circle", "disc"])
def test_teams_are_drawn_as_told(place: str):
    team = TeamConfig.model_validate(
        {"robots": [4, 10], "obstacles": [0, 3], "place": [place], "radius": 2.2, "separation": 0.7}
    )
    counts = set()
    for seed in range(60):
        drawn = team.draw(np.random.default_rng(seed))
        assert drawn == team.draw(np.random.default_rng(seed))
        standing = [body["position"] for body in drawn["obstacles"]]
        starts, goals = ([robot[key] for robot in drawn["robots"]] for key in ("start", "goal"))
        counts.add((len(starts), len(standing)))
        for points in ([*standing, *starts], [*standing, *goals]):
            assert min(math.dist(a, b) for i, a in enumerate(points) for b in points[:i]) >= 0.7
        reach = [math.hypot(*start) for start in starts]
        assert max(reach) <= 2.2 + 1e-12
        assert (min(reach) > 2.19) == (place == "circle")
    assert {robots for robots, _ in counts} == set(range(4, 11))
    assert {obstacles for _, obstacles in counts} == set(range(4))
