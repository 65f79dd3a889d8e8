"""Long logs: read in blocks, by a fast parser and with the compiled filter, they say what short ones say."""

import csv
import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from tests.logs import bounded_errors, write_config, write_log
from torchfsid.cli import main
from torchfsid.commands.figure_style import MOST_POINTS
from torchfsid.commands.figures import draw_observation
from torchfsid.config.observe import ObserveConfig
from torchfsid.config.observers import LONG_LOG, UkfConfig
from torchfsid.errors import ConfigError, LogError
from torchfsid.logs import large_csv
from torchfsid.logs.table_log import read_csv
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask

BODIES = ["ann", "bob, jr", "pillar"]
CONFIG = {
    "task": {"kind": "goal", "gain": 0.9},
    "barriers": [
        {
            "kind": "avoidance",
            "safety_distance": 0.5,
            "class_k": {"gain": 1.5},
            "neighbour_velocity": "previous",
        }
    ],
    "prior": {"lower": [-5, -5], "upper": [5, 5]},
    "noise": {"velocity": 2e-3},
    "obstacles": ["pillar"],
}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two robots that swap places past a pillar, with errors, a lost sample and a wild one."""
    start = torch.tensor([[-2.0, 0.0], [2.0, 0.3]], dtype=torch.float64)
    barrier = CollisionAvoidance(ClassK(1.5), safety_distance=0.5, neighbour_velocity="previous")
    controller, pillar = CbfQpController(GoalTask(0.9), [barrier]), torch.tensor([[0.2, 1.0]])
    run = simulate(controller, start.flip(0), start, dt=0.05, steps=80, obstacles=pillar)
    errors = bounded_errors(run, 2, 1e-3, seed=1)
    errors[60, 0] += 3.0
    path = write_log(tmp_path_factory.mktemp("log") / "log.csv", run, BODIES, errors)
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for k, line in enumerate(lines) if k != 1 + 3 * 30))
    return path


def observed(log: Path, out: Path, config: dict) -> list[dict[str, str]]:
    out.mkdir()
    assert (
        main(["observe", str(log), "--config", str(write_config(out / "c.yaml", config)), "--out", str(out / "r")]) == 0
    )
    return list(csv.DictReader((out / "r" / "estimates.csv").open()))


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("on_inconsistent", ["hold", "reset"])
def test_whatever_the_blocks_and_the_engine(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undrawn: None, on_inconsistent: str
) -> None:
    config = CONFIG | {"on_inconsistent": on_inconsistent}
    found = {}
    for block in (1, 7, 1000):
        for engine in ("filterpy", "batch"):
            monkeypatch.setattr("torchfsid.commands.observe.BLOCK", block)
            found[block, engine] = observed(log, tmp_path / f"{block}{engine}", config | {"ukf": {"engine": engine}})
    expected = found.pop((1, "filterpy"))
    regions = json.loads((tmp_path / "1filterpy" / "r" / "regions.json").read_text())["robots"]
    assert any(region["events"] for region in regions.values())  # the wild sample is noticed
    for rows in found.values():
        assert len(rows) == len(expected) == 2 * 81
        for row, other in zip(rows, expected, strict=True):
            for name, cell in row.items():
                if name in ("robot", "case", "n_active", "status") or not cell:
                    assert cell == other[name], name
                else:
                    assert float(cell) == pytest.approx(float(other[name]), rel=1e-9, abs=1e-9), name
    moved = {(tmp_path / f"{block}{engine}" / "r" / "motion.csv").read_text() for block, engine in found}
    assert len(moved) == 1


def test_the_engine_is_chosen_and_recorded(log: Path, tmp_path: Path) -> None:
    assert UkfConfig().for_log(LONG_LOG, True).engine == "filterpy"
    assert UkfConfig().for_log(LONG_LOG + 1, True).engine == "batch"
    assert UkfConfig().for_log(LONG_LOG + 1, False).engine == "filterpy"
    assert UkfConfig(qp_inside=True).for_log(LONG_LOG + 1, True).engine == "filterpy"
    assert UkfConfig(engine="batch").for_log(1, True).engine == "batch"
    with pytest.raises(ConfigError, match="QP is inside"):
        UkfConfig(engine="batch", qp_inside=True).for_log(1, True)
    with pytest.raises(ConfigError, match="clipped"):
        UkfConfig(engine="batch").for_log(1, False)
    observed(log, tmp_path / "o", CONFIG)
    resolved = yaml.safe_load((tmp_path / "o" / "r" / "config.yaml").read_text())
    assert resolved["ukf"]["engine"] == "filterpy"
    assert ObserveConfig.model_validate(resolved).ukf == UkfConfig(engine="filterpy")


@pytest.mark.parametrize(
    "text",
    [
        "t,robot,x,y,vx,vy\n0,a,1.25,2,,\n0,b,0,1e-3,3,4\n\n0.5,a,1.5,2.25,1,2\n0.5,b,-1,0,0,1\n",
        "t , robot,x,y\r\n0,a,1.2345678901234567,2\r\n1, a ,1,2\r\n",
        "t,robot,x,y\n0,a,1,2\n1,a, 1.5,2\n",
        "t,robot,x,y\n0,a,1,2\n1,a,+1.5,2\n",
    ],
)
def test_large_files_are_read_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    pytest.importorskip("pyarrow")
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode())
    plain = read_csv(path)
    monkeypatch.setattr(large_csv, "LARGE", 0)
    assert isinstance(large_csv.csv_table(str(path)), large_csv.LargeCsvTable)
    fast = read_csv(path)
    for field in fields(plain):
        mine, theirs = getattr(fast, field.name), getattr(plain, field.name)
        assert np.array_equal(mine, theirs) if isinstance(theirs, np.ndarray) else mine == theirs, field.name


@pytest.mark.parametrize(
    "text",
    [
        "t,robot,x,y\n0,a,1,2\n1,a,one,2\n",
        "t,robot,x,y\n0,a,1,2\n1,a,,2\n",
        "t,robot,x,y\n0,a,1,2\n1,,1,2\n",
        "t,robot,x,y\n0,a,1,2\n1,a,1\n",
        "t,robot,x,y\n0,a,1,2\n1,a,nan,2\n",
        "t,robot,x,y\n0,a,1,2\n1,a,1e13,2\n",
        "t,robot,x,y\n1,a,1,2\n0,a,1,2\n",
        "t,robot,x,x\n0,a,1,2\n",
        "t,robot,x,y\n",
        "t;robot;x;y\n0;a;1,5;2\n",
    ],
)
def test_mistakes_in_large_files_have_the_same_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(LogError) as plain:
        read_csv(path)
    monkeypatch.setattr(large_csv, "LARGE", 0)
    with pytest.raises(LogError) as fast:
        read_csv(path)
    assert str(fast.value) == str(plain.value)


def test_figures_of_long_logs_read_what_they_draw(tmp_path: Path, log: Path) -> None:
    """A name of several lines, and more samples than a figure is wide. What is not drawn may be anything."""
    observed(log, tmp_path / "o", CONFIG)
    results, robots = tmp_path / "o" / "r", ['"a\nb"', "c"]
    regions = (results / "regions.json").read_text().replace("bob, jr", "a\\nb").replace("ann", "c")
    (results / "regions.json").write_text(regions)
    header, *_ = (results / "estimates.csv").read_text().splitlines()
    columns = header.split(",")
    times = 2 * MOST_POINTS

    def line(k: int, robot: str) -> str:
        cells = {"t": str(k) if k % 2 else "not a number", "robot": robot, "case": "A", "diameter": "1"}
        return ",".join(cells.get(column, "") for column in columns)

    lines = [line(k, robot) for k in range(times) for robot in robots]
    (results / "estimates.csv").write_text("\n".join([header, *lines]) + "\n")
    x, seen = np.zeros((2, 2, 2)), np.ones((2, 2), dtype=bool)
    assert len(draw_observation(results, x, seen, ["a\nb", "c"])) == 2
