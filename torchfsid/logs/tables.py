"""Tables of a log: named columns from CSV or Parquet. An error message names the table row and the column."""

from __future__ import annotations

import csv
import math
import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from torchfsid.errors import LogError, one_line
from torchfsid.logs.reading import NEGLIGIBLE, half_units

LARGEST = 1e12
"""Larger numbers are no measurements (in SI units, even stamps in seconds since 1970 are smaller)."""

A_NUMBER = f"a finite number of at most {LARGEST:g}"

TUM_COLUMNS = 8
"""t x y z qx qy qz qw."""

VICON_SECTIONS = ("Objects", "Segments", "Trajectories")
"""First lines of the exports of Vicon that hold positions."""


@runtime_checkable
class Table(Protocol):
    """A table of named columns.

    Attributes:
        source: the file.
        header: the names of the columns.
    """

    source: str
    header: list[str]

    def error(self, row: int, message: str) -> LogError:
        """The error for a mistake in the table row of this index, counted from 0."""
        ...

    def header_error(self, message: str) -> LogError:
        """The error for a mistake in the names of the columns."""
        ...

    def names(self, column: str) -> list[str]:
        """The column as names, none of them empty.

        Raises:
            LogError: an entry is not a name.
        """
        ...

    def numbers(self, column: str, may_be_empty: bool = False) -> Float[np.ndarray, "rows"]:
        """The column as numbers, none larger than `LARGEST`.

        Args:
            column: the name.
            may_be_empty: empty cells are NaN. Otherwise they are mistakes.

        Raises:
            LogError: an entry is not such a number.
        """
        ...

    def rounding(self, columns: Sequence[str], values: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "rows n"]:
        """How far the numbers of these columns, all of one quantity, can be from those that were written."""
        ...


def is_measurable(values: Any) -> Any:
    """Can this number have been measured? Its square and the square of that must be finite."""
    return np.abs(values) <= LARGEST


def require_column(table: Table, name: str) -> None:
    """Check that the table has exactly one column of that name.

    Raises:
        LogError: it has none, or several.
    """
    count = table.header.count(name)
    if count != 1:
        problem = f"{count} columns are called" if count else "no column"
        raise table.header_error(
            f"{problem} {name!r}, the header has {reprlib.repr(table.header)}{_hint(table.header)}"
        )


def _hint(header: Sequence[str]) -> str:
    """What a file may be whose columns are not found."""
    first = header[0] if header else ""
    if len(header) == 1 and (";" in first or "\t" in first):
        return "; is the separator another one? Expected commas"
    if first == "Format Version":
        return "; an export of OptiTrack? Declare log: {format: optitrack}"
    if first in VICON_SECTIONS:
        return "; an export of Vicon? Declare log: {format: vicon}"
    is_tum = len(header) == 1 and len(numbers := first.split()) == TUM_COLUMNS and all(map(_is_number, numbers))
    return "; a TUM file? Declare log: {format: tum}" if is_tum else ""


def checked_names(table: Table, column: str, names: list[str]) -> list[str]:
    """The names, if each can be shown in a terminal and used as a file name.

    Raises:
        LogError: a name is empty or holds a NUL.
    """
    for name in dict.fromkeys(names):
        if not name:
            raise table.error(names.index(name), f"column {column!r} is empty")
        if "\0" in name:
            raise table.error(names.index(name), f"column {column!r}: a name with a NUL: {reprlib.repr(name)}")
    return names


class Record(NamedTuple):
    """One line of a table, or several where a cell holds line breaks: the last of them in the file, and the cells."""

    line: int
    cells: list[str]


def records_in(source: str) -> list[Record]:
    """The lines of a CSV file that are not blank.

    Raises:
        LogError: the file cannot be read, is not CSV, or is empty.
    """
    records = []
    try:
        with open(source, encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            for cells in reader:
                if len(cells) > 1 or "".join(cells).strip():
                    records.append(Record(reader.line_num, cells))
    except OSError as error:
        raise LogError(f"{source}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise LogError(f"{source}: not text in UTF-8") from error
    except csv.Error as error:
        raise LogError(f"{source} line {reader.line_num}: not valid CSV: {error}") from error
    if not records:
        raise LogError(f"{source}: the file is empty")
    return records


class CsvTable:
    """A CSV file: its cells as text, and the line of the file on which each stands."""

    def __init__(self, source: str, records: Sequence[Record] | None = None):
        """Read the file, or take records that were read before, the names of the columns first."""
        self.source = source
        first, *rows = records_in(source) if records is None else records
        self.header_line, self.header = first.line, [name.strip() for name in first.cells]
        self.lines, self.rows = [record.line for record in rows], [record.cells for record in rows]
        if not rows:
            raise self.header_error("no rows after the header")
        for i, row in enumerate(self.rows):
            if len(row) != len(self.header):
                hint = "; decimals with commas? Expected points" if len(row) > len(self.header) else ""
                message = f"expected {len(self.header)} cells as in the header, got {len(row)}"
                raise self.error(i, message + (_hint(self.header) or hint))

    def error(self, row: int, message: str) -> LogError:
        return LogError(f"{self.source} line {self.lines[row]}: {message}")

    def header_error(self, message: str) -> LogError:
        return LogError(f"{self.source} line {self.header_line}: {message}")

    def names(self, column: str) -> list[str]:
        index = self.header.index(column)
        return checked_names(self, column, [row[index].strip() for row in self.rows])

    def numbers(self, column: str, may_be_empty: bool = False) -> Float[np.ndarray, "rows"]:
        cells = self.texts(column)
        there = np.array([not may_be_empty or bool(cell.strip()) for cell in cells])
        if not there.all():
            cells = [cell if cell.strip() else "0" for cell in cells]
        try:
            values = np.fromiter(map(float, cells), dtype=np.float64, count=len(cells))
        except ValueError:
            values = np.array([math.nan])
        if is_measurable(values).all() and _is_plain("".join(cells)):
            return np.where(there, values, math.nan)
        i = next(i for i, cell in enumerate(cells) if not _is_number(cell))
        hint = " (decimals with commas? Expected points)" if _is_number(cells[i].replace(",", ".")) else ""
        raise self.error(i, f"column {column!r}: expected {A_NUMBER}, got {reprlib.repr(cells[i])}{hint}")

    def rounding(self, columns: Sequence[str], values: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "rows n"]:
        return half_units((cell for column in columns for cell in self.texts(column)), values)

    def texts(self, column: str) -> list[str]:
        """The cells of the column."""
        index = self.header.index(column)
        return [row[index] for row in self.rows]


def _is_plain(text: str) -> bool:
    """Is the text free of notation that only Python reads as a number, such as 1_0 or digits of other scripts?"""
    return text.isascii() and "_" not in text


def _is_number(cell: str) -> bool:
    try:
        return _is_plain(cell) and bool(is_measurable(float(cell)))
    except ValueError:
        return False


class ParquetTable:
    """A Parquet file. Its columns are read when they are asked for. Messages count table rows from 1."""

    def __init__(self, source: str):
        try:
            from pyarrow import BufferReader
            from pyarrow.parquet import ParquetFile
        except ImportError as error:
            raise LogError(f"{source}: Parquet needs an extra: pip install 'torchfsid[parquet]'") from error
        self.source = source
        try:
            content = Path(source).read_bytes()
        except OSError as error:
            raise LogError(f"{source}: cannot be read: {error.strerror or error}") from error
        try:
            self.file = ParquetFile(BufferReader(content))
            self.header: list[str] = self.file.schema_arrow.names
        except Exception as error:  # damaged bytes make the parser raise many kinds
            raise LogError(f"{source}: not valid Parquet: {one_line(error)}") from error
        if self.file.metadata.num_rows == 0:
            raise self.header_error("no rows")

    def error(self, row: int, message: str) -> LogError:
        return LogError(f"{self.source} row {row + 1}: {message}")

    def header_error(self, message: str) -> LogError:
        return LogError(f"{self.source}: {message}")

    def names(self, column: str) -> list[str]:
        from pyarrow import types

        cells = self._column(column)
        if not (types.is_string(cells.type) or types.is_large_string(cells.type) or types.is_integer(cells.type)):
            raise self.header_error(f"column {column!r}: expected text or whole numbers, it holds {cells.type}")
        return checked_names(self, column, ["" if cell is None else str(cell).strip() for cell in cells.to_pylist()])

    def numbers(self, column: str, may_be_empty: bool = False) -> Float[np.ndarray, "rows"]:
        from pyarrow import float64, types

        cells = self._column(column)
        if not (types.is_integer(cells.type) or types.is_floating(cells.type) or types.is_decimal(cells.type)):
            raise self.header_error(f"column {column!r}: expected numbers, it holds {cells.type}")
        values = cells.cast(float64(), safe=False).to_numpy(zero_copy_only=False).astype(np.float64)
        measurable = is_measurable(values) | (may_be_empty & np.isnan(values))
        if not measurable.all():
            i = int(np.argmin(measurable))
            raise self.error(i, f"column {column!r}: expected {A_NUMBER}, got {cells[i].as_py()!r}")
        return values

    def rounding(self, columns: Sequence[str], values: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "rows n"]:
        from pyarrow import float16, float32

        precision = {float16(): np.float16, float32(): np.float32}
        units = [np.finfo(precision.get(self._column(column).type, np.float64)).eps for column in columns]
        return np.where(np.array(units) > NEGLIGIBLE, np.array(units) / 2, 0.0) * np.abs(values)

    def _column(self, column: str) -> Any:
        """The column as one Arrow array. A column of categories is replaced by its values."""
        from pyarrow import types

        try:
            cells = self.file.read(columns=[column]).column(column).combine_chunks()
            cells.validate(full=True)
            cells = cells.dictionary_decode() if types.is_dictionary(cells.type) else cells
        except Exception as error:  # as above: the pages are parsed only now
            raise LogError(f"{self.source}: not valid Parquet: {one_line(error)}") from error
        if len(cells) != self.file.metadata.num_rows:
            raise LogError(
                f"{self.source}: not valid Parquet: {len(cells)} rows in column {column!r}, others in the file"
            )
        return cells
