"""Logs of robots driven by accelerations: read, differentiated, with gaps, observed, checked, and what is refused."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from tests.logs import bounded_errors, write_config, write_log
from tests.second_order_teams import crossing
from tests.test_config import refusal
from torchfsid.cli import main
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.config.documents import dump, validate
from torchfsid.config.models import load_models
from torchfsid.config.observe import ObserveConfig
from torchfsid.errors import ConfigError
from torchfsid.logs.table_log import read_csv
from torchfsid.robots.simulation import Trajectory

BODIES = ["ann", "bob", "cyd", "dan", "post"]
CONFIG = {
    "dynamics": "double_integrator",
    "task": {"kind": "goal", "gain": 0.6, "damping": 1.4},
    "barriers": [
        {
            "kind": "avoidance", "order": 2, "safety_distance": 0.4, "class_k": [{"gain": 1.5}, {"gain": 2.0}],
            "neighbour_acceleration": "current",
        },
        {"kind": "acceleration_box", "limit": [1.5, 1.5]},
    ],
    "prior": {"lower": [-4, -4], "upper": [4, 4]},
    "noise": {"acceleration": 1e-6},
    "obstacles": ["post"],
    "ukf": False,
}  # fmt: skip
LOOP = {**CONFIG, "task": {
    "kind": "goal", "gain": 0.7, "velocity_loop": 1.8, "saturation": {"kind": "norm", "limit": 0.5},
}}  # fmt: skip

pytestmark = pytest.mark.usefixtures("undrawn")


def a_run(task: str = "damped") -> tuple[torch.Tensor, Trajectory]:
    return crossing(task, "current", 0)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "log.csv", a_run()[1], BODIES)


def observed(log: Path, config: dict, out: Path, *overrides: str) -> dict:
    """The regions of `torchfsid observe`."""
    path = write_config(out.parent / "config.yaml", config)
    options = [option for override in overrides for option in ("--set", override)]
    assert main(["observe", str(log), "--config", str(path), "--out", str(out), *options]) == 0
    return json.loads((out / "regions.json").read_text())["robots"]


def are_inside(regions: dict, goals: torch.Tensor) -> bool:
    return all(
        region["status"] == "ok" and (np.array(region["A"]) @ goal <= np.array(region["b"]) + 1e-9).all()
        for region, goal in zip(regions.values(), goals.numpy(), strict=True)
    )


def test_a_log_has_what_was_measured(log: Path) -> None:
    """The measurements of a log are those of the simulation."""
    _, run = a_run()
    declared = DeclaredLog(validate(CONFIG, ObserveConfig, "config"), read_csv(log))
    for k, seen in enumerate(declared.measurements()):
        exact = run.measurement(k)
        for name in ("x", "u", "velocity", "bodies", "body_velocities", "body_accelerations"):
            assert torch.equal(getattr(seen, name), getattr(exact, name)), name
        assert seen.observed is not None
        assert seen.observed.all()
    assert read_csv(log).of_first_order().a is None


@pytest.mark.parametrize("task", ["damped", "loop"])
def test_goals_are_found(task: str, tmp_path: Path) -> None:
    goals, run = a_run(task)
    log = write_log(tmp_path / "log.csv", run, BODIES, bounded_errors(run, 4, 1e-3, seed=1))
    config = CONFIG if task == "damped" else LOOP
    regions = observed(log, config, tmp_path / "out", "noise={acceleration: 1e-3, neighbour_acceleration: 1e-3}")
    assert are_inside(regions, goals)
    assert list(regions) == BODIES[:4]


def test_auto_finds_the_bound(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    goals, run = a_run()
    log = write_log(tmp_path / "log.csv", run, BODIES, bounded_errors(run, 4, 1e-2, seed=1))
    regions = observed(log, CONFIG, tmp_path / "out", "noise={acceleration: auto, neighbour_acceleration: 1e-2}")
    assert are_inside(regions, goals)
    assert "noise.acceleration: auto found" in capsys.readouterr().out
    found = json.loads((tmp_path / "out" / "acceleration_bound.json").read_text())
    assert 1e-3 < max(found["smallest"].values()) < 2.1e-2
    assert yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())["noise"]["acceleration"] == found["used"]


def test_the_filter_and_the_hybrid_find_the_goals(log: Path, tmp_path: Path) -> None:
    goals, _ = a_run()
    observed(log, CONFIG, tmp_path / "out", "ukf={}")
    last = list(csv.DictReader((tmp_path / "out" / "estimates.csv").open()))[-4:]
    for name, largest in (("ukf", 0.1), ("hybrid", 1e-4)):
        estimates = np.array([[float(row[f"{name}_0"]), float(row[f"{name}_1"])] for row in last])
        assert np.linalg.norm(estimates - goals.numpy(), axis=-1).max() < largest


def test_accelerations_from_differences_of_velocities(log: Path, tmp_path: Path) -> None:
    """Exact under zero-order hold. Errors of velocities are counted at their honest bound, and called useless."""
    goals, run = a_run()
    assert run.velocity is not None
    lines = [",".join(line.split(",")[:6]) for line in log.read_text().split()]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    without = read_csv(tmp_path / "log.csv")
    assert without.a is None
    exact = without.accelerated(0.0)
    np.testing.assert_allclose(exact.a, run.u[:-1], atol=1e-12)
    assert are_inside(observed(tmp_path / "log.csv", CONFIG, tmp_path / "out", "velocity=differentiated"), goals)

    generator, size = np.random.default_rng(1), 1e-3
    turn = generator.uniform(0, 2 * np.pi, without.seen.shape)
    assert without.u is not None
    wrong = replace(without, u=without.u + size * np.stack([np.cos(turn), np.sin(turn)], axis=-1))
    noisy = wrong.accelerated(size)
    assert noisy.acceleration_error is not None
    error = np.linalg.norm(noisy.a - run.u[:-1].numpy(), axis=-1)
    assert (error <= noisy.acceleration_error + 1e-12).all()
    np.testing.assert_allclose(noisy.acceleration_error, 2 * size / 0.1)
    config = validate({**CONFIG, "velocity": "differentiated", "noise": {"acceleration": 1e-6, "velocity": 0.1}},
                      ObserveConfig, "config")  # fmt: skip
    judged = DeclaredLog(config, without).judged(1e-6)
    assert judged.is_useless
    assert "differences of velocities" in judged.warning(is_needed=False)


def test_positions_alone_do_not_do(log: Path) -> None:
    only = replace(read_csv(log), u=None, a=None, acceleration_known=None)
    for velocity in ("logged", "differentiated"):
        with pytest.raises(ConfigError, match="two unknowns for each position"):
            DeclaredLog(validate({**CONFIG, "velocity": velocity}, ObserveConfig, "config"), only)
    with pytest.raises(ConfigError, match="no accelerations ax, ay"):
        DeclaredLog(validate(CONFIG, ObserveConfig, "config"), replace(read_csv(log), a=None))


def test_gaps_are_bridged_within_their_bounds(log: Path, tmp_path: Path) -> None:
    """A robot that is missing for 0.4 s: the others keep their goals, and the truth is within what is said of it."""
    goals, run = a_run()
    assert run.velocity is not None
    whole = log.read_text().split()
    gone = [f"{t}" for t in run.t[20:24].tolist()]
    lines = [line for line in whole if not (line.split(",")[0] in gone and line.split(",")[1] == "bob")]
    assert len(lines) == len(whole) - 4
    (tmp_path / "log.csv").write_text("\n".join(lines))
    filled = DeclaredLog(validate(CONFIG, ObserveConfig, "config"), read_csv(tmp_path / "log.csv")).log
    assert filled.bridged is not None
    assert filled.bridged.sum() == 4
    for name, values, error in (
        ("x", run.x, filled.position_error), ("u", run.velocity, filled.velocity_error),
        ("a", run.u, filled.acceleration_error),
    ):  # fmt: skip
        off = np.linalg.norm(getattr(filled, name) - values.numpy(), axis=-1)
        assert (off <= error + 1e-9).all()
    assert are_inside(observed(tmp_path / "log.csv", CONFIG, tmp_path / "out"), goals)


def test_check_finds_a_shift(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, run = a_run()
    late = replace(run, u=torch.cat([torch.zeros_like(run.u[:1]), run.u[:-1]]))
    path = write_config(tmp_path / "config.yaml", CONFIG)
    for which, expected in ((log, "accelerations and positions are aligned"), (
        write_log(tmp_path / "late.csv", late, BODIES), "accelerations logged 1 sample(s) later fit better",
    )):  # fmt: skip
        assert main(["check", str(which), "--config", str(path), "--out", str(tmp_path / "out")]) == 0
        said = capsys.readouterr().out
        assert expected in said
        assert "m/s2" in said
        assert "m/s " not in said.replace("m/s2", "")


def test_the_wrong_order_does_not_explain_a_log(log: Path) -> None:
    """Robots taken to be driven by velocities, and rows that leave out the neighbours' accelerations."""
    none = {**CONFIG, "barriers": [{**CONFIG["barriers"][0], "neighbour_acceleration": "none"}, CONFIG["barriers"][1]]}
    first = {
        "task": {"kind": "goal", "gain": 0.6}, "noise": {"velocity": 1e-6}, "obstacles": ["post"],
        "prior": CONFIG["prior"],
        "barriers": [{"kind": "avoidance", "safety_distance": 0.4, "class_k": {"gain": 1.5}}],
    }  # fmt: skip
    for wrong in (none, first):
        bounds = DeclaredLog(validate(wrong, ObserveConfig, "config"), read_csv(log)).smallest_bounds()
        assert max(bounds.values()) > 0.03


def test_open_forms_are_hypotheses(tmp_path: Path) -> None:
    barriers = [{**CONFIG["barriers"][0], "neighbour_acceleration": "auto"}, CONFIG["barriers"][1]]
    path = write_config(tmp_path / "config.yaml", {**CONFIG, "barriers": barriers})
    assert list(load_models(path)) == ["none", "current"]


def test_configurations_are_repeatable() -> None:
    for config in (CONFIG, LOOP, {**CONFIG, "noise": {"acceleration": "auto", "velocity": 1e-3}}):
        made = validate(config, ObserveConfig, "config")
        assert validate(yaml.safe_load(dump(made)), ObserveConfig, "config") == made


AVOIDANCE = CONFIG["barriers"][0]
REFUSED = {
    "dynamics": ({"dynamics": "single_integrator"}, "task.damping: needs dynamics: double_integrator"),
    "velocity loop of first order": ({"dynamics": "single_integrator", "task": LOOP["task"]}, "task.velocity_loop"),
    "order 2 of first order": (
        {"dynamics": "single_integrator", "task": {"kind": "goal", "gain": 1.0}}, "barriers[0].order: expected 1 with",
    ),
    "acceleration box of first order": (
        {
            "dynamics": "single_integrator", "task": {"kind": "goal", "gain": 1.0},
            "barriers": [CONFIG["barriers"][1]],
        },
        "barriers[0].kind: expected rows over velocities",
    ),
    "noise of first order": ({"noise": {"velocity": 1e-3}}, "noise.acceleration: expected a bound on acceleration"),
    "noise of second order": (
        {
            "dynamics": "single_integrator", "task": {"kind": "goal", "gain": 1.0},
            "barriers": [{"kind": "speed_box", "limit": [1, 1]}],
        },
        "noise.velocity: expected a bound on velocity",
    ),
    "order 1": (
        {"barriers": [{"kind": "avoidance", "safety_distance": 0.4, "class_k": {"gain": 1.5}}]},
        "barriers[0].order: expected 2 with dynamics: double_integrator",
    ),
    "speed box": ({"barriers": [{"kind": "speed_box", "limit": [1, 1]}]}, "barriers[0].kind: expected rows over acc"),
    "one gain": ({"barriers": [{**AVOIDANCE, "class_k": {"gain": 1.5}}]}, "barriers[0].class_k: expected a list"),
    "three gains": ({"barriers": [{**AVOIDANCE, "class_k": [{"gain": 1.5}] * 3}]}, "barriers[0].class_k: expected at"),
    "two gains of order 1": (
        {"barriers": [{**AVOIDANCE, "order": 1, "neighbour_acceleration": "none"}]}, "barriers[0].neighbour_acceler",
    ),
    "power": (
        {"barriers": [{**AVOIDANCE, "class_k": [{"gain": 1.5}, {"gain": 1.0, "power": 3}]}]},
        "barriers[0].class_k[1].power: expected 1",
    ),
    "neighbours' velocities": (
        {"barriers": [{**AVOIDANCE, "neighbour_velocity": "current"}]}, "did you mean 'neighbour_acceleration'?",
    ),
    "damping and loop": ({"task": {**LOOP["task"], "damping": 1.0}}, "task.velocity_loop: expected damping or"),
    "damped dead zone": ({"task": {**CONFIG["task"], "dead_zone": 0.1}}, "task.dead_zone: expected none with damping"),
    "task": ({"task": {"kind": "velocity"}}, "task.kind: expected 'goal' with dynamics: double_integrator"),
    "law": ({"task": {"kind": "goal", "law": "constant_speed", "speed": 1, "tolerance": 0.1}}, "task.law: expected"),
    "bound": ({"noise": {"acceleration": -1}}, "noise.acceleration: expected a bound of at least 0 m/s2 or 'auto'"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_fit_together(name: str) -> None:
    changes, expected = REFUSED[name]
    assert expected in refusal(lambda: validate({**CONFIG, **changes}, ObserveConfig, "config"))
