"""The figures of a scene with one robot or a team, as in the paper, and in the plane a film of the run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from matplotlib.figure import Figure

from experiments.figures.animation import animate
from experiments.figures.film import Film
from experiments.figures.single import draw_single
from experiments.figures.space import draw_snapshots
from experiments.figures.team import draw_comparison, draw_team
from experiments.runs.config import SceneConfig
from experiments.runs.saved import Results


def draw_scene(folder: Path, config: SceneConfig) -> Iterator[tuple[str, Figure | Film]]:
    """The figures and the film, with their names."""
    results = Results(folder, config)
    if config.dimension == 3:
        yield "figure", draw_snapshots(results, config)
        yield "comparison", draw_comparison(results, config)
        return
    if len(config.robots) == 1:
        yield "figure", draw_single(results, config)
    else:
        yield "figure", draw_team(results, config)
        yield "comparison", draw_comparison(results, config)
    yield "animation", animate(results, config)
