"""The commands on logs as functions: `fsid.read_log`, `fsid.observe` and `fsid.check`.

They take what the configuration file of a command has, under the same names. Each section may be given as in the file,
as a mapping, or as an object: a task, barriers, a `FeasibleSet` as prior, a `NoiseBound` as noise.

    fsid.observe("run.csv", config="run.yaml")
    fsid.observe("run.csv", config="run.yaml", noise={"velocity": 0.01})
    fsid.observe(log, task, [barrier], prior, fsid.NoiseBound(0.01), velocity="differentiated", obstacles=["pillar"])
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchfsid.commands.check import Check
from torchfsid.commands.check import check as check_declared
from torchfsid.commands.declared_log import DeclaredLog
from torchfsid.commands.observe import Observation
from torchfsid.commands.observed import Observed
from torchfsid.commands.provenance import made_from
from torchfsid.config.bags import BagConfig
from torchfsid.config.documents import read_yaml, validate
from torchfsid.config.models import models_in
from torchfsid.config.motion_capture import LogConfig
from torchfsid.config.observe import ObserveConfig
from torchfsid.errors import ConfigError, InputError
from torchfsid.logs import read
from torchfsid.logs.log import Log
from torchfsid.logs.simulated import log_of
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.recording import names_of
from torchfsid.robots.simulation import Trajectory
from torchfsid.robots.tasks import Task
from torchfsid.robots.unknown_avoidance import UnknownAvoidance
from torchfsid.sets.feasible_set import FeasibleSet

Section = Mapping[str, Any]
"""A section as in the configuration file."""

LogLike = Log | Trajectory | str | Path
"""A log, a simulated run, or the path of a log."""


def read_log(
    path: str | Path,
    *,
    bag: Section | None = None,
    heading: str | None = None,
    form: Section | None = None,
    in_space: bool = False,
) -> Log:
    """Read a log: CSV, Parquet, a ROS 2 bag, or a log of motion capture.

    Args:
        path: the file or folder. The suffix says what it is.
        bag: where the bodies are in a ROS bag, the section `bag` of the configuration.
        heading: the column of headings [rad], for unicycles.
        form: the form of a log of motion capture, the section `log` of the configuration.
        in_space: robots of bags and of motion capture are in space. Tables are if they have a column z.

    Raises:
        LogError: it cannot be read, or is not what its suffix says. The message names the line.
        ConfigError: a section is wrong, or a ROS bag comes without `bag`.
    """
    topics = None if bag is None else validate(bag, BagConfig, "bag")
    exported = None if form is None else validate(form, LogConfig, "form")
    return read.read_log(path, topics, heading, exported, in_space)


def observe(
    log: LogLike,
    task: Task | Section | None = None,
    barriers: Sequence[Barrier | UnknownAvoidance | Section] | None = None,
    prior: FeasibleSet | Section | None = None,
    noise: NoiseBound | Section | None = None,
    *,
    config: str | Path | Section | None = None,
    **options: Any,
) -> Observed:
    """Infer the sets of a log's robots, as `torchfsid observe` does.

    Args:
        log: a log, a simulated run, or the path of a log. The bodies of a run that stand still are its obstacles.
        task: the task of the robots.
        barriers: their barriers.
        prior: the prior set of theta: one, or a batch with one for each robot.
        noise: bounds on the errors of the log.
        config: the configuration file, or its content. What is given beside it replaces its sections.
        options: the other keys of the file, such as `set`, `velocity`, `obstacles`, `on_inconsistent`, `ukf`.

    Raises:
        ConfigError: a section is wrong, missing, or does not fit the log; or there are several hypotheses
            (`torchfsid observe` compares them).
        LogError: the log cannot be read.
        FsidError: no parameter explains a robot, and `on_inconsistent` is `raise`.
    """
    declared = _declared(log, task, barriers, prior, noise, config, options)
    return Observed(Observation(declared), made_from(Path(log) if isinstance(log, str | Path) else declared.log))


def check(
    log: LogLike,
    task: Task | Section | None = None,
    barriers: Sequence[Barrier | UnknownAvoidance | Section] | None = None,
    prior: FeasibleSet | Section | None = None,
    noise: NoiseBound | Section | None = None,
    *,
    config: str | Path | Section | None = None,
    **options: Any,
) -> Check:
    """Ask whether a log fits its declared model, as `torchfsid check` does. The arguments are those of `observe`.

    `.conclusions()` says the result in sentences, `.to_json()` in numbers.

    Raises:
        ConfigError: see `observe`.
        LogError: see `observe`.
    """
    return check_declared(_declared(log, task, barriers, prior, noise, config, options))


def _declared(
    log: LogLike,
    task: Any,
    barriers: Any,
    prior: Any,
    noise: Any,
    config: str | Path | Section | None,
    options: Section,
) -> DeclaredLog:
    """The log with the declared model."""
    if isinstance(config, str | Path):
        content, source = read_yaml(config), str(config)
    else:
        content, source = config or {}, "the arguments" if config is None else "config"
    given = {"task": task, "barriers": barriers, "prior": prior, "noise": noise}
    given = {name: section for name, section in given.items() if section is not None}
    if isinstance(log, Trajectory):
        names = names_of(log)
        given = {"obstacles": names[log.robots :], **given}
    models = models_in({**content, **given, **options}, source)
    if len(models) > 1:
        raise ConfigError(f"{source}: expected one model, got the hypotheses {', '.join(models)}")
    (model,) = models.values()
    return DeclaredLog(model, _read(log, model))


def _read(log: LogLike, config: ObserveConfig) -> Log:
    if isinstance(log, Log):
        return log
    if isinstance(log, Trajectory):
        return log_of(log, names_of(log))
    if isinstance(log, str | Path):
        heading = None if config.body is None else config.body.heading
        return read.read_log(log, config.bag, heading, config.log, config.dimension == 3)
    raise InputError("log", "a Log, a Trajectory or the path of a log", type(log).__name__)
