"""The files in `configs/`: `kind: scene` is a robot or a team in closed loop, `kind: cases` is the paper's Table I.

Each file is complete: nothing is inherited. Keys that are left out have the defaults written here. This module does not
import torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from torchfsid.config.avoidance import AvoidanceConfig
from torchfsid.config.barriers import BarrierConfig
from torchfsid.config.dimensions import dimensions_of, require_one_dimension
from torchfsid.config.documents import Strict, wrong
from torchfsid.config.observe import AnyNoiseConfig, Dynamics, require_one_order
from torchfsid.config.observers import PriorConfig, UkfConfig
from torchfsid.config.quantities import BodyName, NonNegative, Number, Place, PlanarVector, Positive, known
from torchfsid.config.tasks import GoalConfig
from torchfsid.config.unknown_numbers import unknown_numbers

SetKind = Literal["critical_region", "inverse_optimal"]

SETS: tuple[SetKind, ...] = ("critical_region", "inverse_optimal")

MAX_STEPS = 1_000_000
"""More is a slip of the pen in dt or duration."""

Text = Annotated[str, Field(min_length=1)]
WholeNumber = Annotated[int, Field(strict=True, ge=0)]
Count = Annotated[int, Field(strict=True, ge=1)]


class RobotConfig(Strict):
    """A robot.

    Attributes:
        name: its name.
        start: where it starts [m].
        goal: where it goes [m].
    """

    name: BodyName
    start: Place
    goal: Place


class ObstacleConfig(Strict):
    """A body that stands still.

    Attributes:
        name: its name.
        position: its position [m].
    """

    name: BodyName
    position: Place


class MeasurementNoiseConfig(Strict):
    """The errors of the measurements of the robots.

    Attributes:
        velocity: bound on the length of velocity errors [m/s].
        position: bound on the length of position errors [m].
        acceleration: bound on the length of acceleration errors, of double integrators [m/s2].
        shape: `uniform`: uniform in discs. `bias`: one error of full length per robot, constant over time.
            `adversarial`: errors of full length, chosen at every sample with knowledge of the truth and the observer
            (`experiments.runs.errors`).
    """

    velocity: NonNegative = 0.0
    position: NonNegative = 0.0
    acceleration: NonNegative = 0.0
    shape: Literal["uniform", "bias", "adversarial"] = "uniform"


class ExpectedConfig(Strict):
    """What the paper says is active until a time. Either `active` or `count` is given.

    Attributes:
        until: end of the interval [s].
        active: names of the active bodies.
        count: number of active bodies.
    """

    until: Positive
    active: tuple[BodyName, ...] | None = None
    count: WholeNumber | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> ExpectedConfig:
        if (self.active is None) == (self.count is None):
            raise wrong("expected either active (names) or count (a number)")
        return self


class ExperimentConfig(Strict):
    """The common part of all experiments: the declared model and the observers.

    Attributes:
        kind: the kind of file.
        title: title of the figures.
        task: the task, whose goal is inferred.
        barriers: the barriers, in the order of their rows.
        dynamics: robots that are driven by velocities, or by accelerations (`double_integrator`).
        dt: sampling time [s].
        duration: length of the run [s].
        prior: the prior set of a goal [m].
        set: the set of the plain columns, of regions.json and of the hybrid estimate. The other set is computed
            alongside where it can be (`sets`).
        active_tolerance: distance to its boundary below which a row counts as active, in units of the control.
        noise: bounds on errors, for the inverse-optimal set.
        ukf: the filter.
    """

    kind: str
    title: Text
    task: GoalConfig
    barriers: Annotated[tuple[BarrierConfig, ...], Field(min_length=1)]
    dynamics: Dynamics = "single_integrator"
    dt: Positive
    duration: Positive
    prior: PriorConfig
    set: SetKind
    active_tolerance: Positive = 1e-3
    noise: AnyNoiseConfig
    ukf: UkfConfig = UkfConfig()

    @property
    def steps(self) -> int:
        """The number of samples of the run."""
        return round(self.duration / self.dt)

    @property
    def dimension(self) -> int:
        """Are the robots in the plane (2) or in space (3)?"""
        return dimensions_of(self.task, self.prior)[0]

    @property
    def sets(self) -> tuple[SetKind, ...]:
        """The kinds of set that can be computed. The paper's needs exact rows and a nominal control without limits."""
        exact = not self.task.is_clipped and not any(barrier.uncertain for barrier in self.barriers)
        return SETS if exact else ("inverse_optimal",)

    @property
    def safety_distance(self) -> float | None:
        """The safety distance of the first barrier that has one [m]. Bodies are drawn in this size."""
        distances = (known(getattr(barrier, "safety_distance", None)) for barrier in self.barriers)
        return next((distance for distance in distances if distance is not None), None)

    @model_validator(mode="after")
    def _can_be_simulated(self) -> Self:
        for number in unknown_numbers(self.task, self.barriers):
            raise wrong("expected a number, not [low, high]: robots that are simulated have it", number.name)
        for i, barrier in enumerate(self.barriers):
            if barrier.is_unknown:
                raise wrong("expected numbers, not [low, high]: robots that are simulated have them", f"barriers[{i}]")
        require_one_order(self.dynamics, self.task, self.barriers, self.noise)
        if self.noise.control == "auto":
            raise wrong(
                "expected a number, not auto: robots that are simulated have it", f"noise.{self.noise.quantity}"
            )
        if self.set not in self.sets:
            raise wrong("critical_region needs exact rows and no clipped nominal control, take inverse_optimal", "set")
        require_one_dimension((self.dimension,), self.barriers)
        require_steps(self.duration, self.dt)
        return self

    def _require_in_prior(self, goal: Sequence[float], path: str) -> None:
        bounds = zip(self.prior.lower, goal, self.prior.upper, strict=True)
        if not all(low <= x <= high for low, x, high in bounds):
            raise wrong(f"the prior does not hold it: {list(goal)}", path)

    def _require_in_time(self, snapshots: Sequence[float]) -> None:
        require_increasing(snapshots, "snapshots")
        if snapshots[-1] > self.duration:
            raise wrong(f"must not be after the end, {self.duration} s, got {snapshots[-1]}", "snapshots")


class SceneConfig(ExperimentConfig):
    """A robot among obstacles, or a team in which every robot avoids every other.

    Attributes:
        robots: the robots.
        obstacles: bodies that stand still.
        radius: radius of all bodies, for barriers that need one [m]. Bodies are then drawn in this size.
        seed: seed of the measurement noise.
        measurement_noise: errors of the measurements.
        snapshots: times of the figure's panels [s].
        expected: the expected timeline of active obstacles, for scenes with one robot.
    """

    kind: Literal["scene"]
    robots: Annotated[tuple[RobotConfig, ...], Field(min_length=1)]
    obstacles: tuple[ObstacleConfig, ...] = ()
    radius: Positive | None = None
    seed: WholeNumber
    measurement_noise: MeasurementNoiseConfig = MeasurementNoiseConfig()
    snapshots: Annotated[tuple[NonNegative, ...], Field(min_length=1, max_length=4)]
    expected: tuple[ExpectedConfig, ...] = ()

    @property
    def bodies(self) -> list[str]:
        """The names of the robots, then of the obstacles."""
        return [body.name for body in (*self.robots, *self.obstacles)]

    @model_validator(mode="after")
    def _is_a_scene(self) -> SceneConfig:
        names = self.bodies
        if repeated := [name for i, name in enumerate(names) if name in names[:i]]:
            raise wrong(f"two bodies are called {repeated[0]!r}", "robots, obstacles")
        places = {
            f"robots[{i}].{name}": getattr(of, name) for i, of in enumerate(self.robots) for name in ("start", "goal")
        }
        places |= {f"obstacles[{i}].position": of.position for i, of in enumerate(self.obstacles)}
        for path, place in places.items():
            if len(place) != self.dimension:
                raise wrong(f"expected {self.dimension} entries as in the prior, got {list(place)}", path)
        for i, robot in enumerate(self.robots):
            self._require_in_prior(robot.goal, f"robots[{i}].goal")
        if self.radius is None and any(barrier.uses_radius for barrier in self.barriers):
            raise wrong("expected the radius of the bodies, which a barrier needs", "radius")
        self._require_in_time(self.snapshots)
        noise = self.measurement_noise
        if self.dynamics == "single_integrator" and noise.acceleration > 0:
            raise wrong("needs dynamics: double_integrator", "measurement_noise.acceleration")
        if self.dimension == 3 and noise.shape == "adversarial":
            raise wrong("the adversary knows robots in the plane only", "measurement_noise.shape")
        if self.dynamics == "double_integrator" and noise.shape == "adversarial":
            raise wrong("the adversary knows single integrators only", "measurement_noise.shape")
        if self.expected and len(self.robots) > 1:
            raise wrong("only a scene of one robot has an expected timeline", "expected")
        require_increasing([interval.until for interval in self.expected], "expected")
        obstacles = [obstacle.name for obstacle in self.obstacles]
        for i, interval in enumerate(self.expected):
            if unknown := [name for name in interval.active or () if name not in obstacles]:
                raise wrong(f"no obstacle is called {unknown[0]!r}", f"expected[{i}].active")
        return self


class CaseBodyConfig(Strict):
    """A body beside the robot.

    Attributes:
        direction: direction from the robot to the body [deg].
        radius: radius of the body [m].
        speed: the speed to which its row limits the robot in this direction [m/s]. Default: the row goes through the
            `meet` of the case, and is active.
    """

    direction: Number
    radius: Positive
    speed: Number | None = None


class CaseConfig(Strict):
    """One line of Table I.

    Attributes:
        name: its name.
        letter: the case that the bodies realise.
        meet: the control at which the active rows meet, in the frame of the directions [m/s].
        bodies: the bodies around the robot.
    """

    name: BodyName
    letter: Literal["A", "B", "C", "D", "E"]
    meet: PlanarVector = (0.0, 0.0)
    bodies: Annotated[tuple[CaseBodyConfig, ...], Field(min_length=1)]


class CasesConfig(ExperimentConfig):
    """Constructed cases: a robot is held in one of the paper's cases by bodies that move along with it.

    Attributes:
        start: start of the robot, in every case [m].
        goal: goal of the robot, in every case [m].
        barriers: the only barrier. The places of the bodies follow from its rows.
        radius: radius of the robot [m].
        spin: angular rate at which the directions turn [deg/s].
        cases: the cases.
    """

    kind: Literal["cases"]
    barriers: tuple[AvoidanceConfig]
    start: PlanarVector
    goal: PlanarVector
    radius: Positive
    spin: Number = 0.0
    cases: Annotated[tuple[CaseConfig, ...], Field(min_length=1)]

    @property
    def slots(self) -> int:
        """The largest number of bodies of a case."""
        return max(len(case.bodies) for case in self.cases)

    @model_validator(mode="after")
    def _is_a_table(self) -> CasesConfig:
        self._require_in_prior(self.goal, "goal")
        names = [case.name for case in self.cases]
        if repeated := [name for i, name in enumerate(names) if name in names[:i]]:
            raise wrong(f"two cases are called {repeated[0]!r}", "cases")
        (barrier,) = self.barriers
        if barrier.margin is None:
            raise wrong("expected one avoidance barrier with a margin", "barriers")
        if (barrier.distance, barrier.class_k.power, barrier.neighbour_velocity) != ("squared", 1, "none"):
            raise wrong("expected the paper's row: squared, power 1, neighbour_velocity none", "barriers[0]")
        return self


def require_steps(duration: float, dt: float) -> None:
    """Check, in a validator, that a run has a number of steps that can be run."""
    if not 1 <= duration / dt <= MAX_STEPS:
        raise wrong(f"expected 1 to {MAX_STEPS} steps of dt = {dt} s, got {duration} s", "duration")


def require_increasing(times: Sequence[float], path: str) -> None:
    """Check, in a validator, that times increase. `path` names the key in the message."""
    for before, after in pairwise(times):
        if not before < after:
            raise wrong(f"times must increase, got {after} after {before}", path)
