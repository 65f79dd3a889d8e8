"""What the commands print: a line per robot, and the conclusions as sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from torchfsid.commands.check import Check
from torchfsid.commands.hypotheses import Hypotheses, HypothesisVerdict
from torchfsid.commands.judged_bound import JudgedBound
from torchfsid.commands.observe import Observation, Verdict
from torchfsid.commands.results import STATUS_NAMES, constraint_name, seconds
from torchfsid.commands.terminal import digits, ends, table
from torchfsid.logs.reading import Reading
from torchfsid.observers.safety import SafetyObserver
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status

MOST_EVENTS = 8
"""Contradictions that are printed."""

MOST_COLUMNS = 4
"""Models beyond which the table of hypotheses has a line, not a column, for each."""


def print_verdicts(observation: Observation, out: Path, console: Console) -> None:
    """Print the final set of each robot."""
    numbers = ("skipped", "volume", "diameter", "centroid", "centre", "radius", "shrank last")
    verdicts = table(
        f"{len(observation.log.t)} samples, set: {observation.config.set}", ["robot", "cases"], [*numbers, "status"]
    )
    verdicts.columns[-1].justify = "left"
    found = observation.verdicts()
    for verdict in found:
        since = verdict.no_information_since
        shown = observation.bound.cell(verdict.status, observation.smallest_bounds is not None)
        is_doubtful = verdict.status != "ok" or observation.bound.is_useless
        resets = "".join(f", reset at {seconds(t)}" for t in verdict.resets)
        aside = f", {verdict.unexplained} set aside" if verdict.unexplained else ""
        verdicts.add_row(
            escape(verdict.robot),
            " ".join(f"{case}:{count}" for case, count in verdict.cases.items() if count),
            str(verdict.skipped),
            _size(verdict.volume),
            _size(verdict.diameter),
            _point(verdict.centroid, verdict),
            _point(verdict.centre, verdict),
            _size(verdict.radius),
            "never" if since is None else seconds(since),
            (_red(shown) if is_doubtful else shown) + resets + aside,
        )
    console.print(verdicts)
    if infeasible := [f"{verdict.robot} {verdict.infeasible}" for verdict in found if verdict.infeasible]:
        console.print(
            f"Rows may have been infeasible, and the controller took the least violation (of {len(observation.log.t)} "
            f"samples): {escape(', '.join(infeasible))}. These samples are not used."
        )
    if observation.declared.contacts:
        console.print(
            f"{observation.declared.contacts} times a body did not move as its logged velocity says (contacts?). "
            "The velocity it arrived with counts as uncertain."
        )
    if observation.declared.recovery is not None:
        _print_lines([observation.declared.recovery.sentence()], console)
    _print_events(observation, console)
    if isinstance(observation.sets, SetMembershipObserver) and observation.sets.windows_used:
        shares = ", ".join(f"{length:g} s {share:.0%}" for length, share in observation.sets.windows_used.items())
        console.print(f"Windows over positions that were used: {shares}")
        if "previous" in observation.config.neighbour_velocities:
            console.print(
                "Rows that use velocities (orca, neighbour_velocity: previous) are hardly known from positions: log "
                "velocities if you can."
            )
    if observation.narrowing is not None:
        _print_lines(observation.narrowing.said(), console)
    if observation.config.outliers:
        _print_outliers(observation, console)
    if isinstance(observation.sets, SafetyObserver):
        _print_safety(observation.sets, observation.robots, observation.declared.row_labels, console)
    noise = observation.config.noise
    _print_bound(console, observation.smallest_bounds, observation.bound, noise.quantity)
    if strained := observation.strained():
        console.print(
            f"More than half of noise.{noise.quantity}, {observation.bound_used:g} {noise.unit}, is needed by "
            f"{escape(', '.join(strained))}: if the errors are not that large, the model is wrong (torchfsid check)"
        )
    files = ("estimates.csv", "regions.json", "config.yaml", "regions.png", "regions.pdf", "safety.png", "safety.pdf")
    there = ", ".join(file for file in files if (out / file).is_file())
    console.print(escape(f"Results: {out}/{there}"))


def _print_events(observation: Observation, console: Console) -> None:
    """Print when and by which rows the robots were first contradicted."""
    events, labels = observation.sets.events, observation.declared.row_labels
    for event in events[:MOST_EVENTS]:
        rows = dict.fromkeys(
            constraint_name(source, labels) + ("" if math.isnan(time) or time == event.t else f" at {seconds(time)}")
            for time, source in event.rows
        )
        what = "is violated" if event.status == Status.ALARM else "contradict each other"
        named = ", ".join(rows) or "the prior"
        console.print(
            escape(
                f"{observation.robots[event.robot]} at {seconds(event.t)}: {STATUS_NAMES[event.status]}: {named} {what}"
            ),
            soft_wrap=True,
        )
    if len(events) > MOST_EVENTS:
        console.print(f"... and {len(events) - MOST_EVENTS} more, see regions.json")
    if any(verdict.status != "ok" for verdict in observation.verdicts()):
        console.print("torchfsid check says which rows and which bounds do not fit.")


def _print_lines(lines: Sequence[str], console: Console) -> None:
    for line in lines:
        console.print(escape(line), soft_wrap=True)


def _print_outliers(observation: Observation, console: Console) -> None:
    """Print what the sets promise, and the samples that are set aside."""
    q, labels = observation.config.outliers, observation.declared.row_labels
    samples = "sample is an outlier" if q == 1 else "samples are outliers"
    console.print(f"outliers: {q}: a set holds the truth if at most {q} of its robot's {samples}")
    for verdict in observation.verdicts():
        for certain in (True, False):
            if named := [
                f"{seconds(sample.t)} ({', '.join(dict.fromkeys(constraint_name(s, labels) for s in sample.sources))})"
                for sample in verdict.set_aside
                if sample.is_certain == certain
            ]:
                what = "set aside" if certain else "set aside, but it is not certain which of these"
                console.print(escape(f"{verdict.robot}: {what}: {', '.join(named)}"), soft_wrap=True)


def _print_safety(observer: SafetyObserver, robots: Sequence[str], labels: Sequence[str], console: Console) -> None:
    """Print what was learned about the safety parameters, of the team or of each robot."""
    unknown = observer.model.unknown
    what = "safety distance" if unknown.margin is None else "margin"
    shown = table("safety parameters", ["of"], ["gain", f"{what} [m]"])
    intervals, (of_gain, of_distance) = unknown.intervals(observer.safety), unknown.bounded_by_data(observer.safety)
    for i, name in enumerate(["the team"] if observer.is_shared else robots):
        gain = ends(intervals.gain[i].tolist(), of_gain[i].tolist())
        shown.add_row(escape(name), gain, ends(intervals.distance[i].tolist(), of_distance[i].tolist()))
    console.print(shown)
    if not bool(of_gain.all() & of_distance.all()):
        console.print("* not bounded by the data: this end holds only because of the declared interval")
    for refutation in observer.refutations:
        rows = dict.fromkeys(
            f"{robots[robot]} {labels[row]} at {seconds(time)}" for time, robot, row in refutation.rows
        )
        whose = (
            "the team has no safety parameters in common"
            if refutation.robot is None
            else f"no safety parameters explain {robots[refutation.robot]}"
        )
        reasons = [f"these contradict each other: {', '.join(rows)}"] if rows else []
        if refutation.unexplained:
            whom = ", ".join(robots[robot] for robot in refutation.unexplained)
            reasons.append(f"no theta in the prior explains the motion of {whom} with those that are left")
        console.print(escape("; ".join([f"{whose}, found at {seconds(refutation.t)}", *reasons])), soft_wrap=True)
    if bool((observer.status >= Status.INCONSISTENT).all()):
        console.print(
            "no robot is explained by any safety parameters: something else in the model or the prior is wrong"
        )
    if odd := [robots[robot] for robot in observer.odd()]:
        names = odd[0] if len(odd) == 1 else f"one of {', '.join(odd)}"
        console.print(escape(f"without {names} the others can have the same parameters"))


def print_reading(reading: Reading, console: Console) -> None:
    """Print what was found while the log was read."""
    for sentence in reading.sentences():
        console.print(escape(sentence), soft_wrap=True)


def print_hypotheses(hypotheses: Hypotheses, out: Path, console: Console) -> None:
    """Print which hypotheses are left for each robot, and what refuted the others."""
    names, found = list(hypotheses.observations), hypotheses.verdicts()
    cells = {robot: [_cell(of_robot.get(name)) for name in names] for robot, of_robot in found.items()}
    left = [
        ", ".join(name for name in names if name in of_robot and not of_robot[name].is_refuted) or _red("none")
        for of_robot in found.values()
    ]
    if len(names) <= MOST_COLUMNS:
        verdicts = table("which model is it?", ["robot"], [*names, "left"])
        for robot, of_robot, names_left in zip(found, cells.values(), left, strict=True):
            verdicts.add_row(escape(robot), *of_robot, names_left)
    else:
        verdicts = table("which model is it?", ["model"], list(found))
        for name, of_model in zip(names, zip(*cells.values(), strict=True), strict=True):
            verdicts.add_row(escape(name), *of_model)
        verdicts.add_section()
        verdicts.add_row("left", *left)
    for column in verdicts.columns[1:]:
        column.justify = "left"
    console.print(verdicts)
    for name, observation in hypotheses.observations.items():
        if observation.narrowing is not None:
            _print_lines([f"{name}: {line}" for line in observation.narrowing.said()], console)
        if observation.config.outliers:
            console.print(f"[bold]{escape(name)}[/]: ", end="")
            _print_outliers(observation, console)
        sets = observation.sets
        explains_some = bool((sets.status < Status.INCONSISTENT).any())
        if isinstance(sets, SafetyObserver) and sets.team_is_refuted and explains_some:
            console.print(escape(f"{name}: the robots have no safety parameters in common, each has its own"))
    first = next(iter(hypotheses.observations.values()))
    if first.declared.recovery is not None:
        _print_lines([first.declared.recovery.sentence()], console)
    quantity = first.config.noise.quantity
    _print_bound(console, hypotheses.smallest_bounds, hypotheses.bound, quantity)
    console.print(escape(f"Results: {out}/hypotheses.json, and a folder for each of {', '.join(names)}"))


def _cell(verdict: HypothesisVerdict | None) -> str:
    """What the log says about one model for one robot."""
    if verdict is None:
        return "-"
    if verdict.refuted_at is not None:
        return f"refuted at {seconds(verdict.refuted_at)} by {' / '.join(_rows(verdict))}"
    if verdict.is_refuted:
        return "refuted: no values of its unknown numbers explain it"
    alarm = "" if verdict.status == "ok" else f", {_red(verdict.status)}"
    bound = " (bound useless)" if verdict.bound_useless else ""
    return f"possible{bound}, volume {_size(verdict.volume)}{alarm}"


def print_check(found: Check, name: str, console: Console) -> None:
    """Print the smallest bounds, what contradicts the declared bounds, and the conclusions.

    Args:
        found: the result of `check`.
        name: name of the hypothesis, or "".
        console: where to print.
    """
    robots = table(
        f"smallest {found.quantity} bound and residuals [{found.unit}]",
        ["robot"],
        ["bound", "median", "p95", "max", "at", "samples"],
    )
    faults = table(
        f"at odds with the declared bounds, {found.quantity} {found.declared:.3g} {found.unit}",
        ["robot", "what", "row"],
        ["samples", "first", f"worst [{found.unit}]"],
    )
    for robot in found.robots:
        sizes = [_size(size) for size in (robot.smallest_bound, robot.median, robot.p95, robot.worst)]
        robots.add_row(
            escape(robot.robot),
            *sizes,
            "-" if math.isnan(robot.worst_time) else seconds(robot.worst_time),
            str(robot.samples),
        )
        for what, listed in (("unexplained", robot.contradictions), ("violated", robot.violations)):
            for fault in listed:
                row = escape(f"{fault.row} (soft)" if fault.soft else fault.row)
                size = [str(fault.samples), seconds(fault.first), f"{fault.worst:.3g}"]
                faults.add_row(escape(robot.robot), what, row, *size)
    if name:
        console.print(f"[bold]{name}[/]")
    console.print(robots)
    if faults.row_count:
        console.print(faults)
    for conclusion in found.conclusions():
        console.print(f"- {escape(conclusion)}", soft_wrap=True)


def _print_bound(console: Console, smallest: Mapping[str, float] | None, bound: JudgedBound, quantity: str) -> None:
    """Print the bound that `auto` found, and a warning if the bound is useless, found or declared."""
    if smallest is not None:
        robot = max(smallest, key=lambda robot: smallest[robot])
        found = f"noise.{quantity}: auto found {smallest[robot]:.3g} {bound.unit} (robot {robot})"
        takes = f"takes {bound.bound:.3g} {bound.unit}"
        console.print(escape(f"{found}, {takes}: {bound.compared()}"), soft_wrap=True)
    if bound.is_useless:
        more = "" if smallest is None else " (torchfsid check names rows and looks for shifts)"
        warning = escape(bound.warning(is_needed=smallest is not None) + more)
        console.print(f"{_red('Warning:')} {warning}", soft_wrap=True)


def _rows(verdict: HypothesisVerdict) -> list[str]:
    """The labels of the rows in the evidence, each once."""
    return [escape(row) for row in dict.fromkeys(row for _, row in verdict.evidence)]


def _red(text: str) -> str:
    return f"[bold red]{text}[/]"


def _size(value: float) -> str:
    """The size as text. A dash if it is NaN, as that of an empty set."""
    return "-" if math.isnan(value) else f"{value:.3g}"


def _point(values: Sequence[float], verdict: Verdict) -> str:
    """The point as text, with enough digits to locate it within its set."""
    return "(" + ", ".join(digits(value, verdict.diameter) for value in values) + ")"
