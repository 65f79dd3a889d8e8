"""Which task do the robots have? Each hypothesis has a set of its own for every robot.

A hypothesis is refuted for a robot when its set becomes empty. The rows that contradict each other are the evidence. A
hypothesis that is left may be true or not: a log can only refute.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from torchfsid.commands.declared_log import DeclaredLog, automatic_bound
from torchfsid.commands.judged_bound import JudgedBound
from torchfsid.commands.observe import Observation
from torchfsid.commands.results import STATUS_NAMES
from torchfsid.commands.results_folder import write_json
from torchfsid.commands.where_to_look import constraint_name
from torchfsid.outcome import Status


@dataclass(frozen=True)
class HypothesisVerdict:
    """What a log says about one hypothesis for one robot.

    Attributes:
        status: `ok`, `alarm` or `inconsistent`, see `Status`. `inconsistent` means refuted.
        refuted_at: when its set became empty [s], or None. It is refuted without a time if no values of its unknown
            numbers explain the motion.
        evidence: times [s] and labels of the rows that contradict each other then. The time of the prior is None.
        volume: volume of its set at the end.
        bound_useless: it is left only with a bound that leaves wrong models, too, see `JudgedBound`.
    """

    status: str
    refuted_at: float | None
    evidence: tuple[tuple[float | None, str], ...]
    volume: float
    bound_useless: bool

    @property
    def is_refuted(self) -> bool:
        """Can it not be true?"""
        return self.status == STATUS_NAMES[Status.INCONSISTENT]

    def to_json(self) -> dict:
        """The entry of `hypotheses.json`."""
        evidence = [{"time": time, "row": row} for time, row in self.evidence]
        return {**vars(self), "evidence": evidence}


class Hypotheses:
    """A log and several models by name, ready to run.

    With `auto` all hypotheses have the same bound, so that none survives by a larger bound of its own. It is
    twice the smallest bound with which every robot is explained by some hypothesis.

    Raises:
        ConfigError: some robot is explained by no hypothesis, with any bound up to the largest control.
    """

    def __init__(self, models: Mapping[str, DeclaredLog]):
        self.smallest_bounds: dict[str, float] | None = None
        if next(iter(models.values())).config.noise.control == "auto":
            best: dict[str, float] = {}
            for model in models.values():
                for robot, bound in model.smallest_bounds().items():
                    best[robot] = min(bound, best.get(robot, math.inf))
            self.smallest_bounds = best
            bound = automatic_bound(best, next(iter(models.values())).config.noise.quantity)
            models = {name: model.with_bound(bound) for name, model in models.items()}
        self.observations = {name: Observation(model) for name, model in models.items()}

    @property
    def samples(self) -> int:
        """The number of samples that all hypotheses read together."""
        return sum(observation.samples for observation in self.observations.values())

    @property
    def bound_used(self) -> float:
        """The bound on controls in use."""
        return next(iter(self.observations.values())).bound_used

    @property
    def bound(self) -> JudgedBound:
        """The same, judged by the controls seen."""
        return next(iter(self.observations.values())).bound

    def write_verdicts(self, out: Path) -> None:
        """Write hypotheses.json: the verdict on each hypothesis for each robot."""
        verdicts = {
            robot: {name: verdict.to_json() for name, verdict in of_robot.items()}
            for robot, of_robot in self.verdicts().items()
        }
        write_json(out / "hypotheses.json", verdicts)

    def verdicts(self) -> dict[str, dict[str, HypothesisVerdict]]:
        """For each robot, the verdict on each hypothesis. The leader of a formation has none on that formation."""
        verdicts: dict[str, dict[str, HypothesisVerdict]] = {}
        for name, observation in self.observations.items():
            labels, volumes = observation.declared.row_labels, observation.sets.feasible_set.volume().tolist()
            for i, robot in enumerate(observation.robots):
                events = [e for e in observation.sets.events if e.robot == i and e.status == Status.INCONSISTENT]
                rows = events[0].rows if events else ()
                verdicts.setdefault(robot, {})[name] = HypothesisVerdict(
                    status=STATUS_NAMES[Status(int(observation.sets.status[i]))],
                    refuted_at=float(events[0].t) if events else None,
                    evidence=tuple((_or_none(float(time)), constraint_name(source, labels)) for time, source in rows),
                    volume=volumes[i],
                    bound_useless=observation.bound.is_useless and not events,
                )
        return verdicts


def _or_none(time: float) -> float | None:
    return None if math.isnan(time) else time
