"""What commands show: tables on stdout, progress on stderr.

Showing never decides whether the work is done. A reader that leaves (`| head`) ends the printing only.
"""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import IO, Any, TypeVar, cast

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from torchfsid.commands.command_line import silence

COMPILING = "Compiling kernels, once on this machine: about a minute"

WIDTH = 160
"""Columns of what is not a terminal: a file or a pipe has no width of its own."""

Item = TypeVar("Item")


class _Console(Console):
    def on_broken_pipe(self) -> None:
        self.quiet = True
        silence(self.file.fileno())


class _Aside:
    """stderr, except that what cannot be shown there raises no error."""

    def __init__(self) -> None:
        self._stream = sys.stderr

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.flush()


def console(least_width: int = 0) -> Console:
    """A console on stdout. Tables that need more columns than the terminal has are wrapped by the terminal."""
    made = _Console(emoji=False)
    made.width = max(made.width if made.is_terminal else WIDTH, least_width)
    return made


def aside() -> Console:
    """A console on stderr."""
    return Console(file=cast(IO[str], _Aside()), emoji=False)


def table(title: str, texts: Sequence[str], numbers: Sequence[str] = ()) -> Table:
    """A table with columns of texts, then of numbers. Cells wrap in a narrow terminal, and no digit is cut off."""
    made = Table(title=escape(title), title_justify="left")
    for heading in texts:
        made.add_column(escape(heading), no_wrap=True)
    for heading in numbers:
        made.add_column(escape(heading), justify="right", overflow="fold")
    return made


def track(
    items: Iterable[Item], what: str, total: int, finished: int = 0, size: Callable[[Item], int] = lambda _: 1
) -> Iterator[Item]:
    """Pass items on and show progress.

    Args:
        items: the items.
        what: what is done with them, for the progress line.
        total: number of all items, the `finished` ones included.
        finished: number of items that were done before.
        size: how many an item counts for.
    """
    shown = aside()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, TimeRemainingColumn(), console=shown, speed_estimate_period=600) as progress:
        task = progress.add_task(_first(what, shown), total=total, completed=finished)
        for item in items:
            yield item
            progress.update(task, advance=size(item), description=what)
        if progress.tasks[0].completed > finished:
            _kernels_are_compiled()


@contextlib.contextmanager
def status(what: str, computes: bool = False) -> Iterator[None]:
    """In this block show that something is being done whose length is not known.

    Args:
        what: what is being done.
        computes: it uses the compiled kernels, which may have to be compiled first.
    """
    shown = aside()
    with shown.status(_first(what, shown) if computes else what):
        yield
    if computes:
        _kernels_are_compiled()


def digits(value: float, resolution: float) -> str:
    """A number as text: rounded to about a hundredth of `resolution`, so that differences of a tenth of it are seen.

    Without a resolution it has four digits. NaN is a dash.
    """
    if math.isnan(value):
        return "-"
    enough, size = 4, abs(value)
    if 0 < size < math.inf and math.isfinite(resolution):
        resolution = max(resolution, 1e-12 * size)  # beyond that, digits are round-off
        enough = max(4, 2 + math.floor(math.log10(size)) - math.floor(math.log10(resolution)))
        value = round(value, 2 - math.floor(math.log10(resolution))) + 0.0  # no -0
    return f"{value:.{enough}g}"


def ends(interval: Sequence[float], by_data: Sequence[bool] = (True, True)) -> str:
    """An interval as text, rounded outward, with a star at the ends that the data do not bound."""
    low, high = interval
    width = max(high - low, 1e-6 * abs(high))
    steps = [10.0 ** (math.floor(math.log10(max(min(width, abs(end) or width), 1e-300))) - 1) for end in interval]
    outward = (math.floor(low / steps[0]) * steps[0], math.ceil(high / steps[1]) * steps[1])
    return " .. ".join(f"{end:.7g}" + ("" if known else "*") for end, known in zip(outward, by_data, strict=True))


def _first(what: str, shown: Console) -> str:
    """The text to show during the first item: kernels are compiled when they are first used."""
    from torchfsid.kernels.compiled import folder

    if (folder() / "complete").exists():
        return what
    if not shown.is_terminal:
        shown.print(COMPILING)
    return COMPILING


def _kernels_are_compiled() -> None:
    from torchfsid.kernels.compiled import folder

    with contextlib.suppress(OSError):
        folder().mkdir(parents=True, exist_ok=True)
        (folder() / "complete").touch()
