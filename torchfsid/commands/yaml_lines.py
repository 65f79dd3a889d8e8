"""Lines of a YAML file with comments: values as the configuration reads them, and rounded numbers."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any

COLUMN = 48
"""Where comments begin."""

NO_WORDS = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}
"""What YAML reads as something else."""


def line(text: str, comment: str) -> str:
    """A line with its comment."""
    return f"{text:<{COLUMN}}# {comment}" if len(text) < COLUMN else f"{text}    # {comment}"


def section(content: Mapping[str, Any], explained: Mapping[str, str]) -> list[str]:
    """The keys of a section, each with what it means. Mappings have a line for each entry."""
    lines = []
    for key, value in content.items():
        if isinstance(value, Mapping):
            lines.append(line(f"  {key}:", explained[key]))
            lines += [f"    {word(name)}: {flow(entry)}" for name, entry in value.items()]
        else:
            lines.append(line(f"  {key}: {flow(value)}", explained[key]))
    return lines


def flow(value: Any) -> str:
    """A value in one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {flow(entry)}" for key, entry in value.items()) + "}"
    return word(value) if isinstance(value, str) else str(value)


def word(text: str) -> str:
    """A text as YAML, in quotes unless it is a plain word."""
    plain = text.isascii() and text.replace("_", "").isalnum() and text[0].isalpha()
    return text if plain and text.lower() not in NO_WORDS else _quoted(text)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=not text.isprintable())


def numbers(values: Iterable[float]) -> str:
    """A list of numbers of at most four digits."""
    return f"[{', '.join(short(float(value)) for value in values)}]"


def coordinates(values: Iterable[float], size: float) -> list[str]:
    """Coordinates to a thousandth of the size of what they are about, however far they are from the origin."""
    digits = 3 - math.floor(math.log10(size))
    return [f"{round(float(value), digits):.15g}" for value in values]


def short(value: float) -> str:
    """A number of at most four digits, as YAML 1.1 reads it."""
    text = f"{value:.4g}"
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def rounded_down(value: float) -> float:
    """A positive number, rounded down to two digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1) if value > 0 else 1.0
    return math.floor(value / step * (1 + 1e-6)) * step


def rounded_up(value: float) -> float:
    """A positive number, rounded up to two digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1) if value > 0 else 1.0
    return math.ceil(value / step * (1 - 1e-6)) * step
