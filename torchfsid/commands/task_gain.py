"""An unknown gain of the task, `task: {kind: goal, gain: [low, high]}`: which gains can explain a log?

The interval is bisected. A part of it is dropped if no robot's goal explains the motion with any gain in that part, and
halved otherwise, until the parts at both ends are narrow. The robots share the gain. A robot that no part explains does
not take part.

In a part [low, high] the task has the gain in the middle, with an error of half the width (`GoalTask.gain_error`). So
nothing is lost. Where motions carry no information (jams), little or nothing is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.config.tasks import GoalConfig

RESOLUTION = 1.005
"""The parts at both ends are not halved below this ratio of their ends."""


@dataclass(frozen=True)
class TaskGain:
    """The gains that can explain the log.

    Attributes:
        unit: their unit.
        declared: the declared interval.
        found: the interval that is left; the declared one if nothing explains the log.
        explains: whether any gain does.
    """

    unit: str
    declared: tuple[float, float]
    found: tuple[float, float]
    explains: bool

    @property
    def by_data(self) -> tuple[bool, bool]:
        """Whether the ends come from the data. Otherwise they are those that were declared."""
        return self.found[0] > self.declared[0], self.found[1] < self.declared[1]

    def to_json(self) -> dict:
        """The content of task_gain.json."""
        return {**vars(self), "bounded_by_data": self.by_data}


def narrowed(declared: DeclaredLog) -> tuple[DeclaredLog, TaskGain]:
    """The same log with a narrower interval for the task's gain, and what was found.

    Args:
        declared: a log whose task has an unknown gain, with the bound on controls as a number.
    """
    task, bound = declared.config.task, declared.config.noise.control
    assert isinstance(task, GoalConfig)
    assert isinstance(task.gain, tuple)
    assert bound != "auto"
    consistency, known = declared.consistency(), {}
    bounds = torch.full((consistency.robots,), bound, dtype=torch.float64)

    def fits(low: float, high: float) -> torch.Tensor:
        if (low, high) not in known:
            part = task.model_copy(update={"gain": (low, high)})
            consistency.task = part.build(declared.log.bodies)
            known[low, high] = consistency.sets(bounds, taking_part).fits
        return known[low, high]

    low, high = declared_gain = task.gain[0], task.gain[1]
    taking_part = torch.ones(consistency.robots, dtype=torch.bool)
    taking_part = fits(low, high)

    def end(low: float, high: float, first: bool) -> float | None:
        """The least (or the largest) gain of a part that is not dropped."""
        if not bool(fits(low, high)[taking_part].all()):
            return None
        if high <= low * RESOLUTION:
            return low if first else high
        middle = (low * high) ** 0.5
        halves = [(low, middle), (middle, high)]
        for half in halves if first else reversed(halves):
            if (found := end(half[0], half[1], first)) is not None:
                return found
        return None

    ends = end(low, high, True), end(low, high, False)
    if ends[0] is None or ends[1] is None or not bool(taking_part.any()):
        return declared, TaskGain(task.gain_unit, declared_gain, declared_gain, False)
    found = TaskGain(task.gain_unit, declared_gain, (ends[0], ends[1]), True)
    return declared.with_task_gain(found.found), found
