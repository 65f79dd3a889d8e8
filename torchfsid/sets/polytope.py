r"""Batched convex polytopes: the sets of parameters in other dimensions than 2 and 3 (p = 1, 4, 5, ...).

They have the interface of `polygon`. Searches run in numpy, without gradients. `cell` finds the facets that are left
after a clip, `shape` finds volume and centroid, `programmes` finds the nearest point and the inscribed ball. Every
facet is one of the given rows, whose gradient `provenance` keeps. Vertices, volume, centroid, ball and nearest point
are twice differentiable functions of the facets. A point is removed only if it is outside beyond round-off: every set
is an outer set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import nan
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.halfspaces import array
from torchfsid.outcome import Status
from torchfsid.sets import derivatives, recentred, searches, sensitivity
from torchfsid.sets.body import PRIOR, Clipped, Contradiction
from torchfsid.sets.cell import Cell, intersect, merged
from torchfsid.sets.derivatives import at
from torchfsid.sets.faces import Indices, Mask, Reals
from torchfsid.sets.provenance import Sheets
from torchfsid.sets.shape import Shape
from torchfsid.tolerances import ROUND_OFF


@dataclass(frozen=True)
class Polytope:
    """A batch of bounded convex polytopes {z : A z <= b} in R^p, float64.

    Attributes:
        A: the facets' rows, without gradients, padded with 0.z <= 1.
        b: their right-hand sides, without gradients. A row that only touched the set has been moved outward by its
            round-off.
        time: the time when each facet came [s]; NaN for the facets of the prior.
        source: the constraint that each facet came from; `PRIOR` for the facets of the prior.
        label: the place of each facet's row in `sheets`; 0 if it has no gradient.
        count: the number of real facets.
        corners: the vertices, without gradients, padded with copies of the first one.
        incident: which vertex is on which facet. Padding is on none.
        vertex_count: the number of real vertices.
        reach: the largest |coordinates| that the set ever had, to which its round-off is proportional.
        sheets: the rows with gradients.
    """

    A: Float[Tensor, "B F p"]
    b: Float[Tensor, "B F"]
    time: Float[Tensor, "B F"]
    source: Int[Tensor, "B F"]
    label: Int[Tensor, "B F"]
    count: Int[Tensor, "B"]
    corners: Float[Tensor, "B V p"]
    incident: Bool[Tensor, "B V F"]
    vertex_count: Int[Tensor, "B"]
    reach: Float[Tensor, "B p"]
    sheets: Sheets = field(default_factory=Sheets)

    @classmethod
    def from_box(cls, lower: Float[Tensor, "B p"], upper: Float[Tensor, "B p"]) -> Polytope:
        """Axis-parallel boxes. Facets: first the lower sides -z_i <= -lower_i, then the upper sides z_i <= upper_i."""
        B, p = lower.shape
        unit, b = torch.eye(p, dtype=lower.dtype, device=lower.device), torch.cat([-lower, upper], dim=-1)
        A, nothing = torch.cat([-unit, unit]).expand(B, 2 * p, p), torch.full_like(b, nan)
        label, sheets = torch.zeros_like(b).long(), Sheets()
        if torch.is_grad_enabled() and b.requires_grad:
            label = 1 + torch.arange(b.numel(), device=b.device).reshape(b.shape)
            sheets = sheets.with_sheet(A.flatten(0, 1), b.flatten())
        rows = _Rows.join((A, b.detach(), nothing, torch.full_like(label, PRIOR), label))
        boxes = [Cell.box(low, high) for low, high in zip(array(lower), array(upper), strict=True)]
        return cls._of(boxes, list(np.arange(b.numel()).reshape(b.shape)), rows, sheets)

    @property
    def dim(self) -> int:
        return self.A.shape[-1]

    @property
    def valid(self) -> Bool[Tensor, "B F"]:
        """A mask of the slots that hold a facet."""
        return torch.arange(self.A.shape[1], device=self.count.device) < self.count.unsqueeze(-1)

    def select(self, items: Tensor) -> Polytope:
        """The sub-batch at `items` (indices or a mask)."""
        chosen, origins, rows = self._positions(items), self._origins(), _Rows.join(self._rows())
        return self._of([self._cells[i] for i in chosen], [origins[i] for i in chosen], rows, self.sheets)

    def replaced(self, items: Tensor, other: Polytope) -> Polytope:
        """This batch with the polytopes of `other` at the places `items` (indices or a mask)."""
        cells, origins, others = list(self._cells), self._origins(), other._origins(first=self.b.numel())
        for i, cell, origin in zip(self._positions(items), other._cells, others, strict=True):
            cells[i], origins[i] = cell, origin
        sheets, label = self.sheets.joined(other.sheets, other.label)
        return self._of(cells, origins, _Rows.join(self._rows(), (*other._rows()[:-1], label)), sheets)

    def clip(
        self,
        A: Float[Tensor, "B R p"],
        b: Float[Tensor, "B R"],
        time: Float[Tensor, "B R"],
        source: Int[Tensor, "B R"],
        most: int,
    ) -> Clipped:
        (B, R, p), F, device = A.shape, self.b.shape[1], self.A.device
        cells, origins, against = list(self._cells), self._origins(), np.full((B, p + 1), -1)
        outcome, shrunk, rows, right = np.full(B, int(Status.OK)), np.zeros(B, dtype=bool), array(A), array(b)
        for i in np.flatnonzero(self._exceeded(rows, right)):
            found = intersect(cells[i], rows[i], right[i])
            # The polytopes' own rows come first among all rows, item by item.
            place = np.append(B * F + i * R + np.arange(R), i * F + np.arange(F))
            outcome[i] = found.outcome
            against[i, : len(found.contradiction)] = place[found.contradiction]
            if found.cell is cells[i]:
                continue
            cell, kept = merged(found.cell, most)
            # Where merging costs more than the cut has gained, the polytope stays as it was.
            if cell is found.cell or cell.content <= cells[i].content:
                cells[i], origins[i], shrunk[i] = cell, place[found.origin[kept]], True
        label, sheets = torch.zeros_like(source), self.sheets
        if torch.is_grad_enabled() and (A.requires_grad or b.requires_grad) and shrunk.any():
            used = np.unique(np.concatenate(origins))
            entered = torch.from_numpy(used[used >= B * F] - B * F).to(device)
            labels = 1 + sheets.rows + torch.arange(len(entered), device=device)
            label = label.flatten().index_copy(0, entered, labels).reshape(B, R)
            sheets = sheets.with_sheet(A.flatten(0, 1).index_select(0, entered), b.flatten().index_select(0, entered))
        fresh = A.detach(), b.detach(), time, source, label
        table = _Rows.join(self._rows(), fresh)
        outcomes, cut, conflict = (torch.as_tensor(field, device=device) for field in (outcome, shrunk, against))
        contradiction = Contradiction(*table.at(conflict, nan, nan)[:4])
        return Clipped(self._of(cells, origins, table, sheets) if shrunk.any() else self, outcomes, cut, contradiction)

    def merge(self, most: int) -> Polytope:
        """Outer polytopes with at most `most` facets.

        The facet whose removal adds the least volume is dropped, one by one. A facet without which the set would be
        unbounded is never dropped. So more than `most` may remain.
        """
        cells, kept = zip(*(merged(cell, most) for cell in self._cells), strict=True)
        origins = [origin[some] for origin, some in zip(self._origins(), kept, strict=True)]
        return self._of(list(cells), origins, _Rows.join(self._rows()), self.sheets)

    def rows(self) -> tuple[Float[Tensor, "B F p"], Float[Tensor, "B F"]]:
        """A and b, with the gradients of the given rows that have become facets."""
        return self.sheets.attached(self.A, self.b, self.label)

    # Geometry -------------------------------------------------------------------------------------------------------

    @property
    def vertices(self) -> Float[Tensor, "B V p"]:
        """The vertices. Where more than p facets meet, p of them decide the gradient, with directions far apart."""
        return sensitivity.vertices(*self.rows(), self.shape) if self._differentiable else self.corners

    def volume(self) -> Float[Tensor, "B"]:
        """The volume, or the length for p = 1. It is 0 for a flat set, whose width is lost in round-off."""
        return self._measure[0]

    def centroid(self) -> Float[Tensor, "B p"]:
        """The centre of volume. For a flat set (a facet, an edge, a point) it is the centre of that."""
        return self._measure[1]

    def diameter(self) -> Float[Tensor, "B"]:
        """The largest distance between two points of the set."""
        ends, distance = searches.farthest(self.corners)
        if not self._differentiable:
            return distance
        first, last = at(self.corners, ends).unbind(1)
        along = torch.stack([first - last, last - first], dim=1)  # the directions in which the two are extreme
        return derivatives.distance(distance, sensitivity.extreme(*self.rows(), self.shape, ends, along))

    def support(self, direction: Float[Tensor, "B D p"]) -> Float[Tensor, "B D"]:
        """The support function h(n) = max n.z over the set, n the `direction`."""
        furthest = (direction.detach() @ self.corners.mT).argmax(-1)
        if not self._differentiable:
            return (direction * at(self.corners, furthest)).sum(-1)
        return (direction * sensitivity.extreme(*self.rows(), self.shape, furthest, direction)).sum(-1)

    def chebyshev(self) -> tuple[Float[Tensor, "B p"], Float[Tensor, "B"]]:
        """Centre and radius of a largest inscribed ball. See `recentred.chebyshev`."""
        return recentred.chebyshev(*self.rows(), self._as_tensor(self.shape.middle), self.reach)

    def nearest(
        self, point: Float[Tensor, "B p"], metric: Float[Tensor, "B p p"] | None = None
    ) -> Float[Tensor, "B p"]:
        """The point of the set nearest to `point` in the norm sqrt(z' metric z). See `recentred.nearest`."""
        return recentred.nearest(*self.rows(), self._as_tensor(self.shape.middle), self.reach, point, metric)

    # Parts of the computation ---------------------------------------------------------------------------------------

    @cached_property
    def shape(self) -> Shape:
        """The shape of the polytopes, in numpy, without gradients."""
        fields = (self.A, self.b, self.corners, self.vertex_count, self.incident, self.reach)
        return Shape(*(array(field) for field in fields))

    @cached_property
    def _cells(self) -> list[Cell]:
        """The polytopes one by one, without padding."""
        A, b, vertices, incident, reach = (
            array(field) for field in (self.A, self.b, self.corners, self.incident, self.reach)
        )
        counts = zip(self.count.tolist(), self.vertex_count.tolist(), strict=True)
        return [
            Cell(A[i, :f], b[i, :f], vertices[i, :v], incident[i, :v, :f], reach[i]) for i, (f, v) in enumerate(counts)
        ]

    @property
    def _differentiable(self) -> bool:
        """Is a gradient required with respect to the rows?"""
        return torch.is_grad_enabled() and bool(self.sheets.sheets)

    @property
    def _measure(self) -> tuple[Tensor, Tensor]:
        """Volume and centroid, with gradients if the rows require them."""
        if self._differentiable:
            return sensitivity.measure(*self.rows(), self.shape)
        return self._as_tensor(self.shape.volume), self._as_tensor(self.shape.centroid)

    def _as_tensor(self, field: Reals) -> Tensor:
        return torch.as_tensor(field, device=self.A.device)

    def _exceeded(self, A: Reals, b: Reals) -> Mask:
        """Does some row (B, R, p) cut the item by more than round-off? A mask (B,)."""
        tolerance = ROUND_OFF * ((np.abs(A) @ array(self.reach)[..., None])[..., 0] + np.abs(b))
        return ((A @ array(self.corners).swapaxes(1, 2)).max(-1) - b > tolerance).any(-1)

    def _positions(self, items: Tensor) -> list[int]:
        return torch.arange(len(self.A), device=items.device)[items].tolist()

    def _rows(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        return self.A, self.b, self.time, self.source, self.label

    def _origins(self, first: int = 0) -> list[Indices]:
        """The indices of each item's facets among all rows, if the rows of this batch begin at index `first`."""
        F = self.b.shape[1]
        return [first + i * F + np.arange(len(cell.b)) for i, cell in enumerate(self._cells)]

    @classmethod
    def _of(cls, cells: list[Cell], origins: Sequence[Indices], rows: _Rows, sheets: Sheets) -> Polytope:
        """The batch of these cells, padded to the largest. The facets are taken from `rows`.

        The values of b are taken from the cells, where some rows have been moved outward.
        """
        p, device = rows.A.shape[-1], rows.A.device
        counts = np.array([[len(cell.b), len(cell.vertices)] for cell in cells], dtype=np.int64).reshape(-1, 2)
        B, (F, V) = len(cells), np.maximum(counts.max(0, initial=1), (1, p))
        origin, right = np.full((B, F), -1), np.ones((B, F))
        corners, incident, reach = np.zeros((B, V, p)), np.zeros((B, V, F), dtype=bool), np.zeros((B, p))
        for i, (cell, (f, v)) in enumerate(zip(cells, counts, strict=True)):
            origin[i, :f], right[i, :f] = origins[i], cell.b
            corners[i], corners[i, :v], incident[i, :v, :f] = cell.vertices[0], cell.vertices, cell.incident
            reach[i] = cell.reach
        A, _, time, source, label = rows.at(torch.as_tensor(origin, device=device), 0.0, 1.0)
        sheets, label = sheets.in_use(label)
        table = (counts[:, 0], corners, incident, counts[:, 1], reach)
        b, *others = (torch.as_tensor(part, device=device) for part in (right, *table))
        batch = cls(A, b, time, source, label, *others, sheets=sheets)
        batch.__dict__["_cells"] = cells
        return batch


class _Rows(NamedTuple):
    """Half-spaces in one flat list, with the time, source and label of each."""

    A: Float[Tensor, "N p"]
    b: Float[Tensor, "N"]
    time: Float[Tensor, "N"]
    source: Int[Tensor, "N"]
    label: Int[Tensor, "N"]

    @classmethod
    def join(cls, *batches: tuple[Tensor, ...]) -> _Rows:
        """The flat list of several batches, each A (B, R, p), b, time, source and label (B, R), item by item."""
        return cls(*(torch.cat([field.flatten(0, 1) for field in fields]) for fields in zip(*batches, strict=True)))

    def at(self, index: Int[Tensor, "B K"], fill_A: float, fill_b: float) -> tuple[Tensor, ...]:
        """The rows at the places `index`. Where it is -1, A and b are `fill_A` and `fill_b`, with the prior's stamp."""
        none = index < 0
        return (
            torch.where(none.unsqueeze(-1), fill_A, self.A[index]),
            torch.where(none, fill_b, self.b[index]),
            torch.where(none, nan, self.time[index]),
            torch.where(none, PRIOR, self.source[index]),
            torch.where(none, 0, self.label[index]),
        )
