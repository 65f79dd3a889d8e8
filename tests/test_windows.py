"""Windows over positions: truths of motion-capture logs stay inside, and sets are far smaller than by differences."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.identification.evidence import ObservationModel
from torchfsid.identification.windows import Windows
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask, Saturation, Task
from torchfsid.sets.feasible_set import FeasibleSet

DT, RHO, GAIN = 0.01, 5e-4, 1.0
LENGTHS = (0.1, 0.25, 0.5, 1.0)


def team(
    seed: int, task: Task, avoidance: CollisionAvoidance, robots: int = 4, steps: int = 400
) -> tuple[Trajectory, Tensor]:
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(robots) / robots
    start = torch.from_numpy(0.8 * np.stack([np.cos(angle), np.sin(angle)], axis=1) + rng.normal(0, 0.1, (robots, 2)))
    goals = -start + torch.from_numpy(rng.normal(0, 0.15, (robots, 2)))
    return simulate(CbfQpController(task, [avoidance]), goals, start, dt=DT, steps=steps), goals


def displaced(rng: np.random.Generator, x: Tensor, kind: str, rho: float) -> Tensor:
    """Positions with errors of at most rho: in a disc, on its edge, or all in one direction that turns with time."""
    shape = x.shape[:-1]
    angle, size = rng.uniform(0, 2 * np.pi, shape), np.ones(shape)
    if kind == "disc":
        size = np.sqrt(rng.uniform(0, 1, shape))
    if kind == "sway":
        angle = np.broadcast_to(2 * np.pi * np.arange(shape[0])[:, None] / 40, shape)
    error = rho * size[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return x + torch.from_numpy(error)


def samples(x: Tensor, rho: float) -> list[Measurement]:
    u, error = x.diff(dim=0) / DT, torch.full((x.shape[1],), 2 * rho / DT, dtype=torch.float64)
    return [
        Measurement.of_team(k * DT, x[k], u[k], previous_u=u[max(k - 1, 0)], velocity_error=error)
        for k in range(len(u))
    ]


def observed(found: list[Measurement], task: Task, avoidance: Any, **options: Any) -> SetMembershipObserver:
    box = torch.full((len(found[0].x), 2), 3.0, dtype=torch.float64)
    noise = NoiseBound(1e-6, position=options.pop("rho", RHO))
    observer = SetMembershipObserver(task, [avoidance], FeasibleSet.from_box(-box, box), noise=noise, **options)
    for sample in found:
        observer.update(sample)
    return observer


@pytest.mark.parametrize(("share", "errors"), [("current", "disc"), ("current", "sway"), ("none", "edge")])
def test_no_truth_is_lost_and_sets_are_small(share: Any, errors: str) -> None:
    task, avoidance = GoalTask(GAIN), CollisionAvoidance(ClassK(2.0), safety_distance=0.3, neighbour_velocity=share)
    trajectory, goals = team(3, task, avoidance)
    found = samples(displaced(np.random.default_rng(4), trajectory.x, errors, RHO), RHO)
    by_windows = observed(found, task, avoidance, windows=LENGTHS)
    by_differences = observed(found, task, avoidance)
    for observer in (by_windows, by_differences):
        assert observer.feasible_set.contains(goals).all()
        assert (observer.status == Status.OK).all()
    small, large = by_windows.feasible_set.diameter(), by_differences.feasible_set.diameter()
    assert (small <= 1.02 * large).all()
    if share == "current":  # nobody is jammed
        assert small.max() < 8e-3
        assert (large / small).min() > (2 if errors == "edge" else 8)


@pytest.mark.parametrize(
    "saturation", [Saturation("norm", (0.8, 0.8)), Saturation("box", (0.8, 0.6)), Saturation("norm", (0.8, 0.8), 0.05)]
)
def test_clipped_nominal_controls(saturation: Saturation) -> None:
    task = GoalTask(GAIN, saturation=saturation)
    avoidance = CollisionAvoidance(ClassK(2.0), safety_distance=0.3, neighbour_velocity="current")
    trajectory, goals = team(5, task, avoidance, steps=500)
    found = samples(displaced(np.random.default_rng(6), trajectory.x, "edge", RHO), RHO)
    observer = observed(found, task, avoidance, windows=LENGTHS)
    assert observer.feasible_set.contains(goals).all()
    assert (observer.status == Status.OK).all()
    assert min(observer.windows_used.values()) > 0 or saturation.dead_speed > 0
    assert observer.feasible_set.diameter().median() < (0.4 if saturation.dead_speed else 0.02)


def test_each_window_alone_holds_the_truth() -> None:
    """8 teams with errors on the edge of their bounds, every window against the goals."""
    for seed in range(8):
        share, avoidance_gain = ("none", "current")[seed % 2], 1.0 + seed % 3
        avoidance = CollisionAvoidance(ClassK(avoidance_gain), safety_distance=0.5, neighbour_velocity=share)  # type: ignore[arg-type]
        trajectory, goals = team(seed, GoalTask(GAIN), avoidance, robots=5, steps=80)
        rho = (5e-4, 3e-3)[seed % 4 // 2]
        found = samples(displaced(np.random.default_rng(seed), trajectory.x, "edge", rho), rho)
        windows = Windows(
            ObservationModel(GoalTask(GAIN), [avoidance], noise=NoiseBound(1e-9, position=rho)), (0.05, 0.2)
        )
        box = torch.full((5, 2), 4.0, dtype=torch.float64)
        prior = FeasibleSet.from_box(-box, box)
        for sample in found:
            omega = windows.read(prior, sample).omega
            assert omega.contains(goals, tolerance=1e-9).all()
        assert (windows.used > 0).all()


def test_one_window_is_the_sum_of_its_samples() -> None:
    """Without rows and errors a window says where the goal is: by the mean position and the displacement."""
    lonely = CollisionAvoidance(ClassK(2.0), safety_distance=0.1)
    task = GoalTask(GAIN)
    trajectory, goals = team(1, task, lonely, robots=1, steps=60)
    windows = Windows(ObservationModel(task, [lonely], noise=NoiseBound(0.0)), (0.3,))
    found = samples(trajectory.x, 0.0)
    box = torch.full((1, 2), 3.0, dtype=torch.float64)
    prior = FeasibleSet.from_box(-box, box)
    for k, sample in enumerate(found):
        omega = windows.read(prior, sample).omega
        if k >= 30:
            x = trajectory.x[k - 30 : k + 1, 0]
            expected = x[:-1].mean(0) + (x[-1] - x[0]) / 0.3 / GAIN
            rows = (omega.A[0] != 0).any(-1)
            assert ((omega.A[0] @ expected - omega.b[0])[rows].abs() < 1e-9).all()
            assert expected.tolist() == pytest.approx(goals[0].tolist(), abs=1e-9)


def test_times_need_not_be_even_and_compiled_is_torch() -> None:
    """Every third sample is missing for everybody: the held control is the mean velocity until the next sample."""
    task, avoidance = GoalTask(GAIN), CollisionAvoidance(ClassK(2.0), safety_distance=0.3, neighbour_velocity="current")
    trajectory, goals = team(7, task, avoidance, steps=200)
    kept = [k for k in range(201) if k % 3]
    x, t = displaced(np.random.default_rng(8), trajectory.x, "disc", RHO)[kept], trajectory.t[kept]
    found = []
    for k in range(len(kept) - 1):
        step = float(t[k + 1] - t[k])
        error = torch.full((4,), 2 * RHO / step, dtype=torch.float64)
        found.append(Measurement.of_team(float(t[k]), x[k], (x[k + 1] - x[k]) / step, velocity_error=error))
    noise = 0.02  # controls change within the longer steps
    sets = []
    for compiled in (None, False):
        box = torch.full((4, 2), 3.0, dtype=torch.float64)
        observer = SetMembershipObserver(
            task, [avoidance], FeasibleSet.from_box(-box, box), noise=NoiseBound(noise, position=RHO),
            windows=(0.1, 0.4), compiled=compiled,
        )  # fmt: skip
        for sample in found:
            observer.update(sample)
        assert observer.feasible_set.contains(goals).all()
        sets.append(observer.feasible_set)
    assert sets[0].volume().tolist() == pytest.approx(sets[1].volume().tolist(), rel=1e-6)
    assert sets[0].centroid().flatten().tolist() == pytest.approx(sets[1].centroid().flatten().tolist(), abs=1e-7)


def test_a_gap_of_the_robot_ends_its_windows_and_no_others() -> None:
    task, avoidance = GoalTask(GAIN), CollisionAvoidance(ClassK(2.0), safety_distance=0.2)
    trajectory, _ = team(9, task, avoidance, robots=3, steps=60)
    box = torch.full((3, 2), 3.0, dtype=torch.float64)
    windows = Windows(ObservationModel(task, [avoidance], noise=NoiseBound(1e-6, position=RHO)), (0.2,))
    counts = []
    for k, sample in enumerate(samples(trajectory.x, RHO)):
        seen = torch.ones(3, dtype=torch.bool)
        seen[1] = not 25 <= k < 30
        windows.read(FeasibleSet.from_box(-box, box), replace(sample, observed=seen))
        counts.append(int(windows.ended))
    per_sample = np.diff(counts)
    assert per_sample[24:49].tolist() == [2] * 25  # from the first sample without robot 1 until 0.2 s after the last
    assert per_sample[21] == per_sample[52] == 3


def test_what_windows_refuse() -> None:
    task, avoidance = GoalTask(GAIN), CollisionAvoidance(ClassK(2.0), safety_distance=0.3)
    model = ObservationModel(task, [avoidance], noise=NoiseBound(1e-6))
    with pytest.raises(InputError, match="positive lengths"):
        Windows(model, (0.1, -1.0))
    with pytest.raises(InputError, match="inverse_optimal, for windows"):
        Windows(ObservationModel(task, [avoidance], kind="critical_region"), (0.1,))
    windows = Windows(model, (0.1,))
    trajectory, _ = team(1, task, avoidance, steps=3)
    prior = FeasibleSet.from_box(-torch.ones(4, 2).double(), torch.ones(4, 2).double())
    first, second, *_ = samples(trajectory.x, 0.0)
    windows.read(prior, second)
    with pytest.raises(InputError, match="a time after"):
        windows.read(prior, first)


CONFIG = """
task: {kind: goal, gain: 1.0}
barriers: [{kind: avoidance, safety_distance: 0.3, class_k: {gain: 2.0}, neighbour_velocity: current}]
prior: {lower: [-3, -3], upper: [3, 3]}
noise: {velocity: 1.0e-6, position: 5.0e-4}
velocity: windows
ukf: false
"""


def test_a_log_of_positions_with_dropouts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import json

    from torchfsid.cli import main

    avoidance = CollisionAvoidance(ClassK(2.0), safety_distance=0.3, neighbour_velocity="current")
    trajectory, goals = team(11, GoalTask(GAIN), avoidance, steps=400)
    rng = np.random.default_rng(12)
    x = displaced(rng, trajectory.x, "disc", RHO)
    seen = np.ones(x.shape[:2], dtype=bool)
    for robot in range(4):
        for begin in range(60 + 20 * robot, 400, 150):
            seen[begin : begin + int(rng.integers(5, 30)), robot] = False
    rows = [
        f"{k * DT:.2f},r{i},{float(x[k, i, 0])!r},{float(x[k, i, 1])!r}"
        for k in range(len(x)) for i in range(4) if seen[k, i]
    ]  # fmt: skip
    (tmp_path / "log.csv").write_text("\n".join(["t,robot,x,y", *rows]))
    (tmp_path / "cfg.yaml").write_text(CONFIG)
    out = tmp_path / "out"
    assert main(["observe", str(tmp_path / "log.csv"), "--config", str(tmp_path / "cfg.yaml"), "--out", str(out)]) == 0
    assert "Windows over positions that were used" in capsys.readouterr().out
    found = json.loads((out / "regions.json").read_text())
    assert found["windows_used"]["0.5"] >= 0.6
    for i, robot in enumerate(found["robots"].values()):
        assert robot["status"] == "ok"
        A, b = np.array(robot["A"]), np.array(robot["b"])
        assert (A @ goals[i].numpy() <= b + 1e-9).all()
        assert robot["diameter"] < 0.01
    assert "windows:" in (out / "config.yaml").read_text()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("windows=[0.1]\nvelocity=logged", "windows: expected velocity: windows beside it"),
        ("noise.velocity=auto", "noise.velocity: with windows it is the error of the controllers alone"),
        ("on_inconsistent=reset", "on_inconsistent: a window may span a change of goal"),
        ("set=critical_region", "set: windows need inverse_optimal"),
    ],
)
def test_configurations_that_do_not_fit(change: str, message: str, tmp_path: Path) -> None:
    from torchfsid.config.models import load_models
    from torchfsid.errors import ConfigError

    (tmp_path / "cfg.yaml").write_text(CONFIG)
    with pytest.raises(ConfigError, match=message):
        load_models(tmp_path / "cfg.yaml", change.split("\n"))
