"""The declared models of an observe file: one model, or several hypotheses for the same log.

    task:  {kind: goal, gain: 0.9}                    one model, or
    tasks:                                            hypotheses, each with a name, a task and, if need be, a prior
      - {name: goal, task: {kind: goal, gain: 0.9}}
      - {task: {kind: velocity}, prior: {lower: [-1, -1], upper: [1, 1]}}

A hypothesis without a name has the name of its task's kind. A hypothesis without a prior or barriers has those of the
file. All other sections hold for every hypothesis.

An avoidance barrier may leave its form open. Each combination is a hypothesis:

    class_k: {gain: 2.0, power: [1, 3]}
    distance: [squared, euclidean]
    neighbour_velocity: auto                          or a list; auto is [none, current, previous]
    neighbour_acceleration: auto                      likewise, with order: 2; auto is [none, current]
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from torchfsid.config.barriers import BarrierConfig
from torchfsid.config.documents import Strict, apply_overrides, dump, read_yaml, to_yaml, validate, wrong
from torchfsid.config.observe import ObserveConfig
from torchfsid.config.observers import PriorConfig
from torchfsid.config.tasks import TaskConfig
from torchfsid.errors import ConfigError


class HypothesisConfig(Strict):
    """A task that the robots may have.

    Attributes:
        name: name of the hypothesis and of its folder. Default: the kind of the task.
        task: the task.
        prior: prior set of its theta. Default: the prior of the file.
        barriers: its barriers. Default: the barriers of the file.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")] | None = None
    task: TaskConfig
    prior: PriorConfig | None = None
    barriers: tuple[BarrierConfig, ...] | None = None

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
    return models_in(apply_overrides(read_yaml(path), overrides), str(path))


def models_in(mapping: Mapping[Any, Any], source: str) -> dict[str, ObserveConfig]:
    """The models in the content of an observe file, by name. `source` names it in messages.

    Raises:
        ConfigError: see `load_models`.
    """
    if "tasks" not in mapping:
        return _of_forms("", mapping, source)
    if "task" in mapping:
        raise ConfigError(f"{source}: tasks: expected task or tasks, got both")
    common = {key: value for key, value in mapping.items() if key != "tasks"}
    if common.get("on_inconsistent", "hold") != "hold":
        raise ConfigError(f"{source}: on_inconsistent: an empty set refutes a hypothesis, so it is 'hold' with tasks")
    hypotheses = validate({"tasks": mapping["tasks"]}, _Hypotheses, source).tasks
    models = {}
    for hypothesis, raw in zip(hypotheses, mapping["tasks"], strict=True):
        own = {key: raw[key] for key in ("task", "prior", "barriers") if key in raw}
        models |= _of_forms(hypothesis.called, {**common, **own}, f"{source} ({hypothesis.called})")
    return models


def _of_forms(name: str, mapping: Mapping[Any, Any], source: str) -> dict[str, ObserveConfig]:
    """The models that differ in the form of a barrier, where that is left open. Otherwise the model alone."""
    forms = list(_open_forms(mapping.get("barriers")))
    if not forms:
        return {name: validate(mapping, ObserveConfig, source)}
    for i, key, values in forms:
        if len(values) < 2 or len({str(value) for value in values}) < len(values):
            raise ConfigError(f"{source}: barriers[{i}].{key}: expected different values, got {values}")
    if mapping.get("on_inconsistent", "hold") != "hold":
        raise ConfigError(f"{source}: on_inconsistent: an empty set refutes a form, so it is 'hold' with several forms")
    models = {}
    for choice in product(*(values for _, _, values in forms)):
        chosen, words = deepcopy(dict(mapping)), [name] if name else []
        for (i, key, _), value in zip(forms, choice, strict=True):
            barrier = chosen["barriers"][i]
            (barrier["class_k"] if key == "class_k.power" else barrier)[key.split(".")[-1]] = value
            words.append(f"power-{value}" if key == "class_k.power" else str(value))
        models[".".join(words)] = validate(chosen, ObserveConfig, source)
    return models


def _open_forms(barriers: Any) -> Iterator[tuple[int, str, list[Any]]]:
    """For each barrier and key that is left open, the possible values."""
    for i, barrier in enumerate(barriers if isinstance(barriers, list) else []):
        if not isinstance(barrier, dict) or barrier.get("kind") != "avoidance":
            continue
        class_k, share = barrier.get("class_k"), barrier.get("neighbour_velocity")
        if isinstance(class_k, dict) and isinstance(class_k.get("power"), list):
            yield i, "class_k.power", class_k["power"]
        if isinstance(barrier.get("distance"), list):
            yield i, "distance", barrier["distance"]
        if share == "auto" or isinstance(share, list):
            yield i, "neighbour_velocity", ["none", "current", "previous"] if share == "auto" else share
        pull = barrier.get("neighbour_acceleration")
        if pull == "auto" or isinstance(pull, list):
            yield i, "neighbour_acceleration", ["none", "current"] if pull == "auto" else pull


def dump_models(models: Mapping[str, ObserveConfig]) -> str:
    """The models as one YAML file, with defaults filled in. `load_models` gives back the same models."""
    first = next(iter(models.values()))
    if len(models) == 1:
        return dump(first)
    differ = {"task", "prior"}
    if any(model.barriers != first.barriers for model in models.values()):
        differ.add("barriers")
    own = [{"name": name, **_raw(model, differ)} for name, model in models.items()]
    return to_yaml({"tasks": own, **_raw(first, set(ObserveConfig.model_fields) - differ)})


def _raw(model: ObserveConfig, keys: set[str]) -> dict[str, Any]:
    return model.model_dump(mode="json", exclude_none=True, include=keys)
