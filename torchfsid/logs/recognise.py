"""What kind of log is this? Recognised from the files, before anything is declared.

a folder with metadata.yaml, .mcap, .db3      a ROS 2 bag (`recognise_bags`)
.parquet, or a CSV with t, robot, x, y        a table of this package
first line Format Version, Objects, ..        an export of OptiTrack or Vicon
eight numbers a line, or a folder of those    TUM
any other CSV, or a folder of those           columns that come in pairs .. x, .. y after a column of times
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from torchfsid.config.bags import BagConfig
from torchfsid.config.motion_capture import LogConfig
from torchfsid.config.quantities import DECIMAL
from torchfsid.errors import LogError
from torchfsid.logs.recognise_bags import bag_section
from torchfsid.logs.tables import TUM_COLUMNS, VICON_SECTIONS, ParquetTable, Record, records_in

HEADINGS = ("theta", "yaw", "heading", "psi", "phi")
"""Names of columns of headings."""

TIMES = ("t", "time", "timestamp", "stamp", "seconds", "secs", "sec", "s", "ms", "us", "ns", "milliseconds")

AXES = {"east": "x", "north": "y", "up": "z", "yaw": "heading", "theta": "heading", "heading": "heading"}
"""What else the axes are called."""

NAMED = re.compile(
    r"(?P<owner>.*?)[\s._/:-]*(?:pos(?:ition)?)?[\s._/:-]*(?P<axis>v?[xyz]|east|north|up|yaw|theta|heading)",
    re.IGNORECASE,
)
"""The name of a column: the body, then the axis."""

UNIT = re.compile(r"[(\[]\s*([a-z]+)[^)\]]*[)\]]\s*$", re.IGNORECASE)
"""A unit at the end of a name, in brackets."""

LONGEST_SAMPLING = 2.0
"""Steps between times beyond which they are not in seconds [s]."""

SCANNED_LINES = 50
"""Lines among which the names of the columns are."""


@dataclass(frozen=True)
class Recognised:
    """What `read_log` has to be told of a log.

    Attributes:
        what: the kind of log, in words.
        bag: the section `bag` of a ROS bag.
        form: the section `log` of a log that is no table of this package.
        heading: the column of headings, if a table has one.
    """

    what: str
    bag: dict[str, Any] | None = None
    form: dict[str, Any] | None = None
    heading: str | None = None

    @property
    def has_poses(self) -> bool:
        """May it have orientations?"""
        return self.heading is not None or self.bag is not None or self.form is not None

    def sections(self) -> tuple[BagConfig | None, LogConfig | None]:
        """The sections, validated."""
        bag = None if self.bag is None else BagConfig.model_validate(self.bag)
        return bag, None if self.form is None else LogConfig.model_validate(self.form)


def recognise(path: Path) -> Recognised:
    """The kind of a log, and where its bodies are.

    Raises:
        LogError: it cannot be read, or nothing in it looks like positions of bodies.
    """
    suffix = path.suffix.lower()
    if (path / "metadata.yaml").exists() or suffix in (".mcap", ".db3"):
        return Recognised("a ROS 2 bag", bag=bag_section(path))
    if path.is_dir():
        return _folder(path)
    if suffix == ".parquet":
        return Recognised("a table", heading=_heading_among(ParquetTable(str(path)).header))
    records = records_in(str(path))
    first = records[0].cells[0].strip()
    header = [name.strip() for name in records[0].cells]
    if {"t", "robot", "x", "y"} <= set(header):
        return Recognised("a table", heading=_heading_among(header))
    if first == "Format Version":
        return Recognised("an export of OptiTrack Motive", form={"format": "optitrack"})
    if first in VICON_SECTIONS:
        return Recognised("an export of Vicon", form={"format": "vicon"})
    if _is_tum(records):
        return Recognised("a TUM file", form={"format": "tum"})
    columns = _columns(path, records)
    if columns is None:
        raise LogError(
            f"{path}: no positions found: expected columns t, robot, x, y, or pairs of columns .. x, .. y after one of "
            "times (log: {format: columns, ..} reads any table by the names of its columns)"
        )
    form, bodies = columns
    return Recognised("a table with columns of its own", form={**form, "bodies": bodies})


def _folder(path: Path) -> Recognised:
    """A folder with a file for each body."""
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in (".txt", ".tum", ".csv"))
    tables = [file for file in files if file.suffix.lower() == ".csv"]
    if not tables:
        if not files:
            raise LogError(f"{path}: neither a ROS 2 bag (metadata.yaml) nor files .txt, .tum or .csv in this folder")
        return Recognised("a folder of TUM files", form={"format": "tum"})
    form: dict[str, Any] = {}
    found: dict[str, dict[str, str]] = {}
    for file in tables:
        columns = _columns(file, records_in(str(file)))
        if columns is None or (form and columns[0] != form):
            raise LogError(f"{file}: no column of times with a pair of columns .. x, .. y, the same as in other files")
        form, bodies = columns
        alone = len(bodies) == 1
        found |= {file.stem if alone else body: {"file": file.name, **axes} for body, axes in bodies.items()}
    return Recognised("a folder of tables", form={**form, "bodies": found})


def _columns(path: Path, records: Sequence[Record]) -> tuple[dict[str, Any], dict[str, dict[str, str]]] | None:
    """The form of a table by its columns, and the columns of each body. None if nothing looks like positions."""
    for head, row in pairwise(records[:SCANNED_LINES]):
        names = [name.strip() for name in head.cells]
        time = next((name for name in names if UNIT.sub("", name).strip().lower() in TIMES), None)
        bodies = _pairs(names, path.stem)
        if time is None or not bodies or not DECIMAL.fullmatch(row.cells[min(names.index(time), len(row.cells) - 1)]):
            continue
        form: dict[str, Any] = {"format": "columns", "time": time}
        form |= {} if head.line == 1 else {"header_line": head.line}
        form |= _time_unit(time, names.index(time), [record for record in records if record.line > head.line])
        lengths = {told[1].lower() for axes in bodies.values() if (told := UNIT.search(axes["x"]))} & {"mm", "cm"}
        return form | ({"unit": lengths.pop()} if len(lengths) == 1 else {}), bodies
    return None


def _pairs(names: Sequence[str], alone: str) -> dict[str, dict[str, str]]:
    """The columns of each body that has a position.

    Args:
        names: the names of the columns.
        alone: the name of the body whose columns have no more than the axis.
    """
    found: dict[str, dict[str, str]] = {}
    for name in names:
        told = NAMED.fullmatch(UNIT.sub("", name).strip())
        if told is not None:
            axis = told["axis"].lower()
            found.setdefault(told["owner"] or alone, {}).setdefault(AXES.get(axis, axis), name)
    bodies = {body: axes for body, axes in found.items() if {"x", "y"} <= axes.keys()}
    for axes in bodies.values():
        if not {"vx", "vy"} <= axes.keys():
            for axis in ("vx", "vy", "vz"):
                axes.pop(axis, None)
    return bodies


def _time_unit(name: str, column: int, records: Sequence[Record]) -> dict[str, str]:
    """The unit of times, from the name of their column, or from the step between them."""
    told = UNIT.search(name)
    word = (told[1] if told else name).lower()
    for unit in ("ms", "us", "ns"):
        if word == unit or (unit == "ms" and word.startswith("milli")):
            return {"time_unit": unit}
    if told is not None:
        return {}
    cells = [record.cells[column] for record in records[:1000] if len(record.cells) > column]
    times = np.array([float(cell) for cell in cells if DECIMAL.fullmatch(cell)])
    steps = np.diff(times)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if step * size <= LONGEST_SAMPLING:
            return {} if unit == "s" else {"time_unit": unit}
    return {"time_unit": "ns"}


def _is_tum(records: Sequence[Record]) -> bool:
    lines = [record.cells[0].partition("#")[0].split() for record in records[:SCANNED_LINES] if len(record.cells) == 1]
    lines = [line for line in lines if line]
    return bool(lines) and all(len(line) == TUM_COLUMNS and all(map(DECIMAL.fullmatch, line)) for line in lines)


def _heading_among(header: Sequence[str]) -> str | None:
    return next((name for name in header if name.lower() in HEADINGS), None)
