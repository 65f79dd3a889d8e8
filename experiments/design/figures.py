"""Every figure of a design, from its results folder alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from matplotlib.figure import Figure

from experiments.design.config import ProbePlacementConfig, load_design
from experiments.figures.learning import draw_learning
from experiments.figures.probe import draw_before_after, draw_search
from experiments.figures.probe_animation import animate

Save = Callable[[Figure, Path, str], list[Path]]


def draw_design(folder: Path, save: Save) -> list[Path]:
    """figure.png and figure.pdf; of a probe also comparison.png, comparison.pdf and animation.gif."""
    config = load_design(folder / "config.yaml")
    if not isinstance(config, ProbePlacementConfig):
        return save(draw_learning(folder, config), folder, "figure")
    paths = save(draw_search(folder, config), folder, "figure")
    paths += save(draw_before_after(folder, config), folder, "comparison")
    return [*paths, animate(folder, config, folder / "animation.gif")]
