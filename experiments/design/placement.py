"""Place probes in many corridors by every method, and record the results.

runs.csv has the mean area over the test goals, the number of simulations (one placement with one goal) and the seconds.
landscape.csv has the mean area over the validation goals for a still probe on a grid of places.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from experiments.design.config import ProbePlacementConfig
from experiments.design.probe import Probing, along
from experiments.design.search import METHODS, Evaluated, Search, choose
from experiments.kinds import Track
from experiments.results import RowWriter, write_rows
from experiments.studies.gradients import across, check_gradients, nothing_to_follow, summarise_switches
from experiments.tables import print_rows
from torchfsid.commands.results_folder import write_json
from torchfsid.observers.set_membership import SetMembershipObserver

SHOWN = ("random", "adam")
"""The methods whose choices are replayed."""


def place(config: ProbePlacementConfig, out: Path, track: Track) -> dict[str, Any]:
    """Search, compare, and return the summary. After an interruption the folder has what was finished."""
    checking, *seeds, drawing = np.random.SeedSequence(config.seed).spawn(2 + config.scenes)
    corridors = [_Corridor(config, seed) for seed in seeds]
    rows: list[dict[str, Any]] = []
    # A grid is for one way-point only: its size grows with the power 2 K.
    methods = {K: [name for name in METHODS if name != "grid" or K == 1] for K in config.way_points}
    jobs = [(i, K, method) for i in range(len(corridors)) for K in config.way_points for method in methods[K]]
    with RowWriter(out / "runs.csv") as runs:
        for i, K, method in track(jobs, "Searching", len(jobs)):
            new = [{"corridor": i, "way_points": K, **row} for row in corridors[i].compare(K, method)]
            runs.write(new)
            write_json(out / "placements.json", [corridor.record() for corridor in corridors if corridor.chosen])
            rows += new

    first = corridors[0]
    write_rows(out / "descent.csv", first.descent)
    write_rows(out / "landscape.csv", first.landscape(track))
    replay = first.replay()
    write_json(out / "replay.json", replay)
    switches = across(first.probing, first.chosen[1]["adam"][0, 0], torch.tensor(replay["goal"], dtype=torch.float64))
    write_rows(out / "switches.csv", switches)
    checks = check_gradients(config, checking, track)
    write_rows(out / "gradient_check.csv", checks)
    nothing = nothing_to_follow(config, drawing)
    write_rows(out / "no_gradient.csv", nothing)
    summary = {"title": config.title, "seed": config.seed, "set": config.set} | summarise(rows, checks)
    return summary | {"no gradient": nothing, "where active sets switch": summarise_switches(switches)}


class _Corridor:
    """One corridor, its goals, and the placements chosen for it."""

    def __init__(self, config: ProbePlacementConfig, seed: np.random.SeedSequence):
        moving, drawing, self._searching = seed.spawn(3)
        shift = np.random.default_rng(moving).uniform(-config.jitter, config.jitter, (len(config.obstacles), 2))
        self.config, self.probing = config, Probing.of(config, torch.from_numpy(shift))
        counts = (config.goals.train, config.goals.validation, config.goals.test)
        states = drawing.generate_state(3).tolist()
        self.train, self.validation, self.test = map(self.probing.draw_goals, counts, states)
        self.chosen: dict[int, dict[str, Tensor]] = {}
        self.descent: list[dict[str, Any]] = []

    def compare(self, K: int, method: str) -> list[dict[str, Any]]:
        """The table rows of a method. `random` also gives those of no probe and of a single random placement."""
        started = time.perf_counter()
        # Every method has the same random numbers: the same starts, the same random places.
        seed = np.random.SeedSequence(self._searching.entropy, spawn_key=(*self._searching.spawn_key, K))
        search = Search.of(self.probing, self.config.search, self.train, K, seed)
        found = METHODS[method](search)
        chosen = choose(search, found, self.validation)
        seconds = time.perf_counter() - started
        self.chosen.setdefault(K, {})[method] = chosen
        if method == "adam" and K == 1:
            self.descent += _descent(found)
        simulations = sum(map(len, found.means)) * self.config.goals.train
        simulations += self.config.search.finalists * self.config.goals.validation
        rows = [self._judge(method, chosen, simulations, seconds)]
        if method == "random":
            several = torch.cat(found.placements)[: self.config.search.finalists]
            rows += [self._judge("none", None, 0, 0.0), self._judge("one_random", several, 0, 0.0)]
        return rows

    def _judge(self, method: str, placements: Tensor | None, simulations: int, seconds: float) -> dict[str, Any]:
        with torch.no_grad():
            left = self.probing.left(placements, self.test)
        return {
            "method": method,
            "mean_area": float(left.area.mean()),
            "geometric_mean_area": float(left.area.log().mean().exp()),
            "sound": float(left.sound.double().mean()),
            "simulations": simulations,
            "seconds": seconds,
        }

    def landscape(self, track: Track) -> list[dict[str, Any]]:
        """Mean areas of a still probe on the grid. Places that are not allowed have no area."""
        places = self.probing.grid(*self.config.landscape)
        allowed = (places - self.probing.start).norm(dim=-1) >= self.config.safety_distance
        means = torch.full((len(places),), torch.nan, dtype=torch.float64)
        chunks = allowed.nonzero().flatten().split(self.config.search.starts)
        for items in track(chunks, "Landscape", len(chunks)):
            with torch.no_grad():
                means[items] = self.probing.left(places[items].unsqueeze(1), self.validation).area.mean(-1)
        rows = zip(places.tolist(), means.tolist(), strict=True)
        return [{"x": x, "y": y, "mean_area": "" if mean != mean else mean} for (x, y), mean in rows]

    def record(self) -> dict[str, Any]:
        chosen = {
            str(K): {name: placement[0].tolist() for name, placement in of.items()} for K, of in self.chosen.items()
        }
        return {"obstacles": self.probing.obstacles.tolist(), "chosen": chosen}

    def replay(self) -> dict[str, Any]:
        """The runs with one goal: the one whose area is the median with Adam's probe of the most way-points."""
        K = max(self.chosen)
        with torch.no_grad():
            areas = self.probing.left(self.chosen[K]["adam"], self.test).area[0]
        goal = self.test[areas.argsort()[len(areas) // 2]].unsqueeze(0)
        shown = [("none", 0, None)]
        shown += [(method, K, of[method]) for K, of in self.chosen.items() for method in SHOWN]
        runs = [{"method": method, "way_points": K, **self._replay(at, goal)} for method, K, at in shown]
        return {"goal": goal[0].tolist(), "obstacles": self.probing.obstacles.tolist(), "runs": runs}

    def _replay(self, placement: Tensor | None, goal: Tensor) -> dict[str, Any]:
        samples, model = [], self.probing.model
        observer = SetMembershipObserver(
            model.task, model.barriers, self.probing.prior_of(1), model.kind, model.noise, model.active_tolerance
        )
        with torch.no_grad():
            for k, sample in enumerate(self.probing.loop(placement, goal)):
                estimate = observer.update(sample.measurement)
                theta_set, kkt = estimate.feasible_set, estimate.kkt
                share = k / max(self.config.steps - 1, 1)
                samples.append(
                    {
                        "t": sample.measurement.t,
                        "x": sample.measurement.x[0].tolist(),
                        "probe": None if placement is None else along(placement, share)[0].tolist(),
                        "active": kkt.active[0].nonzero().flatten().tolist(),
                        "vertices": theta_set.vertices()[0].tolist(),
                        "area": float(theta_set.volume()[0]),
                    }
                )
        return {"way_point_places": None if placement is None else placement[0].tolist(), "samples": samples}


def _descent(found: Evaluated) -> list[dict[str, Any]]:
    screened = len(found.means) - len(found.starts)
    batches = zip(found.starts, found.placements[screened:], found.means[screened:], strict=True)
    return [
        {"step": step, "start": i, "x": x, "y": y, "mean_area": mean}
        for step, (starts, placements, means) in enumerate(batches)
        for i, ((x, y),), mean in zip(starts.tolist(), placements.tolist(), means.tolist(), strict=True)
    ]


def summarise(runs: list[dict[str, Any]], checks: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over corridors, and every method against one random placement and the best of equally many."""
    table: dict[str, Any] = {}
    for K in dict.fromkeys(row["way_points"] for row in runs):
        of_K = [row for row in runs if row["way_points"] == K]
        areas = {
            name: np.array([row["mean_area"] for row in of_K if row["method"] == name])
            for name in dict.fromkeys(row["method"] for row in of_K)
        }
        table[str(K)] = {
            name: {
                "mean area": float(of.mean()),
                "standard error": float(of.std() / len(of) ** 0.5),
                "one random / this": float(areas["one_random"].mean() / of.mean()),
                "this / best of random": float(of.mean() / areas["random"].mean()),
                "not above best of random": int((of <= areas["random"]).sum()),
                "least share of goals that count": min(r["sound"] for r in of_K if r["method"] == name),
                "simulations": max(r["simulations"] for r in of_K if r["method"] == name),
                "seconds": float(np.mean([r["seconds"] for r in of_K if r["method"] == name])),
            }
            for name, of in areas.items()
        }
    cosines = {
        f"{row['objective']}, {row['horizon']} samples, {row['way_points']} way-points": row["cosine"] for row in checks
    }
    return {"corridors": len({row["corridor"] for row in runs}), "areas [m^2]": table, "gradient cosines": cosines}


def print_placement(summary: dict[str, Any], console: Console) -> None:
    """Print the summary."""
    for K, methods in summary["areas [m^2]"].items():
        still = "a probe that stands still" if K == "1" else f"a path of {K} way-points"
        print_rows(console, f"Mean area left, {still}, {summary['corridors']} corridors", "method", methods)
    cosines = {name: {"cosine": value} for name, value in summary["gradient cosines"].items()}
    print_rows(console, "Gradient of the mean over goals against central differences", "", cosines)
