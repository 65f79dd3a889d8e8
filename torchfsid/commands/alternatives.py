"""Would another value of one key explain a log with a much smaller bound? If so, the declared value is the suspect.

The numbers of task and barriers are multiplied and divided by a few factors, words are replaced by the other ones, a
missing saturation is put at the largest control seen, and the prior is widened: one change at a time. The best number
is then refined. Only changes that leave far less to errors are worth a word, since a little better is always possible.
A change that helps is a suspicion. It is no proof, because errors of several keys look alike.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, field
from typing import Any

import torch

from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.config.documents import apply_overrides, validate
from torchfsid.config.observe import ObserveConfig
from torchfsid.errors import ConfigError
from torchfsid.observers.consistency import RESOLUTION, Consistency

FACTORS = (1.05, 1.1, 1.25, 1.6, 2.0, 4.0, 10.0)
"""Factors by which numbers are changed, up and down."""

REFINED = (1.12, 1.04, 1.01)
"""Smaller factors, by which the best number is then moved as long as that helps."""

WORDS = {
    "class_k.power": (1.0, 2.0, 3.0),
    "neighbour_velocity": ("none", "current", "previous"),
    "neighbour_acceleration": ("none", "current"),
}
"""Values of keys that are not changed by factors."""

WIDER = 4.0
"""Factor by which the prior is widened about its centre."""

CLEARLY_BETTER = 0.7
"""A change is worth a word if it needs less than this fraction of the bound."""

NEGLIGIBLE = 1e-4
"""Share of the typical control below which a bound leaves nothing to explain."""

MOST_BLOCKS = 64
"""Blocks of samples that are read while looking. The best change is then confirmed with all of them."""


@dataclass(frozen=True)
class Alternative:
    """Another value of one key, and the smallest bound on controls that then explains every robot.

    Attributes:
        key: the key, as `--set` takes it.
        value: the value, likewise.
        declared: the declared value.
        bound: the smallest bound then.
    """

    key: str
    value: str
    declared: str
    bound: float

    def sentence(self, unit: str) -> str:
        """The suspicion in words."""
        if self.key == "prior":
            return f"prior too small: one that is {WIDER:g} times as wide needs {self.bound:.3g} {unit} only"
        change = f"suspect {self.key}: {self.value} instead of {self.declared} needs {self.bound:.3g} {unit} only"
        if self.key.endswith(tuple(WORDS)) or self.declared == "none":
            return change
        low, high = float(self.value) / 2, float(self.value) * 2
        return f"{change} (torchfsid check --scan {self.key}={low:.3g}:{high:.3g} shows more)"


def with_change(config: ObserveConfig, key: str, value: str) -> ObserveConfig:
    """The same configuration with another value of a key.

    Raises:
        ConfigError: the key or the value does not fit.
    """
    mapping = config.model_dump(mode="json", exclude_none=True)
    return validate(apply_overrides(mapping, [f"{key}={value}"]), ObserveConfig, "the changed configuration")


def best_alternative(declared: DeclaredLog, smallest: float) -> Alternative | None:
    """The change of one key with which a log needs a much smaller bound. None if there is none.

    Models with unknown numbers have none: what their values may be is narrowed, or learned.

    Args:
        declared: the log and its model, whose bound on controls is a number.
        smallest: the smallest bound on controls that explains every robot with the declared model.
    """
    leaves_nothing = not declared.judged(smallest).share > NEGLIGIBLE
    if declared.config.is_unknown or declared.config.unknown_numbers or leaves_nothing:
        return None
    search = _Search(declared, CLEARLY_BETTER * smallest)
    least, best = search.limit, None
    for key, now, values in _changes(declared.config, search.whole.fastest):
        search.limit, better = least, None
        for value in values:
            better = value if search.improves(key, value) else better
        if isinstance(better, float) and not key.endswith(tuple(WORDS)):
            for factor in (change for step in REFINED for change in (1 / step, step)):
                while search.improves(key, better * factor):
                    better *= factor
        if better is not None and (best is None or search.limit < best[0]):
            best = search.limit, key, now, better
    if best is None:
        return None
    search.limit, (_, key, now, value) = least, best
    bound = search.bound(key, _text(value), search.whole)
    return None if math.isinf(bound) else Alternative(key, _text(value), "none" if now is None else _text(now), bound)


def _changes(config: ObserveConfig, fastest: float) -> Iterator[tuple[str, Any, list[Any]]]:
    """The keys that may be wrong, their values, and other ones."""
    sections = [("task", config.task), *((f"barriers.{i}", barrier) for i, barrier in enumerate(config.barriers))]
    for place, section in sections:
        for key in section.suspects:
            now = _at(section, key)
            if key in WORDS:
                yield f"{place}.{key}", now, [value for value in WORDS[key] if value != now]
            elif isinstance(now, float) and now > 0:
                yield f"{place}.{key}", now, [now * change for factor in FACTORS for change in (factor, 1 / factor)]
            elif key == "saturation":
                yield f"{place}.{key}", now, [f"{{kind: norm, limit: {fastest:.4g}}}"]
    corners = list(zip(config.prior.lower, config.prior.upper, strict=True))
    lower, upper = ([(a + b + sign * WIDER * (b - a)) / 2 for a, b in corners] for sign in (-1, 1))
    yield "prior", None, [f"{{lower: {lower}, upper: {upper}}}"]


def _at(section: Any, key: str) -> Any:
    for part in key.split("."):
        section = section[int(part)] if part.isdigit() else getattr(section, part)
    return section


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@dataclass
class _Search:
    """Changes of one log's model. A change has to explain the log with less than the limit."""

    declared: DeclaredLog
    limit: float
    whole: Consistency = field(init=False)
    part: Consistency = field(init=False)

    def __post_init__(self) -> None:
        self.whole = self.declared.consistency()
        self.limit = min(self.limit, self.whole.fastest)
        self.part = self.whole.thinned(MOST_BLOCKS)

    def improves(self, key: str, value: Any) -> bool:
        """Does a change need a smaller bound than those of its key before? It is then the limit."""
        found = self.bound(key, _text(value), self.part)
        if found < self.limit / RESOLUTION:
            self.limit = found
            return True
        return False

    def bound(self, key: str, value: str, consistency: Consistency) -> float:
        """The smallest bound with a change. It is infinite above the limit, or if the change does not fit."""
        try:
            changed = self.declared.with_model(with_change(self.declared.config, key, value))
        except ConfigError:
            return math.inf
        if changed.config.neighbour_velocities != self.declared.config.neighbour_velocities:
            consistency = changed.consistency()  # other samples count as known
        else:
            consistency = copy(consistency)
            consistency.task, consistency.barriers, consistency.prior = changed.task, changed.barriers, changed.prior
        if not bool(consistency.sets(torch.full((consistency.robots,), self.limit, dtype=torch.float64)).fits.all()):
            return math.inf
        return float(consistency.smallest_bounds(self.limit).max())
