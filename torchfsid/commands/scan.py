"""`torchfsid check --scan KEY=LOW:HIGH[:N]`: the smallest bound that explains each robot, over the values of one key.

The wrong value of a key needs a large bound, because errors have to explain what it cannot. So the right one is at or
near the value that needs least: the best for all robots has the smallest largest bound. It is refined between its
neighbours. A valley that is flat says that the log does not tell these values apart.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchfsid.commands.alternatives import with_change
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.results_folder import write_json, write_whole
from torchfsid.config.observe import ObserveConfig
from torchfsid.errors import ConfigError
from torchfsid.logs.log import Log

VALUES = 16
"""Values that are tried if none are said."""

MOST_VALUES = 1000
"""Most values."""

WIDE = 10.0
"""Ratio of HIGH to LOW from which on values are spaced by equal ratios instead of equal differences."""

REFINED, ROUNDS = 6, 2
"""Values between the neighbours of the best one, and how often they are refined."""

Track = Callable[[list[float]], Iterable[float]]


@dataclass(frozen=True)
class Range:
    """The values of a key.

    Attributes:
        key: the key, as `--set` takes it.
        low: the least value.
        high: the largest value.
        count: how many values are tried.
    """

    key: str
    low: float
    high: float
    count: int = VALUES

    @classmethod
    def parse(cls, text: str) -> Range:
        """The range in a text such as "task.gain=0.05:0.2:16".

        Raises:
            ConfigError: it is not of this form, or of a bound, which is what is found.
        """
        key, _, values = text.partition("=")
        parts = values.split(":")
        try:
            low, high, count = float(parts[0]), float(parts[1]), int(parts[2]) if len(parts) > 2 else VALUES
        except (ValueError, IndexError):
            low, high, count = 0.0, 0.0, 0
        if not key or len(parts) > 3 or not 2 <= count <= MOST_VALUES or not -math.inf < low < high < math.inf:
            raise ConfigError(
                f"--scan {text!r}: expected KEY=LOW:HIGH or KEY=LOW:HIGH:N with LOW < HIGH and 2 to {MOST_VALUES} "
                "values, such as task.gain=0.05:0.2"
            )
        if key in ("noise.velocity", "noise.acceleration"):
            raise ConfigError(f"--scan {key}: expected a key of the model, this bound is what is found")
        return cls(key, low, high, count)

    def between(self, low: float, high: float, count: int) -> list[float]:
        """This many values from low to high, of 9 digits at most."""
        shares = [i / (count - 1) for i in range(count)]
        if self.low > 0 and self.high >= WIDE * self.low:
            found = [low * (high / low) ** share for share in shares]
        else:
            found = [low + (high - low) * share for share in shares]
        return [float(f"{value:.9g}") for value in found]


@dataclass(frozen=True)
class Scan:
    """The smallest bounds over the values of a key.

    Attributes:
        key: the key.
        declared: its value in the configuration. None if it has none, or no number.
        robots: names of the robots.
        unit: unit of the bounds.
        quantity: what they bound, `velocity` or `acceleration`.
        bounds: by value, in rising order, the smallest bound of each robot. It is infinite where none explains it.
    """

    key: str
    declared: float | None
    robots: tuple[str, ...]
    unit: str
    quantity: str
    bounds: dict[float, tuple[float, ...]]

    @property
    def best(self) -> float:
        """The value with the smallest bound for all robots. The middle one, if many have that up to round-off."""
        return best_of(self.bounds)

    def largest(self, value: float) -> float:
        """The bound that explains all robots with this value."""
        return max(self.bounds[value])

    def best_of(self, robot: int) -> float:
        """The value with the smallest bound for one robot."""
        return best_of({value: (of_value[robot],) for value, of_value in self.bounds.items()})

    def conclusions(self) -> list[str]:
        """What was found, as sentences."""
        if math.isinf(self.largest(self.best)):
            return [f"no value of {self.key} explains all robots, with any bound: something else is wrong"]
        bound = self.largest(self.best)
        close = [value for value in self.bounds if self.largest(value) <= CLOSE * bound]
        lines = [f"best: {self.key}={self.best:.4g} needs {bound:.3g} {self.unit}"]
        if self.declared is not None and (now := self.bounds.get(self.declared)) is not None:
            lines[0] += f"; the declared {self.declared:g} needs {max(now):.3g} {self.unit}"
        if len(close) > 1:
            lines.append(
                f"values from {close[0]:.4g} to {close[-1]:.4g} need at most {CLOSE - 1:.0%} more: the log hardly "
                "tells them apart"
            )
        if self.best in (min(self.bounds), max(self.bounds)):
            lines.append("the best value is at an end of the range: scan further")
        lines.append("the smallest bound is no proof: another key may be wrong instead")
        return lines

    def to_json(self) -> dict[str, Any]:
        """The content of scan.json. Infinite bounds are null."""
        return {
            "key": self.key,
            "declared": self.declared,
            "quantity": self.quantity,
            "unit": self.unit,
            "best": {"value": self.best, "bound": self.largest(self.best)},
            "best_of_robots": {robot: self.best_of(i) for i, robot in enumerate(self.robots)},
            "values": list(self.bounds),
            "bounds": {robot: [of[i] for of in self.bounds.values()] for i, robot in enumerate(self.robots)},
            "conclusions": self.conclusions(),
        }

    def write(self, out: Path) -> None:
        """Write scan.csv and scan.json. A bound that does not exist is an empty cell."""
        text = io.StringIO(newline="")
        rows = csv.writer(text)
        rows.writerow(["value", "robot", f"{self.quantity}_bound"])
        for value, bounds in self.bounds.items():
            for robot, bound in zip(self.robots, bounds, strict=True):
                rows.writerow([f"{value:.9g}", robot, "" if math.isinf(bound) else f"{bound:.6g}"])
        write_whole(out / "scan.csv", text.getvalue())
        write_json(out / "scan.json", self.to_json())


CLOSE = 1.1
"""Values that need at most this factor more than the best are hardly told apart."""


def best_of(bounds: dict[float, tuple[float, ...]]) -> float:
    """The value with the smallest largest bound, or the middle one of those."""
    least = min(max(of_value) for of_value in bounds.values())
    best = [value for value, of_value in bounds.items() if max(of_value) <= least * RESOLUTION]
    return best[len(best) // 2]


RESOLUTION = 1.02
"""Bounds that differ by less than this factor are the same, see `Consistency.smallest_bounds`."""


def scan(log: Log, config: ObserveConfig, values: Range, track: Track = iter) -> Scan:
    """The smallest bounds over a range of values, the best one refined, and that of the declared value.

    Args:
        log: the log, as it was read.
        config: the declared model.
        values: the range.
        track: shows the progress.

    Raises:
        ConfigError: a value does not fit the key, or the log does not have what the model then needs.
    """
    declared = _declared(config, values.key)
    bounds: dict[float, tuple[float, ...]] = {}
    robots: Sequence[str] = ()

    def find(wanted: Iterable[float]) -> None:
        nonlocal robots
        for value in wanted:
            model = DeclaredLog(with_change(config, values.key, f"{value:.9g}"), log)
            robots = model.robots
            bounds[value] = tuple(model.smallest_bounds().values())

    first = values.between(values.low, values.high, values.count)
    find(track([*first, *([declared] if declared is not None and declared not in first else [])]))
    for _ in range(ROUNDS):
        ordered, best = sorted(bounds), best_of(dict(sorted(bounds.items())))
        k = ordered.index(best)
        around = values.between(ordered[max(k - 1, 0)], ordered[min(k + 1, len(ordered) - 1)], REFINED + 2)
        try:
            find([value for value in around if value not in bounds])
        except ConfigError:  # whole numbers only
            break
    noise = config.noise
    return Scan(values.key, declared, tuple(robots), noise.unit, noise.quantity, dict(sorted(bounds.items())))


def _declared(config: ObserveConfig, key: str) -> float | None:
    node: Any = config.model_dump(mode="json")
    for part in key.split("."):
        try:
            node = node[int(part)] if isinstance(node, list) else node[part]
        except (KeyError, IndexError, TypeError, ValueError):
            return None
    return float(node) if isinstance(node, int | float) and not isinstance(node, bool) else None
