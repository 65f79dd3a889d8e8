"""The figures of a placed probe: the search, the runs with and without probes, and a film of these."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.design.config import ProbePlacementConfig
from experiments.figures.film import Film, spread
from experiments.figures.probe import draw_before_after, draw_map, draw_search, name_of
from experiments.results import damaged, read_json, reading

FRAMES, FRAME_MS, COLOURS = 40, 120, 96
SIZE, DPI = (8.0, 2.6), 90


def draw_placement(folder: Path, config: ProbePlacementConfig) -> Iterator[tuple[str, Figure | Film]]:
    """The figures and the film, with their names."""
    replay = _replay(folder / "replay.json")
    yield "figure", draw_search(folder, config)
    yield "comparison", draw_before_after(replay, config)
    yield "animation", _film(replay, config)


def _film(replay: dict[str, Any], config: ProbePlacementConfig) -> Film:
    """The same goal without a probe and with the path that was found: a frame per sample, at most `FRAMES`."""
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


def _replay(path: Path) -> dict[str, Any]:
    """The runs with one goal, without a probe and with several. The content is checked, so that it can be drawn."""
    with reading(path):
        replay = read_json(path)
        _points(replay["goal"], *replay["obstacles"])
        for run in replay["runs"]:
            name_of(run)
            _points(*(run["way_point_places"] or []))
            for sample in run["samples"]:
                _points(sample["x"], *sample["vertices"], *([sample["probe"]] if sample["probe"] else []))
                _points([sample["t"], sample["area"]])
                sample["active"] = list(sample["active"])
    if len({len(run["samples"]) for run in replay["runs"]}) != 1 or not replay["runs"][0]["samples"]:
        damaged(path, "its runs are of different lengths")
    return replay


def _points(*points: Any) -> None:
    """Check that these are pairs of numbers, by a ValueError or TypeError."""
    np.array(points, dtype=float).reshape(len(points), 2)
