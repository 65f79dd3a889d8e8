r"""Batched convex polytopes: the sets of parameters beyond the plane (p = 1, 3, 4, ...), and what is asked of them.

The counterpart of `polygon` and `clipping`, behind the same interface. One polytope is a `Cell`, in numpy, where the
mathematics is; here they are a batch of padded tensors. Every facet is one of the rows that were given, and carries its
gradient; where one is required, `sensitivity` has the derivatives of all that is asked, twice. Whatever round-off
leaves open stays in: every set is an outer set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import nan
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchfsid.outcome import Outcome
from torchfsid.sets import sensitivity
from torchfsid.sets.body import PRIOR, Clipped, Contradiction
from torchfsid.sets.cell import Cell, box, intersect, nearest, without_cheapest_facet
from torchfsid.sets.faces import Indices


@dataclass(frozen=True)
class Polytope:
    """A batch of bounded convex polytopes {z : A z <= b} in R^p, float64.

    `count` facets and `vertex_count` vertices are real; behind them stand padding rows 0.z <= 1 and copies of the first
    vertex. `time` and `source` say when and from which constraint each facet came (NaN and `PRIOR`: the first box).
    `corners` are the vertices without gradients.
    """

    A: Float[Tensor, "B F p"]
    b: Float[Tensor, "B F"]
    time: Float[Tensor, "B F"]
    source: Int[Tensor, "B F"]
    count: Int[Tensor, "B"]
    corners: Float[Tensor, "B V p"]
    incident: Bool[Tensor, "B V F"]
    vertex_count: Int[Tensor, "B"]

    @classmethod
    def from_box(cls, lower: Float[Tensor, "B p"], upper: Float[Tensor, "B p"]) -> Polytope:
        """Axis-parallel boxes; facets: the lower sides -z_i <= -lower_i, then the upper sides z_i <= upper_i."""
        B, p = lower.shape
        unit, b = torch.eye(p, dtype=lower.dtype, device=lower.device), torch.cat([-lower, upper], dim=-1)
        A, nothing = torch.cat([-unit, unit]).expand(B, 2 * p, p), torch.full_like(b, nan)
        rows = _Rows.join((A, b, nothing, torch.full_like(b, PRIOR).long()))
        boxes = [box(low, high) for low, high in zip(_array(lower), _array(upper), strict=True)]
        return cls._of(boxes, list(np.arange(b.numel()).reshape(b.shape)), rows)

    @property
    def dim(self) -> int:
        return self.A.shape[-1]

    @property
    def valid(self) -> Bool[Tensor, "B F"]:
        """Slots that hold a facet."""
        return torch.arange(self.A.shape[1], device=self.count.device) < self.count.unsqueeze(-1)

    @property
    def reach(self) -> Float[Tensor, "B p"]:
        """The largest |coordinates| of the vertices."""
        return self.corners.abs().amax(1)

    def rows(self) -> tuple[Float[Tensor, "B F p"], Float[Tensor, "B F"]]:
        """The facets' rows; each carries its gradient."""
        return self.A, self.b

    def select(self, items: Tensor) -> Polytope:
        """The sub-batch at `items` (indices or a mask)."""
        chosen, origins = self._positions(items), self._origins()
        return self._of([self._cells[i] for i in chosen], [origins[i] for i in chosen], _Rows.join(self._rows()))

    def replaced(self, items: Tensor, other: Polytope) -> Polytope:
        """This batch with `other` in the places `items` (indices or a mask)."""
        cells, origins, others = list(self._cells), self._origins(), other._origins(first=self.b.numel())
        for i, cell, origin in zip(self._positions(items), other._cells, others, strict=True):
            cells[i], origins[i] = cell, origin
        return self._of(cells, origins, _Rows.join(self._rows(), other._rows()))

    def _positions(self, items: Tensor) -> list[int]:
        return torch.arange(len(self.A), device=items.device)[items].tolist()

    def _rows(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.A, self.b, self.time, self.source

    def _origins(self, first: int = 0) -> list[Indices]:
        """Where the facets of each item stand among all rows, if the batch's begin with number `first`."""
        F = self.b.shape[1]
        return [first + i * F + np.arange(len(cell.b)) for i, cell in enumerate(self._cells)]

    @classmethod
    def _of(cls, cells: list[Cell], origins: Sequence[Indices], rows: _Rows) -> Polytope:
        """The batch of these cells, padded to the largest, their facets taken from rows. It keeps the cells, and what
        is already known about them."""
        p, device = rows.A.shape[-1], rows.A.device
        counts = np.array([[len(cell.b), len(cell.vertices)] for cell in cells], dtype=np.int64).reshape(-1, 2)
        B, (F, V) = len(cells), counts.max(0, initial=1)
        origin, corners, incident = np.full((B, F), -1), np.zeros((B, V, p)), np.zeros((B, V, F), dtype=bool)
        for i, (cell, (f, v)) in enumerate(zip(cells, counts, strict=True)):
            origin[i, :f] = origins[i]
            corners[i], incident[i, :, :f] = cell.vertices[0], cell.incident[0]
            corners[i, :v], incident[i, :v, :f] = cell.vertices, cell.incident
        table = (counts[:, 0], corners, incident, counts[:, 1])
        facets = rows.at(torch.as_tensor(origin, device=device), 0.0, 1.0)
        batch = cls(*facets, *(torch.as_tensor(field, device=device) for field in table))
        batch.__dict__["_cells"] = cells
        return batch

    @cached_property
    def _cells(self) -> list[Cell]:
        """The polytopes one by one, without padding."""
        A, b, vertices, incident = (_array(field) for field in (self.A, self.b, self.corners, self.incident))
        counts = zip(self.count.tolist(), self.vertex_count.tolist(), strict=True)
        return [Cell(A[i, :f], b[i, :f], vertices[i, :v], incident[i, :v, :f]) for i, (f, v) in enumerate(counts)]

    def _stacked(self, rows: list[Any], *shape: int) -> Tensor:
        return torch.as_tensor(np.array(rows, dtype=float).reshape(len(self.A), *shape), device=self.A.device)

    def _differentiable(self, *others: Tensor) -> bool:
        """Is a gradient required, with respect to the rows or something else?"""
        required = any(tensor.requires_grad for tensor in (self.A, self.b, *others))
        return torch.is_grad_enabled() and required and len(self.A) > 0

    def clip(
        self,
        A: Float[Tensor, "B R p"],
        b: Float[Tensor, "B R"],
        time: Float[Tensor, "B"],
        source: Int[Tensor, "B R"],
        most: int,
    ) -> Clipped:
        clipped = clip_polytope(self, A, b, time, source)
        body, shrunk = _merged(self, clipped.body, clipped.shrunk, most)
        return replace(clipped, body=body, shrunk=shrunk)

    # What is asked of a polytope ------------------------------------------------------------------------------------

    @property
    def vertices(self) -> Float[Tensor, "B V p"]:
        """The vertices. Where more than p facets meet, p of them, as different as they come, decide its gradient."""
        if not self._differentiable():
            return self.corners
        return sensitivity.vertices(self.A, self.b, self.corners, self._cells)

    def volume(self) -> Float[Tensor, "B"]:
        """Volume (in one dimension, length); 0 for a set whose width is lost in round-off."""
        if self._differentiable():
            return sensitivity.measure(self.A, self.b, self._cells)[0]
        return self._stacked([cell.measure[0] for cell in self._cells])

    def centroid(self) -> Float[Tensor, "B p"]:
        """Centre of volume; of a set without volume, the middle of its bounding box."""
        if self._differentiable():
            return sensitivity.measure(self.A, self.b, self._cells)[1]
        return self._stacked([cell.measure[1] for cell in self._cells], self.dim)

    def diameter(self) -> Float[Tensor, "B"]:
        """Largest distance between two points of the set."""
        apart = torch.cdist(self.corners, self.corners, compute_mode="donot_use_mm_for_euclid_dist").flatten(1)
        furthest, at = apart.argmax(-1), torch.arange(len(apart), device=apart.device)
        vertices, V = self.vertices, self.corners.shape[1]
        return torch.linalg.vector_norm(vertices[at, furthest // V] - vertices[at, furthest % V], dim=-1)

    def support(self, direction: Float[Tensor, "B D p"]) -> Float[Tensor, "B D"]:
        """Support function h(n) = max n.z over the set."""
        values = direction @ self.vertices.transpose(1, 2)
        return values.gather(-1, values.detach().argmax(-1, keepdim=True)).squeeze(-1)

    def chebyshev(self) -> tuple[Float[Tensor, "B p"], Float[Tensor, "B"]]:
        """Centre and radius of a largest inscribed ball: max r s.t. A_f.z + |A_f| r <= b_f.

        The radius is the distance from the returned centre to the nearest facet. Where the centre is not unique, an end
        of the set of centres is returned, with the gradient of the p + 1 facets that decide it; the radius and its
        gradient are right in any case.
        """
        if self._differentiable():
            return sensitivity.inscribed_ball(self.A, self.b, self._cells)
        centres, radii = [cell.ball[0] for cell in self._cells], [cell.ball[1] for cell in self._cells]
        return self._stacked(centres, self.dim), self._stacked(radii)

    def nearest(
        self, point: Float[Tensor, "B p"], metric: Float[Tensor, "B p p"] | None = None
    ) -> Float[Tensor, "B p"]:
        """The point of the set nearest to `point` in the norm sqrt(z' metric z) (default: Euclidean).

        Raises `SolverError` if a `metric` is not positive definite, or if the solver stalls.
        """
        metrics = [np.eye(self.dim)] * len(point) if metric is None else _array(metric)
        found = [nearest(*each) for each in zip(self._cells, _array(point), metrics, strict=True)]
        feet = self._stacked([foot for foot, _ in found], self.dim)
        if not self._differentiable(point, *([] if metric is None else [metric])):
            return feet
        return sensitivity.nearest(self.A, self.b, point, metric, feet, [active for _, active in found])


class _Rows(NamedTuple):
    """Half-spaces in one row, with their provenance."""

    A: Float[Tensor, "N p"]
    b: Float[Tensor, "N"]
    time: Float[Tensor, "N"]
    source: Int[Tensor, "N"]

    @classmethod
    def join(cls, *batches: tuple[Tensor, Tensor, Tensor, Tensor]) -> _Rows:
        """Of each batch, A (B, R, p), b, time and source (B, R), item by item."""
        return cls(*(torch.cat([field.flatten(0, 1) for field in fields]) for fields in zip(*batches, strict=True)))

    def at(self, index: Int[Tensor, "B K"], of_A: float, of_b: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The rows at these places; where the index is -1, A and b are what is given, of the prior."""
        none = index < 0
        return (
            torch.where(none.unsqueeze(-1), of_A, self.A[index]),
            torch.where(none, of_b, self.b[index]),
            torch.where(none, nan, self.time[index]),
            torch.where(none, PRIOR, self.source[index]),
        )


def clip_polytope(
    polytope: Polytope,
    A: Float[Tensor, "B R p"],
    b: Float[Tensor, "B R"],
    time: Float[Tensor, "B"],
    source: Int[Tensor, "B R"],
) -> Clipped:
    """Intersect every polytope with its R half-spaces A z <= b, stamping new facets with `time` and `source`."""
    (B, R, p), F, device = A.shape, polytope.b.shape[1], polytope.A.device
    cells, outcome, shrunk = list(polytope._cells), np.full(B, int(Outcome.NONEMPTY)), np.zeros(B, dtype=bool)
    origins, against = [], np.full((B, p + 1), -1)
    for i, item in enumerate(zip(cells, _array(A), _array(b), strict=True)):
        found = intersect(*item)
        cells[i], outcome[i], shrunk[i] = found.cell, found.outcome, found.cell is not item[0]
        # Among all rows, those of the polytopes come first, item by item.
        place = np.append(B * F + i * R + np.arange(R), i * F + np.arange(F))
        origins.append(place[found.origin])
        against[i, : len(found.contradiction)] = place[found.contradiction]
    outcomes, cut, conflict = (torch.as_tensor(table, device=device) for table in (outcome, shrunk, against))
    rows = _Rows.join(polytope._rows(), (A, b, time.unsqueeze(-1).expand(B, R), source))
    body = Polytope._of(cells, origins, rows) if shrunk.any() else polytope
    contradiction = Contradiction(*(field.detach() for field in rows.at(conflict, nan, nan)))
    return Clipped(body, outcomes, cut, contradiction)


def merge_polytope(polytope: Polytope, most: int) -> Polytope:
    """Outer polytopes with at most `most` facets: drop, one by one, the facet whose removal adds the least volume.

    A facet that keeps the set bounded is never dropped, so that more than `most` may remain.
    """
    cells, origins = list(polytope._cells), polytope._origins()
    for i, cell in enumerate(cells):
        while len(cell.b) > most and (larger := without_cheapest_facet(cell)) is not None:
            cell, kept = larger
            cells[i], origins[i] = cell, origins[i][kept]
    return Polytope._of(cells, origins, _Rows.join(polytope._rows()))


def _merged(
    before: Polytope, body: Polytope, shrunk: Bool[Tensor, "B"], most: int
) -> tuple[Polytope, Bool[Tensor, "B"]]:
    """With at most `most` facets, or as before where merging would cost more than the cut has gained."""
    over = (body.count > most).nonzero().squeeze(-1)
    if len(over) == 0:
        return body, shrunk
    merged = merge_polytope(body.select(over), most)
    grown = merged.volume() > before.select(over).volume()
    body = body.replaced(over, merged).replaced(over[grown], before.select(over[grown]))
    return body, shrunk.index_fill(0, over[grown], False)


def _array(tensor: Tensor) -> NDArray:
    return tensor.detach().cpu().numpy()
