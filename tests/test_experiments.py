"""The paper's experiments: their timelines, what they promise, that they can be repeated, and what they refuse."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
import torch

from experiments.__main__ import main
from experiments.figures.style import length
from experiments.kinds import KINDS, load
from experiments.runs.config import SETS, CasesConfig, ExpectedConfig, SceneConfig
from experiments.runs.saved import Results
from experiments.runs.scene import simulate_scene
from experiments.runs.summary import compare, stays_below, timeline
from torchfsid.commands.results_folder import write_json
from torchfsid.config.documents import dump
from torchfsid.logs.table_log import read_csv

CONFIGS = Path(__file__).parents[1] / "configs"
SHORT = ("duration=0.2", "snapshots=[0.1]", "expected=[]")

Runner = Callable[..., Results]


@pytest.fixture(scope="module", autouse=True)
def _shapes_are_checked_elsewhere() -> Iterator[None]:
    """A run makes a hundred thousand checks, which would take longer than the run."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def finish(path: Path, out: Path, *overrides: str) -> Results:
    """What the command line does, figures apart."""
    config = load(path, overrides, "run")
    assert isinstance(config, SceneConfig | CasesConfig)
    (out / "config.yaml").write_text(dump(config), encoding="utf-8")
    write_json(out / "summary.json", KINDS[config.kind].run(config, out, lambda items, *_: items))
    return Results(out, config)


@pytest.fixture(scope="module")
def run_experiment(tmp_path_factory: pytest.TempPathFactory) -> Runner:
    """Run a file of configs/ without figures."""

    def runner(name: str, *overrides: str) -> Results:
        return finish(CONFIGS / f"{name}.yaml", tmp_path_factory.mktemp(name), *overrides)

    return runner


@pytest.fixture(scope="module")
def two_pairs(run_experiment: Runner) -> Results:
    return run_experiment("two_pairs", "duration=2.2", "snapshots=[0.4, 1.6]")


@pytest.fixture(scope="module")
def mixed_active(run_experiment: Runner) -> Results:
    return run_experiment("mixed_active", "duration=3.74")


@pytest.fixture(scope="module")
def four_robots(run_experiment: Runner) -> Results:
    return run_experiment("four_robots", "duration=1.2", "snapshots=[0.08, 0.44, 0.76]")


@pytest.fixture(scope="module")
def five_cases(run_experiment: Runner) -> Results:
    return run_experiment("five_cases", "duration=0.5")


# Configurations -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["two_pairs", "mixed_active", "four_robots", "five_cases"])
def test_configs_load_and_survive_being_written(name: str, tmp_path: Path):
    config = load(CONFIGS / f"{name}.yaml")
    (tmp_path / "config.yaml").write_text(dump(config), encoding="utf-8")
    assert load(tmp_path / "config.yaml") == config
    assert isinstance(config, SceneConfig | CasesConfig)
    assert config.set == "critical_region"


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("nonsense=1", "nonsense"),
        ("kind=scenes", "kind"),
        ("dt=-0.02", "dt"),
        ("dt=.nan", "dt"),
        ("dt=1.0e-300", "duration"),
        ("duration=0.001", "duration"),
        ("active_tolerance=0", "active_tolerance"),
        ("prior.lower=[1, 2, 3]", "prior"),
        ("prior.lower=[11, -9]", "prior"),
        ("prior.upper=[3, 11]", "robots[0].goal"),
        ("robots.0.gaol=[1, 1]", "robots[0].gaol"),
        ("robots.0.start=[1]", "robots[0].start"),
        ("robots.0.name=1", "robots, obstacles"),
        ("barriers.0.safety_distance=0", "barriers[0].safety_distance"),
        ("barriers.0={kind: avoidance, margin: 0.1, class_k: {gain: 1}}", "radius"),
        ("snapshots=[2, 1]", "snapshots"),
        ("snapshots=[9]", "snapshots"),
        ("seed=-1", "seed"),
        ("expected.0.active=[7]", "expected[0].active"),
        ("expected.0.count=2", "expected[0]"),
        ("expected.0.until=3", "expected"),
        ("noise.velocity=-1", "noise.velocity"),
        ("ukf.position_noise=0", "ukf.position_noise"),
    ],
)
def test_wrong_config_is_one_line_and_exit_code_2(
    override: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    code = main(["run", str(CONFIGS / "two_pairs.yaml"), "--out", str(out), "--set", override])
    message = capsys.readouterr().err
    assert code == 2
    assert message.count("\n") == 1
    assert f": {named}: " in message
    assert not out.exists()


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("goal=[7, 0]", "goal"),
        ("cases.0.letter=F", "cases[0].letter"),
        ("cases.1.name=A", "cases"),
        ("cases.0.bodies=[]", "cases[0].bodies"),
        ("barriers.0={kind: avoidance, safety_distance: 0.1, class_k: {gain: 1}}", "barriers"),
        ("barriers.0.class_k.power=3", "barriers[0]"),
    ],
)
def test_wrong_table_is_refused(override: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    code = main(["run", str(CONFIGS / "five_cases.yaml"), "--out", str(tmp_path / "out"), "--set", override])
    assert code == 2
    assert f": {named}: " in capsys.readouterr().err


def test_missing_files_are_one_line_and_exit_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["run", str(tmp_path / "none.yaml"), "--out", str(tmp_path / "out")]) == 2
    assert main(["figures", str(tmp_path)]) == 2
    a_file = tmp_path / "file"
    a_file.touch()
    assert main(["run", str(CONFIGS / "two_pairs.yaml"), "--out", str(a_file)]) == 2
    assert capsys.readouterr().err.count("\n") == 3


def test_nothing_slow_is_imported_before_the_config_is_validated():
    check = "import sys, experiments.__main__; sys.exit(bool({'torch', 'matplotlib'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", check], cwd=CONFIGS.parent).returncode == 0


# Scenes -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", ["two_pairs", "mixed_active"])
def test_timeline_is_the_papers(scene: str, request: pytest.FixtureRequest):
    results: Results = request.getfixturevalue(scene)
    assert results.summary["expected_timeline"]["deviation"] <= 0.04


def test_two_pairs_intervals(two_pairs: Results):
    active = [(interval["active"], interval["until"]) for interval in two_pairs.summary["timeline"]["ego"]]
    assert [names for names, _ in active] == [["1", "2"], ["3", "4"], []]
    assert active[0][1] == pytest.approx(1.1, abs=0.04)
    assert active[1][1] == pytest.approx(2.1, abs=0.04)


@pytest.mark.parametrize("scene", ["two_pairs", "mixed_active", "four_robots"])
def test_truth_stays_inside_and_area_never_grows(scene: str, request: pytest.FixtureRequest):
    results: Results = request.getfixturevalue(scene)
    for counts in ("truth_outside", "area_grew"):
        assert {steps for of_set in results.summary[counts].values() for steps in of_set.values()} == {0}
    for kind in SETS:
        assert (np.diff(results.of_set(kind, "volume"), axis=0) <= 1e-9 * results.of_set(kind, "volume")[:-1]).all()
    assert set(results.summary["infeasible_steps"].values()) == {0}
    assert set(results.summary["deadlocked_since"].values()) == {None}


def test_ukf_stands_still_while_the_region_shrinks(two_pairs: Results):
    held = two_pairs.t < 2.1 - 1e-9
    error, area = two_pairs.error("ukf_0", "ukf_1")[:, 0], two_pairs.numbers("volume")[:, 0]
    assert np.ptp(error[held]) < 1e-9
    assert area[held][-1] < 0.8 * area[0] < 0.2 * 20.0**2
    assert (np.diff(area[held]) < 0).mean() > 0.5
    assert error[-1] < 1e-3
    assert set(two_pairs.cases()[held].ravel()) == {"D"}


def test_four_robots_are_all_held_at_first(four_robots: Results):
    assert set(four_robots.cases()[four_robots.t < 0.9].ravel()) == {"D"}
    assert (four_robots.error("hybrid_0", "hybrid_1") <= four_robots.error("ukf_0", "ukf_1") + 1e-6).all()


def test_a_run_from_its_resolved_config_is_the_same_run(run_experiment: Runner, tmp_path: Path):
    noisy = ("measurement_noise={velocity: 1.0e-3, position: 1.0e-4}", "noise.velocity=2.0e-3", "seed=7")
    first = run_experiment("two_pairs", *SHORT, *noisy)
    finish(first.folder / "config.yaml", tmp_path)
    for name in ("estimates.csv", "regions.json", "regions.jsonl", "trajectory.csv", "summary.json", "config.yaml"):
        assert (tmp_path / name).read_bytes() == (first.folder / name).read_bytes(), name
    other = run_experiment("two_pairs", *SHORT, *noisy[:2], "seed=8")
    assert (other.folder / "trajectory.csv").read_bytes() != (first.folder / "trajectory.csv").read_bytes()


def test_measurement_noise_keeps_its_bounds_and_spares_obstacles():
    noise = "measurement_noise={velocity: 0.01, position: 0.02}"
    config = load(CONFIGS / "two_pairs.yaml", [*SHORT, noise])
    assert isinstance(config, SceneConfig)
    scene = simulate_scene(config)
    for true, measured, bound in ((scene.true.x, scene.measured.x, 0.02), (scene.true.u, scene.measured.u, 0.01)):
        error = (measured - true).norm(dim=-1)
        assert 0 < error[:, 0].max() <= bound
        assert (error[:, 1:] == 0).all()


def test_the_trajectory_is_a_log_of_what_was_observed(two_pairs: Results):
    log = read_csv(two_pairs.folder / "trajectory.csv")
    config = two_pairs.config
    assert isinstance(config, SceneConfig)
    assert list(log.bodies) == config.bodies
    measured = simulate_scene(config).measured
    for ours, theirs in zip(measured.measurements(), log.measurements(["ego"], {"none"}), strict=True):
        assert ours.t == theirs.t
        assert theirs.u is not None
        assert torch.equal(ours.x, theirs.x)
        assert torch.equal(ours.bodies[ours.present], theirs.bodies[theirs.present])


def test_either_set_can_fill_the_plain_columns(run_experiment: Runner):
    swapped = run_experiment("two_pairs", *SHORT, "set=inverse_optimal")
    plain = run_experiment("two_pairs", *SHORT)
    for kind in SETS:
        np.testing.assert_array_equal(swapped.of_set(kind, "volume"), plain.of_set(kind, "volume"))
    final = json.loads((swapped.folder / "regions.json").read_text(encoding="utf-8"))["robots"]["ego"]["volume"]
    assert final == pytest.approx(swapped.numbers("volume")[-1, 0], rel=1e-9)


# Table I ------------------------------------------------------------------------------------------------------------


def test_every_case_is_realised_at_every_step(five_cases: Results):
    config = five_cases.config
    assert isinstance(config, CasesConfig)
    assert {case.letter for case in config.cases} == set("ABCDE")
    for i, case in enumerate(config.cases):
        assert set(five_cases.cases()[:, i]) == {case.letter}, case.name
    for row in five_cases.summary["cases"]:
        assert row["realised"] == row["letter"]
        assert row["critical_region_truth_outside"] == row["inverse_optimal_truth_outside"] == 0


def test_what_the_table_measures(five_cases: Results):
    rows = {row["case"]: row for row in five_cases.summary["cases"]}
    for row in rows.values():
        assert row["point_measured"] == row["point_paper"], row["case"]
        assert (row["information_rank"] == 0) == (row["letter"] in "DE")
        assert (row["ukf_error_after"] < 0.01 * row["ukf_error_before"]) == (row["letter"] in "ABC")
    shrinking = {name for name, row in rows.items() if row["region_measured"] == "yes"}
    assert set(rows) - shrinking == {"C, no other body", "E, surrounded"}
    # Opposite parallel rows: the multipliers give nothing, all there is comes from a row that stays inactive.
    assert rows["C, opposite sides"]["facets_of_multipliers"] == 0
    assert rows["C, opposite sides"]["facets_of_inactive_rows"] == 1
    assert rows["C, same side"]["facets_of_multipliers"] > 0
    # With both controls free or not, the measured velocity says more than the active set alone.
    assert rows["C, no other body"]["inverse_optimal_area_after"] < 1e-6


# Summaries and figures ----------------------------------------------------------------------------------------------


def test_run_draws_and_figures_draws_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    overrides = [text for override in SHORT for text in ("--set", override)]
    assert main(["run", str(CONFIGS / "two_pairs.yaml"), "--out", str(out), *overrides]) == 0
    assert "1, 2" in capsys.readouterr().out
    drawn = {name: (out / name).read_bytes() for name in ("figure.png", "figure.pdf", "animation.gif")}
    for name in drawn:
        (out / name).unlink()
    assert main(["figures", str(out)]) == 0
    assert {name: (out / name).read_bytes() for name in drawn} == drawn


@pytest.mark.parametrize("content", ["task: {kind: velocity}\n", "tasks: []\n"])
def test_figures_of_an_observed_log_are_drawn_elsewhere(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str
):
    (tmp_path / "config.yaml").write_text(content)
    assert main(["figures", str(tmp_path)]) == 2
    assert "is of `torchfsid observe`, which" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("scene", "names"),
    [("four_robots", ["figure", "comparison"]), ("five_cases", ["figure"])],
)
def test_figures_of_teams_and_tables(scene: str, names: list[str], request: pytest.FixtureRequest):
    results: Results = request.getfixturevalue(scene)
    assert main(["figures", str(results.folder)]) == 0
    for name in names:
        assert all((results.folder / f"{name}{suffix}").stat().st_size > 1000 for suffix in (".png", ".pdf"))


def test_timeline_and_stays_below():
    t = np.array([0.0, 0.1, 0.2, 0.3])
    intervals = timeline(t, [["1"], ["1"], [], ["2"]])
    assert [(i["from"], i["until"], i["active"]) for i in intervals] == [
        (0.0, 0.2, ["1"]),
        (0.2, 0.3, []),
        (0.3, None, ["2"]),
    ]
    assert stays_below(t, np.array([3.0, 0.5, 2.0, 0.5]), 1.0) == 0.3
    assert stays_below(t, np.array([0.5, 0.5, 0.5, 0.5]), 1.0) == 0.0
    assert stays_below(t, np.array([0.5, 0.5, 0.5, 2.0]), 1.0) is None
    assert stays_below(t, np.array([0.5, 0.5, np.nan, np.nan]), 1.0) is None


@pytest.mark.parametrize(("switch", "deviation"), [(3, 0.2), (5, 0.0), (6, 0.1)])
def test_a_timeline_is_compared_by_how_late_or_early_its_switches_are(switch: int, deviation: float):
    t = 0.1 * np.arange(10)
    active = [["1"] if k < switch else [] for k in range(10)]
    expected = [ExpectedConfig(until=0.5, active=("1",)), ExpectedConfig(until=1.0, count=0)]
    found = compare(t, active, expected, dt=0.1)
    assert found["deviation"] == pytest.approx(deviation)
    assert found["switches"][0]["deviation"] == pytest.approx(deviation)


def test_lengths_are_written_in_the_unit_that_fits():
    texts = [length(x) for x in (14.2, 0.11, 0.0032, 1.06e-6, 2e-9, 0.0)]
    assert texts == ["14 m", "0.11 m", "3.2 mm", "1.1 µm", "2 nm", "0 nm"]
