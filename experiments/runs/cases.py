r"""Table I: a robot is held in one of the paper's cases by bodies that move along with it.

A body at x + r n, with n a unit vector, limits the robot's speed in this direction. The limit s grows with r:

    n.u <= gamma/2 (r - Ds^2/r) = s      <=>      r = (s + sqrt(s^2 + gamma^2 Ds^2)) / gamma.

So rows with any normals can be made to meet in one control, with s = n.meet. At every step the bodies are placed anew
around the robot, from its position alone. The robot then moves by the solution of its safety QP.

It is measured whether a point estimator can learn, and which rows shrink the region. A direction of the parameter is
learned if the filter's standard deviation along it falls below `LEARNED` of the prior's. The filter can learn in as
many directions as the rank of the sum of G'G dt. A region shrinks if its area does. Its facets say why: rows that had
to stay inactive, or multipliers that are not negative.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

from experiments.kinds import Track
from experiments.results import write_rows
from experiments.runs.config import SETS, CaseConfig, CasesConfig
from experiments.runs.observe import Observed, Recording, observe
from experiments.runs.saved import Results
from experiments.runs.summary import settings
from experiments.tables import table
from torchfsid.config.quantities import known
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import closed_loop

LEARNED = 0.1
"""Share of the prior's standard deviation."""

RANK_TOLERANCE = 1e-9
"""Relative to the largest singular value that G'G could have summed up to."""

PAPER = {"A": ("yes", "yes"), "B": ("yes", "yes"), "C": ("yes", "yes"), "D": ("no", "yes"), "E": ("no", "yes")}
"""Table I: is point-wise, is region-based identification possible?"""


def run_cases(config: CasesConfig, out: Path, track: Track) -> dict[str, Any]:
    """Simulate, observe, and return the summary."""
    observed = observe(config, record_cases(config), out, track)
    summary = measure_cases(config, Results(out, config), observed)
    write_rows(out / "cases.csv", summary["cases"])
    return summary


def record_cases(config: CasesConfig) -> Recording:
    """All cases as one batch of robots, each among its own bodies."""
    count = len(config.cases)
    goals, start = (torch.tensor(at, dtype=torch.float64).expand(count, 2) for at in (config.goal, config.start))
    task = config.task.build([], config.dimension)
    controller = CbfQpController(task, [barrier.build([]) for barrier in config.barriers])
    places = [_places(case, config) for case in config.cases]
    offsets, radii, present = (torch.stack(parts) for parts in zip(*places, strict=True))
    radius = torch.full((count,), config.radius, dtype=torch.float64)

    def around(t: float, x: Tensor, _: Tensor) -> Measurement:
        bodies = x.unsqueeze(-2) + offsets @ _rotation(math.radians(config.spin) * t).T
        return Measurement(t=t, x=x, u=None, bodies=bodies, present=present, radius=radius, body_radii=radii)

    samples = config.steps + 1
    return Recording(
        robots=[case.name for case in config.cases],
        goals=goals,
        task=controller.task,
        barriers=list(controller.barriers),
        labels=[f"avoid {j + 1}" for j in range(config.slots)],
        measurements=(
            sample.measurement
            for sample in closed_loop(controller, goals, start, around, dt=config.dt, samples=samples)
        ),
        samples=samples,
    )


def _places(case: CaseConfig, config: CasesConfig) -> tuple[Tensor, Tensor, Tensor]:
    """The bodies of a case.

    Returns:
        Offsets (m, 2) from the robot at the start [m], radii (m,) [m], and which slots hold a body (m,).
    """
    slots, taken = config.slots, len(case.bodies)
    (avoidance,) = config.barriers
    gamma, margin = known(avoidance.class_k.gain), known(avoidance.margin)
    assert gamma is not None
    assert margin is not None
    offsets = torch.ones(slots, 2, dtype=torch.float64)
    radii = torch.ones(slots, dtype=torch.float64)
    for j, body in enumerate(case.bodies):
        angle = math.radians(body.direction)
        normal = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
        speed = body.speed if body.speed is not None else float(normal @ torch.tensor(case.meet, dtype=torch.float64))
        safety_distance = config.radius + body.radius + margin
        distance = (speed + math.hypot(speed, gamma * safety_distance)) / gamma
        offsets[j] = distance * normal
        radii[j] = body.radius
    return offsets, radii, torch.arange(slots) < taken


def _rotation(angle: float) -> Float[Tensor, "2 2"]:
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)


def measure_cases(config: CasesConfig, results: Results, observed: Observed) -> dict[str, Any]:
    """The content of summary.json. Its `cases` are also the content of cases.csv."""
    return {
        "title": config.title,
        "settings": settings(config) | {"spin": config.spin, "goal": list(config.goal)},
        "steps": len(results.t),
        "cases": [_measure(i, config, results, observed) for i in range(len(config.cases))],
    }


def _measure(i: int, config: CasesConfig, results: Results, observed: Observed) -> dict[str, Any]:
    case, gain = config.cases[i], known(config.task.gain) or 0.0
    atol = RANK_TOLERANCE * gain**2 * config.dt * len(results.t)
    error = results.error("ukf_0", "ukf_1")[:, i]
    prior_error = np.linalg.norm((np.array(config.prior.lower) + config.prior.upper) / 2 - config.goal)
    before, after = max(config.ukf.spread(config.prior)), torch.linalg.eigvalsh(observed.covariance[i]).sqrt()
    learned = int((after < LEARNED * before).sum())
    row: dict[str, Any] = {
        "case": case.name,
        "letter": case.letter,
        "realised": "".join(sorted(set(results.cases()[:, i]))),
        "active": int(results.n_active()[:, i].max()),
        "rank_of_rows": 2 - int(observed.rank[i]),
        "information_rank": int(torch.linalg.matrix_rank(observed.information[i], atol=atol)),
        "ukf_error_before": float(prior_error),
        "ukf_error_after": float(error[-1]),
        "ukf_std_before": before,
        "ukf_std_after_smallest": float(after.min()),
        "ukf_std_after_largest": float(after.max()),
        "learned_directions": learned,
        "point_paper": PAPER[case.letter][0],
        "point_measured": ("no", "in part", "yes")[learned],
    }
    sets = observed.observers.sets
    for kind in SETS:
        grew, shrank = results.changes(kind)
        row |= {
            f"{kind}_area_before": results.prior_volume,
            f"{kind}_area_after": float(sets[kind].feasible_set.volume()[i]),
            f"{kind}_shrinking_steps": int(shrank[i]),
            f"{kind}_truth_outside": int(observed.outside[kind][i]),
            f"{kind}_area_grew": int(grew[i]),
        }
    facets = sets["critical_region"].feasible_set.facets()
    source, rows = facets.source[i][(facets.halfspaces.A[i] != 0).any(-1)], config.slots
    return row | {
        "facets_of_prior": int((source < 0).sum()),
        "facets_of_inactive_rows": int(((source >= 0) & (source < rows)).sum()),
        "facets_of_multipliers": int((source >= rows).sum()),
        "region_paper": PAPER[case.letter][1],
        "region_measured": "yes" if row["critical_region_shrinking_steps"] else "no",
        "inverse_optimal_measured": "yes" if row["inverse_optimal_shrinking_steps"] else "no",
    }


def print_cases(summary: dict[str, Any], console: Console) -> None:
    """Print the measured table. An answer that differs from the paper's is red, with the paper's in brackets."""
    title = f"{summary['title']}: {summary['steps']} samples of {summary['settings']['dt']} s"
    headings = "case", "rank of\nΣG'G dt", "UKF error\n\\[m]", "point\nestimate?", "region's\narea \\[m²]"
    shown = table((*headings, "steps it\nshrank", "region?", "inv.-opt.\narea \\[m²]"), title=title)
    for row in summary["cases"]:
        shown.add_row(
            row["case"],
            str(row["information_rank"]),
            f"{row['ukf_error_before']:.2g} → {row['ukf_error_after']:.1g}",
            _against(row["point_measured"], row["point_paper"]),
            f"{row['critical_region_area_before']:.3g} → {row['critical_region_area_after']:.3g}",
            str(row["critical_region_shrinking_steps"]),
            _against(row["region_measured"], row["region_paper"]),
            f"{row['inverse_optimal_area_after']:.2g}",
        )
    console.print(shown)


def _against(measured: str, paper: str) -> str:
    return measured if measured == paper else f"[red]{measured} ({paper})[/]"
