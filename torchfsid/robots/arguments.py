"""Checks of the arguments of tasks, barriers and observers: a wrong type is refused where it is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchfsid.errors import InputError

if TYPE_CHECKING:
    from torchfsid.robots.measurement import Measurement


def require_numbers(name: str, expected: str, value: Any, fits: Callable[[Tensor], Tensor | bool]) -> None:
    """Check a number, or a tensor of numbers, all of which have to fit.

    Raises:
        InputError: the value is no number, or does not fit.
    """
    try:
        is_right = bool(torch.as_tensor(fits(torch.as_tensor(value))).all())
    except (TypeError, ValueError, RuntimeError):  # as_tensor raises any of them
        is_right = False
    if not is_right:
        raise InputError(name, expected, repr(value))


def for_samples(name: str, value: float | Tensor, batch: torch.Size) -> float | Tensor:
    """A number for each of B robots, repeated for each of several of their samples, concatenated.

    Raises:
        InputError: the batch is not one of samples of B robots.
    """
    if not isinstance(value, Tensor) or value.ndim != 1 or len(batch) != 1:
        return value
    if len(value) == 0 or batch[0] % len(value) != 0:
        raise InputError(name, f"one number, or one for each of {batch[0]} robots", tuple(value.shape))
    return value.repeat(batch[0] // len(value))


def require_each(name: str, value: float | Tensor, measurement: Measurement) -> None:
    """Check that numbers for robots (B, ...) are those of all robots of one sample. Two samples of half of them are
    only known by their times.

    Raises:
        InputError: the sample is one of another number of robots.
    """
    robots = len(measurement.x)
    is_one = measurement.x.ndim == 2 and not isinstance(measurement.t, Tensor)
    if is_one and isinstance(value, Tensor) and value.ndim > 0 and len(value) not in (1, robots):
        raise InputError(name, f"one number, or one for each of {robots} robots", tuple(value.shape))


def require_names(name: str, names: Any) -> tuple[str, ...]:
    """The names as a tuple.

    Raises:
        InputError: they are a single text, whose letters would be taken for names, or no texts at all.
    """
    if isinstance(names, str) or not all(isinstance(entry, str) for entry in names):
        raise InputError(name, "a tuple of names, e.g. ('ellipse',)", repr(names))
    return tuple(names)


def require_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Check a word.

    Raises:
        InputError: it is none of the choices.
    """
    if value not in choices:
        raise InputError(name, f"one of {', '.join(map(repr, choices))}", repr(value))


def require_task(task: Any) -> None:
    """Check a task as far as its type.

    Raises:
        InputError: it is no task.
    """
    if not (callable(task) and hasattr(task, "parameter_names")):
        raise InputError("task", "a task, e.g. GoalTask(gain=1.0)", repr(task))


def require_barriers(barriers: Any) -> None:
    """Check a list of barriers as far as its type. Barriers with unknown parameters cannot be called.

    Raises:
        InputError: it is no list, or an entry is no barrier.
    """
    if not isinstance(barriers, Sequence) or isinstance(barriers, str):
        raise InputError("barriers", "a list of barriers, e.g. [SpeedDisc(1.0)]", repr(barriers))
    for i, barrier in enumerate(barriers):
        if not hasattr(barrier, "soft"):
            raise InputError(f"barriers[{i}]", "a barrier, e.g. SpeedDisc(1.0)", repr(barrier))
