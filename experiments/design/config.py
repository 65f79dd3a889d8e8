"""The files of `python -m experiments design`: `kind: probe_placement` and `kind: learned_observer`.

Each file is complete. Keys that are left out have the defaults written here. This module does not import torch.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from experiments.runs.config import Count, Text, WholeNumber, require_steps
from experiments.teams import TeamConfig
from torchfsid.config.avoidance import AvoidanceConfig
from torchfsid.config.documents import Strict, wrong
from torchfsid.config.observers import PriorConfig, UkfConfig
from torchfsid.config.quantities import NonNegative, Number, PlanarVector, Positive, known

Several = Annotated[int, Field(strict=True, ge=2)]


class BoxConfig(PriorConfig):
    """A rectangle [m]."""

    lower: PlanarVector
    upper: PlanarVector


class DesignConfig(Strict):
    """The common part: robots that go to goals and avoid bodies.

    Attributes:
        kind: the kind of file.
        title: title of the figures.
        gain: gain kp of the goal task [1/s].
        avoidance: barrier by a safety distance that ignores neighbours' velocities (the paper's row).
        prior: the prior set of a goal [m].
        dt: sampling time [s].
        duration: length of a run [s].
        seed: seed of all random numbers.
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
        """The number of samples of a run."""
        return round(self.duration / self.dt)

    @property
    def safety_distance(self) -> float:
        """The safety distance of the barrier [m]."""
        distance = known(self.avoidance.safety_distance)
        assert distance is not None
        return distance

    @model_validator(mode="after")
    def _can_be_run(self) -> DesignConfig:
        require_steps(self.duration, self.dt)
        if self.avoidance.margin is not None or self.avoidance.safety_distances:
            raise wrong("bodies have no names and no radius here: give one safety_distance", "avoidance")
        if self.avoidance.is_unknown:
            raise wrong("expected numbers, not [low, high]", "avoidance")
        if self.avoidance.neighbour_velocity != "none":
            raise wrong("expected none", "avoidance.neighbour_velocity")
        return self


class NumbersConfig(Strict):
    """How many random goals or teams there are.

    Attributes:
        train: those to search with, or to train on.
        validation: those to choose among finalists, or to stop the training and to tune by hand.
        test: those to report on.
    """

    train: Count
    validation: Count
    test: Count


class SearchConfig(Strict):
    """A search of `starts` x `steps` placements, for every method.

    Attributes:
        starts: placements that the gradient follows at a time, and size of a generation of the cross-entropy method.
        steps: steps of the gradient method, and number of generations.
        spread: standard deviation of the starts about the predicted path [m].
        learning_rate: learning rate of Adam [m].
        objective: quantity whose mean over goals Adam minimises. Other methods and all selections minimise the mean
            area.
        elite: share of a generation from which the next one is drawn.
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
    """A check of the gradients of the mean over goals against central differences.

    Attributes:
        horizons: numbers of samples after which the area is taken.
        placements: number of placements over which the check is averaged.
        goals: number of goals in the mean.
        step: step of the differences [m].
    """

    horizons: Annotated[tuple[Count, ...], Field(min_length=1)]
    placements: Count
    goals: Several
    step: Positive


class ProbePlacementConfig(DesignConfig):
    """Where to put a probing obstacle so that the set of possible goals shrinks most.

    Attributes:
        start: start of the robot [m].
        obstacles: obstacles of the corridor [m].
        scenes: number of corridors in which every method is tried.
        jitter: largest displacement of a corridor's obstacles along each axis [m].
        way_points: numbers of way-points. One of them is 1, a probe that stands still.
        room: box of the allowed way-points [m].
        set: the set that the observer uses.
        active_tolerance: distance to its boundary below which a row counts as active [m/s].
        velocity_noise: velocity bound of the observer, for `inverse_optimal` [m/s].
        goals: numbers of goals.
        search: the search.
        landscape: columns and rows of the grid of places.
        gradient_check: the check of the gradients.
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
    goals: NumbersConfig
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
        if self.goals.train < 2:
            raise wrong("expected several, whose mean is taken", "goals.train")
        if max(self.gradient_check.horizons) > self.steps:
            raise wrong(f"a run has {self.steps} samples", "gradient_check.horizons")
        return self


class TrainingConfig(Strict):
    """How a gain is trained.

    Attributes:
        epochs: passes over the training teams.
        learning_rate: learning rate of Adam.
        hidden: units of the network's hidden layer.
    """

    epochs: Count
    learning_rate: Positive
    hidden: Count


class LearnedObserverConfig(DesignConfig):
    """A point-wise adaptive observer with a trained gain, compared with others on new teams.

    Attributes:
        team: what teams are drawn from.
        teams: numbers of teams.
        noise: bounds of the disturbance of the executed velocities in training [m/s].
        unseen_noise: bounds of the disturbance in the comparison [m/s].
        gains: constant gains Gamma kp^2 from which the hand-tuned one is chosen.
        pulls: constant pulls from which the hand-tuned one is chosen.
        training: how the gains are trained.
        times: times at which errors are reported [s].
        active_tolerance: distance to its boundary, beyond the noise, below which a row counts as active [m/s].
        ukf: the filter to compare with.
    """

    kind: Literal["learned_observer"]
    team: TeamConfig
    teams: NumbersConfig
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
