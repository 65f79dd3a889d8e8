"""Gain and safety distance learned with the goals. `python -m experiments.studies.safety_parameters` runs the study.

The gain and safety distance of random teams are drawn, and lie at random places in priors. Several parts:

    settings    every form of the barrier with every shape of errors: is a truth lost, and what does it cost in theta?
    shrinking   teams that are logged with several bounds and declared with several priors: how small do sets become?
    odd         one robot of four has another gain. The team has no common parameters, and the robot must be named.

Where errors are a tenth of the bound, a second observer has a prior 100 times wider. docs/safety_parameters.md has the
results. The journal of finished runs and two tables are written first, then the figure.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from experiments.results import Journal, write_rows
from experiments.studies.safety_summary import TARGET, as_markdown, draw_study, tables
from experiments.studies.safety_teams import Form, Prior, Setting, Team, draw, logged
from experiments.sweeps.workers import workers
from torchfsid.commands.results_folder import write_json
from torchfsid.commands.terminal import track
from torchfsid.observers.safety import SafetyObserver
from torchfsid.outcome import Status
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.unknown_avoidance import UnknownAvoidance
from torchfsid.sets.feasible_set import FeasibleSet

Part = Literal["settings", "shrinking", "odd"]

FORMS = tuple(
    Form(rows, power, distance)
    for rows, power, distance in product(("none", "current", "previous"), (1, 3), ("squared", "euclidean"))
)

BOUNDS = (5e-3, 2e-2)
"""Declared bounds of velocities [m/s]."""

SHAPES = ("exact", "uniform", "circle", "fixed", "alternating", "adversarial")

SETTINGS = (
    Setting("exact", 1e-6),
    *(Setting(errors, bound) for bound in BOUNDS for errors in SHAPES),
    *(Setting(errors, 5e-3, 1e-3) for errors in ("tenth", "circle", "adversarial")),
    *(Setting("circle", 2e-2, 5e-3),),
)

ACCURACY = 2
"""Times as many teams where errors are a tenth of the bound, with exact positions."""

WIDER = Prior(100.0 * 100, 4.0 * 100)

SHRINKING = tuple(Form(rows, power, "squared") for rows, power in product(("none", "current"), (1, 3)))
SHRINKING_BOUNDS = (1e-6, 1e-4, 1e-3, 5e-3, 2e-2, 5e-2)
SHRINKING_PRIORS = (Prior(4.0, 2.0), WIDER, Prior(1e6, 64.0))

TIMES = (1.0, 2.0, 4.0)
"""Times at which enclosures are recorded, besides the end [s]."""


@dataclass(frozen=True)
class Run:
    """A team to be drawn, and the ways in which it is observed."""

    part: Part
    form: Form
    observed: tuple[tuple[Setting, Prior], ...]
    factor: float | None = None


def planned(teams: int) -> list[Run]:
    """All runs, with so many teams per form and setting."""
    tenths = [Setting("tenth", bound) for bound in BOUNDS]
    runs = [Run("settings", form, ((s, Prior()),)) for form, s in product(FORMS, SETTINGS) for _ in range(teams)]
    runs += [
        Run("settings", form, ((setting, Prior()), (setting, WIDER)))
        for form, setting in product(FORMS, tenths)
        for _ in range(ACCURACY * teams)
    ]
    variants = [(Setting("tenth", bound), Prior()) for bound in SHRINKING_BOUNDS]
    variants += [(Setting("tenth", 5e-3), prior) for prior in SHRINKING_PRIORS]
    runs += [Run("shrinking", form, tuple(variants)) for form in SHRINKING for _ in range(teams)]
    odd = [Form(rows, power, "squared") for rows, power in product(("none", "previous"), (1, 3))]
    return runs + [
        Run("odd", form, ((Setting("uniform", 5e-3), Prior()),), factor)
        for form, factor in product(odd, (1 / 3, 3.0))
        for _ in range(max(1, 3 * teams // 4))
    ]


def record(run: Run, number: int, seed: int) -> dict[str, Any]:
    """Draw the team, log and observe it. The rows of the two tables."""
    torch.set_num_threads(1)
    team = drawn(run, number, seed)
    sets, robots, shapes = [], [], []
    for variant, (setting, prior) in enumerate(run.observed):
        log = logged(team, setting, np.random.default_rng((seed, number, 1)))
        about = {"run": number, "variant": variant, "part": run.part, **vars(run.form), **vars(setting)}
        about |= {"gain_prior": prior.gain, "distance_prior": prior.distance, "robots": team.robots}
        about |= {"samples": len(log.t), "active": team.active, "infeasible": int((~team.true.feasible).sum())}
        of_sets, of_robots = observed(team, list(log.measurements()), setting, prior)
        corners = [row.pop("corners") for row in of_sets]
        if run.part == "shrinking" and (setting.velocity, prior) == (5e-3, Prior()):
            truth = [float(team.gain[0]), team.distance]
            shapes.append({"robots": team.robots, "power": run.form.power, "truth": truth, "sets": corners})
        sets += [about | row for row in of_sets]
        robots += [about | row for row in of_robots]
    return {"run": number, "sets": sets, "robots": robots, "shapes": shapes}


def drawn(run: Run, number: int, seed: int) -> Team:
    """The team of a run."""
    robots = (4, 4) if run.factor else (2, 5)
    return draw(run.form, np.random.default_rng((seed, number, 0)), robots, run.factor)


def observed(
    team: Team, measurements: list[Measurement], setting: Setting, prior: Prior
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Observe a log. A row per stage, and a row per robot."""
    knowing = team.knowing(setting)
    learner = team.learner(setting, prior)
    begun, stages, marks = perf_counter(), [], list(TIMES)
    for sample in measurements:
        learner.update(sample)
        if marks and sample.time >= marks[0] - 1e-9:
            stages.append(stage(learner, team, f"{marks.pop(0):g} s"))
    streamed, took = learner.feasible_set.diameter(), perf_counter() - begun
    stages.append(stage(learner, team, "streamed") | {"seconds": took})
    begun = perf_counter()
    learner.look_again(measurements)
    stages.append(stage(learner, team, "looked") | {"seconds": perf_counter() - begun})
    begun = perf_counter()
    for sample in measurements:
        knowing.update(sample)
    known, took = knowing.feasible_set.diameter(), perf_counter() - begun
    odd, differs = learner.odd(), team.differs.tolist()
    diameters = zip(*map(Tensor.tolist, (known, streamed, learner.feasible_set.diameter())), strict=True)
    of_robots = [
        {
            "robot": i,
            "reached": "",
            **dict(zip(("known", "streamed", "looked"), of_robot, strict=True)),
            "seconds": took,
        }
        | {"differs": differs[i], "named": i in odd}
        for i, of_robot in enumerate(diameters)
    ]
    return stages, of_robots


def reached(run: Run, number: int, seed: int, variant: int) -> tuple[tuple[int, int], list[float]]:
    """The diameters of Theta that known parameters at the corners of Psi reach together, where they explain the data.

    They bound the diameters for unknown parameters from below.
    """
    torch.set_num_threads(1)
    team, (setting, prior) = drawn(run, number, seed), run.observed[variant]
    measurements = list(logged(team, setting, np.random.default_rng((seed, number, 1))).measurements())
    learner = team.learner(setting, prior)
    for sample in measurements:
        learner.update(sample)
    learner.look_again(measurements)
    corners, unknown = learner.safety.vertices()[0].unique(dim=0), learner.model.unknown
    beta, D = unknown.split(torch.lerp(corners, corners.mean(0), 1e-3))
    vertices = []
    for gain, distance in zip((beta**unknown.power).tolist(), unknown.length(D).tolist(), strict=True):
        guess = replace(team, gain=torch.full_like(team.gain, gain), distance=distance).knowing(setting)
        for sample in measurements:
            guess.update(sample)
        if bool((guess.status == Status.OK).all()):
            vertices.append(guess.feasible_set.vertices())
    together = torch.cat(vertices, dim=-2) if vertices else torch.zeros(team.robots, 1, 2, dtype=torch.float64)
    return (number, variant), torch.cdist(together, together).amax((-1, -2)).tolist()


def of_runs(rows: Sequence[dict[str, Any]]) -> list[tuple[int, int]]:
    """The runs and variants to which the rows belong."""
    return sorted({(row["run"], row["variant"]) for row in rows})


def stage(learner: SafetyObserver, team: Team, name: str) -> dict[str, Any]:
    """Where the observer stands: enclosures of the gain and the safety distance, statuses, and what is lost."""
    unknown, hypotheses = learner.model.unknown, [learner.of_single_robots]
    if learner.is_shared and not bool(team.differs.any()):
        hypotheses.append(learner.possible)
    first = learner.safety.select(torch.zeros(1, dtype=torch.long))
    gain, distance = (ends[0].tolist() for ends in unknown.intervals(first))
    by_data = [bool(ends.all()) for ends in unknown.bounded_by_data(first)]
    goals_held = torch.cat([sets.theta.contains(team.goals) for sets in hypotheses])
    psi_held = torch.cat([sets.psi.select(sets.owner).contains(team.psi) for sets in hypotheses])
    return {
        "stage": name,
        "gain": float(team.gain.median()),
        "safety_distance": team.distance,
        **dict(zip(("gain_low", "gain_high"), gain, strict=True)),
        **dict(zip(("distance_low", "distance_high"), distance, strict=True)),
        **dict(zip(("gain_by_data", "distance_by_data"), by_data, strict=True)),
        "goals_lost": int((~goals_held).sum()),
        "safety_lost": int((~psi_held).sum()),
        "flagged": int((learner.status != Status.OK).sum()),
        "refuted": len(learner.refutations),
        "seconds": 0.0,
        "corners": outline(unknown, first) if learner.is_shared else [],
    }


def outline(unknown: UnknownAvoidance, psi: FeasibleSet, points: int = 20) -> list[list[float]]:
    """The boundary of Psi in the plane of gain and safety distance, where edges are curved."""
    corners = psi.vertices()[0]
    share = torch.linspace(0, 1, points, dtype=torch.float64)[:, None]
    beta, D = unknown.split(torch.lerp(corners[:, None], corners.roll(-1, 0)[:, None], share).flatten(0, 1))
    return torch.stack([beta**unknown.power, unknown.length(D)], dim=-1).tolist()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing of the study, write and print its tables, and draw the figure."""
    parser = argparse.ArgumentParser(prog="python -m experiments.studies.safety_parameters")
    parser.add_argument("--teams", type=int, default=4, help="teams per form of the barrier and setting")
    parser.add_argument("--every", type=int, default=1, help="only every so many of the runs")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument(
        "--out", type=Path, default=Path("results/safety_parameters"), help="folder; runs in it are kept"
    )
    chosen = parser.parse_args(arguments)
    chosen.out.mkdir(parents=True, exist_ok=True)
    runs = dict(list(enumerate(planned(chosen.teams)))[:: chosen.every])
    with Journal(chosen.out / "records.jsonl") as journal, workers(chosen.jobs) as team:
        missing = [number for number in runs if number not in journal.records]
        np.random.default_rng(chosen.seed).shuffle(missing)  # so that all parts progress together
        calls = ((runs[number], number, chosen.seed) for number in missing)
        for done in track(team(record, calls), "Learning", len(runs), len(runs) - len(missing)):
            journal.add([done])
        records = [journal.records[number] for number in runs]
        large = [row for each in records for row in each["robots"] if row["looked"] > TARGET * row["known"]]
        large = [row for row in large if row["part"] != "odd"]
        calls = ((runs[number], number, chosen.seed, variant) for number, variant in of_runs(large))
        found = dict(track(team(reached, calls), "Checking large sets", len(of_runs(large))))
    for row in large:
        row["reached"] = found[row["run"], row["variant"]][row["robot"]]
    for name in ("sets", "robots"):
        write_rows(chosen.out / f"{name}.csv", (row for each in records for row in each[name]))
    shapes = [shape for each in records for shape in each["shapes"]]
    write_json(chosen.out / "shapes.json", shapes)
    summary = dict(tables(chosen.out))
    write_json(chosen.out / "summary.json", summary)
    for title, rows in summary.items():
        print(as_markdown(title, rows))
    draw_study(chosen.out).savefig(chosen.out / "figure.png", dpi=200)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
