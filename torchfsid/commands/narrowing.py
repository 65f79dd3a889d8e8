"""Unknown numbers of a model, such as `task: {kind: goal, gain: [low, high]}`: which values can explain a log?

The intervals of all unknown numbers are a box of values. A box is dropped if some robot's motion cannot be explained
with any values in it. Otherwise it is halved, until it is narrow. The boxes nearest to an end of a number's interval
come first, so that the first narrow one that is left is where this interval now ends. First the sides of one number
after another are halved, with all values of the others. Then all sides are, the widest first, because what one number
may be depends on the others. The robots share the numbers. A robot that no values explain does not take part.

In a box, the model has the values in the middle, with errors of half the widths (`GoalTask.gain_error`,
`Orca.rate_error`, `SecondOrderAvoidance.gain_errors` and so on). So nothing is lost. Where motions carry no information
(jams), little or nothing is dropped, nor of a number that another one can make up for.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import count, product

import torch
from jaxtyping import Bool
from torch import Tensor

from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.terminal import ends
from torchfsid.observers.consistency import Consistency

RESOLUTION = 1.005
"""A side is narrow below this ratio of its ends; where zero is possible, below its share of the declared interval."""

MOST_BOXES = 200
"""Boxes that are halved at most for one end. The end is then that of the nearest box that is left."""

Interval = tuple[float, float]
Box = tuple[tuple[int, int], ...]
"""Sides between two marks of each number's `Scale`."""


@dataclass(frozen=True)
class Scale:
    """The declared interval of a number in 2^n narrow parts: of equal ratios, or of equal width if it has zero.

    The marks between the parts are counted from 0. All boxes end at marks, so that many are met again.
    """

    declared: Interval

    @property
    def parts(self) -> int:
        low, high = self.declared
        narrow = math.log(high / low) / math.log(RESOLUTION) if low > 0 else (high > low) / (RESOLUTION - 1)
        return 2 ** math.ceil(math.log2(max(narrow, 1)))

    def at(self, mark: int) -> float:
        """The value at a mark."""
        low, high = self.declared
        if mark in (0, self.parts):  # without round-off
            return high if mark else low
        share = mark / self.parts
        return low * (high / low) ** share if low > 0 else low + (high - low) * share

    def halves(self, side: tuple[int, int]) -> tuple[tuple[int, int], tuple[int, int]]:
        """A side parted at the mark in it that halves the largest parts."""
        step, middle = self.parts, side[1]
        while not middle < side[1]:
            step //= 2
            middle = (side[0] // step + 1) * step
        return (side[0], middle), (middle, side[1])


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
    search = _Search(declared)
    whole = tuple((0, scale.parts) for scale in search.scales)
    taking_part = torch.ones(len(robots), dtype=torch.bool)
    box = search.narrowed(whole, taking_part)
    if box is None:
        each = torch.eye(len(robots), dtype=torch.bool)
        taking_part = torch.tensor([search.narrowed(whole, alone) is not None for alone in each])
        if bool(taking_part.any()):
            box = search.narrowed(whole, taking_part)
    left = None if box is None else search.intervals(box)
    explained = tuple(robot for robot, part in zip(robots, taking_part.tolist(), strict=True) if part)
    unexplained = tuple(robot for robot in robots if robot not in explained)
    found = {
        number.name: Narrowed(number.unit, number.interval, side, left is not None)
        for number, side in zip(numbers, left or [number.interval for number in numbers], strict=True)
    }
    return declared if left is None else declared.with_numbers(left), Narrowing(found, explained, unexplained)


@dataclass
class _Search:
    """Boxes of values, and which robots they explain."""

    declared: DeclaredLog
    scales: list[Scale] = field(init=False)
    consistency: Consistency = field(init=False)
    known: dict[Box, Bool[Tensor, "B"]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.scales = [Scale(number.interval) for number in self.declared.config.unknown_numbers]
        self.consistency = self.declared.consistency()

    def narrowed(self, box: Box, robots: Bool[Tensor, "B"]) -> Box | None:
        """The part of a box between the ends of all its sides. None if no values explain these robots."""
        every = range(len(box))
        one_by_one: list[tuple[int, Sequence[int]]] = [(i, [i]) for i in every]
        together = [(i, every) for i in every if len(box) > 1]
        for (i, halved), last in product([*one_by_one, *together], (False, True)):
            if (end := self.end(box, i, last, halved, robots)) is None:
                return None
            side = (box[i][0], end) if last else (end, box[i][1])
            box = (*box[:i], side, *box[i + 1 :])
        return box

    def end(self, box: Box, i: int, last: bool, halved: Sequence[int], robots: Bool[Tensor, "B"]) -> int | None:
        """The first (or last) mark of number i in the boxes that are not dropped. None if all are.

        Args:
            box: the box to begin with.
            i: the number.
            last: the last mark instead of the first.
            halved: the numbers whose sides are halved.
            robots: the robots that a box has to explain.
        """
        sign, order, left = -1 if last else 1, count(), MOST_BOXES
        boxes = [(sign * box[i][last], 0, box)]
        while boxes:
            *_, nearest = heappop(boxes)
            if not bool(self.explained(nearest)[robots].all()):
                continue
            width, k = max((nearest[k][1] - nearest[k][0], k) for k in halved)
            if width == 1 or left == 0:
                return nearest[i][last]
            left -= 1
            for half in self.scales[k].halves(nearest[k]):
                part = (*nearest[:k], half, *nearest[k + 1 :])
                heappush(boxes, (sign * part[i][last], -next(order), part))
        return None

    def intervals(self, box: Box) -> list[Interval]:
        """The values of each number in a box."""
        return [(scale.at(low), scale.at(high)) for scale, (low, high) in zip(self.scales, box, strict=True)]

    def explained(self, box: Box) -> Bool[Tensor, "B"]:
        """The robots whose motions can be explained as far as the errors of a box let it be seen."""
        if box not in self.known:
            part, bound = self.declared.with_numbers(self.intervals(box)), self.declared.config.noise.control
            assert bound != "auto"
            self.consistency.task, self.consistency.barriers = part.task, part.barriers
            bounds = torch.full((self.consistency.robots,), bound, dtype=torch.float64)
            self.known[box] = self.consistency.sets(bounds).fits
        return self.known[box]
