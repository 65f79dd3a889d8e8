"""Train gains through the projection, and compare them with other observers on new teams and noise.

runs.csv has mean errors by observer, noise and team, over time and at `times`. answers.csv has the outputs of the
trained network with pull, by noise, case and area. summary.json has the differences from plain recursive least squares
with standard errors over teams. All lengths are in metres.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console
from torch import Tensor, nn

from experiments.design.adaptive import AdaptiveObserver, ConstantGain, NetworkGain, RlsGain
from experiments.design.config import LearnedObserverConfig
from experiments.design.rollouts import Rollouts, roll_out
from experiments.kinds import Track
from experiments.results import RowWriter, rows_of, write_rows
from experiments.tables import print_rows
from torchfsid.commands.results_folder import write_json
from torchfsid.identification.kkt import CASES


def learn(config: LearnedObserverConfig, out: Path, track: Track) -> dict[str, Any]:
    """Simulate, train, compare, and return the summary. After an interruption the folder has what was finished."""
    levels = len(config.noise)
    train_seed, validation_seed, test_seed, start_seed = np.random.SeedSequence(config.seed).spawn(4)
    seeds = [*train_seed.spawn(levels), *validation_seed.spawn(levels)]
    counts = [config.teams.train] * levels + [config.teams.validation] * levels
    jobs = list(zip(config.noise * 2, counts, seeds, strict=True))
    seen = [roll_out(config, *job, filters=False) for job in track(jobs, "Simulating", len(jobs))]
    training, validation = seen[:levels], seen[levels:]

    tuned_pull = min(config.pulls, key=lambda a: float(_error(AdaptiveObserver(RlsGain(a)), validation)))
    tuned = min(config.gains, key=lambda share: float(_error(_constant(config, share), validation)))
    torch.manual_seed(int(start_seed.generate_state(1)[0]))
    prior = torch.tensor(config.prior.upper) - torch.tensor(config.prior.lower)
    sizes = config.training.hidden, float(prior.prod()), float(np.median(config.noise))
    networks = {"network": NetworkGain(*sizes, pulls=False), "network with pull": NetworkGain(*sizes, pulls=True)}
    constant = ConstantGain(tuned, config.gain)
    learned = {
        "constant, learned": AdaptiveObserver(constant),
        **{name: AdaptiveObserver(network) for name, network in networks.items()},
    }
    with RowWriter(out / "training.csv") as curves:
        for name, observer in learned.items():
            curves.write(train(name, observer, training, validation, config, track))
    states = {name: {key: value.tolist() for key, value in of.state_dict().items()} for name, of in learned.items()}
    write_json(out / "gains.json", states)
    write_rows(out / "answers.csv", _answers(networks["network with pull"], config))
    observers = {
        "constant": _constant(config, tuned),
        **learned,
        "RLS": AdaptiveObserver(RlsGain()),
        "RLS with pull": AdaptiveObserver(RlsGain(tuned_pull)),
        "constant, not projected": AdaptiveObserver(ConstantGain(tuned, config.gain), projects=False),
        "RLS, not projected": AdaptiveObserver(RlsGain(), projects=False),
    }
    contains, rows = _compare(config, observers, test_seed, out, track)
    return {
        "title": config.title,
        "seed": config.seed,
        "hand-tuned gain times kp^2": tuned,
        "hand-tuned pull": tuned_pull,
        "learned gain times kp^2": float(constant.log_share.detach().exp()),
        "share of samples at which the set holds the truth": contains,
        **summarise(rows, config),
    }


def _compare(
    config: LearnedObserverConfig,
    observers: dict[str, AdaptiveObserver],
    seed: np.random.SeedSequence,
    out: Path,
    track: Track,
) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """Compare on teams and noise that no observer has seen.

    Returns:
        How often the sets held the truth, and the rows of runs.csv.
    """
    jobs = list(zip(config.unseen_noise, seed.spawn(len(config.unseen_noise)), strict=True))
    contains, rows = {}, []
    with RowWriter(out / "runs.csv") as runs, RowWriter(out / "curves.csv") as curves:
        for noise, child in track(jobs, "Comparing", len(jobs)):
            seen = roll_out(config, noise, config.teams.test, child, filters=True)
            contains[str(noise)] = seen.contains
            with torch.no_grad():
                estimates = seen.estimates | {name: of(*_inputs(seen)) for name, of in observers.items()}
            for name, of in estimates.items():
                error = (of - seen.goals).norm(dim=-1)
                at = enumerate(error.mean(1).tolist())
                curves.write({"observer": name, "noise": noise, "t": k * config.dt, "error": e} for k, e in at)
                new = _rows(name, noise, error, config)
                runs.write(new)
                rows += new
    return contains, rows


def train(
    name: str,
    observer: AdaptiveObserver,
    training: Sequence[Rollouts],
    validation: Sequence[Rollouts],
    config: LearnedObserverConfig,
    track: Track,
) -> list[dict[str, Any]]:
    """Minimise the mean error over robots and time by Adam. Keep the epoch that is best on the validation teams.

    Returns:
        One table row per epoch. Epoch 0 is untrained.
    """
    optimiser = torch.optim.Adam(observer.parameters(), lr=config.training.learning_rate)
    best, lowest, rows = copy.deepcopy(observer.state_dict()), float("inf"), []
    for epoch in track(range(config.training.epochs + 1), f"Training: {name}", config.training.epochs + 1):
        with torch.no_grad():
            held_out = float(_error(observer, validation))
        if held_out < lowest:
            best, lowest = copy.deepcopy(observer.state_dict()), held_out
        loss = _error(observer, training)
        rows.append({"gain": name, "epoch": epoch, "training": float(loss.detach()), "validation": held_out})
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    observer.load_state_dict(best)
    return rows


def _constant(config: LearnedObserverConfig, share: float) -> AdaptiveObserver:
    return AdaptiveObserver(ConstantGain(share, config.gain)).requires_grad_(False)


def _inputs(seen: Rollouts) -> tuple[Any, ...]:
    return seen.steps, seen.theta, seen.information


def _error(observer: nn.Module, levels: Sequence[Rollouts]) -> Float[Tensor, ""]:
    """Mean distance to the goal over robots, time and levels of noise [m]."""
    errors = [(observer(*_inputs(seen)) - seen.goals).norm(dim=-1).mean() for seen in levels]
    return torch.stack(errors).mean()


def _rows(name: str, noise: float, error: Float[Tensor, "T B"], config: LearnedObserverConfig) -> list[dict[str, Any]]:
    of_teams = error.reshape(len(error), config.teams.test, -1).mean(-1)
    at = {f"at {t} s": of_teams[min(round(t / config.dt), len(error) - 1)].tolist() for t in config.times}
    columns = {"team": range(config.teams.test), "mean": of_teams.mean(0).tolist(), **at}
    return [{"observer": name, "noise": noise, **row} for row in rows_of(columns)]


def _answers(network: NetworkGain, config: LearnedObserverConfig) -> list[dict[str, Any]]:
    """Distrust, memory and pull, from the area of the prior down to the area at which noise leaves Theta."""
    areas = network.prior_area * torch.logspace(-6, 0, 25, dtype=torch.float64)
    rows = []
    for noise in config.noise:
        for case, letter in enumerate(CASES):
            with torch.no_grad():
                answer = network.answer(areas, torch.full((len(areas),), case), noise)
            said = {name: of.tolist() for name, of in answer._asdict().items()}
            rows += [{"noise": noise, "case": letter, **row} for row in rows_of({"area": areas.tolist(), **said})]
    return rows


def summarise(runs: list[dict[str, Any]], config: LearnedObserverConfig) -> dict[str, Any]:
    """Mean errors by noise and observer, and the paired difference from `RLS` with its standard error over teams."""
    table: dict[str, Any] = {}
    keys = [key for key in runs[0] if key not in ("observer", "noise", "team")]
    for noise in config.unseen_noise:
        of_noise = [row for row in runs if row["noise"] == noise]
        names = list(dict.fromkeys(row["observer"] for row in of_noise))
        errors = {name: np.array([row["mean"] for row in of_noise if row["observer"] == name]) for name in names}
        table[str(noise)] = {
            name: {key: float(np.mean([r[key] for r in of_noise if r["observer"] == name])) for key in keys}
            | _paired(errors[name] - errors["RLS"])
            for name in names
        }
    return {"mean errors by noise [m]": table}


def _paired(difference: np.ndarray) -> dict[str, float]:
    return {"minus RLS": float(difference.mean()), "standard error": float(difference.std() / len(difference) ** 0.5)}


def print_learning(summary: dict[str, Any], console: Console) -> None:
    """Print the summary."""
    for noise, observers in summary["mean errors by noise [m]"].items():
        print_rows(console, f"Mean error in m on unseen teams, disturbance up to {noise} m/s", "observer", observers)
