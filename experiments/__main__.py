"""The command line: `python -m experiments run CONFIG --out DIR`, `... sweep ...`, `... design ...`, `... figures DIR`.

Everything is validated before PyTorch is loaded and before anything is written: a mistake costs one clear line on
stderr and exit code 2.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from experiments.design.config import load_design
from experiments.runs.config import load_experiment
from experiments.sweeps.config import load_sweep
from torchfsid.errors import ConfigError, FsidError

if TYPE_CHECKING:
    from torchfsid.robots.measurement import Measurement

USAGE_ERROR, INTERRUPTED = 2, 130

TABLE_WIDTH, SWEEP_WIDTH = 100, 130
"""Columns that the tables need; a narrower terminal wraps them."""


class _Parser(argparse.ArgumentParser):
    """Mistakes are answered by one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(USAGE_ERROR, f"{self.prog}: {message}\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = _Parser(prog="experiments", description="The paper's experiments: results first, figures from them.")
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="run an experiment and draw its figures")
    sweep = commands.add_parser("sweep", help="finish a sweep: run what is not in its folder yet, and draw its figures")
    design = commands.add_parser("design", help="design an observer by gradient, and compare it with others")
    for command in (run, sweep, design):
        command.add_argument("config", type=Path, metavar="CONFIG", help="YAML, see configs/")
        command.add_argument("--out", type=Path, required=True, metavar="DIR", help="results folder")
        command.add_argument("--set", action="append", default=[], metavar="A.B=VALUE", help="override a key")
    where = sweep.add_mutually_exclusive_group()
    where.add_argument("--jobs", type=_jobs, default=1, metavar="N", help="processes; -1: one per core (default: 1)")
    where.add_argument("--dask", metavar="ADDRESS", help="run on a Dask cluster, tcp://HOST:PORT of its scheduler")
    figures = commands.add_parser("figures", help="draw the figures of a results folder again")
    figures.add_argument("folder", type=Path, metavar="DIR", help="results folder of a run")
    chosen = parser.parse_args(arguments)
    try:
        if chosen.command == "run":
            _run(chosen.config, chosen.out, chosen.set)
        elif chosen.command == "sweep":
            _sweep(chosen.config, chosen.out, chosen.set, chosen.jobs, chosen.dask)
        elif chosen.command == "design":
            _design(chosen.config, chosen.out, chosen.set)
        else:
            _draw(chosen.folder)
    except FsidError as error:
        print(f"experiments: {error}", file=sys.stderr)
        return USAGE_ERROR
    except OSError as error:
        print(f"experiments: {error.filename}: {error.strerror}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        again = "; the same command goes on from here" if chosen.command == "sweep" else ""
        print(f"experiments: interrupted{again}", file=sys.stderr)
        return INTERRUPTED
    return 0


def _jobs(text: str) -> int:
    if text != "-1" and not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected a number of processes, or -1, got {text!r}")
    return int(text)


def _require_folder(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out: {out} is not a folder")


def _run(path: Path, out: Path, overrides: Sequence[str]) -> None:
    config = load_experiment(path, overrides)
    _require_folder(out)

    import torch
    from rich.console import Console
    from rich.progress import track

    from experiments.runs.scene import run
    from experiments.runs.swarm import print_swarm
    from experiments.runs.table import print_table
    from experiments.runs.verdict import print_verdict

    torch.set_num_threads(1)  # small tensors: more threads only wait for each other
    progress = Console(stderr=True)

    def observing(measurements: Iterable[Measurement], samples: int) -> Iterable[Measurement]:
        return track(measurements, "Observing", total=samples, console=progress)

    summary = run(config, out, observing)
    _draw(out)
    console = Console(width=max(Console().width, TABLE_WIDTH))
    {"scene": print_verdict, "cases": print_table, "swarm": print_swarm}[config.kind](summary, console)


def _sweep(path: Path, out: Path, overrides: Sequence[str], jobs: int, dask: str | None) -> None:
    config = load_sweep(path, overrides)
    _require_folder(out)

    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from torchfsid.commands.results import write_json

    try:
        from experiments.sweeps.summary import print_sweep, summarise_sweep
        from experiments.sweeps.sweep import sweep
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error}: install torchfsid[experiments]") from error

    def tracked(records: Iterable[Any], total: int, finished: int) -> Iterable[Any]:
        columns = TextColumn("Sweeping"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()
        with Progress(*columns, console=Console(stderr=True), speed_estimate_period=600) as progress:
            task = progress.add_task("", total=total, completed=finished)
            for record in records:
                yield record
                progress.advance(task)

    sweep(config, out, jobs=jobs, dask=dask, track=tracked)
    summary = summarise_sweep(out)
    write_json(out / "summary.json", summary)
    _draw(out)
    print_sweep(summary, Console(width=max(Console().width, SWEEP_WIDTH)))


def _design(path: Path, out: Path, overrides: Sequence[str]) -> None:
    config = load_design(path, overrides)
    _require_folder(out)

    import torch
    from rich.console import Console
    from rich.progress import track

    from experiments.design.run import print_design, run_design

    torch.set_num_threads(1)  # small tensors: more threads only wait for each other
    progress = Console(stderr=True)
    summary = run_design(config, out, lambda items, what, total: track(items, what, total, console=progress))
    _draw(out)
    print_design(summary, Console(width=max(Console().width, TABLE_WIDTH)))


def _draw(folder: Path) -> None:
    from rich.console import Console

    from experiments.figures import draw

    with Console(stderr=True).status("Drawing"):
        draw(folder)


if __name__ == "__main__":
    sys.exit(main())
