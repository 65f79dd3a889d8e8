"""The summary of a scene: the timeline of active obstacles, checks of the theory, and how fast estimators converge.

A share (10 %, 1 %) refers to the value before the first measurement, that of the prior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from torch import Tensor

from experiments.runs.config import ExpectedConfig, ExperimentConfig, SceneConfig
from experiments.runs.observe import Observed
from experiments.runs.saved import Results
from experiments.tables import table
from torchfsid.robots.simulation import Trajectory

SHARES = (0.1, 0.01)

ESTIMATORS = {"ukf": "UKF error", "hybrid": "hybrid error"} | {
    f"{kind} {measure}": f"{name} {measure.replace('sqrt_', '√').replace('cbrt_', '∛')}"
    for kind, name in (("critical_region", "paper's region"), ("inverse_optimal", "inverse-optimal"))
    for measure in ("sqrt_area", "cbrt_volume", "diameter", "centroid", "centre")
}

LONGEST = 10
"""Intervals of a timeline that are printed."""


def summarise_scene(config: SceneConfig, results: Results, observed: Observed, true: Trajectory) -> dict[str, Any]:
    """The content of summary.json."""
    active = {robot: [at[i].active for at in results.regions] for i, robot in enumerate(results.robots)}
    measures, before = results.lengths, results.prior_lengths

    def per_robot(values: list | np.ndarray | Tensor) -> dict[str, Any]:
        return dict(zip(results.robots, values if isinstance(values, list) else values.tolist(), strict=True))

    def until_below(name: str, share: float) -> list[float | None]:
        of_robots = zip(measures[name].T, share * before[name], strict=True)
        return [stays_below(results.t, values, bound) for values, bound in of_robots]

    summary: dict[str, Any] = {
        "title": config.title,
        "settings": settings(config)
        | {"measurement_noise": config.measurement_noise.model_dump(), "seed": config.seed},
        "timeline": {robot: timeline(results.t, names) for robot, names in active.items()},
    }
    if config.expected:
        summary["expected_timeline"] = compare(results.t, active[results.robots[0]], config.expected, config.dt)
    return summary | {
        "steps": len(results.t),
        "truth_outside": {kind: per_robot(outside) for kind, outside in observed.outside.items()},
        "area_grew": {kind: per_robot(results.changes(kind)[0]) for kind in config.sets},
        "ukf_outside": {kind: per_robot(outside) for kind, outside in observed.ukf_outside.items()},
        "before": {name: per_robot(values) for name, values in before.items()},
        "at_snapshots": [
            {"t": float(results.t[k]), **{name: per_robot(values[k]) for name, values in measures.items()}}
            for k in map(results.at, config.snapshots)
        ],
        "time_below": {
            f"{share:.0%}": {name: per_robot(until_below(name, share)) for name in measures} for share in SHARES
        },
        "infeasible_steps": per_robot((~true.feasible).sum(0)),
        "relaxed_samples": per_robot(observed.observers.sets[config.set].infeasible),
        "deadlocked_since": per_robot([None if math.isnan(t) else t for t in true.deadlocked_since.tolist()]),
    }


def settings(config: ExperimentConfig) -> dict[str, Any]:
    """The settings on which every comparison depends."""
    spread = config.ukf.prior_std or config.ukf.spread(config.prior)
    return {
        "dt": config.dt,
        "set": config.set,
        "prior": config.prior.model_dump(),
        "noise_bound": config.noise.control,
        "noise_unit": config.noise.unit,
        "ukf": {"R": config.ukf.position_noise**2, "Q_per_second": config.ukf.process_noise**2, "prior_std": spread},
    }


def stays_below(t: np.ndarray, values: np.ndarray, bound: float) -> float | None:
    """The first time from which the value stays below the bound [s]. None if it is not below at the end.

    NaN, the value of an empty set, is not below.
    """
    above = np.flatnonzero(~(values < bound))
    first = above[-1] + 1 if len(above) else 0
    return float(t[first]) if first < len(t) else None


def timeline(t: np.ndarray, active: Sequence[list[str]]) -> list[dict[str, Any]]:
    """Intervals [from, until) with the same active rows. The last one has no end."""
    starts = [k for k in range(len(t)) if k == 0 or active[k] != active[k - 1]]
    ends = [*(float(t[k]) for k in starts[1:]), None]
    return [{"from": float(t[k]), "until": end, "active": active[k]} for k, end in zip(starts, ends, strict=True)]


def compare(
    t: np.ndarray, active: Sequence[list[str]], expected: Sequence[ExpectedConfig], dt: float
) -> dict[str, Any]:
    """Compare a timeline with the expected one.

    Each expected switch gets the smallest `deviation` [s] such that all samples further away from the switch agree. A
    sample stands for the time until the next one.
    """
    deviations = [0.0] * len(expected)
    for time, names in zip(t, active, strict=True):
        middle = time + dt / 2
        now = next((i for i, interval in enumerate(expected) if middle < interval.until), None)
        if now is None or _agrees(names, expected[now]):
            continue
        switches = [i for i in (now - 1, now) if i >= 0]
        nearest = min(switches, key=lambda i: abs(expected[i].until - middle))
        far_end = time if expected[nearest].until > middle else time + dt
        deviations[nearest] = max(deviations[nearest], abs(expected[nearest].until - far_end))
    switches = [interval.until for interval in expected]
    return {
        "deviation": max(deviations),
        "switches": [{"expected": at, "deviation": by} for at, by in zip(switches, deviations, strict=True)],
    }


def _agrees(names: list[str], expected: ExpectedConfig) -> bool:
    return len(names) == expected.count if expected.active is None else set(names) == set(expected.active)


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
