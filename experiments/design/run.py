"""One design: from a validated configuration to a results folder, and the table that a run ends with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from experiments.design.config import LearnedObserverConfig, ProbePlacementConfig
from experiments.design.learning import learn
from experiments.design.placement import place
from experiments.design.tables import Track


def run_design(config: ProbePlacementConfig | LearnedObserverConfig, out: Path, track: Track) -> dict[str, Any]:
    """Everything but the figures; returns the summary."""
    return place(config, out, track) if isinstance(config, ProbePlacementConfig) else learn(config, out, track)


def print_design(summary: dict[str, Any], console: Console) -> None:
    if "areas [m^2]" in summary:
        for K, methods in summary["areas [m^2]"].items():
            still = "a probe that stands still" if K == "1" else f"a path of {K} way-points"
            _print(console, f"Mean area left, {still}, {summary['corridors']} corridors", "method", methods)
        cosines = {name: {"cosine": value} for name, value in summary["gradient cosines"].items()}
        _print(console, "Gradient of the mean over goals against central differences", "", cosines)
    else:
        for noise, observers in summary["mean errors by noise [m]"].items():
            _print(console, f"Mean error in m on unseen teams, disturbance up to {noise} m/s", "observer", observers)


def _print(console: Console, title: str, first: str, rows: dict[str, dict[str, float]]) -> None:
    table = Table(title=title, box=SIMPLE_HEAD, title_justify="left")
    table.add_column(first, no_wrap=True)
    for name in next(iter(rows.values()), {}):
        table.add_column(name, justify="right")
    for name, row in rows.items():
        table.add_row(name, *(f"{value:.3g}" if isinstance(value, float) else str(value) for value in row.values()))
    console.print(table)
