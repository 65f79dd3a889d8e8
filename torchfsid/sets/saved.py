"""Sets joined, in a line of text, as dictionaries of tensors, and with their tensors replaced one by one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.sets.facets import Facets
from torchfsid.sets.polygon import Polygon
from torchfsid.sets.polyhedron import Polyhedron
from torchfsid.sets.polytope import Polytope

ROWS = ("A", "b", "time", "source")


def kind_of(p: int) -> type[Any]:
    """The class of the bodies of sets in R^p."""
    return Polygon if p == 2 else Polyhedron if p == 3 else Polytope


def mapped(value: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """The same record with every tensor in it replaced by a function of it."""
    if isinstance(value, Tensor):
        return function(value)
    if is_dataclass(value) and not isinstance(value, type):
        changed = {field.name: mapped(getattr(value, field.name), function) for field in fields(value) if field.init}
        return replace(value, **changed)
    if isinstance(value, tuple) and not isinstance(value, torch.Size):
        parts = [mapped(part, function) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


def joined(parts: Sequence[Any]) -> Any:
    """Several batches (B,) of a `FeasibleSet` as one, one after the other.

    Raises:
        InputError: there are no parts, or they have different dimensions or no batch.
    """
    if len({part.dim for part in parts}) != 1 or any(len(part.batch_shape) != 1 for part in parts):
        expected = "batches (B,) of sets of the same dimension"
        raise InputError("parts", expected, [(tuple(part.batch_shape), part.dim) for part in parts])
    places = torch.arange(sum(map(len, parts)), device=parts[0].outcome.device)
    whole, last = parts[0].select(torch.zeros_like(places)), 0
    for part in parts:
        first, last = last, last + len(part)
        whole = replace(whole, body=whole.body.replaced(places[first:last], part.body))
    return replace(
        whole,
        outcome=torch.cat([part.outcome for part in parts]),
        contradiction=Facets.joined([part.contradiction for part in parts]),
        last_cut=torch.cat([part.last_cut for part in parts]),
    )


def described(sets: Any) -> str:
    """A `FeasibleSet` in a line."""
    volume = sets.volume().detach().flatten().tolist()
    size = f"[{min(volume):.3g}, {max(volume):.3g}]" if len(volume) > 1 else ", ".join(f"{v:.3g}" for v in volume)
    empty = f", {int(sets.is_empty.sum())} empty" if sets.any_empty else ""
    return f"FeasibleSet(batch={tuple(sets.batch_shape)}, dim={sets.dim}, volume={size}{empty})"


def state_of(sets: Any) -> dict[str, Any]:
    """A `FeasibleSet` as a dictionary. Its facets refer to no rows with gradients."""
    state = {f"body.{field.name}": getattr(sets.body, field.name) for field in fields(sets.body)}
    state |= {f"contradiction.{name}": part for name, part in zip(ROWS, sets.contradiction.parts, strict=True)}
    state |= {"outcome": sets.outcome, "last_cut": sets.last_cut}
    state = {name: part.detach().clone() for name, part in state.items() if isinstance(part, Tensor)}
    return {**state, "body.label": torch.zeros_like(state["body.label"]), "max_facets": sets.max_facets}


def read(state: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of the `FeasibleSet` of such a dictionary."""
    body = {name.removeprefix("body."): part for name, part in state.items() if name.startswith("body.")}
    A, b, time, source = (state[f"contradiction.{name}"] for name in ROWS)
    return {
        "body": kind_of(body["A"].shape[-1])(**body),
        "batch_shape": state["outcome"].shape,
        "contradiction": Facets(Halfspaces(A, b), time, source),
        **{name: state[name] for name in ("outcome", "last_cut", "max_facets")},
    }
