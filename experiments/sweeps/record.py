"""The record of one run of a sweep: a table row, and sizes and errors at some times.

Sizes are the square root of the area (in space the cube root of the volume), the diameter, and the distances of point
estimates from the goal [m]. A set is lost from the first sample at which it does not hold the truth. It is lost in
silence if its status ends as `ok`.
"""

from __future__ import annotations

import math
import time
from typing import Any

import torch
from torch import Tensor

from experiments.results import rows_of
from experiments.runs.config import SceneConfig
from experiments.runs.observers import Observers
from experiments.runs.recording import SimulatedScene, simulate_scene
from torchfsid.commands.results import STATUS_NAMES
from torchfsid.identification.active_set import active_set
from torchfsid.identification.kkt import CASES, solve_kkt
from torchfsid.observers.hybrid import HybridEstimate
from torchfsid.observers.set_membership import Event, SetEstimate
from torchfsid.outcome import Status
from torchfsid.robots.barriers import stack_barriers
from torchfsid.robots.measurement import Measurement

EXACTLY_ACTIVE = 1e-9
"""Distance to its boundary below which a row of the true controls is active [m/s]: round-off of the controller."""


def observed(scene: SceneConfig, times: tuple[float, ...]) -> dict[str, Any]:
    """Simulate and observe a scene.

    Returns:
        A mapping with the table row of the run (`row`), sizes and errors at the samples nearest to `times` [s]
            (`series`), and durations (`seconds`).
    """
    torch.set_num_threads(1)  # small tensors: more threads only wait for each other
    began = time.perf_counter()
    simulated = simulate_scene(scene)
    recording = simulated.recording()
    observers = Observers(scene, recording)
    lost_since = {kind: torch.full((len(recording.robots),), math.nan, dtype=torch.float64) for kind in scene.sets}
    kept = {round(t / scene.dt) for t in times}
    cases = torch.zeros(len(CASES))
    seen_right, series, sizes = 0, [], {}
    for k, measurement in enumerate(recording.measurements):
        estimate, sets = observers.update(measurement)
        for kind, since in lost_since.items():
            since[since.isnan() & (observers.tally.sets[kind].outside > 0)] = measurement.t
        of_robots, active = _true_cases(simulated, simulated.true.measurement(k))
        cases += torch.bincount(of_robots, minlength=len(CASES))
        rows = stack_barriers(recording.barriers, measurement)
        seen = active_set(rows, _control(measurement), scene.active_tolerance)
        seen_right += int((seen == active).all(-1).sum())
        if k in kept or k == recording.samples - 1:
            sizes = _sizes(estimate, sets, recording.goals)
        if k in kept:
            series += _series(measurement.time, recording.robots, sizes, sets, observers)
    shares = (cases / cases.sum()).tolist()
    stopped = [t for t in simulated.true.deadlocked_since.tolist() if not math.isnan(t)]
    row = {
        "robots": len(recording.robots),
        "obstacles": len(scene.obstacles),
        "infeasible_steps": int((~simulated.true.feasible).sum()),
        "relaxed_samples": int(observers.sets[scene.set].infeasible.sum()),
        "deadlocked": len(stopped),
        "deadlocked_since": min(stopped, default=None),
        **{f"case_{letter}": round(share, 6) for letter, share in zip(CASES, shares, strict=True)},
        "active_set_seen": round(seen_right / float(cases.sum()), 6),
    }
    for kind in scene.sets:
        row |= {f"{kind}_{name}": value for name, value in _of_set(observers, kind, lost_since[kind]).items()}
    row |= {name: _rounded(float(values.nanmedian())) for name, values in sizes.items()}
    return {"row": row, "series": series, "seconds": round(time.perf_counter() - began, 3)}


def _true_cases(scene: SimulatedScene, exact: Measurement) -> tuple[Tensor, Tensor]:
    """The true case of every robot, and the truly active rows."""
    rows = stack_barriers(scene.barriers, exact)
    active = active_set(rows, _control(exact), EXACTLY_ACTIVE)
    return solve_kkt(rows, active, *scene.task(exact)).case, active


def _control(measurement: Measurement) -> Tensor:
    assert measurement.u is not None
    return measurement.u


def _sizes(estimate: HybridEstimate, sets: dict[str, SetEstimate], goals: Tensor) -> dict[str, Tensor]:
    """Sizes and errors of every robot, by name [m]."""
    sizes = {}
    for kind, of_kind in sets.items():
        theta = of_kind.feasible_set
        sizes[f"{kind}_sqrt_area"] = theta.volume().sqrt() if theta.dim == 2 else theta.volume() ** (1 / 3)
        sizes[f"{kind}_diameter"] = theta.diameter()
        sizes[f"{kind}_centroid_error"] = (of_kind.theta - goals).norm(dim=-1)
    sizes["ukf_error"] = (estimate.ukf_estimate.theta - goals).norm(dim=-1)
    sizes["hybrid_error"] = (estimate.theta - goals).norm(dim=-1)
    return sizes


def _series(
    t: float, robots: list[str], sizes: dict[str, Tensor], sets: dict[str, SetEstimate], observers: Observers
) -> list[dict[str, Any]]:
    columns: dict[str, list] = {"t": [_rounded(t)] * len(robots), "robot": robots}
    for kind, of_kind in sets.items():
        columns[f"{kind}_lost"] = (observers.tally.sets[kind].outside > 0).long().tolist()
        columns[f"{kind}_status"] = [STATUS_NAMES[of_robot] for of_robot in of_kind.status.tolist()]
    columns |= {name: [_rounded(value) for value in values.tolist()] for name, values in sizes.items()}
    return rows_of(columns)


def _of_set(observers: Observers, kind: str, lost_since: Tensor) -> dict[str, Any]:
    observer, lost = observers.sets[kind], ~lost_since.isnan()
    return {
        "lost": int(lost.sum()),
        "lost_since": _rounded(float(lost_since[lost].min())) if lost.any() else None,
        "lost_and_inconsistent": int((lost & (observer.status == Status.INCONSISTENT)).sum()),
        "lost_in_silence": int((lost & (observer.status == Status.OK)).sum()),
        **_first(observer.events, Status.ALARM, "alarm"),
        **_first(observer.events, Status.INCONSISTENT, "inconsistent"),
    }


def _first(events: list[Event], status: Status, name: str) -> dict[str, Any]:
    """The number of robots with this status, and the time of the first."""
    times = [event.t for event in events if event.status == status]
    return {name: len(times), f"{name}_since": _rounded(min(times)) if times else None}


def _rounded(value: float) -> float | None:
    """The value with six significant digits, for people and figures. None if it is not finite."""
    return float(f"{value:.6g}") if math.isfinite(value) else None
