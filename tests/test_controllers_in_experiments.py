"""Experiments with other controllers than the paper's: ORCA, and robots of second order."""

import json
from pathlib import Path

import pytest
import torch

from experiments.__main__ import main
from experiments.kinds import load
from experiments.runs.config import SceneConfig
from experiments.runs.saved import Results
from experiments.runs.scene import simulate_scene
from experiments.sweeps.record import observed
from tests.test_experiments import CONFIGS, finish
from torchfsid.logs.table_log import read_csv

# ORCA ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def orca(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Three robots in a row that overlap, so that the one in the middle has no control that keeps its rows."""
    at = ((-0.35, 0.0), (0.0, 0.02), (0.35, 0.0))
    robots = [{"name": f"r{i}", "start": [x, y], "goal": [-4 * x, 1.0 - i]} for i, (x, y) in enumerate(at)]
    team = f"robots={json.dumps(robots)}"
    short = ("dt=0.1", "duration=0.8", "snapshots=[0.2, 0.5]", team)
    return finish(CONFIGS / "orca_circle.yaml", tmp_path_factory.mktemp("orca"), *short)


def test_truths_stay_inside_and_relaxed_samples_are_counted(orca: Results) -> None:
    summary = orca.summary
    assert list(summary["truth_outside"]) == ["inverse_optimal"]
    for counts in ("truth_outside", "area_grew"):
        assert set(summary[counts]["inverse_optimal"].values()) == {0}
    relaxed, infeasible = summary["relaxed_samples"], summary["infeasible_steps"]
    assert sum(infeasible.values()) > 0
    assert all(relaxed[robot] >= infeasible[robot] for robot in orca.robots)
    assert (orca.numbers("diameter")[-1] < orca.numbers("diameter")[0]).all()


def test_a_scene_with_radii_is_a_log_with_radii(orca: Results) -> None:
    log = read_csv(orca.folder / "trajectory.csv")
    assert isinstance(orca.config, SceneConfig)
    measured = simulate_scene(orca.config).measured
    pairs = zip(measured.measurements(), log.measurements(orca.robots, {"previous"}), strict=False)
    for ours, theirs in list(pairs)[1:]:
        for name in ("x", "u", "velocity", "radius", "previous_body_velocities", "body_radii"):
            of_run, of_log = getattr(ours, name), getattr(theirs, name)
            assert torch.equal(of_run, of_log), name


def test_figures_draw_robots_in_their_size(orca: Results) -> None:
    assert main(["figures", str(orca.folder)]) == 0
    for name in ("figure.png", "figure.pdf", "comparison.png", "animation.gif"):
        assert (orca.folder / name).stat().st_size > 1000


def test_a_robot_alone_is_drawn_with_the_one_set_that_there_is(tmp_path: Path) -> None:
    alone = ("robots=[{name: r1, start: [1, 0], goal: [-1, 0]}]", "obstacles=[{name: o1, position: [0, 0.1]}]")
    results = finish(CONFIGS / "orca_circle.yaml", tmp_path, *alone, "dt=0.1", "duration=0.3", "snapshots=[0.1]")
    assert set(results.summary["truth_outside"]["inverse_optimal"].values()) == {0}
    assert main(["figures", str(tmp_path)]) == 0


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("radius=null", "radius"),
        ("radius=0", "radius"),
        ("set=critical_region", "set"),
        ("barriers.0={kind: speed_disc, limit: 1.0}", "set"),
    ],
)
def test_what_orca_needs(override: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    overrides = ["--set", override, "--set", "set=critical_region"] if "disc" in override else ["--set", override]
    assert main(["run", str(CONFIGS / "orca_circle.yaml"), "--out", str(tmp_path / "out"), *overrides]) == 2
    assert f": {named}: " in capsys.readouterr().err


@pytest.mark.parametrize("shape", ["uniform", "adversarial"])
def test_a_run_of_a_sweep(shape: str) -> None:
    noise = f"measurement_noise={{velocity: 0.01, shape: {shape}}}"
    config = load(CONFIGS / "orca_circle.yaml", ["dt=0.2", "duration=0.8", "snapshots=[0.2]", noise])
    assert isinstance(config, SceneConfig)
    row = observed([config], (0.0, 0.4))[0]["row"]
    assert row["inverse_optimal_lost"] == row["inverse_optimal_alarm"] == row["inverse_optimal_inconsistent"] == 0
    assert "critical_region_lost" not in row


# Robots of second order ---------------------------------------------------------------------------------------------


NOISY = (
    "measurement_noise={acceleration: 0.02, velocity: 0.005, position: 0.002}",
    "noise={acceleration: 0.02001, neighbour_acceleration: 0.02, velocity: 0.005, position: 0.002}",
    "set=inverse_optimal",
)


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> Results:
    short = ("dt=0.1", "duration=1.0", "snapshots=[0.5]")
    return finish(CONFIGS / "second_order_crossing.yaml", tmp_path_factory.mktemp("crossing"), *short, *NOISY)


def test_truths_stay_inside_where_accelerations_have_errors(crossing: Results) -> None:
    counts = crossing.summary["truth_outside"]["inverse_optimal"]
    assert set(counts.values()) == set(crossing.summary["infeasible_steps"].values()) == {0}
    assert (crossing.numbers("volume")[-1] < 0.5 * crossing.numbers("volume")[0]).all()
    assert crossing.summary["settings"]["noise_unit"] == "m/s2"


def test_errors_of_accelerations_keep_their_bounds(crossing: Results) -> None:
    assert isinstance(crossing.config, SceneConfig)
    scene = simulate_scene(crossing.config)
    assert scene.true.velocity is not None
    assert scene.measured.velocity is not None
    for true, measured, bound in (
        (scene.true.x, scene.measured.x, 0.002),
        (scene.true.velocity, scene.measured.velocity, 0.005),
        (scene.true.u, scene.measured.u, 0.02),
    ):
        error = (measured - true).norm(dim=-1)
        assert 0.5 * bound < error[:, :4].max() <= bound
        assert (error[:, 4:] == 0).all()


def test_the_trajectory_is_a_log_of_accelerations(crossing: Results) -> None:
    log = read_csv(crossing.folder / "trajectory.csv")
    assert isinstance(crossing.config, SceneConfig)
    measured = simulate_scene(crossing.config).measured
    for ours, theirs in zip(measured.measurements(), log.measurements(crossing.robots, {"current"}), strict=True):
        for name in ("x", "velocity", "u", "body_velocities", "body_accelerations"):
            assert torch.equal(getattr(ours, name), getattr(theirs, name)), name


def test_figures_of_robots_of_second_order(crossing: Results) -> None:
    assert main(["figures", str(crossing.folder)]) == 0


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("dynamics=single_integrator", "task.damping"),
        ("noise={velocity: 0.01}", "noise.acceleration"),
        ("noise.acceleration=auto", "noise.acceleration"),
        ("barriers.1={kind: speed_box, limit: [1, 1]}", "barriers[1].kind"),
        ("measurement_noise.shape=adversarial", "measurement_noise.shape"),
    ],
)
def test_what_double_integrators_need(
    override: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = str(CONFIGS / "second_order_crossing.yaml")
    assert main(["run", config, "--out", str(tmp_path / "out"), "--set", override]) == 2
    assert f": {named}: " in capsys.readouterr().err


SWARM = [
    "dynamics=double_integrator",
    "barriers=[{kind: acceleration_box, limit: [1, 1]}]",
    "noise={acceleration: 0.1}",
]


@pytest.mark.parametrize(
    ("name", "overrides", "named"),
    [
        ("two_pairs", ["measurement_noise.acceleration=0.1"], "measurement_noise.acceleration"),
        ("swarm", SWARM, "dynamics"),
    ],
)
def test_what_single_integrators_do_not_have(
    name: str, overrides: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = [text for override in overrides for text in ("--set", override)]
    assert main(["run", str(CONFIGS / f"{name}.yaml"), "--out", str(tmp_path / "out"), *settings]) == 2
    assert f": {named}: " in capsys.readouterr().err
