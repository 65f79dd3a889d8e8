"""The quantities that configuration files are made of: what is a number, a name, a vector there."""

from __future__ import annotations

import reprlib
from typing import Annotated

from pydantic import BeforeValidator, Field

from torchfsid.config.documents import wrong


def as_number(value: object) -> object:
    """PyYAML takes 1e-6, a number without a dot, for text."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _name(value: object) -> object:
    """Bodies are named by text; a whole number stands for the text that writes it."""
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    if not isinstance(value, str) or not value:
        raise wrong(f"expected a name, got {reprlib.repr(value)} (put names in quotes)")
    return value


Number = Annotated[float, BeforeValidator(as_number), Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Flag = Annotated[bool, Field(strict=True)]
BodyName = Annotated[str, BeforeValidator(_name)]
Vector = Annotated[tuple[Number, ...], Field(min_length=1)]
PlanarVector = Annotated[tuple[Number, ...], Field(min_length=2, max_length=2)]
