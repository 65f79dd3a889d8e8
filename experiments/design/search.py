r"""Where to put the probe: a gradient method, and others at the same number of simulations.

Every method evaluates `starts` x `steps` placements on the same training goals. Its `finalists`, the placements with
the smallest mean areas, are compared on the validation goals. The best of them is its answer. It is judged on goals
that no method has seen.

    one_random    a place drawn from the room; nothing is compared
    grid          the best of as many places on a grid over the room, for a probe that stands still
    random        the best of as many places drawn from the room
    near_path     the best of as many places drawn near the path predicted without a probe
    cem           the cross-entropy method: generations from a Gaussian fitted to the best of the generation before
    adam          Adam by successive halving, from many starts near the predicted path, projected onto the allowed
                  placements
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from experiments.design.probe import Probing, expectation

if TYPE_CHECKING:
    from experiments.design.config import SearchConfig

COARSEST = 1e-3
"""The Gaussian of the cross-entropy method keeps at least this standard deviation [m]."""

HALVINGS = 3
"""Stages of Adam's search, each from half as many placements as the one before."""

TURN = 1.0
"""Standard deviation of the way from one way-point to the next around the robot [rad]."""


@dataclass
class Evaluated:
    """Placements in the order of their evaluation. Batches on descents come last.

    Attributes:
        placements: way-points of each batch [m].
        means: mean areas over the training goals [m^2].
        starts: for each placement of a descent, the number of the start that it comes from.
    """

    placements: list[Float[Tensor, "P K 2"]] = field(default_factory=list)
    means: list[Float[Tensor, "P"]] = field(default_factory=list)
    starts: list[Int[Tensor, "P"]] = field(default_factory=list)

    def add(self, placements: Float[Tensor, "P K 2"], areas: Float[Tensor, "P S"]) -> Float[Tensor, "P"]:
        """Append a batch with its areas, and return the mean areas over goals [m^2]."""
        self.placements.append(placements.detach().clone())
        self.means.append(areas.detach().mean(-1))
        return self.means[-1]


@dataclass(frozen=True)
class Search:
    """The common part of the methods.

    Attributes:
        probing: the scene.
        settings: the settings of all methods.
        goals: the training goals [m].
        path: the predicted path [m].
        way_points: number of way-points.
        random: source of random numbers.
    """

    probing: Probing
    settings: SearchConfig
    goals: Float[Tensor, "S 2"]
    path: Float[Tensor, "T 2"]
    way_points: int
    random: np.random.Generator

    @classmethod
    def of(
        cls,
        probing: Probing,
        settings: SearchConfig,
        goals: Float[Tensor, "S 2"],
        way_points: int,
        seed: np.random.SeedSequence,
    ) -> Search:
        """A search with random numbers from `seed`. The predicted path is the mean over goals, without a probe."""
        path = probing.run(None, goals).x.mean(0)
        return cls(probing, settings, goals, path, way_points, np.random.default_rng(seed))

    def anywhere(self, count: int) -> Float[Tensor, "P K 2"]:
        """Way-points drawn uniformly from the room [m]."""
        lower, upper = self.probing.room
        even = torch.from_numpy(self.random.uniform(size=(count, self.way_points, 2)))
        return self.probing.allowed(lower + (upper - lower) * even)

    def near_path(self, count: int) -> Float[Tensor, "P K 2"]:
        """Placements near the predicted path [m].

        A still probe is drawn near any point of the path. A way-point is drawn on a ring around the robot's position at
        that time, with a radius a little above the safety distance. Each is turned some way around the ring from the
        one before.
        """
        spread, T, K = self.settings.spread, len(self.path), self.way_points
        if K == 1:
            at = torch.from_numpy(self.random.integers(T, size=(count, 1)))
            away = spread * torch.from_numpy(self.random.normal(size=(count, 1, 2)))
            return self.probing.allowed(self.path[at] + away)
        at = torch.linspace(0, T - 1, K).round().long()
        turns = self.random.normal(size=(count, K)) * TURN
        turns[:, 0] = self.random.uniform(0, 2 * np.pi, size=count)
        angle = torch.from_numpy(turns.cumsum(-1))
        radius = self.probing.safety_distance + spread * torch.from_numpy(self.random.normal(size=(count, K))).abs()
        ring = radius.unsqueeze(-1) * torch.stack([angle.cos(), angle.sin()], dim=-1)
        return self.probing.allowed(self.path[at] + ring)

    def evaluate(self, placements: Float[Tensor, "P K 2"]) -> Float[Tensor, "P S"]:
        """The area for every placement and goal [m^2], without gradients."""
        with torch.no_grad():
            return self.probing.left(placements, self.goals).area


def drawn(draw: Callable[[Search, int], Tensor]) -> Callable[[Search], Evaluated]:
    """The method that evaluates placements drawn by `draw`, all in all `starts` x `steps`."""

    def method(search: Search) -> Evaluated:
        found, settings = Evaluated(), search.settings
        for _ in range(settings.steps):
            placements = draw(search, settings.starts)
            found.add(placements, search.evaluate(placements))
        return found

    return method


def grid(search: Search) -> Evaluated:
    """The method that evaluates places on a grid of about square cells."""
    found, settings = Evaluated(), search.settings
    lower, upper = search.probing.room
    width, height = (upper - lower).tolist()
    columns = max(1, round((settings.starts * settings.steps * width / height) ** 0.5))
    places = search.probing.grid(columns, settings.starts * settings.steps // columns)
    for chunk in search.probing.allowed(places.unsqueeze(1)).split(settings.starts):
        found.add(chunk, search.evaluate(chunk))
    return found


def cem(search: Search) -> Evaluated:
    """The cross-entropy method (R. Rubinstein, 1999), axis by axis. Its first generation is near the predicted path."""
    found, settings = Evaluated(), search.settings
    elite = max(2, round(settings.elite * settings.starts))
    placements = search.near_path(settings.starts)
    for _ in range(settings.steps):
        order = found.add(placements, search.evaluate(placements)).argsort()
        best = placements[order[:elite]]
        mean, spread = best.mean(0), best.std(0).clamp(min=COARSEST)
        normal = torch.from_numpy(search.random.normal(size=tuple(placements.shape)))
        placements = search.probing.allowed(mean + spread * normal)
    return found


def adam(search: Search) -> Evaluated:
    """Adam by successive halving (K. Jamieson, A. Talwalkar, 2016), projected onto the allowed placements.

    From most starts there is no descent: the probe changes nothing or comes too close. So a fifth of the simulations
    chooses starts. The others go in equal shares to the best `starts`/2, the best half of these, and the best half
    again. The fewer starts are left, the more steps each has. The learning rate falls to zero.
    """
    found, settings = Evaluated(), search.settings
    for _ in range(max(settings.steps // 5, 1)):
        placements = search.near_path(settings.starts)
        found.add(placements, search.evaluate(placements))
    placements, means = torch.cat(found.placements), torch.cat(found.means)
    starts = torch.arange(len(means))
    left = settings.starts * settings.steps - len(means)
    for stage in range(HALVINGS):
        best = means.argsort()[: max(settings.starts >> (stage + 1), 1)]
        steps = left // (HALVINGS - stage) // len(best)
        starts = starts[best]
        rates = [settings.learning_rate * (1 - done / HALVINGS) for done in (stage, stage + 1)]
        placements, means = _descend(search, found, placements[best], means[best], steps, rates)
        found.starts += [starts] * steps
        left -= steps * len(best)
    return found


def _descend(
    search: Search,
    found: Evaluated,
    best: Float[Tensor, "P K 2"],
    lowest: Float[Tensor, "P"],
    steps: int,
    rates: Sequence[float],
) -> tuple[Float[Tensor, "P K 2"], Float[Tensor, "P"]]:
    """The best placement on the descent from each start, and its mean area. The learning rate changes over `rates`."""
    placements = best.clone().requires_grad_()
    optimiser = torch.optim.Adam([placements])
    for k in range(steps):
        optimiser.param_groups[0]["lr"] = rates[0] + (rates[1] - rates[0]) * k / steps
        areas = search.probing.left(placements, search.goals).area
        means = found.add(placements, areas)
        better = means < lowest
        best = torch.where(better[:, None, None], placements.detach(), best)
        lowest = torch.where(better, means, lowest)
        optimiser.zero_grad()
        expected = expectation(areas, search.settings.objective).sum()
        if expected.requires_grad:  # false if no placement changes anything
            expected.backward()
            optimiser.step()
            with torch.no_grad():
                placements.copy_(search.probing.allowed(placements))
    return best, lowest


METHODS: dict[str, Callable[[Search], Evaluated]] = {
    "grid": grid,
    "random": drawn(Search.anywhere),
    "near_path": drawn(Search.near_path),
    "cem": cem,
    "adam": adam,
}


def choose(search: Search, found: Evaluated, goals: Float[Tensor, "S 2"]) -> Float[Tensor, "1 K 2"]:
    """The finalist with the smallest mean area over other goals."""
    finalists = torch.cat(found.means).argsort()[: search.settings.finalists]
    placements = torch.cat(found.placements)[finalists]
    with torch.no_grad():
        best = search.probing.left(placements, goals).area.mean(-1).argmin()
    return placements[best : best + 1]
