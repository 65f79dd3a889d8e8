"""python -m experiments.studies.wrong_safety [--teams 50] [--first 100]

Whom does `torchfsid check` blame if the declared gain or safety distance is wrong? Random teams of 3 or 4 robots that
cross (the paper's rows, or one joint QP), errors of 2 mm/s within a declared bound of 5 mm/s. Each team is declared
eight times: the gain or the distance wrong by +-20 % or +-5 %. The table of docs/safety_parameters.md.
"""

from __future__ import annotations

import argparse
import random
from collections import Counter
from itertools import product

import torch

from torchfsid.commands.check_safety import check_safety
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.terminal import track
from torchfsid.config.documents import validate
from torchfsid.config.observe import ObserveConfig
from torchfsid.logs.log import Log
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance, NeighbourVelocity
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask

ERROR, BOUND, KP = 0.002, 0.005, 0.8
ROWS: list[NeighbourVelocity] = ["none", "current"]


def team(seed: int) -> tuple[Log, float, float, NeighbourVelocity]:
    """The log of a random team, its gain, its safety distance [m] and its rows."""
    chance, generator = random.Random(seed), torch.Generator().manual_seed(seed)
    robots, gain, distance = chance.choice([3, 4]), chance.uniform(1, 4), chance.uniform(0.35, 0.6)
    rows = chance.choice(ROWS)
    angle = 2 * torch.pi * torch.arange(robots) / robots + 0.3 * torch.rand(robots, generator=generator)
    start = 2.2 * torch.stack([angle.cos(), angle.sin()], dim=-1).double()
    goals = -start + 0.3 * torch.randn(robots, 2, generator=generator).double()
    barrier = CollisionAvoidance(ClassK(gain), safety_distance=distance, neighbour_velocity=rows)
    run = simulate(CbfQpController(GoalTask(KP), [barrier]), goals, start, dt=0.05, steps=160)
    turn = 2 * torch.pi * torch.rand(run.u.shape[:2], generator=generator).double()
    u = run.u + ERROR * torch.stack([turn.cos(), turn.sin()], dim=-1)
    seen = torch.ones(run.x.shape[:2], dtype=torch.bool).numpy()
    names = tuple(str(i) for i in range(robots))
    return Log("team", names, run.t.numpy(), run.x.numpy(), u.numpy(), seen, seen), gain, distance, rows


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m experiments.studies.wrong_safety")
    parser.add_argument("--teams", type=int, default=50)
    parser.add_argument("--first", type=int, default=100, help="number of the first team")
    chosen = parser.parse_args(arguments)
    torch.set_grad_enabled(False)
    count: Counter[tuple[str, float, str]] = Counter()
    for seed in track(range(chosen.first, chosen.first + chosen.teams), "Checking", chosen.teams):
        log, gain, distance, rows = team(seed)
        for wrong, factor in product(("gain", "distance"), (1.2, 0.8, 1.05, 0.95)):
            barrier = {
                "kind": "avoidance",
                "neighbour_velocity": rows,
                "safety_distance": distance * (factor if wrong == "distance" else 1),
                "class_k": {"gain": gain * (factor if wrong == "gain" else 1)},
            }
            config = {
                "task": {"kind": "goal", "gain": KP},
                "barriers": [barrier],
                "prior": {"lower": [-6, -6], "upper": [6, 6]},
                "noise": {"velocity": BOUND},
            }
            found = check_safety(DeclaredLog(validate(config, ObserveConfig, "study"), log))
            assert found is not None
            count[wrong, factor, found.verdict] += 1
    print("| wrong | factor | verdict | teams |\n|---|---|---|---|")
    for (wrong, factor, verdict), teams in sorted(count.items()):
        print(f"| {wrong} | {factor:g} | {verdict} | {teams} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
