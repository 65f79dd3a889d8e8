"""The kinds of configuration files, in one table of what is done with each.

Its functions are imported when they are called, so that a mistake in a file is found before PyTorch is loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from experiments.design.config import LearnedObserverConfig, ProbePlacementConfig
from experiments.runs.config import CasesConfig, SceneConfig
from experiments.runs.swarm_config import SwarmConfig
from experiments.sweeps.config import SweepConfig, override_sweep
from torchfsid.config.documents import Strict, apply_overrides, read_yaml, validate
from torchfsid.errors import ConfigError

Config = SceneConfig | CasesConfig | SwarmConfig | SweepConfig | ProbePlacementConfig | LearnedObserverConfig

Command = Literal["run", "sweep", "design"]

Track = Callable[..., Iterable[Any]]
"""Passes items on and shows how far they have come: (items, what is done, how many there are, completed=0)."""


@dataclass(frozen=True)
class Later:
    """A function of `experiments` that is imported when it is called."""

    module: str
    name: str

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return getattr(import_module(f"experiments.{self.module}"), self.name)(*arguments, **options)


@dataclass(frozen=True)
class Kind:
    """What is done with the files of a kind.

    Attributes:
        command: the command of `python -m experiments` that takes these files.
        config: the class of the configuration.
        run: (config, folder, track) -> summary. Writes all results but the summary and the figures into the folder.
        show: (summary, console) -> None. Prints the summary.
        draw: (folder, config) -> pairs of a name and a figure or film, drawn from the files of the folder.
        page: (folder, config) -> report.html as text, from the same files. None: there is no page of this kind.
    """

    command: Command
    config: type[Strict]
    run: Later
    show: Later
    draw: Later
    page: Later | None = None


KINDS = {
    "scene": Kind(
        "run",
        SceneConfig,
        Later("runs.scene", "run_scene"),
        Later("runs.summary", "print_verdict"),
        Later("figures.scene", "draw_scene"),
        Later("pages", "results_page"),
    ),
    "cases": Kind(
        "run",
        CasesConfig,
        Later("runs.cases", "run_cases"),
        Later("runs.cases", "print_cases"),
        Later("figures.cases", "draw_cases"),
        Later("pages", "results_page"),
    ),
    "swarm": Kind(
        "run",
        SwarmConfig,
        Later("runs.swarm", "run_swarm"),
        Later("runs.swarm", "print_swarm"),
        Later("figures.swarm", "draw_swarm"),
    ),
    "sweep": Kind(
        "sweep",
        SweepConfig,
        Later("sweeps.sweep", "run_sweep"),
        Later("sweeps.swept", "print_sweep"),
        Later("figures.sweep", "draw_sweep"),
        Later("pages", "sweep_page"),
    ),
    "probe_placement": Kind(
        "design",
        ProbePlacementConfig,
        Later("design.placement", "place"),
        Later("design.placement", "print_placement"),
        Later("figures.placement", "draw_placement"),
    ),
    "learned_observer": Kind(
        "design",
        LearnedObserverConfig,
        Later("design.learning", "learn"),
        Later("design.learning", "print_learning"),
        Later("figures.learning", "draw_learning"),
    ),
}


def load(path: str | Path, overrides: Sequence[str] = (), command: Command | None = None) -> Config:
    """The configuration in a file.

    Args:
        path: the YAML file.
        overrides: texts such as "noise.velocity=0.02".
        command: the command that the file must be for. None: any command.

    Raises:
        ConfigError: the file is not valid, or is of a kind for another command.
    """
    mapping = read_yaml(path)
    mapping = (override_sweep if mapping.get("kind") == "sweep" else apply_overrides)(mapping, overrides)
    if "kind" not in mapping and ("task" in mapping or "tasks" in mapping):
        raise ConfigError(f"{path}: is of `torchfsid observe`, which writes its results and draws regions.png")
    kind, expected = mapping.get("kind"), [name for name, of in KINDS.items() if command in (None, of.command)]
    if kind not in expected:
        raise ConfigError(f"{path}: kind: expected one of {', '.join(map(repr, expected))}, got {kind!r}")
    config: Any = validate(mapping, KINDS[str(kind)].config, source=str(path))
    if isinstance(config, SweepConfig):
        config.check_runs(source=str(path))
    return config
