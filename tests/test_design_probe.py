"""Probes placed by gradient: the gradients, what counts as no information, and that a run can be repeated."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.cuda_probe import compare, corridor
from experiments.__main__ import main
from experiments.design.config import ProbePlacementConfig
from experiments.design.placement import place
from experiments.design.probe import Objective, Probing, along, expectation
from experiments.kinds import load as load_config
from experiments.results import read_columns
from experiments.studies.gradients import across, summarise_switches
from torchfsid.config.documents import dump
from torchfsid.identification.evidence import SetKind
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask
from torchfsid.sets.feasible_set import FeasibleSet

CONFIG = Path(__file__).parents[1] / "configs" / "probe_placement.yaml"
SMALL = (
    "scenes=1",
    "duration=0.2",
    "search={starts: 4, steps: 2, spread: 0.15, learning_rate: 0.05, objective: area, finalists: 2}",
    "goals={train: 4, validation: 4, test: 4}",
    "landscape=[4, 2]",
    "gradient_check={horizons: [1], placements: 1, goals: 16, step: 0.01}",
)

pytestmark = pytest.mark.usefixtures("unchecked")


def load(*overrides: str) -> ProbePlacementConfig:
    config = load_config(CONFIG, overrides)
    assert isinstance(config, ProbePlacementConfig)
    return config


def tensor(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


# Gradients ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["critical_region", "inverse_optimal"])
def test_whole_pipeline_against_finite_differences(kind: str):
    """Way-points -> closed loop -> log-area of Theta(T), goal by goal, 1e-5; no history switches within the step."""
    probing = Probing.of(load(f"set={kind}"))
    goals = probing.draw_goals(4, seed=3)
    placement = tensor([[[0.62, 0.05], [0.9, -0.1], [0.8, 0.2]]])

    def log_area(at: Tensor) -> Tensor:
        return probing.left(at, goals, steps=12).area[0].log()

    jacobian = torch.autograd.functional.jacobian(log_area, placement).flatten(1)
    step = 1e-6
    for i in range(6):
        direction = step * torch.eye(6, dtype=torch.float64)[i].reshape(placement.shape)
        difference = (log_area(placement + direction) - log_area(placement - direction)) / (2 * step)
        torch.testing.assert_close(jacobian[:, i], difference, rtol=1e-5, atol=1e-5)
    assert (jacobian.abs().amax(-1) > 1e-2).all()


@pytest.mark.parametrize("kind", ["critical_region", "inverse_optimal"])
def test_simulate_and_the_observer_against_finite_differences(kind: SetKind):
    """The same for the package's own `simulate`: obstacle -> closed loop -> log-area of Theta(T)."""
    task, barriers = GoalTask(1.0), [CollisionAvoidance(ClassK(1.0), 0.4)]
    standing, goal, start = tensor([[0.6, 0.7], [0.6, -0.7]]), tensor([[3.1, 0.2]]), tensor([[0.0, 0.0]])

    def log_area(obstacle: Tensor) -> Tensor:
        bodies = torch.cat([standing, obstacle.unsqueeze(0)])
        run = simulate(CbfQpController(task, barriers), goal, start, dt=0.05, steps=12, obstacles=bodies)
        prior = FeasibleSet.from_box(tensor([[2.5, -0.5]]), tensor([[3.5, 0.5]]))
        noise = NoiseBound(0.01) if kind == "inverse_optimal" else None
        observer = SetMembershipObserver(task, barriers, prior, kind=kind, noise=noise)
        for measurement in run.measurements():
            observer.update(measurement)
        return observer.feasible_set.volume().log().sum()

    obstacle, step = tensor([0.62, 0.05]), 1e-6
    gradient = torch.autograd.functional.jacobian(log_area, obstacle)
    steps = step * torch.eye(2, dtype=torch.float64)
    differences = [(log_area(obstacle + s) - log_area(obstacle - s)) / (2 * step) for s in steps]
    torch.testing.assert_close(gradient, torch.stack(differences), rtol=1e-5, atol=1e-5)
    assert gradient.abs().max() > 1e-2


@pytest.mark.parametrize("objective", ["area", "log_area"])
def test_score_term_where_the_mean_is_known(objective: Objective):
    """Theta_0 = [0, 1] in two cells, [0, q] and [q, 1]: the mean of A is q^2 + (1 - q)^2, that of log A minus the
    entropy. Without the second term automatic differentiation gives half of the gradient, and nothing."""
    q = tensor(0.3).requires_grad_()
    goals = (torch.arange(1000, dtype=torch.float64) + 0.5) / 1000
    area = torch.where(goals < q, q, 1 - q).unsqueeze(0)
    (gradient,) = torch.autograd.grad(expectation(area, objective).sum(), q, retain_graph=True)
    smooth = area if objective == "area" else area.log()
    (without,) = torch.autograd.grad(smooth.mean(), q)
    exact = 4 * 0.3 - 2 if objective == "area" else np.log(0.3 / 0.7)
    assert float(gradient) == pytest.approx(exact, rel=1e-9)
    assert float(without) == pytest.approx(exact / 2 if objective == "area" else 0.0, abs=1e-9)


@pytest.mark.parametrize("horizon", [1, 5])
def test_gradient_of_the_mean_in_the_corridor(horizon: int):
    """Over goals, against central differences of the mean: at the first sample it is exact, soon after a direction."""
    probing = Probing.of(load())
    goals, placement, step = probing.draw_goals(2048, seed=1), tensor([[[0.65, 0.06]]]), 0.01

    def mean(at: Tensor) -> Tensor:
        return expectation(probing.left(at, goals, horizon).area, "area").sum()

    gradient = torch.autograd.functional.jacobian(mean, placement).flatten()
    steps = step * torch.eye(2, dtype=torch.float64).reshape(2, 1, 1, 2)
    with torch.no_grad():
        differences = torch.stack([(mean(placement + s) - mean(placement - s)) / (2 * step) for s in steps])
    assert differences.norm() > 0.1
    assert torch.cosine_similarity(gradient, differences, dim=0) > 0.95
    if horizon == 1:
        assert gradient.norm() / differences.norm() == pytest.approx(1.0, abs=0.05)


def test_at_a_switch_the_area_jumps():
    """Across the corridor for one goal: between switches the derivatives add up to the truth, and nowhere else."""
    rows = across(Probing.of(load()), tensor([0.55, 0.0]), tensor([3.1, 0.2]))
    y, log_area, added_up, switches = (np.array([row[key] for row in rows]) for key in rows[0])
    jumps, switched = np.abs(np.diff(log_area) - np.diff(added_up)), np.diff(switches) > 0
    assert (switches == 0).sum() > 100
    assert jumps[switches[1:] == 0].max() < 1e-7
    assert jumps[~switched].max() < 0.1 < jumps[switched].min()
    assert jumps[switched].max() > 1
    assert summarise_switches(rows)["switches"] == switches[-1] > 5
    assert y[-1] - y[0] == pytest.approx(0.2)


# Runs ---------------------------------------------------------------------------------------------------------------

AVOIDANCES = (
    "avoidance={distance: squared, safety_distance: 0.4, class_k: {gain: 1.0}}",
    "avoidance={distance: euclidean, safety_distance: 0.35, class_k: {gain: 20.0, power: 3}}",
)
PATHS = tensor(
    [
        [[0.62, 0.05], [0.9, -0.1], [0.8, 0.2]],
        [[0.0, 0.5], [0.3, 0.42], [1.2, 0.0]],
        [[0.0, 0.0], [0.7, 0.1], [0.8, 0.0]],
    ]
)
"""Ahead of the robot, from its side to its front, and from its own place to its front."""


@pytest.mark.parametrize("avoidance", AVOIDANCES)
@pytest.mark.parametrize("placements", [None, PATHS])
def test_compiled_runs_are_the_closed_loop(avoidance: str, placements: Tensor | None):
    probing = Probing.of(load(avoidance))
    goals = probing.draw_goals(8, seed=5)
    runs, samples = probing.run(placements, goals), list(probing.loop(placements, goals))
    x, u, bodies = (torch.stack([getattr(s.measurement, name) for s in samples], 1) for name in ("x", "u", "bodies"))
    torch.testing.assert_close(runs.x, x, rtol=0, atol=1e-12)
    torch.testing.assert_close(runs.u, u, rtol=0, atol=1e-12)
    assert torch.equal(runs.bodies, bodies)
    active, feasible = (torch.stack([getattr(s.control, name) for s in samples], 1) for name in ("active", "feasible"))
    assert torch.equal(runs.feasible, feasible)
    ours = torch.zeros_like(active, dtype=torch.long).scatter_add(-1, runs.rows, runs.filled.long())
    assert torch.equal(ours.bool(), active)
    assert placements is None or not feasible.all()


@pytest.mark.parametrize("avoidance", AVOIDANCES)
def test_gradients_of_runs_are_those_of_the_closed_loop(avoidance: str):
    """Of a weighted sum of some positions and controls."""
    probing = Probing.of(load(avoidance))
    goals, rng = probing.draw_goals(8, seed=5), np.random.default_rng(0)
    placements = PATHS.clone().requires_grad_()
    T, B = probing.steps, len(PATHS) * len(goals)
    weights, used = torch.from_numpy(rng.normal(size=(2, B, T, 2))), torch.from_numpy(rng.uniform(size=(B, T)) < 0.2)
    weights = weights * used.unsqueeze(-1)
    found = probing.run(placements, goals).along(probing.path(placements, T))
    (ours,) = torch.autograd.grad((torch.stack(found) * weights).sum(), placements)
    samples = [sample.measurement for sample in probing.loop(placements, goals)]
    by_steps = torch.stack([torch.stack([getattr(s, name) for s in samples], 1) for name in ("x", "u")])
    (theirs,) = torch.autograd.grad((by_steps * weights).sum(), placements)
    torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    assert (theirs[:2].flatten(1).norm(dim=-1) > 0.1).all()


def test_the_benchmark_takes_the_scene_of_the_file(capsys: pytest.CaptureFixture[str]):
    """Its gradient step runs where it is told to, and both sides agree."""
    scene, of_file = corridor(), Probing.of(load())
    for name, part in vars(scene).items():
        assert torch.equal(part, getattr(of_file, name)) if isinstance(part, Tensor) else part == getattr(of_file, name)
    (row,) = compare("cpu", [32]).values()
    assert row["value_difference"] == row["gradient_difference"] == 0
    assert "32 x 32 items" in capsys.readouterr().out


# What counts --------------------------------------------------------------------------------------------------------


def test_a_probe_that_comes_too_close_teaches_nothing():
    """It may not be used to stop the robot: the prior's area, and no gradient to follow."""
    probing = Probing.of(load())
    goals = probing.draw_goals(4, seed=0)
    over_the_robot = tensor([[[0.6, 0.0], [0.1, 0.0], [-0.4, 0.0]]]).requires_grad_()
    left = probing.left(over_the_robot, goals)
    assert not left.sound.any()
    assert (left.area == probing.prior_area).all()
    assert not left.area.requires_grad or torch.autograd.grad(left.area.sum(), over_the_robot)[0].norm() == 0
    beside = probing.left(tensor([[[0.6, 0.0]]]), goals)
    assert beside.sound.all()
    assert (beside.area < probing.prior_area).all()


def test_a_set_that_has_lost_its_goal_teaches_nothing():
    """With a coarse tolerance, goals near a switch are given an active set that is not theirs."""
    placement, lost = tensor([[[0.62, 0.05]]]), []
    for tolerance in (1e-6, 0.05):
        probing = Probing.of(load(f"active_tolerance={tolerance}"))
        goals = probing.draw_goals(128, seed=0)
        observer = SetMembershipObserver(
            probing.model.task,
            probing.model.barriers,
            probing.prior_of(128),
            probing.model.kind,
            active_tolerance=tolerance,
        )
        for sample in probing.loop(placement, goals):
            estimate = observer.update(sample.measurement)
        out = ~estimate.feasible_set.contains(goals, 1e-9)
        left = probing.left(placement, goals)
        assert torch.equal(left.sound[0], (estimate.status == Status.OK) & ~out)
        assert (left.area[0, out] == probing.prior_area).all()
        torch.testing.assert_close(left.area[left.sound], estimate.feasible_set.volume()[left.sound[0]])
        lost.append(int(((estimate.status == Status.OK) & out).sum()))
    assert lost[0] == 0
    assert lost[1] > 0


def test_allowed_placements_keep_the_safety_distance_and_the_room():
    probing = Probing.of(load())
    random = torch.from_numpy(np.random.default_rng(0).uniform(-2, 5, (200, 3, 2)))
    random[0, 0] = probing.start
    allowed = probing.allowed(random)
    lower, upper = probing.room
    assert ((allowed[:, 0] - probing.start).norm(dim=-1) >= 0.4).all()
    assert (allowed[:, 1:] >= lower).all()
    assert (allowed[:, 1:] <= upper).all()
    inside = tensor([[[1.0, 0.1], [0.9, 0.3], [0.7, 0.0]]])
    assert torch.equal(probing.allowed(inside), inside)


def test_without_a_probe_the_corridor_hides_the_goal():
    probing = Probing.of(load())
    assert probing.left(None, probing.draw_goals(8, seed=0)).area.tolist() == [[1.0] * 8]


def test_a_probe_along_its_way_points():
    way = tensor([[[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]]])
    at = torch.stack([along(way, share)[0] for share in (0.0, 0.25, 0.5, 0.75, 1.0)])
    assert torch.allclose(at, tensor([[0, 0], [0.5, 0], [1, 0], [1, 1], [1, 2]]))
    assert torch.equal(along(way[:, :1], 0.7), way[:, 0])


# A run --------------------------------------------------------------------------------------------------------------


def silent(items: Iterable[Any], *_: Any) -> Iterable[Any]:
    return items


def test_a_run_can_be_repeated_from_its_folder_and_is_drawn(tmp_path: Path):
    first, second = tmp_path / "first", tmp_path / "second"
    assert main(["design", str(CONFIG), "--out", str(first), *[word for o in SMALL for word in ("--set", o)]]) == 0
    config = load_config(first / "config.yaml")
    assert dump(config) == (first / "config.yaml").read_text()
    assert isinstance(config, ProbePlacementConfig)
    second.mkdir()
    place(config, second, silent)
    ours, theirs = (read_columns(folder / "runs.csv") for folder in (first, second))
    assert all((ours[name] == theirs[name]).all() for name in ours if name != "seconds")
    assert len(ours["method"]) == 7 + 6
    for name in (
        "placements.json",
        "replay.json",
        "landscape.csv",
        "gradient_check.csv",
        "no_gradient.csv",
        "switches.csv",
    ):
        assert (first / name).read_bytes() == (second / name).read_bytes()
    for name in ("figure.png", "figure.pdf", "comparison.png", "animation.gif"):
        assert (first / name).stat().st_size > 1000
    areas = json.loads((first / "summary.json").read_text())["areas [m^2]"]
    assert areas["1"]["none"]["mean area"] == 1.0
    simulations = {areas[K][name]["simulations"] for K in "13" for name in ("random", "near_path", "cem", "adam")}
    assert len(simulations) == 1


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("kind=probe", "kind"),
        ("search.step=1", "search.step"),
        ("goals.train=1", "goals.train"),
        ("avoidance.margin=0.1", "avoidance"),
        ("avoidance.neighbour_velocity=current", "avoidance.neighbour_velocity"),
        ("prior.upper=[2, 1]", "prior"),
        ("way_points=[1, 1]", "way_points"),
        ("way_points=[3]", "way_points"),
        ("obstacles=[[1, 1]]", "obstacles"),
        ("search.finalists=999", "search.finalists"),
        ("gradient_check.horizons=[99]", "gradient_check.horizons"),
        ("duration=0.001", "duration"),
    ],
)
def test_wrong_config_is_one_line_and_exit_code_2(
    override: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["design", str(CONFIG), "--out", str(tmp_path / "out"), "--set", override]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert f": {named}: " in message
    assert not (tmp_path / "out").exists()
