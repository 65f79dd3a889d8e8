r"""The smallest bounds on errors with which a log fits its declared model, whatever the truth is.

    delta_i = min { delta : the sets of robot i's samples with bound delta on controls share a point of the prior }

A set grows with its bound, so bisection finds delta_i. Below it no parameter explains robot i. A hard row that is
violated by more than its bound is a contradiction too, if `slack` follows `velocity`. The residual of one sample is the
smallest bound for that sample alone, with a given Theta in place of the prior.

Unlike an observer, this reads the whole log. Blocks of samples are read at once with the current Theta. They are read
again while that shrinks Theta, which is possible if the nominal control is clipped. So the sets are never larger than
the observer's. An observer with bound delta_i finds no contradiction, up to round-off. Where safety parameters are
unknown, every robot has a set Psi of its own beside its Theta.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.identification.by_robot import by_robot
from torchfsid.identification.evidence import Evidence, ObservationModel, evidence
from torchfsid.identification.safety_parameters import LearningModel, Possible
from torchfsid.observers.blocks import times_of
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Task
from torchfsid.robots.unknown_avoidance import UnknownAvoidance
from torchfsid.sets.feasible_set import FeasibleSet

RESOLUTION = 1.02
"""A bound that is found is at most this factor too large."""

SMALLEST = 1e-9
"""Bounds below this are not told apart [units of the control]."""

BLOCK = 64
"""Samples read at once."""

SHRUNK = 0.9
"""Samples are read again while that leaves less than this fraction of some robot's Theta."""


@dataclass(frozen=True)
class Block:
    """Some samples of all robots as one measurement, sample by sample."""

    times: Float[Tensor, "samples"]
    measurement: Measurement

    @property
    def of_items(self) -> Float[Tensor, "items"]:
        """The time of each item, a robot's sample [s]."""
        return torch.as_tensor(self.measurement.t, dtype=torch.float64)

    def repeated(self, of_robots: Tensor) -> Tensor:
        """The values `of_robots`, repeated for each sample of the block."""
        return of_robots.repeat(len(self.times), *[1] * (of_robots.ndim - 1))


class Fit(NamedTuple):
    """Theta of every robot, its Psi if safety parameters are unknown, and whether they are free of contradictions."""

    theta: FeasibleSet
    psi: FeasibleSet | None
    fits: Bool[Tensor, "B"]


class Consistency:
    """The consistency of a log with a model of robots that share a task and barriers.

    Args:
        measurements: the samples in the order of time, all of the same robots. Either a list of single samples, or
            blocks of samples, concatenated, that can be iterated over again and again: of a long log, not all is kept.
        task: the task of all robots.
        barriers: the barriers of all robots.
        prior: the robots' prior sets, batch (B,).
        slack: a separate bound for the slack [units of the control]; None for that of the control.
        others: all other bounds. Its `velocity` and `slack` are not used.
    """

    def __init__(
        self,
        measurements: Iterable[Measurement],
        task: Task,
        barriers: Sequence[Barrier | UnknownAvoidance],
        prior: FeasibleSet,
        slack: float | None = None,
        others: NoiseBound | None = None,
    ):
        self.task, self.barriers, self.prior, self.slack = task, barriers, prior, slack
        self.others = NoiseBound(0.0) if others is None else others
        self.robots = prior.batch_shape[0]
        unknown = [barrier for barrier in barriers if isinstance(barrier, UnknownAvoidance)]
        self.psi = unknown[0].prior(self.robots) if unknown else None
        if isinstance(measurements, Sequence):
            samples = range(0, len(measurements), BLOCK)
            measurements = [Measurement.concatenate(measurements[k : k + BLOCK]) for k in samples]
        self._measurements = measurements

    @property
    def blocks(self) -> Iterator[Block]:
        """The samples, block by block."""
        for measurement in self._measurements:
            yield Block(times_of(measurement, self.robots), measurement)

    def thinned(self, most: int) -> Consistency:
        """The same for at most so many blocks, evenly spread over the log, with its `fastest`."""
        step = math.ceil(sum(1 for _ in self._measurements) / most)
        other = copy(self)
        other.fastest, other._measurements = self.fastest, list(islice(self._measurements, 0, None, step))
        return other

    @cached_property
    def fastest(self) -> float:
        """The size of the largest control."""
        return max(float(of.u.norm(dim=-1).max()) for of in self._measurements if of.u is not None)

    def smallest_bounds(self, largest: float) -> Float[Tensor, "B"]:
        """delta_i of every robot, too large by at most `RESOLUTION`. Infinite if it is above `largest`."""
        high = torch.full((self.robots,), largest, dtype=torch.float64)
        possible = self.sets(high).fits
        low = torch.full_like(high, min(SMALLEST, largest))
        high = torch.where(self.sets(low).fits, low, high)
        while bool((high > low * RESOLUTION)[possible].any()):
            middle = (low * high).sqrt()
            fits = self.sets(middle, possible).fits
            low, high = torch.where(fits, low, middle), torch.where(fits, middle, high)
        return torch.where(possible, high, math.inf)

    def sets(self, velocity: Float[Tensor, "B"], wanted: Bool[Tensor, "B"] | None = None) -> Fit:
        """The sets of every robot for its own bound on controls.

        The computation stops as soon as all `wanted` robots (default: all) are contradicted.
        """
        wanted = torch.ones(self.robots, dtype=torch.bool) if wanted is None else wanted
        theta, psi, fits = self.prior, self.psi, torch.ones(self.robots, dtype=torch.bool)
        rereads = self.task.saturation is not None or psi is not None or getattr(self.task, "uncertain", False)
        while True:
            before = theta.volume()
            for block in self.blocks:
                noise = self._noise(block.repeated(velocity))
                if psi is None:
                    found = evidence(ObservationModel(self.task, self._known, noise=noise), theta, block.measurement)
                    narrowed = theta.intersect(*by_robot(found.omega, block.of_items, self.robots))
                else:
                    own = Possible(theta, psi, torch.arange(self.robots))
                    read = LearningModel(self.task, self.barriers, noise).read(own, block.measurement)
                    found, narrowed = read.evidence, read.theta
                    learned = read.cuts.apply(psi, own.owner, block.of_items)
                    fits = fits & ~learned.is_empty
                    psi = learned.where(~learned.is_empty, psi)
                if self.slack is None:
                    fits = fits & ~self._by_robot(found.alarmed).any(0)
                fits = fits & ~narrowed.is_empty
                theta = narrowed.where(~narrowed.is_empty, theta)
                if not bool((fits & wanted).any()):
                    return Fit(theta, psi, fits)
            if not rereads or bool((theta.volume() >= SHRUNK * before)[fits & wanted].all()):
                return Fit(theta, psi, fits)

    def residuals(self, sets: Fit, largest: float) -> Float[Tensor, "samples B"]:
        """The smallest bound with which each sample's own set meets Theta.

        It is NaN where the sample says nothing of theta, and infinite above `largest`.
        """
        found = []
        for block in self.blocks:
            items = len(block.times) * self.robots
            high = torch.full((items,), largest, dtype=torch.float64)
            low = torch.full_like(high, min(SMALLEST, largest))
            possible, says = self._meets(block, sets, high)
            high = torch.where(self._meets(block, sets, low)[0], low, high)
            while bool((high > low * RESOLUTION)[possible].any()):
                middle = (low * high).sqrt()
                meets, _ = self._meets(block, sets, middle)
                low, high = torch.where(meets, low, middle), torch.where(meets, middle, high)
            found.append(self._by_robot(torch.where(possible, high, math.inf).where(says, math.nan)))
        return torch.cat(found)

    def read(self, block: Block, sets: Fit, velocity: Float[Tensor, "items"]) -> Evidence:
        """The evidence of a block of samples, given sets and a bound on controls for each item."""
        noise = self._noise(velocity)
        if sets.psi is None:
            model = ObservationModel(self.task, self._known, noise=noise)
        else:
            corners = block.repeated(sets.psi.vertices().detach())
            model = LearningModel(self.task, self.barriers, noise).given(corners)
        return evidence(model, sets.theta, block.measurement)

    @property
    def _known(self) -> list[Barrier]:
        return [barrier for barrier in self.barriers if not isinstance(barrier, UnknownAvoidance)]

    def _noise(self, velocity: Float[Tensor, "items"]) -> NoiseBound:
        slack = velocity if self.slack is None else torch.full_like(velocity, self.slack)
        return replace(self.others, velocity=velocity, slack=slack)

    def _meets(
        self, block: Block, sets: Fit, velocity: Float[Tensor, "items"]
    ) -> tuple[Bool[Tensor, "items"], Bool[Tensor, "items"]]:
        """Does each sample's set meet Theta, and was the sample measured at all?"""
        found = self.read(block, sets, velocity)
        items = block.repeated(torch.arange(self.robots))
        meets = ~sets.theta.select(items).intersect(found.omega).is_empty
        if self.slack is None:
            meets = meets & ~found.alarmed
        return meets, found.informative | found.alarmed

    def _by_robot(self, items: Tensor) -> Tensor:
        return items.unflatten(0, (-1, self.robots))
