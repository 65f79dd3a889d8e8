"""Numbers of a model that are not known, `[low, high]`, and are narrowed from a log before it is observed.

Each section says which of its numbers may be unknown (`narrowed`). An unknown gain or distance of an avoidance barrier
of order 1 is none of them: it is learned together with theta (`robots.unknown_avoidance`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

from torchfsid.config.barriers import BarrierConfig
from torchfsid.config.documents import Strict
from torchfsid.config.given import GivenBarrier, GivenTask
from torchfsid.config.quantities import Path, as_interval
from torchfsid.config.tasks import TaskConfig

Section = TypeVar("Section", bound=Strict)


class UnknownNumber(NamedTuple):
    """A number of the model that is not known.

    Attributes:
        path: where it stands in the file.
        interval: the values [low, high] that it may have.
        unit: its unit.
    """

    path: Path
    interval: tuple[float, float]
    unit: str

    @property
    def name(self) -> str:
        """The path as text, such as `barriers[0].margin`."""
        return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in self.path)[1:]


def unknown_numbers(
    task: TaskConfig | GivenTask, barriers: Sequence[BarrierConfig | GivenBarrier]
) -> list[UnknownNumber]:
    """The numbers of a task and of barriers that are given as [low, high] and can be narrowed."""
    sections = [(("task",), task), *((("barriers", i), barrier) for i, barrier in enumerate(barriers))]
    return [
        UnknownNumber((*place, *path), as_interval(value), unit)
        for place, section in sections
        for path, unit in section.narrowed.items()
        if isinstance(value := _at(section, path), tuple)
    ]


def _at(section: Any, path: Path) -> Any:
    for key in path:
        section = section[key] if isinstance(key, int) else getattr(section, key)
    return section


def replaced(section: Section, path: Path, value: Any) -> Section:
    """The same section with another value at a path. The value is not checked."""

    def rest(of: Any, path: Path) -> Any:
        if not path:
            return value
        key, *deeper = path
        if isinstance(key, int):
            return (*of[:key], rest(of[key], tuple(deeper)), *of[key + 1 :])
        return of.model_copy(update={key: rest(getattr(of, key), tuple(deeper))})

    return rest(section, path)
