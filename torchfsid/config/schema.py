"""The JSON Schema of observe files, with which editors complete, explain and check the keys.

It is generated from the sections and their docstrings. An editor with yaml-language-server takes it by the first line

    # yaml-language-server: $schema=torchfsid.schema.json

A schema knows types and names. What depends on several keys together, or on the log, only the command can check.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel

from torchfsid.config.models import HypothesisConfig
from torchfsid.config.observe import ObserveConfig

DIALECT = "https://json-schema.org/draft/2020-12/schema"

LIMITS = {"gt": "exclusiveMinimum", "ge": "minimum", "lt": "exclusiveMaximum", "le": "maximum"}

BOUND = {"anyOf": [{"type": "number", "minimum": 0}, {"const": "auto"}]}
NAME = {"type": ["string", "integer"]}
"""A body in a list may be written as a number."""


def several(of: Mapping[str, Any], *words: str) -> dict[str, Any]:
    """One value, or a list of those that are hypotheses (`config.models`), or one of these words."""
    return {"anyOf": [of, {"type": "array", "items": of, "minItems": 2}, *({"const": word} for word in words)]}


def schema() -> dict[str, Any]:
    """The JSON Schema of an observe file: one model (`task`), or several hypotheses (`tasks`)."""
    made, hypothesis = ObserveConfig.model_json_schema(), HypothesisConfig.model_json_schema()
    sections = {**made.pop("$defs"), **hypothesis.pop("$defs"), "HypothesisConfig": hypothesis, "ObserveConfig": made}
    for model in _sections(ObserveConfig, HypothesisConfig):
        _explain(sections[model.__name__], model)
    for name in ("ObservedNoiseConfig", "AccelerationNoiseConfig"):
        control = sections[name]["properties"]["velocity" if name == "ObservedNoiseConfig" else "acceleration"]
        control.update(BOUND)
    made["properties"]["obstacles"]["items"] = NAME
    for name in ("AvoidanceConfig", "SecondOrderAvoidanceConfig"):
        _leave_forms_open(sections, sections[name]["properties"])
    made["properties"]["tasks"] = {
        "type": "array",
        "minItems": 2,
        "items": {"$ref": "#/$defs/HypothesisConfig"},
        "description": "hypotheses instead of `task`: each has a name and a task, perhaps a prior and barriers.",
    }
    del sections["ObserveConfig"]
    made["required"] = ["noise"]
    made["oneOf"] = [{"required": ["task", "barriers", "prior"]}, {"required": ["tasks"]}]
    made["title"] = "torchfsid observe"
    return {"$schema": DIALECT, **_with_limits({**made, "$defs": sections})}


def schema_text() -> str:
    """The schema as JSON: `torchfsid schema > torchfsid.schema.json`."""
    return json.dumps(schema(), indent=1)


def descriptions(model: type[BaseModel]) -> dict[str, str]:
    """What the docstrings of a section and of those that it extends say of each key."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        _, _, attributes = (base.__doc__ or "").partition("Attributes:\n")
        for entry in re.split(r"\n(?=\s{4,8}\w+: )", "\n" + attributes):
            name, colon, text = entry.strip().partition(": ")
            if colon and name in model.model_fields:
                found[name] = " ".join(text.split())
    return found


def _sections(*models: type[BaseModel]) -> Iterator[type[BaseModel]]:
    """All sections that these sections are made of, themselves included."""
    waiting, met = list(models), set()
    while waiting:
        part: Any = waiting.pop()
        if isinstance(part, type) and issubclass(part, BaseModel):
            if part not in met:
                met.add(part)
                yield part
                waiting += [field.annotation for field in part.model_fields.values()]
                waiting += [item for field in part.model_fields.values() for item in field.metadata]
        else:
            waiting += getattr(part, "__args__", ())


def _explain(section: dict[str, Any], model: type[BaseModel]) -> None:
    """Give keys their descriptions, and the section the first paragraph of its own. A `kind` has to be written."""
    section["description"] = " ".join((model.__doc__ or "").partition("Attributes:")[0].split())
    for key, text in descriptions(model).items():
        section["properties"][key]["description"] = text
    for key, value in section["properties"].items():
        value.pop("title", None)
        if key == "kind":
            section["required"] = list(dict.fromkeys(["kind", *section.get("required", [])]))


def _with_limits(node: Any) -> Any:
    """The limits of numbers under their standard names: pydantic keeps its own behind a validator."""
    if isinstance(node, dict):
        return {
            LIMITS.get(key, key) if not isinstance(value, dict) else key: _with_limits(value)
            for key, value in node.items()
        }
    return [_with_limits(value) for value in node] if isinstance(node, list) else node


def _leave_forms_open(sections: dict[str, Any], keys: dict[str, Any]) -> None:
    """Let a barrier leave its form open, as `config.models` does."""
    for key in ("distance", "neighbour_velocity", "neighbour_acceleration"):
        if key in keys:
            told = {name: keys[key].pop(name) for name in ("description", "default") if name in keys[key]}
            keys[key] = {**told, **several(keys[key], *(["auto"] if key != "distance" else []))}
    power = sections["UnknownClassKConfig"]["properties"]["power"]
    if "anyOf" not in power:
        sections["UnknownClassKConfig"]["properties"]["power"] = several(power)
