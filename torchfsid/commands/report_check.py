"""What `torchfsid check` prints: bounds and residuals, what contradicts the declared bounds, and the conclusions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from rich.console import Console
from rich.markup import escape

from torchfsid.commands.check import Check
from torchfsid.commands.fitted_table import Column, fitted_table
from torchfsid.commands.report import size
from torchfsid.commands.scan import Scan

BOUNDS = ("robot", "bound", "median", "p95", "max", "at", "samples")
FAULTS = ("robot", "what", "row", "samples", "first")
KINDS: dict[str, Literal["name", "words"]] = {"robot": "name", "what": "words", "row": "name"}


def print_check(found: Check, name: str, console: Console) -> None:
    """Print the smallest bounds, what contradicts the declared bounds, and the conclusions.

    Args:
        found: the result of `check`.
        name: name of the hypothesis, or "".
        console: where to print.
    """
    title = f"smallest {found.quantity} bound and residuals [{found.unit}]"
    bounds = [
        [
            escape(robot.robot),
            *(size(value) for value in (robot.smallest_bound, robot.median, robot.p95, robot.worst)),
            "-" if math.isnan(robot.worst_time) else found.clock(robot.worst_time),
            str(robot.samples),
        ]
        for robot in found.robots
    ]
    faults = [
        [
            escape(robot.robot),
            what,
            escape(f"{fault.row} (soft)" if fault.soft else fault.row),
            str(fault.samples),
            found.clock(fault.first),
            f"{fault.worst:.3g}",
        ]
        for robot in found.robots
        for what, listed in (("unexplained", robot.contradictions), ("violated", robot.violations))
        for fault in listed
    ]
    if name:
        console.print(f"[bold]{escape(name)}[/]")
    _print_table(title, BOUNDS, bounds, ("median", "p95", "samples", "at"), console)
    if faults:
        title = f"at odds with the declared bounds, {found.quantity} {found.declared:.3g} {found.unit}"
        _print_table(title, (*FAULTS, f"worst [{found.unit}]"), faults, ("first", "samples", "what"), console)
    for conclusion in found.conclusions():
        console.print(f"- {escape(conclusion)}", soft_wrap=True)


def print_scan(found: Scan, console: Console) -> None:
    """Print the smallest bounds over the values of a key, the best one marked, and the conclusions."""
    title = f"smallest {found.quantity} bound [{found.unit}] over {found.key}"
    marks = {found.declared: "declared", found.best: "best"}
    columns = [Column(found.key, cells=[f"{value:.5g}" for value in found.bounds])]
    columns += [
        Column(escape(robot), cells=[size(bounds[i]) for bounds in found.bounds.values()])
        for i, robot in enumerate(found.robots)
    ]
    columns.append(Column("largest", cells=[size(found.largest(value)) for value in found.bounds]))
    columns.append(Column("", "words", [marks.get(value, "") for value in found.bounds]))
    console.print(fitted_table(title, columns, [*reversed(found.robots)], console, "see scan.csv (--out)"))
    for conclusion in found.conclusions():
        console.print(f"- {escape(conclusion)}", soft_wrap=True)


def _print_table(
    title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], dropped: Sequence[str], console: Console
) -> None:
    columns = [
        Column(heading, KINDS.get(heading, "number"), list(cells))
        for heading, cells in zip(headings, zip(*rows, strict=True), strict=True)
    ]
    console.print(fitted_table(title, columns, dropped, console, "see check.json (--out), or widen the terminal"))
