"""Tables on a console. This module does not import torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table


def table(texts: Sequence[str], numbers: Sequence[str] = (), title: str | None = None) -> Table:
    """A table with columns of texts, then of numbers. In a narrow console cells wrap, and nothing is cut off."""
    made = Table(
        title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1), pad_edge=False, collapse_padding=True
    )
    for heading in texts:
        made.add_column(heading, overflow="fold")
    for heading in numbers:
        made.add_column(heading, justify="right", overflow="fold")
    return made


def print_rows(console: Console, title: str, first: str, rows: Mapping[str, Mapping[str, Any]]) -> None:
    """Print a table with one table row for each name."""
    shown = table([first], list(next(iter(rows.values()), {})), title)
    for name, row in rows.items():
        shown.add_row(name, *(f"{value:.3g}" if isinstance(value, float) else str(value) for value in row.values()))
    console.print(shown)
