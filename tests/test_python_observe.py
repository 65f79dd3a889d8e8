"""The commands on logs as functions: a saved run gives the sets of the streaming observer, by objects as by files."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch

import torchfsid as fsid

TASK = fsid.GoalTask(0.9)
AVOIDANCE = fsid.CollisionAvoidance(fsid.ClassK(1.5), safety_distance=0.5)
GOALS = torch.tensor([[2.0, 0.1], [-2.0, 0.0]], dtype=torch.float64)
BOX = torch.full((2,), 5.0, dtype=torch.float64)
PRIOR, NOISE = fsid.FeasibleSet.from_box(-BOX, BOX), fsid.NoiseBound(1e-3)
CONFIG = """
task: {kind: goal, gain: 0.9}
barriers: [{kind: avoidance, safety_distance: 0.5, class_k: {gain: 1.5}}]
prior: {lower: [-5, -5], upper: [5, 5]}
noise: {velocity: 0.001}
obstacles: [obstacle_0]
ukf: false
"""


@pytest.fixture(scope="module")
def run() -> fsid.Trajectory:
    """Two robots swap places past a pillar."""
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3]], dtype=torch.float64)
    controller = fsid.CbfQpController(TASK, [AVOIDANCE])
    return fsid.simulate(controller, GOALS, start, dt=0.05, steps=40, obstacles=torch.tensor([[0.2, 1.0]]))


@pytest.fixture(scope="module")
def saved(run: fsid.Trajectory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run.save(tmp_path_factory.mktemp("logs") / "run.csv")


@pytest.fixture(scope="module")
def streamed(run: fsid.Trajectory) -> fsid.SetMembershipObserver:
    observer = fsid.SetMembershipObserver(
        TASK, [AVOIDANCE], fsid.FeasibleSet.concatenate([PRIOR[None]] * 2), noise=NOISE
    )
    for measurement in run.measurements():
        observer.update(measurement)
    return observer


def test_a_saved_run_is_observed_like_the_run_itself(
    run: fsid.Trajectory, saved: Path, streamed: fsid.SetMembershipObserver, tmp_path: Path, undrawn: None
) -> None:
    (tmp_path / "config.yaml").write_text(CONFIG)
    ways = [
        fsid.observe(saved, TASK, [AVOIDANCE], PRIOR, NOISE, obstacles=["obstacle_0"], ukf=False),
        fsid.observe(run, TASK, [AVOIDANCE], PRIOR, NOISE, ukf=False),
        fsid.observe(fsid.read_log(saved), config=tmp_path / "config.yaml"),
        fsid.observe(saved, barriers=[AVOIDANCE], config=tmp_path / "config.yaml"),
    ]
    for found in ways:
        torch.testing.assert_close(found.sets.vertices(), streamed.feasible_set.vertices(), rtol=0, atol=1e-12)
        torch.testing.assert_close(found.sets.last_cut, streamed.feasible_set.last_cut)
        assert found.status_names == ["ok", "ok"]
        assert found.sets.contains(GOALS).all()
    made = [json.loads((found.save(tmp_path / "out") / "regions.json").read_text())["made_from"] for found in ways]
    assert made[0] == made[3] == {**made[2], "sha256": hashlib.sha256(saved.read_bytes()).hexdigest()}
    assert made[2]["log"] == str(saved)
    assert "sha256" not in made[1]  # a run, or a log in memory, is not the file that it may have come from


def test_a_log_keeps_every_digit(run: fsid.Trajectory, saved: Path) -> None:
    log = fsid.read_log(saved)
    assert log.bodies == ("0", "1", "obstacle_0")
    np.testing.assert_array_equal(log.x, run.x)
    np.testing.assert_array_equal(log.u, run.u)
    np.testing.assert_array_equal(log.t, run.t)
    assert log.reading.rounding == {}
    assert log.position_error is None


def test_a_run_of_second_order_with_radii_is_saved(tmp_path: Path) -> None:
    task, limit = fsid.GoalTask(0.6, damping=1.4), fsid.SpeedBox((2.0, 2.0), quantity="acceleration")
    start, goals = torch.tensor([[0.0, 0.0], [3.0, 1.0]]), torch.tensor([[1.0, 1.0], [0.0, 0.5]])
    controller = fsid.CbfQpController(task, [limit])
    radius = torch.tensor([0.5, 0.25])
    run = fsid.simulate(controller, goals, start, dt=0.1, steps=40, velocity=torch.zeros(2, 2), radius=radius)
    log = fsid.read_log(run.save(tmp_path / "run.csv", names=["a", "b"]))
    assert log.bodies == ("a", "b")
    np.testing.assert_array_equal(log.radius, radius)
    np.testing.assert_array_equal(log.a, run.u)
    options = {"dynamics": "double_integrator", "ukf": False}
    by_run = fsid.observe(run, task, [limit], PRIOR, NOISE, **options)
    by_log = fsid.observe(log, task, [limit], PRIOR, NOISE, **options)
    torch.testing.assert_close(by_run.sets.vertices(), by_log.sets.vertices())
    assert by_log.sets.contains(goals).all()
    assert (by_log.sets.diameter() < 0.1).all()


def test_own_barriers_and_tasks_are_observed(run: fsid.Trajectory) -> None:
    """A pursuit whose target is known: theta is the offset to it; and a wall of one's own."""
    wall = fsid.AffineBarrier(
        torch.tensor([[0.0, 1.0]]), lambda seen: 3.0 - seen.x[..., 1:], names=("wall",), depends_on_bodies=False
    )
    target = torch.tensor([1.0, 1.0], dtype=torch.float64)
    task = fsid.AffineTask(0.9 * torch.eye(2), lambda seen: 0.9 * (target - seen.x), ("east", "north"))
    found = fsid.observe(run, task, [AVOIDANCE, wall], PRIOR, NOISE, ukf=False)
    assert found.sets.contains(GOALS - target).all()
    assert (found.sets.diameter() < 0.1).all()
    assert "wall" in found.observation.declared.row_labels


def test_the_course_of_a_result_and_its_files(
    run: fsid.Trajectory, streamed: fsid.SetMembershipObserver, tmp_path: Path, undrawn: None
) -> None:
    found = fsid.observe(run, TASK, [AVOIDANCE], PRIOR, NOISE)
    assert found.over_time("volume").shape == (len(found.t), 2)
    assert found.over_time("centroid").shape == (len(found.t), 2, 2)
    torch.testing.assert_close(found.over_time("centroid")[-1], streamed.feasible_set.centroid())
    assert (found.over_time("volume").diff(dim=0) <= 1e-12).all()
    assert found.over_time("status").sum() == 0
    assert set(found.estimates) >= {"t", "robot", "volume", "ukf_0", "hybrid_1"}
    with pytest.raises(fsid.InputError, match="volume"):
        found.over_time("area")
    assert "\n" not in repr(found)
    assert len(repr(found)) < 200
    assert found.plot(tmp_path / "figure.pdf").is_file()
    with pytest.raises(fsid.InputError, match=r"\*\.pdf"):
        found.plot(tmp_path / "figure.svg")
    assert "<html" in found.report(tmp_path / "run.html").read_text(encoding="utf-8")
    folder = found.save(tmp_path / "out")
    assert {"estimates.csv", "regions.json", "config.yaml", "regions.png"} <= {path.name for path in folder.iterdir()}
    found.save(folder)  # its own results are replaced
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "regions.json").write_text("mine")
    with pytest.raises(fsid.ConfigError, match="choose another"):
        found.save(tmp_path / "other")


def test_check_is_the_same_question(run: fsid.Trajectory) -> None:
    assert "consistent" in fsid.check(run, TASK, [AVOIDANCE], PRIOR, NOISE).conclusions()[0]
    wrong = fsid.check(run, fsid.GoalTask(0.5), [AVOIDANCE], PRIOR, NOISE)
    assert wrong.smallest_bound > 0.01
    assert "consistent" not in wrong.conclusions()[0] or "too small" in wrong.conclusions()[0]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"noise": 0.02}, "noise: expected"),
        ({"noise": fsid.NoiseBound(torch.ones(2))}, "noise: .* for all robots"),
        ({"task": AVOIDANCE}, "task: .* a task"),
        ({"barriers": AVOIDANCE}, "barriers: expected a list"),
        ({"barriers": [AVOIDANCE, TASK]}, r"barriers\[1\]: .* a barrier"),
        ({"barriers": [{"kind": "speed_disc", "limit": -1}]}, r"barriers\[0\].limit: .* greater than 0"),
        ({"prior": (-1, 1)}, "prior: expected keys and values"),
        ({"prior": torch.ones(2)}, "prior: .* a FeasibleSet"),
        ({"prior": fsid.FeasibleSet.concatenate([PRIOR[None]] * 3)}, "prior: .* each of 2 robots, got 3"),
        ({"prior": fsid.FeasibleSet.from_box(-torch.ones(3), torch.ones(3))}, "prior: .* 2 parameters"),
        ({"priors": PRIOR}, "priors: unknown key .*'prior'"),
        ({"task": None}, "task: required key is missing"),
        ({"set": "critical_region", "task": fsid.GoalTask(1.0, gain_error=0.1)}, "not known exactly"),
    ],
)
def test_what_does_not_fit_is_named(run: fsid.Trajectory, given: dict, told: str) -> None:
    arguments = {"task": TASK, "barriers": [AVOIDANCE], "prior": PRIOR, "noise": NOISE, "ukf": False}
    with pytest.raises(fsid.FsidError, match=told):
        fsid.observe(run, **{**arguments, **given})


def test_a_run_that_is_no_log(run: fsid.Trajectory, tmp_path: Path) -> None:
    with pytest.raises(fsid.InputError, match="3 different names"):
        run.save(tmp_path / "run.csv", names=["a", "b"])
    with pytest.raises(fsid.InputError, match=r"\*\.csv"):
        run.save(tmp_path / "run.parquet")
