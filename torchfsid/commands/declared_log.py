"""A log together with its declared model, checked against each other before a command begins."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from torchfsid.commands.clock import Clock
from torchfsid.commands.judged_bound import SUSPECTS, JudgedBound
from torchfsid.commands.where_to_look import where_to_look
from torchfsid.config.dimensions import WORDS
from torchfsid.config.observe import ObserveConfig
from torchfsid.config.quantities import require_body
from torchfsid.config.unknown_numbers import replaced
from torchfsid.errors import ConfigError
from torchfsid.logs.commanded import Recovery, commanded
from torchfsid.logs.contacts import arrival_errors
from torchfsid.logs.gaps import bridged
from torchfsid.logs.log import Log
from torchfsid.observers.consistency import BLOCK, Consistency
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Task
from torchfsid.robots.unknown_avoidance import UnknownAvoidance
from torchfsid.sets.feasible_set import FeasibleSet

AUTO_FACTOR = 2.0
"""A bound of `auto` takes the smallest bound that explains the log this many times: the worst error of a log is
not the worst there is, and part of an error may look like another parameter."""


LARGEST_OF = {"velocity": "speed", "acceleration": "acceleration"}
"""What a large control is large in."""


WINDOWS = (0.1, 0.25, 0.5, 1.0)
"""Default lengths of windows over positions [s]."""


def default_windows(log: Log) -> tuple[float, ...]:
    """The default lengths that have two samples or more [s]. Two, five and ten samples of a log that is slower."""
    step = float(np.median(np.diff(log.t)))
    return tuple(length for length in WINDOWS if length > 1.5 * step) or (2 * step, 5 * step, 10 * step)


@dataclass
class DeclaredLog:
    """A log and the model that its configuration declares.

    Attributes:
        config: the configuration.
        log: the log, with gaps filled (`gaps`), and with velocities from differences of positions if `config` says so.
            Those of unicycles are commands (`commanded`).
        recovery: what became of the poses of unicycles. None if robots are none.
        robots: the bodies to infer.
        task: the task of the model.
        barriers: the barriers of the model.
        prior: the prior sets of the robots.

    Raises:
        ConfigError: the model needs something that the log does not have (a body, velocities, radii, positions z).
    """

    config: ObserveConfig
    log: Log
    recovery: Recovery | None = field(init=False, default=None)
    robots: list[str] = field(init=False)
    task: Task = field(init=False)
    barriers: list[Barrier | UnknownAvoidance] = field(init=False)
    prior: FeasibleSet = field(init=False)

    def __post_init__(self) -> None:
        config = self.config
        if self.log.x.shape[-1] not in config.dimensions:
            told = f"prior: {len(config.prior.lower)} entries for a task {config.task.kind!r}"
            there = "has positions z" if config.dimension == 2 else "has no positions z"
            raise ConfigError(f"{told}: robots {WORDS[config.dimension]}, but the log {there}")
        if config.is_second_order:
            self._require_accelerations()
        elif config.velocity == "logged" and self.log.u is None:
            raise ConfigError("velocity: 'logged', but the log has no velocities vx, vy (use 'differentiated')")
        if len(self.log.bodies) > 1 and not (self.log.seen.sum(axis=1) > 1).any():
            raise ConfigError(f"{self.log.source}: no two bodies share a time, so none would ever see another")
        if config.is_second_order:
            noise = config.noise.build_others()
            self.log = self.log if config.velocity == "logged" else self.log.accelerated(float(noise.arrival))
        else:
            self.log = self.log.of_first_order()
            if config.velocity == "windows":
                self.log = self.log.windowed(config.noise.position)
                self.config = config.model_copy(update={"windows": config.windows or default_windows(self.log)})
            elif config.body is not None:
                self._require_headings()
                self.log, self.recovery = commanded(
                    self.log, config.body, config.noise.position, getattr(config.noise, "heading", 0.0)
                )
            elif config.velocity == "differentiated":
                self.log = self.log.differentiated()
        self.log = bridged(self.log)
        self.robots = config.robots(self.log.bodies)
        for robot in config.truth or {}:
            require_body(f"truth.{robot}", robot, self.robots)
        self.task = config.task.build(self.log.bodies, self.log.x.shape[-1])
        self.barriers = config.build_barriers(self.log.bodies, self._radius)
        self.prior = config.prior.build(len(self.robots))
        if config.ukf is not False:
            updates = len(self.log.t) * len(self.robots)
            chosen = config.ukf.for_log(updates, self.task.saturation is None)
            self.config = self.config.model_copy(update={"ukf": chosen})

    def _require_accelerations(self) -> None:
        if self.log.u is None:
            raise ConfigError(
                "dynamics: a double_integrator needs velocities vx, vy, and the log has none: positions alone leave "
                "velocities and accelerations open, two unknowns for each position"
            )
        if self.config.velocity == "logged" and self.log.a is None:
            raise ConfigError(
                "velocity: 'logged', but the log has no accelerations ax, ay (use 'differentiated': they are then "
                "differences of velocities)"
            )
        _, known = self.log.controls
        joint = "current" in self.config.neighbour_velocities and self.config.velocity == "logged"
        for j, body in enumerate(self.log.bodies):
            if not self.log.velocity_known[:, j].any():
                raise ConfigError(f"dynamics: a double_integrator avoids bodies of known velocities, {body!r} has none")
            if joint and not known[:, j].any():
                raise ConfigError(f"barriers: rows use the accelerations of all bodies, and {body!r} has none")

    def _require_headings(self) -> None:
        known = self.log.with_headings
        for robot in self.config.robots(self.log.bodies):
            if robot not in known:
                raise ConfigError(f"body: {self.log.source}: robot {robot!r} has no heading (an obstacle needs none)")

    @property
    def row_labels(self) -> list[str]:
        """A label for each row of the model."""
        return [label for barrier in self.barriers for label in barrier.labels(self.log.bodies)]

    @property
    def clock(self) -> Clock:
        """How times of the log are shown."""
        return Clock.of(float(self.log.t[0]))

    def where_to_look(self, constraints: Iterable[str]) -> str:
        """The keys of the configuration behind constraints that contradict each other."""
        rows = [barrier.labels(self.log.bodies) for barrier in self.barriers]
        return where_to_look(constraints, self.config, rows)

    def measurements(self, block: int | None = None) -> Iterator[Measurement]:
        """The samples of the robots, in the order of time.

        Args:
            block: how many are concatenated to one measurement. None: each measurement is one sample.
        """
        uses, required = self.config.neighbour_velocities, self.config.required
        return self.log.measurements(self.robots, uses, required, self._arrival_errors, block)

    @property
    def contacts(self) -> int:
        """The number of samples at which a body did not move as its velocity says, where rows use that velocity."""
        return 0 if self._arrival_errors is None else int((self._arrival_errors > 0).sum())

    @cached_property
    def _arrival_errors(self) -> Float[np.ndarray, "times bodies"] | None:
        config = self.config
        if config.is_second_order or config.velocity != "logged" or "previous" not in config.neighbour_velocities:
            return None
        velocity = 0.0 if config.noise.control == "auto" else config.noise.control
        return arrival_errors(self.log, config.noise.position, velocity)

    def consistency(self) -> Consistency:
        """What the log says about the bound on controls, under the model and all other declared bounds."""
        noise = self.config.noise
        return Consistency(_Blocks(self), self.task, self.barriers, self.prior, noise.slack, noise.build_others())

    def shifted(self, samples: int) -> DeclaredLog:
        """The same log with controls taken this number of samples later."""
        log, times = self.log, len(self.log.t)
        kept = slice(max(0, -samples), times - max(0, samples))
        moved = slice(max(0, samples), times + min(0, samples))
        velocities = moved if log.a is None else kept

        def at(part: slice, values: np.ndarray | None) -> np.ndarray | None:
            return None if values is None else values[part]

        accelerated = log.acceleration_known
        shifted = replace(
            log,
            t=log.t[kept],
            x=log.x[kept],
            u=at(velocities, log.u),
            a=at(moved, log.a),
            seen=log.seen[kept],
            velocity_known=log.velocity_known[velocities] & log.seen[kept],
            acceleration_known=None if accelerated is None else accelerated[moved] & log.seen[kept],
            position_error=at(kept, log.position_error),
            velocity_error=at(velocities, log.velocity_error),
            acceleration_error=at(moved, log.acceleration_error),
            lost=at(kept, log.lost),
            bridged=None if log.bridged is None else log.bridged[kept] | log.bridged[moved],
        )
        return replace(self, config=self.config.model_copy(update={"velocity": "logged", "body": None}), log=shifted)

    def with_bound(self, bound: float) -> DeclaredLog:
        """The same log and model with another bound on the error of controls."""
        other = copy(self)
        other.config = self.config.with_bound(bound)
        return other

    def with_model(self, config: ObserveConfig) -> DeclaredLog:
        """The same log with another task, other barriers and another prior."""
        other = copy(self)
        other.config = config
        other.task = config.task.build(self.log.bodies, self.log.x.shape[-1])
        other.barriers = config.build_barriers(self.log.bodies, self._radius)
        other.prior = config.prior.build(len(self.robots))
        return other

    def with_numbers(self, intervals: Sequence[tuple[float, float]]) -> DeclaredLog:
        """The same log and model with other intervals for its unknown numbers."""
        other = copy(self)
        for number, interval in zip(self.config.unknown_numbers, intervals, strict=True):
            other.config = replaced(other.config, number.path, interval)
        other.task = other.config.task.build(self.log.bodies, self.log.x.shape[-1])
        other.barriers = other.config.build_barriers(self.log.bodies, self._radius)
        return other

    @property
    def _radius(self) -> list[float] | None:
        return None if self.log.radius is None else self.log.radius.tolist()

    def judged(self, bound: float) -> JudgedBound:
        """A bound on the error of controls, judged by the controls of the inferred robots.

        Accelerations from differences of velocities have errors of their own, of which the median counts.
        """
        controls, known = self.log.controls
        assert controls is not None
        of_robots = [self.log.bodies.index(robot) for robot in self.robots]
        known = known[:, of_robots]
        sizes = np.linalg.norm(controls[:, of_robots][known], axis=-1)
        error, differences = self.log.acceleration_error, 0.0
        if error is not None and len(sizes):
            differences = float(np.median(error[:, of_robots][known]))
        return JudgedBound.of(bound, sizes, self.config.noise.unit, differences)

    def smallest_bounds(self) -> dict[str, float]:
        """For each robot, the smallest bound on controls with which the model explains its motion.

        It is infinite if no bound up to the largest control in the log does.
        """
        consistency = self.consistency()
        return dict(zip(self.robots, consistency.smallest_bounds(consistency.fastest).tolist(), strict=True))


@dataclass(frozen=True)
class _Blocks:
    """The samples of a log in blocks, made again whenever they are iterated over."""

    declared: DeclaredLog

    def __iter__(self) -> Iterator[Measurement]:
        return self.declared.measurements(BLOCK)


def automatic_bound(smallest: Mapping[str, float], quantity: str = "velocity") -> float:
    """The bound that `auto` takes.

    Args:
        smallest: each robot's smallest bound, as `DeclaredLog.smallest_bounds` returns it.
        quantity: what it bounds, `velocity` or `acceleration`.

    Raises:
        ConfigError: one of them is infinite: the model is wrong. `torchfsid check` says where.
    """
    unexplained = [robot for robot, bound in smallest.items() if bound == math.inf]
    if unexplained:
        raise ConfigError(
            f"noise.{quantity}: auto: no bound up to the largest {LARGEST_OF[quantity]} in the log explains robot "
            f"{unexplained[0]!r}; "
            f"the model is wrong (torchfsid check says where): suspect {SUSPECTS}"
        )
    return AUTO_FACTOR * max(smallest.values())
