"""The command line: `torchfsid observe LOG --config CONFIG --out DIR`.

Everything is validated before PyTorch is loaded and before anything is written: a wrong configuration or log costs a
moment, one clear line on stderr, and exit code 2.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from torchfsid.config import ObserveConfig
from torchfsid.documents import load
from torchfsid.errors import FsidError

if TYPE_CHECKING:
    from torchfsid.observation import Observation

USAGE_ERROR, INTERRUPTED = 2, 130


class _Parser(argparse.ArgumentParser):
    """Mistakes are answered by one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(USAGE_ERROR, f"{self.prog}: {message}\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = _Parser(
        prog="torchfsid", description="For each robot, the set in which its hidden task parameter must lie."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    observe = commands.add_parser("observe", help="infer the sets of a log's robots")
    observe.add_argument(
        "log", type=Path, metavar="LOG", help="CSV or Parquet: t, robot, x, y[, vx, vy][, radius]; or a ROS 2 bag"
    )
    observe.add_argument("--config", type=Path, required=True, help="YAML: task, barriers, prior, noise, ...")
    observe.add_argument("--out", type=Path, required=True, help="results folder")
    observe.add_argument("--set", action="append", default=[], metavar="A.B=VALUE", help="override a key of the config")
    chosen = parser.parse_args(arguments)
    try:
        _observe(chosen.log, chosen.config, chosen.out, chosen.set)
    except FsidError as error:
        print(f"torchfsid: {error}", file=sys.stderr)
        return USAGE_ERROR
    except OSError as error:
        print(f"torchfsid: {error.filename}: {error.strerror}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print(f"torchfsid: interrupted; the results so far are in {chosen.out}", file=sys.stderr)
        return INTERRUPTED
    return 0


def _observe(log: Path, config: Path, out: Path, overrides: Sequence[str]) -> None:
    model = load(config, ObserveConfig, overrides)

    import torch
    from rich.console import Console
    from rich.progress import track

    from torchfsid.observation import Observation
    from torchfsid.sources import read_log

    torch.set_num_threads(1)  # small tensors: more threads only wait for each other
    observation = Observation(model, read_log(log, model.bag))
    total = len(observation.log.t)
    for _ in track(observation.run(out), "Observing", total=total, console=Console(stderr=True)):
        pass
    _print_verdicts(observation, out)


def _print_verdicts(observation: Observation, out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{len(observation.log.t)} samples, set: {observation.config.set}", title_justify="left")
    for heading in (
        "robot",
        "cases",
        "skipped",
        "volume",
        "diameter",
        "centroid",
        "centre",
        "radius",
        "shrank last",
        "status",
    ):
        table.add_column(heading, justify="left" if heading in ("robot", "cases", "status") else "right", no_wrap=True)
    for verdict in observation.verdicts():
        since = verdict.no_information_since
        table.add_row(
            verdict.robot,
            " ".join(f"{case}:{count}" for case, count in verdict.cases.items() if count),
            str(verdict.skipped),
            f"{verdict.volume:.3g}",
            f"{verdict.diameter:.3g}",
            _vector(verdict.centroid),
            _vector(verdict.centre),
            f"{verdict.radius:.3g}",
            "never" if since is None else f"{since:g} s",
            verdict.status if verdict.status == "ok" else f"[bold red]{verdict.status}[/]",
        )
    console = Console()
    if not console.is_terminal:
        console.width = 160  # a file or a pipe has no width of its own
    console.print(table)
    if observation.smallest_bounds is not None:
        robot, bound = max(observation.smallest_bounds.items(), key=lambda item: item[1])
        used = observation.config.noise.velocity
        console.print(f"noise.velocity: auto found {bound:.3g} m/s (robot {robot}), used: {used:.3g} m/s")
    console.print(f"Results: {out}/estimates.csv, regions.json, config.yaml, regions.png, regions.pdf")


def _vector(values: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
