"""Write pages: a template, its style and its scripts in one HTML file, which loads nothing."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from torchfsid.commands.page.content import content
from torchfsid.commands.results_folder import write_whole

PAGE = "report.html"
"""Name of the page in its results folder."""

SCRIPTS = ("text.js", "state.js", "plane.js", "marks.js", "map.js", "chart.js", "timeline.js", "panels.js", "main.js")
"""Scripts of the page of a run, in the order in which they need each other."""


def write_page(folder: Path, truth: Mapping[str, Sequence[float]] | None = None) -> Path:
    """Write report.html of a results folder.

    Args:
        folder: the results folder of `torchfsid observe` or of an experiment with a scene.
        truth: the true parameter of each robot, where it is known.

    Raises:
        FigureError: a file that the page needs is missing or damaged.
        OSError: the page cannot be written.
    """
    record = content(folder, truth)
    return write_html(folder / PAGE, record["heading"] or record["title"], "run", SCRIPTS, record)


def write_html(path: Path, title: str, kind: str, scripts: Sequence[str], record: Mapping[str, Any]) -> Path:
    """Write a page whose scripts find `record` as JSON.

    Args:
        path: the file.
        title: the title of the page.
        kind: the template and the style: KIND.html, KIND.css beside the common page.css.
        scripts: names of the scripts.
        record: what the page shows.
    """
    assets = files("torchfsid.commands.page") / "assets"

    def text(name: str) -> str:
        return (assets / name).read_text(encoding="utf-8")

    data = json.dumps(record, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    parts = {
        "title": html.escape(title),
        "style": text("page.css") + text(f"{kind}.css"),
        # "<" as an escape: no text of the data can end the element.
        "data": data.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029"),
        "script": "\n".join(map(text, scripts)),
    }
    page = text(f"{kind}.html")
    pieces = page.split("{{")
    filled = [pieces[0]]
    for piece in pieces[1:]:
        name, rest = piece.split("}}", 1)
        filled += [parts[name], rest]
    write_whole(path, "".join(filled))
    return path
