"""What all figures of the commands share: style, colours, names, thinning, readable axes, and how they are written."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.font_manager import get_font_names
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from torchfsid.commands.results_folder import write_whole
from torchfsid.errors import FigureError, one_line

ROBOT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F5539", "#4D4D4D")
"""Okabe and Ito's colours, readable for the colour-blind; reused in turn beyond eight robots."""

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "savefig.dpi": 160,
    "pdf.fonttype": 42,
}


MOST_POINTS = 2000
"""Of a line or a row of cells: more than a figure is wide, drawn in the time of a few."""

MOST_NAMED = 24
"""Robots beyond which a legend names none."""

WIDE_FONTS = (
    "Noto Sans CJK JP",
    "Noto Sans CJK SC",
    "Noto Sans CJK KR",
    "Noto Sans Arabic",
    "Noto Sans Devanagari",
    "WenQuanYi Zen Hei",
    "Droid Sans Fallback",
    "Hiragino Sans",
    "Microsoft YaHei",
    "Arial Unicode MS",
    "Unifont",
)
"""Fonts for names that the default font cannot write, taken where they are installed."""


def render(name: Path, size: tuple[float, float], draw: Callable[[Figure], None]) -> list[Path]:
    """Draw a figure of this size [inches] and write it as `name`.png and `name`.pdf.

    Raises:
        FigureError: matplotlib fails.
        OSError: a figure cannot be written.
    """
    paths, drawn = [name.with_suffix(".png"), name.with_suffix(".pdf")], []
    try:
        with mpl.rc_context({**STYLE, "font.family": _fonts()}), warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Glyph .* missing from")  # if no font has a glyph, a box is drawn
            figure = Figure(figsize=size, layout="constrained")
            draw(figure)
            for path in paths:
                content = io.BytesIO()
                figure.savefig(content, format=path.suffix[1:])
                figure.set_layout_engine("none")  # computed once: the layout is the slowest part of drawing
                drawn.append(content.getvalue())
    except Exception as error:  # unusual names and numbers make matplotlib raise many kinds
        raise FigureError(f"{paths[0]}: not drawn: {one_line(error)}") from error
    for path, content in zip(paths, drawn, strict=True):
        write_whole(path, content)
    return paths


def _fonts() -> list[str]:
    there = set(get_font_names())
    return ["sans-serif", *(font for font in WIDE_FONTS if font in there)]


def thinned(values: np.ndarray) -> np.ndarray:
    """At most `MOST_POINTS` of the values, evenly spaced, the last one included."""
    step = -(-len(values) // MOST_POINTS)
    return values if step <= 1 else values[(len(values) - 1) % step :: step]


def plain_name(name: str) -> str:
    """The name for matplotlib: a dollar starts no formula, and a leading underscore does not hide it from a legend."""
    name = name if len(name) <= 24 else f"{name[:23]}…"
    return (" " if name.startswith("_") else "") + name.replace("$", r"\$")


def readable_log_axis(axis: Axis, low: float, high: float) -> None:
    """Plain numbers on a logarithmic axis from low to high, as many as can be read."""
    decades = math.log10(high / low)
    steps = (1, 2, 3, 4, 5, 6, 7, 8, 9) if decades < 0.7 else (1, 2, 3, 5) if decades < 1.3 else (1, 2, 5)
    axis.set_major_locator(LogLocator(subs=steps if decades < 2.5 else (1,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def colour(i: int) -> str:
    """The colour of the robot with this index."""
    return ROBOT_COLOURS[i % len(ROBOT_COLOURS)]
