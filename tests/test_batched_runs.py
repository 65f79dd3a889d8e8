"""Runs side by side: each gives what it gives alone, whatever the others are."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch

from experiments.runs.batch import likeness
from experiments.sweeps.config import SweepConfig
from experiments.sweeps.sweep import parts, records
from torchfsid.identification.evidence import ObservationModel, evidence
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import Arena, SpeedBox
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet

PLANE: dict[str, Any] = {
    "kind": "sweep",
    "title": "Side by side",
    "seed": 3,
    "repeats": 2,
    "times": [0, 0.3, 0.6],
    "experiment": {
        "kind": "scene",
        "task": {"kind": "goal", "gain": 1},
        "barriers": [{"kind": "avoidance", "safety_distance": 0.4, "class_k": {"gain": 2}}],
        "team": {"robots": [1, 4], "obstacles": [0, 2], "place": ["disc"], "radius": 1.2, "separation": 0.5},
        "measurement_noise": {"shape": "uniform"},
        "dt": 0.1,
        "duration": 0.6,
        "prior": {"lower": [-4, -4], "upper": [4, 4]},
        "set": "inverse_optimal",
        "noise": {"velocity": 0},
    },
    "draw": {"task.gain": [0.6, 1.6], "barriers.0.class_k.gain": [1, 3], "barriers.0.safety_distance": [0.3, 0.45]},
    "grid": {
        "measurement_noise.velocity, measurement_noise.position, noise.velocity, noise.position": [
            [1e-3, 1e-4, 1.1e-3, 1e-4],
            [1e-2, 1e-3, 1.1e-2, 1e-3],
        ],
        "barriers.0.neighbour_velocity": ["none", "current"],
    },
}
SPACE = PLANE["experiment"] | {
    "team": PLANE["experiment"]["team"] | {"robots": [2, 3], "place": ["ball"]},
    "prior": {"lower": [-4, -4, -4], "upper": [4, 4, 4]},
    "measurement_noise": {"shape": "bias"},
}
ACCELERATED = PLANE["experiment"] | {
    "task": {"kind": "goal", "gain": 1, "damping": 1.4},
    "barriers": [{"kind": "avoidance", "order": 2, "safety_distance": 0.3, "class_k": [{"gain": 1.5}, {"gain": 2.0}]}],
    "dynamics": "double_integrator",
    "noise": {"acceleration": 0},
}
CASES = {
    "uniform": {},
    "adversarial": {"experiment": PLANE["experiment"] | {"measurement_noise": {"shape": "adversarial"}}},
    "in space": {"experiment": SPACE},
    "accelerated": {
        "experiment": ACCELERATED,
        "draw": {"task.gain": [0.6, 1.6]},
        "grid": {"measurement_noise.acceleration, noise.acceleration": [[0.01, 0.011], [0.05, 0.051]]},
    },
    "clipped": {
        "repeats": 1,
        "experiment": PLANE["experiment"]
        | {"task": {"kind": "goal", "gain": 1, "saturation": {"kind": "norm", "limit": 0.4}}},
    },
}


@pytest.mark.parametrize("case", CASES)
def test_a_batch_gives_the_records_of_single_runs(case: str) -> None:
    config = SweepConfig(**(PLANE | CASES[case]))
    together = sorted(records(config, range(config.runs)), key=lambda record: record["run"])
    assert any(record["row"]["robots"] > 1 for record in together)
    for run, record in enumerate(together):
        (alone,) = records(config, [run])
        assert_same(record["row"], alone["row"])
        assert len(record["series"]) == 3 * record["row"]["robots"]
        for one, other in zip(record["series"], alone["series"], strict=True):
            assert_same(one, other)


def assert_same(one: dict[str, Any], other: dict[str, Any]) -> None:
    assert list(one) == list(other)
    for name, value in one.items():
        if isinstance(value, float):  # six digits are kept
            np.testing.assert_allclose(value, other[name], rtol=1e-5, atol=1e-12, err_msg=name)
        else:
            assert value == other[name], name


def test_which_scenes_are_alike() -> None:
    def text(run: int, **changed: Any) -> str | None:
        return likeness(SweepConfig(**(PLANE | {"experiment": PLANE["experiment"] | changed})).scene(run))

    assert text(0) == text(1) == text(4)  # other seeds, gains, teams, sizes of errors
    others = [
        text(2),
        text(0, dt=0.2),
        text(0, prior={"lower": [-5, -5], "upper": [5, 5]}),
        text(0, active_tolerance=1),
    ]
    assert len({text(0), *others}) == 5
    assert text(0, ukf={"feedback": True}) is None


def test_parts_are_all_runs_in_order() -> None:
    for runs in (1, 10, 40, 1000, 5000):
        assert [run for part in parts(runs) for run in part] == list(range(runs))
        assert len(parts(runs)) >= min(runs, 16)
        assert max(map(len, parts(runs))) <= 64


@pytest.mark.parametrize("neighbours", ["none", "current"])
def test_teams_of_different_sizes_beside_each_other(neighbours: Any) -> None:
    rng = np.random.default_rng(2)
    sizes, gains, gammas = ((3, 2), (2, 0), (1, 1)), torch.tensor([0.7, 1.0, 1.4]), torch.tensor([1.0, 2.0, 3.0])
    start, theta = torch.zeros(2, 3, 3, 2, dtype=torch.float64)
    standing, present = torch.zeros(3, 2, 2, dtype=torch.float64), torch.zeros(3, 5, dtype=torch.bool)
    for i, (robots, obstacles) in enumerate(sizes):
        places = torch.from_numpy(rng.permutation([[a, b] for a in (-1, 0, 1) for b in (-1, 0, 1)])) + 0.1
        start[i, :robots], theta[i, :robots] = places[:robots], -places[:robots] * 1.3
        standing[i, :obstacles] = places[robots : robots + obstacles]
        present[i, :robots], present[i, 3 : 3 + obstacles] = True, True

    def controller(gain: Any, gamma: Any) -> CbfQpController:
        avoidance = CollisionAvoidance(ClassK(gamma), safety_distance=0.4, neighbour_velocity=neighbours)
        return CbfQpController(GoalTask(gain), [avoidance])

    of_teams = controller(gains.double().unsqueeze(-1), gammas.double()[:, None, None])
    found = simulate(of_teams, theta, start, dt=0.1, steps=20, obstacles=standing, present=present)
    assert found.active.any()
    for i, (robots, obstacles) in enumerate(sizes):
        at = (theta[i, :robots], start[i, :robots])
        alone = simulate(
            controller(float(gains[i]), float(gammas[i])), *at, dt=0.1, steps=20, obstacles=standing[i, :obstacles]
        )
        torch.testing.assert_close(found.team(i).x[:, :robots], alone.x[:, :robots], rtol=1e-9, atol=1e-12)
        assert torch.equal(found.feasible[:, i, :robots], alone.feasible)
        block, last = found.team(i).block(5, 21), found.team(i).measurement(20)
        for field in fields(Measurement):
            if isinstance(value := getattr(last, field.name), torch.Tensor):
                assert torch.equal(getattr(block, field.name)[-1], value), field.name


def test_an_empty_slot_does_not_stop_a_team() -> None:
    """Empty slots are at zero, where these robots could not keep their walls and their greatest speed, and stand."""
    avoidance = CollisionAvoidance(ClassK(2.0), safety_distance=0.4, neighbour_velocity="current")
    walls = Arena((4.0, 4.0), (9.0, 9.0), ClassK(1.0))
    controller = CbfQpController(GoalTask(1.0), [avoidance, walls, SpeedBox((1.0, 1.0))])
    start = torch.tensor([[5.0, 5.0], [7.0, 7.0], [0.0, 0.0]], dtype=torch.float64)
    theta = start[[1, 0, 2]]
    there = torch.tensor([True, True, False])
    found = simulate(controller, theta, start, dt=0.1, steps=9, present=there)
    alone = simulate(controller, theta[:2], start[:2], dt=0.1, steps=9)
    assert found.feasible[:, :2].all()
    torch.testing.assert_close(found.x[:, :2], alone.x, rtol=1e-9, atol=1e-12)
    at_the_wall = simulate(CbfQpController(GoalTask(1.0), [walls]), theta, start, dt=0.5, steps=40, present=there)
    assert at_the_wall.deadlocked_since.isnan().all()


def test_every_bound_may_be_one_for_each_robot() -> None:
    rng = np.random.default_rng(4)
    x, u, before = torch.from_numpy(rng.uniform(-1, 1, (3, 4, 2)))
    seen = Measurement.of_team(0.0, x, 0.1 * u, previous_u=0.1 * before)
    prior = FeasibleSet.from_box(torch.full((4, 2), -4.0), torch.full((4, 2), 4.0))
    avoidance = CollisionAvoidance(ClassK(2.0), safety_distance=0.2, neighbour_velocity="previous")
    sizes = {field.name: torch.from_numpy(rng.uniform(1e-3, 2e-2, 4)) for field in fields(NoiseBound)}
    model = ObservationModel(GoalTask(0.9), [avoidance], noise=NoiseBound(**sizes))
    found = evidence(model, prior, seen)
    for i in range(4):
        item = torch.tensor([i])
        own = replace(model, noise=NoiseBound(**{name: float(size[i]) for name, size in sizes.items()}))
        alone = evidence(own, prior.select(item), seen.select(item))
        torch.testing.assert_close(found.omega.b[i], alone.omega.b[0], rtol=1e-12, atol=0)
        assert found.informative[i] == alone.informative[0]
