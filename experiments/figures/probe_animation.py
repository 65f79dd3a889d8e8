"""A film of the same goal without a probe and with the path that was found."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.design.config import ProbePlacementConfig
from experiments.figures.film import Film, spread
from experiments.figures.probe import draw_map, name_of

FRAMES, FRAME_MS, COLOURS = 40, 120, 96
SIZE, DPI = (8.0, 2.6), 90


def animate(replay: dict[str, Any], config: ProbePlacementConfig) -> Film:
    """The film: one frame per sample, at most `FRAMES`."""
    shown, film = [replay["runs"][0], replay["runs"][-1]], Film(FRAME_MS, COLOURS)
    with mpl.rc_context({"font.size": 8, "axes.titlesize": 8.5}):
        for k in spread(len(shown[0]["samples"]), FRAMES):
            figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
            canvas = FigureCanvasAgg(figure)
            for axes, run in zip(figure.subplots(1, 2), shown, strict=True):
                draw_map(axes, replay, run, config, k)
                sample = run["samples"][k]
                axes.set_title(f"{name_of(run)}   t = {sample['t']:.2f} s   area {sample['area']:.3f} m²")
            canvas.draw()
            film.add(canvas)
    return film
