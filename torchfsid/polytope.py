r"""Batched convex polytopes: the sets of parameters beyond the plane (p = 1, 3, 4, ...), and what is asked of them.

The counterpart of `polygon` and `clipping`, behind the same interface, and NOT differentiable: what comes in is
detached, what goes out carries no gradient. One polytope is a `Cell`, in numpy, where the mathematics is; here they are
a batch of padded tensors. Whatever round-off leaves open stays in: every set is an outer set.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import nan

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchfsid.cells import Cell, Reals, box, intersect, nearest, without_cheapest_facet
from torchfsid.clipping import Outcome
from torchfsid.polygon import PRIOR


@dataclass(frozen=True)
class Polytope:
    """A batch of bounded convex polytopes {z : A z <= b} in R^p, float64.

    `count` facets and `vertex_count` vertices are real; behind them stand padding rows 0.z <= 1 and copies of the first
    vertex. `time` and `source` say when and from which constraint each facet came (NaN and `PRIOR`: the first box).
    """

    A: Float[Tensor, "B F p"]
    b: Float[Tensor, "B F"]
    time: Float[Tensor, "B F"]
    source: Int[Tensor, "B F"]
    count: Int[Tensor, "B"]
    vertices: Float[Tensor, "B V p"]
    incident: Bool[Tensor, "B V F"]
    vertex_count: Int[Tensor, "B"]

    @classmethod
    def from_box(cls, lower: Float[Tensor, "B p"], upper: Float[Tensor, "B p"]) -> Polytope:
        """Axis-parallel boxes; facets: the lower sides -z_i <= -lower_i, then the upper sides z_i <= upper_i."""
        boxes = [box(low, high) for low, high in zip(_array(lower), _array(upper), strict=True)]
        return cls._of(boxes, lower.shape[-1], lower.device)

    @property
    def dim(self) -> int:
        return self.A.shape[-1]

    @property
    def valid(self) -> Bool[Tensor, "B F"]:
        """Slots that hold a facet."""
        return torch.arange(self.A.shape[1], device=self.count.device) < self.count.unsqueeze(-1)

    def select(self, items: Tensor) -> Polytope:
        """The sub-batch at `items` (indices or a mask)."""
        return self._of([self._cells[i] for i in self._positions(items)], self.dim, self.A.device)

    def replaced(self, items: Tensor, other: Polytope) -> Polytope:
        """This batch with `other` in the places `items` (indices or a mask)."""
        cells = list(self._cells)
        for i, cell in zip(self._positions(items), other._cells, strict=True):
            cells[i] = cell
        return self._of(cells, self.dim, self.A.device)

    def _positions(self, items: Tensor) -> list[int]:
        return torch.arange(len(self.A), device=items.device)[items].tolist()

    @classmethod
    def _of(cls, cells: list[Cell], dim: int, device: torch.device) -> Polytope:
        """The batch of these cells, padded to the largest. It keeps them, and what is already known about them."""
        counts = np.array([[len(cell.b), len(cell.vertices)] for cell in cells], dtype=np.int64).reshape(-1, 2)
        B, (F, V) = len(cells), counts.max(0, initial=1)
        A, b, time = np.zeros((B, F, dim)), np.ones((B, F)), np.full((B, F), nan)
        source, vertices, incident = np.full((B, F), PRIOR), np.zeros((B, V, dim)), np.zeros((B, V, F), dtype=bool)
        for i, (cell, (f, v)) in enumerate(zip(cells, counts, strict=True)):
            A[i, :f], b[i, :f], time[i, :f], source[i, :f] = cell.A, cell.b, cell.time, cell.source
            vertices[i], incident[i, :, :f] = cell.vertices[0], cell.incident[0]
            vertices[i, :v], incident[i, :v, :f] = cell.vertices, cell.incident
        table = (A, b, time, source, counts[:, 0], vertices, incident, counts[:, 1])
        batch = cls(*(torch.as_tensor(field, device=device) for field in table))
        batch.__dict__["_cells"] = cells
        return batch

    @cached_property
    def _cells(self) -> list[Cell]:
        """The polytopes one by one, without padding."""
        A, b, time, source = (_array(field) for field in (self.A, self.b, self.time, self.source))
        vertices, incident = _array(self.vertices), _array(self.incident)
        counts = zip(self.count.tolist(), self.vertex_count.tolist(), strict=True)
        return [
            Cell(A[i, :f], b[i, :f], time[i, :f], source[i, :f], vertices[i, :v], incident[i, :v, :f])
            for i, (f, v) in enumerate(counts)
        ]

    def _tensor(self, rows: list[Reals] | list[float], *shape: int) -> Tensor:
        return torch.as_tensor(np.array(rows, dtype=float).reshape(len(self.A), *shape), device=self.A.device)

    # What is asked of a polytope ------------------------------------------------------------------------------------

    def volume(self) -> Float[Tensor, "B"]:
        """Volume (in one dimension, length); 0 for a set whose width is lost in round-off."""
        return self._tensor([cell.measure[0] for cell in self._cells])

    def centroid(self) -> Float[Tensor, "B p"]:
        """Centre of volume; of a set without volume, the middle of its bounding box."""
        return self._tensor([cell.measure[1] for cell in self._cells], self.dim)

    def diameter(self) -> Float[Tensor, "B"]:
        """Largest distance between two points of the set."""
        apart = torch.cdist(self.vertices, self.vertices, compute_mode="donot_use_mm_for_euclid_dist")
        return apart.flatten(1).amax(-1)

    def support(self, direction: Float[Tensor, "B D p"]) -> Float[Tensor, "B D"]:
        """Support function h(n) = max n.z over the set."""
        return (direction.detach() @ self.vertices.transpose(1, 2)).amax(-1)

    def chebyshev(self) -> tuple[Float[Tensor, "B p"], Float[Tensor, "B"]]:
        """Centre and radius of a largest inscribed ball: max r s.t. A_f.z + |A_f| r <= b_f.

        The radius is the distance from the returned centre to the nearest facet. Where the centre is not unique, an end
        of the set of centres is returned.
        """
        centres, radii = [cell.ball[0] for cell in self._cells], [cell.ball[1] for cell in self._cells]
        return self._tensor(centres, self.dim), self._tensor(radii)

    def nearest(
        self, point: Float[Tensor, "B p"], metric: Float[Tensor, "B p p"] | None = None
    ) -> Float[Tensor, "B p"]:
        """The point of the set nearest to `point` in the norm sqrt(z' metric z) (default: Euclidean).

        Raises `SolverError` if a `metric` is not positive definite, or if the solver stalls.
        """
        metrics = [np.eye(self.dim)] * len(point) if metric is None else _array(metric)
        feet = [nearest(*each) for each in zip(self._cells, _array(point), metrics, strict=True)]
        return self._tensor(feet, self.dim)


@dataclass(frozen=True)
class Contradiction:
    """Up to p + 1 rows per item that no point satisfies together, NaN behind them: some y >= 0 has y'A = 0, y'b < 0."""

    A: Float[Tensor, "B R p"]
    b: Float[Tensor, "B R"]
    time: Float[Tensor, "B R"]
    source: Int[Tensor, "B R"]


@dataclass(frozen=True)
class ClippedPolytope:
    """Polytopes after a clip.

    Attributes:
        body: the intersection; where it is empty, the polytope as it was.
        outcome: an `Outcome` per item.
        shrunk: the item was really cut.
        contradiction: for empty items, the rows that contradict each other.
    """

    body: Polytope
    outcome: Int[Tensor, "B"]
    shrunk: Bool[Tensor, "B"]
    contradiction: Contradiction


def clip_polytope(
    polytope: Polytope,
    A: Float[Tensor, "B R p"],
    b: Float[Tensor, "B R"],
    time: Float[Tensor, "B"],
    source: Int[Tensor, "B R"],
) -> ClippedPolytope:
    """Intersect every polytope with its R half-spaces A z <= b, stamping new facets with `time` and `source`."""
    B, p, device = len(A), polytope.dim, polytope.A.device
    cells, outcome, shrunk = list(polytope._cells), np.full(B, int(Outcome.NONEMPTY)), np.zeros(B, dtype=bool)
    against = (np.full((B, p + 1, p), nan), *np.full((2, B, p + 1), nan), np.full((B, p + 1), PRIOR))
    for i, item in enumerate(zip(cells, _array(A), _array(b), _array(time), _array(source), strict=True)):
        cells[i], outcome[i], contradiction = intersect(*item)
        shrunk[i] = cells[i] is not item[0]
        for table, rows in zip(against, contradiction, strict=False):
            table[i, : len(rows)] = rows
    outcomes, cut, *rows = (torch.as_tensor(table, device=device) for table in (outcome, shrunk, *against))
    body = Polytope._of(cells, p, device) if shrunk.any() else polytope
    return ClippedPolytope(body, outcomes, cut, Contradiction(*rows))


def merge_polytope(polytope: Polytope, most: int) -> Polytope:
    """Outer polytopes with at most `most` facets: drop, one by one, the facet whose removal adds the least volume.

    A facet that keeps the set bounded is never dropped, so that more than `most` may remain.
    """
    cells = list(polytope._cells)
    for i, cell in enumerate(cells):
        larger: Cell | None = cell
        while larger is not None:
            cells[i] = larger
            larger = without_cheapest_facet(larger) if len(larger.b) > most else None
    return Polytope._of(cells, polytope.dim, polytope.A.device)


def _array(tensor: Tensor) -> NDArray:
    return tensor.detach().cpu().numpy()
