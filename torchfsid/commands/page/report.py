"""The command `torchfsid report`: the page of a results folder, or of each model where it holds several hypotheses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from torchfsid.commands.page.write import PAGE, run_page, tables_page
from torchfsid.commands.results_folder import ResultsFolder, write_whole
from torchfsid.errors import FigureError, one_line

HYPOTHESES = "hypotheses.json"


def write_report(folder: ResultsFolder) -> Path:
    """`torchfsid report`: write report.html of a results folder. Everything is read before anything is written.

    Raises:
        ConfigError: the folder belongs to somebody else (`ResultsFolder`).
        FigureError: a file that the page needs is missing or damaged.
        OSError: a page cannot be written.
    """
    pages = pages_of(folder.path)
    folder.claim(pages)
    _write(folder.path, pages)
    return folder.path / PAGE


def write_pages(out: Path) -> None:
    """Write report.html of a results folder that this command owns.

    Raises:
        FigureError: a file that the page needs is missing or damaged.
        OSError: a page cannot be written.
    """
    _write(out, pages_of(out))


def pages_of(out: Path) -> dict[str, str]:
    """The pages of a results folder, by name of file.

    Raises:
        FigureError: a file that the page needs is missing or damaged.
    """
    return hypotheses_pages(out) if (out / HYPOTHESES).is_file() else {PAGE: run_page(out)}


def _write(out: Path, pages: dict[str, str]) -> None:
    for name, page in pages.items():
        write_whole(out / name, page)


def hypotheses_pages(out: Path) -> dict[str, str]:
    """The page of each model of several hypotheses, and a table of the models that links to them, by name of file.

    Raises:
        FigureError: a file is missing or damaged.
    """
    try:
        robots: dict[str, dict[str, Any]] = json.loads((out / HYPOTHESES).read_text(encoding="utf-8"))
        models = list(dict.fromkeys(model for of_robot in robots.values() for model in of_robot))
        rows = [_row(robot, model, of) for robot, of_robot in robots.items() for model, of in of_robot.items()]
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise FigureError(f"{out / HYPOTHESES}: missing or damaged: {one_line(error)}") from error
    columns = ["robot", "model", "verdict", "refuted at [s]", "by", "volume at the end"]
    counts = f"{len(robots)} robots under {len(models)} models."
    record = {
        "title": f"{out.resolve().name}: which model is it?",
        "lead": f"{counts} A log can only refute: what is possible may still be wrong.",
        "tables": [{"title": "Every robot under every model", "columns": columns, "rows": rows}],
    }
    return {f"{model}/{PAGE}": run_page(out / model) for model in models} | {PAGE: tables_page(record)}


def _row(robot: str, model: str, of: dict[str, Any]) -> list[Any]:
    verdict = {"ok": "possible", "inconsistent": "refuted"}.get(of["status"], f"possible, {of['status']}")
    rows = ", ".join(dict.fromkeys(found["row"] for found in of["evidence"]))
    return [robot, [model, f"{model}/{PAGE}"], verdict, of["refuted_at"], rows, of["volume"]]
