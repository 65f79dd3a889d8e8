"""Unknown numbers of a model, such as `task: {kind: goal, gain: [low, high]}`: which values can explain a log?

The intervals of all unknown numbers are a box of values. A box is dropped if some robot's motion cannot be explained
with any values in it. Otherwise it is halved across its widest side, until all its sides are narrow. The boxes nearest
to an end of a number's interval come first, so that the first narrow one that is left is where this interval now ends.
The ends are found one after another, each within those found before. The robots share the numbers. A robot that no
values explain does not take part.

In a box, the model has the values in the middle, with errors of half the widths (`GoalTask.gain_error`,
`Orca.rate_error`, `SecondOrderAvoidance.gain_errors` and so on). So nothing is lost. Where motions carry no information
(jams), little or nothing is dropped, nor of a number that another one can make up for.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import count

import torch
from jaxtyping import Bool
from torch import Tensor

from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.terminal import ends
from torchfsid.config.unknown_numbers import UnknownNumber
from torchfsid.observers.consistency import Consistency

RESOLUTION = 1.005
"""A side is narrow below this ratio of its ends; where zero is possible, below its share of the declared interval."""

MOST_BOXES = 400
"""Boxes that are read at most for one end. The end is then the nearest that is left."""

Interval = tuple[float, float]
Box = tuple[Interval, ...]


@dataclass(frozen=True)
class Narrowed:
    """The values of one number that can explain the log.

    Attributes:
        unit: their unit.
        declared: the declared interval.
        found: the interval that is left; the declared one if nothing explains the log.
        explains: whether any value does.
    """

    unit: str
    declared: Interval
    found: Interval
    explains: bool

    @property
    def by_data(self) -> tuple[bool, bool]:
        """Whether the ends come from the data. Otherwise they are those that were declared."""
        return self.found[0] > self.declared[0], self.found[1] < self.declared[1]

    def to_json(self) -> dict:
        """The entry of unknown_numbers.json."""
        return {**vars(self), "bounded_by_data": self.by_data}


@dataclass(frozen=True)
class Narrowing:
    """What is left of the unknown numbers of a model.

    Attributes:
        numbers: what was found, by the place of the number in the file, such as `barriers[0].time_horizon`.
        explained: the robots that some values explain.
        unexplained: the robots that none explain. They do not take part.
    """

    numbers: Mapping[str, Narrowed]
    explained: tuple[str, ...]
    unexplained: tuple[str, ...]

    @property
    def explains(self) -> bool:
        """Are there values that explain all robots that can be explained?"""
        return all(number.explains for number in self.numbers.values())

    def said(self) -> list[str]:
        """What was found, as sentences."""
        declared = ", ".join(f"{name} {ends(number.declared)}" for name, number in self.numbers.items())
        lines = []
        if self.unexplained:
            lines.append(
                f"no values of the unknown numbers explain {', '.join(self.unexplained)} (declared {declared})"
            )
        if not self.explains and self.explained:
            robots = ", ".join(self.explained)
            lines.append(f"no values of the unknown numbers explain all of {robots} together (declared {declared})")
        for name, number in self.numbers.items() if self.explains else ():
            open_ends = "" if all(number.by_data) else "; * not bounded by the data"
            found = f"{ends(number.found, number.by_data)} {number.unit}"
            lines.append(f"{name}: {found} (declared {ends(number.declared)}{open_ends})")
        return lines

    def to_json(self) -> dict:
        """The content of unknown_numbers.json."""
        return {
            "numbers": {name: number.to_json() for name, number in self.numbers.items()},
            "explained": self.explained,
            "unexplained": self.unexplained,
        }


def narrowed(declared: DeclaredLog) -> tuple[DeclaredLog, Narrowing]:
    """The same log with narrower intervals for the unknown numbers of its model, and what was found.

    Args:
        declared: a log whose model has unknown numbers, with the bound on controls as a number.
    """
    numbers, robots = declared.config.unknown_numbers, declared.robots
    search, whole = _Search(declared, numbers), tuple(number.interval for number in numbers)
    taking_part = torch.ones(len(robots), dtype=torch.bool)
    box = search.narrowed(whole, taking_part)
    if box is None:
        each = torch.eye(len(robots), dtype=torch.bool)
        taking_part = torch.tensor([search.end(whole, 0, False, alone) is not None for alone in each])
        if bool(taking_part.any()):
            box = search.narrowed(whole, taking_part)
    explained = tuple(robot for robot, part in zip(robots, taking_part.tolist(), strict=True) if part)
    unexplained = tuple(robot for robot in robots if robot not in explained)
    found = {
        number.name: Narrowed(number.unit, number.interval, number.interval if box is None else side, box is not None)
        for number, side in zip(numbers, box or whole, strict=True)
    }
    return declared if box is None else declared.with_numbers(numbers, box), Narrowing(found, explained, unexplained)


@dataclass
class _Search:
    """Boxes of values, and which robots they explain."""

    declared: DeclaredLog
    numbers: Sequence[UnknownNumber]
    consistency: Consistency = field(init=False)
    known: dict[Box, Bool[Tensor, "B"]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.consistency = self.declared.consistency()

    def narrowed(self, box: Box, robots: Bool[Tensor, "B"]) -> Box | None:
        """The part of a box between the ends of all its sides. None if no values explain these robots."""
        for i in range(len(box)):
            for last in (False, True):
                found = self.end(box, i, last, robots)
                if found is None:
                    return None
                side = (box[i][0], found) if last else (found, box[i][1])
                box = (*box[:i], side, *box[i + 1 :])
        return box

    def end(self, box: Box, i: int, last: bool, robots: Bool[Tensor, "B"]) -> float | None:
        """The first (or last) value of number i in the boxes that are not dropped. None if all are."""
        sign, order, read = -1 if last else 1, count(), 0
        boxes = [(sign * box[i][last], 0, box)]
        while boxes:
            *_, nearest = heappop(boxes)
            read += 1
            if not bool(self.explained(nearest)[robots].all()):
                continue
            widths = [self.width(k, side) for k, side in enumerate(nearest)]
            if max(widths) <= 1 or read >= MOST_BOXES:
                return nearest[i][last]
            k = widths.index(max(widths))
            for half in self.halves(k, nearest[k]):
                part = (*nearest[:k], half, *nearest[k + 1 :])
                heappush(boxes, (sign * half[last] if k == i else sign * part[i][last], -next(order), part))
        return None

    def width(self, k: int, side: Interval) -> float:
        """The width of a side of number k, in widths that are narrow."""
        low, high = self.numbers[k].interval
        if low > 0:
            return math.log(side[1] / side[0]) / math.log(RESOLUTION)
        return (side[1] - side[0]) / ((high - low) * (RESOLUTION - 1) or 1.0)

    def halves(self, k: int, side: Interval) -> tuple[Interval, Interval]:
        middle = math.sqrt(side[0] * side[1]) if self.numbers[k].interval[0] > 0 else (side[0] + side[1]) / 2
        return (side[0], middle), (middle, side[1])

    def explained(self, box: Box) -> Bool[Tensor, "B"]:
        """The robots whose motions can be explained as far as the errors of a box let it be seen."""
        if box not in self.known:
            part, bound = self.declared.with_numbers(self.numbers, box), self.declared.config.noise.control
            assert bound != "auto"
            self.consistency.task, self.consistency.barriers = part.task, part.barriers
            bounds = torch.full((self.consistency.robots,), bound, dtype=torch.float64)
            self.known[box] = self.consistency.sets(bounds).fits
        return self.known[box]
