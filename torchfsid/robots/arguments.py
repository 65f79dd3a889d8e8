"""Checks of the arguments of tasks, barriers and observers: a wrong type is refused where it is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchfsid.errors import InputError


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
