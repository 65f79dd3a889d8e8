"""The gradient of a mean over goals (`probe.expectation`) against central differences of that mean.

Both use the same goals, so many that the jumps of single goals average out. Placements are drawn near the predicted
path, such that the probe matters and no difference crosses the safety distance. The gradient does not see what is lost
there (docs/design.md).

A second study gives the shares of placements at which the gradient is zero.

A third one shows what automatic differentiation does not see: the area for one goal jumps where its active sets switch.
A still probe is moved along y, across the corridor. Between two switches of the history of active sets, A is smooth and
automatic differentiation gives d log A/dy. At a switch A jumps, and automatic differentiation gives a one-sided
derivative. So the integral of these derivatives differs from the change of log A.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from experiments.design.config import GradientCheckConfig, ProbePlacementConfig
from experiments.design.probe import Objective, Probing, expectation, slope
from experiments.design.search import Search
from experiments.kinds import Track
from experiments.results import rows_of
from torchfsid.identification.evidence import evidence

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

REACH = 0.1
"""The probe is moved so far, to either side [m]."""

PLACES = 801
"""On this way."""


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


def _check(probing: Probing, placements: Tensor, goals: Tensor, horizon: int, step: float) -> list[dict[str, Any]]:
    of_each = [_gradients(probing, placement.unsqueeze(0), goals, horizon, step) for placement in placements]
    rows = []
    for objective in OBJECTIVES:
        together = map(torch.cat, zip(*(of[objective] for of in of_each), strict=True))
        about = {"way_points": placements.shape[1], "objective": objective, "placements": len(placements)}
        rows.append(about | _compare(*together) | {"horizon": horizon})
    return rows


def _gradients(
    probing: Probing, placement: Tensor, goals: Tensor, horizon: int, step: float
) -> dict[Objective, tuple[Tensor, Tensor, Tensor]]:
    """Gradients of the mean: by automatic differentiation, the same without the score term, and by differences."""
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
        found[objective] = whole, smooth_part, of
    return found


def _compare(whole: Tensor, smooth_part: Tensor, differences: Tensor) -> dict[str, float]:
    each = torch.cosine_similarity(whole.flatten(1), differences.flatten(1))
    return {
        "cosine": _cosine(whole, differences),
        "median_cosine": float(each.median()),
        "least_cosine": float(each.min()),
        "length_ratio": float(whole.norm() / differences.norm()),
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


def across(probing: Probing, place: Float[Tensor, "2"], goal: Float[Tensor, "2"]) -> list[dict[str, Any]]:
    """Move a still probe across the corridor. One table row per allowed place.

    A table row has the log of the area [m^2], the integral of the derivatives from the first place, and the number of
    switches so far.
    """
    places = place.repeat(PLACES, 1, 1)
    places[:, 0, 1] += torch.linspace(-REACH, REACH, PLACES, dtype=torch.float64)
    places = places[(probing.allowed(places) == places).flatten(1).all(-1)].requires_grad_()
    goals = goal.unsqueeze(0)
    log_area = probing.left(places, goals).area[:, 0].log()
    slopes, y = slope(log_area.sum(), places)[:, 0, 1], places.detach()[:, 0, 1]
    log_area = log_area.detach()
    with torch.no_grad():
        seen = probing.run(places, goals).measurement()
        history = evidence(probing.model, probing.prior_of(1), seen).kkt.active.unflatten(0, (len(places), -1))
    switched = (history[1:] != history[:-1]).flatten(1).any(-1).long()
    columns = {
        "y": y,
        "log_area": log_area,
        "by_derivatives": torch.cat([log_area[:1], log_area[0] + torch.cumulative_trapezoid(slopes, y)]),
        "switches": torch.cat([switched.new_zeros(1), switched.cumsum(0)]),
    }
    return rows_of({name: column.tolist() for name, column in columns.items()})


def summarise_switches(rows: list[dict[str, Any]]) -> dict[str, float]:
    """The number of switches, the change of log A along the way, and the integral of the derivatives."""
    first, last = rows[0], rows[-1]
    return {
        "way [m]": last["y"] - first["y"],
        "switches": last["switches"],
        "change of log A": last["log_area"] - first["log_area"],
        "its derivatives add up to": last["by_derivatives"] - first["log_area"],
    }
