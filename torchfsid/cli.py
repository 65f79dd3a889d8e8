"""The command line: `torchfsid observe LOG --config CONFIG --out DIR`, `torchfsid check LOG --config CONFIG`.

Everything is validated before PyTorch is loaded and before anything is written: a wrong configuration or log costs a
moment, one clear line on stderr, and exit code 2.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from torchfsid.config.models import load_models
from torchfsid.errors import FsidError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from torchfsid.commands.check import Check
    from torchfsid.commands.hypotheses import Hypotheses, HypothesisVerdict
    from torchfsid.commands.observe import Observation

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
    check = commands.add_parser("check", help="does a log fit its declared model?")
    for command in (observe, check):
        command.add_argument(
            "log", type=Path, metavar="LOG", help="CSV or Parquet: t, robot, x, y[, vx, vy][, radius]; or a ROS 2 bag"
        )
        command.add_argument("--config", type=Path, required=True, help="YAML: task, barriers, prior, noise, ...")
        command.add_argument(
            "--set", action="append", default=[], metavar="A.B=VALUE", help="override a key of the config"
        )
    observe.add_argument("--out", type=Path, required=True, help="results folder")
    check.add_argument("--out", type=Path, help="folder for check.json")
    chosen = parser.parse_args(arguments)
    run = {"observe": _observe, "check": _check}[chosen.command]
    try:
        run(chosen.log, chosen.config, chosen.out, chosen.set)
    except FsidError as error:
        print(f"torchfsid: {error}", file=sys.stderr)
        return USAGE_ERROR
    except OSError as error:
        print(f"torchfsid: {error.filename}: {error.strerror}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        done = "" if chosen.out is None else f"; what is done so far is in {chosen.out}"
        print(f"torchfsid: interrupted{done}", file=sys.stderr)
        return INTERRUPTED
    return 0


def _observe(log: Path, config: Path, out: Path, overrides: Sequence[str]) -> None:
    models = load_models(config, overrides)

    import torch
    from rich.progress import track

    from torchfsid.commands.hypotheses import Hypotheses
    from torchfsid.commands.observe import Observation
    from torchfsid.logs.read import read_log

    torch.set_num_threads(1)  # small tensors: more threads only wait for each other
    first = next(iter(models.values()))
    recorded = read_log(log, first.bag)
    run = Observation(first, recorded) if len(models) == 1 else Hypotheses(models, recorded)
    for _ in track(run.run(out), "Observing", total=run.samples, console=_console(stderr=True)):
        pass
    if isinstance(run, Observation):
        _print_verdicts(run, out)
    else:
        _print_hypotheses(run, out)


def _check(log: Path, config: Path, out: Path | None, overrides: Sequence[str]) -> None:
    models = load_models(config, overrides)

    import torch

    from torchfsid.commands.check import check
    from torchfsid.commands.results import write_json
    from torchfsid.commands.scene import Scene
    from torchfsid.logs.read import read_log

    torch.set_num_threads(1)
    for name, model in models.items():
        found = check(Scene(model, read_log(log, model.bag)))
        if out is not None:
            (out / name).mkdir(parents=True, exist_ok=True)
            write_json(out / name / "check.json", found.to_json())
        if name:
            _console().print(f"[bold]{name}[/]")
        _print_check(found)


def _print_hypotheses(hypotheses: Hypotheses, out: Path) -> None:
    from rich.markup import escape

    names = list(hypotheses.observations)
    table = _table("which task is it?", ["robot", *names, "left"])
    for robot, verdicts in hypotheses.verdicts().items():
        cells, left = [], []
        for name in names:
            verdict = verdicts.get(name)
            if verdict is None:
                cells.append("-")
            elif verdict.refuted_at is not None:
                cells.append(f"refuted at {verdict.refuted_at:g} s by {' / '.join(_rows(verdict))}")
            else:
                left.append(name)
                alarm = "" if verdict.status == "ok" else f", [bold red]{verdict.status}[/]"
                cells.append(f"possible, volume {verdict.volume:.3g}{alarm}")
        table.add_row(escape(robot), *cells, ", ".join(left) or "[bold red]none[/]")
    console = _console()
    console.print(table)
    _print_bound(console, hypotheses.smallest_bounds, hypotheses.velocity_bound)
    console.print(f"Results: {out}/hypotheses.json, and a folder for each of {', '.join(names)}")


def _rows(verdict: HypothesisVerdict) -> list[str]:
    """The rows of the evidence, each once."""
    from rich.markup import escape

    return [escape(row) for row in dict.fromkeys(row for _, row in verdict.evidence)]


def _print_bound(console: Console, smallest: Mapping[str, float] | None, used: float) -> None:
    from rich.markup import escape

    if smallest is not None:
        robot = max(smallest, key=lambda robot: smallest[robot])
        console.print(
            escape(f"noise.velocity: auto found {smallest[robot]:.3g} m/s (robot {robot}), takes {used:.3g} m/s")
        )


def _print_check(found: Check) -> None:
    from rich.markup import escape

    robots = _table("smallest velocity bound and residuals [m/s]", ["robot"])
    for heading in ("bound", "median", "p95", "max", "at", "samples"):
        robots.add_column(heading, justify="right")
    faults = _table(f"at odds with the declared bounds, velocity {found.declared:.3g} m/s", ["robot", "what", "row"])
    for heading in ("samples", "first", "worst [m/s]"):
        faults.add_column(heading, justify="right")
    for robot in found.robots:
        sizes = [f"{size:.3g}" for size in (robot.smallest_bound, robot.median, robot.p95, robot.worst)]
        robots.add_row(escape(robot.robot), *sizes, f"{robot.worst_time:g} s", str(robot.samples))
        for what, listed in (("unexplained", robot.contradictions), ("violated", robot.violations)):
            for fault in listed:
                row = escape(f"{fault.row} (soft)" if fault.soft else fault.row)
                size = [str(fault.samples), f"{fault.first:g} s", f"{fault.worst:.3g}"]
                faults.add_row(escape(robot.robot), what, row, *size)
    console = _console()
    console.print(robots)
    if faults.row_count:
        console.print(faults)
    for conclusion in found.conclusions():
        console.print(f"- {escape(conclusion)}", soft_wrap=True)


def _table(title: str, texts: Sequence[str]) -> Table:
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for heading in texts:
        table.add_column(heading, no_wrap=True)
    return table


def _console(stderr: bool = False) -> Console:
    from rich.console import Console

    console = Console(stderr=stderr)
    if not console.is_terminal:
        console.width = 160  # a file or a pipe has no width of its own
    return console


def _print_verdicts(observation: Observation, out: Path) -> None:
    from rich.markup import escape

    table = _table(f"{len(observation.log.t)} samples, set: {observation.config.set}", ["robot", "cases"])
    for heading in ("skipped", "volume", "diameter", "centroid", "centre", "radius", "shrank last"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("status", no_wrap=True)
    for verdict in observation.verdicts():
        since = verdict.no_information_since
        resets = "".join(f", reset at {t:g} s" for t in verdict.resets)
        table.add_row(
            escape(verdict.robot),
            " ".join(f"{case}:{count}" for case, count in verdict.cases.items() if count),
            str(verdict.skipped),
            f"{verdict.volume:.3g}",
            f"{verdict.diameter:.3g}",
            _vector(verdict.centroid),
            _vector(verdict.centre),
            f"{verdict.radius:.3g}",
            "never" if since is None else f"{since:g} s",
            (verdict.status if verdict.status == "ok" else f"[bold red]{verdict.status}[/]") + resets,
        )
    console = _console()
    console.print(table)
    _print_bound(console, observation.smallest_bounds, observation.velocity_bound)
    if strained := observation.strained():
        console.print(
            f"More than half of noise.velocity, {observation.velocity_bound:g} m/s, is needed by "
            f"{escape(', '.join(strained))}: if the errors are not that large, the model is wrong (torchfsid check)"
        )
    console.print(f"Results: {out}/estimates.csv, regions.json, config.yaml, regions.png, regions.pdf")


def _vector(values: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
