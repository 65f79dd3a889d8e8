"""Logs that are refused: one clear line, which names the file, the line, the column."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.test_logs import GAPS
from torchfsid.errors import LogError
from torchfsid.logs.log import Log
from torchfsid.logs.table_log import read_csv
from torchfsid.logs.units import require_units

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
    HEADER + ROW + "1,a,1_0.0,2,3,4\n": " line 3: column 'x': expected a finite number of at most 1e+12, got '1_0.0'",
    HEADER + ROW + "1,a,1,٣,3,4\n": " line 3: column 'y': expected a finite number of at most 1e+12, got '٣'",
    HEADER + ROW + "1_0,a,1,2,3,4\n": " line 3: column 't': expected a finite number of at most 1e+12, got '1_0'",
    HEADER + ROW + "1,a\0,1,2,3,4\n": " line 3: column 'robot': a name with a NUL: 'a\\x00'",
    HEADER + ROW + "50000000,a,1,2,3,4\n": (
        " line 1: column 't': the median step is 5e+07 s; stamps in nanoseconds? Expected seconds"
    ),
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


def test_a_pause_is_no_other_unit(write):
    """It is the median step that tells."""
    log = read_csv(write(HEADER + "".join(f"{t},a,1,2,3,4\n" for t in (0, 0.1, 1e6, 1e6 + 0.1))))
    assert log.t.tolist() == [0, 0.1, 1e6, 1e6 + 0.1]


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


UNITS = {"t in milliseconds": (1e3, 1), "positions in millimetres": (1, 1e3)}


@pytest.mark.parametrize("told", [*UNITS, None])
def test_times_in_milliseconds(write, told: str | None) -> None:
    """A robot on a circle, and one that stands, with errors of positions and velocities."""
    of_time, of_position = UNITS.get(told or "", (1, 1))
    rng, lines = np.random.default_rng(3), []
    for k in range(40):
        t, (dx, dy), (du, dv) = 0.02 * k, rng.normal(0, 1e-4, 2), rng.normal(0, 0.01, 2)
        x, y = of_position * np.array([np.cos(t) + dx, np.sin(t) + dy])
        lines.append(f"{of_time * t},a,{x},{y},{-np.sin(t) + du},{np.cos(t) + dv}")
        lines.append(f"{of_time * t},b,{of_position * dx},{of_position * dy},{du},{dv}")
    path = write(HEADER + "\n".join(lines) + "\n")
    if told is None:
        assert len(read_csv(path).t) == 40
    else:
        assert refusal(path).endswith(f"times the ways between positions: {told}?")


RIGHT = {
    "put back a thousand steps away": lambda rng: (0.01, 0.003 * (np.arange(12_000) % 1000), 0.3),
    "held by a wall": lambda rng: (0.1, rng.normal(0, 5e-5, (40, 3)), 1.0),
    "slow, with large errors": lambda rng: (1e-3, rng.normal(0, 0.025, (40, 3)), 0.05),
    "slow, rounded to centimetres": lambda rng: (0.01, np.round(1e-5 * np.arange(12_000), 2), 1e-3),
}


@pytest.mark.parametrize("told", RIGHT)
def test_units_that_fit(told: str) -> None:
    """Ways that are a thousand times as long, or as short, as velocities tell, of no wrong unit."""
    dt, places, speed = RIGHT[told](np.random.default_rng(1))
    places = places if places.ndim == 2 else np.stack([places, 0 * places], axis=-1)
    x, there = places[:, None], np.ones((len(places), 1), dtype=np.bool_)
    u = np.broadcast_to(speed * np.eye(1, x.shape[-1]), x.shape)
    require_units(Log("a log", ("a",), dt * np.arange(len(x)), x, u, there, there))
