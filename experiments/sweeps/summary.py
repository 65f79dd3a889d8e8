"""The summary of a sweep for each point of its grid: summary.json, and a printed table."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from experiments.figures.style import length
from experiments.sweeps.config import SweepConfig
from experiments.sweeps.swept import Swept, quantiles, short
from experiments.tables import table

SIZES = ("sqrt_area", "diameter", "centroid_error")
COUNTS = ("lost_and_inconsistent", "lost_in_silence", "alarm", "inconsistent")
QUANTILES = (0.1, 0.5, 0.9)


def summarise_sweep(folder: Path, config: SweepConfig) -> dict[str, Any]:
    """The content of summary.json. Sizes are quantiles over the robots at the last of the sweep's times."""
    swept = Swept(folder, config)
    levels = itertools.product(*(range(len(axis)) for axis in config.axes))
    return {
        "title": config.title,
        "runs": len(swept.runs["run"]),
        "failed": swept.failed,
        "keys": [", ".join(map(short, swept.telling(axis))) for axis in range(len(config.axes))],
        "points": [_point(swept, at) for at in levels],
    }


def _point(swept: Swept, at: tuple[int, ...]) -> dict[str, Any]:
    runs, series = swept.chosen(swept.runs, at), swept.chosen(swept.series, at)
    last = series["t"] == series["t"].max(initial=0.0)
    robots = int(runs["robots"].sum())
    found: dict[str, Any] = {
        "point": [", ".join(swept.labels(axis)[level]) for axis, level in enumerate(at)],
        "runs": len(runs["run"]),
        "robots": robots,
        "infeasible_steps": int(runs["infeasible_steps"].sum()),
        "relaxed_samples": int(runs["relaxed_samples"].sum()),
        "deadlocked": int(runs["deadlocked"].sum()),
        "cases": {letter: _mean(runs[f"case_{letter}"], runs["robots"]) for letter in "ABCDE"},
        "active_set_seen": _mean(runs["active_set_seen"], runs["robots"]),
    }
    for kind in swept.kinds(runs):
        lost = runs[f"{kind}_lost"]
        counts = {name: int(runs[f"{kind}_{name}"].sum()) for name in COUNTS}
        found[kind] = {"runs_lost": int((lost > 0).sum()), "lost": int(lost.sum()), **counts}
        found[kind] |= {name: _quantiles(series[f"{kind}_{name}"][last]) for name in SIZES}
    return found | {name: _quantiles(series[name][last]) for name in ("ukf_error", "hybrid_error")}


def _mean(values: np.ndarray, weights: np.ndarray) -> float | None:
    return round(float(np.average(values, weights=weights)), 4) if len(values) else None


def _quantiles(values: np.ndarray) -> list[float] | None:
    found = quantiles(values, QUANTILES)
    return None if np.isnan(found).any() else [float(f"{x:.4g}") for x in found]


def print_sweep(summary: dict[str, Any], console: Console) -> None:
    """Print for each point of the grid the robots whose set lost the truth, and medians at the end."""
    numbers = "runs", "robots", "paper's lost", "silently", "√area", "inv.-opt. lost", "√area", "UKF", "hybrid"
    texts, numbers = ([heading.replace(" ", "\n") for heading in of] for of in (summary["keys"], numbers))
    shown = table(texts, numbers)
    for point in summary["points"]:
        paper, ours = point.get("critical_region"), point["inverse_optimal"]
        cells = [str(point["runs"]), str(point["robots"]), "", "", ""]
        if paper is not None:
            cells[2:] = str(paper["lost"]), str(paper["lost_in_silence"]), _median(paper["sqrt_area"])
        cells += str(ours["lost"]), _median(ours["sqrt_area"])
        shown.add_row(*point["point"], *cells, _median(point["ukf_error"]), _median(point["hybrid_error"]))
    console.print(shown)
    if summary["failed"]:
        console.print(f"[red]{summary['failed']} runs failed: see the column error of runs.csv")


def _median(quantiles: list[float] | None) -> str:
    return "" if quantiles is None else length(quantiles[QUANTILES.index(0.5)])
