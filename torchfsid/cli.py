"""The command line: `torchfsid observe LOG --config CONFIG --out DIR`, `torchfsid check LOG --config CONFIG`,
`torchfsid report DIR`.

Everything is validated before PyTorch is loaded and before anything is written: a wrong configuration or log costs a
moment, one clear line on stderr, and exit code 2.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from torchfsid.commands.command_line import Parser, add_overrides, execute
from torchfsid.commands.interruption import importing
from torchfsid.commands.results_folder import OBSERVE, ResultsFolder


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code (`commands.command_line` lists them)."""
    parser = Parser(
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
        add_overrides(command)
    observe.add_argument("--out", type=Path, required=True, help="results folder")
    observe.add_argument("--report", action="store_true", help="write report.html, too: a page of the run")
    check.add_argument("--out", type=Path, help="folder for check.json")
    report = commands.add_parser("report", help="write report.html of a results folder: a page that opens offline")
    report.add_argument("out", type=Path, metavar="DIR", help="results folder of observe")
    commands.metavar = f"{{{','.join(commands.choices)}}}"  # so that a message about a missing command names them
    chosen = parser.parse_args(arguments)

    if chosen.command == "observe":
        folder = ResultsFolder(chosen.out, OBSERVE)
        return execute(
            "torchfsid", lambda: _observe(chosen.log, chosen.config, folder, chosen.set, chosen.report), folder
        )
    if chosen.command == "report":
        results = ResultsFolder(chosen.out, None)
        return execute("torchfsid", lambda: _report(results), results)
    anywhere = None if chosen.out is None else ResultsFolder(chosen.out, None)
    return execute("torchfsid", lambda: _check(chosen.log, chosen.config, anywhere, chosen.set), anywhere)


def _observe(log: Path, config: Path, folder: ResultsFolder, overrides: Sequence[str], report: bool) -> None:
    with importing():
        from torchfsid.config.models import load_models

    folder.require_ours()
    models = load_models(config, overrides)

    with importing():
        from torchfsid.commands.on_logs import observe_log

    observe_log(log, models, folder, report)


def _check(log: Path, config: Path, folder: ResultsFolder | None, overrides: Sequence[str]) -> None:
    with importing():
        from torchfsid.config.models import load_models

    if folder is not None:
        folder.require_ours()
    models = load_models(config, overrides)

    with importing():
        from torchfsid.commands.on_logs import check_log

    check_log(log, models, folder)


def _report(folder: ResultsFolder) -> None:
    folder.require_ours()

    with importing():
        from torchfsid.commands.page.report import write_report

    print(f"Page: {write_report(folder)}")


if __name__ == "__main__":
    sys.exit(main())
