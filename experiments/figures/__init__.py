"""The figures of a results folder, drawn from its files alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from experiments.figures.film import Film
from experiments.figures.style import STYLE
from experiments.kinds import KINDS
from experiments.results import require
from torchfsid.commands.results_folder import named


def draw(folder: Path, config: Any) -> list[Path]:
    """Draw all figures of the configuration's kind, each figure as PNG and PDF, each film as GIF.

    Raises:
        FigureError: a needed file is missing or damaged.
        OSError: a figure cannot be written.
    """
    require(folder, config.kind)
    paths = []
    with mpl.rc_context(STYLE):
        for name, drawn in KINDS[config.kind].draw(folder, config):
            paths += _save(drawn, folder, name)
    return paths


def _save(drawn: Figure | Film, folder: Path, name: str) -> list[Path]:
    if isinstance(drawn, Film):
        path = folder / f"{name}.gif"
        with named(path):
            drawn.save(path)
        return [path]
    paths = [folder / f"{name}.png", folder / f"{name}.pdf"]
    for path in paths:
        # No date in the PDF: the same results give the same file.
        with named(path):
            drawn.savefig(path, metadata={"CreationDate": None} if path.suffix == ".pdf" else None)
        # Computed once: the layout is the slowest part of drawing.
        drawn.set_layout_engine("none")
    return paths
