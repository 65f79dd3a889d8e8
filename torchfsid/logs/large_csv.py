"""Large CSV files, parsed by pyarrow if it is installed.

Only plain files are: ASCII without quotes, and numbers as programs write them. Whatever else there is, and every
mistake, goes to `CsvTable`, so that it is read, or reported, in one way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from torchfsid.errors import LogError
from torchfsid.logs.reading import half_units
from torchfsid.logs.tables import CsvTable, Table, checked_names, is_measurable

LARGE = 4_000_000
"""Size from which a file is large [bytes]: smaller ones are read before pyarrow is imported."""


def csv_table(source: str) -> Table:
    """The table in a CSV file.

    Raises:
        LogError: see `CsvTable`.
    """
    return _large_table(source) or CsvTable(source)


def _large_table(source: str) -> LargeCsvTable | None:
    """The table in a large and plain file, or None."""
    try:
        if Path(source).stat().st_size < LARGE:
            return None
        from pyarrow import ArrowInvalid, BufferReader, csv, string

        content = Path(source).read_bytes()
    except (ImportError, OSError):
        return None
    if b'"' in content or b"\0" in content or not content.isascii():
        return None
    first, _, _ = content.partition(b"\n")
    names = first.decode("ascii").strip("\r").split(",")
    if not first.strip() or len(set(names)) < len(names):
        return None
    texts = dict.fromkeys(names, string())
    options = csv.ConvertOptions(column_types=texts, strings_can_be_null=True, null_values=[""])
    try:
        cells = csv.read_csv(BufferReader(content), convert_options=options)
    except ArrowInvalid:
        return None
    return LargeCsvTable(source, cells) if cells.num_rows else None


class LargeCsvTable:
    """The cells of a plain CSV file, as an Arrow table of texts."""

    def __init__(self, source: str, cells: Any):
        self.source, self._cells = source, cells
        self.header: list[str] = [name.strip() for name in cells.column_names]

    @cached_property
    def _plain(self) -> CsvTable:
        return CsvTable(self.source)

    def error(self, row: int, message: str) -> LogError:
        return self._plain.error(row, message)

    def header_error(self, message: str) -> LogError:
        return self._plain.header_error(message)

    def names(self, column: str) -> list[str]:
        return checked_names(self, column, [name.strip() for name in self._texts(column)])

    def numbers(self, column: str, may_be_empty: bool = False) -> Float[np.ndarray, "rows"]:
        from pyarrow import ArrowInvalid, float64

        cells = self._column(column)
        try:
            values = cells.cast(float64()).to_numpy(zero_copy_only=False)
        except ArrowInvalid:
            return self._plain.numbers(column, may_be_empty)
        empty = np.isnan(values) if cells.null_count else np.zeros(len(values), dtype=bool)
        if not (is_measurable(values) | (empty & may_be_empty)).all() or empty.sum() != cells.null_count:
            return self._plain.numbers(column, may_be_empty)
        return values

    def rounding(self, columns: Sequence[str], values: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "rows n"]:
        return half_units((cell for column in columns for cell in self._texts(column)), values)

    def _column(self, column: str) -> Any:
        return self._cells.column(self.header.index(column)).combine_chunks()

    def _texts(self, column: str) -> Iterator[str]:
        for chunk in self._cells.column(self.header.index(column)).chunks:
            for cell in chunk.to_pylist():
                yield cell or ""
