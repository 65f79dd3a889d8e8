"""Films, as GIFs. All frames share one palette, which keeps the file small."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

LAST_FRAME_MS = 2000


@dataclass
class Film:
    """Frames of one size.

    Attributes:
        frame_ms: how long a frame is shown [ms]. The last one is shown longer.
        colours: number of colours of the palette.
        frames: the frames so far.
    """

    frame_ms: int
    colours: int
    frames: list[Image.Image] = field(default_factory=list)

    def add(self, canvas: FigureCanvasAgg) -> None:
        """Add what the canvas shows as the next frame."""
        self.frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))

    def save(self, path: Path) -> None:
        """Write the GIF."""
        width, height = self.frames[0].size
        shown = [self.frames[0], self.frames[len(self.frames) // 2], self.frames[-1]]
        strip = Image.new("RGB", (width, height * len(shown)))
        for i, image in enumerate(shown):
            strip.paste(image, (0, i * height))
        palette = strip.quantize(self.colours, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        first, *others = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in self.frames]
        durations = [self.frame_ms] * len(others) + [LAST_FRAME_MS]
        first.save(path, save_all=True, append_images=others, duration=durations, loop=0, optimize=True)


def spread(samples: int, frames: int) -> list[int]:
    """At most `frames` sample indices, evenly spaced, the first and the last sample included."""
    return np.unique(np.linspace(0, samples - 1, frames).round().astype(int)).tolist()
