"""Swarms: robots among their nearest neighbours only, observed as they go."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import jaxtyping
import pytest

from experiments.__main__ import main
from experiments.kinds import load
from experiments.runs.swarm_config import SwarmConfig

SWARM = Path(__file__).parents[1] / "configs" / "swarm.yaml"
SMALL = ("robots=60", "side=7.5", "duration=0.9", "snapshots=[0.3, 0.9]")


@pytest.fixture(scope="module", autouse=True)
def _shapes_are_checked_elsewhere() -> Iterator[None]:
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("swarm")
    overrides = [text for override in SMALL for text in ("--set", override)]
    assert main(["run", str(SWARM), "--out", str(out), *overrides]) == 0
    return out


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_no_truth_is_lost_and_sets_shrink(small: Path):
    summary = json.loads((small / "summary.json").read_text())
    assert summary["truth_outside"] == 0
    assert summary["status"] == {"ok": 60, "alarm": 0, "inconsistent": 0}
    assert summary["infeasible_steps"] == 0
    assert summary["closest"] > 0.5 - 1e-3
    assert summary["peak_memory_mib"] > 50
    medians = [float(row["sqrt_area_0.5"]) for row in rows(small / "sizes.csv")]
    assert len(medians) == summary["steps"] + 1
    assert medians == sorted(medians, reverse=True)
    assert medians[-1] < 0.1 * medians[0]


def test_robots_meet_and_figures_come_from_the_files(small: Path):
    snapshots = rows(small / "snapshots.csv")
    assert [row["t"] for row in snapshots] == ["0.3"] * 60 + ["0.9"] * 60
    assert {"A", "B", "D"} <= {row["case"] for row in snapshots}
    drawn = (small / "figure.png").read_bytes()
    (small / "figure.png").unlink()
    assert main(["figures", str(small)]) == 0
    assert (small / "figure.png").read_bytes() == drawn


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("robots=0", "robots"),
        ("side=20", "side"),
        ("side=50", "side"),
        ("neighbours=0", "neighbours"),
        ("sensing_radius=0", "sensing_radius"),
        ("measurement_noise.position=0.1", "measurement_noise"),
        ("barriers.0.neighbour_velocity=current", "barriers[0].neighbour_velocity"),
        ("snapshots=[99]", "snapshots"),
    ],
)
def test_wrong_config_is_one_line_and_exit_code_2(
    override: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["run", str(SWARM), "--out", str(tmp_path / "out"), "--set", override]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert f": {named}: " in message


def test_the_committed_swarm_is_a_thousand_robots_for_a_thousand_steps():
    config = load(SWARM)
    assert isinstance(config, SwarmConfig)
    assert config.robots == config.steps == 1000
