"""Docstrings of this package as reStructuredText for Sphinx: they are plain text, with displayed formulas indented.

A bar, a star or an underscore at the end of a word has a meaning in reStructuredText, and none in our docstrings, where
|x| is a norm and `*batch` a shape. An indented paragraph is a display, if it is no section such as `Args:`.
"""

from __future__ import annotations

import inspect
import re

from sphinx.application import Sphinx

SECTION = re.compile(r"(Args|Attributes|Raises|Returns|Yields):$")
CODE = re.compile(r"(`+[^`]+`+)")


def escaped(line: str) -> str:
    """The line with its special characters taken literally, outside of code."""
    parts = CODE.split(line)
    parts[::2] = [re.sub(r"([\\|*]|(?<=\w)_(?!\w))", r"\\\1", part) for part in parts[::2]]
    return "".join(parts)


def as_rst(lines: list[str]) -> list[str]:
    """A docstring, as reStructuredText for napoleon."""
    out: list[str] = []
    displayed = False
    for i, line in enumerate(lines):
        starts = i == 0 or not lines[i - 1].strip()
        if starts and line.strip() and not displayed and line.startswith("    "):
            out += ["::", ""]
            displayed = True
        elif line.strip() and not line.startswith(" "):
            displayed = False
        out.append(line if displayed else escaped(line))
    return out


def _convert(app: Sphinx, what: str, name: str, subject: object, options: object, lines: list[str]) -> None:
    if name.startswith(("torchfsid", "experiments")):
        lines[:] = as_rst(lines)


def _correct(app: Sphinx, what: str, name: str, subject: object, options: object, lines: list[str]) -> None:
    """Shapes such as `*batch m`, which napoleon takes from annotations, are code; a property's text is no type."""
    lines[:] = [re.sub(r"^(:vartype \w+: )(.+)$", r"\1``\2``", line.replace("jaxtyping.", "")) for line in lines]
    told = inspect.getdoc(subject) or ""
    if what == "property" and "Raises:" not in told:
        lines[:] = as_rst(told.splitlines())


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", _convert, priority=400)  # before napoleon
    app.connect("autodoc-process-docstring", _correct, priority=600)  # after it
    return {"parallel_read_safe": True}
