"""Tables that fit the terminal: columns that matter less are left out, and no cell is cut off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

LONGEST_NAME = 24
"""Cells from which on names are folded."""

BORDER = 3
"""Cells between two columns. Outside of the first and the last one there are two."""


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        heading: its heading.
        kind: `number`; `name`, folded only beyond `LONGEST_NAME`; or `words`, which may wrap, but not before a comma.
        cells: its cells, as markup.
    """

    heading: str
    kind: Literal["number", "name", "words"] = "number"
    cells: list[str] = field(default_factory=list)

    @property
    def wide(self) -> int:
        """The width in which nothing wraps but long names [cells]."""
        widest = max(map(cell_len, (self.heading, *self._plain)))
        return min(widest, LONGEST_NAME) if self.kind == "name" else widest

    @property
    def narrow(self) -> int:
        """The least width [cells]."""
        if self.kind != "words":
            return self.wide
        words = [word for text in self._plain for word in text.split()]
        return max(map(cell_len, (self.heading, *words, *(text.split(",")[0] for text in self._plain))))

    @property
    def _plain(self) -> list[str]:
        return [Text.from_markup(cell).plain for cell in self.cells]


def fits(columns: Sequence[Column], console: Console) -> bool:
    """Is the console wide enough for these columns?"""
    return sum(column.narrow + BORDER for column in columns) + 1 <= console.width


def plain_table(title: str, columns: Sequence[Column], console: Console) -> Table:
    """A table of these columns, which have as many cells each. Words wrap where the console is too narrow for them."""
    made = Table(title=escape(title), title_justify="left", caption_justify="left")
    room = console.width - 1 - sum(column.narrow + BORDER for column in columns)
    for column in columns:
        more = max(0, min(room, column.wide - column.narrow))
        room -= more
        justify = "right" if column.kind == "number" else "left"
        made.add_column(escape(column.heading), justify=justify, width=column.narrow + more, overflow="fold")
    for row in zip(*(column.cells for column in columns), strict=True):
        made.add_row(*row)
    return made


def fitted_table(
    title: str, columns: Sequence[Column], dropped: Sequence[str], console: Console, elsewhere: str
) -> Table:
    """A table of as many columns as the console is wide enough for.

    Args:
        title: its title.
        columns: its columns.
        dropped: headings of columns that may be left out, in this order.
        console: where it is printed.
        elsewhere: where what is left out can be found.
    """
    left_out: list[str] = []
    shown = list(columns)
    for heading in dropped:
        if fits(shown, console):
            break
        left_out += [column.heading for column in shown if column.heading == heading]
        shown = [column for column in shown if column.heading != heading]
    made = plain_table(title, shown, console)
    if left_out:
        made.caption = escape(f"for lack of width without {', '.join(left_out)}: {elsewhere}")
    return made
