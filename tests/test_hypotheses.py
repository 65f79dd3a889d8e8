"""Which task is it, and has it changed? Hypotheses that refute each other, and sets that start again."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.logs import bounded_errors, write_config, write_log
from torchfsid.cli import main
from torchfsid.config.models import load_models
from torchfsid.errors import ConfigError
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import AffineTask, GoalTask, OrbitTask, Task, VelocityTask
from torchfsid.sets.feasible_set import FeasibleSet

AVOIDANCE = CollisionAvoidance(ClassK(2.0), safety_distance=0.5, neighbour_velocity="current")
TASKS: dict[str, Task] = {"orbit": OrbitTask(0.8), "velocity": VelocityTask(), "goal": GoalTask(0.9)}
TRUTHS = {"orbit": [0.3, -0.2], "velocity": [0.5, 0.3], "goal": [-1.0, 1.0]}
pytestmark = pytest.mark.usefixtures("undrawn")

BODIES = ["orbiter", "cruiser", "homer"]
CONFIG = {
    "tasks": [
        {"task": {"kind": "orbit", "rate": 0.8}},
        {"task": {"kind": "velocity"}, "prior": {"lower": [-1, -1], "upper": [1, 1]}},
        {"name": "home", "task": {"kind": "goal", "gain": 0.9}},
    ],
    "barriers": [
        {
            "kind": "avoidance",
            "safety_distance": 0.5,
            "class_k": {"gain": 2.0},
            "neighbour_velocity": "current",
        }
    ],
    "prior": {"lower": [-5, -5], "upper": [5, 5]},
    "noise": {"velocity": 0.01, "neighbour_velocity": 0.01},
}
NAMES = ["orbit", "velocity", "home"]


def each_its_own(part: int) -> Callable[[Measurement], Tensor]:
    """C or d of a team in which robot i has the i-th task."""

    def stacked(measurement: Measurement) -> Tensor:
        return torch.stack([task(measurement)[part][i] for i, task in enumerate(TASKS.values())])

    return stacked


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three robots with three tasks, in each other's way."""
    task = AffineTask(each_its_own(0), each_its_own(1), ("theta_0", "theta_1"))
    start = torch.tensor([[1.3, -0.2], [-1.5, -0.6], [1.5, -1.0]], dtype=torch.float64)
    truths = torch.tensor(list(TRUTHS.values()), dtype=torch.float64)
    run = simulate(CbfQpController(task, [AVOIDANCE]), truths, start, dt=0.15, steps=20)
    assert run.active.any()
    return write_log(tmp_path_factory.mktemp("log") / "log.csv", run, BODIES, bounded_errors(run, 3, 0.01, 0))


def test_each_robot_is_identified_by_refuting_the_others(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = {"velocity": "auto", "neighbour_velocity": 0.01}
    config = write_config(tmp_path / "config.yaml", {**CONFIG, "noise": noise})
    out = tmp_path / "out"
    assert main(["observe", str(log), "--config", str(config), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "which model is it?" in text
    assert all(f"│ {body} " in text for body in BODIES)
    verdicts = json.loads((out / "hypotheses.json").read_text())
    assert list(verdicts) == BODIES
    for body, true_name, truth in zip(BODIES, NAMES, TRUTHS.values(), strict=True):
        assert [name for name in NAMES if verdicts[body][name]["refuted_at"] is None] == [true_name]
        region = json.loads((out / true_name / "regions.json").read_text())["robots"][body]
        assert all(a[0] * truth[0] + a[1] * truth[1] <= b for a, b in zip(region["A"], region["b"], strict=True))
        assert verdicts[body][true_name] == {
            "status": "ok",
            "refuted_at": None,
            "evidence": [],
            "volume": region["volume"],
            "bound_useless": False,
        }
        for name in set(NAMES) - {true_name}:
            refuted = verdicts[body][name]
            assert refuted["status"] == "inconsistent"
            assert refuted["refuted_at"] in [evidence["time"] for evidence in refuted["evidence"]]
            rows = {evidence["row"] for evidence in refuted["evidence"]}
            assert rows <= {"prior", "nominal control", *(f"avoid {other}" for other in BODIES)}
    assert {path.name for path in (out / "velocity").iterdir()} >= {"estimates.csv", "regions.json", "config.yaml"}
    found = json.loads((out / "velocity_bound.json").read_text())
    assert found["used"] == 2 * max(found["smallest"].values()) <= 0.0204
    again = tmp_path / "again"
    assert main(["observe", str(log), "--config", str(out / "home" / "config.yaml"), "--out", str(again)]) == 0
    assert (again / "regions.json").read_bytes() == (out / "home" / "regions.json").read_bytes()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"task": {"kind": "velocity"}}, "tasks: expected task or tasks, got both"),
        ({"tasks": CONFIG["tasks"][:1]}, "tasks: expected at least 2 entries, got 1"),
        ({"tasks": [{"task": {"kind": "velocity"}}] * 2}, "two hypotheses are called 'velocity'"),
        ({"tasks": [{"task": {"kind": "goal"}}, *CONFIG["tasks"][:1]]}, "tasks[0].task.gain: required key is missing"),
        ({"tasks": [{"task": {"kind": "velocity"}, "name": "../up"}, *CONFIG["tasks"][:1]]}, "tasks[0].name"),
        ({"tasks": [{"task": {"kind": "goal_unknown_gain"}}, *CONFIG["tasks"][:1]]}, "(goal_unknown_gain): prior"),
        ({"tasks": "goal"}, "tasks"),
        ({"on_inconsistent": "reset"}, "on_inconsistent"),
        ({"noise": {"velocity": -1}}, "noise.velocity"),
    ],
)
def test_wrong_hypotheses_are_one_line(tmp_path: Path, change: dict, expected: str) -> None:
    config = write_config(tmp_path / "config.yaml", {**CONFIG, **change})
    with pytest.raises(ConfigError) as error:
        load_models(config)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("noise", [1e-6, 0.01])
def test_a_change_of_goal_is_seen_within_two_samples(noise: float) -> None:
    """Four pairs of robots change their goals half-way to them, by at least half a metre; the sets start again."""
    pairs, dt = 4, 0.08
    generator = torch.Generator().manual_seed(3)
    goals = 4 * torch.rand(2, 2 * pairs, 2, generator=generator, dtype=torch.float64) - 2
    apart = goals[1] - goals[0]
    goals[1] = goals[0] + apart * (0.5 / apart.norm(dim=-1, keepdim=True)).clamp(min=1)
    start = 4 * torch.rand(2 * pairs, 2, generator=generator, dtype=torch.float64) - 2
    start[1::2] = start[::2] + torch.tensor([0.8, 0.0])
    samples: list[Measurement] = []
    controller = CbfQpController(GoalTask(0.9), [AVOIDANCE])
    switch = 18
    for pair in range(pairs):
        own = slice(2 * pair, 2 * pair + 2)
        before = simulate(controller, goals[0, own], start[own], dt=dt, steps=switch)
        after = simulate(controller, goals[1, own], before.x[-1], dt=dt, steps=switch)
        for k, (run, i) in enumerate([(before, i) for i in range(switch)] + [(after, i) for i in range(switch)]):
            errors = bounded_errors(run, 2, noise, seed=k)
            seen = replace(run, u=run.u + errors).measurement(i)
            if pair == 0:
                samples.append(replace(seen, t=k * dt))
            else:
                samples[k] = beside(samples[k], seen)
    lower = torch.full((2 * pairs, 2), -5.0)
    observer = SetMembershipObserver(
        GoalTask(0.9),
        [AVOIDANCE],
        FeasibleSet.from_box(lower, -lower),
        noise=NoiseBound(noise, neighbour_velocity=noise),
        on_inconsistent="reset",
    )
    for k, sample in enumerate(samples):
        theta = observer.update(sample).feasible_set
        assert k >= switch or theta.contains(goals[0]).all()
    assert theta.contains(goals[1]).all()
    assert (observer.status == Status.OK).all()
    assert sorted(event.robot for event in observer.events) == list(range(2 * pairs))
    assert all(event.reset for event in observer.events)
    delays = [round(event.t / dt) - switch for event in observer.events]
    assert min(delays) >= 0
    assert max(delays) <= 2


def beside(one: Measurement, other: Measurement) -> Measurement:
    """Two teams as one batch."""
    joined = {
        name: torch.cat([value, getattr(other, name)]) for name, value in vars(one).items() if isinstance(value, Tensor)
    }
    return replace(one, **joined)
