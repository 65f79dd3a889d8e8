"""The figure of a scan: the smallest bound of each robot, and that for all, over the values of a key."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from torchfsid.commands.figure_style import MOST_NAMED, colour, plain_name, readable_log_axis, render
from torchfsid.commands.scan import WIDE, Scan


def draw_scan(out: Path, found: Scan) -> list[Path]:
    """Draw scan.png and scan.pdf into the folder.

    Raises:
        FigureError: matplotlib fails.
        OSError: a figure cannot be written.
    """

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        values = np.array(list(found.bounds))
        bounds = np.array(list(found.bounds.values()))
        bounds[np.isinf(bounds)] = np.nan
        for i, robot in enumerate(found.robots):
            axes.plot(values, bounds[:, i], color=colour(i), lw=1.2, marker=".", ms=4, label=plain_name(robot))
        largest = np.array([found.largest(value) for value in values])
        axes.plot(values, np.where(np.isinf(largest), np.nan, largest), color="0.15", lw=2.4, alpha=0.35, label="all")
        if not math.isinf(found.largest(found.best)):
            axes.axvline(found.best, color="0.15", lw=1, label=f"best: {found.best:.4g}")
        if found.declared is not None:
            axes.axvline(found.declared, color="0.45", lw=1, ls="--", label=f"declared: {found.declared:.4g}")
        if values[0] > 0 and values[-1] >= WIDE * values[0]:
            axes.set_xscale("log")
            readable_log_axis(axes.xaxis, values[0], values[-1])
        sizes = bounds[np.isfinite(bounds) & (bounds > 0)]
        if len(sizes) and sizes.max() > 2 * sizes.min():
            axes.set_yscale("log")
            readable_log_axis(axes.yaxis, sizes.min(), sizes.max())
        else:
            axes.set_ylim(bottom=0)
        if missing := int(np.isnan(bounds).any(axis=1).sum()):
            axes.set_title(f"{missing} values explain some robot with no bound", fontsize=8, fontweight="normal")
        axes.set_xlabel(found.key)
        axes.set_ylabel(f"smallest {found.quantity} bound [{found.unit}]")
        axes.grid(color="0.93", lw=0.6)
        named = len(found.robots) <= MOST_NAMED
        handles, labels = axes.get_legend_handles_labels()
        kept = slice(None) if named else slice(len(found.robots), None)
        axes.legend(
            handles[kept],
            labels[kept],
            title="robot" if named else None,
            fontsize=8,
            loc="upper left",
            bbox_to_anchor=(1.0, 1.0),
        )

    return render(out / "scan", (7.5, 4.2), draw)
