"""Pages as text: a template, its style and its scripts in one HTML file, which loads nothing."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from torchfsid.commands.page.content import Told, content

PAGE = "report.html"
"""Name of a page in its results folder."""

RUN = ("text.js", "state.js", "plane.js", "marks.js", "map.js", "chart.js", "timeline.js", "panels.js", "main.js")
"""Scripts of the page of a run, in the order in which they need each other."""

TABLES = ("text.js", "tables.js")
"""Scripts of a page of tables."""


def run_page(folder: Path, truth: Mapping[str, Sequence[float]] | None = None, told: Told | None = None) -> str:
    """The page of a results folder of `torchfsid observe`, or of an experiment with such files.

    Args:
        folder: the results folder.
        truth: the true parameter of each robot, where it is known and not in config.yaml.
        told: further lines on some robots.

    Raises:
        FigureError: a file that the page needs is missing or damaged.
    """
    record = content(folder, truth, told)
    return _page(record["heading"] or record["title"], "run", RUN, record)


def tables_page(record: Mapping[str, Any]) -> str:
    """A page of tables that can be sorted and searched.

    Args:
        record: `title`, `lead` (a sentence) and `tables`, a list of mappings with `title`, `columns` (names) and `rows`
            (numbers, texts or None). A text [words, address] is a link.
    """
    return _page(record["title"], "tables", TABLES, record)


def _page(title: str, kind: str, scripts: Sequence[str], record: Mapping[str, Any]) -> str:
    assets = files("torchfsid.commands.page") / "assets"

    def text(name: str) -> str:
        return (assets / name).read_text(encoding="utf-8")

    parts = {
        "title": html.escape(title),
        "style": text("page.css") + text(f"{kind}.css"),
        # "<" as an escape: no text of the data can end the element.
        "data": json.dumps(record, allow_nan=False, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c"),
        "script": "\n".join(map(text, scripts)),
    }
    first, *pieces = text(f"{kind}.html").split("{{")
    return first + "".join(parts[name] + rest for name, _, rest in (piece.partition("}}") for piece in pieces))
