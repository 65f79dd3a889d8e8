"""The rows of a declared model that contradict samples of a log, at the declared bounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfsid.commands.where_to_look import constraint_name
from torchfsid.observers.consistency import Consistency, Fit


@dataclass(frozen=True)
class Fault:
    """Samples of a robot that contradict the declared bounds because of one row of the model.

    Attributes:
        row: label of the row.
        soft: the controller may violate the row.
        samples: number of such samples.
        first: time of the first [s].
        worst: largest amount by which a bound is exceeded, in units of the controls.
        look_at: the keys of the configuration behind it, in words.
    """

    row: str
    soft: bool
    samples: int
    first: float
    worst: float
    look_at: str

    def to_json(self) -> dict:
        """The entry of `check.json`."""
        return {**vars(self), "worst": self.worst if math.isfinite(self.worst) else None}


class Faults:
    """For all samples, at the declared bound: the row that a sample contradicts, and by how much.

    Args:
        labels: labels of the rows of the model.
        look_at: the keys behind constraints, in words (`where_to_look`).
        consistency: the samples.
        sets: the best Theta of every robot.
        bound: the declared bound on controls.
        residuals: of the samples, see `Consistency.residuals`.
    """

    def __init__(
        self,
        labels: Sequence[str],
        look_at: Callable[[Sequence[str]], str],
        consistency: Consistency,
        sets: Fit,
        bound: float,
        residuals: Tensor,
    ):
        self.labels, self._look_at = labels, look_at
        at_odds, blamed, excess, measured = [], [], [], []
        for block in consistency.blocks:
            reading = consistency.read(block, sets, block.repeated(torch.full_like(residuals[0], bound)))
            # How far Theta is beyond each half-space, as a control: rows come from unit normals over the control.
            corners = block.repeated(sets.theta.vertices())
            beyond = (reading.omega.A @ corners.mT).amin(-1) - reading.omega.b
            worst = beyond.argmax(-1, keepdim=True)
            assert reading.omega.source is not None
            blamed.append(reading.omega.source.gather(-1, worst).squeeze(-1))
            at_odds.append(reading.informative)
            excess.append(reading.excess)
            measured.append(reading.informative | reading.alarmed)
            self.hard = reading.hard
        robots = residuals.shape[1]
        self.times = torch.cat([block.times for block in consistency.blocks])
        self.over = residuals - bound
        self.at_odds = torch.cat(at_odds).unflatten(0, (-1, robots)) & (self.over > 0)
        self.blamed = torch.cat(blamed).unflatten(0, (-1, robots))
        self.excess = torch.cat(excess).unflatten(0, (-1, robots))
        self.measured = torch.cat(measured).unflatten(0, (-1, robots))

    def contradictions(self, robot: int) -> tuple[Fault, ...]:
        over, blamed = self.over[:, robot], self.blamed[:, robot]
        faults = []
        for source in blamed[self.at_odds[:, robot]].unique().tolist():
            at_odds = self.at_odds[:, robot] & (blamed == source)
            hard = source % len(self.labels) if source < 2 * len(self.labels) else None
            soft = hard is not None and not bool(self.hard[hard])
            faults.append(self._fault(constraint_name(source, self.labels), soft, at_odds, over))
        return tuple(faults)

    def violations(self, robot: int) -> tuple[Fault, ...]:
        faults = []
        for row, label in enumerate(self.labels):
            excess = self.excess[:, robot, row]
            violated = self.measured[:, robot] & (excess > 0)
            if bool(violated.any()):
                faults.append(self._fault(label, not bool(self.hard[row]), violated, excess))
        return tuple(faults)

    def _fault(self, label: str, soft: bool, samples: Tensor, over: Tensor) -> Fault:
        first = float(self.times[samples][0])
        return Fault(label, soft, int(samples.sum()), first, float(over[samples].max()), self._look_at([label]))
