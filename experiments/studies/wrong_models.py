"""What an observer reports when its model is wrong. `python -m experiments.studies.wrong_models` prints the table.

Teams of four robots cross a disc with two pillars to random goals, with one joint QP per team (`neighbour_velocity:
current`). Controls are measured with errors of a given size in random directions. Each model is wrong in one thing. A
robot is silent if its status is `ok` but its set does not hold the truth, or the task has no such truth. It must not
end silent. docs/wrong_models.md says when it does, and why that cannot be avoided.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchfsid.commands.declared_log import AUTO_FACTOR
from torchfsid.commands.judged_bound import JudgedBound
from torchfsid.observers.consistency import Consistency
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask, OrbitTask, Saturation, Task, VelocityTask
from torchfsid.sets.feasible_set import FeasibleSet

ROBOTS, DT, STEPS, GAIN = 4, 0.05, 120, 0.8
AVOIDANCE = CollisionAvoidance(ClassK(2.0), safety_distance=0.5, neighbour_velocity="current")
TASK = GoalTask(GAIN)
SATURATED = GoalTask(GAIN, saturation=Saturation("norm", (0.7, 0.7)))
PILLARS = torch.tensor([[0.4, 0.7], [-0.6, -0.4]], dtype=torch.float64)

LEVELS = ((1e-6, 0.0), (0.02, 0.02), (0.02, 0.002))
"""Declared bound and size of the errors [m/s]: exact data, errors as large as declared, a generous bound."""


@dataclass(frozen=True)
class Belief:
    """The model that an observer assumes, and the measurements that it gets.

    Attributes:
        name: name of the table row.
        task: the assumed task.
        barriers: the assumed barriers.
        run: the task that the robots really have.
        seen: function applied to the measurements.
        errors: factor on the size of the errors.
    """

    name: str
    task: Task = TASK
    barriers: Sequence[Barrier] = (AVOIDANCE,)
    run: GoalTask = TASK
    seen: Callable[[list[Measurement]], list[Measurement]] = lambda samples: samples
    errors: float = 1.0


def without_last_pillar(samples: list[Measurement]) -> list[Measurement]:
    """The measurements without the last pillar."""
    visible = torch.arange(ROBOTS + len(PILLARS)) < ROBOTS + len(PILLARS) - 1
    return [replace(sample, present=sample.present & visible) for sample in samples]


def shifted(by: int) -> Callable[[list[Measurement]], list[Measurement]]:
    """Take velocities, the neighbours' included, from this number of samples later."""

    def shift(samples: list[Measurement]) -> list[Measurement]:
        pairs = zip(samples[max(0, -by) :], samples[max(0, by) :], strict=False)
        return [replace(at, u=later.u, body_velocities=later.body_velocities) for at, later in pairs]

    return shift


BELIEFS = (
    Belief("right model"),
    Belief("right model, saturated run", SATURATED, run=SATURATED),
    Belief("neighbour velocity: none", barriers=[replace(AVOIDANCE, neighbour_velocity="none")]),
    Belief("neighbour velocity: previous", barriers=[replace(AVOIDANCE, neighbour_velocity="previous")]),
    Belief("linear task, saturated run", run=SATURATED),
    Belief("gain + 20 %", GoalTask(1.2 * GAIN)),
    Belief("gain - 20 %", GoalTask(0.8 * GAIN)),
    Belief("gain + 5 %", GoalTask(1.05 * GAIN)),
    Belief("gain + 2 %", GoalTask(1.02 * GAIN)),
    Belief("safety distance + 20 %", barriers=[replace(AVOIDANCE, safety_distance=0.6)]),
    Belief("safety distance - 20 %", barriers=[replace(AVOIDANCE, safety_distance=0.4)]),
    Belief("safety distance + 2 %", barriers=[replace(AVOIDANCE, safety_distance=0.51)]),
    Belief("class-K gain x 2", barriers=[replace(AVOIDANCE, class_k=ClassK(4.0))]),
    Belief("class-K gain / 2", barriers=[replace(AVOIDANCE, class_k=ClassK(1.0))]),
    Belief("a pillar is missing", seen=without_last_pillar),
    Belief("errors 10 times too large", errors=10.0),
    Belief("velocities one sample late", seen=shifted(-1)),
    Belief("velocities one sample early", seen=shifted(1)),
    Belief("wrong task: velocity", VelocityTask()),
    Belief("wrong task: orbit", OrbitTask(0.5)),
)


def simulated(task: Task, seeds: int) -> tuple[Trajectory, Tensor]:
    """One team per seed, and the goals of all robots [m]."""
    circles, goals = [], []
    for seed in range(seeds):
        turn, distance, aside = uniform(torch.Generator().manual_seed(seed), (ROBOTS,), (ROBOTS, 1), (ROBOTS, 2))
        circles.append(directions(2 * math.pi * (torch.arange(ROBOTS) + 0.6 * turn) / ROBOTS))
        goals.append(-circles[-1] * (1.6 + 0.6 * distance) + 0.3 * (aside - 0.5))
    controller, goal = CbfQpController(task, [AVOIDANCE]), torch.stack(goals)
    run = simulate(controller, goal, 2.0 * torch.stack(circles), dt=DT, steps=STEPS, obstacles=PILLARS)
    return run, goal.flatten(0, 1)


def measured(run: Trajectory, error: float) -> list[Measurement]:
    """The robots of all teams as one batch, with velocity errors of this size [m/s]."""
    samples, teams, bodies, _ = run.u.shape
    turns = uniform(torch.Generator().manual_seed(teams), *[(samples, bodies)] * teams)
    away = directions(2 * math.pi * torch.stack(turns, dim=1))
    away[..., ROBOTS:, :] = 0.0
    noisy = replace(run, u=run.u + error * away)
    return [noisy.measurement(k).flattened() for k in range(samples)]


def uniform(generator: torch.Generator, *shapes: tuple[int, ...]) -> list[Tensor]:
    """Random numbers between 0 and 1."""
    return [torch.rand(shape, generator=generator, dtype=torch.float64) for shape in shapes]


def directions(angle: Tensor) -> Tensor:
    """Unit vectors."""
    return torch.stack([angle.cos(), angle.sin()], dim=-1)


def ending(belief: Belief, samples: list[Measurement], goals: Tensor, noise: NoiseBound) -> list[str]:
    """Observe all runs with the model of the belief. How many robots end how, as cells of the table.

    `flagged`: the status is not `ok`. `ok, inside`, `ok, outside`: it is `ok` and the truth is in the set, or outside
    of it. `strained`: it is `ok` and needs more than half of the bound, and how many of these are silent. `away`: the
    largest distance of a truth outside from its set [m]. `silent for`: the longest time for which a status was `ok`
    with the truth outside [s].
    """
    observer = SetMembershipObserver(belief.task, belief.barriers, prior(goals), noise=noise)
    has_truth = isinstance(belief.task, GoalTask)
    steps = torch.zeros(len(goals))
    for sample in samples:
        observer.update(sample)
        steps += (observer.status == Status.OK) & ~(observer.feasible_set.contains(goals) & has_truth)
    ok = observer.status == Status.OK
    silent = ok & ~(observer.feasible_set.contains(goals) & has_truth)
    away = torch.where(silent, (observer.feasible_set.project(goals) - goals).norm(dim=-1), 0.0)
    consistency = Consistency(samples, belief.task, belief.barriers, prior(goals), others=noise)
    relaxed = consistency.sets(torch.as_tensor(noise.velocity).expand(len(goals)) / 2).fits
    counted = (~ok, ok & ~silent, silent, ok & ~relaxed, silent & ~relaxed)
    flagged, right, outside, strained, strained_silent = (str(int(robots.sum())) for robots in counted)
    farthest = f"{float(away.max()):.2g}" if silent.any() else ""
    return [flagged, right, outside, f"{strained} ({strained_silent})", farthest, f"{DT * float(steps.max()):.3g}"]


def prior(goals: Tensor) -> FeasibleSet:
    """The prior set of each robot."""
    reach = torch.full_like(goals, 6.0)
    return FeasibleSet.from_box(-reach, reach)


def automatic(belief: Belief, samples: list[Measurement], goals: Tensor, neighbour_velocity: float) -> NoiseBound:
    """The bounds that `velocity: auto` takes, one per run for all its robots."""
    consistency = Consistency(
        samples,
        belief.task,
        belief.barriers,
        prior(goals),
        others=NoiseBound(0.0, neighbour_velocity=neighbour_velocity),
    )
    smallest = consistency.smallest_bounds(consistency.fastest).unflatten(0, (-1, ROBOTS)).amax(-1)
    # Without such a bound the command ends with an error, which is as good as a flag: take a bound that is refuted.
    smallest = torch.where(smallest.isfinite(), smallest, 0.0)
    return NoiseBound(AUTO_FACTOR * smallest.repeat_interleave(ROBOTS), neighbour_velocity=neighbour_velocity)


def useless(samples: list[Measurement], noise: NoiseBound) -> int:
    """The number of robots in runs whose bound is useless, see `JudgedBound`."""
    controls = torch.stack([sample.u for sample in samples if sample.u is not None])
    sizes = controls.norm(dim=-1).unflatten(1, (-1, ROBOTS)).transpose(0, 1).flatten(1)
    bounds = torch.as_tensor(noise.velocity)[::ROBOTS].tolist()
    judged = [JudgedBound.of(bound, run.numpy()) for bound, run in zip(bounds, sizes, strict=True)]
    return ROBOTS * sum(of_run.is_useless for of_run in judged)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and print the table."""
    parser = argparse.ArgumentParser(prog="python -m experiments.studies.wrong_models")
    parser.add_argument("--seeds", type=int, default=12, help="runs per model and bound")
    parser.add_argument("--auto", action="store_true", help="take the bound that velocity: auto would")
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    runs = {task: simulated(task, chosen.seeds) for task in (TASK, SATURATED)}
    heads = "model", "bound", "errors", "flagged", "ok, inside", "ok, outside", "strained", "away", "silent for"
    heads = (*heads, "useless") if chosen.auto else heads
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for belief in BELIEFS:
        trajectory, goals = runs[belief.run]
        for bound, size in LEVELS:
            errors = belief.errors * size if size else (belief.errors - 1.0) * bound
            samples = belief.seen(measured(trajectory, errors))
            declared = NoiseBound(bound, neighbour_velocity=bound)
            label = f"{bound:g}"
            if chosen.auto:
                declared = automatic(belief, samples, goals, bound)
                label = f"{float(torch.as_tensor(declared.velocity).median()):.2g}"
            cells = [belief.name, label, f"{errors:g}", *ending(belief, samples, goals, declared)]
            cells += [str(useless(samples, declared))] if chosen.auto else []
            print(f"| {' | '.join(cells)} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
