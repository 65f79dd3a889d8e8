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
from torchfsid.logs.log import Log, read_csv
from torchfsid.robots.barriers import ClassK, CollisionAvoidance

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


name = st.text(st.characters(codec="utf-8"), min_size=1).map(str.strip).filter(bool)


@st.composite
def logs(draw) -> dict:
    """The fields of a log; every time has a body and every body a time, as in a file."""
    bodies = tuple(draw(st.lists(name, unique=True, min_size=1, max_size=4)))
    times = draw(st.lists(st.floats(0, 1e6), unique=True, min_size=2, max_size=6).map(sorted))
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


# What is refused, and how.

HEADER = "t,robot,x,y,vx,vy\n"
ROW = "0,a,1,2,3,4\n"
WRONG = {
    "": ": the file is empty",
    "\n\n": ": the file is empty",
    HEADER: " line 1: no rows after the header",
    "a,b,c\n1,2,3\n": " line 1: no column 't'",
    "t,x,y\n0,1,2\n": " line 1: no column 'robot'",
    "t;robot;x;y\n0;a;1;2\n": " line 1: no column 't', the header has ['t;robot;x;y']",
    "t,robot,x,y,vx\n0,a,1,2,3\n": " line 1: no column 'vy'",
    "t,robot,x,y,vy\n0,a,1,2,3\n": " line 1: no column 'vx'",
    "t,robot,x,y,z,vx,vy\n0,a,1,2,3,4,5\n": " line 1: no column 'vz'",
    "t,robot,x,y,vx,vy,vz\n0,a,1,2,3,4,5\n": " line 1: column 'vz' without 'z'",
    "t,robot,x,x,y\n0,a,1,2,3\n": " line 1: 2 columns are called 'x'",
    HEADER + ROW + "1,a,1,2,3\n": " line 3: expected 6 cells as in the header, got 5",
    HEADER + ROW + "1,a,1,2,3,4,5\n": " line 3: expected 6 cells as in the header, got 7",
    HEADER + ROW + "1,a,1,2,oops,4\n": " line 3: column 'vx': expected a finite number of at most 1e+12, got 'oops'",
    HEADER + ROW + "\n\n1,a,,2,3,4\n": " line 5: column 'x': expected a finite number of at most 1e+12, got ''",
    HEADER + ROW + "1,a,1,nan,3,4\n": " line 3: column 'y': expected a finite number of at most 1e+12, got 'nan'",
    HEADER + ROW + "1,a,1,-inf,3,4\n": " line 3: column 'y': expected a finite number of at most 1e+12, got '-inf'",
    HEADER + ROW + "1,a,1,2,3,1e999\n": " line 3: column 'vy': expected a finite number of at most 1e+12, got '1e999'",
    HEADER + ROW + "nan,a,1,2,3,4\n": " line 3: column 't': expected a finite number of at most 1e+12, got 'nan'",
    HEADER + ROW + "1, ,1,2,3,4\n": " line 3: column 'robot' is empty",
    HEADER + ROW + "1,b,1,2,3,4\n0.5,b,1,2,3,4\n": " line 4: times must not decrease, got 0.5 after 1.0",
    HEADER + ROW + "1,a,1,2,3,4\n0,b,1,2,3,4\n": " line 4: times must not decrease, got 0.0 after 1.0",
    HEADER + ROW + "0,b,1,2,3,4\n0.0,a,5,6,7,8\n1,a,1,2,3,4\n": " line 4: robot 'a' has another row at t = 0.0",
    HEADER + ROW + "0,b,1,2,3,4\n": " line 3: the log ends after a single time, t = 0.0",
    "t,robot,x,y,radius\n0,a,1,2,.1\n1,a,1,2,-1\n": " line 3: column 'radius': expected a number >= 0, got -1.0",
    "t,robot,x,y,radius\n0,b,1,2,1\n0,a,1,2,.1\n1,a,1,2,.2\n": (
        " line 4: the radius of robot 'a' changes from 0.1 to 0.2"
    ),
    HEADER + ROW + '1,"a\n': " line 3: not valid CSV",
    HEADER + ROW + '1,"a"b,1,2,3,4\n': " line 3: not valid CSV",
    b"t,robot,x,y\n0,\xff,1,2\n": ": not text in UTF-8",
    (HEADER + ROW).encode("utf-16"): ": not text in UTF-8",
}


@pytest.mark.parametrize("content", WRONG, ids=list(WRONG.values()))
def test_a_wrong_log_is_named_by_line_and_column(write, content):
    path = write(content)
    assert refusal(path).startswith(f"{path}{WRONG[content]}")


def test_lines_are_lines_of_the_file(write):
    """A quoted name may hold a line break: the line named is where the wrong record ends."""
    path = write(HEADER + '0,"a\nb",1,2,3,4\n1,c,1,2,x,4\n')
    assert refusal(path).startswith(f"{path} line 4: column 'vx'")


@pytest.mark.parametrize("path", ["missing.csv", "."])
def test_a_file_that_cannot_be_read(tmp_path, path):
    assert ": cannot be read: " in refusal(tmp_path / path)


def test_reading_does_not_wait_for_torch():
    code = "import sys, torchfsid.logs; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


cells = st.one_of(
    st.sampled_from(["t", "robot", "x", "y", "z", "vx", "vy", "vz", "radius", "", "nan", "1e999", '"', '"a"', "\x00"]),
    st.integers(0, 3).map(str),
    st.text(st.characters(codec="utf-8"), max_size=3),
)


def reads_or_refuses(path) -> None:
    message, log = "", None
    try:
        log = read_csv(path)
    except LogError as error:
        message = str(error)
    assert message.isprintable()
    if log is not None:
        assert np.isfinite(log.x).all()
        assert (np.diff(log.t) > 0).all()
        assert log.seen.any(axis=0).all()
        assert log.seen.any(axis=1).all()


@repeatable
@given(content=st.binary() | st.text(st.characters(codec="utf-8")).map(str.encode))
def test_any_bytes(content, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(content)
    reads_or_refuses(path)


@repeatable
@given(row=st.integers(0, 7), column=st.integers(0, 5), cell=cells)
def test_one_wrong_cell_in_a_right_log(row, column, cell, tmp_path_factory):
    rows = [line.split(",") for line in GAPS.splitlines()]
    rows[row][column] = cell
    path = tmp_path_factory.getbasetemp() / "cell.csv"
    path.write_text("\n".join(",".join(row) for row in rows), encoding="utf-8")
    reads_or_refuses(path)


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
