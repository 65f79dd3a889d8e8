"""The measured motion of one body in space, and what the plane needs of it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from torchfsid.errors import LogError
from torchfsid.logs.tables import A_NUMBER, is_measurable

LEVEL = 0.1
"""Largest change of height of a body that moves in the plane [m]: uneven floors, jitter, a drone that hovers."""

LONG_AGO = 1_000_000_000_000_000
"""Stamps beyond this [ns], eleven days, are times since 1970. As seconds in a double they would lose nanoseconds, so
they are counted from the first."""


class Motion(NamedTuple):
    """Samples of one body.

    Attributes:
        stamps: times [ns], increasing.
        x: positions [m].
        u: velocities [m/s], or None.
        position_error: bounds on the errors of x in the plane [m].
        velocity_error: bounds on the errors of u in the plane [m/s].
    """

    stamps: Int[np.ndarray, "samples"]
    x: Float[np.ndarray, "samples 3"]
    u: Float[np.ndarray, "samples 3"] | None
    position_error: Float[np.ndarray, "samples"]
    velocity_error: Float[np.ndarray, "samples"]

    @classmethod
    def exact(
        cls,
        stamps: Int[np.ndarray, "samples"],
        x: Float[np.ndarray, "samples 3"],
        u: Float[np.ndarray, "samples 3"] | None = None,
    ) -> Motion:
        """A motion without errors."""
        return cls(stamps, x, u, np.zeros(len(stamps)), np.zeros(len(stamps)))

    def require_numbers(self, where: str) -> None:
        """Check that all is measurable in the plane.

        Raises:
            LogError: it is not so.
        """
        values = self.x[:, :2] if self.u is None else np.hstack([self.x[:, :2], self.u[:, :2]])
        measurable = is_measurable(values).all(axis=1)
        if not measurable.all():
            k = int(np.argmin(measurable))
            got = tuple(values[k].tolist())
            raise LogError(f"{where}: expected {A_NUMBER} everywhere, got {got} at t = {self.stamps[k] / 1e9} s")

    def require_level(self, where: str) -> None:
        """Check that the height stays the same.

        Raises:
            LogError: it does not, or is no number.
        """
        low, high = float(self.x[:, 2].min()), float(self.x[:, 2].max())
        if not high - low <= LEVEL:
            raise LogError(f"{where}: robots in the plane only, but the height changes from {low:g} to {high:g} m")


def start_of(stamps: Iterable[int]) -> int:
    """What to subtract from all stamps [ns]: the first, if it is a time since 1970, otherwise nothing."""
    first = min(stamps, default=0)
    return first if first > LONG_AGO else 0
