"""A CSV file that grows during a run and holds whole samples only, however the run ends."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from torchfsid.commands.results_folder import named


class TableFile:
    """Lines that are written whole or not at all.

    A file that cannot be written (full disk) does not end the run: it stops after its last whole sample.

    Args:
        path: the file. It is replaced.
        header: names of its columns.

    Attributes:
        problem: why the file stopped growing. None: it did not.

    Raises:
        OSError: the file cannot be opened.
    """

    def __init__(self, path: Path, header: Sequence[str]):
        self.path = path
        self.problem: OSError | None = None
        self._file = path.open("wb", buffering=0)
        self.write([header])

    def write(self, lines: Sequence[Sequence[str]]) -> None:
        """Write all lines or none, even if writing fails or is interrupted."""
        if self.problem is not None:
            return
        text = io.StringIO(newline="")
        csv.writer(text).writerows(lines)
        content, whole = text.getvalue().encode(), self._file.tell()
        try:
            with named(self.path):
                while content:
                    content = content[self._file.write(content) :]
        except BaseException as error:
            self._file.truncate(whole)
            if not isinstance(error, OSError):
                raise
            self.problem = error

    def close(self) -> None:
        """Close the file.

        Raises:
            OSError: the file stopped growing.
        """
        self._file.close()
        if self.problem is not None:
            raise self.problem


def number(value: float) -> str:
    """The number as text, with 15 significant digits; empty if it is not finite.

    With 12 digits map coordinates would end at hundredths of a millimetre.
    """
    return f"{value:.15g}" if math.isfinite(value) else ""


def texts(values: Tensor) -> list[list[str]]:
    """The numbers (rows, columns) as text."""
    return [[number(value) for value in row] for row in values.tolist()]
