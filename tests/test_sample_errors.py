"""Bounds on the errors of each sample: columns, covariances, rounding."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.bag_writer import odometry, write_bag, yawed
from tests.test_gaps import BODIES, ROBOTS, TASK, crossing, log_of, observed
from torchfsid.cli import main
from torchfsid.config.bags import BagConfig
from torchfsid.errors import LogError
from torchfsid.logs.bags import read_bag
from torchfsid.logs.gaps import bridged
from torchfsid.logs.log import Log
from torchfsid.logs.reading import NEGLIGIBLE, half_units
from torchfsid.logs.table_log import read_csv
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.sets.feasible_set import FeasibleSet

HEADER = "t,robot,x,y,vx,vy,position_error,velocity_error\n"
EXACT = "0.12345678901234567"
"""A number with all digits: the columns beside it are not rounded."""


def csv_log(folder: Path, text: str) -> Log:
    path = folder / "log.csv"
    path.write_text(text)
    return read_csv(path)


def test_columns_of_errors_and_a_position_without_a_velocity(tmp_path):
    rows = f"0,a,{EXACT},1,{EXACT},2,0.01,0.1\n0,b,1,1,,,0.02,\n1,a,0,1,1,2,0,0\n1,b,1,1,0.5,0.5,0,0.3\n"
    log = csv_log(tmp_path, HEADER + rows)
    assert log.position_error is not None
    assert log.velocity_error is not None
    assert log.u is not None
    assert log.position_error.tolist() == [[0.01, 0.02], [0, 0]]
    assert log.velocity_error.tolist() == [[0.1, 0], [0, 0.3]]
    assert log.velocity_known.tolist() == [[True, False], [True, True]]
    assert log.seen.all()
    assert log.u[0, 1].tolist() == [0, 0]
    first, second = log.measurements(["a", "b"], {"none"})
    assert first.observed is not None
    assert first.observed.tolist() == [True, False]
    assert first.present.tolist() == [[False, True], [True, False]]
    assert second.velocity_error is not None
    assert second.velocity_error.tolist() == [0, 0.3]
    joint = next(log.measurements(["a", "b"], {"current"}))
    assert joint.observed is not None
    assert not joint.observed.any()


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        ("0,a,1,1,,2,0,0", "column 'vx' is empty, and other columns of this velocity are not"),
        ("0,a,1,1,1,2,-1,0", "column 'position_error': expected a bound >= 0, got -1.0"),
        ("0,a,1,1,1,2,0,", "column 'velocity_error': expected a bound >= 0, got nothing"),
        ("0,a,1,1,1,2,,0", "column 'position_error': expected a finite number of at most 1e+12, got ''"),
    ],
)
def test_wrong_errors(tmp_path, row, expected):
    with pytest.raises(LogError, match=r"log\.csv line 2: ") as caught:
        csv_log(tmp_path, f"{HEADER}{row}\n1,a,1,1,1,2,0,0\n")
    assert expected in str(caught.value)
    with pytest.raises(LogError, match="line 1: column 'velocity_error' without a velocity"):
        csv_log(tmp_path, "t,robot,x,y,velocity_error\n0,a,0,0,1\n1,a,0,0,1\n")


def test_rows_that_repeat_another_one(tmp_path):
    text = f"t,robot,x,y\n0,a,{EXACT},1\n0,b,1,1\n0,a,{EXACT},1\n1,a,0,0\n1,b,0,0\n"
    log = csv_log(tmp_path, text)
    assert log.seen.all()
    assert log.reading.to_json() == {"duplicates": 1}


def test_errors_of_differences_and_in_gaps():
    """Positions that are wrong by up to their bounds: velocities and interpolated positions are within theirs."""
    run, _ = crossing(CollisionAvoidance(ClassK(2.0), safety_distance=0.6))
    rng = np.random.default_rng(1)
    seen = rng.random(run.x.shape[:2]) > 0.15
    seen[0] = seen[-1] = True
    truth = log_of(run, np.ones_like(seen))
    bound = 1e-3 * rng.random(seen.shape)
    turn = rng.uniform(0, 2 * np.pi, seen.shape)
    x = truth.x + bound[..., None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    measured = replace(truth, x=x, position_error=bound)
    assert truth.u is not None
    whole = measured.differentiated()
    assert whole.u is not None
    assert whole.velocity_error is not None
    assert (np.linalg.norm(whole.u - truth.u[:-1], axis=-1) <= whole.velocity_error + 1e-9).all()
    assert np.linalg.norm(whole.u - truth.u[:-1], axis=-1).max() > 0.01

    holes = replace(
        measured, x=np.where(seen[..., None], x, 0), seen=seen, velocity_known=seen, position_error=bound * seen
    )
    filled = bridged(holes)
    assert filled.position_error is not None
    off = np.linalg.norm(filled.x - truth.x, axis=-1)
    assert (off <= filled.position_error + 1e-12).all()


# Rounding.


@pytest.mark.parametrize("form", [".0f", ".3f", ".6f", ".4g", ".8g", ".3e", "r", "stripped"])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 300.0])
def test_half_a_unit_covers_the_error_of_rounding(form, scale):
    values = scale * np.random.default_rng(0).standard_normal(300)
    written = {"r": repr, "stripped": lambda v: repr(round(v, 6))}.get(form, lambda v: format(v, form))
    texts = [written(value) for value in values.tolist()]
    read = np.array([float(text) for text in texts])
    bounds = half_units(texts, read)
    if form == ".0f":  # whole numbers count as exact
        assert not bounds.any()
        return
    assert (np.abs(read - values) <= bounds * (1 + 1e-9) + NEGLIGIBLE / 2).all()
    assert bounds.max() <= (1 if form == "r" else 20) * np.abs(read - values).max() + 1e-12


def test_six_decimals_alone_break_a_bound_of_1e_6(tmp_path):
    barrier = CollisionAvoidance(ClassK(2.0), safety_distance=0.6)
    run, goals = crossing(barrier)
    with (tmp_path / "log.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["t", "robot", "x", "y", "vx", "vy"])
        for k, t in enumerate(run.t.tolist()):
            for j, body in enumerate(BODIES):
                rows.writerow([t, body, *(f"{v:.6f}" for v in [*run.x[k, j].tolist(), *run.u[k, j].tolist()])])
    log = read_csv(tmp_path / "log.csv")
    assert log.reading.rounding == pytest.approx({"position": 5e-7 * 2**0.5, "velocity": 5e-7 * 2**0.5})

    def watched(log: Log) -> SetMembershipObserver:
        prior = FeasibleSet.from_box(torch.full((ROBOTS, 2), -6.0), torch.full((ROBOTS, 2), 6.0))
        watching = SetMembershipObserver(TASK, [barrier], prior, noise=NoiseBound(1e-6))
        for measurement in log.measurements(BODIES[:ROBOTS], {"none"}):
            watching.update(measurement)
        return watching

    told, ignored = watched(log), watched(replace(log, position_error=None, velocity_error=None))
    assert told.status.tolist() == [Status.OK] * ROBOTS
    assert told.feasible_set.contains(goals).all()
    assert not (ignored.feasible_set.contains(goals) & (ignored.status == Status.OK)).all()
    exact = log_of(run, np.ones(run.x.shape[:2], dtype=bool))
    assert observed(exact, barrier).status.tolist() == [Status.OK] * ROBOTS


def test_rounding_is_printed_and_recorded(tmp_path, capsys):
    (tmp_path / "log.csv").write_text("t,robot,x,y,vx,vy\n0,a,0.5,0,0.25,0\n1,a,0.75,0,0.25,0\n")
    (tmp_path / "config.yaml").write_text(
        "task: {kind: goal, gain: 1.0}\nbarriers: [{kind: speed_box, limit: [9, 9]}]\nukf: false\n"
        "prior: {lower: [-5, -5], upper: [5, 5]}\nnoise: {velocity: 0.1}\n"
    )
    config = str(tmp_path / "config.yaml")
    for command in (["observe", "--out", str(tmp_path / "out")], ["check"]):
        assert main([*command, str(tmp_path / "log.csv"), "--config", config]) == 0
        assert "The log's decimals are rounded" in capsys.readouterr().out
    recorded = json.loads((tmp_path / "out" / "regions.json").read_text())["log"]["rounding"]
    assert recorded == pytest.approx({"position": 0.005 * 2**0.5, "velocity": 0.005 * 2**0.5})


# Covariances in bags.


def odometries(covariance: np.ndarray, yaw: float = 0.0) -> list[object]:
    return [
        odometry(k * 100_000_000, (0.1 * k, 0), (1, 0), yawed(yaw), covariance=covariance.flatten()) for k in range(5)
    ]


def test_covariances_become_bounds(tmp_path):
    covariance = np.diag([4e-4, 1e-4, 1e6, 1e6, 1e6, 9e-4])
    covariance[0, 1] = covariance[1, 0] = 1e-4
    path = write_bag(tmp_path / "bag", {"/odom": odometries(covariance, yaw=0.7)})
    spread = 3 * np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    log = read_bag(path, BagConfig(topics={"/odom": "r"}, covariance_multiple=3))
    np.testing.assert_allclose(log.position_error, np.full((5, 1), spread))
    np.testing.assert_allclose(log.velocity_error, np.full((5, 1), spread + 3 * 0.03))
    assert read_bag(path, BagConfig(topics={"/odom": "r"})).position_error is None


def test_covariances_between_samples(tmp_path):
    covariance = np.diag([4e-4, 4e-4, 0, 0, 0, 0])
    topics = {f"/{j}": odometries(covariance) for j in range(2)}
    topics["/1"] = [
        odometry(int((k - 0.5) * 1e8), (0.1 * k - 0.05, 1), (1, 0), covariance=covariance.flatten())
        for k in range(1, 7)
    ]
    log = read_bag(write_bag(tmp_path / "bag", topics), BagConfig(topics={"/0": "a", "/1": "b"}, covariance_multiple=2))
    assert log.position_error is not None
    np.testing.assert_allclose(log.position_error[1:], 0.04, atol=1e-9)
    apart = log.differentiated()
    assert apart.velocity_error is not None
    np.testing.assert_allclose(apart.velocity_error[apart.velocity_known], 0.8, atol=1e-6)


@pytest.mark.parametrize("covariance", [np.zeros((6, 6)), -np.eye(6)])
def test_a_covariance_that_is_not_there(tmp_path, covariance):
    path = write_bag(tmp_path / "bag", {"/odom": odometries(covariance)})
    with pytest.raises(LogError, match=r"topic '/odom': no covariance of the pose: declare noise instead"):
        read_bag(path, BagConfig(topics={"/odom": "r"}, covariance_multiple=3))
