"""Tables of a log: named columns from CSV or Parquet. An error message names the table row and the column."""

from __future__ import annotations

import csv
import math
import reprlib
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from torchfsid.errors import LogError, one_line

LARGEST = 1e12
"""Larger numbers are no measurements (in SI units, even stamps in seconds since 1970 are smaller)."""

A_NUMBER = f"a finite number of at most {LARGEST:g}"


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
        """The column as numbers, none larger than `LARGEST`. If cells may be empty, those are NaN.

        Raises:
            LogError: an entry is not such a number.
        """
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
        raise table.header_error(f"{problem} {name!r}, the header has {reprlib.repr(table.header)}")


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


class CsvTable:
    """A CSV file: its cells as text, and the line of the file on which each stands."""

    def __init__(self, source: str):
        self.source = source
        self.lines: list[int] = []
        records: list[list[str]] = []
        try:
            with open(source, encoding="utf-8-sig", newline="") as file:
                reader = csv.reader(file, strict=True)
                for record in reader:
                    if len(record) > 1 or "".join(record).strip():  # not a blank line
                        records.append(record)
                        self.lines.append(reader.line_num)
        except OSError as error:
            raise LogError(f"{source}: cannot be read: {error.strerror or error}") from error
        except UnicodeDecodeError as error:
            raise LogError(f"{source}: not text in UTF-8") from error
        except csv.Error as error:
            raise LogError(f"{source} line {reader.line_num}: not valid CSV: {error}") from error
        if not records:
            raise LogError(f"{source}: the file is empty")
        self.header = [name.strip() for name in records.pop(0)]
        self.rows = records
        header_line = self.lines.pop(0)
        if not records:
            raise LogError(f"{source} line {header_line}: no rows after the header")
        for i, row in enumerate(records):
            if len(row) != len(self.header):
                raise self.error(i, f"expected {len(self.header)} cells as in the header, got {len(row)}")

    def error(self, row: int, message: str) -> LogError:
        return LogError(f"{self.source} line {self.lines[row]}: {message}")

    def header_error(self, message: str) -> LogError:
        return LogError(f"{self.source} line 1: {message}")

    def names(self, column: str) -> list[str]:
        index = self.header.index(column)
        return checked_names(self, column, [row[index].strip() for row in self.rows])

    def numbers(self, column: str, may_be_empty: bool = False) -> Float[np.ndarray, "rows"]:
        index = self.header.index(column)
        cells = [row[index] for row in self.rows]
        if may_be_empty and (empty := [not cell.strip() for cell in cells]).count(True):
            cells = ["0" if is_empty else cell for is_empty, cell in zip(empty, cells, strict=True)]
            return np.where(empty, math.nan, self._as_numbers(column, cells))
        return self._as_numbers(column, cells)

    def _as_numbers(self, column: str, cells: list[str]) -> Float[np.ndarray, "rows"]:
        try:
            values = np.fromiter(map(float, cells), dtype=np.float64, count=len(cells))
        except ValueError:
            values = np.array([math.nan])
        if is_measurable(values).all() and _is_plain("".join(cells)):
            return values
        i = next(i for i, cell in enumerate(cells) if not _is_number(cell))
        raise self.error(i, f"column {column!r}: expected {A_NUMBER}, got {reprlib.repr(cells[i])}")


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
        measurable = is_measurable(values)
        if may_be_empty:
            measurable |= cells.is_null().to_numpy(zero_copy_only=False)
        if not measurable.all():
            i = int(np.argmin(measurable))
            raise self.error(i, f"column {column!r}: expected {A_NUMBER}, got {cells[i].as_py()!r}")
        return values

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
