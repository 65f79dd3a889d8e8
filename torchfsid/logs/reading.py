"""What was found while a log was read, beside its numbers. Commands print it, and regions.json records it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from jaxtyping import Float

NEGLIGIBLE = 1e-10
"""Unit of the last decimal from which on rounding is not counted [m], [m/s], [m/s2]: numbers of 12 digits are exact."""

BATCH = 10_000
"""Texts that are looked at together."""

ALL_DIGITS = 17
"""Significant digits of which every double can be read back."""

UNITS = {"position": "m", "velocity": "m/s", "acceleration": "m/s2"}
ROUNDED = {**UNITS, "heading": "rad"}


@dataclass(frozen=True)
class Reading:
    """What was found while a log was read.

    Attributes:
        rounding: for each quantity of `ROUNDED` that was rounded when the log was written, the bound on the length of
            the error, which the log's bounds contain. That of headings is used where commands are recovered.
        duplicates: the number of samples that were left out because they repeat another one exactly.
        time_origin: what was subtracted from all times [s]. None: nothing.
    """

    rounding: Mapping[str, float] = field(default_factory=dict)
    duplicates: int = 0
    time_origin: float | None = None

    def to_json(self) -> dict[str, object]:
        """The content of regions.json under `log`. Empty if there is nothing to say."""
        found: dict[str, object] = {"rounding": dict(self.rounding)} if self.rounding else {}
        found |= {"duplicates": self.duplicates} if self.duplicates else {}
        return found | ({} if self.time_origin is None else {"time_origin": self.time_origin})

    def sentences(self) -> Iterator[str]:
        """The same in words."""
        if self.rounding:
            sizes = ", ".join(f"{name} {size:.2g} {ROUNDED[name]}" for name, size in self.rounding.items())
            yield f"The log's decimals are rounded; this much is added to the bounds: {sizes}"
        if self.duplicates:
            yield f"{self.duplicates} samples repeat another one exactly, and are left out"
        if self.time_origin is not None:
            yield f"Times are counted from the first sample, {self.time_origin:.9f} s"


def half_units(
    texts: Iterable[str], values: Float[np.ndarray, "*shape"], power: int = 0
) -> Float[np.ndarray, "*shape"]:
    """How far numbers can be from those that were rounded when they were written: half a unit of the last digit.

    The columns of one quantity are written alike: with a fixed number of decimals D, or with a fixed number of
    significant digits S, of which trailing zeros may be missing. With D and S the largest that occur, and 10^e the
    place of a number's first digit, max(10^-D, 10^(e + 1 - S)) is no smaller than the unit in both cases. Whole
    numbers, and numbers with all digits of a double, count as exact.

    Args:
        texts: the cells of all columns of one quantity.
        values: their numbers, or some of them, in SI units.
        power: the power of ten by which the texts have to be multiplied for SI units. Whole are numbers in these.
    """
    decimals, digits = 0, 0
    for text in _distinct(texts):
        mantissa, _, exponent = text.strip().lower().partition("e")
        whole, _, fraction = mantissa.lstrip("+-").partition(".")
        digits = max(digits, len((whole + fraction).lstrip("0")))
        if digits >= ALL_DIGITS:
            return np.zeros(values.shape)
        decimals = max(decimals, len(fraction) - int(exponent or 0) - power)
    if decimals <= 0:
        return np.zeros(values.shape)
    first = np.floor(np.log10(np.maximum(np.abs(values), 10.0**-decimals)))
    units = np.maximum(10.0**-decimals, 10.0 ** (first + 1 - digits))
    return np.where(units > NEGLIGIBLE, units / 2, 0.0)


def _distinct(texts: Iterable[str]) -> Iterator[str]:
    """The texts without repetitions, a batch at a time: often the first ones tell enough."""
    rest, seen = iter(texts), set[str]()
    while batch := set(islice(rest, BATCH)):
        yield from batch - seen
        seen |= batch
