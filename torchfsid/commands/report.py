"""What the commands print: a line per robot, and the conclusions as sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from torchfsid.commands.fitted_table import Column, fitted_table
from torchfsid.commands.judged_bound import JudgedBound
from torchfsid.commands.observe import Observation, Verdict
from torchfsid.commands.results import STATUS_NAMES
from torchfsid.commands.results_folder import ResultsFolder
from torchfsid.commands.terminal import digits, ends, table
from torchfsid.commands.where_to_look import constraint_name
from torchfsid.logs.reading import Reading
from torchfsid.observers.safety import SafetyObserver
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status

MUCH = 0.1
"""Share of the typical control from which on a bound that `auto` found may hide an error of the model."""

MOST_NAMED = 24
"""Robots that a line names."""

MOST_EVENTS = 8
"""Contradictions that are printed."""

HEADINGS = (
    "robot", "cases", "skipped", "volume", "diameter", "centroid", "centre", "radius", "shrank last", "truth", "status"
)  # fmt: skip
DROPPED = ("cases", "centre", "skipped", "radius", "shrank last", "volume", "centroid", "diameter")
"""Columns that are left out in a narrow terminal, in this order."""

WRITTEN = (
    "estimates.csv", "sets.csv", "motion.csv", "regions.json", "config.yaml", "regions.png", "regions.pdf",
    "safety.png", "safety.pdf", "velocity_bound.json", "acceleration_bound.json", "unknown_numbers.json",
    "task_gain.json", "report.html",
)  # fmt: skip
"""Files that are named where they are there."""


def print_verdicts(observation: Observation, out: Path, console: Console) -> None:
    """Print the final set of each robot."""
    found, bound = observation.verdicts(), observation.bound
    console.print(_table(observation, found, console))
    _print_trust(found, bound, console)
    print_lines(observation.declared.clock.sentence(), console)
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
        print_lines([observation.declared.recovery.sentence()], console)
    _print_events(observation, found, console)
    if isinstance(observation.sets, SetMembershipObserver) and observation.sets.windows_used:
        shares = ", ".join(f"{length:g} s {share:.0%}" for length, share in observation.sets.windows_used.items())
        console.print(f"Windows over positions that were used: {shares}")
        if "previous" in observation.config.neighbour_velocities:
            console.print(
                "Rows that use velocities (orca, neighbour_velocity: previous) are hardly known from positions: log "
                "velocities if you can."
            )
    if observation.narrowing is not None:
        print_lines(observation.narrowing.said(), console)
    if observation.config.outliers:
        print_outliers(observation, console)
    if isinstance(observation.sets, SafetyObserver):
        _print_safety(observation, observation.sets, console)
    noise = observation.config.noise
    alternative = observation.alternative
    print_bound(console, observation.smallest_bounds, bound, noise.quantity, is_explained=alternative is not None)
    if strained := observation.strained():
        console.print(
            f"More than half of noise.{noise.quantity}, {observation.bound_used:g} {noise.unit}, is needed by "
            f"{escape(', '.join(strained))}: if the errors are not that large, the model is wrong (torchfsid check)"
        )
    if alternative is not None:
        console.print(f"{red('Warning:')} {escape(alternative.sentence(noise.unit))}", soft_wrap=True)
    if large := observation.hardly_cut():
        console.print(
            escape(f"The log says little of {', '.join(large)}: the set is still more than half of the prior."),
            soft_wrap=True,
        )
    there = ", ".join(file for file in WRITTEN if (out / file).is_file())
    console.print(escape(f"Results: {out}/{there}"))


def _table(observation: Observation, found: Sequence[Verdict], console: Console) -> Table:
    """A line per robot."""
    unit, p, clock = observation.config.task.unit, observation.sets.prior.dim, observation.declared.clock
    rows = []
    for verdict in found:
        since = verdict.no_information_since
        shown = observation.bound.cell(verdict.status, observation.smallest_bounds is not None)
        is_doubtful = verdict.status != "ok" or observation.bound.is_useless
        resets = "".join(f", reset at {clock(t)}" for t in verdict.resets)
        aside = f", {verdict.unexplained} set aside" if verdict.unexplained else ""
        rows.append(
            [
                escape(verdict.robot),
                " ".join(f"{case}:{count}" for case, count in verdict.cases.items() if count),
                str(verdict.skipped),
                *_sizes(verdict),
                "never" if since is None else clock(since),
                {None: "-", True: "inside", False: red("outside")}[verdict.holds_truth],
                (red(shown) if is_doubtful else shown) + resets + aside,
            ]
        )
    kinds: dict[str, Literal["name", "words"]] = {
        "robot": "name",
        "cases": "words",
        "truth": "words",
        "status": "words",
    }
    columns = [
        Column(heading, kinds.get(heading, "number"), list(cells))
        for heading, cells in zip(HEADINGS, zip(*rows, strict=True), strict=True)
        if heading != "truth" or observation.config.truth
    ]
    units = f", lengths in {unit}, volume in {unit}{'' if p == 1 else f'^{p}'}" if unit == "m" else ""
    title = f"{len(observation.log.t)} samples, set: {observation.config.set}{units}"
    return fitted_table(title, columns, DROPPED, console, "see regions.json, or widen the terminal")


def _sizes(verdict: Verdict) -> list[str]:
    """What the table says of a set. A set that is not to be trusted has no size."""
    if verdict.status != "ok":
        return ["-"] * 5
    centroid, centre = _point(verdict.centroid, verdict), _point(verdict.centre, verdict)
    return [size(verdict.volume), size(verdict.diameter), centroid, centre, size(verdict.radius)]


def _print_trust(found: Sequence[Verdict], bound: JudgedBound, console: Console) -> None:
    """Print what the statuses mean."""
    if bad := [f"{verdict.robot} ({verdict.status})" for verdict in found if verdict.status != "ok"]:
        said = f"Not to be trusted: {_first(bad)}. The model, the prior or a bound is wrong."
        console.print(red(escape(said)), soft_wrap=True)
    if lost := [verdict.robot for verdict in found if verdict.status == "ok" and verdict.holds_truth is False]:
        said = f"The truth of {_first(lost)} is outside although the status is ok: the model or a bound is wrong."
        console.print(red(escape(said)), soft_wrap=True)
    if not bound.is_useless and any(verdict.status == "ok" for verdict in found):
        console.print("ok: no contradiction was seen. That is no proof of the model.")


def _first(named: Sequence[str]) -> str:
    """The first of these, and how many there are beside them."""
    more = len(named) - MOST_NAMED
    return ", ".join(named[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def _print_events(observation: Observation, found: Sequence[Verdict], console: Console) -> None:
    """Print when and by which constraints robots were first contradicted, and the keys to look at."""
    events, labels, clock = observation.sets.events, observation.declared.row_labels, observation.declared.clock
    to_look: dict[str, list[str]] = {}
    for event in events[:MOST_EVENTS]:
        robot, status = observation.robots[event.robot], STATUS_NAMES[event.status]
        rows = dict.fromkeys(
            constraint_name(source, labels) + ("" if math.isnan(time) or time == event.t else f" at {clock(time)}")
            for time, source in event.rows
        )
        what = "is violated" if event.status == Status.ALARM else "contradict each other"
        print_lines([f"{robot} at {clock(event.t)}: {status}: {', '.join(rows) or 'the prior'} {what}"], console)
        keys = observation.declared.where_to_look(constraint_name(source, labels) for _, source in event.rows)
        to_look.setdefault(keys, []).append(robot)
    if len(events) > MOST_EVENTS:
        console.print(f"... and {len(events) - MOST_EVENTS} more, see regions.json")
    print_lines([f"{', '.join(dict.fromkeys(robots))}: {keys}" for keys, robots in to_look.items()], console)
    if any(verdict.status != "ok" for verdict in found):
        console.print("torchfsid check says which keys and which bounds do not fit.")


def print_lines(lines: Sequence[str], console: Console) -> None:
    for line in lines:
        console.print(escape(line), soft_wrap=True)


def print_outliers(observation: Observation, console: Console) -> None:
    """Print what the sets promise, and the samples that are set aside."""
    q, labels, clock = observation.config.outliers, observation.declared.row_labels, observation.declared.clock
    samples = "sample is an outlier" if q == 1 else "samples are outliers"
    console.print(f"outliers: {q}: a set holds the truth if at most {q} of its robot's {samples}")
    for verdict in observation.verdicts():
        for certain in (True, False):
            if named := [
                f"{clock(sample.t)} ({', '.join(dict.fromkeys(constraint_name(s, labels) for s in sample.sources))})"
                for sample in verdict.set_aside
                if sample.is_certain == certain
            ]:
                what = "set aside" if certain else "set aside, but it is not certain which of these"
                console.print(escape(f"{verdict.robot}: {what}: {', '.join(named)}"), soft_wrap=True)


def _print_safety(observation: Observation, observer: SafetyObserver, console: Console) -> None:
    """Print what was learned about the safety parameters, of the team or of each robot."""
    robots, labels, clock = observation.robots, observation.declared.row_labels, observation.declared.clock
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
        rows = dict.fromkeys(f"{robots[robot]} {labels[row]} at {clock(time)}" for time, robot, row in refutation.rows)
        whose = (
            "the team has no safety parameters in common"
            if refutation.robot is None
            else f"no safety parameters explain {robots[refutation.robot]}"
        )
        reasons = [f"these contradict each other: {', '.join(rows)}"] if rows else []
        if refutation.unexplained:
            whom = ", ".join(robots[robot] for robot in refutation.unexplained)
            reasons.append(f"no theta in the prior explains the motion of {whom} with those that are left")
        console.print(escape("; ".join([f"{whose}, found at {clock(refutation.t)}", *reasons])), soft_wrap=True)
    if bool((observer.status >= Status.INCONSISTENT).all()):
        console.print(
            "no robot is explained by any safety parameters: something else in the model or the prior is wrong"
        )
    if odd := [robots[robot] for robot in observer.odd()]:
        names = odd[0] if len(odd) == 1 else f"one of {', '.join(odd)}"
        console.print(escape(f"without {names} the others can have the same parameters"))


def print_replaced(folder: ResultsFolder, console: Console) -> None:
    """Print that an earlier run is gone."""
    if folder.replaced:
        what = f"the {len(folder.replaced)} files of an earlier run"
        console.print(escape(f"{folder.path}: replaces {what}"), soft_wrap=True)


def print_reading(reading: Reading, console: Console) -> None:
    """Print what was found while the log was read."""
    for sentence in reading.sentences():
        console.print(escape(sentence), soft_wrap=True)


def print_bound(
    console: Console,
    smallest: Mapping[str, float] | None,
    bound: JudgedBound,
    quantity: str,
    is_explained: bool = False,
) -> None:
    """Print the bound that `auto` found, and a warning if the bound is useless, found or declared.

    Args:
        console: where to print.
        smallest: with `auto`, each robot's smallest bound.
        bound: the bound in use.
        quantity: what it bounds.
        is_explained: a key is named that may have made it so large.
    """
    if smallest is not None:
        robot = max(smallest, key=lambda robot: smallest[robot])
        found = f"noise.{quantity}: auto found {smallest[robot]:.3g} {bound.unit} (robot {robot})"
        takes = f"takes {bound.bound:.3g} {bound.unit}"
        console.print(escape(f"{found}, {takes}: {bound.compared()}"), soft_wrap=True)
        if not bound.is_useless and (large := [name for name, of in smallest.items() if of > MUCH * bound.typical]):
            said = (
                f"More than {MUCH:.0%} of the typical control is needed by {', '.join(large)}: if the errors are not "
                "that large, the model is wrong (torchfsid check)"
            )
            console.print(escape(said), soft_wrap=True)
    if bound.is_useless:
        more = "" if smallest is None or is_explained else " (torchfsid check names rows and looks for shifts)"
        warning = escape(bound.warning(smallest is not None, is_explained) + more)
        console.print(f"{red('Warning:')} {warning}", soft_wrap=True)


def red(text: str) -> str:
    return f"[bold red]{text}[/]"


def size(value: float) -> str:
    """The size as text. A dash if it is NaN, as that of an empty set."""
    return "-" if math.isnan(value) else f"{value:.3g}"


def _point(values: Sequence[float], verdict: Verdict) -> str:
    """The point as text, with enough digits to locate it within its set."""
    return "(" + ", ".join(digits(value, verdict.diameter) for value in values) + ")"
