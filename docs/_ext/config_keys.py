"""Every key of a configuration file, from the schema itself: for the reference in these pages, and for the tests.

The keys, their values and defaults are those of the pydantic models, their meaning is what the models' docstrings say.
So the reference cannot go stale. A link is written in Markdown, to the label that `label` gives the section of a model.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo
from pydantic.json_schema import SkipJsonSchema
from pydantic_core import PydanticUndefined

from experiments.kinds import KINDS
from experiments.teams import TeamConfig
from torchfsid.config.documents import Strict
from torchfsid.config.observe import ObserveConfig
from torchfsid.config.schema import descriptions

CHOSEN_BY = ("kind", "order")
"""Keys that choose among the forms of a section."""


@dataclass(frozen=True)
class Key:
    """A key of a section: its values and default in Markdown, and its meaning, empty if nothing is said of it."""

    name: str
    values: str
    default: str
    meaning: str


@dataclass(frozen=True)
class Section:
    """A section of a file: where it stands, such as `barriers[]`, and the keys that choose this form of it.

    `within` is the form of the section around it, where that has several.
    """

    model: type[Strict]
    place: str
    within: str
    form: dict[str, Any]
    meaning: str
    keys: tuple[Key, ...]

    @property
    def title(self) -> str:
        """Its place and form, as they are written in a file."""
        form = _written(self.form)
        name = f"`{': '.join(filter(None, (self.place, form)))}`" if self.place or form else "The file"
        return f"{name} of `{self.within}`" if self.within else name


def sections(
    model: type[Strict], place: str = "", within: str = "", known: set[type[Strict]] | None = None
) -> Iterator[Section]:
    """The section of a model, then those of its keys, each once."""
    known = set() if known is None else known
    if model in known:
        return
    known.add(model)
    told = descriptions(model)
    form = _form(model)
    keys = tuple(
        Key(name, _values(field.annotation, field.metadata), _default(field), told.get(name, "") or _chosen(name, form))
        for name, field in model.model_fields.items()
    )
    yield Section(model, place, within, form, _opening(model), keys)
    for name, field in model.model_fields.items():
        for part, several in _models(field.annotation):
            below = f"{place}.{name}" if place else name
            yield from sections(part, f"{below}{several}", _written(form), known)


def _form(model: type[Strict]) -> dict[str, Any]:
    """The keys that choose this form of a section, with their values."""
    fields = {name: model.model_fields[name] for name in CHOSEN_BY if name in model.model_fields}
    return {name: values[0] for name, of in fields.items() if len(values := get_args(of.annotation)) == 1}


def _written(form: dict[str, Any]) -> str:
    return f"{{{', '.join(f'{key}: {value}' for key, value in form.items())}}}" if form else ""


def _chosen(name: str, form: dict[str, Any]) -> str:
    return "this form of the section" if name in form else ""


def _models(annotation: Any, several: str = "") -> Iterator[tuple[type[Strict], str]]:
    """The sections within an annotation, each with [] if there is a list of them, or .NAME for a mapping."""
    if isinstance(annotation, type) and issubclass(annotation, Strict):
        yield annotation, several
    elif get_origin(annotation) is not Literal and not _is_hidden(annotation):
        within = {tuple: "[]", dict: ".NAME"}.get(get_origin(annotation), "")
        for part in get_args(annotation):
            yield from _models(part, several + within)


def _is_hidden(annotation: Any) -> bool:
    """Is this an object of Python, which a file cannot hold?"""
    return any(isinstance(part, SkipJsonSchema) for part in getattr(annotation, "__metadata__", ()))


def _values(annotation: Any, metadata: Any = ()) -> str:
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _values(parts[0], parts[1:])
    if origin is Literal:
        return ", ".join(f"`{str(part).lower() if isinstance(part, bool) else part}`" for part in parts)
    if origin in (Union, UnionType):
        return " or ".join(
            dict.fromkeys(_values(part) for part in parts if part is not NoneType and not _is_hidden(part))
        )
    if origin is tuple:
        limits = _limits(metadata)
        least, most = limits.get("min_length"), limits.get("max_length")
        count = f"{least} " if least is not None and least == most else ""
        several = parts[0] is not Ellipsis and (len(parts) > 1)
        return f"list of {count}{_plural(_values(parts[0]))}" if several else f"list of one {_values(parts[0])}"
    if origin is dict:
        return f"mapping of names to {_plural(_values(parts[1]))}"
    if isinstance(annotation, type) and issubclass(annotation, Strict):
        form = _form(annotation)
        name = form.get("kind", "section") + (", order: 2" if form.get("order") == 2 else "")
        return f"[{name}](#{label(annotation)})"
    word = {float: "number", int: "whole number", bool: "`true`, `false`", str: "text"}.get(annotation, "anything")
    limits = _limits(metadata)
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    return " ".join([word, *(f"{sign} {limits[name]:g}" for name, sign in signs.items() if name in limits)])


def _plural(word: str) -> str:
    head, *rest = re.split(r"(?= [>≥<≤])", word, maxsplit=1)
    return "".join([f"{head}s" if re.fullmatch(r"(whole )?number|text", head) else head, *rest])


def _limits(metadata: Any) -> dict[str, Any]:
    """The limits in the metadata of an annotation."""
    found: dict[str, Any] = {}
    for part in metadata:
        for item in part.metadata if isinstance(part, FieldInfo) else [part]:
            for name in ("gt", "ge", "lt", "le", "min_length", "max_length"):
                if getattr(item, name, None) is not None:
                    found[name] = getattr(item, name)
    return found


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None or value is PydanticUndefined or value in ((), {}):
        return ""
    if isinstance(value, Strict):
        return "its defaults"
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def _opening(model: type[Strict]) -> str:
    """What a docstring says before its attributes."""
    return inspect.cleandoc(model.__doc__ or "").split("Attributes:")[0].strip()


def experiment_sections() -> Iterator[Section]:
    """The sections of all kinds of files of `experiments`, each once, without those of observe files."""
    known = {section.model for section in sections(ObserveConfig)}
    for kind in KINDS.values():
        yield from sections(kind.config, known=known)
    yield from sections(TeamConfig, "experiment.team", known=known)


def label(model: type[Strict]) -> str:
    """The label of a model's section in these pages."""
    return f"config-{model.__name__}"
