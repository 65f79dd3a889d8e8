"""The command line: `torchfsid init LOG`, `torchfsid check LOG --config CONFIG`, `torchfsid observe LOG --config CONFIG
--out DIR`, `torchfsid report DIR`, `torchfsid schema`.

Everything is validated before PyTorch is loaded and before anything is written: a wrong configuration or log costs a
moment, one clear line on stderr, and exit code 2.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from torchfsid import __version__
from torchfsid.commands.command_line import Parser, add_overrides, execute
from torchfsid.commands.interruption import importing
from torchfsid.commands.results_folder import OBSERVE, ResultsFolder

DESCRIPTION = "For each robot of a team, the set in which its hidden task parameter (its goal, say) must lie."

FIRST_STEPS = """\
first steps:
  torchfsid init run.csv                                          a config for this log, with every key explained
  (edit the lines marked EDIT in config.yaml: what the robots do)
  torchfsid check run.csv --config config.yaml                    does the log fit this model?
  torchfsid observe run.csv --config config.yaml --out results    tables, sets and figures in results/

exit codes: 0 done, 1 failed after it began to write, 2 a mistake in log, config or arguments and nothing was written,
128 + number ended by a signal
"""

OBSERVED = """\
example:
  torchfsid observe run.csv --config config.yaml --out results --set noise.velocity=0.02 --set 'obstacles=[wall]'

statuses, one per robot:
  ok             no contradiction was seen. This is no proof that the model is right (see torchfsid check)
  alarm          the robot moved in a way that a barrier forbids, by more than its bound: barrier or bound is wrong
  inconsistent   no parameter of the prior explains all that was seen: model, prior or bound is wrong, or the robot
                 changed its task. Contradicting rows and times are in regions.json

A set whose status is not ok is not to be trusted. A status is a result and no failure: scripts read it in regions.json.

exit codes: 0 done, even if no set can be trusted; 1 failed after it began to write; 2 nothing was written; 128 + signal
"""

CHECKED = """\
prints, for each robot, the smallest bound on the errors of its commands with which the model explains its motion,
beside the declared bound and the speeds seen; the samples and rows that contradict the model most; the key to suspect,
or whether shifted velocities would fit better. A small bound is no proof of the model, but one near the speeds seen
disproves it. The exit code is 0 for any answer.

examples:
  torchfsid check run.csv --config config.yaml --set task.gain=0.11 --set barriers.0.safety_distance=0.2
  torchfsid check run.csv --config config.yaml --scan task.gain=0.05:0.2 --out scan
"""

STARTED = """\
The file names the bodies and what they do in the log, and has a line for every key. What no log can tell (task and
barriers) has a value to start from and is marked EDIT. It can be used at once.

example:
  torchfsid init run.csv --out run.yaml
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code (`commands.command_line` lists them)."""
    shaped = argparse.RawDescriptionHelpFormatter
    parser = Parser(prog="torchfsid", description=DESCRIPTION, epilog=FIRST_STEPS, formatter_class=shaped)
    parser.add_argument("--version", action="version", version=f"torchfsid {__version__}")
    commands = parser.add_subparsers(dest="command", required=True)

    def command(name: str, what: str, epilog: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=what, description=what, epilog=epilog, formatter_class=shaped)

    start = command("init", "write a commented config for a log", STARTED)
    observe = command("observe", "infer the sets of a log's robots", OBSERVED)
    check = command("check", "does a log fit its declared model?", CHECKED)
    commands.add_parser("schema", help="print the JSON Schema of the config, for editors")
    for of_log in (start, observe, check):
        of_log.add_argument(
            "log",
            type=Path,
            metavar="LOG",
            help="CSV or Parquet with columns t, robot, x, y[, z][, vx, vy][, ax, ay][, radius] (s, m, m/s, m/s2, m); "
            "a ROS 2 bag; an export of motion capture",
        )
    for on_model in (observe, check):
        on_model.add_argument("--config", type=Path, required=True, help="YAML: task, barriers, prior, noise, ...")
        add_overrides(on_model)
    start.add_argument("--out", type=Path, default=Path("config.yaml"), help="default: config.yaml; never replaced")
    observe.add_argument("--out", type=Path, required=True, help="results folder")
    observe.add_argument("--report", action="store_true", help="write report.html, too: a page of the run")
    observe.add_argument(
        "--mcap",
        type=Path,
        metavar="FILE.mcap",
        help="the run as ROS 2 messages, for Foxglove, RViz, rerun (docs/mcap.md)",
    )
    observe.add_argument("--merge", action="store_true", help="copy the messages of LOG, a bag, into FILE.mcap")
    check.add_argument("--out", type=Path, help="folder for check.json, or for scan.csv, scan.json and scan.png")
    check.add_argument(
        "--scan",
        metavar="KEY=LOW:HIGH[:N]",
        help="instead: the smallest bound that explains the log over N values of a key, e.g. task.gain=0.05:0.2",
    )
    report = commands.add_parser("report", help="write report.html of a results folder: a page that opens offline")
    report.add_argument("out", type=Path, metavar="DIR", help="results folder of observe")
    commands.metavar = f"{{{','.join(commands.choices)}}}"  # so that a message about a missing command names them
    chosen = parser.parse_args(arguments)

    if chosen.command == "init":
        return execute("torchfsid", lambda: _init(chosen.log, chosen.out))
    if chosen.command == "schema":
        return execute("torchfsid", _schema)
    if chosen.command == "observe":
        folder = ResultsFolder(chosen.out, OBSERVE)
        if chosen.merge and chosen.mcap is None:
            parser.error("--merge: expected --mcap beside it")
        return execute("torchfsid", lambda: _observe(chosen, folder), folder)
    if chosen.command == "report":
        results = ResultsFolder(chosen.out, None)
        return execute("torchfsid", lambda: _report(results), results)
    anywhere = None if chosen.out is None else ResultsFolder(chosen.out, None)
    return execute("torchfsid", lambda: _check(chosen.log, chosen.config, anywhere, chosen.set, chosen.scan), anywhere)


def _init(log: Path, out: Path) -> None:
    with importing():
        from torchfsid.commands.init import write_config

    write_config(log, out)


def _schema() -> None:
    with importing():
        from torchfsid.commands.terminal import console
        from torchfsid.config.schema import schema_text

    console().out(schema_text(), highlight=False)


def _observe(chosen: argparse.Namespace, folder: ResultsFolder) -> None:
    with importing():
        from torchfsid.config.models import load_models

    folder.require_ours()
    models = load_models(chosen.config, chosen.set)

    with importing():
        from torchfsid.commands.on_logs import observe_log

    observe_log(chosen.log, models, folder, chosen.report, chosen.mcap, chosen.merge)


def _check(log: Path, config: Path, folder: ResultsFolder | None, overrides: Sequence[str], values: str | None) -> None:
    with importing():
        from torchfsid.config.models import load_models

    if folder is not None:
        folder.require_ours()
    models = load_models(config, overrides)

    with importing():
        from torchfsid.commands.on_logs import check_log, scan_log
        from torchfsid.commands.scan import Range

    if values is None:
        check_log(log, models, folder)
    else:
        scan_log(log, models, folder, Range.parse(values))


def _report(folder: ResultsFolder) -> None:
    folder.require_ours()

    with importing():
        from torchfsid.commands.page.report import write_report

    print(f"Page: {write_report(folder)}")


if __name__ == "__main__":
    sys.exit(main())
