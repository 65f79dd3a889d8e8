"""Robots in the plane or in space: how many entries the prior has says which, and all other sections have to agree."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torchfsid.config.documents import wrong

WORDS = {2: "in the plane", 3: "in space"}


def dimensions_of(task: Any, prior: Any) -> tuple[int, ...]:
    """The dimensions that the robots' positions may have, in a validator: 2 or 3. Only an own task leaves both open."""
    entries = len(prior.lower)
    found = tuple(n for n in task.dimensions if task.parameters(n) == entries)
    if not found:
        expected = " and ".join(f"{task.parameters(n)} {WORDS[n]}" for n in task.dimensions)
        expected = expected.replace(" ", " parameters ", 1)
        raise wrong(f"task {task.kind!r} has {expected}, lower and upper have {entries}", "prior")
    return found


def require_one_dimension(dimensions: Sequence[int], barriers: Sequence[Any]) -> None:
    """Check, in a validator, that the barriers are those of robots of one of these dimensions."""
    for i, barrier in enumerate(barriers):
        if barrier.dimension not in (None, *dimensions):
            got = f"{barrier.kind!r} is {WORDS[barrier.dimension]}"
            raise wrong(f"the prior says that robots are {WORDS[dimensions[0]]}, and {got}", f"barriers[{i}]")
        if barrier.kind == "arena" and any(getattr(other, "sidestep", 0.0) > 0 for other in barriers):
            raise wrong("a sidestep at a wall of an arena is not modelled: expected sidestep: 0", f"barriers[{i}]")
