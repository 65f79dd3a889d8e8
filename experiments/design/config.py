"""The files of `python -m experiments design`: `kind: probe_placement` and `kind: learned_observer`.

Each file is complete; what is left out has the default written here. No torch in this module.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from experiments.runs.config import Text, WholeNumber
from experiments.teams import TeamConfig
from torchfsid.config.barriers import AvoidanceConfig
from torchfsid.config.documents import Strict, wrong
from torchfsid.config.observers import UkfConfig
from torchfsid.config.quantities import NonNegative, Number, PlanarVector, Positive

Count = Annotated[int, Field(strict=True, ge=1)]
Several = Annotated[int, Field(strict=True, ge=2)]
MAX_STEPS = 100_000
"""More is a slip of the pen in dt or duration."""


class BoxConfig(Strict):
    """A rectangle [m]."""

    lower: PlanarVector
    upper: PlanarVector

    @model_validator(mode="after")
    def _is_a_box(self) -> BoxConfig:
        if not all(low < high for low, high in zip(self.lower, self.upper, strict=True)):
            raise wrong(f"expected lower < upper, got {list(self.lower)} and {list(self.upper)}")
        return self


class DesignConfig(Strict):
    """What both share: robots that go to goals, and how they avoid others.

    Attributes:
        gain: kp of the goal task [1/s].
        avoidance: by a safety distance, neighbours' velocities ignored (the paper's row).
        prior: what is known of a goal at first [m].
        dt, duration: sampling time, and how long is observed [s].
        seed: of everything random.
    """

    kind: str
    title: Text
    gain: Positive
    avoidance: AvoidanceConfig
    prior: BoxConfig
    dt: Positive
    duration: Positive
    seed: WholeNumber

    @property
    def steps(self) -> int:
        return round(self.duration / self.dt)

    @property
    def safety_distance(self) -> float:
        assert self.avoidance.safety_distance is not None
        return self.avoidance.safety_distance

    @model_validator(mode="after")
    def _can_be_run(self) -> DesignConfig:
        if not 1 <= self.duration / self.dt <= MAX_STEPS:
            raise wrong(f"expected 1 to {MAX_STEPS} steps of dt = {self.dt} s, got {self.duration} s", "duration")
        if self.avoidance.margin is not None or self.avoidance.safety_distances:
            raise wrong("bodies have no names and no radius here: give one safety_distance", "avoidance")
        if self.avoidance.neighbour_velocity != "none":
            raise wrong("expected none", "avoidance.neighbour_velocity")
        return self


class GoalsConfig(Strict):
    """Numbers of goals drawn: to search with, to choose among what was found, and to report."""

    train: Several
    validation: Count
    test: Count


class SearchConfig(Strict):
    """A search of `starts` x `steps` placements, whatever the method.

    Attributes:
        starts: that the gradient follows at a time, and a generation of the cross-entropy method.
        steps: of the gradient, and generations.
        spread: standard deviation of the starts about the predicted path [m].
        learning_rate: of Adam [m].
        objective: whose mean over goals Adam minimises. The others, and all selection, minimise the mean area.
        elite: share of a generation that the next one is drawn from.
        finalists: placements of each method that are compared on the validation goals.
    """

    starts: Several = 32
    steps: Count = 12
    spread: Positive
    learning_rate: Positive
    objective: Literal["area", "log_area"]
    elite: Annotated[Number, Field(gt=0, le=1)] = 0.25
    finalists: Count = 16


class GradientCheckConfig(Strict):
    """Gradients of the mean over goals, against central differences.

    Attributes:
        horizons: numbers of samples after which the area is taken.
        placements, goals: over how many it is averaged. step: of the differences [m].
    """

    horizons: Annotated[tuple[Count, ...], Field(min_length=1)]
    placements: Count
    goals: Several
    step: Positive


class ProbePlacementConfig(DesignConfig):
    """Where to put a probing obstacle so that the set of possible goals shrinks most.

    Attributes:
        start: of the robot [m]. obstacles: of the corridor [m].
        scenes: corridors in which it is tried, each with obstacles moved by at most `jitter` [m] along each axis.
        way_points: numbers of way-points, 1 (a probe that stands still) among them.
        room: where way-points may be [m].
        set, active_tolerance [m/s], velocity_noise [m/s]: of the observer; the last for `inverse_optimal`.
        landscape: columns and rows of the grid of places.
    """

    kind: Literal["probe_placement"]
    start: PlanarVector
    obstacles: Annotated[tuple[PlanarVector, ...], Field(min_length=2)]
    scenes: Count
    jitter: NonNegative
    way_points: Annotated[tuple[Count, ...], Field(min_length=1)]
    room: BoxConfig
    set: Literal["critical_region", "inverse_optimal"]
    active_tolerance: Positive = 1e-3
    velocity_noise: NonNegative = 1e-2
    goals: GoalsConfig
    search: SearchConfig
    landscape: tuple[Several, Several]
    gradient_check: GradientCheckConfig

    @model_validator(mode="after")
    def _fits(self) -> ProbePlacementConfig:
        if len(set(self.way_points)) < len(self.way_points):
            raise wrong(f"expected different numbers, got {list(self.way_points)}", "way_points")
        if 1 not in self.way_points:
            raise wrong("expected 1 among them: the landscape is that of a probe that stands still", "way_points")
        if self.search.finalists > self.search.starts * self.search.steps:
            raise wrong("more than there are placements", "search.finalists")
        if max(self.gradient_check.horizons) > self.steps:
            raise wrong(f"a run has {self.steps} samples", "gradient_check.horizons")
        return self


class TeamsConfig(Strict):
    """Numbers of teams: to train on, to choose when to stop and to tune by hand, and to compare on."""

    train: Count
    validation: Count
    test: Count


class TrainingConfig(Strict):
    """How a gain is trained.

    Attributes:
        epochs: passes over the training teams. learning_rate: of Adam.
        hidden: units of the network's layer.
    """

    epochs: Count
    learning_rate: Positive
    hidden: Count


class LearnedObserverConfig(DesignConfig):
    """A point-wise adaptive observer whose gain is trained, compared with others on teams it has not seen.

    Attributes:
        team: what teams are drawn from. teams: how many.
        noise: bounds of the disturbance of the executed velocities [m/s], in training. unseen_noise: in the comparison.
        gains: constant gains Gamma kp^2 from which the hand-tuned one is taken. pulls: likewise constant pulls.
        times: at which errors are reported [s].
        active_tolerance: distance to its boundary below which a row counts as active, beyond the noise [m/s].
    """

    kind: Literal["learned_observer"]
    team: TeamConfig
    teams: TeamsConfig
    noise: Annotated[tuple[Positive, ...], Field(min_length=1)]
    unseen_noise: Annotated[tuple[Positive, ...], Field(min_length=1)]
    gains: Annotated[tuple[Positive, ...], Field(min_length=1)]
    pulls: Annotated[tuple[Annotated[Positive, Field(lt=1)], ...], Field(min_length=1)]
    training: TrainingConfig
    times: Annotated[tuple[NonNegative, ...], Field(min_length=1)]
    active_tolerance: Positive = 1e-3
    ukf: UkfConfig = UkfConfig()

    @model_validator(mode="after")
    def _is_comparable(self) -> LearnedObserverConfig:
        if self.team.robots[0] != self.team.robots[1] or self.team.obstacles[0] != self.team.obstacles[1]:
            raise wrong("teams are run as one batch: expected one number", "team.robots, team.obstacles")
        if any(t > self.duration for t in self.times):
            raise wrong(f"must not be after the end, {self.duration} s", "times")
        return self
