"""The types of values in configuration files: numbers, names and vectors."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Mapping, Sequence
from typing import Annotated

from pydantic import BeforeValidator, Discriminator, Field, Tag

from torchfsid.config.documents import wrong
from torchfsid.errors import ConfigError

DECIMAL = re.compile(r"\s*[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?\s*", re.ASCII)
"""How numbers are written."""


def as_number(value: object) -> object:
    """A number that PyYAML reads as text, such as 1e-6 without a dot. Other texts are returned as they are.

    Texts that only Python reads as numbers, such as 1_0, stay texts.
    """
    return float(value) if isinstance(value, str) and DECIMAL.fullmatch(value) else value


def _name(value: object) -> object:
    """The name of a body. A whole number becomes the text that writes it."""
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    if not isinstance(value, str) or not value:
        raise wrong(f"expected a name, got {reprlib.repr(value)} (put names in quotes)")
    if "\0" in value:
        raise wrong(f"expected a name without a NUL, got {reprlib.repr(value)}")
    return value


Number = Annotated[float, BeforeValidator(as_number), Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Flag = Annotated[bool, Field(strict=True)]
BodyName = Annotated[str, BeforeValidator(_name)]
Vector = Annotated[tuple[Number, ...], Field(min_length=1)]
PlanarVector = Annotated[tuple[Number, ...], Field(min_length=2, max_length=2)]
Place = Annotated[tuple[Number, ...], Field(min_length=2, max_length=3)]
"""A vector in the plane or in space."""

Lengths = Annotated[tuple[Positive, ...], Field(min_length=2, max_length=3)]
"""One positive length for each axis."""


def _one_or_two(value: object) -> str:
    return "<interval>" if isinstance(value, list | tuple) else "<number>"


PositiveInterval = Annotated[tuple[Positive, ...], Field(min_length=2, max_length=2)]
Unknown = Discriminator(_one_or_two)
PositiveOrInterval = Annotated[
    Annotated[Positive, Tag("<number>")] | Annotated[PositiveInterval, Tag("<interval>")], Unknown
]
"""A number, or bounds [low, high] on a number that is not known."""

NonNegativeOrInterval = Annotated[
    Annotated[NonNegative, Tag("<number>")] | Annotated[PlanarVector, Tag("<interval>")], Unknown
]
"""A number >= 0, or bounds [low, high] on one that is not known."""


Path = tuple[str | int, ...]
"""Where a value stands in a section: keys, and places in lists."""

Units = Mapping[Path, str]
"""The units of the numbers of a section that may be unknown, and are then narrowed from a log."""


def require_body(path: str, name: str, bodies: Sequence[str]) -> None:
    """Check that a body named in the file is in the log.

    Args:
        path: path of the key that names it.
        name: the name.
        bodies: the bodies of the log.

    Raises:
        ConfigError: there is no such body.
    """
    if name not in bodies:
        raise ConfigError(f"{path}: no body is called {name!r}; there are {reprlib.repr(list(bodies))}")


def as_interval(value: float | tuple[float, ...]) -> tuple[float, float]:
    """The interval [low, high], or that of a known number."""
    return (value[0], value[1]) if isinstance(value, tuple) else (value, value)


def as_middle(value: float | tuple[float, ...]) -> tuple[float, float]:
    """The middle of an interval and half its width; zero for a known number."""
    low, high = as_interval(value)
    return (low + high) / 2, (high - low) / 2


def known(value: float | tuple[float, ...] | None) -> float | None:
    """A number that must be known by now."""
    assert not isinstance(value, tuple)
    return value


FARTHEST_APART = 1e12
"""Ratio of the ends of an interval beyond which sets over it would lose their digits."""


def require_interval(name: str, value: float | tuple[float, ...] | None) -> None:
    """Check, in a validator, that an interval has low <= high, and ends that are not too far apart."""
    if not isinstance(value, tuple):
        return
    if not value[0] <= value[1]:
        raise wrong(f"expected [low, high] with low <= high, got {list(value)}", name)
    if value[1] > FARTHEST_APART * value[0] > 0:
        raise wrong(f"expected ends at most a factor {FARTHEST_APART:g} apart, got {list(value)}", name)


def require_box(lower: Sequence[float], upper: Sequence[float]) -> None:
    """Check, in a validator, that lower < upper in every entry."""
    if len(lower) != len(upper):
        raise wrong(f"lower has {len(lower)} entries, upper has {len(upper)}")
    for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
        if not low < high:
            raise wrong(f"lower[{i}] must be less than upper[{i}], got {low} and {high}")
