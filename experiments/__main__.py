"""The command line: `python -m experiments {run, sweep, design} CONFIG --out DIR`,
`python -m experiments {figures, report} DIR`.

Everything is validated before PyTorch is loaded and before anything is written. A mistake gives one line on stderr and
exit code 2.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from torchfsid.commands.command_line import Parser, add_overrides, execute, use_one_thread
from torchfsid.commands.results_folder import ResultsFolder


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code (`torchfsid.commands.command_line` lists them)."""
    parser = Parser(prog="experiments", description="The paper's experiments: results first, figures from them.")
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="run an experiment and draw its figures")
    sweep = commands.add_parser("sweep", help="finish a sweep: run what is not in its folder yet, and draw its figures")
    design = commands.add_parser("design", help="design an observer by gradient, and compare it with others")
    for command in (run, sweep, design):
        command.add_argument("config", type=Path, metavar="CONFIG", help="YAML, see configs/")
        command.add_argument("--out", type=Path, required=True, metavar="DIR", help="results folder")
        add_overrides(command)
    for command in (run, sweep):
        command.add_argument("--report", action="store_true", help="write report.html, too: a page that opens offline")
    where = sweep.add_mutually_exclusive_group()
    where.add_argument("--jobs", type=_jobs, default=1, metavar="N", help="processes; -1: one per core (default: 1)")
    where.add_argument("--dask", metavar="ADDRESS", help="run on a Dask cluster, tcp://HOST:PORT of its scheduler")
    figures = commands.add_parser("figures", help="draw the figures of a results folder again")
    report = commands.add_parser("report", help="write report.html of a results folder: a page that opens offline")
    for command in (figures, report):
        command.add_argument("out", type=Path, metavar="DIR", help="results folder of a run")
    commands.metavar = f"{{{','.join(commands.choices)}}}"  # so that a message about a missing command names them
    chosen = parser.parse_args(arguments)
    folder = ResultsFolder(chosen.out, None)
    left = "what is done so far is in {folder}"
    if chosen.command == "sweep":
        left = "the same command goes on from here"
    action = {"figures": _draw_again, "report": _report}.get(chosen.command, _run)
    return execute("experiments", lambda: action(chosen, folder), folder, left)


def _jobs(text: str) -> int:
    if text != "-1" and not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected a number of processes, or -1, got {text!r}")
    return int(text)


def _run(chosen: argparse.Namespace, folder: ResultsFolder) -> None:
    from experiments.kinds import KINDS, Later, load
    from torchfsid.errors import ConfigError

    config = load(chosen.config, chosen.set, chosen.command)
    kind, folder.kind = KINDS[config.kind], config.kind
    if getattr(chosen, "report", False) and kind.page is None:
        raise ConfigError(f"--report: results of the kind '{config.kind}' have no page, only figures")
    folder.require_ours()

    from experiments.results import names
    from torchfsid.commands.results_folder import write_json
    from torchfsid.commands.terminal import console, track
    from torchfsid.config.documents import dump

    use_one_thread()
    with ExitStack() as stack:
        options: dict[str, Any] = {}
        if chosen.command == "sweep":
            options["team"] = stack.enter_context(Later("sweeps.workers", "workers")(chosen.jobs, chosen.dask))
        folder.claim(names(config.kind), dump(config), resume=chosen.command == "sweep")
        summary = kind.run(config, folder.path, track, **options)
    write_json(folder.path / "summary.json", summary)
    kind.show(summary, console())
    _draw(folder, config)
    if getattr(chosen, "report", False):
        _write_page(folder, config)


def _report(chosen: argparse.Namespace, folder: ResultsFolder) -> None:
    from experiments.kinds import load

    _write_page(folder, load(folder.path / "config.yaml"))
    print(f"Page: {folder.path / 'report.html'}")


def _write_page(folder: ResultsFolder, config: Any) -> None:
    """Write report.html. Everything is read before the folder is claimed."""
    from experiments.kinds import KINDS
    from experiments.results import PAGE
    from torchfsid.commands.results_folder import write_whole
    from torchfsid.errors import ConfigError

    page = KINDS[config.kind].page
    if page is None:
        raise ConfigError(f"{folder.path}: results of the kind '{config.kind}' have no page, only figures")
    text = page(folder.path, config)
    if not folder.claimed:
        folder.claim([PAGE], resume=True)
    write_whole(folder.path / PAGE, text)


def _draw_again(chosen: argparse.Namespace, folder: ResultsFolder) -> None:
    from experiments.kinds import load
    from experiments.results import FIGURES
    from torchfsid.errors import FigureError

    config = load(folder.path / "config.yaml")
    folder.claim(FIGURES, resume=True)
    try:
        _draw(folder, config)
    except FigureError:
        folder.release()  # nothing was written
        raise


def _draw(folder: ResultsFolder, config: Any) -> None:
    from experiments.figures import draw
    from torchfsid.commands.terminal import status

    with status("Drawing"):
        draw(folder.path, config)


if __name__ == "__main__":
    sys.exit(main())
