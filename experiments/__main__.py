"""The command line: `python -m experiments run CONFIG --out DIR`, `python -m experiments figures DIR`.

Everything is validated before PyTorch is loaded and before anything is written: a mistake costs one clear line on
stderr and exit code 2.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from experiments.config import load_experiment
from torchfsid.errors import ConfigError, FsidError

if TYPE_CHECKING:
    from torchfsid.measurement import Measurement

USAGE_ERROR, INTERRUPTED = 2, 130

TABLE_WIDTH = 100
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
    run.add_argument("config", type=Path, metavar="CONFIG", help="YAML, see configs/")
    run.add_argument("--out", type=Path, required=True, metavar="DIR", help="results folder")
    run.add_argument("--set", action="append", default=[], metavar="A.B=VALUE", help="override a key of the config")
    figures = commands.add_parser("figures", help="draw the figures of a results folder again")
    figures.add_argument("folder", type=Path, metavar="DIR", help="results folder of a run")
    chosen = parser.parse_args(arguments)
    try:
        if chosen.command == "run":
            _run(chosen.config, chosen.out, chosen.set)
        else:
            _draw(chosen.folder)
    except FsidError as error:
        print(f"experiments: {error}", file=sys.stderr)
        return USAGE_ERROR
    except OSError as error:
        print(f"experiments: {error.filename}: {error.strerror}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print("experiments: interrupted", file=sys.stderr)
        return INTERRUPTED
    return 0


def _run(path: Path, out: Path, overrides: Sequence[str]) -> None:
    config = load_experiment(path, overrides)
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out: {out} is not a folder")

    import torch
    from rich.console import Console
    from rich.progress import track

    from experiments.run import run
    from experiments.table import print_table
    from experiments.verdict import print_verdict

    torch.set_num_threads(1)  # small tensors: more threads only wait for each other
    progress = Console(stderr=True)

    def observing(measurements: Iterable[Measurement], samples: int) -> Iterable[Measurement]:
        return track(measurements, "Observing", total=samples, console=progress)

    summary = run(config, out, observing)
    _draw(out)
    console = Console(width=max(Console().width, TABLE_WIDTH))
    (print_table if config.kind == "cases" else print_verdict)(summary, console)


def _draw(folder: Path) -> None:
    from rich.console import Console

    from experiments.figures import draw

    with Console(stderr=True).status("Drawing"):
        draw(folder)


if __name__ == "__main__":
    sys.exit(main())
