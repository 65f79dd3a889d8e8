"""Unicycles: commands come back from poses, errors stay within their bounds, and what poses do not say is not used."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.bag_writer import odometry, pose, transforms, write_bag, yawed
from tests.unicycle_teams import AHEAD, DT, LOOK, MAPS, MODEL, SI, WHEELS, Run, driven, write_poses
from torchfsid.cli import main
from torchfsid.commands.check import check
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.observe import Observation
from torchfsid.config.documents import validate
from torchfsid.config.observe import ObserveConfig
from torchfsid.errors import ConfigError, LogError
from torchfsid.logs.log import Log
from torchfsid.logs.read import read_log
from torchfsid.logs.table_log import read_csv, read_parquet

EXACT = 1e-11
KINDS = list(MAPS)


def config(body: dict | None, noise: dict | None = None, **others: object) -> ObserveConfig:
    section = {} if body is None else {"body": body, "velocity": "differentiated"}
    return validate({**MODEL, **section, "noise": noise or {"velocity": 0.02}, **others}, ObserveConfig, "test")


def declared(run: Run, body: dict, path: Path, noise: dict | None = None) -> DeclaredLog:
    return DeclaredLog(config(body, noise), read_csv(write_poses(path / "log.csv", run.t, run.poses), "theta"))


def observed(model: DeclaredLog, out: Path) -> Observation:
    observation = Observation(model)
    observation.run(out)
    return observation


def errors(model: DeclaredLog, run: Run) -> np.ndarray:
    assert model.log.u is not None
    return np.linalg.norm(model.log.u - run.u[:-1].numpy(), axis=-1)


# The formulas.


@pytest.mark.parametrize("arcs", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_commands_come_back_and_limits_are_recognised(kind, arcs, tmp_path):
    run = driven(kind, 4, arcs)
    model = declared(run, {**MAPS[kind][1], **WHEELS}, tmp_path)
    known, limited = model.log.velocity_known, run.limited[:-1].numpy()
    assert errors(model, run)[known].max() < EXACT
    assert not (known & limited).any()
    assert (~known & ~limited).mean() < 0.005
    assert model.recovery is not None
    assert model.recovery.is_arc == arcs
    assert [counts[1] for counts in model.recovery.counts.values()] == [
        pytest.approx(count, abs=2) for count in limited.sum(axis=0).tolist()
    ]


@pytest.mark.parametrize("kind", ["plain", "ahead"])
def test_a_wheel_limit_that_nobody_declared_is_seen(kind, tmp_path):
    run = driven(kind, 4)
    model = declared(run, MAPS[kind][1], tmp_path)
    known, limited = model.log.velocity_known, run.limited[:-1].numpy()
    assert limited.sum() > 2
    assert not (known & limited).any()
    assert (~known & ~limited).mean() < 0.005
    assert model.recovery is not None
    assert "seems to be one: 0.2, with wheel_base: 0.11" in model.recovery.sentence()


@pytest.mark.parametrize("kind", ["plain", "ahead"])
def test_without_wheel_limits_none_are_seen(kind, tmp_path):
    run = driven(kind, 4, wheels=False)
    model = declared(run, MAPS[kind][1], tmp_path)
    assert model.recovery is not None
    assert model.log.velocity_known.mean() > 0.995
    assert "seems" not in model.recovery.sentence()
    inexact = declared(run, MAPS[kind][1], tmp_path, {"velocity": 0.02, "position": 1e-4})
    assert inexact.recovery is not None
    assert "so none is recognised" in inexact.recovery.sentence()


@pytest.mark.parametrize(
    ("position", "heading", "arcs"), [(1e-5, 0.0, False), (0.0, 1e-3, True), (3e-4, 2e-3, True), (1e-3, 0.02, False)]
)
@pytest.mark.parametrize("kind", KINDS)
def test_errors_of_poses_stay_within_the_bounds(kind, position, heading, arcs, tmp_path):
    """Positions and headings are wrong by their bounds, in random directions."""
    run, generator = driven(kind, 4, arcs), torch.Generator().manual_seed(5)
    turn = 2 * math.pi * torch.rand(run.poses.shape[:2], generator=generator, dtype=torch.float64)
    sign = torch.randint(0, 2, turn.shape, generator=generator) * 2 - 1
    wrong = torch.stack([position * turn.cos(), position * turn.sin(), heading * sign], dim=-1)
    noise = {"velocity": 0.0, "position": position, "heading": heading}
    model = declared(replace(run, poses=run.poses + wrong), {**MAPS[kind][1], **WHEELS}, tmp_path, noise)
    known, found = model.log.velocity_known, errors(model, run)
    assert model.log.velocity_error is not None
    assert model.log.position_error is not None
    assert not (known & run.limited[:-1].numpy()).any()
    assert (found <= model.log.velocity_error + EXACT)[known].all()
    if known.any():
        assert (found / np.maximum(model.log.velocity_error, EXACT))[known].max() > 0.3
    shift = AHEAD if kind in ("ahead", "clipped") else 0.0
    e = torch.stack([run.poses[..., 2].cos(), run.poses[..., 2].sin()], dim=-1)
    apart = np.linalg.norm(model.log.x - (run.poses[..., :2] + shift * e)[:-1].numpy(), axis=-1)
    assert (apart <= position + model.log.position_error + EXACT).all()


# Sets.


@pytest.mark.parametrize("kind", ["plain", "ahead"])
def test_sets_are_those_of_the_logged_commands(kind, tmp_path):
    """The Robotarium's gains, four robots, a bound of 0.02 m/s: with the heading the diameter is below 0.06 m."""
    run = driven(kind, 4)
    found = observed(declared(run, {**MAPS[kind][1], **WHEELS}, tmp_path), tmp_path)
    assert found.sets.feasible_set.contains(run.goals).all()
    e = torch.stack([run.poses[..., 2].cos(), run.poses[..., 2].sin()], dim=-1)
    x = (run.poses[..., :2] + (AHEAD if kind == "ahead" else 0.0) * e).numpy()
    seen = np.ones(x.shape[:2], dtype=bool)
    logged = Log("logged", found.log.bodies, np.array(run.t), x, run.u.numpy(), seen, seen)
    best = observed(DeclaredLog(config(None), logged), tmp_path)
    for verdict, reference in zip(found.verdicts(), best.verdicts(), strict=True):
        assert verdict.status == "ok"
        assert verdict.diameter < min(0.06, 1.03 * reference.diameter)


def test_errors_of_poses_widen_sets_that_keep_the_truth(tmp_path):
    run, generator = driven("plain", 4), torch.Generator().manual_seed(1)
    bounds = torch.tensor([1e-4, 1e-4, 1e-3], dtype=torch.float64) / math.sqrt(2)
    wrong = bounds * (2 * torch.rand(run.poses.shape, generator=generator, dtype=torch.float64) - 1)
    noise = {"velocity": 1e-6, "position": 1e-4, "heading": 1e-3}
    model = declared(replace(run, poses=run.poses + wrong), {**SI, **WHEELS}, tmp_path, noise)
    found = observed(model, tmp_path)
    assert found.sets.feasible_set.contains(run.goals).all()
    assert all(verdict.status == "ok" and verdict.diameter < 0.1 for verdict in found.verdicts())


@pytest.mark.parametrize(("body", "is_left_out"), [(SI, True), (LOOK, False)])
def test_the_filter_is_left_out_where_positions_do_not_follow_commands(body, is_left_out, tmp_path):
    run = driven("plain" if body is SI else "ahead", 4)
    path = write_poses(tmp_path / "log.csv", run.t, run.poses)
    model = Observation(DeclaredLog(config(body, ukf={}), read_csv(path, "theta")))
    assert (model.observer is model.sets) == is_left_out


def test_check_asks_for_headings_where_positions_explain_nothing(tmp_path):
    run = driven("plain", 4)
    path = write_poses(tmp_path / "log.csv", run.t[:80], run.poses[:80])
    blind = check(DeclaredLog(config(None, velocity="differentiated"), read_csv(path))).conclusions()
    assert any("log their headings and declare the body" in line for line in blind)
    seeing = check(DeclaredLog(config({**SI, **WHEELS}), read_csv(path, "theta"))).conclusions()
    assert seeing[0].startswith("unicycles, by straight steps")
    assert "the log is consistent with the declared model" in seeing[1]
    assert not any("headings" in line for line in seeing)


# Files.


def bag_of(run: Run, path: Path, delays: tuple[int, ...]) -> tuple[Path, dict]:
    """The run as Odometry, PoseStamped and transforms; `delays` shift the stamps of robots [ns]."""
    stamps = [round(t * 1e9) for t in run.t]
    topics: dict[str, list[object]] = {"/a": [], "/b": [], "/tf": []}
    for stamp, poses in zip(stamps, run.poses.tolist(), strict=True):
        (xa, ya, a), (xb, yb, b), (xc, yc, c), (xd, yd, d) = poses
        topics["/a"].append(odometry(stamp + delays[0], (xa, ya), (0, 0, 0), yawed(a)))
        topics["/b"].append(pose(stamp + delays[1], (xb, yb), orientation=yawed(b)))
        topics["/tf"].append(transforms(stamp + delays[2], {"c": (xc, yc)}, orientation=yawed(c)))
        topics["/tf"].append(transforms(stamp + delays[3], {"d": (xd, yd)}, orientation=yawed(d)))
    bag = {"topics": {"/a": "r0", "/b": "r1"}, "frames": {"c": "r2", "d": "r3"}}
    return write_bag(path / "bag", topics), bag


@pytest.mark.parametrize("body", [SI, LOOK])
def test_bags_give_the_heading_from_the_orientation(body, tmp_path):
    run = driven("plain" if body is SI else "ahead", 4)
    path, bag = bag_of(run, tmp_path, (0, 0, 0, 0))
    settings = config({**body, **WHEELS}, bag=bag)
    of_bag = DeclaredLog(settings, read_log(path, settings.bag, "theta")).log
    of_csv = declared(run, {**body, **WHEELS}, tmp_path).log
    for name in ("x", "u", "velocity_known"):
        np.testing.assert_allclose(getattr(of_bag, name), getattr(of_csv, name), atol=1e-10)


def test_poses_at_different_times_are_brought_together(tmp_path):
    """The commands of a robot are recovered at its own poses. What is between limited poses is not used."""
    run = driven("plain", 4)
    path, bag = bag_of(run, tmp_path, (0, 7_000_000, 13_000_000, 21_000_000))
    settings = config({**SI, **WHEELS}, bag=bag)
    found = observed(DeclaredLog(settings, read_log(path, settings.bag, "theta")), tmp_path)
    assert found.declared.recovery is not None
    assert [counts[1] for counts in found.declared.recovery.counts.values()] == run.limited[:-1].sum(dim=0).tolist()
    assert found.sets.feasible_set.contains(run.goals).all()
    assert all(verdict.status == "ok" and verdict.diameter < 0.06 for verdict in found.verdicts())
    steps = np.diff(run.u[:, 0].numpy(), axis=0)
    assert found.log.u is not None
    known = found.log.velocity_known[:, 0]
    np.testing.assert_allclose(found.log.u[known, 0], run.u[: len(known), 0].numpy()[known], atol=np.abs(steps).max())


def test_headings_are_turned_into_the_fixed_frame(tmp_path):
    """Odometry in a frame that is turned and moved, which a transform tells once."""
    run, yaw = driven("ahead", 4, wheels=False), 0.7
    c, s = math.cos(yaw), math.sin(yaw)
    turn = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    places = (run.poses[..., :2] - torch.tensor([1.0, 2.0])) @ turn  # R^T (x - p), written for rows
    topics: dict[str, list[object]] = {f"/r{j}/odom": [] for j in range(4)}
    for k, t in enumerate(run.t):
        for j in range(4):
            turned = yawed(run.poses[k, j, 2].item() - yaw)
            topics[f"/r{j}/odom"].append(odometry(round(t * 1e9), places[k, j].tolist(), (0, 0, 0), turned, "odom"))
    topics["/tf_static"] = [transforms(0, {"odom": (1.0, 2.0)}, "map", yawed(yaw))]
    bag = {"topics": {f"/r{j}/odom": f"r{j}" for j in range(4)}, "fixed_frame": "map"}
    settings = config(LOOK, bag=bag)
    log = DeclaredLog(settings, read_log(write_bag(tmp_path / "bag", topics), settings.bag, heading="theta")).log
    assert log.u is not None
    np.testing.assert_allclose(log.u[log.velocity_known], run.u[:-1].numpy()[log.velocity_known], atol=1e-9)
    np.testing.assert_allclose(log.x, declared(run, LOOK, tmp_path).log.x, atol=1e-9)


def test_rounded_poses_have_bounds_of_their_own(tmp_path):
    run = driven("plain", 4)
    path = write_poses(tmp_path / "log.csv", run.t, run.poses, digits=4)
    model = DeclaredLog(config({**SI, **WHEELS}), read_csv(path, "theta"))
    assert model.log.reading.rounding == pytest.approx({"position": 7.1e-5, "heading": 5e-5}, rel=0.01)
    assert model.log.velocity_error is not None
    known = model.log.velocity_known
    assert (errors(model, run) <= model.log.velocity_error)[known].all()
    assert known.mean() > 0.9


def test_a_body_without_headings_is_no_unicycle(tmp_path):
    """Its velocity is a difference. A unicycle without its heading for a while is not seen for that while."""
    run = driven("ahead", 4, wheels=False)
    poses = run.poses.clone()
    poses[:, 3, 2] = math.nan
    poses[50:60, 0, 2] = math.nan
    with_obstacle = config(LOOK, obstacles=["r3"])
    log = DeclaredLog(with_obstacle, read_csv(write_poses(tmp_path / "log.csv", run.t, poses), "theta")).log
    assert log.u is not None
    np.testing.assert_allclose(log.x[:, 3], poses[:-1, 3, :2].numpy())
    np.testing.assert_allclose(log.u[:, 3], poses[:, 3, :2].diff(dim=0).numpy() / DT, atol=1e-9)
    assert log.bridged is not None
    assert log.bridged[:, 0].nonzero()[0].tolist() == list(range(49, 60))  # from its last heading on


def test_parquet_has_empty_headings_as_nulls(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    columns = {"t": [0.0, 0.0, 0.1, 0.1], "robot": ["a", "b"] * 2, "x": [0.0] * 4, "y": [1.0] * 4}
    table = pa.table({**columns, "yaw": pa.array([0.5, None, 0.6, None], pa.float64())})
    pq.write_table(table, tmp_path / "log.parquet")
    log = read_parquet(tmp_path / "log.parquet", "yaw")
    assert log.with_headings == ("a",)
    assert log.heading is not None
    assert log.heading[:, 0].tolist() == [0.5, 0.6]


def test_the_command_line_counts_limited_poses(tmp_path, capsys):
    import yaml

    run = driven("plain", 4)
    path = write_poses(tmp_path / "log.csv", run.t[:40], run.poses[:40], heading="yaw")
    body = {**SI, **WHEELS, "heading": "yaw"}
    model = {**MODEL, "noise": {"velocity": 0.02}, "velocity": "differentiated", "body": body}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(model))
    assert main(["observe", str(path), "--config", str(tmp_path / "config.yaml"), "--out", str(tmp_path / "out")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "unicycles, by straight steps: the commands of" in shown
    assert "a wheel or the turn rate may be at its limit: r" in shown
    again = validate(yaml.safe_load((tmp_path / "out" / "config.yaml").read_text()), ObserveConfig, "again")
    assert again.body == config(body).body


# Refusals.


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"body": {"kind": "unicycle", "map": "look_ahead"}}, "body.distance: required key is missing"),
        ({"body": {**SI, "distance": 0.1}}, "body.distance: map 'si_to_uni' has none"),
        ({"body": {**LOOK, "linear_gain": 0.8}}, "body.linear_gain: map 'look_ahead' has none"),
        ({"body": {**SI, "wheel_limit": 0.2}}, "body.wheel_base: required key is missing, with wheel_limit"),
        ({"body": {**SI, "map": "polar"}}, "body.map"),
        ({"velocity": "logged"}, "velocity: commands of unicycles come from poses"),
        (
            {"body": None, "noise": {"velocity": 0.1, "heading": 0.1}},
            "noise.heading: robots have headings only with a body",
        ),
    ],
)
def test_wrong_sections_are_one_line(changes, message):
    sections = {**MODEL, "noise": {"velocity": 0.02}, "velocity": "differentiated", "body": SI, **changes}
    with pytest.raises(ConfigError) as caught:
        validate({key: value for key, value in sections.items() if value is not None}, ObserveConfig, "file")
    assert message in str(caught.value)
    assert str(caught.value).isprintable()


def test_wrong_headings_are_one_line(tmp_path):
    run = driven("plain", 4)
    path = write_poses(tmp_path / "log.csv", run.t, run.poses)
    with pytest.raises(LogError, match=r"line 1: body\.heading: no single 'yaw' in the header"):
        read_csv(path, "yaw")
    degrees = run.poses * torch.tensor([1.0, 1.0, 180 / math.pi], dtype=torch.float64)
    with pytest.raises(ConfigError, match="is across the headings: expected radians"):
        declared(replace(run, poses=degrees), SI, tmp_path)
    nameless = run.poses.clone()
    nameless[:, 2, 2] = math.nan
    with pytest.raises(ConfigError, match="robot 'r2' has no heading"):
        declared(replace(run, poses=nameless), SI, tmp_path)
    (tmp_path / "text.csv").write_text("t,robot,x,y,theta\n0,a,0,0,north\n1,a,0,0,north\n")
    with pytest.raises(LogError, match="line 2: column 'theta'"):
        read_csv(tmp_path / "text.csv", "theta")
