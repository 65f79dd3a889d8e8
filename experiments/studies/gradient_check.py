"""The gradient of a mean over goals (`probe.expectation`) against central differences of that mean.

Both use the same goals, so many that the jumps of single goals average out. Placements are drawn near the predicted
path, such that the probe matters and no difference crosses the safety distance. The gradient does not see what is lost
there (docs/design.md).

A second study gives the shares of placements at which the gradient is zero.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from experiments.design.config import GradientCheckConfig, ProbePlacementConfig
from experiments.design.probe import Objective, Probing, expectation, slope
from experiments.design.search import Search
from experiments.kinds import Track

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
    """Compare both gradients. One table row per number of way-points, horizon and objective.

    A table row has the cosine over all placements, the median and the least cosine of single ones, and the ratio of
    lengths; and the same without the second term of the gradient.
    """
    probing = Probing.of(config)
    settings = config.gradient_check
    jobs = [(K, horizon) for K in config.way_points for horizon in settings.horizons]
    seeds = seed.spawn(len(config.way_points))
    rows = []
    for K, horizon in track(jobs, "Checking gradients", len(jobs)):
        goals = probing.draw_goals(settings.goals, int(seed.generate_state(1)[0]))
        search = Search.of(probing, config.search, goals[:SCOUTS], K, seeds[config.way_points.index(K)])
        placements = _fit_for_it(search, settings, horizon)
        rows += _check(probing, placements, goals, horizon, settings.step) if len(placements) else []
    return rows


def nothing_to_follow(config: ProbePlacementConfig, seed: np.random.SeedSequence) -> list[dict[str, Any]]:
    """Shares of zero gradients. One table row per number of way-points and way of drawing.

    A table row has the share of placements at which the gradient is zero, and the share of outcomes (one placement with
    one goal) that do not count.
    """
    probing, rows = Probing.of(config), []
    goals = probing.draw_goals(config.goals.train, int(seed.generate_state(1)[0]))
    for K, child in zip(config.way_points, seed.spawn(len(config.way_points)), strict=True):
        search = Search.of(probing, config.search, goals, K, child)
        for drawn, draw in (("anywhere", search.anywhere), ("near_path", search.near_path)):
            placements = draw(CANDIDATES * DRAWS)
            zero, unsound = [], []
            for part in placements.split(CANDIDATES):
                leaf = part.requires_grad_()
                left = probing.left(leaf, goals)
                gradient = slope(expectation(left.area, "area").sum(), leaf)
                zero.append((gradient == 0).flatten(1).all(-1))
                unsound.append(~left.sound)
            shares = {"zero": float(torch.cat(zero).double().mean()), "lost": float(torch.cat(unsound).double().mean())}
            rows.append({"way_points": K, "drawn": drawn, **shares})
    return rows


def _fit_for_it(search: Search, settings: GradientCheckConfig, horizon: int) -> Tensor:
    fit: list[Tensor] = []
    for _ in range(DRAWS):
        candidates = search.near_path(CANDIDATES)
        with torch.no_grad():
            area = search.probing.left(candidates, search.goals, horizon).area
            good = (area < MATTERS * search.probing.prior_area).any(-1)
            for step in _steps(candidates, CLEAR * settings.step):
                for moved in (candidates + step, candidates - step):
                    good &= search.probing.left(moved, search.goals, horizon).sound.all(-1)
        fit.append(candidates[good])
        if sum(map(len, fit)) >= settings.placements:
            break
    return torch.cat(fit)[: settings.placements]


class _Gradients(NamedTuple):
    """Gradients of the mean over goals.

    Attributes:
        whole: by automatic differentiation.
        smooth_part: by automatic differentiation, without the score term.
        differences: by central differences.
    """

    whole: Tensor
    smooth_part: Tensor
    differences: Tensor


def _check(probing: Probing, placements: Tensor, goals: Tensor, horizon: int, step: float) -> list[dict[str, Any]]:
    of_each = [_gradients(probing, placement.unsqueeze(0), goals, horizon, step) for placement in placements]
    rows = []
    for objective in OBJECTIVES:
        together = _Gradients(*map(torch.cat, zip(*(of[objective] for of in of_each), strict=True)))
        about = {"way_points": placements.shape[1], "objective": objective, "placements": len(placements)}
        rows.append(about | _compare(together) | {"horizon": horizon})
    return rows


def _gradients(
    probing: Probing, placement: Tensor, goals: Tensor, horizon: int, step: float
) -> dict[Objective, _Gradients]:
    leaf = placement.clone().requires_grad_()
    area = probing.left(leaf, goals, horizon).area
    differences: dict[Objective, Tensor] = {objective: torch.zeros_like(placement) for objective in OBJECTIVES}
    for direction in _steps(placement, step):
        with torch.no_grad():
            ahead, behind = (probing.left(at, goals, horizon).area for at in (leaf + direction, leaf - direction))
            for objective, of in differences.items():
                of += (expectation(ahead, objective) - expectation(behind, objective)) / (2 * step) * direction / step
    found = {}
    for objective, of in differences.items():
        phi = area if objective == "area" else area.log()
        (whole,) = torch.autograd.grad(expectation(area, objective).sum(), leaf, retain_graph=True)
        (smooth_part,) = torch.autograd.grad(phi.mean(), leaf, retain_graph=True)
        found[objective] = _Gradients(whole, smooth_part, of)
    return found


def _compare(of: _Gradients) -> dict[str, float]:
    each = torch.cosine_similarity(of.whole.flatten(1), of.differences.flatten(1))
    return {
        "cosine": _cosine(of.whole, of.differences),
        "median_cosine": float(each.median()),
        "least_cosine": float(each.min()),
        "length_ratio": float(of.whole.norm() / of.differences.norm()),
        "cosine_without": _cosine(of.smooth_part, of.differences),
        "length_ratio_without": float(of.smooth_part.norm() / of.differences.norm()),
    }


def _cosine(v: Tensor, w: Tensor) -> float:
    return float(torch.cosine_similarity(v.flatten(), w.flatten(), dim=0))


def _steps(placements: Tensor, step: float) -> list[Tensor]:
    """A step along every coordinate of the way-points."""
    K = placements.shape[1]
    return list(
        step * torch.eye(2 * K, dtype=torch.float64).reshape(2 * K, 1, K, 2).expand(-1, len(placements), -1, -1)
    )
