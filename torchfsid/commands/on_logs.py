"""The two commands on logs, from the path of a log to the last printed line."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from functools import partial
from pathlib import Path

from rich.markup import escape

from torchfsid.commands.check import check
from torchfsid.commands.command_line import use_one_thread
from torchfsid.commands.declared_log import AUTO_FACTOR, DeclaredLog
from torchfsid.commands.hypotheses import Hypotheses
from torchfsid.commands.map_panel import Marks
from torchfsid.commands.observe import Observation, times_in
from torchfsid.commands.page.report import write_pages
from torchfsid.commands.page.write import PAGE
from torchfsid.commands.provenance import made_from
from torchfsid.commands.report import print_reading, print_replaced, print_verdicts
from torchfsid.commands.report_check import print_check, print_scan
from torchfsid.commands.report_hypotheses import print_hypotheses
from torchfsid.commands.results_folder import ResultsFolder, write_json, write_whole
from torchfsid.commands.safety_figure import draw_safety
from torchfsid.commands.scan import Range, scan
from torchfsid.commands.scan_figure import draw_scan
from torchfsid.commands.space_figure import draw_regions
from torchfsid.commands.terminal import console, status, track
from torchfsid.config.documents import dump
from torchfsid.config.models import dump_models
from torchfsid.config.observe import ObserveConfig
from torchfsid.errors import ConfigError, FigureError
from torchfsid.logs.log import Log
from torchfsid.logs.mcap import require_new_mcap
from torchfsid.logs.read import read_log

FILES = ("estimates.csv", "sets.csv", "motion.csv", "regions.json", "regions.png", "regions.pdf")
"""What an observation leaves beside config.yaml."""

UNKNOWN_FILES = ("safety.png", "safety.pdf", "unknown_numbers.json", "task_gain.json")
"""What it leaves besides, where safety parameters or other numbers of the model are unknown."""

CHECKED = "check.json"
SCANNED = ("scan.csv", "scan.json", "scan.png", "scan.pdf")


def observe_log(
    path: Path,
    models: Mapping[str, ObserveConfig],
    folder: ResultsFolder,
    with_page: bool = False,
    mcap: Path | None = None,
    merge: bool = False,
) -> None:
    """`torchfsid observe`: infer the sets of a log's robots, under one model or under several hypotheses.

    A file that cannot be written or drawn is reported at the end, after everything else is done.

    Args:
        path: the log.
        models: the models, by name.
        folder: the results folder.
        with_page: write report.html, too.
        mcap: a new file for the run as ROS messages. None: there is none.
        merge: copy the messages of the log, a bag, into it.
    """
    use_one_thread()
    if mcap is not None:
        _require_viewable(mcap, models, merge)
    log = _read(path, models)
    if mcap is not None and log.t[0] < 0:
        raise ConfigError(f"--mcap: ROS has no times below zero, and the log begins at {log.t[0]:g} s")
    run = _ready({name: DeclaredLog(model, log) for name, model in models.items()})
    of_each = run.observations if isinstance(run, Hypotheses) else {"": run}
    of_model = ("config.yaml", *FILES, *UNKNOWN_FILES, *([PAGE] if with_page else []))
    files = [f"{name}/{file}" if name else file for name in of_each for file in of_model]
    first = next(iter(models.values()))
    bound_file = f"{first.noise.quantity}_bound.json"
    also = [bound_file, *(["hypotheses.json", *([PAGE] if with_page else [])] if isinstance(run, Hypotheses) else [])]
    folder.claim([*files, *also], dump_models({name: of.stated for name, of in of_each.items()}))
    print_replaced(folder, console())
    if run.smallest_bounds is not None:
        found = {"smallest": run.smallest_bounds, "factor": AUTO_FACTOR, "used": run.bound_used}
        found |= run.bound.to_json()
        write_json(folder.path / bound_file, found)
    source = made_from(path)
    problems: list[OSError | FigureError] = []
    for name, observation in of_each.items():
        out = folder.path / name
        try:
            if name:
                out.mkdir(exist_ok=True)
                write_whole(out / "config.yaml", dump(observation.stated))
            if observation.narrowing is not None:
                write_json(out / "unknown_numbers.json", observation.narrowing.to_json())
                if "task.gain" in observation.narrowing.numbers:
                    write_json(out / "task_gain.json", observation.narrowing.numbers["task.gain"].to_json())
            what, total = f"Observing {name}".strip(), observation.samples
            shown = partial(track, what=what, total=total, size=times_in)
            observation.run(out, shown, source, mcap, path if merge else None)
            with status("Drawing"):
                seen = observation.log
                draw_regions(out, seen.x, seen.seen, seen.bodies, Marks.of(observation.config))
                if observation.config.is_unknown:
                    draw_safety(out)
        except (OSError, FigureError) as problem:
            problems.append(problem)
    try:
        if isinstance(run, Hypotheses):
            run.write_verdicts(folder.path)
        if with_page:
            write_pages(folder.path)
    except (OSError, FigureError) as problem:
        problems.append(problem)
    print_reading(log.reading, console())
    if isinstance(run, Hypotheses):
        print_hypotheses(run, folder.path, console())
    else:
        if run.smallest_bounds is not None:
            with status("Trying other values", computes=True):
                _ = run.alternative
        print_verdicts(run, folder.path, console())
    if mcap is not None and mcap.exists():
        console().print(escape(f"ROS messages: {mcap}"))
    if problems:
        raise problems[0]


def scan_log(path: Path, models: Mapping[str, ObserveConfig], folder: ResultsFolder | None, values: Range) -> None:
    """`torchfsid check --scan`: the smallest bounds over the values of one key."""
    use_one_thread()
    if len(models) > 1:
        raise ConfigError(f"--scan: expected one model, the configuration has {len(models)}: {', '.join(models)}")
    (config,) = models.values()
    log = _read(path, models)
    found = scan(log, config, values, lambda wanted: track(wanted, f"Scanning {values.key}", len(wanted)))
    if folder is not None:
        folder.claim(SCANNED)
        print_replaced(folder, console())
        found.write(folder.path)
        with status("Drawing"):
            draw_scan(folder.path, found)
    print_scan(found, console())


def check_log(path: Path, models: Mapping[str, ObserveConfig], folder: ResultsFolder | None) -> None:
    """`torchfsid check`: does a log fit its declared model, or each of the hypotheses?"""
    use_one_thread()
    log = _read(path, models)
    declared = {name: DeclaredLog(model, log) for name, model in models.items()}
    with status("Checking", computes=True):
        found = {name: check(model) for name, model in declared.items()}
    if folder is not None:
        folder.claim([f"{name}/{CHECKED}" if name else CHECKED for name in found])
        for name, of_model in found.items():
            (folder.path / name).mkdir(exist_ok=True)
            write_json(folder.path / name / CHECKED, of_model.to_json())
    shown = console()
    print_reading(log.reading, shown)
    for name, of_model in found.items():
        print_check(of_model, name, shown)


def _require_viewable(mcap: Path, models: Mapping[str, ObserveConfig], merge: bool) -> None:
    """Check that these models can be observed into an MCAP file.

    Raises:
        ConfigError: they cannot.
    """
    require_new_mcap(mcap)
    if len(models) > 1:
        raise ConfigError("--mcap: one model at a time, and the config has several hypotheses")
    if merge and next(iter(models.values())).bag is None:
        raise ConfigError("--merge: copies the messages of a ROS bag, and the config has no section bag")


def _read(path: Path, models: Mapping[str, ObserveConfig]) -> Log:
    first = next(iter(models.values()))
    heading = None if first.body is None else first.body.heading
    return read_log(path, first.bag, heading, first.log, in_space=first.dimension == 3)


def _ready(models: Mapping[str, DeclaredLog]) -> Observation | Hypotheses:
    first = next(iter(models.values()))
    auto, unknown = first.config.noise.control == "auto", any(model.config.unknown_numbers for model in models.values())
    finding = status("Narrowing unknown numbers" if unknown else "Finding the bound", computes=True)
    with finding if auto or unknown else nullcontext():
        return Hypotheses(models) if len(models) > 1 else Observation(first)
