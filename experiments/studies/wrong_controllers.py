"""What an observer reports when the controller is of another kind, or ORCA's horizon or radii are wrong.

`python -m experiments.studies.wrong_controllers` prints a table of docs/wrong_models.md. Random teams cross, driven by
ORCA, by barrier rows or by barrier rows over accelerations, and are measured exactly. A robot interacts if a row ever
holds it back from its nominal control by more than the declared bound. Only these robots can show that rows are wrong.
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
from torchfsid.robots.barriers import Barrier, SpeedBox
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.orca import Orca
from torchfsid.robots.second_order import SecondOrderAvoidance
from torchfsid.robots.simulation import Trajectory, simulate
from torchfsid.robots.tasks import GoalTask, Saturation
from torchfsid.sets.feasible_set import FeasibleSet

DT, STEPS, GAIN, BOUND = 0.1, 160, 0.7, 1e-5
ROBOTS = (8, 20)
"""A team has from this to that many robots."""

TASK = GoalTask(GAIN, saturation=Saturation("norm", (1.0, 1.0)))
ORCA = Orca(time_horizon=2.0, time_step=DT, max_speed=1.3, count=8, distance=6.0)
CBF = CollisionAvoidance(ClassK(2.0), margin=0.05)
DAMPED = GoalTask(0.6, damping=1.4)
SECOND = (SecondOrderAvoidance((1.5, 2.0), margin=0.05), SpeedBox((2.0, 2.0), quantity="acceleration"))

RUNS: dict[str, tuple[GoalTask, Sequence[Barrier]]]
RUNS = {"ORCA": (TASK, (ORCA,)), "barrier rows": (TASK, (CBF,)), "accelerations": (DAMPED, SECOND)}
"""Tasks and barriers of the robots."""


@dataclass(frozen=True)
class Team:
    """A run, the goals [m] and the task of its robots."""

    run: Trajectory
    goals: Tensor
    task: GoalTask

    @property
    def interacts(self) -> Tensor:
        """The robots that a row holds back from their nominal controls."""
        run = self.run
        held = (run.u - run.nominal).norm(dim=-1) > BOUND
        return (held & run.active.any(-1)).any(0)

    @property
    def gets_free(self) -> Tensor:
        """The robots that are free at some time, with a nominal control that is not clipped."""
        run, limits = self.run, self.task.saturation
        slow = run.nominal.norm(dim=-1) < (math.inf if limits is None else 0.99 * limits.limits[0])
        return (slow & ((run.u - run.nominal).norm(dim=-1) < 1e-9) & ~run.active.any(-1)).any(0)

    @property
    def prior(self) -> FeasibleSet:
        reach = torch.full_like(self.goals, 10.0)
        return FeasibleSet.from_box(-reach, reach)


def as_it_is(sample: Measurement) -> Measurement:
    return sample


def radii(factor: float) -> Callable[[Measurement], Measurement]:
    """Take the radii to be wrong by this factor."""

    def seen(sample: Measurement) -> Measurement:
        assert sample.radius is not None
        assert sample.body_radii is not None
        return replace(sample, radius=factor * sample.radius, body_radii=factor * sample.body_radii)

    return seen


def too_late(sample: Measurement) -> Measurement:
    """Take the velocities of the sample itself for those before it."""
    return replace(sample, velocity=sample.u, previous_body_velocities=sample.body_velocities)


def as_first_order(sample: Measurement) -> Measurement:
    """Take the velocities of robots of second order for their controls."""
    return replace(sample, u=sample.velocity, velocity=None, body_accelerations=None)


@dataclass(frozen=True)
class Belief:
    """The barriers and the task that an observer assumes, and the run that it sees."""

    name: str
    barriers: Sequence[Barrier]
    run: str = "ORCA"
    seen: Callable[[Measurement], Measurement] = as_it_is
    task: GoalTask = TASK


JOINT = replace(CBF, neighbour_velocity="current")
SLOW = GoalTask(0.6 / 1.4)
BELIEFS = (
    Belief("ORCA: right model", [ORCA]),
    Belief("ORCA: time horizon + 20 %", [replace(ORCA, time_horizon=1.2 * ORCA.time_horizon)]),
    Belief("ORCA: time horizon - 20 %", [replace(ORCA, time_horizon=0.8 * ORCA.time_horizon)]),
    Belief("ORCA: radii + 20 %", [ORCA], seen=radii(1.2)),
    Belief("ORCA: radii - 20 %", [ORCA], seen=radii(0.8)),
    Belief("ORCA: velocities of the same sample", [ORCA], seen=too_late),
    Belief("ORCA: barrier rows assumed", [CBF]),
    Belief("ORCA: joint barrier rows assumed", [JOINT]),
    Belief("barrier rows: right model", [CBF], "barrier rows"),
    Belief("barrier rows: ORCA assumed", [ORCA], "barrier rows"),
    Belief("accelerations: right model", SECOND, "accelerations", task=DAMPED),
    Belief("accelerations: single integrators", [CBF], "accelerations", as_first_order, GoalTask(0.6)),
    Belief("accelerations: single integrators, slow", [CBF], "accelerations", as_first_order, SLOW),
    Belief("accelerations: single integrators, joint rows", [JOINT], "accelerations", as_first_order, SLOW),
    Belief("accelerations: no damping", SECOND, "accelerations", task=GoalTask(0.6)),
)


def simulated(kind: str, seed: int) -> Team:
    """A team of `RUNS` that crosses: from a ring to the other side, or to a random place on it."""
    task, barriers = RUNS[kind]
    generator = torch.Generator().manual_seed(seed)
    robots = int(torch.randint(ROBOTS[0], ROBOTS[1] + 1, (), generator=generator))

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    turn = 2 * math.pi * (torch.arange(robots) + 0.4 * uniform(robots)) / robots
    start = max(2.5, 0.22 * robots) * torch.stack([turn.cos(), turn.sin()], dim=-1)
    other = start if seed % 2 else -start[torch.randperm(robots, generator=generator)]
    goals = -other + 0.4 * (uniform(robots, 2) - 0.5)
    radius = 0.15 + 0.15 * uniform(robots)
    velocity = torch.zeros_like(start) if kind == "accelerations" else None
    controller = CbfQpController(task, barriers)
    run = simulate(controller, goals, start, dt=DT, steps=STEPS, radius=radius, velocity=velocity)
    return Team(run, goals, task)


def ending(belief: Belief, team: Team) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Observe a team with the barrier of the belief.

    Returns:
        For each robot whether its status is not `ok`, whether the truth is in its set, and the diameter of this set
        relative to 2 BOUND/GAIN. Then two shares of the samples: those that are not used because the rows may have been
        infeasible, and all that are not used.
    """
    observer = SetMembershipObserver(belief.task, belief.barriers, team.prior, noise=NoiseBound(BOUND))
    relaxed = 0
    for sample in team.run.measurements():
        relaxed += int(observer.update(belief.seen(sample)).evidence.infeasible.sum())
    theta, not_used = observer.feasible_set, torch.tensor([relaxed, int(observer.skipped.sum())])
    diameter, shares = theta.diameter() / (2 * BOUND / belief.task.gain), not_used / (len(team.run.t) * len(team.goals))
    return observer.status != Status.OK, theta.contains(team.goals), diameter, shares


def judged(belief: Belief, team: Team) -> JudgedBound:
    """The bound that `velocity: auto` takes for a team. It is infinite if none explains all of its robots."""
    samples = [belief.seen(sample) for sample in team.run.measurements()]
    consistency = Consistency(samples, belief.task, belief.barriers, team.prior)
    bound = AUTO_FACTOR * float(consistency.smallest_bounds(consistency.fastest).max())
    controls = torch.stack([sample.u for sample in samples if sample.u is not None])
    return JudgedBound.of(bound, controls.norm(dim=-1).flatten().numpy())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(prog="python -m experiments.studies.wrong_controllers")
    parser.add_argument("--teams", type=int, default=12, help="teams of each kind")
    parser.add_argument("--auto", action="store_true", help="judge the bound that velocity: auto would take, too")
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    teams = {kind: [simulated(kind, seed) for seed in range(chosen.teams)] for kind in RUNS}
    heads = ("model", "robots", "interact", "flagged of them", "flagged of others", "ok, outside", "relaxed", "unused")
    heads = (*heads, "diameter") + (("auto: useless or none", "share") if chosen.auto else ())
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for belief in BELIEFS:
        of_run = teams[belief.run]
        *of_robots, shares = zip(*(ending(belief, team) for team in of_run), strict=True)
        flagged, inside, diameter = map(torch.cat, of_robots)
        interacts = torch.cat([team.interacts for team in of_run])
        widths = diameter[torch.cat([team.gets_free for team in of_run]) & ~flagged]
        cells = [
            belief.name,
            f"{len(flagged)}",
            f"{int(interacts.sum())}",
            f"{int((flagged & interacts).sum())}",
            f"{int((flagged & ~interacts).sum())}",
            f"{int((~flagged & ~inside).sum())}",
            *(f"{share:.1%}" for share in torch.stack(shares).mean(0).tolist()),
            f"{float(widths.median()):.3g}, {float(widths.max()):.3g}" if len(widths) else "",
        ]
        if chosen.auto:
            found = [judged(belief, team) for team in of_run]
            least, most = (pick(bound.share for bound in found) for pick in (min, max))
            cells += [f"{sum(bound.is_useless for bound in found)} of {len(found)}", f"{least:.2g}-{most:.2g}"]
        print(f"| {' | '.join(cells)} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
