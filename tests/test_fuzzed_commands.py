"""Whatever a file holds, `observe` and `check` answer with results or with one line and exit code 2."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchfsid.cli import main

CONFIG: dict[str, Any] = {
    "task": {"kind": "goal", "gain": 0.9},
    "barriers": [
        {"kind": "avoidance", "safety_distance": 0.5, "class_k": {"gain": 1.5}, "neighbour_velocity": "none"},
        {"kind": "speed_box", "limit": [2.0, 2.0]},
    ],
    "prior": {"lower": [-5, -5], "upper": [5, 5]},
    "noise": {"velocity": 1e-3, "position": 0.0},
    "set": "inverse_optimal",
    "on_inconsistent": "hold",
    "ukf": {"position_noise": 1e-3},
}
CHANGES: dict[str, list[Any]] = {
    "task": [
        {"kind": "velocity"},
        {"kind": "orbit", "rate": -2.0},
        {"kind": "goal", "gain": 1e-9},
        {"kind": "goal", "gain": 1e9},
        {"kind": "goal", "gain": 0.9, "saturation": {"kind": "norm", "limit": 0.3}, "dead_zone": 0.1},
        {"kind": "goal", "gain": 0.9, "saturation": {"kind": "box", "limit": [1e-6, 1e6]}},
    ],
    "barriers": [
        [{"kind": "avoidance", "distance": "euclidean", "safety_distance": 1e3, "class_k": {"gain": 1e6, "power": 3}}],
        [{"kind": "avoidance", "margin": 0.1, "class_k": {"gain": 1.0}, "neighbour_velocity": "previous"}],
        [{"kind": "arena", "lower": [-9, -9], "upper": [-8, -8], "class_k": {"gain": 1e-6, "power": 0.5}}],
        [{"kind": "speed_polygon", "sides": 3, "limit": 1e-12, "soft": True}],
    ],
    "prior": [
        {"lower": [-1e9, -1e9], "upper": [1e9, 1e9]},
        {"lower": [4.0, 4.0], "upper": [4.0000000001, 4.0000000001]},
        {"lower": [5e8, -1], "upper": [1e9, 1]},
    ],
    "noise": [{"velocity": 0}, {"velocity": 1e6}, {"velocity": "auto"}, {"velocity": 1e-3, "position": 10.0}],
    "set": ["critical_region"],
    "on_inconsistent": ["reset", "raise"],
    "velocity": ["differentiated"],
    "active_tolerance": [1e-15, 1e15],
    "ukf": [{"position_noise": 1e-12, "process_noise": 0.0}, {"qp_inside": True, "feedback": True, "prior_std": 1e-9}],
}
CELLS = st.sampled_from(["0", "1e300", "-1e-300", "1e9", "nan", "inf", "", "abc", "-0.0", "2.5"])
HEAD = ["t", "robot", "x", "y", "vx", "vy", "radius"]


@st.composite
def logs(draw: st.DrawFn) -> list[list[str]]:
    """Two robots and a pillar, sensible but for a few cells."""
    rows = []
    for k in range(draw(st.integers(1, 6))):
        for body, x, y, vx in (("a", -2.0, 0.0, 0.5), ("b", 2.0, 0.3, -0.5), ("pillar", 0.1, 1.0, 0.0)):
            rows.append([f"{0.1 * k:.1f}", body, f"{x + 0.1 * k * vx}", f"{y}", f"{vx}", "0.01", "0.2"])
    for _ in range(draw(st.integers(0, 3))):
        row, column = draw(st.integers(0, len(rows) - 1)), draw(st.integers(0, len(HEAD) - 1))
        rows[row][column] = draw(CELLS)
    return rows


@st.composite
def configs(draw: st.DrawFn) -> dict[str, Any]:
    changed = draw(st.lists(st.sampled_from(sorted(CHANGES)), max_size=3, unique=True))
    return {**CONFIG, **{key: draw(st.sampled_from(CHANGES[key])) for key in changed}}


def answer(arguments: list[str]) -> tuple[int, str]:
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        code = main(arguments)
    return code, errors.getvalue()


@pytest.mark.usefixtures("undrawn")
@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(rows=logs(), config=configs(), command=st.sampled_from(["observe", "check"]))
def test_results_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, rows: list[list[str]], config: dict[str, Any], command: str
) -> None:
    folder = tmp_path_factory.mktemp("fuzz")
    with (folder / "log.csv").open("w", newline="") as file:
        csv.writer(file).writerows([HEAD, *rows])
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    out = folder / "out"
    code, errors = answer(
        [command, str(folder / "log.csv"), "--config", str(folder / "config.yaml"), "--out", str(out)]
    )
    if code in (1, 2):
        assert (code == 1) == (command == "observe" and out.exists())
        assert errors.splitlines()[-1].startswith("torchfsid: ")
        assert "Traceback" not in errors
    else:
        assert code == 0
        if command == "observe":
            assert_finite(out)


def assert_finite(out: Path) -> None:
    """Every set is bounded, and no bigger than its prior."""
    prior = yaml.safe_load((out / "config.yaml").read_text())["prior"]
    sides = [high - low for low, high in zip(prior["lower"], prior["upper"], strict=True)]
    for region in json.loads((out / "regions.json").read_text())["robots"].values():
        assert 0 <= region["volume"] <= math.prod(sides) * (1 + 1e-9)
        assert all(math.isfinite(value) for vertex in region["vertices"] for value in vertex)
