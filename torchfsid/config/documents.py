"""YAML files to validated, frozen records and back.

A mistake in a file is one `ConfigError` of one line. It names the file, the path of the key, what was expected and what
was found.
"""

from __future__ import annotations

import difflib
import re
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from torchfsid.errors import ConfigError, one_line


def wrong(message: str, key: object = None) -> PydanticCustomError:
    """A validation error with its whole message. `key` is the part of the section that the message is about."""
    return PydanticCustomError("complete", "{message}", {"message": message, "key": key})


class Strict(BaseModel):
    """A section of a file. It is frozen. An unknown key is an error that suggests the nearest known key."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _knows_its_keys(cls, data: Any) -> Any:
        for key in data if isinstance(data, Mapping) else ():
            if key not in cls.model_fields:
                guess = [f"{section}.{key}" for section, keys in cls._sections() if key in keys]
                guess += difflib.get_close_matches(str(key), cls.model_fields, n=1)
                hint = f"did you mean '{guess[0]}'?" if guess else f"known keys: {', '.join(cls.model_fields)}"
                raise wrong(f"unknown key ({hint})", key)
        return data

    @classmethod
    def _sections(cls) -> Iterator[tuple[str, Iterable[str]]]:
        """The keys that are sections of their own, each with its keys."""
        for name, field in cls.model_fields.items():
            parts: list[Any] = [field.annotation]
            for part in parts:
                if isinstance(part, type) and issubclass(part, Strict):
                    yield name, part.model_fields
                elif get_origin(part) in (Annotated, Union, UnionType):
                    parts += get_args(part)


Config = TypeVar("Config", bound=Strict)

CHOICES = frozenset(
    {"<section>", "<false>", "<number>", "<interval>", "<velocity>", "<acceleration>", "avoidance, order: 2"}
    | {"<name>", "<columns>"}
)
"""Tags of values of two kinds, a section or False, a number or an interval. Pydantic puts them into paths, but they are
no keys."""


def load(path: str | Path, model: type[Config], overrides: Iterable[str] = ()) -> Config:
    """Read a configuration file.

    Args:
        path: the YAML file.
        overrides: texts such as "noise.velocity=0.02", applied before validation (`apply_overrides`).
        model: the class of the configuration.

    Raises:
        ConfigError: the file cannot be read, is not YAML, or does not fit `model`.
    """
    return validate(apply_overrides(read_yaml(path), overrides), model, source=str(path))


def dump(config: Strict) -> str:
    """The configuration as YAML, with defaults filled in. `load` gives back the same configuration."""
    return to_yaml(config.model_dump(mode="json", exclude_none=True))


def to_yaml(content: Mapping[str, Any]) -> str:
    """The mapping as YAML, its keys in their order."""
    return yaml.safe_dump(dict(content), sort_keys=False, default_flow_style=None)


def read_yaml(path: str | Path) -> dict[Any, Any]:
    """The mapping in a YAML file, not yet validated.

    Raises:
        ConfigError: the file cannot be read, is not YAML, or holds no mapping.
    """
    try:
        text = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    data = _parse(text, str(path))
    if not isinstance(data, dict):
        got = "nothing" if data is None else reprlib.repr(data)
        raise ConfigError(f"{path}: expected keys and values, got {got}")
    return data


def apply_overrides(mapping: dict[Any, Any], overrides: Iterable[str]) -> dict[Any, Any]:
    """A copy of a raw mapping with some values replaced.

    Keys that do not exist are added. Validation comes later.

    Args:
        mapping: as `read_yaml` returns it.
        overrides: texts such as "a.b=value" or "barriers.0.margin=0.2". Values are YAML.

    Raises:
        ConfigError: an override is not of this form, or its path leads through something that has no keys.
    """
    for override in overrides:
        path, equals, text = override.partition("=")
        keys = [key.strip() for key in path.split(".")]
        if not equals or not all(keys):
            raise ConfigError(f"override {override!r}: expected path.to.key=value")
        where = f"override {override!r}"
        mapping = with_value(mapping, keys, _parse(text, where), where)
    return mapping


def with_value(node: Any, keys: list[str], value: object, where: str) -> Any:
    """A copy of a raw mapping (or of a list within one) with the value at the path `keys` replaced.

    Every node on the way is copied, because YAML aliases share nodes that must not change together.

    Raises:
        ConfigError: the path leads through something that has no keys. The message begins with `where`.
    """
    if not keys:
        return value
    first, *rest = keys
    if isinstance(node, list):
        if first not in map(str, range(len(node))):
            raise ConfigError(f"{where}: expected a number below {len(node)} in place of {first!r}")
        i = int(first)
        return [*node[:i], with_value(node[i], rest, value, where), *node[i + 1 :]]
    if node is None or isinstance(node, dict):
        node = node or {}
        return {**node, first: with_value(node.get(first), rest, value, where)}
    raise ConfigError(f"{where}: {reprlib.repr(node)} has no key {first!r}")


def validate(mapping: Mapping[Any, Any], model: type[Config], source: str) -> Config:
    """The mapping as a `model`.

    Raises:
        ConfigError: the mapping does not fit. The message names `source` and the path of the first mistake.
    """
    try:
        return model.model_validate(mapping)
    except ValidationError as error:
        first, *rest = error.errors(include_url=False)
        # An entry that is wrong also leaves its list too short: a mistake that follows from another is not counted.
        others = [other for other in rest if first["loc"][: len(other["loc"])] != other["loc"]]
        more = f" (and {len(others)} more)" if others else ""
        raise ConfigError(f"{source}: {_path(first, mapping)}: {_sentence(first)}{more}") from error


def _path(error: ErrorDetails, mapping: Mapping[Any, Any]) -> str:
    """The path of a mistake, such as `barriers[0].safety_distance`.

    Pydantic also puts kinds and tags of sections into its paths. They are not keys and are left out.
    """
    keys: list[Any] = []
    node: Any = mapping
    kind = None
    for part in error["loc"]:
        if (kind is not None and part == kind) or part in CHOICES:
            kind = None
            continue
        keys.append(part)
        try:
            node = node[part]
        except (KeyError, IndexError, TypeError):
            node = None
        kind = node.get("kind") if isinstance(node, Mapping) else None
    context = error.get("ctx", {})
    if error["type"] == "complete" and context["key"] is not None:
        keys.append(context["key"])
    if error["type"] in ("union_tag_invalid", "union_tag_not_found"):
        keys.append("kind")
    path = ""
    for key in keys:
        if isinstance(key, int):
            path += f"[{key}]"
        else:
            path += ("." if path else "") + (key if isinstance(key, str) and key.isprintable() else reprlib.repr(key))
    return path or "the file"


def _sentence(error: ErrorDetails) -> str:
    kind, context, got = error["type"], error.get("ctx", {}), reprlib.repr(error["input"])
    if kind == "complete":
        return context["message"]
    if kind in ("missing", "union_tag_not_found"):
        return "required key is missing"
    if kind == "union_tag_invalid":
        return f"expected one of {context['expected_tags']}, got {reprlib.repr(error['input']['kind'])}"
    if kind in ("too_short", "too_long"):
        bound = f"at least {context['min_length']}" if kind == "too_short" else f"at most {context['max_length']}"
        return f"expected {bound} entries, got {context['actual_length']}"
    if kind == "tuple_type":
        return f"expected a list, got {got}"
    if kind in ("model_type", "model_attributes_type"):
        return f"expected keys and values, got {got}"
    return f"{error['msg']}, got {got}"


class _Loader(yaml.SafeLoader):
    """YAML as `safe_load` reads it, with two differences.

    A key that is given twice is an error. Only plain decimal notation is a number: the body 010 is not number 8, and
    neither 1_0 nor 1_0.0 is ten.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        for key, _ in node.value:
            if (key.tag, repr(key.value)) in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {key.value!r} is given twice", key.start_mark)
            seen.add((key.tag, repr(key.value)))
        return super().construct_mapping(node, deep)

    def construct_decimal(self, node: yaml.ScalarNode) -> int | str:
        text = self.construct_scalar(node)
        return int(text) if re.fullmatch(r"0|-?[1-9][0-9]*", text) else text

    def construct_fraction(self, node: yaml.ScalarNode) -> float | str:
        text = self.construct_scalar(node)
        return text if "_" in text or ":" in text else self.construct_yaml_float(node)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_decimal)
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_fraction)


def _parse(text: str | bytes, source: str) -> Any:
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ConfigError(f"{source}: {line}not valid YAML: {one_line(error.problem or error)}") from error
    # PyYAML also passes on errors of Python's own constructors (!!int x, 2001-99-99, very deep nesting ...).
    except (yaml.YAMLError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ConfigError(f"{source}: not valid YAML: {one_line(error)}") from error
