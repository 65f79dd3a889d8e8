"""Several samples of all robots, taken in at once: what does not depend on Theta is computed for all of them.

The half-spaces of S samples are given. Most of them cut no set. Theta of a robot changes at some samples only, and a
search finds the next of these for each robot (`kernels.first_cuts`). All robots are then cut together, each by the
half-spaces of its own next sample, and the search goes on from there. So sets are cut in the order of time, exactly as
if the samples had come one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.device import any_of
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, array
from torchfsid.identification.evidence import ObservationModel
from torchfsid.kernels.first_cuts import first_cuts, first_cuts_of_hulls
from torchfsid.observers.outliers import Levels, narrowed
from torchfsid.robots.bounds import ErrorBounds
from torchfsid.robots.measurement import Measurement
from torchfsid.sets.feasible_set import FeasibleSet

LARGEST_THETA = 1e9
"""Larger than any parameter, to find out what depends on them."""

FEW = 12
"""Batches of sets that are joined at a time."""


def depends_on_theta(model: ObservationModel, measurement: Measurement, robots: int) -> bool:
    """Does what a measurement of these robots says, at one or several times, depend on the sets so far?

    A bound on the drift of C theta + d is no smaller for larger theta. If it is the same for theta = 0 as for all theta
    of the largest numbers, it does not depend on theta.
    """
    if model.task.saturation is not None or getattr(model.task, "uncertain", False):
        return True
    noise = model.noise and model.noise.of_samples(robots, len(measurement.x))
    noise = noise and replace(noise, velocity=0.0, slack=0.0)  # no drift depends on them
    errors = ErrorBounds.of(measurement, noise)
    if errors is None:
        return False
    nothing = measurement.x.new_zeros(len(measurement.x), len(model.task.parameter_names))
    bounds = (model.task.drift(errors, size) for size in (nothing, torch.full_like(nothing, LARGEST_THETA)))
    return not torch.equal(*bounds)


def times_of(samples: Measurement, robots: int) -> Float[Tensor, "S"]:
    """The times of S samples of these robots, concatenated in the order of time [s], on the CPU.

    Raises:
        InputError: the measurement is not such samples, or a sample has several times.
    """
    items = len(samples.x)
    if samples.x.ndim == 2 and items == robots:
        return torch.tensor([samples.time], dtype=torch.float64, device="cpu")
    if samples.x.ndim != 2 or robots == 0 or items == 0 or items % robots != 0:
        raise InputError("measurement", f"samples of {robots} robots, concatenated", tuple(samples.x.shape))
    times = (
        torch.as_tensor(samples.t, dtype=torch.float64, device=samples.x.device)
        .expand(items)
        .unflatten(0, (-1, robots))
    )
    if not bool((times == times[:, :1]).all()):
        raise InputError("measurement.t", "one time for all robots of a sample", "different times")
    return times[:, 0].cpu()


def one_by_one(samples: Measurement, robots: int) -> Iterator[Measurement]:
    """The samples of a block, one after the other."""
    if len(samples.x) == robots:
        yield samples
        return
    for s, t in enumerate(times_of(samples, robots).tolist()):
        yield replace(samples.select(slice(s * robots, (s + 1) * robots)), t=t)


@dataclass
class Course:
    """Sets of B robots over S samples, as they are cut in the order of time.

    Attributes:
        levels: the sets so far, see `outliers`. The last one is Theta.
        omega: the half-spaces of the samples (S*B, R), sample by sample.
        t: the times of the samples [s], on the CPU.
        alarmed: which samples are alarming (S*B).
        parts: sets Theta, each a batch (k,): those before the samples, and those that followed.
        which: for each sample and robot, the place of Theta after the sample in all `parts` one after the other.
        explained: whether a parameter of Theta explains the sample.
        proofs: for each (sample, robot) that emptied the last level, what `proof` says of the empty set.
        any_alarm: whether a sample is alarming.
    """

    levels: Levels
    omega: Halfspaces
    t: Float[Tensor, "S"]
    alarmed: Bool[Tensor, "N"]
    parts: list[FeasibleSet] = field(init=False)
    which: Int[Tensor, "S B"] = field(init=False)
    explained: Bool[Tensor, "S B"] = field(init=False)
    proofs: dict[tuple[int, int], tuple] = field(init=False, default_factory=dict)
    any_alarm: bool = field(init=False)

    def run(self, prior: FeasibleSet | None, proof: Callable[[FeasibleSet, int], tuple]) -> None:
        """Cut the sets by all samples.

        Args:
            prior: what follows an empty set. None: the set as it was.
            proof: called with the sets and the robot, where a set is empty.
        """
        samples, robots = len(self.t), self.levels[-1].batch_shape[0]
        device = self.levels[-1].outcome.device
        every = torch.arange(robots, device=device)
        if samples == 1:  # no search: all robots are cut at once
            explains, theta = self._cut(self.omega, self.t.item(), None, prior, proof)
            self.parts, self.which, self.explained = [theta], every.unsqueeze(0), explains.unsqueeze(0)
            return
        self.any_alarm = bool(self.alarmed.any())
        self.omega, now, times = self.omega.shortened(), torch.zeros_like(every), self.t.to(device)
        self.parts, known = [self.levels[-1]], robots
        which, explained = np.tile(np.arange(robots), (samples, 1)), np.ones((samples, robots), dtype=np.bool_)
        while bool((cut := (now := self._next_cuts(now)) < samples).any()):
            items = now.clamp(max=samples - 1) * robots + every
            omega = self.omega.select(items).where(cut.unsqueeze(-1))
            explains, theta = self._cut(omega, times[items // robots], now, prior, proof)
            changed = cut.nonzero().flatten()
            self.parts.append(theta.select(changed))
            for robot, sample in zip(changed.tolist(), now[changed].tolist(), strict=True):
                which[sample:, robot], explained[sample, robot], known = known, bool(explains[robot]), known + 1
            now = torch.where(cut, now + 1, samples)
        self.which, self.explained = (torch.from_numpy(part).to(device) for part in (which, explained))

    def _cut(
        self, omega: Halfspaces, t: float | Tensor, now: Tensor | None, prior: FeasibleSet | None, proof: Callable
    ) -> tuple[Bool[Tensor, "B"], FeasibleSet]:
        """Cut the sets by the samples `now` of the robots (None: the first). Returns `explained` of them, and Theta."""
        (*below, theta), explained = narrowed(self.levels, omega, t)
        if now is None:  # all that the host has to know of an update, at once
            any_empty, self.any_alarm = any_of(theta.is_empty, self.alarmed)
            theta = theta.knowing(any_empty)
        if theta.any_empty:
            for robot in theta.is_empty.nonzero().flatten().tolist():
                self.proofs[0 if now is None else int(now[robot]), robot] = proof(theta, robot)
            theta = theta.where(~theta.is_empty, self.levels[-1] if prior is None else prior)
        self.levels = (*below, theta)
        return explained, theta

    @property
    def lost(self) -> Bool[Tensor, "S B"]:
        """Where a sample emptied the last level."""
        found = torch.zeros_like(self.explained)
        for place in self.proofs:
            found[place] = True
        return found

    def _next_cuts(self, start: Int[Tensor, "B"]) -> Int[Tensor, "B"]:
        """For each robot the first sample, from `start` on, of which some row cuts some level. S if there is none."""
        samples = len(self.t)
        found = torch.full_like(start, samples)
        for level in self.levels:
            since = torch.where(level.is_empty, samples, start)
            found = torch.minimum(found, self._next_cut_of(level, since))
        return found

    def _next_cut_of(self, level: FeasibleSet, start: Int[Tensor, "B"]) -> Int[Tensor, "B"]:
        corners, reach = array(level.body.corners), array(level.body.reach)
        if level.dim == 2:
            found = first_cuts(corners, array(level.body.count), reach, *self._rows, array(start))
        else:
            found = first_cuts_of_hulls(corners, reach, *self._rows, array(start))
        return torch.from_numpy(found).to(start.device)

    @cached_property
    def _rows(self) -> tuple[np.ndarray, np.ndarray]:
        shape = len(self.t), -1
        return array(self.omega.A.unflatten(0, shape)), array(self.omega.b.unflatten(0, shape))


def joined(parts: Sequence[FeasibleSet]) -> FeasibleSet:
    """Many batches (k,) of sets as one. Few are joined at a time, so that each set is copied a few times only."""
    while len(parts) > 1:
        parts = [FeasibleSet.concatenate(parts[k : k + FEW]) for k in range(0, len(parts), FEW)]
    return parts[0]
