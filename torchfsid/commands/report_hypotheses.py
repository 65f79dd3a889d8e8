"""What `torchfsid observe` prints of several hypotheses: which are left for each robot, and what refuted the others."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from torchfsid.commands.clock import Clock
from torchfsid.commands.fitted_table import Column, fits, plain_table
from torchfsid.commands.hypotheses import Hypotheses, HypothesisVerdict
from torchfsid.commands.report import print_bound, print_lines, print_outliers, red, size
from torchfsid.observers.safety import SafetyObserver
from torchfsid.outcome import Status

MOST_COLUMNS = 4
"""Models beyond which the table has a line, not a column, for each."""


def print_hypotheses(hypotheses: Hypotheses, out: Path, console: Console) -> None:
    """Print which hypotheses are left for each robot, and what refuted the others."""
    first = next(iter(hypotheses.observations.values()))
    names = list(hypotheses.observations)
    print_lines(first.declared.clock.sentence(), console)
    console.print(_table(hypotheses, first.declared.clock, console))
    console.print("possible: no contradiction was seen. That is no proof of the model.")
    for name, observation in hypotheses.observations.items():
        if observation.narrowing is not None:
            print_lines([f"{name}: {line}" for line in observation.narrowing.said()], console)
        if observation.config.outliers:
            console.print(f"[bold]{escape(name)}[/]: ", end="")
            print_outliers(observation, console)
        sets = observation.sets
        explains_some = bool((sets.status < Status.INCONSISTENT).any())
        if isinstance(sets, SafetyObserver) and sets.team_is_refuted and explains_some:
            console.print(escape(f"{name}: the robots have no safety parameters in common, each has its own"))
    if first.declared.recovery is not None:
        print_lines([first.declared.recovery.sentence()], console)
    quantity = first.config.noise.quantity
    print_bound(console, hypotheses.smallest_bounds, hypotheses.bound, quantity)
    console.print(escape(f"Results: {out}/hypotheses.json, and a folder for each of {', '.join(names)}"))


def _table(hypotheses: Hypotheses, clock: Clock, console: Console) -> Table:
    """The verdicts with a column for each model or robot where there is room, otherwise with a line for each."""
    names, found = list(hypotheses.observations), hypotheses.verdicts()
    cells = {robot: [_cell(of_robot.get(name), clock) for name in names] for robot, of_robot in found.items()}
    left = [
        ", ".join(name for name in names if name in of_robot and not of_robot[name].is_refuted) or red("none")
        for of_robot in found.values()
    ]
    robots, title = [escape(robot) for robot in found], "which model is it?"
    if len(names) <= MOST_COLUMNS:
        by_model = zip(names, zip(*cells.values(), strict=True), strict=True)
        of_models = [Column(name, "words", list(column)) for name, column in by_model]
        columns = [Column("robot", "name", robots), *of_models, Column("left", "words", left)]
    else:
        of_robots = [Column(robot, "words", [*cells[robot], last]) for robot, last in zip(found, left, strict=True)]
        columns = [Column("model", "name", [*map(escape, names), "left"]), *of_robots]
    if fits(columns, console):
        return plain_table(title, columns, console)
    lines = [
        (escape(robot), escape(name), cell) for robot in found for name, cell in zip(names, cells[robot], strict=True)
    ]
    of_robots, of_names, verdicts = (list(cells) for cells in zip(*lines, strict=True))
    listed = [
        Column("robot", "name", of_robots),
        Column("model", "name", of_names),
        Column("verdict", "words", verdicts),
    ]
    return plain_table(title, listed, console)


def _cell(verdict: HypothesisVerdict | None, clock: Clock) -> str:
    """What the log says about one model for one robot."""
    if verdict is None:
        return "-"
    if verdict.refuted_at is not None:
        return f"refuted at {clock(verdict.refuted_at)}, by {' / '.join(_rows(verdict))}"
    if verdict.is_refuted:
        return "refuted: no values of its unknown numbers explain it"
    alarm = "" if verdict.status == "ok" else f", {red(verdict.status)}"
    bound = " (bound useless)" if verdict.bound_useless else ""
    return f"possible{bound}, volume {size(verdict.volume)}{alarm}"


def _rows(verdict: HypothesisVerdict) -> list[str]:
    """The labels of the rows in the evidence, each once."""
    return [escape(row) for row in dict.fromkeys(row for _, row in verdict.evidence)]
