"""The declared models of an observe file: one model, or several hypotheses for the same log.

    task:  {kind: goal, gain: 0.9}                    one model, or
    tasks:                                            hypotheses, each with a name, a task and, if need be, a prior
      - {name: goal, task: {kind: goal, gain: 0.9}}
      - {task: {kind: velocity}, prior: {lower: [-1, -1], upper: [1, 1]}}

A hypothesis without a name has the name of its task's kind. A hypothesis without a prior has the prior of the file. All
other sections hold for every hypothesis.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from torchfsid.config.documents import Strict, apply_overrides, dump, read_yaml, to_yaml, validate, wrong
from torchfsid.config.observe import ObserveConfig, PriorConfig
from torchfsid.config.tasks import TaskConfig
from torchfsid.errors import ConfigError


class HypothesisConfig(Strict):
    """A task that the robots may have.

    Attributes:
        name: name of the hypothesis and of its folder. Default: the kind of the task.
        task: the task.
        prior: prior set of its theta. Default: the prior of the file.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")] | None = None
    task: TaskConfig
    prior: PriorConfig | None = None

    @property
    def called(self) -> str:
        """The name, or the kind of the task if there is no name."""
        return self.name or self.task.kind


class _Hypotheses(Strict):
    tasks: Annotated[tuple[HypothesisConfig, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _are_told_apart(self) -> _Hypotheses:
        names = [hypothesis.called for hypothesis in self.tasks]
        for i, name in enumerate(names):
            if name in names[:i]:
                raise wrong(f"two hypotheses are called '{name}', give them names", "tasks")
        return self


def load_models(path: str | Path, overrides: Iterable[str] = ()) -> dict[str, ObserveConfig]:
    """The models in an observe file, by name. The only model of a `task` has the name "".

    Args:
        path: the YAML file.
        overrides: as in `load`.

    Raises:
        ConfigError: see `load`. Also if the file has both `task` and `tasks`, or if it has `tasks` and
            `on_inconsistent` is not `hold`: an empty set refutes a hypothesis, and must not be reset.
    """
    mapping = apply_overrides(read_yaml(path), overrides)
    source = str(path)
    if "tasks" not in mapping:
        return {"": validate(mapping, ObserveConfig, source)}
    if "task" in mapping:
        raise ConfigError(f"{source}: tasks: expected task or tasks, got both")
    common = {key: value for key, value in mapping.items() if key != "tasks"}
    if common.get("on_inconsistent", "hold") != "hold":
        raise ConfigError(f"{source}: on_inconsistent: an empty set refutes a hypothesis, so it is 'hold' with tasks")
    hypotheses = validate({"tasks": mapping["tasks"]}, _Hypotheses, source).tasks
    models = {}
    for hypothesis, raw in zip(hypotheses, mapping["tasks"], strict=True):
        own = {key: raw[key] for key in ("task", "prior") if key in raw}
        models[hypothesis.called] = validate({**common, **own}, ObserveConfig, f"{source} ({hypothesis.called})")
    return models


def dump_models(models: Mapping[str, ObserveConfig]) -> str:
    """The models as one YAML file, with defaults filled in. `load_models` gives back the same models."""
    first = next(iter(models.values()))
    if len(models) == 1:
        return dump(first)
    own = [{"name": name, **_raw(model, {"task", "prior"})} for name, model in models.items()]
    return to_yaml({"tasks": own, **_raw(first, set(ObserveConfig.model_fields) - {"task", "prior"})})


def _raw(model: ObserveConfig, keys: set[str]) -> dict[str, Any]:
    return model.model_dump(mode="json", exclude_none=True, include=keys)
