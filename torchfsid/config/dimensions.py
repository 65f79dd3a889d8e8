"""Robots in the plane or in space: how many entries the prior has says which, and all other sections have to agree."""

from __future__ import annotations

from collections.abc import Sequence

from torchfsid.config.barriers import BarrierConfig
from torchfsid.config.documents import wrong
from torchfsid.config.observers import PriorConfig
from torchfsid.config.tasks import TaskConfig

WORDS = {2: "in the plane", 3: "in space"}


def dimension_of(task: TaskConfig, prior: PriorConfig) -> int:
    """The dimension of the robots' positions, in a validator: 2 or 3."""
    entries = len(prior.lower)
    possible = {task.parameters(n): n for n in task.dimensions}
    if entries not in possible:
        expected = " and ".join(f"{p} {WORDS[n]}" for p, n in possible.items()).replace(" ", " parameters ", 1)
        raise wrong(f"task {task.kind!r} has {expected}, lower and upper have {entries}", "prior")
    return possible[entries]


def require_one_dimension(dimension: int, barriers: Sequence[BarrierConfig]) -> None:
    """Check, in a validator, that the barriers are those of robots of this dimension."""
    for i, barrier in enumerate(barriers):
        if barrier.dimension not in (None, dimension):
            got = f"{barrier.kind!r} is {WORDS[barrier.dimension or dimension]}"
            raise wrong(f"the prior says that robots are {WORDS[dimension]}, and {got}", f"barriers[{i}]")
        if barrier.kind == "arena" and any(getattr(other, "sidestep", 0.0) > 0 for other in barriers):
            raise wrong("a sidestep at a wall of an arena is not modelled: expected sidestep: 0", f"barriers[{i}]")
