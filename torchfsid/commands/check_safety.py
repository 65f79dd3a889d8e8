"""Are the declared gain and safety distance possible, and if not, which of the two is wrong?

The log is read with both unknown in wide intervals about the declared values. Then each is held at its declared value
while the other is free. A value is blamed only if nothing that the other could be explains the log. So a right value is
never blamed, as long as the rest of the model and the bounds hold.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace

import torch

from torchfsid.commands.declared_log import DeclaredLog, automatic_bound
from torchfsid.commands.terminal import ends
from torchfsid.config.avoidance import AvoidanceConfig
from torchfsid.identification.safety_parameters import LearningModel, Possible
from torchfsid.observers.second_look import second_look
from torchfsid.robots.unknown_avoidance import Interval, UnknownAvoidance

GAIN_FACTOR, DISTANCE_FACTOR = 100.0, 4.0
"""The intervals reach from the declared value by these factors, down and up."""


@dataclass(frozen=True)
class Learned:
    """What the log allows: intervals of gain and distance [m], and which ends the data bound. None if nothing is."""

    gain: Interval
    distance: Interval
    gain_by_data: tuple[bool, bool]
    distance_by_data: tuple[bool, bool]


@dataclass(frozen=True)
class SafetyCheck:
    """The declared gain and distance against the log.

    Attributes:
        what: `safety distance` or `margin`.
        gain: the declared gain; None if it is an interval.
        distance: the declared safety distance or margin [m]; None if it is an interval.
        free: what the log allows if both are unknown.
        with_gain: what it allows with the declared gain.
        with_distance: what it allows with the declared distance.
        pair: whether it allows both declared values.
        is_useless: whether the velocity bound is, see `JudgedBound`.
    """

    what: str
    gain: float | None
    distance: float | None
    free: Learned | None
    with_gain: Learned | None
    with_distance: Learned | None
    pair: bool
    is_useless: bool

    @property
    def verdict(self) -> str:
        """`possible`, or what is wrong: `gain`, `distance`, `both`, `one` of them, or `neither`, something else is."""
        if self.pair:
            return "possible"
        if self.free is None:
            return "neither"
        return {(False, False): "both", (False, True): "gain", (True, False): "distance", (True, True): "one"}[
            (self.with_gain is not None, self.with_distance is not None)
        ]

    def conclusion(self) -> str:
        """The verdict as a sentence."""
        return f"at a useless bound only: {self._said()}" if self.is_useless and self.free else self._said()

    def _said(self) -> str:
        if self.free is None:
            is_interval = self.gain is None
            within, causes = ("of the declared intervals ", "they are wrong, ") if is_interval else ("", "")
            return (
                f"no gain and {self.what} {within}common to all robots explain the log: {causes}robots differ, "
                "or something else in the model is wrong"
            )
        allowed = f"the log allows gain {ends(self.free.gain, self.free.gain_by_data)} and {self.what} " + (
            f"{ends(self.free.distance, self.free.distance_by_data)} m"
        )
        if not all((*self.free.gain_by_data, *self.free.distance_by_data)):
            allowed += " (* not bounded by the data)"
        if self.gain is None or self.distance is None:
            return allowed
        declared = f"gain {self.gain:g} and {self.what} {self.distance:g} m"
        other = self.with_distance or self.with_gain
        if self.verdict == "possible":
            return f"the declared {declared} are possible; {allowed}"
        if self.verdict == "both" or other is None:
            return f"the declared {declared} are both wrong; {allowed}"
        if self.verdict == "gain":
            right = f"with {self.what} {self.distance:g} m it is {ends(other.gain)}"
            return f"the gain {self.gain:g} is wrong: {right}; {allowed}"
        if self.verdict == "distance":
            return (
                f"the {self.what} {self.distance:g} m is wrong: with gain {self.gain:g} it is "
                f"{ends(other.distance)} m; {allowed}"
            )
        return f"of the declared {declared} at least one is wrong, and the log does not say which; {allowed}"

    def to_json(self) -> dict:
        """The entry of `check.json`."""
        learned = {"free": self.free, "with_gain": self.with_gain, "with_distance": self.with_distance}
        return {
            "verdict": self.verdict,
            "conclusion": self.conclusion(),
            **{name: None if found is None else vars(found) for name, found in learned.items()},
        }


def check_safety(declared: DeclaredLog) -> SafetyCheck | None:
    """Check the declared gain and distance of the avoidance barrier.

    With `velocity: auto` the bound is determined with both unknown, so that it does not hide an error of theirs.

    Args:
        declared: the log and its model.

    Returns:
        None if there is not exactly one such barrier, if bodies have distances of their own or are ellipsoids, or if
        sets are reset or are critical regions.
    """
    config = declared.config
    places = [i for i, barrier in enumerate(config.barriers) if isinstance(barrier, AvoidanceConfig)]
    if len(places) != 1 or config.set == "critical_region" or config.on_inconsistent == "reset":
        return None
    barrier = config.barriers[places[0]]
    assert isinstance(barrier, AvoidanceConfig)
    if barrier.safety_distances or barrier.ellipsoid is not None:
        return None
    radius = None if declared.log.radius is None else declared.log.radius.tolist()
    stated = barrier.build_unknown(radius)
    what = "safety distance" if stated.margin is None else "margin"
    (gain, _), (low, high) = stated.gain, stated.declared
    beside, wide = stated.lengths[0] - low, (gain / GAIN_FACTOR, gain * GAIN_FACTOR)
    around = (stated.lengths[0] / DISTANCE_FACTOR - beside, stated.lengths[0] * DISTANCE_FACTOR - beside)
    anything = stated if barrier.is_unknown else _with(stated, wide, around)
    declared = _with_barrier(declared, places[0], anything)
    if config.noise.control == "auto":
        smallest = declared.smallest_bounds()
        if math.inf in smallest.values():
            return SafetyCheck(what, gain, low, None, None, None, False, True)
        declared = declared.with_bound(automatic_bound(smallest, config.noise.quantity))
    bound = declared.config.noise.control
    assert bound != "auto"
    is_useless = declared.judged(bound).is_useless

    def learned(unknown: UnknownAvoidance) -> Learned | None:
        return _learned(_with_barrier(declared, places[0], unknown), unknown)

    free = learned(anything)
    if barrier.is_unknown:
        return SafetyCheck(what, None, None, free, None, None, free is not None, is_useless)
    with_gain = free and learned(_with(stated, stated.gain, around))
    with_distance = free and learned(_with(stated, wide, (low, high)))
    pair = with_gain is not None and with_distance is not None and learned(stated) is not None
    return SafetyCheck(what, gain, low, free, with_gain, with_distance, pair, is_useless)


def _with_barrier(declared: DeclaredLog, place: int, barrier: UnknownAvoidance) -> DeclaredLog:
    """The same log and model with another barrier at this place."""
    other = copy(declared)
    other.barriers = [barrier if i == place else old for i, old in enumerate(declared.barriers)]
    return other


def _with(stated: UnknownAvoidance, gain: Interval, distance: Interval) -> UnknownAvoidance:
    if stated.margin is None:
        return replace(stated, gain=gain, safety_distance=distance)
    return replace(stated, gain=gain, margin=distance)


def _learned(declared: DeclaredLog, unknown: UnknownAvoidance) -> Learned | None:
    """What the log allows within these intervals, or None if nothing explains it."""
    config, robots = declared.config, len(declared.robots)
    model = LearningModel(declared.task, declared.barriers, config.noise.build(), config.active_tolerance)
    start = Possible(declared.prior, unknown.prior(1), torch.zeros(robots, dtype=torch.long))
    found = second_look(model, start, list(declared.measurements()))
    if bool(found.is_empty.any()):
        return None
    intervals, (of_gain, of_distance) = unknown.intervals(found.psi), unknown.bounded_by_data(found.psi)
    gain, distance = intervals.gain[0].tolist(), intervals.distance[0].tolist()
    return Learned(tuple(gain), tuple(distance), tuple(of_gain[0].tolist()), tuple(of_distance[0].tolist()))
