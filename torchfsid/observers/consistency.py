r"""The smallest bounds on errors with which a log fits its declared model, whatever the truth is.

    delta_i = min { delta : the sets of robot i's samples with velocity bound delta share a point of the prior }

A set grows with its bound, so bisection finds delta_i. Below it no parameter explains robot i. A hard row that is
violated by more than its bound is a contradiction too, if `slack` follows `velocity`. The residual of one sample is the
smallest bound for that sample alone, with a given Theta in place of the prior.

Unlike an observer, this reads the whole log. Blocks of samples are read at once with the current Theta. They are read
again while that shrinks Theta, which is possible if the nominal control is clipped. So the sets are never larger than
the observer's. An observer with bound delta_i finds no contradiction, up to round-off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import Evidence, ObservationModel, evidence
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Task
from torchfsid.sets.feasible_set import FeasibleSet

RESOLUTION = 1.02
"""A bound that is found is at most this factor too large."""

SMALLEST = 1e-9
"""Bounds below this are not told apart [m/s]."""

BLOCK = 64
"""Samples read at once."""

SHRUNK = 0.9
"""Samples are read again while that leaves less than this fraction of some robot's Theta."""


@dataclass(frozen=True)
class Block:
    """Some samples of all robots as one measurement, sample by sample."""

    times: Float[Tensor, "samples"]
    measurement: Measurement

    @classmethod
    def of(cls, samples: Sequence[Measurement]) -> Block:
        return cls(
            torch.tensor([sample.time for sample in samples], dtype=torch.float64), Measurement.concatenate(samples)
        )

    def repeated(self, of_robots: Tensor) -> Tensor:
        """The values `of_robots`, repeated for each sample of the block."""
        return of_robots.repeat(len(self.times), *[1] * (of_robots.ndim - 1))


class Consistency:
    """The consistency of a log with a model of robots that share a task and barriers.

    Args:
        measurements: the samples in the order of time, all of the same robots.
        task: the task of all robots.
        barriers: the barriers of all robots.
        prior: the robots' prior sets, batch (B,).
        slack: a separate bound for the slack [m/s]; None for that of the velocity.
        position: see `NoiseBound` [m].
        neighbour_velocity: see `NoiseBound` [m/s].
    """

    def __init__(
        self,
        measurements: Sequence[Measurement],
        task: Task,
        barriers: Sequence[Barrier],
        prior: FeasibleSet,
        slack: float | None = None,
        position: float = 0.0,
        neighbour_velocity: float = 0.0,
    ):
        self.task, self.barriers, self.prior, self.slack = task, barriers, prior, slack
        self.position, self.neighbour_velocity = position, neighbour_velocity
        self.robots = prior.batch_shape[0]
        self.blocks = [Block.of(measurements[k : k + BLOCK]) for k in range(0, len(measurements), BLOCK)]
        self.fastest = max(float(sample.u.norm(dim=-1).max()) for sample in measurements if sample.u is not None)

    def smallest_bounds(self, largest: float) -> Float[Tensor, "B"]:
        """delta_i of every robot [m/s], too large by at most `RESOLUTION`. Infinite if it is above `largest`."""
        high = torch.full((self.robots,), largest, dtype=torch.float64)
        possible = self.sets(high)[1]
        low = torch.full_like(high, min(SMALLEST, largest))
        high = torch.where(self.sets(low)[1], low, high)
        while bool((high > low * RESOLUTION)[possible].any()):
            middle = (low * high).sqrt()
            fits = self.sets(middle, possible)[1]
            low, high = torch.where(fits, low, middle), torch.where(fits, middle, high)
        return torch.where(possible, high, math.inf)

    def sets(
        self, velocity: Float[Tensor, "B"], wanted: Bool[Tensor, "B"] | None = None
    ) -> tuple[FeasibleSet, Bool[Tensor, "B"]]:
        """Theta of every robot for its own velocity bound [m/s], and whether it is free of contradictions.

        The computation stops as soon as all `wanted` robots (default: all) are contradicted.
        """
        wanted = torch.ones(self.robots, dtype=torch.bool) if wanted is None else wanted
        theta, fits = self.prior, torch.ones(self.robots, dtype=torch.bool)
        while True:
            before = theta.volume()
            for block in self.blocks:
                found = self.read(block, theta, block.repeated(velocity))
                if self.slack is None:
                    fits = fits & ~self._by_robot(found.alarmed).any(0)
                rows = found.omega
                A, b = self._by_robot(rows.A).transpose(0, 1).flatten(1, 2), self._by_robot(rows.b).transpose(0, 1)
                narrowed = theta.intersect(Halfspaces(A, b.flatten(1, 2)))
                fits = fits & ~narrowed.is_empty
                theta = narrowed.where(~narrowed.is_empty, theta)
                if not bool((fits & wanted).any()):
                    return theta, fits
            if self.task.saturation is None or bool((theta.volume() >= SHRUNK * before)[fits & wanted].all()):
                return theta, fits

    def residuals(self, theta: FeasibleSet, largest: float) -> Float[Tensor, "samples B"]:
        """The smallest bound with which each sample's own set meets Theta [m/s].

        It is NaN where the sample says nothing of theta, and infinite above `largest`.
        """
        found = []
        for block in self.blocks:
            items = len(block.times) * self.robots
            high = torch.full((items,), largest, dtype=torch.float64)
            low = torch.full_like(high, min(SMALLEST, largest))
            possible, says = self._meets(block, theta, high)
            high = torch.where(self._meets(block, theta, low)[0], low, high)
            while bool((high > low * RESOLUTION)[possible].any()):
                middle = (low * high).sqrt()
                meets, _ = self._meets(block, theta, middle)
                low, high = torch.where(meets, low, middle), torch.where(meets, middle, high)
            found.append(self._by_robot(torch.where(possible, high, math.inf).where(says, math.nan)))
        return torch.cat(found)

    def read(self, block: Block, theta: FeasibleSet, velocity: Float[Tensor, "items"]) -> Evidence:
        """The evidence of a block of samples, given Theta and a velocity bound [m/s] for each item."""
        slack = None if self.slack is None else torch.full_like(velocity, self.slack)
        noise = NoiseBound(velocity, slack, self.position, self.neighbour_velocity)
        return evidence(ObservationModel(self.task, self.barriers, noise=noise), theta, block.measurement)

    def _meets(
        self, block: Block, theta: FeasibleSet, velocity: Float[Tensor, "items"]
    ) -> tuple[Bool[Tensor, "items"], Bool[Tensor, "items"]]:
        """Does each sample's set meet Theta, and was the sample measured at all?"""
        found = self.read(block, theta, velocity)
        items = block.repeated(torch.arange(self.robots))
        meets = ~theta.select(items).intersect(found.omega).is_empty
        if self.slack is None:
            meets = meets & ~found.alarmed
        return meets, found.informative | found.alarmed

    def _by_robot(self, items: Tensor) -> Tensor:
        return items.unflatten(0, (-1, self.robots))
