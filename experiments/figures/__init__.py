"""Every figure of a results folder, from its files alone."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from experiments.config import CasesConfig
from experiments.figures.animation import animate
from experiments.figures.cases import draw_cases
from experiments.figures.single import draw_single
from experiments.figures.style import STYLE
from experiments.figures.team import draw_comparison, draw_team
from experiments.saved import Results


def draw(folder: Path) -> list[Path]:
    """Draw figure.png and figure.pdf; of a scene also animation.gif, of a team also comparison.png and comparison.pdf.

    Raises:
        ConfigError: the folder has no readable config.yaml.
        OSError: another of its files cannot be read, or a figure cannot be written.
    """
    results = Results(folder)
    config = results.config
    with mpl.rc_context(STYLE):
        if isinstance(config, CasesConfig):
            return _save(draw_cases(results, config), folder, "figure")
        if len(config.robots) == 1:
            paths = _save(draw_single(results, config), folder, "figure")
        else:
            paths = _save(draw_team(results, config), folder, "figure")
            paths += _save(draw_comparison(results, config), folder, "comparison")
        return [*paths, animate(results, config, folder / "animation.gif")]


def _save(figure: Figure, folder: Path, name: str) -> list[Path]:
    paths = [folder / f"{name}.png", folder / f"{name}.pdf"]
    for path in paths:
        # No date in the PDF: the same results give the same file.
        figure.savefig(path, metadata={"CreationDate": None} if path.suffix == ".pdf" else None)
        # Once is enough: the layout is the slowest part of drawing.
        figure.set_layout_engine("none")
    return paths
