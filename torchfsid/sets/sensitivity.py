r"""Vertices, volume and centroid of polytopes as functions of their rows A z <= b, in the frame of each set.

The numbers come from `shape`, the derivatives from `derivatives`. In the frame, z = middle + (y * scale) axes, a thin
set is as wide as it is long. The map between z and y is constant, so that derivatives pass through it. Flat sets do not
depend on the rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchfsid.halfspaces import Halfspaces, array
from torchfsid.programmes.differentiable import times
from torchfsid.sets import derivatives
from torchfsid.sets.derivatives import Skeleton, at
from torchfsid.sets.faces import Indices, Mask, Reals, optimal_bases
from torchfsid.sets.shape import Shape, lengths


class Frame(NamedTuple):
    """The frames of the sets: z = middle + (y * scale) axes."""

    middle: Float[Tensor, "B p"]
    axes: Float[Tensor, "B p p"]
    scale: Float[Tensor, "B p"]

    def rows(self, A: Tensor, b: Tensor) -> tuple[Float[Tensor, "B F p"], Float[Tensor, "B F"]]:
        """The rows A z <= b, of unit length, as rows over y."""
        unit = Halfspaces(A, b).normalised()
        return unit.A @ self.axes.mT * self.scale.unsqueeze(-2), unit.b - times(unit.A, self.middle)

    def outside(self, change: Float[Tensor, "B N p"]) -> Float[Tensor, "B N p"]:
        """The changes of z that belong to changes of y."""
        return change * self.scale.unsqueeze(-2) @ self.axes


def change(value: Tensor) -> Tensor:
    """Zero with the derivatives of `value`. So numbers do not depend on whether a gradient is asked for."""
    return value - value.detach()


def vertices(A: Float[Tensor, "B F p"], b: Float[Tensor, "B F"], shape: Shape) -> Float[Tensor, "B V p"]:
    """The vertices as functions of the rows. A vertex that is not the solution of p facets is constant."""
    moved = _solutions(A, b, shape, shape.vertices, shape.y, *shape.bases)
    real = torch.as_tensor(shape.incident.any(2), device=A.device)
    return torch.where(real.unsqueeze(-1), moved, moved[:, :1])


def extreme(
    A: Float[Tensor, "B F p"],
    b: Float[Tensor, "B F"],
    shape: Shape,
    vertex: Int[Tensor, "B K"],
    direction: Float[Tensor, "B K p"],
) -> Float[Tensor, "B K p"]:
    """The vertices of these numbers as functions of the rows. Each is extreme in its direction.

    So its facets are those of an optimal basis: the derivatives of max d.z over the set are then right also where more
    than p facets meet.
    """
    number, frame = array(vertex)[..., None], shape.frame
    corners, y = (np.take_along_axis(points, number, axis=1) for points in (shape.vertices, shape.y))
    incident = np.take_along_axis(shape.incident, number, axis=1)
    given, scale = array(direction), frame.scale / frame.scale.max(1, keepdims=True)
    inside = given / lengths(given)[..., None] @ frame.axes.swapaxes(1, 2) * scale[:, None]
    return _solutions(A, b, shape, corners, y, *optimal_bases(shape.rows[0], incident, inside))


def _solutions(
    A: Tensor, b: Tensor, shape: Shape, corners: Reals, y: Reals, basis: Indices, solved: Mask
) -> Float[Tensor, "B K p"]:
    """The corners, with the coordinates y, as the solutions of the facets `basis`. Constant where not `solved`."""
    frame = _frame(shape, A)
    rows, right = frame.rows(A, b)
    number, place, index, known = (torch.as_tensor(field, device=A.device) for field in (corners, y, basis, solved))
    return number + frame.outside(change(derivatives.solution(place, at(rows, index), at(right, index), known)))


def measure(
    A: Float[Tensor, "B F p"], b: Float[Tensor, "B F"], shape: Shape
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B p"]]:
    """Volume and centroid as functions of the rows."""
    frame, solid = _frame(shape, A), shape.solid
    rows, right = frame.rows(A, b)
    found = (solid.y, *shape.solid_bases, *_padded(*shape.simplices, solid.y.shape[1], b.shape), ~shape.is_flat)
    skeleton = Skeleton(*(torch.as_tensor(field, device=A.device) for field in found))
    volume, centroid = (torch.as_tensor(field, device=A.device) for field in (solid.volume, solid.centroid))
    volume, centroid = derivatives.measure(rows, right, volume, centroid, skeleton)
    moved = frame.outside(change(centroid).unsqueeze(1)).squeeze(1)
    return (
        torch.as_tensor(shape.volume, device=A.device) + change(volume) * frame.scale.prod(-1),
        torch.as_tensor(shape.centroid, device=A.device) + moved,
    )


def _frame(shape: Shape, like: Tensor) -> Frame:
    return Frame(*(torch.as_tensor(field, device=like.device) for field in shape.frame[:3]))


def _padded(corners: Indices, facet: Indices, V: int, rows: torch.Size) -> tuple[Indices, Indices]:
    """A flat list of simplices as arrays (B, S, p) and (B, S), with vertices numbered within each item. Padding
    simplices repeat one vertex."""
    B, F = rows
    item = facet // F
    number = np.bincount(item, minlength=B)
    slot, S = np.arange(len(item)) - (number.cumsum() - number)[item], number.max(initial=0)
    simplices, facets = np.zeros((B, S, corners.shape[1]), dtype=np.int64), np.zeros((B, S), dtype=np.int64)
    simplices[item, slot], facets[item, slot] = corners - (item * V)[:, None], facet - item * F
    return simplices, facets
