"""The records of runs of a sweep: of each run a table row, and sizes and errors at some times.

Sizes are the square root of the area (in space the cube root of the volume), the diameter, and the distances of point
estimates from the goal [m]. A set is lost from the first sample at which it does not hold the truth. It is lost in
silence if its status ends as `ok`. Runs that are alike are simulated and observed as one batch (`runs.batch`).
"""

from __future__ import annotations

import math
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from experiments.results import rows_of
from experiments.runs.batch import Batch, Model
from experiments.runs.config import SceneConfig
from experiments.runs.errors import measure
from experiments.runs.observe import Observers
from torchfsid.commands.observe import BLOCK_ROWS
from torchfsid.commands.results import STATUS_NAMES
from torchfsid.identification.active_set import active_set
from torchfsid.identification.kkt import CASES, solve_kkt
from torchfsid.observers.hybrid import HybridEstimate
from torchfsid.observers.set_membership import Event, SetEstimate, SetEstimates
from torchfsid.outcome import Status
from torchfsid.robots.barriers import stack_barriers
from torchfsid.robots.measurement import Measurement

EXACTLY_ACTIVE = 1e-9
"""Distance to its boundary below which a row of the true controls is active [m/s]: round-off of the controller."""


def most_alike(scene: SceneConfig) -> int:
    """The number of such scenes of which all samples can be read at once."""
    return max(1, BLOCK_ROWS // (len(scene.robots) * len(scene.bodies) * (scene.steps + 1)))


def observed(scenes: Sequence[SceneConfig], times: tuple[float, ...]) -> list[dict[str, Any]]:
    """Simulate and observe scenes that are alike, at most `most_alike`, or one scene.

    Returns:
        For each scene a mapping with the table row of the run (`row`), sizes and errors at the samples nearest to
            `times` [s] (`series`), and its share of the time that this took (`seconds`).
    """
    torch.set_num_threads(1)  # small tensors: more threads only wait for each other
    began = time.perf_counter()
    batch = Batch(scenes)
    found = _Observed(batch, times)
    records = [{"row": found.row(i), "series": found.series(i)} for i in range(len(scenes))]
    seconds = round((time.perf_counter() - began) / len(scenes), 3)
    return [record | {"seconds": seconds} for record in records]


class _Observed:
    """What was seen of R robots of a batch.

    Attributes:
        observers: the observers, after the last sample.
        kept: the samples of the series.
        sizes: sizes and errors at these samples and at the last one: by sample, numbers (R,) by name [m].
        status: the statuses of the sets at all samples, by kind of set.
        lost: whether a set does not hold the truth at a sample, or did not before, by kind of set.
        cases: the number of samples in each true case.
        seen_right: the number of samples at which the active set was seen as it was.
    """

    def __init__(self, batch: Batch, times: tuple[float, ...]):
        first, robots = batch.scenes[0], len(batch.team)
        samples = first.steps + 1
        self.batch, self.kept = batch, sorted({round(t / first.dt) for t in times})
        self.sizes: dict[int, dict[str, Tensor]] = {}
        self.cases = torch.zeros(robots, len(CASES), dtype=torch.long)
        self.seen_right = torch.zeros(robots, dtype=torch.long)
        # A sweep counts as a long log, for the choice of the filter's engine.
        ukf = first.ukf.for_log(sys.maxsize, not first.task.is_clipped)
        model = batch.model(batch.team.repeat(samples))
        config = first.model_copy(update={"ukf": ukf})
        self.observers = Observers(config, model.task, model.barriers, robots, model.noise)
        measured, inside, status = measure(batch), defaultdict(list), defaultdict(list)
        # Numbers of a batch are those of all its samples. Of a scene alone as many are read as memory allows.
        length = samples if len(batch.scenes) > 1 else max(1, BLOCK_ROWS // int(batch.present.sum() * robots))
        for start in range(0, samples, length):
            exact, seen = (batch.of_robots(run.block(start, start + length)) for run in (batch.true, measured))
            self._compare(exact, seen, model, first.active_tolerance)
            k = start
            for estimates, sets in self.observers.read(seen):
                for kind, of_kind in sets.items():
                    inside[kind].append(_holds(of_kind, batch.goals))
                    status[kind].append(of_kind.status)
                for s in range(len(estimates)):
                    if k + s in self.kept or k + s == samples - 1:
                        of_kinds = {kind: of_kind[s] for kind, of_kind in sets.items()}
                        self.sizes[k + s] = _sizes(estimates[s], of_kinds, batch.goals)
                k += len(estimates)
        self.status = {kind: torch.cat(parts) for kind, parts in status.items()}
        self.lost = {kind: (~torch.cat(parts)).cummax(0).values for kind, parts in inside.items()}

    def _compare(self, exact: Measurement, seen: Measurement, model: Model, tolerance: float) -> None:
        """Count the true cases, and the active sets that are seen as they are."""
        assert exact.u is not None
        assert seen.u is not None
        rows = stack_barriers(model.barriers, exact)
        active = active_set(rows, exact.u, EXACTLY_ACTIVE)
        case = solve_kkt(rows, active, *model.task(exact)).case.unflatten(0, (-1, len(self.cases)))
        self.cases += (case.unsqueeze(-1) == torch.arange(len(CASES))).sum(0)
        right = (active_set(stack_barriers(model.barriers, seen), seen.u, tolerance) == active).all(-1)
        self.seen_right += right.unflatten(0, case.shape).sum(0)

    def row(self, i: int) -> dict[str, Any]:
        """The table row of a scene."""
        scene, true, robots = self.batch.scenes[i], self.batch.true, self._robots(i)
        stopped = [t for t in true.deadlocked_since[i].tolist() if not math.isnan(t)]
        cases = self.cases[robots].sum(0)
        shares, seen_right = cases / cases.sum(), float(self.seen_right[robots].sum() / cases.sum())
        row = {
            "robots": len(scene.robots),
            "obstacles": len(scene.obstacles),
            "infeasible_steps": int((~true.feasible[:, i, : len(scene.robots)]).sum()),
            "relaxed_samples": int(self.observers.sets[scene.set].infeasible[robots].sum()),
            "deadlocked": len(stopped),
            "deadlocked_since": min(stopped, default=None),
            **{f"case_{letter}": round(share, 6) for letter, share in zip(CASES, shares.tolist(), strict=True)},
            "active_set_seen": round(seen_right, 6),
        }
        for kind in scene.sets:
            row |= {f"{kind}_{name}": value for name, value in self._of_set(kind, robots).items()}
        at_the_end = self.sizes[len(true.t) - 1]
        return row | {name: _rounded(float(values[robots].nanmedian())) for name, values in at_the_end.items()}

    def series(self, i: int) -> list[dict[str, Any]]:
        """Sizes and errors of a scene, a row per time and robot."""
        robots, names, rows = self._robots(i), [robot.name for robot in self.batch.scenes[i].robots], []
        for k in self.kept:
            t = _rounded(float(self.batch.true.t[k]))
            columns: dict[str, list] = {"t": [t] * len(names), "robot": names}
            for kind in self.observers.sets:
                columns[f"{kind}_lost"] = self.lost[kind][k, robots].long().tolist()
                columns[f"{kind}_status"] = [STATUS_NAMES[of] for of in self.status[kind][k, robots].tolist()]
            for name, values in self.sizes[k].items():
                columns[name] = [_rounded(value) for value in values[robots].tolist()]
            rows += rows_of(columns)
        return rows

    def _robots(self, i: int) -> slice:
        """The robots of a scene."""
        first, last = torch.searchsorted(self.batch.team, torch.tensor([i, i + 1])).tolist()
        return slice(first, last)

    def _of_set(self, kind: str, robots: slice) -> dict[str, Any]:
        observer, lost = self.observers.sets[kind], self.lost[kind][:, robots]
        status, ever, since = observer.status[robots], lost.any(0), lost.any(1).nonzero()
        events = [event for event in observer.events if robots.start <= event.robot < robots.stop]
        return {
            "lost": int(ever.sum()),
            "lost_since": _rounded(float(self.batch.true.t[since[0]])) if len(since) else None,
            "lost_and_inconsistent": int((ever & (status == Status.INCONSISTENT)).sum()),
            "lost_in_silence": int((ever & (status == Status.OK)).sum()),
            **_first(events, Status.ALARM, "alarm"),
            **_first(events, Status.INCONSISTENT, "inconsistent"),
        }


def _holds(estimates: SetEstimates, goals: Float[Tensor, "R p"]) -> Bool[Tensor, "S R"]:
    """Do the sets hold the truths?"""
    owner = torch.zeros(len(estimates.sets.outcome), dtype=torch.long)
    owner[estimates.which] = torch.arange(len(goals)).expand_as(estimates.which)
    return estimates.sets.contains(goals[owner])[estimates.which]


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


def _first(events: list[Event], status: Status, name: str) -> dict[str, Any]:
    """The number of robots with this status, and the time of the first."""
    times = [event.t for event in events if event.status == status]
    return {name: len(times), f"{name}_since": _rounded(min(times)) if times else None}


def _rounded(value: float) -> float | None:
    """The value with six significant digits, for people and figures. None if it is not finite."""
    return float(f"{value:.6g}") if math.isfinite(value) else None
