"""The gradient of a mean over goals (`probe.expectation`) against central differences of that mean.

The same goals on both sides, so many that the jumps of single goals average out. Placements are drawn near the
predicted path such that the probe matters, and that no difference steps across the safety distance: what is lost there
is not seen by the gradient (docs/design.md).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments.design.config import ProbePlacementConfig
from experiments.design.probe import Objective, Probing, expectation
from experiments.design.search import Search
from experiments.design.tables import Track

CANDIDATES = 32
"""Placements drawn at a time."""

DRAWS = 20
"""Times that candidates are drawn before fewer placements than asked for have to do."""

SCOUTS = 8
"""Goals that decide whether a placement is fit for the check."""

CLEAR = 1.5
"""No goal may be lost within so many steps of the differences."""

MATTERS = 0.9
"""The probe matters if some goal's area falls below this share of the prior's."""

OBJECTIVES: tuple[Objective, ...] = ("area", "log_area")


def check_gradients(config: ProbePlacementConfig, seed: np.random.SeedSequence, track: Track) -> list[dict[str, Any]]:
    """A row per number of way-points, horizon and objective: the cosine between both gradients over all placements, the
    median and the least of single ones, the ratio of their lengths; and the same without the second term."""
    probing = Probing.of(config)
    settings = config.gradient_check
    jobs = [(K, horizon) for K in config.way_points for horizon in settings.horizons]
    seeds = seed.spawn(len(config.way_points))
    rows = []
    for K, horizon in track(jobs, "Checking gradients", len(jobs)):
        goals = probing.draw_goals(settings.goals, int(seed.generate_state(1)[0]))
        search = Search.of(probing, goals[:SCOUTS], K, seeds[config.way_points.index(K)])
        placements = _fit_for_it(search, horizon)
        rows += _check(probing, placements, goals, horizon) if len(placements) else []
    return rows


def _fit_for_it(search: Search, horizon: int) -> Tensor:
    settings = search.probing.config.gradient_check
    fit: list[Tensor] = []
    for _ in range(DRAWS):
        candidates = search.near_path(CANDIDATES)
        with torch.no_grad():
            area = search.probing.outcome(candidates, search.goals, horizon).area
            good = (area < MATTERS * search.probing.prior_area).any(-1)
            for step in _steps(candidates, CLEAR * settings.step):
                for moved in (candidates + step, candidates - step):
                    good &= search.probing.outcome(moved, search.goals, horizon).sound.all(-1)
        fit.append(candidates[good])
        if sum(map(len, fit)) >= settings.placements:
            break
    return torch.cat(fit)[: settings.placements]


def _check(probing: Probing, placements: Tensor, goals: Tensor, horizon: int) -> list[dict[str, Any]]:
    step = probing.config.gradient_check.step
    leaf = placements.clone().requires_grad_()
    area = probing.outcome(leaf, goals, horizon).area
    differences: dict[Objective, Tensor] = {objective: torch.zeros_like(placements) for objective in OBJECTIVES}
    for direction in _steps(placements, step):
        with torch.no_grad():
            ahead, behind = (probing.outcome(at, goals, horizon).area for at in (leaf + direction, leaf - direction))
            for objective, of in differences.items():
                slope = (expectation(ahead, objective) - expectation(behind, objective)) / (2 * step)
                of += slope[:, None, None] * direction / step
    return [_compare(leaf, area, objective, of) | {"horizon": horizon} for objective, of in differences.items()]


def _compare(leaf: Tensor, area: Tensor, objective: Objective, differences: Tensor) -> dict[str, Any]:
    (gradient,) = torch.autograd.grad(expectation(area, objective).sum(), leaf, retain_graph=True)
    phi = area if objective == "area" else area.log()
    (smooth_part,) = torch.autograd.grad(phi.mean(-1).sum(), leaf, retain_graph=True)
    each = torch.cosine_similarity(gradient.flatten(1), differences.flatten(1))
    return {
        "way_points": leaf.shape[1],
        "objective": objective,
        "placements": len(leaf),
        "cosine": _cosine(gradient, differences),
        "median_cosine": float(each.median()),
        "least_cosine": float(each.min()),
        "length_ratio": float(gradient.norm() / differences.norm()),
        "cosine_without": _cosine(smooth_part, differences),
        "length_ratio_without": float(smooth_part.norm() / differences.norm()),
    }


def _cosine(v: Tensor, w: Tensor) -> float:
    return float(torch.cosine_similarity(v.flatten(), w.flatten(), dim=0))


def _steps(placements: Tensor, step: float) -> list[Tensor]:
    """A step along every coordinate of the way-points."""
    K = placements.shape[1]
    return list(
        step * torch.eye(2 * K, dtype=torch.float64).reshape(2 * K, 1, K, 2).expand(-1, len(placements), -1, -1)
    )
