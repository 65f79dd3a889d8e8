"""Before and after as a GIF: the same goal without a probe and with the path that was found."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from experiments.design.config import ProbePlacementConfig
from experiments.design.tables import read_json
from experiments.figures.probe import draw_map, name_of

FRAME_MS, LAST_FRAME_MS = 120, 2000
FRAMES = 40
SIZE, DPI = (8.0, 2.6), 90
COLOURS = 96


def animate(folder: Path, config: ProbePlacementConfig, path: Path) -> Path:
    """One frame per sample, at most `FRAMES`."""
    replay = read_json(folder / "replay.json")
    shown = [replay["runs"][0], replay["runs"][-1]]
    count = len(shown[0]["samples"])
    frames = []
    with mpl.rc_context({"font.size": 8, "axes.titlesize": 8.5}):
        for k in np.unique(np.linspace(0, count - 1, FRAMES).round().astype(int)):
            figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
            canvas = FigureCanvasAgg(figure)
            for axes, run in zip(figure.subplots(1, 2), shown, strict=True):
                draw_map(axes, replay, run, config, int(k))
                sample = run["samples"][k]
                axes.set_title(f"{name_of(run)}   t = {sample['t']:.2f} s   area {sample['area']:.3f} m²")
            canvas.draw()
            image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
            frames.append(image.quantize(COLOURS, dither=Image.Dither.NONE))
    durations = [FRAME_MS] * (len(frames) - 1) + [LAST_FRAME_MS]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=True)
    return path
