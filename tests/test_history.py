"""sets.csv and motion.csv: the course of a run, thinned so that what is left out is known."""

import csv
import json
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.logs import write_config, write_log
from torchfsid.cli import main
from torchfsid.commands import history
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask

GOALS = torch.tensor([[2.0, 0.2], [-2.0, 0.0], [0.3, 1.5]], dtype=torch.float64)
NAMES = ["ann", "bob", "eve"]
STEPS = 40

pytestmark = pytest.mark.usefixtures("undrawn", "unchecked")


@pytest.fixture
def observed(tmp_path: Path) -> Path:
    """The results of three robots that meet."""
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3], [0.1, -1.5]], dtype=torch.float64)
    run = simulate(
        CbfQpController(GoalTask(0.9), [CollisionAvoidance(ClassK(1.5), safety_distance=0.5)]),
        GOALS,
        start,
        dt=0.1,
        steps=STEPS,
    )
    log = write_log(tmp_path / "log.csv", run, NAMES)
    config = write_config(
        tmp_path / "config.yaml",
        {
            "task": {"kind": "goal", "gain": 0.9},
            "barriers": [{"kind": "avoidance", "safety_distance": 0.5, "class_k": {"gain": 1.5}}],
            "prior": {"lower": [-5, -5], "upper": [5, 5]},
            "noise": {"velocity": 1e-3},
            "ukf": False,
        },
    )
    assert main(["observe", str(log), "--config", str(config), "--out", str(tmp_path / "out")]) == 0
    return tmp_path / "out"


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_written_set_holds_the_later_ones_and_is_larger_by_a_step_at_most(observed: Path):
    rows, volumes = defaultdict(list), defaultdict(dict)
    for row in table(observed / "sets.csv"):
        rows[row["robot"], float(row["t"])].append([float(row[name]) for name in ("A_0", "A_1", "b")])
    for row in table(observed / "estimates.csv"):
        volumes[row["robot"]][float(row["t"])] = float(row["volume"])
    final = json.loads((observed / "regions.json").read_text())["robots"]
    for robot, goal in zip(NAMES, GOALS.numpy(), strict=True):
        written = [t for name, t in rows if name == robot]
        assert written[0] == 0.0
        assert written == sorted(written)
        assert written[-1] == max(volumes[robot])
        for t in written:
            facets = np.array(rows[robot, t])
            over = facets[:, :2] @ np.array(final[robot]["vertices"]).T - facets[:, 2:]
            assert over.max() < 1e-9
            assert (facets[:, :2] @ goal <= facets[:, 2] + 1e-9).all()
        for t, volume in volumes[robot].items():
            before = max(time for time in written if time <= t)
            assert volumes[robot][before] * (1 - history.STEP) <= volume * (1 + 1e-12)
    assert sum(len(facets) for facets in rows.values()) < 3 * STEPS * 5


def test_rows_say_where_they_came_from(observed: Path):
    names = {(row["row"], row["row_t"] == "") for row in table(observed / "sets.csv")}
    assert names <= {("prior", True), *((f"avoid {name}", False) for name in NAMES), ("nominal control", False)}
    assert len(names) > 1


def test_motion_has_every_body_and_its_active_rows(observed: Path):
    motion, estimates = table(observed / "motion.csv"), table(observed / "estimates.csv")
    assert [(row["t"], row["robot"]) for row in motion] == [(row["t"], row["robot"]) for row in estimates]
    for row, estimate in zip(motion, estimates, strict=True):
        assert len(list(filter(None, row["active"].split("; ")))) == int(estimate["n_active"])
    assert any(row["active"] for row in motion)


def test_long_motion_is_thinned_evenly(observed: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(history, "MOST_TIMES", 10)
    command = ["observe", str(observed.parent / "log.csv"), "--config", str(observed / "config.yaml")]
    assert main([*command, "--out", str(observed)]) == 0
    times = sorted({round(float(row["t"]) / 0.1) for row in table(observed / "motion.csv")})
    assert times == list(range(0, STEPS, 5)) + ([STEPS] if (STEPS) % 5 == 0 else [])
