"""The pages of results folders: a run with the truth, a sweep as tables that one can sort. No import of torch here."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from experiments.results import read_json
from experiments.runs.config import CasesConfig, SceneConfig
from experiments.runs.saved import Results
from experiments.sweeps.config import SweepConfig
from experiments.sweeps.swept import Swept
from torchfsid.commands.page.write import run_page, tables_page


def results_page(folder: Path, config: SceneConfig | CasesConfig) -> str:
    """The page of a scene or of Table I, with the true goals. Bodies that move with the robot are not drawn."""
    results = Results(folder, config)
    truth = dict(zip(results.robots, results.goals.tolist(), strict=True))
    outside = results.summary.get("truth_outside", {}).get(results.config.set, {})
    told = {
        robot: [["truth outside its set", f"at {outside[robot]} of {len(results.t)} samples"]]
        for robot in results.robots
        if robot in outside
    }
    return run_page(folder, truth, told)


def sweep_page(folder: Path, config: SweepConfig) -> str:
    """The page of a sweep: a table of the points of its grid, and one of all its runs."""
    summary, runs = read_json(folder / "summary.json"), Swept(folder, config).all_runs
    points = [_flat(point) for point in summary["points"]]
    names = list(dict.fromkeys(name for point in points for name in point if name != "point"))
    rows = [[*point["point"], *(point.get(name) for name in names)] for point in points]
    failed = f", {summary['failed']} failed (see the column error)" if summary["failed"] else ""
    lead = f"A sweep: {summary['runs']} of {config.runs} runs{failed}."
    cells = {name.replace("_", " "): [_plain(value) for value in values] for name, values in runs.items()}
    told = {name: values for name, values in cells.items() if any(value is not None for value in values)}
    return tables_page(
        {
            "title": summary["title"],
            "lead": f"{lead} Sizes and errors are in metres, at the last of its times.",
            "tables": [
                {"title": "Points of the grid", "columns": [*summary["keys"], *names], "rows": rows},
                {"title": "Runs", "columns": list(told), "rows": list(zip(*told.values(), strict=True))},
            ],
        }
    )


def _flat(point: dict[str, Any]) -> dict[str, Any]:
    """A point of summary.json with a name for each number. Of quantiles, the table has the median."""
    flat: dict[str, Any] = {}
    for name, value in point.items():
        words = name.replace("_", " ")
        if isinstance(value, dict):
            flat |= {f"{words} {inner}": found for inner, found in _flat(value).items()}
        elif isinstance(value, list) and name != "point":
            flat[f"{words}, median"] = value[len(value) // 2]
        else:
            flat[name if name == "point" else words] = value
    return flat


def _plain(value: Any) -> Any:
    """A cell as JSON has it. What is not finite is None."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or value == "" or (isinstance(value, float) and not np.isfinite(value)):
        return None
    return value if isinstance(value, int | float | str) else json.dumps(value)
