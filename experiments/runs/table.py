"""Table I of the paper, measured: in each case, can a point estimator learn, and which rows shrink the region?

A direction of the parameter is learned if the filter's standard deviation along it falls below `LEARNED` of the
prior's. The filter can learn in as many directions as the rank of the sum of G'G dt. A region shrinks if its area does.
Its facets say why: rows that had to stay inactive, or multipliers that are not negative.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from rich.console import Console

from experiments.runs.config import SETS, CasesConfig
from experiments.runs.observers import Observers
from experiments.runs.saved import Results
from experiments.runs.summary import settings
from experiments.runs.tally import Tally
from experiments.tables import table
from torchfsid.config.quantities import known

LEARNED = 0.1
"""Share of the prior's standard deviation."""

RANK_TOLERANCE = 1e-9
"""Relative to the largest singular value that G'G could have summed up to."""

PAPER = {"A": ("yes", "yes"), "B": ("yes", "yes"), "C": ("yes", "yes"), "D": ("no", "yes"), "E": ("no", "yes")}
"""Table I: is point-wise, is region-based identification possible?"""


def measure_cases(config: CasesConfig, results: Results, observers: Observers, tally: Tally) -> dict[str, Any]:
    """The content of summary.json. Its `cases` are also the content of cases.csv."""
    return {
        "title": config.title,
        "settings": settings(config) | {"spin": config.spin, "goal": list(config.goal)},
        "steps": tally.samples,
        "cases": [_measure(i, config, results, observers, tally) for i in range(len(config.cases))],
    }


def _measure(i: int, config: CasesConfig, results: Results, observers: Observers, tally: Tally) -> dict[str, Any]:
    case, gain = config.cases[i], known(config.task.gain) or 0.0
    duration = config.dt * tally.samples
    information_rank = int(torch.linalg.matrix_rank(tally.information[i], atol=RANK_TOLERANCE * gain**2 * duration))
    error = results.error("ukf_0", "ukf_1")[:, i]
    prior_error = np.linalg.norm((np.array(config.prior.lower) + config.prior.upper) / 2 - config.goal)
    before, after = (torch.linalg.eigvalsh(of[i]).sqrt() for of in (tally.prior_covariance, tally.covariance))
    learned = int((after < LEARNED * before.max()).sum())
    row: dict[str, Any] = {
        "case": case.name,
        "letter": case.letter,
        "realised": "".join(sorted(set(results.cases()[:, i]))),
        "active": int(results.n_active()[:, i].max()),
        "rank_of_rows": 2 - int(tally.rank[i]),
        "information_rank": information_rank,
        "ukf_error_before": float(prior_error),
        "ukf_error_after": float(error[-1]),
        "ukf_std_before": float(before.max()),
        "ukf_std_after_smallest": float(after.min()),
        "ukf_std_after_largest": float(after.max()),
        "learned_directions": learned,
        "point_paper": PAPER[case.letter][0],
        "point_measured": ("no", "in part", "yes")[learned],
    }
    prior_area = float(np.prod(np.array(config.prior.upper) - config.prior.lower))
    for kind in SETS:
        of = tally.sets[kind]
        row |= {
            f"{kind}_area_before": prior_area,
            f"{kind}_area_after": float(of.volume[i]),
            f"{kind}_shrinking_steps": int(of.shrank[i]),
            f"{kind}_truth_outside": int(of.outside[i]),
            f"{kind}_area_grew": int(of.grew[i]),
        }
    facets = observers.sets["critical_region"].feasible_set.facets()
    source, rows = facets.source[i][(facets.halfspaces.A[i] != 0).any(-1)], config.slots
    return row | {
        "facets_of_prior": int((source < 0).sum()),
        "facets_of_inactive_rows": int(((source >= 0) & (source < rows)).sum()),
        "facets_of_multipliers": int((source >= rows).sum()),
        "region_paper": PAPER[case.letter][1],
        "region_measured": "yes" if tally.sets["critical_region"].shrank[i] else "no",
        "inverse_optimal_measured": "yes" if tally.sets["inverse_optimal"].shrank[i] else "no",
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
