"""Results folders: one table of their files, and how these are written and read. This module does not import torch.

A file is written line by line, or aside and then renamed. So it is whole, or it ends where the run broke off. Figures
and summaries are made from these files alone.
"""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, Self

import numpy as np

from torchfsid.commands.results_folder import named, whole
from torchfsid.errors import FigureError, one_line


class File(NamedTuple):
    """A file of a results folder.

    Attributes:
        name: its name in the folder.
        writer: the module that writes it.
        reader: the module that reads it back for the figures. None: it is for people and other programmes only.
        holds: its content, in words.
    """

    name: str
    writer: str
    reader: str | None
    holds: str


CONFIG = File("config.yaml", "__main__", "__main__", "the resolved configuration: it gives the same results again")
SUMMARY = File("summary.json", "__main__", None, "what the results show")
OBSERVED = (
    CONFIG,
    File("estimates.csv", "runs.observe", "runs.saved", "a row per time and robot: sizes of sets, estimates"),
    File("regions.jsonl", "runs.observe", "runs.saved", "a line per time and robot: rows, controls, vertices"),
    File("regions.json", "runs.observe", None, "the final sets, rows A theta <= b"),
    File("sets.csv", "runs.observe", None, "the sets over time, thinned: a row per facet"),
)

FILES = {
    "scene": (
        *OBSERVED,
        File("trajectory.csv", "runs.scene", "runs.saved", "what was measured: a log for torchfsid observe"),
        SUMMARY,
    ),
    "cases": (
        *OBSERVED,
        File("cases.csv", "runs.cases", None, "Table I, measured"),
        File("summary.json", "__main__", "figures.cases", "Table I, measured, and its settings"),
    ),
    "swarm": (
        CONFIG,
        File("estimates.csv", "runs.swarm", None, "a row per robot at the snapshots: sizes of sets, estimates"),
        File("regions.json", "runs.swarm", None, "the final sets, rows A theta <= b"),
        File("sets.csv", "runs.swarm", None, "the sets at the snapshots: a row per facet"),
        File("sizes.csv", "runs.swarm", "figures.swarm", "a row per time: quantiles of sizes, shares of robots"),
        File("snapshots.csv", "runs.swarm", "figures.swarm", "a row per robot at the snapshots: place, goal, case"),
        File("summary.json", "__main__", "figures.swarm", "what was lost, how long it took, how much memory"),
    ),
    "sweep": (
        CONFIG,
        File("records.jsonl", "sweeps.sweep", None, "the journal: a line per run, in the order in which they finished"),
        File("runs.csv", "sweeps.swept", None, "a row per run (`sweeps.record`)"),
        File("series.csv", "sweeps.swept", None, "rows per run, time and robot (`sweeps.record`)"),
        File("runs.parquet", "sweeps.swept", "sweeps.swept", "the same as runs.csv"),
        File("series.parquet", "sweeps.swept", "sweeps.swept", "the same as series.csv"),
        File("timings.csv", "sweeps.swept", None, "how long each run took: the one table that is never the same"),
        SUMMARY,
    ),
    "probe_placement": (
        CONFIG,
        File("runs.csv", "design.placement", "figures.placement", "a row per corridor, number of way-points, method"),
        File("placements.json", "design.placement", "figures.placement", "per corridor its obstacles, what was chosen"),
        File("descent.csv", "design.placement", "figures.placement", "first corridor: where Adam's starts went"),
        File("landscape.csv", "design.placement", "figures.placement", "first corridor: the mean area by place"),
        File("replay.json", "design.placement", "figures.placement", "first corridor: one goal, with several probes"),
        File("switches.csv", "design.placement", "figures.placement", "that goal's area and slope across the corridor"),
        File("gradient_check.csv", "design.placement", "figures.placement", "gradients against central differences"),
        File("no_gradient.csv", "design.placement", None, "shares of placements from which there is no gradient"),
        SUMMARY,
    ),
    "learned_observer": (
        CONFIG,
        File("training.csv", "design.learning", "figures.learning", "a row per gain and epoch: mean errors"),
        File("gains.json", "design.learning", None, "the trained gains, whole"),
        File("answers.csv", "design.learning", "figures.learning", "what the network answers"),
        File("runs.csv", "design.learning", None, "a row per observer, noise and team: mean errors"),
        File("curves.csv", "design.learning", "figures.learning", "a row per observer, noise and sample: mean error"),
        SUMMARY,
    ),
}
"""What the results of each kind have, in the order in which it is written."""

FIGURES = ("figure.png", "figure.pdf", "comparison.png", "comparison.pdf", "animation.gif")
"""What is drawn. (The figures of a sweep over two lines are called figure_LABEL; a sweep is only ever gone on with.)"""


PAGE = "report.html"
"""The page of a run or a sweep, which is written when it is asked for."""


def names(kind: str) -> list[str]:
    """The names of the files, figures and pages of a kind."""
    return [*(file.name for file in FILES[kind]), *FIGURES, PAGE]


def require(folder: Path, kind: str) -> None:
    """Check that the folder has the files that the figures of this kind need.

    Raises:
        FigureError: a file is missing. The message names the first one.
    """
    for file in FILES[kind]:
        if file.reader and not (folder / file.name).is_file():
            raise FigureError(f"{folder / file.name}: is missing: the run has not come that far, or it was removed")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """In this block an error in the content of a file is raised as a `FigureError` that names the file."""
    try:
        yield
    except FileNotFoundError as error:
        raise FigureError(f"{path}: is missing") from error
    except OSError as error:
        raise FigureError(f"{path}: cannot be read: {error.strerror or one_line(error)}") from error
    except (LookupError, ValueError, TypeError, AttributeError, csv.Error) as error:
        raise FigureError(f"{path}: is damaged: {type(error).__name__}: {one_line(error)}") from error


def damaged(path: Path, what: str) -> NoReturn:
    """Raise the `FigureError` for a damaged file."""
    raise FigureError(f"{path}: is damaged: {what}")


def require_length(path: Path, lines: int, expected: int) -> None:
    """Check the number of lines of a file.

    Raises:
        FigureError: it has other than the expected number.
    """
    if lines != expected:
        raise FigureError(f"{path}: has {lines} of {expected} rows: the run broke off, or some were removed")


class Columns(dict[str, np.ndarray]):
    """The columns of a table, as texts if it is a CSV file. Asking for a missing column raises `FigureError`."""

    def __init__(self, path: Path, columns: dict[str, np.ndarray]):
        super().__init__(columns)
        self.path = path

    def __missing__(self, name: str) -> NoReturn:
        damaged(self.path, f"it has no column {name!r}")

    def numbers(self, name: str) -> np.ndarray:
        """A column of texts as numbers. Empty cells are NaN."""
        column = self[name]
        with reading(self.path):
            return np.where(column == "", "nan", column).astype(float)

    def of_length(self, rows: int) -> Columns:
        """The same columns, after a check that there are this many table rows."""
        require_length(self.path, len(next(iter(self.values()))), rows)
        return self

    def where(self, **values: object) -> Columns:
        """The table rows in which columns of texts have these values."""
        return self.rows(np.all([self[name] == str(value) for name, value in values.items()], axis=0))

    def rows(self, chosen: np.ndarray) -> Columns:
        """The chosen table rows."""
        return Columns(self.path, {name: column[chosen] for name, column in self.items()})


def read_columns(path: Path) -> Columns:
    """The columns of a CSV file, as texts.

    Raises:
        FigureError: the file is missing or damaged.
    """
    with reading(path):
        text = path.read_text(encoding="utf-8")
        header, *rows = csv.reader(io.StringIO(text, newline=""), strict=True)
        if not rows:
            damaged(path, "it has no rows")
        if not text.endswith("\n"):
            damaged(path, "its last line has no end")
        for line, row in enumerate(rows, 2):
            if len(row) != len(header):
                damaged(path, f"line {line} has {len(row)} cells, its header {len(header)}")
        return Columns(path, dict(zip(header, np.array(rows).T, strict=True)))


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        FigureError: the file is missing or damaged.
    """
    with reading(path):
        return json.loads(path.read_text(encoding="utf-8"))


class Appender:
    """Appends pieces to a file, each whole or not at all, also on a full disk."""

    def __init__(self, path: Path, keep: bool = False):
        self.path, self.file = path, path.open("a+b" if keep else "wb", buffering=0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def append(self, piece: str) -> None:
        """Append a piece, whole or not at all.

        Raises:
            OSError: it cannot be written. The file is then as it was before.
        """
        left, whole = piece.encode(), self.file.seek(0, os.SEEK_END)
        try:
            with named(self.path):
                while left:
                    left = left[self.file.write(left) :]
        except BaseException:
            self.file.truncate(whole)
            raise


class Journal(Appender):
    """A journal: one line of JSON per finished run, appended and synced in the order of finishing.

    A process that is killed may leave a last line without its end. It is cut off when the journal is opened again. Any
    other line that is not JSON (a damaged disk) is ignored. In both cases the run is run again. Whole lines are never
    changed.

    Attributes:
        records: the records of whole lines, by number of the run.
    """

    def __init__(self, path: Path):
        super().__init__(path, keep=True)
        self.file.seek(0)
        *lines, rest = self.file.read().split(b"\n")
        self.file.truncate(self.file.tell() - len(rest))
        records = filter(None, map(_parse, lines))
        self.records: dict[int, dict[str, Any]] = {record["run"]: record for record in records}

    def add(self, records: Sequence[dict[str, Any]]) -> None:
        """Append records. After the return they survive a crash."""
        self.append("".join(json.dumps(record, allow_nan=False) + "\n" for record in records))
        os.fsync(self.file.fileno())
        self.records |= {record["run"]: record for record in records}


def _parse(line: bytes) -> dict[str, Any] | None:
    try:
        record = json.loads(line)
    except ValueError:
        return None
    return record if isinstance(record, dict) and isinstance(record.get("run"), int) else None


def rows_of(columns: Mapping[str, Iterable[Any]]) -> list[dict[str, Any]]:
    """The table rows of columns of the same length."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


class RowWriter(Appender):
    """Writes a CSV file, some table rows at a time. The keys of the first one are the header."""

    header: list[str] | None = None

    def write(self, rows: Iterable[dict[str, Any]]) -> None:
        """Append table rows."""
        rows, text = list(rows), io.StringIO(newline="")
        if not rows:
            return
        writer = csv.DictWriter(text, self.header or list(rows[0]))
        if self.header is None:
            writer.writeheader()
        writer.writerows(rows)
        self.append(text.getvalue())
        self.header = list(writer.fieldnames)


def write_rows(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    """Write a CSV file as a whole."""
    with whole(path) as partial, RowWriter(partial) as writer:
        writer.write(rows)
