"""Every figure of a results folder, from its files alone."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from experiments.design.config import MODELS as DESIGNS
from experiments.figures.animation import animate
from experiments.figures.cases import draw_cases
from experiments.figures.single import draw_single
from experiments.figures.style import STYLE
from experiments.figures.swarm import draw_swarm
from experiments.figures.team import draw_comparison, draw_team
from experiments.runs.config import CasesConfig, SwarmConfig
from experiments.runs.saved import Results
from torchfsid.config.documents import load, read_yaml


def draw(folder: Path) -> list[Path]:
    """Draw figure.png and figure.pdf; of a scene also animation.gif, of a team also comparison.png and comparison.pdf;
    of a sweep with a second line in its grid, one figure per entry of that line instead.

    Raises:
        ConfigError: the folder has no readable config.yaml.
        OSError: another of its files cannot be read, or a figure cannot be written.
    """
    kind = read_yaml(folder / "config.yaml").get("kind")
    with mpl.rc_context(STYLE):
        if kind == "sweep":
            return _draw_sweep(folder)
        if kind == "swarm":
            config = load(folder / "config.yaml", SwarmConfig)
            return _save(draw_swarm(folder, config), folder, "figure")
        if kind in DESIGNS:
            from experiments.design.figures import draw_design

            return draw_design(folder, _save)
        results = Results(folder)
        config = results.config
        if isinstance(config, CasesConfig):
            return _save(draw_cases(results, config), folder, "figure")
        if len(config.robots) == 1:
            paths = _save(draw_single(results, config), folder, "figure")
        else:
            paths = _save(draw_team(results, config), folder, "figure")
            paths += _save(draw_comparison(results, config), folder, "comparison")
        return [*paths, animate(results, config, folder / "animation.gif")]


def _draw_sweep(folder: Path) -> list[Path]:
    from experiments.figures.sweep import draw_sweep
    from experiments.sweeps.swept import Swept

    swept = Swept(folder)
    if len(swept.config.axes) < 2:
        return _save(draw_sweep(swept, None), folder, "figure")
    figures = [(draw_sweep(swept, i), label) for i, label in enumerate(swept.labels(1))]
    return [path for figure, label in figures for path in _save(figure, folder, f"figure_{'_'.join(label)}")]


def _save(figure: Figure, folder: Path, name: str) -> list[Path]:
    paths = [folder / f"{name}.png", folder / f"{name}.pdf"]
    for path in paths:
        # No date in the PDF: the same results give the same file.
        figure.savefig(path, metadata={"CreationDate": None} if path.suffix == ".pdf" else None)
        # Once is enough: the layout is the slowest part of drawing.
        figure.set_layout_engine("none")
    return paths
