"""Parquet logs: the same log as the CSV file of the same rows, and the same clear line for whatever is wrong."""

import sys
from decimal import Decimal
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfsid.errors import LogError
from torchfsid.logs.log import Log
from torchfsid.logs.read import read_log
from torchfsid.logs.table_log import read_csv

COLUMNS = {
    "t": [0.0, 0.0, 0.1, 0.1],
    "robot": ["0", "1", "0", "1"],
    "x": [1.0, 9.0, 1.072, 8.928],
    "y": [5.1, 5.0, 5.0991, 5.0018],
    "vx": [0.72, -0.72, 0.71352, -0.71352],
    "vy": [-0.009, 0.018, -0.008919, 0.017838],
    "radius": [0.2, 0.25, 0.2, 0.25],
}
FIELDS = ("bodies", "t", "x", "u", "seen", "velocity_known", "radius")


def write(path: Path, columns: dict) -> Path:
    pq.write_table(pa.table(columns), path)
    return path


def refusal(path: Path) -> str:
    """The message in which reading must end: one printable line that begins with the file."""
    with pytest.raises(LogError) as caught:
        read_log(path)
    message = str(caught.value)
    assert message.isprintable(), message
    assert message.startswith(str(path))
    return message.removeprefix(str(path))


@pytest.fixture(scope="module")
def csv_log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    path = tmp_path_factory.mktemp("csv") / "log.csv"
    rows = [",".join(map(str, row)) for row in zip(*COLUMNS.values(), strict=True)]
    path.write_text("\n".join([",".join(COLUMNS), *rows]))
    return read_csv(path)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"robot": [0, 1, 0, 1]},
        {"robot": pa.array(["0", "1", "0", "1"]).dictionary_encode()},
        {"robot": pa.array([" 0", "1 ", "0", "1"], pa.large_string())},
        {"t": [Decimal("0.0"), Decimal("0.0"), Decimal("0.1"), Decimal("0.1")]},
        {"note": [None] * 4, "nested": [[1], [2], [], None]},
    ],
    ids=["plain", "whole numbers", "categories", "large text", "decimals", "other columns"],
)
def test_the_same_log_as_from_csv(csv_log, tmp_path, changes):
    log = read_log(write(tmp_path / "log.PARQUET", COLUMNS | changes))
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(log, name), getattr(csv_log, name))


def test_several_row_groups(csv_log, tmp_path):
    path = tmp_path / "log.parquet"
    pq.write_table(pa.table(COLUMNS), path, row_group_size=1)
    np.testing.assert_array_equal(read_log(path).x, csv_log.x)


WRONG = {
    " row 3: column 'x': expected a finite number of at most 1e+12, got nan": {"x": [1.0, 2.0, float("nan"), 1.0]},
    " row 2: column 'x': expected a finite number of at most 1e+12, got None": {"x": [1.0, None, 2.0, 1.0]},
    ": column 'x': expected numbers, it holds string": {"x": ["1", "2", "3", "4"]},
    ": column 't': expected numbers, it holds timestamp[ns]": {"t": pa.array([0, 0, 1, 1], pa.timestamp("ns"))},
    ": column 'vx': expected numbers, it holds bool": {"vx": [True, False, True, False]},
    ": column 'robot': expected text or whole numbers, it holds double": {"robot": [0.0, 1.0, 0.0, 1.0]},
    " row 4: column 'robot' is empty": {"robot": ["0", "1", "0", None]},
    " row 2: column 'robot': a name with a NUL: 'a\\x00b'": {"robot": ["0", "a\0b", "0", "a\0b"]},
    ": column 't': the median step is 5e+07 s; stamps in nanoseconds?": {"t": [0, 0, 50_000_000, 50_000_000]},
    " row 3: times must not decrease, got 0.05 after 0.1": {"t": [0.0, 0.1, 0.05, 0.1]},
    " row 2: robot '0' has another row at t = 0.0": {"robot": ["0", "0", "0", "1"]},
    " row 3: the radius of robot '0' changes from 0.2 to 0.3": {"radius": [0.2, 0.25, 0.3, 0.25]},
}


@pytest.mark.parametrize("expected", WRONG)
def test_a_mistake_is_named_by_row_and_column(tmp_path, expected):
    assert refusal(write(tmp_path / "log.parquet", COLUMNS | WRONG[expected])).startswith(expected)


def test_columns_that_are_missing_or_double(tmp_path):
    without = {name: values for name, values in COLUMNS.items() if name != "vy"}
    assert refusal(write(tmp_path / "a.parquet", without)).startswith(": no column 'vy', the header has ['t', 'robot',")
    double = pa.table([pa.array([0.0])] * 4, names=["t", "x", "x", "y"])
    pq.write_table(double, tmp_path / "b.parquet")
    assert refusal(tmp_path / "b.parquet").startswith(": no column 'robot'")
    pq.write_table(pa.table([*COLUMNS.values(), COLUMNS["x"]], names=[*COLUMNS, "x"]), tmp_path / "c.parquet")
    assert refusal(tmp_path / "c.parquet").startswith(": 2 columns are called 'x'")
    assert refusal(write(tmp_path / "d.parquet", {name: values[:0] for name, values in COLUMNS.items()})) == ": no rows"


def test_what_is_no_parquet(tmp_path):
    (tmp_path / "text.parquet").write_text("t,robot,x,y\n")
    assert refusal(tmp_path / "text.parquet").startswith(": not valid Parquet: ")
    assert refusal(tmp_path / "none.parquet") == ": cannot be read: No such file or directory"
    (tmp_path / "folder.parquet").mkdir()
    assert "a folder without metadata.yaml is not a ROS bag" in refusal(tmp_path / "folder.parquet")


def test_without_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    path = write(tmp_path / "log.parquet", COLUMNS)
    assert refusal(path) == ": Parquet needs an extra: pip install 'torchfsid[parquet]'"


@settings(deadline=None, derandomize=True, max_examples=200)
@given(data=st.data())
def test_damaged_files_are_one_line(tmp_path_factory, data):
    """Cut off, overwritten, with bytes missing, or a single byte changed."""
    path = write(tmp_path_factory.mktemp("damaged") / "log.parquet", COLUMNS)
    content = path.read_bytes()
    first, second = sorted(data.draw(st.tuples(*[st.integers(0, len(content))] * 2)))
    damage = data.draw(st.sampled_from([b"", b"\xff" * (second - first), b"\x00" * (second - first), b"end", None]))
    if damage is None:
        second, damage = first + 1, data.draw(st.binary(min_size=1, max_size=1))
    path.write_bytes(content[:first] + damage + content[second:])
    message, log = "", None
    try:
        log = read_log(path)
    except LogError as error:
        message = str(error)
    assert message.isprintable()
    if log is not None:
        assert np.isfinite(log.x).all()
        assert (np.diff(log.t) > 0).all()
