"""A fleet on several cores: the robots of one observer in parts, each in a thread of its own.

Robots do not know of each other's sets, so the parts have nothing to wait for, and the results are those of the one
observer, whatever the number of parts. Sets stay where they are; those of the whole fleet are put together on demand.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InconsistentError, InputError
from torchfsid.kernels.threads import at_once, get_num_threads
from torchfsid.observers.set_membership import Event, SetEstimate, SetMembershipObserver
from torchfsid.robots.measurement import Measurement
from torchfsid.sets.feasible_set import FeasibleSet


@dataclass(frozen=True)
class FleetEstimate:
    """The sets of a fleet at time t.

    Attributes:
        parts: the estimates of its parts, in the order of the robots.
    """

    parts: tuple[SetEstimate, ...]

    @property
    def t(self) -> float:
        """The time [s]."""
        return self.parts[0].t

    @cached_property
    def feasible_set(self) -> FeasibleSet:
        """Theta(t) of every robot."""
        return FeasibleSet.concatenate([part.feasible_set for part in self.parts])

    @property
    def informative(self) -> Bool[Tensor, "B"]:
        """Whether the sample was used, see `SetEstimate`."""
        return torch.cat([part.informative for part in self.parts])

    @property
    def status(self) -> Int[Tensor, "B"]:
        """A `Status` per robot, the worst so far."""
        return torch.cat([part.status for part in self.parts])

    @property
    def theta(self) -> Float[Tensor, "B p"]:
        """The point estimate, see `SetEstimate`."""
        return torch.cat([part.theta for part in self.parts])


class FleetObserver:
    """A set-membership observer whose robots are shared among threads.

    It pays from some thousand robots on. Set `torch.set_num_threads(1)` beside it: torch's own threads would only
    compete with these.

    Args:
        observer: the observer of the whole fleet. It has seen no measurement yet.
        threads: the number of parts. None: `get_num_threads()`, the cores of the machine unless that was changed.

    Attributes:
        parts: the observers of the parts, in the order of the robots.

    Raises:
        InputError: `threads` is less than 1, or the observer has already seen measurements.
    """

    def __init__(self, observer: SetMembershipObserver, threads: int | None = None):
        robots = len(observer.status)
        threads = get_num_threads() if threads is None else threads
        if threads < 1:
            raise InputError("threads", "1 or more", threads)
        if observer.feasible_set is not observer.prior or observer.events or bool(observer.skipped.any()):
            raise InputError("observer", "one that has seen no measurement", observer.events or "others")
        places = torch.arange(robots).tensor_split(max(1, min(threads, robots)))
        self.parts = tuple(_part(observer, items) for items in places)
        self._slices = [slice(int(items[0]), int(items[-1]) + 1) if len(items) else slice(0) for items in places]

    def update(self, measurement: Measurement) -> FleetEstimate:
        """Take in one measurement of all robots.

        Raises:
            InputError: see `SetMembershipObserver.update`; or the measurement is not one of all robots.
            InconsistentError: see `SetMembershipObserver.update`. Other parts may then have taken the measurement in.
        """
        robots = self._slices[-1].stop
        if measurement.x.shape[:-1] != (robots,):
            raise InputError("measurement", f"a batch of {robots} robots", tuple(measurement.x.shape))
        gradients = torch.is_grad_enabled()  # a setting of each thread
        parts = zip(self.parts, self._slices, strict=True)
        found = at_once([partial(_update, part, measurement, items, gradients) for part, items in parts])
        return FleetEstimate(tuple(found))

    @property
    def feasible_set(self) -> FeasibleSet:
        """The sets of all robots."""
        return FeasibleSet.concatenate([part.feasible_set for part in self.parts])

    @property
    def status(self) -> Int[Tensor, "B"]:
        """A `Status` per robot."""
        return torch.cat([part.status for part in self.parts])

    @property
    def skipped(self) -> Int[Tensor, "B"]:
        """The number of samples without information, per robot."""
        return torch.cat([part.skipped for part in self.parts])

    @property
    def infeasible(self) -> Int[Tensor, "B"]:
        """The number of those with rows that may have been infeasible, per robot."""
        return torch.cat([part.infeasible for part in self.parts])

    @property
    def events(self) -> list[Event]:
        """The events of all robots, in the order of time."""
        parts = zip(self.parts, self._slices, strict=True)
        found = [replace(event, robot=items.start + event.robot) for part, items in parts for event in part.events]
        return sorted(found, key=lambda event: (event.t, event.robot))


def _part(observer: SetMembershipObserver, robots: Int[Tensor, "k"]) -> SetMembershipObserver:
    fleet = len(observer.status)
    noise = None if observer.noise is None else observer.noise.of_samples(fleet, fleet).select(robots)
    return replace(observer, feasible_set=observer.feasible_set.select(robots), noise=noise)


def _update(part: SetMembershipObserver, measurement: Measurement, items: slice, gradients: bool) -> SetEstimate:
    with torch.set_grad_enabled(gradients):
        try:
            return part.update(measurement.select(items))
        except InconsistentError as error:
            raise InconsistentError(items.start + error.robot, error.t, error.rows) from error
