"""A CSV file that grows during a run and holds whole samples only, however the run ends."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path

import numpy as np
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
        text = io.StringIO(newline="")
        csv.writer(text).writerows(lines)
        self.write_texts([text.getvalue()])

    def write_texts(self, texts: Sequence[str]) -> None:
        """Write texts of whole lines (`line_of`). If writing fails or is interrupted, each is there wholly or not."""
        if self.problem is not None:
            return
        content, start = "".join(texts).encode(), self._file.tell()
        try:
            with named(self.path):
                while content:
                    content = content[self._file.write(content) :]
        except BaseException as error:
            ends = accumulate((len(text.encode()) for text in texts), initial=start)
            written = self._file.tell()
            self._file.truncate(max(end for end in ends if end <= written))
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


def line_of(cells: Sequence[str]) -> str:
    """The cells as a part of a line."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\r\n").writerow(cells)  # characters of the terminator are what is quoted in cells
    return text.getvalue().removesuffix("\r\n")


def lines_of(values: Tensor | np.ndarray) -> list[str]:
    """The numbers (rows, columns) as text, each row as a part of a line."""
    rows = np.asarray(values.numpy(force=True) if isinstance(values, Tensor) else values)
    if not np.isfinite(rows).all():
        return [",".join(row) for row in texts(rows)]
    form = ",".join(["%.15g"] * rows.shape[-1])
    return [form % tuple(row) for row in rows.tolist()]


def texts(values: Tensor | np.ndarray) -> list[list[str]]:
    """The numbers (rows, columns) as text."""
    return [[number(value) for value in row] for row in values.tolist()]
