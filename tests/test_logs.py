"""Logs: what is read is what was written, masks say what is unknown, a wrong file is refused with one clear line."""

import csv
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfsid.errors import LogError
from torchfsid.logs.log import Log
from torchfsid.logs.table_log import read_csv
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance

IRSIM = """t,robot,x,y,vx,vy,radius
0,0,1,5.1,0.72,-0.009,0.2
0,1,9,5,-0.72,0.018,0.2
0.1,0,1.072,5.0991,0.71352,-0.008919,0.2
0.1,1,8.928,5.0018,-0.71352,0.017838,0.2
"""

GAPS = """t,robot,x,y,vx,vy
0,a,0,0,1,0
0,b,5,0,2,0
1,a,1,0,1,0
2,a,2,0,1,0
2,b,9,0,2,0
3,a,3,0,1,0
3,b,11,0,2,0
"""

repeatable = settings(deadline=None, derandomize=True)


@pytest.fixture
def write(tmp_path):
    def write_text(text: str | bytes, name: str = "log.csv"):
        path = tmp_path / name
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    return write_text


def refusal(path) -> str:
    """The message of the `LogError` that reading must end in: one printable line."""
    with pytest.raises(LogError) as caught:
        read_csv(path)
    message = str(caught.value)
    assert message.isprintable(), message
    return message


# What a file means.


def test_a_sample(write):
    log = read_csv(write(IRSIM))
    assert log.bodies == ("0", "1")
    assert log.t.tolist() == [0.0, 0.1]
    assert log.x.tolist() == [[[1, 5.1], [9, 5]], [[1.072, 5.0991], [8.928, 5.0018]]]
    assert log.u is not None
    assert log.u.tolist() == [[[0.72, -0.009], [-0.72, 0.018]], [[0.71352, -0.008919], [-0.71352, 0.017838]]]
    assert log.radius is not None
    assert log.radius.tolist() == [0.2, 0.2]
    assert log.seen.all()
    assert log.velocity_known.all()


def test_a_body_without_a_row_is_not_there(write):
    log = read_csv(write(GAPS))
    assert log.bodies == ("a", "b")
    assert log.seen.tolist() == [[True, True], [True, False], [True, True], [True, True]]
    assert log.x[1, 1].tolist() == [0, 0]
    assert log.radius is None
    assert log.previous_known.tolist() == [[False, False], [True, True], [True, False], [True, True]]


@pytest.mark.parametrize(
    "same",
    [
        IRSIM.replace("\n", "\r\n"),
        "\ufeff" + IRSIM,
        IRSIM + "\n\n  \n",
        IRSIM.rstrip("\n"),
        IRSIM.replace("t,robot", '"t","robot"').replace("0,0,1", '"0","0","1"'),
        IRSIM.replace(",", " , "),
        "\n".join(f"{line},note {i}" for i, line in enumerate(IRSIM.splitlines())),
        "\n".join(",".join(reversed(line.split(","))) for line in IRSIM.splitlines()),
    ],
    ids=[
        "crlf",
        "byte order mark",
        "blank lines",
        "no last newline",
        "quotes",
        "spaces",
        "other column",
        "other order",
    ],
)
def test_the_same_log_in_other_clothes(write, same):
    one, other = read_csv(write(IRSIM)), read_csv(write(same, "other.csv"))
    for name in ("t", "x", "u", "seen", "velocity_known", "radius"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.bodies == other.bodies


name = st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1).map(str.strip).filter(bool)


@st.composite
def logs(draw) -> dict:
    """The fields of a log; every time has a body and every body a time, as in a file."""
    bodies = tuple(draw(st.lists(name, unique=True, min_size=1, max_size=4)))
    times = draw(st.lists(st.floats(0, 1e4), unique=True, min_size=2, max_size=6).map(sorted))
    n = draw(st.sampled_from([2, 3]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    seen = rng.random((len(times), len(bodies))) < 0.7
    seen[0], seen[:, 0] = True, True
    x, u = np.where(seen[..., None], rng.normal(size=(2, *seen.shape, n)), 0.0)
    has_velocities = draw(st.booleans())
    return {
        "source": "drawn",
        "bodies": bodies,
        "t": np.array(times),
        "x": x,
        "u": u if has_velocities else None,
        "seen": seen,
        "velocity_known": seen if has_velocities else np.zeros_like(seen),
        "radius": rng.random(len(bodies)) if draw(st.booleans()) else None,
    }


def write_csv(log: Log, path) -> None:
    axes = "xyz"[: log.x.shape[-1]]
    velocities = [f"v{axis}" for axis in axes] if log.u is not None else []
    with open(path, "w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(["t", "robot", *axes, *velocities, *(["radius"] if log.radius is not None else [])])
        for k, j in np.argwhere(log.seen):
            u = [] if log.u is None else log.u[k, j].tolist()
            radius = [] if log.radius is None else [log.radius[j]]
            out.writerow([float(log.t[k]), log.bodies[j], *log.x[k, j].tolist(), *u, *radius])


@repeatable
@given(fields=logs())
def test_what_is_written_is_read(fields, tmp_path_factory):
    log = Log(**fields)
    path = tmp_path_factory.getbasetemp() / "written.csv"
    write_csv(log, path)
    read = read_csv(path)
    assert read.bodies == log.bodies
    for field in ("t", "x", "u", "seen", "velocity_known", "radius"):
        np.testing.assert_array_equal(getattr(read, field), getattr(log, field))


def test_reading_does_not_wait_for_torch():
    code = "import sys, torchfsid.logs; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# Velocities from differences.


@repeatable
@given(fields=logs())
def test_differences_are_exact_under_a_zero_order_hold(fields):
    """x(t+) = x + (t+ - t) u gives back u wherever both ends are seen, and nothing elsewhere."""
    log = Log(**fields)
    times = np.cumsum(np.full(len(log.t), 0.02) + 0.1 * (log.t % 1))  # uneven, and far above round-off
    u = np.random.default_rng(0).normal(size=log.x.shape)
    moves = np.concatenate([np.zeros_like(u[:1]), np.cumsum(u[:-1] * np.diff(times)[:, None, None], axis=0)])
    held = replace(log, t=times, x=np.where(log.seen[..., None], moves, 0.0)).differentiated()

    known = log.seen[:-1] & log.seen[1:]
    np.testing.assert_array_equal(held.velocity_known, known)
    np.testing.assert_array_equal(held.seen, log.seen[:-1])
    np.testing.assert_array_equal(held.t, times[:-1])
    assert held.u is not None
    np.testing.assert_allclose(held.u, np.where(known[..., None], u[:-1], 0.0), atol=1e-12)


def test_differences_that_overflow(write):
    log = read_csv(write("t,robot,x,y\n-1,a,0,0\n0,a,0,0\n1e-300,a,1e12,0\n"))
    with pytest.raises(LogError, match=r"no finite velocities from t = 0\.0 to 1e-300"):
        log.differentiated()


# Measurements.


def test_measurements_of_some_robots_among_all_bodies(write):
    log = read_csv(write(GAPS))
    first, second, third, fourth = log.measurements(["b", "a"], {"none"})
    assert [m.t for m in (first, second, third, fourth)] == [0, 1, 2, 3]
    assert first.x.tolist() == [[5, 0], [0, 0]]
    assert first.u is not None
    assert first.u.tolist() == [[2, 0], [1, 0]]
    assert first.present.tolist() == [[True, False], [False, True]]
    assert second.present.tolist() == [[True, False], [False, False]]
    assert second.observed is not None
    assert second.observed.tolist() == [False, True]
    assert third.previous_body_velocities is not None
    assert third.previous_body_velocities[0].tolist() == [[1, 0], [0, 0]]
    assert third.radius is None


def test_radii_reach_the_barriers(write):
    log = read_csv(write(IRSIM))
    barrier = CollisionAvoidance(ClassK(1.0), margin=0.1, neighbour_velocity="previous")
    of_all = CollisionAvoidance(ClassK(1.0), safety_distance=0.5, neighbour_velocity="previous")
    for measurement in log.measurements(["0", "1"], {"previous"}):
        torch.testing.assert_close(barrier(measurement).b, of_all(measurement).b)


@repeatable
@given(fields=logs(), modes=st.sets(st.sampled_from(["none", "current", "previous"])))
def test_a_robot_is_observed_only_where_its_rows_are_known(fields, modes):
    """Written out body by body, over logs of positions alone, where velocities are missing in more ways."""
    log = Log(**fields)
    positions = replace(log, t=np.arange(len(log.t), dtype=float)).differentiated()
    known, seen = positions.velocity_known, positions.seen
    for k, measurement in enumerate(positions.measurements(positions.bodies, modes)):
        for i in range(len(positions.bodies)):
            expected = known[k, i]
            for j in range(len(positions.bodies)):
                if seen[k, j] and "current" in modes:
                    expected &= known[k, j]
                if seen[k, j] and "previous" in modes:
                    expected &= k > 0 and known[k - 1, j]
            assert measurement.observed is not None
            assert measurement.observed[i] == expected


def test_nothing_is_observed_without_the_leader(write):
    log = read_csv(write(GAPS))
    observed = [m.observed.tolist() for m in log.measurements(["a"], (), required=["b"]) if m.observed is not None]
    assert observed == [[True], [False], [True], [True]]


def test_what_the_log_does_not_have(write):
    log = read_csv(write("t,robot,x,y\n0,a,0,0\n1,a,0,0\n"))
    with pytest.raises(LogError, match=r"log\.csv: no velocities \(vx, vy\)"):
        log.measurements(["a"], ())
    with pytest.raises(LogError, match="no body is called 'c'"):
        log.differentiated().measurements(["c"], ())
