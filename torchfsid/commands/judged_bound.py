"""Is a bound on the error of controls of any use? It is judged by the controls that are seen in the log.

    share = bound / typical control

The typical control is the median over the way, not over time: half of the way is driven faster. So robots that stand at
their goals, or come to rest there, do not count, and neither does a single sample that is far too large.

A sample of a free robot says that its goal, |u|/k away, lies in a ball of radius bound/k. So the share is the error of
the goal relative to its distance. A wrong model needs a large share, and then explains the log like a right one. No
status can say so, since the set is not empty.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

USELESS = 1 / 3
"""Share above which a bound is useless: even the direction to the goal, asin(share), is then unknown by 20 degrees.
With the factor of `auto`, right models of simulators' logs need up to 0.23. Wrong kinds of controllers or tasks, wrong
or missing rows, and shifted columns need 0.3 to 5 (docs/wrong_models.md)."""

SUSPECTS = "a wrong kind of controller, barrier or task, a wrong gain or distance, or shifted columns"
"""What a bound that has to be so large suggests."""


@dataclass(frozen=True)
class JudgedBound:
    """A bound on the error of controls, beside the controls of the inferred robots.

    Attributes:
        bound: the bound [unit].
        typical: the typical control [unit].
        largest: the largest control [unit].
        unit: the unit of controls.
        differences: a further bound, on accelerations that are differences of velocities with errors [unit].
    """

    bound: float
    typical: float
    largest: float
    unit: str
    differences: float = 0.0

    @classmethod
    def of(
        cls, bound: float, sizes: Float[np.ndarray, "samples"], unit: str = "m/s", differences: float = 0.0
    ) -> JudgedBound:
        """Judge a bound by the sizes of the controls that are seen."""
        if not sizes.any():
            return cls(bound, 0.0, 0.0, unit, differences)
        ordered = np.sort(sizes)
        way = np.cumsum(ordered / ordered[-1])
        typical = float(ordered[np.searchsorted(way, way[-1] / 2)])
        return cls(bound, typical, float(ordered[-1]), unit, differences)

    @property
    def share(self) -> float:
        """The bound as a share of the typical control. NaN if nothing moves."""
        return (self.bound + self.differences) / self.typical if self.typical else math.nan

    @property
    def is_useless(self) -> bool:
        """Is the bound so large that a wrong model explains the log, too?"""
        return self.share > USELESS

    def compared(self) -> str:
        """The share in words, to stand behind the bound."""
        if math.isnan(self.share):
            return "no motion was seen"
        return f"{self._percent} of the typical control seen, {self.typical:.3g} {self.unit}"

    def doubt(self) -> str:
        """What a useless bound means, as a sentence."""
        total = self.bound + self.differences
        return (
            f"the bound {total:.3g} {self.unit} is useless: it is {self.compared()} (the largest: "
            f"{self.largest:.3g}), so that a wrong model explains the log as well as the right one"
        )

    def warning(self, is_needed: bool, is_explained: bool = False) -> str:
        """What is to be said of a useless bound.

        Args:
            is_needed: a much smaller bound would not explain the log.
            is_explained: something else says what to suspect.
        """
        advice = (
            f"if the errors are not that large, suspect {SUSPECTS}" if is_needed else "declare a smaller one, or auto"
        )
        if self.differences > self.bound:
            advice = "most of it comes from differences of velocities: log accelerations, or more exact velocities"
        end = "" if is_explained else f"; {advice}"
        return self.doubt() + end

    def cell(self, status: str, is_found: bool) -> str:
        """A status for a table. `ok` is never said alone if the bound is useless or was found in the same log."""
        if status != "ok" or not (self.is_useless or is_found):
            return status
        return "ok (bound useless)" if self.is_useless else f"ok (bound {self._percent})"

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> JudgedBound:
        """The bound of `to_json`, with the bound itself as `used`, as in regions.json."""
        typical, used = entry["typical"], entry["used"]
        further = entry["share"] * typical - used if typical else 0.0
        return cls(used, typical, entry["largest"], entry["unit"], max(0.0, further))

    def to_json(self) -> dict:
        """The entry of results files. NaN stands for no motion."""
        return {
            "share": self.share,
            "useless": self.is_useless,
            "typical": self.typical,
            "largest": self.largest,
            "unit": self.unit,
        }

    @property
    def _percent(self) -> str:
        if math.isnan(self.share):
            return "without motion"
        if self.share < 1e-3:
            return "less than 0.1 %"
        return f"{100 * self.share:.2g} %" if self.share < 0.1 else f"{100 * self.share:.0f} %"
