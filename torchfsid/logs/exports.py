"""Exports of motion capture as tables: which columns of which table belong to a body.

OptiTrack Motive   the first line names the format; a few lines name type, name and ID of each column; a line has the
                   groups (Rotation, Position); the line that begins with Frame has the axes
Vicon              a section (Objects, Segments, Trajectories), the frame rate, a line with the names, a line that
                   begins with Frame and has the axes, a line with the units. Further sections are not read
TUM                t x y z qx qy qz qw, one file per body, # begins a comment
columns            any CSV with one line of names
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterator, Sequence
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from torchfsid.config.motion_capture import SCALES, TIME_UNITS, BodyColumns, LogConfig
from torchfsid.config.quantities import DECIMAL
from torchfsid.errors import ConfigError, LogError
from torchfsid.logs.tables import TUM_COLUMNS, VICON_SECTIONS, CsvTable, Record, records_in, require_column

TUM_NAMES = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
UNITS = {"Meters": "m", "Centimeters": "cm", "Millimeters": "mm"}
"""Units of length, as Motive writes them."""

ANGLES = {"rad": 1.0, "deg": math.pi / 180}
"""Units of angles [rad]."""

LAST = 9_000_000_000_000_000_000
"""Largest stamp [ns]: whole numbers of 64 bits end there."""


class Recorded(NamedTuple):
    """One body in a table.

    Attributes:
        body: the name.
        table: the table. Cells without a measurement are empty.
        stamps: time of each table row [ns].
        columns: names of columns, by axis: x, y, z, perhaps vx, vy, vz.
        power: unit of length, as a power of ten of a metre.
        heading: the column of headings, or those of a quaternion x, y, z, w. Empty if there is none.
        angle: unit of headings [rad].
    """

    body: str
    table: CsvTable
    stamps: Int[np.ndarray, "rows"]
    columns: dict[str, str]
    power: int
    heading: tuple[str, ...] = ()
    angle: float = 1.0


def recorded(path: Path, form: LogConfig) -> list[Recorded]:
    """The bodies in an export.

    Raises:
        LogError: the file cannot be read, or is not of that form.
        ConfigError: a body or a column that the form names is not there.
    """
    if form.format == "columns":
        return _by_columns(path, form)
    if form.format == "tum":
        return _tum(path, form)
    found = {of.body: of for of in (_optitrack if form.format == "optitrack" else _vicon)(path, form)}
    for body, name in form.bodies.items():
        if name not in found:
            raise ConfigError(f"log.bodies.{body}: {path}: nothing is called {name!r}; there are {_listed(found)}")
    return [found[str(name)]._replace(body=body) for body, name in form.bodies.items()] or list(found.values())


def _by_columns(path: Path, form: LogConfig) -> list[Recorded]:
    assert form.time is not None
    tables: dict[Path, tuple[CsvTable, np.ndarray]] = {}
    found = []
    for body, given in form.bodies.items():
        assert isinstance(given, BodyColumns)
        file = path if given.file is None else path / given.file
        if file not in tables:
            records = [record for record in _records(file) if record.line >= form.header_line]
            if not records or records[0].line != form.header_line:
                raise LogError(f"{file} line {form.header_line}: expected names of columns (log.header_line)")
            table = CsvTable(str(file), records)
            require_column(table, form.time)
            tables[file] = table, _stamps(table, form.time, TIME_UNITS[form.time_unit])
        table, stamps = tables[file]
        columns = {name: column for name, column in given.model_dump(exclude={"file"}).items() if column is not None}
        for column in columns.values():
            require_column(table, column)
        heading = tuple(column for name, column in columns.items() if name == "heading")
        columns.pop("heading", None)
        power = SCALES[form.unit or "m"]
        found.append(Recorded(body, table, stamps, columns, power, heading, ANGLES[form.angle]))
    return found


def _tum(path: Path, form: LogConfig) -> list[Recorded]:
    files = {body: path / str(name) for body, name in form.bodies.items()}
    if not files and path.is_dir():
        files = {file.stem: file for file in sorted(path.iterdir()) if file.suffix.lower() in (".txt", ".tum")}
        if not files:
            raise LogError(f"{path}: no file .txt or .tum in this folder")
    return [_of_tum(body, file, form) for body, file in (files or {path.stem: path}).items()]


def _of_tum(body: str, file: Path, form: LogConfig) -> Recorded:
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise LogError(f"{file}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise LogError(f"{file}: not text in UTF-8") from error
    records = [Record(0, list(TUM_NAMES))]
    for i, line in enumerate(lines):
        cells = line.partition("#")[0].split()
        if cells and len(cells) != TUM_COLUMNS:
            expected = f"expected {TUM_COLUMNS} numbers, {' '.join(TUM_NAMES)}"
            raise LogError(f"{file} line {i + 1}: {expected}, got {reprlib.repr(line.strip())}")
        records += [Record(i + 1, cells)] if cells else []
    table = CsvTable(str(file), records)
    stamps = _stamps(table, "t", TIME_UNITS[form.time_unit])
    return Recorded(body, table, stamps, {axis: axis for axis in "xyz"}, SCALES[form.unit or "m"], TUM_NAMES[4:])


def _optitrack(path: Path, form: LogConfig) -> Iterator[Recorded]:
    records = _records(path)
    axes = next((i for i, record in enumerate(records) if record.cells[0] == "Frame"), None)
    kinds, names = (
        next((record.cells for record in records[: axes or 0] if record.cells[1:2] == [of]), None)
        for of in ("Type", "Name")
    )
    if records[0].cells[0] != "Format Version" or axes is None or kinds is None or names is None:
        raise LogError(f"{path} line 1: not an export of OptiTrack Motive with its header")
    told = dict(zip(records[0].cells[::2], records[0].cells[1::2], strict=False))
    groups, header = records[axes - 1].cells, records[axes].cells
    width = min(map(len, (kinds, names, groups, header)))
    labels = [*header[:2], *(f"{names[i]} {groups[i]} {header[i]}" for i in range(2, width))]
    labels = [
        label if kinds[i] in ("", "Type", "Rigid Body") else f"{kinds[i]} {label}" for i, label in enumerate(labels)
    ]
    table = _padded(path, records[axes].line, labels, records[axes + 1 :])
    rate = told.get("Export Frame Rate", "")
    if DECIMAL.fullmatch(rate) and float(rate) > 0:
        stamps = _of_frames(table, labels[0], rate)
    else:
        stamps = _stamps(table, labels[1], TIME_UNITS["s"])
    unit = form.unit or UNITS.get(told.get("Length Units", "Meters"))
    if unit is None:
        raise LogError(f"{path} line 1: unknown units of length {told['Length Units']!r} (log.unit)")
    for name in dict.fromkeys(names[i] for i in range(2, width) if kinds[i] == "Rigid Body"):
        body = _of(name, table, stamps, {axis: f"{name} Position {axis.upper()}" for axis in "xyz"}, unit)
        turned = tuple(f"{name} Rotation {axis}" for axis in "XYZW")
        yield body._replace(heading=turned if set(turned) <= set(labels) else ())


def _vicon(path: Path, form: LogConfig) -> Iterator[Recorded]:
    records = _records(path)
    section, rate, names, header, units = (record.cells for record in [*records[:5], *[Record(0, [""])] * 5][:5])
    has_rate = DECIMAL.fullmatch(rate[0]) and float(rate[0]) > 0
    if section[0] not in VICON_SECTIONS or not has_rate or header[0] != "Frame":
        raise LogError(f"{path} line 1: not an export of Vicon: expected one of {', '.join(VICON_SECTIONS)}, a rate")
    labels, owner = list(header[:2]), ""
    for i, axis in enumerate(header[2:], start=2):
        owner = (names[i].strip() if i < len(names) else "") or owner
        labels.append(f"{owner} {axis.strip()}")
    rows = []
    for record in records[5:]:
        if not DECIMAL.fullmatch(record.cells[0]):
            break
        rows.append(record)
    table = _padded(path, records[3].line, labels, rows)
    stamps, marker = _of_frames(table, labels[0], rate[0]), section[0] == "Trajectories"
    unit = form.unit or next((unit.strip() for unit in units[2:] if unit.strip() in SCALES), "mm")
    for name in dict.fromkeys(name.strip() for name in names[2:] if name.strip()):
        columns = {axis: f"{name} {'' if marker else 'T'}{axis.upper()}" for axis in "xyz"}
        body, turned = _of(name, table, stamps, columns, unit), f"{name} RZ"
        angle = units[labels.index(turned)].strip() if turned in labels[: len(units)] else ""
        yield body._replace(heading=(turned,), angle=ANGLES[angle]) if angle in ANGLES else body


def _of(name: str, table: CsvTable, stamps: np.ndarray, columns: dict[str, str], unit: str) -> Recorded:
    for column in columns.values():
        require_column(table, column)
    return Recorded(name, table, stamps, columns, SCALES[unit])


def _records(path: Path) -> list[Record]:
    """The lines of a CSV file. Cells without a number are empty, whatever the program writes for it."""
    return [
        Record(record.line, ["" if cell.strip().lower() == "nan" else cell.strip() for cell in record.cells])
        for record in records_in(str(path))
    ]


def _padded(path: Path, line: int, header: Sequence[str], rows: Sequence[Record]) -> CsvTable:
    """The table with this header. Empty cells at the ends of rows may be missing, or more than there are columns."""
    whole = [Record(line, list(header))]
    for record in rows:
        extra = len(header) - len(record.cells)
        cells = record.cells + [""] * extra if extra >= 0 or any(record.cells[extra:]) else record.cells[:extra]
        whole.append(Record(record.line, cells))
    return CsvTable(str(path), whole)


def _stamps(table: CsvTable, column: str, power: int) -> Int[np.ndarray, "rows"]:
    """The times in a column [ns], read as decimals: doubles of times since 1970 have no nanoseconds."""
    stamps = []
    for i, text in enumerate(table.texts(column)):
        stamp = Decimal(text).scaleb(power) if DECIMAL.fullmatch(text) and len(text) < len(str(LAST)) * 2 else LAST
        if not abs(stamp) < LAST:
            hint = " (decimals with commas? Expected points)" if DECIMAL.fullmatch(text.replace(",", ".")) else ""
            raise table.error(i, f"column {column!r}: expected a time, got {reprlib.repr(text)}{hint}")
        stamps.append(round(stamp))
    return np.array(stamps, dtype=np.int64)


def _of_frames(table: CsvTable, column: str, rate: str) -> Int[np.ndarray, "rows"]:
    """The times of frames [ns], which come at an exact rate [Hz]."""
    frames = table.numbers(column)
    return np.rint(frames * (1e9 / float(rate))).astype(np.int64)


def _listed(found: dict[str, Recorded]) -> str:
    return reprlib.repr(list(found))
