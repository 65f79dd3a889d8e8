"""The measured motion of one body in space, and what robots in the plane need of it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from torchfsid.errors import LogError
from torchfsid.logs.tables import A_NUMBER, is_measurable

LEVEL = 0.1
"""Largest change of height of a body that moves in the plane [m]: uneven floors, jitter, a drone that hovers."""

TILTED = 0.5
"""Sine of the angle between the plane and a body's x-axis beyond which its direction in the plane says nothing."""

UNIT = 1e-2
"""How far a quaternion's norm may be from 1; all zeros, the usual mistake, is no orientation."""

LONG_AGO = 1_000_000_000_000_000
"""Stamps beyond this [ns], eleven days, are times since 1970. As seconds in a double they would lose nanoseconds, so
they are counted from the first."""


class HeightError(LogError):
    """A body in the plane changes its height: it may be in space."""


class Motion(NamedTuple):
    """Samples of one body.

    Attributes:
        stamps: times [ns], increasing.
        x: positions [m].
        u: velocities [m/s], or None.
        position_error: bounds on the errors of x [m]. They count in the plane only, for robots in the plane.
        velocity_error: bounds on the errors of u [m/s]. Likewise.
        heading: directions of the body's x-axis in the plane [rad], NaN where unknown, or None.
    """

    stamps: Int[np.ndarray, "samples"]
    x: Float[np.ndarray, "samples 3"]
    u: Float[np.ndarray, "samples 3"] | None
    position_error: Float[np.ndarray, "samples"]
    velocity_error: Float[np.ndarray, "samples"]
    heading: Float[np.ndarray, "samples"] | None = None

    @classmethod
    def exact(
        cls,
        stamps: Int[np.ndarray, "samples"],
        x: Float[np.ndarray, "samples 3"],
        u: Float[np.ndarray, "samples 3"] | None = None,
    ) -> Motion:
        """A motion without errors."""
        return cls(stamps, x, u, np.zeros(len(stamps)), np.zeros(len(stamps)))

    def require_numbers(self, where: str, n: int) -> None:
        """Check that all is measurable in the plane (n = 2) or in space (n = 3).

        Raises:
            LogError: it is not so.
        """
        values = self.x[:, :n] if self.u is None else np.hstack([self.x[:, :n], self.u[:, :n]])
        measurable = is_measurable(values).all(axis=1)
        if not measurable.all():
            k = int(np.argmin(measurable))
            got = tuple(values[k].tolist())
            raise LogError(f"{where}: expected {A_NUMBER} everywhere, got {got} at t = {self.stamps[k] / 1e9} s")

    def require_level(self, where: str) -> None:
        """Check that the height stays the same.

        Raises:
            HeightError: it does not, or is no number.
        """
        low, high = float(self.x[:, 2].min()), float(self.x[:, 2].max())
        if not high - low <= LEVEL:
            told = "robots in the plane (a prior of two entries)"
            raise HeightError(f"{where}: {told}, but the height changes from {low:g} to {high:g} m")


def rotation_of(x: float, y: float, z: float, w: float) -> Float[np.ndarray, "3 3"] | None:
    """The matrix that turns vectors by a quaternion whose norm may differ slightly from 1. None if it is no unit.

    R = I + (2 w K + 2 K^2) / norm^2, with K the matrix of the cross product with (x, y, z).
    """
    norm = math.hypot(w, x, y, z)
    if not abs(norm - 1) <= UNIT:
        return None
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2 / norm**2 * (w * cross + cross @ cross)


def heading_of(ahead: Float[np.ndarray, "3"]) -> float:
    """The direction in the plane of a body's x-axis (x, y, height) [rad]. NaN if it is steep."""
    return math.atan2(ahead[1], ahead[0]) if abs(ahead[2]) <= TILTED else math.nan


def start_of(stamps: Iterable[int]) -> int:
    """What to subtract from all stamps [ns]: the first, if it is a time since 1970, otherwise nothing."""
    first = min(stamps, default=0)
    return first if first > LONG_AGO else 0
