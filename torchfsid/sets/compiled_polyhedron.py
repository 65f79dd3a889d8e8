"""The compiled kernels of polyhedra, for tensors: on the device that holds them, or on the CPU.

A batch of polyhedra is `Polyhedron.fields()`. All answers are without gradients.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchfsid import device
from torchfsid.halfspaces import array
from torchfsid.kernels import polyhedron as kernel
from torchfsid.kernels import solid
from torchfsid.kernels.scratch import places

Fields = tuple[Tensor, ...]
LONG, BOOL = torch.long, torch.bool


class Cut(NamedTuple):
    """Polyhedra after a clip.

    Attributes:
        fields: the polyhedra; None if none was cut.
        outcome: a `Status` per item.
        shrunk: whether the clip made the item smaller.
        entered: the rows k R + r that have become facets with a label, in the order of their labels.
        lost: A, b, time and source of the rows that contradict each other.
    """

    fields: Fields | None
    outcome: Int[Tensor, "B"]
    shrunk: Bool[Tensor, "B"]
    entered: Int[Tensor, "N"]
    lost: tuple[Tensor, ...]


def clip(polyhedra: Fields, rows: Sequence[Tensor], first_label: int, most: int) -> Cut:
    """See `kernels.polyhedron.clip`. `rows` are A, b, time and source."""
    if rows[1].shape[1] > 0 and device.has_kernels(*polyhedra[:4], *rows):
        return _clip_on_device(polyhedra, rows, first_label, most)
    fields, outcome, shrunk, entered, lost = kernel.clip(
        tuple(map(array, polyhedra)), *map(array, rows), first_label, most
    )
    where = polyhedra[3].device
    found, (outcomes, smaller, new) = tuple(_tensors(fields, where)), _tensors((outcome, shrunk, entered), where)
    return Cut(found if shrunk.any() else None, outcomes, smaller, new, tuple(_tensors(lost, where)))


def _clip_on_device(polyhedra: Fields, rows: Sequence[Tensor], first_label: int, most: int) -> Cut:
    """Nothing waits for the kernel, except gradients for the rows that entered."""
    b = rows[1]
    (B, R), F = b.shape, polyhedra[3].shape[1]
    fields = _empty(B, max(F, min(F + R, most)), b)
    found = device.empty((B,), b, LONG), device.empty((B,), b, BOOL)
    lost = *(device.empty((B, 4, *more), b) for more in ((3,), (), ())), device.empty((B, 4), b, LONG)
    work = device.scratch(places(F, R), B, b)
    device.launch("space.clip", (polyhedra, rows), (most, first_label > 0), (fields, found, lost, work))
    label, entered = fields[6], b.new_zeros(0, dtype=LONG)
    if first_label > 0:
        new = (label < 0).nonzero(as_tuple=True)
        entered = -1 - label[new]
        label[new] = torch.arange(first_label, first_label + len(entered), device=b.device)
    outcome, shrunk = found
    return Cut(fields, outcome, shrunk, entered, lost)


def merged(polyhedra: Fields, most: int) -> Fields:
    """See `kernels.polyhedron.merged`."""
    b = polyhedra[3]
    if not device.has_kernels(*polyhedra):
        return tuple(_tensors(kernel.merged(tuple(map(array, polyhedra)), most), b.device))
    B, F = b.shape
    fields = _empty(B, F, b)
    work = device.scratch(places(F, 0), B, b)
    device.launch("space.merged", (polyhedra,), (most,), (fields, work))
    return fields


def measures(points: Tensor, meets: Tensor, count: Tensor, reach: Tensor) -> tuple[Tensor, ...]:
    """See `kernels.solid.measures`."""
    given = points, meets, count, reach
    if not device.has_kernels(*given):
        return tuple(_tensors(solid.measures(*map(array, given)), points.device))
    B, V, _ = points.shape
    shapes = (B, V, 3), (B, 3), (B, 3, 3), (B, 3)
    of_frame = *(device.empty(shape, points) for shape in shapes), device.empty((B,), points, LONG)
    results = *of_frame, device.empty((B,), points), device.empty((B, 3), points)
    work = device.scratch(solid.graph_places((V + 4) // 2, V), B, points)
    device.launch("space.measures", (given,), (), (results, work))
    return results


def skeleton(meets: Tensor, count: Tensor, wide: Tensor, rows: Tensor) -> tuple[Tensor, ...]:
    """See `kernels.solid.skeleton`."""
    given = meets, count, wide, rows
    if not device.has_kernels(*given):
        return tuple(_tensors(solid.skeleton(*map(array, given)), meets.device))
    (B, V, _), F = meets.shape, rows.shape[1]
    shapes = (B, 4 * F - 12, 3), (B, 4 * F - 12)
    results = *(device.empty(shape, rows, LONG) for shape in shapes), device.empty((B, V), rows, BOOL)
    work = device.scratch(solid.graph_places(F, V), B, rows)
    device.launch("space.skeleton", (given,), (), (results, work))
    return results


def extreme(meets: Tensor, vertices: Tensor, y: Tensor, rows: Tensor, direction: Tensor) -> Int[Tensor, "B D"]:
    """See `kernels.solid.extreme`."""
    given = meets, vertices, y, rows, direction
    if not device.has_kernels(*given):
        return torch.from_numpy(solid.extreme(*map(array, given))).to(meets.device)
    found = device.empty(direction.shape[:2], rows, LONG)
    device.launch("space.extreme", (given,), (), ((found,),))
    return found


def _empty(B: int, F: int, like: Tensor) -> Fields:
    """Places for the fields of B polyhedra with slots for F facets."""
    vertices, facets = (B, 2 * F - 4, 3), (B, F)
    kinds: list[tuple[tuple[int, ...], torch.dtype]] = [
        (vertices, torch.float64), (vertices, LONG), ((B, F, 3), torch.float64), (facets, torch.float64),
        (facets, torch.float64), (facets, LONG), (facets, LONG), ((B,), LONG), ((B, 3), torch.float64),
    ]  # fmt: skip
    return tuple(device.empty(shape, like, kind) for shape, kind in kinds)


def _tensors(arrays: Iterable[np.ndarray], where: torch.device) -> Iterable[Tensor]:
    return (torch.from_numpy(part).to(where) for part in arrays)
