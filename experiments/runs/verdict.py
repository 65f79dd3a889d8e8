"""The result of a run as a printed table. All of it is in summary.json."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.markup import escape

from experiments.tables import table

ESTIMATORS = {"ukf": "UKF error", "hybrid": "hybrid error"} | {
    f"{kind} {measure}": f"{name} {measure.replace('sqrt_', '√').replace('cbrt_', '∛')}"
    for kind, name in (("critical_region", "paper's region"), ("inverse_optimal", "inverse-optimal"))
    for measure in ("sqrt_area", "cbrt_volume", "diameter", "centroid", "centre")
}


LONGEST = 10
"""Intervals of a timeline that are printed."""


def print_verdict(summary: dict[str, Any], console: Console) -> None:
    """Print the summary of a scene."""
    for robot, intervals in summary["timeline"].items():
        more = [f"{len(intervals) - LONGEST} more in summary.json"] if len(intervals) > LONGEST else []
        told = "; ".join([*map(_interval, intervals[:LONGEST]), *more])
        console.print(escape(f"{robot}: {told}"), highlight=False)
    if "expected_timeline" in summary:
        console.print(f"Farthest from the expected timeline: {summary['expected_timeline']['deviation']:.3g} s")
    console.print(f"{summary['steps']} steps per robot, of which")
    for counted, promise in (("truth_outside", "the truth was outside"), ("area_grew", "the area grew")):
        counts = ", ".join(f"{sum(of.values())} ({kind})" for kind, of in summary[counted].items())
        console.print(f"  {promise}: {counts}", highlight=False)
    console.print("From when on lengths are below 10 % / 1 % of the prior's \\[s]:")
    robots = list(summary["timeline"])
    shown = table([""], [escape(robot) for robot in robots])
    for name, label in ((name, ESTIMATORS[name]) for name in ESTIMATORS if name in summary["before"]):
        of_shares = [summary["time_below"][share][name] for share in ("10%", "1%")]
        shown.add_row(label, *(" / ".join(_time(of[robot]) for of in of_shares) for robot in robots))
    relaxed = summary["relaxed_samples"]
    if any(relaxed.values()):
        shown.add_section()
        shown.add_row("samples whose rows may be relaxed", *(str(relaxed[robot]) for robot in robots))
    console.print(shown)
    for robot in robots:
        if summary["infeasible_steps"][robot] and not relaxed[robot]:
            console.print(
                f"[red]{escape(robot)}: {summary['infeasible_steps'][robot]} steps without a feasible control"
            )
        if summary["deadlocked_since"][robot] is not None:
            console.print(f"[red]{escape(robot)}: in deadlock since {summary['deadlocked_since'][robot]:.2f} s")


def _interval(interval: dict[str, Any]) -> str:
    active = ", ".join(interval["active"]) or "none"
    return active if interval["until"] is None else f"{active} until {interval['until']:.2f} s"


def _time(t: float | None) -> str:
    return "never" if t is None else f"{t:.2f}"
