r"""Batched convex polyhedra: the sets of three parameters.

A polyhedron has F = `count` facets on the planes A_f.z = b_f, and 2 F - 4 vertices, in each of which three facets meet
(`kernels.simple_polyhedron`). Where more than three facets meet in a point, several vertices are at this point.

The compiled kernels find the facets that are left after a clip, and which three meet in a vertex. These are found
without gradients. Vertices, volume, centroid, ball and nearest point are then formulae of these rows, and are twice
differentiable. They are evaluated in the frame of each set, in which a thin set is as wide as it is long.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from math import nan
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.device import constant
from torchfsid.halfspaces import Halfspaces
from torchfsid.sets import compiled_polyhedron as compiled
from torchfsid.sets import derivatives, recentred, searches
from torchfsid.sets.body import PRIOR, Clipped, Contradiction
from torchfsid.sets.derivatives import Skeleton, at
from torchfsid.sets.provenance import Sheets
from torchfsid.sets.sensitivity import Frame, change


class Measures(NamedTuple):
    """Numbers of each set in its frame, without gradients.

    Attributes:
        y: the vertices in the frame.
        frame: the frame.
        wide: the number of directions in which the set is thicker than round-off: the first axes.
        volume: the volume in the frame.
        centroid: the centroid in the frame.
    """

    y: Float[Tensor, "B V 3"]
    frame: Frame
    wide: Int[Tensor, "B"]
    volume: Float[Tensor, "B"]
    centroid: Float[Tensor, "B 3"]


@dataclass(frozen=True)
class Polyhedron:
    """A batch of convex polyhedra.

    Attributes:
        corners: the vertices, without gradients. Those behind the last one repeat the first one.
        meets: the three facets of each vertex.
        A: the rows of the facets, without gradients, padded with 0.z <= 1.
        b: their right-hand sides, without gradients. A row that only touched the set has been moved outward by its
            round-off.
        time: the time when each facet came [s]; NaN for the facets of the prior.
        source: the constraint that each facet came from; `PRIOR` for the facets of the prior.
        label: the place of each facet's row in `sheets`; 0 if it has no gradient.
        count: the number of facets.
        reach: the largest |coordinates| that the set ever had, to which its round-off is proportional.
        sheets: the rows with gradients.
    """

    corners: Float[Tensor, "B V 3"]
    meets: Int[Tensor, "B V 3"]
    A: Float[Tensor, "B F 3"]
    b: Float[Tensor, "B F"]
    time: Float[Tensor, "B F"]
    source: Int[Tensor, "B F"]
    label: Int[Tensor, "B F"]
    count: Int[Tensor, "B"]
    reach: Float[Tensor, "B 3"]
    sheets: Sheets = field(default_factory=Sheets)

    @classmethod
    def from_box(cls, lower: Float[Tensor, "B 3"], upper: Float[Tensor, "B 3"]) -> Polyhedron:
        """Axis-parallel boxes. Facets: first the lower sides -z_i <= -lower_i, then the upper sides z_i <= upper_i."""
        B, where = len(lower), lower.device
        unit, b = torch.eye(3, dtype=lower.dtype, device=where), torch.cat([-lower, upper], dim=-1)
        A = torch.cat([-unit, unit]).expand(B, 6, 3)
        is_upper = constant(tuple(product([False, True], repeat=3)), where, torch.bool)
        label, sheets = torch.zeros_like(b).long(), Sheets()
        if torch.is_grad_enabled() and b.requires_grad:
            label = 1 + torch.arange(b.numel(), device=where).reshape(b.shape)
            sheets = sheets.with_sheet(A.flatten(0, 1), b.flatten())
        return cls(
            corners=torch.where(is_upper, upper.unsqueeze(1), lower.unsqueeze(1)).detach(),
            meets=(torch.arange(3, device=where) + 3 * is_upper).expand(B, 8, 3),
            A=A,
            b=b.detach(),
            time=torch.full_like(b.detach(), nan),
            source=torch.full_like(label, PRIOR),
            label=label,
            count=torch.full((B,), 6, device=where),
            reach=torch.maximum(lower.abs(), upper.abs()).detach(),
            sheets=sheets,
        )

    @property
    def valid(self) -> Bool[Tensor, "B F"]:
        """A mask of the slots that hold a facet."""
        return torch.arange(self.b.shape[1], device=self.count.device) < self.count.unsqueeze(-1)

    @property
    def vertex_count(self) -> Int[Tensor, "B"]:
        """The number of vertices: V = 2 F - 4."""
        return 2 * self.count - 4

    def fields(self) -> tuple[Tensor, ...]:
        """All fields except the sheets."""
        rows = self.A, self.b, self.time, self.source, self.label
        return self.corners, self.meets, *rows, self.count, self.reach

    def select(self, items: Int[Tensor, "k"] | Bool[Tensor, "B"]) -> Polyhedron:
        """The sub-batch at `items` (indices or a mask), with no more slots than it needs."""
        items = torch.arange(len(self.count), device=self.count.device)[items]
        slots = int(self.count[items].max()) if len(items) > 0 else self.b.shape[1]
        chosen = (part.index_select(0, items) for part in self._resized(slots))
        return Polyhedron(*chosen, sheets=self.sheets)._pruned()

    def replaced(self, items: Int[Tensor, "k"], other: Polyhedron) -> Polyhedron:
        """This batch with the polyhedra of `other` at the places `items`, with no more slots than it needs."""
        if len(items) == 0:
            return self
        sheets, label = self.sheets.joined(other.sheets, other.label)
        slots = max(int(self.count.index_fill(0, items, 0).max()), int(other.count.max()))
        mine, theirs = self._resized(slots), replace(other, label=label)._resized(slots)
        parts = (part.index_copy(0, items, new) for part, new in zip(mine, theirs, strict=True))
        return Polyhedron(*parts, sheets=sheets)._pruned()

    def clip(
        self,
        A: Float[Tensor, "B R 3"],
        b: Float[Tensor, "B R"],
        time: Float[Tensor, "B R"],
        source: Int[Tensor, "B R"],
        most: int,
    ) -> Clipped:
        """See `Body.clip`. A facet without which the set would be unbounded is never merged."""
        differentiable = torch.is_grad_enabled() and (A.requires_grad or b.requires_grad)
        first = 1 + self.sheets.rows if differentiable else 0
        found = compiled.clip(self.fields(), (A, b, time, source), first, most)
        cut, sheets = self, self.sheets
        if found.fields is not None:
            if differentiable:
                new_A, new_b = (part.index_select(0, found.entered) for part in (A.flatten(0, 1), b.flatten()))
                sheets = sheets.with_sheet(new_A, new_b)
            cut = Polyhedron(*found.fields, sheets=sheets)._pruned()
        return Clipped(cut, found.outcome, found.shrunk, Contradiction(*found.lost))

    def merge(self, most: int) -> Polyhedron:
        """Outer polyhedra with at most `most` facets.

        The facet whose removal adds the least volume is dropped, one by one. A facet without which the set would be
        unbounded is never dropped. So more than `most` may remain.
        """
        return Polyhedron(*compiled.merged(self.fields(), most), sheets=self.sheets)._pruned()

    # Geometry -------------------------------------------------------------------------------------------------------

    def rows(self) -> tuple[Float[Tensor, "B F 3"], Float[Tensor, "B F"]]:
        """A and b, with the gradients of the given rows that have become facets."""
        return self.sheets.attached(self.A, self.b, self.label)

    @property
    def vertices(self) -> Float[Tensor, "B V 3"]:
        """The corners, each the solution of its three rows."""
        slot = torch.arange(self.corners.shape[1], device=self.count.device)
        return self._solved(torch.where(slot < self.vertex_count.unsqueeze(-1), slot, 0))

    def volume(self) -> Float[Tensor, "B"]:
        """The volume. It is 0 for a flat set, whose width is lost in round-off."""
        return self._measure()[0]

    def centroid(self) -> Float[Tensor, "B 3"]:
        """The centre of volume. For a flat set (a facet, an edge, a point) it is the centre of that."""
        return self._measure()[1]

    def diameter(self) -> Float[Tensor, "B"]:
        """The largest distance between two points of the set."""
        ends, distance = searches.farthest(self.corners)
        if not self._differentiable:
            return distance
        first, last = at(self.corners, ends).unbind(1)
        return derivatives.distance(distance, self._extreme(torch.stack([first - last, last - first], dim=1)))

    def support(self, direction: Float[Tensor, "B D 3"]) -> Float[Tensor, "B D"]:
        """The support function h(n) = max n.z over the set, n the `direction`."""
        if not self._differentiable:
            return (direction * at(self.corners, (direction.detach() @ self.corners.mT).argmax(-1))).sum(-1)
        return (direction * self._extreme(direction)).sum(-1)

    def chebyshev(self) -> tuple[Float[Tensor, "B 3"], Float[Tensor, "B"]]:
        """Centre and radius of a largest inscribed ball. See `recentred.chebyshev`."""
        return recentred.chebyshev(*self.rows(), self._numbers.frame.middle, self.reach)

    def nearest(
        self, point: Float[Tensor, "B 3"], metric: Float[Tensor, "B 3 3"] | None = None
    ) -> Float[Tensor, "B 3"]:
        """The point of the set nearest to `point` in the norm sqrt(z' metric z). See `recentred.nearest`."""
        return recentred.nearest(*self.rows(), self._numbers.frame.middle, self.reach, point, metric)

    # Parts of the computation ---------------------------------------------------------------------------------------

    @property
    def _differentiable(self) -> bool:
        """Is a gradient required with respect to the rows?"""
        return torch.is_grad_enabled() and bool(self.sheets.sheets)

    @cached_property
    def _numbers(self) -> Measures:
        y, *frame, wide, volume, centroid = compiled.measures(self.corners, self.meets, self.count, self.reach)
        return Measures(y, Frame(*frame), wide, volume, centroid)

    @cached_property
    def _unit_rows(self) -> Float[Tensor, "B F 3"]:
        """The facets' rows in the frame, of length 1."""
        return Halfspaces(*self._numbers.frame.rows(self.A, self.b)).normalised().A

    @cached_property
    def _skeleton(self) -> Skeleton:
        """The skeleton in the frame. A flat set has no triangles."""
        known = self._numbers
        triangles, facet, solved = compiled.skeleton(self.meets, self.count, known.wide, self._unit_rows)
        return Skeleton(known.y, self.meets, solved, triangles, facet, known.wide == 3)

    def _measure(self) -> tuple[Float[Tensor, "B"], Float[Tensor, "B 3"]]:
        """Volume and centroid, with gradients if the rows require them."""
        _, frame, wide, number, centre = self._numbers
        volume = torch.where(wide == 3, number * frame.scale.prod(-1), 0.0)
        centroid = frame.middle + frame.outside(centre.unsqueeze(1)).squeeze(1)
        if not self._differentiable:
            return volume, centroid
        found, moved = derivatives.measure(*frame.rows(*self.rows()), number, centre, self._skeleton)
        return (
            volume + change(found) * frame.scale.prod(-1),
            centroid + frame.outside(change(moved).unsqueeze(1)).squeeze(1),
        )

    def _solved(self, vertex: Int[Tensor, "B K"]) -> Float[Tensor, "B K 3"]:
        """The vertices of these numbers as the solutions of their rows. Constant where the rows are dependent."""
        number = at(self.corners, vertex)
        if not self._differentiable:
            return number
        frame, skeleton = self._numbers.frame, self._skeleton
        rows, right = frame.rows(*self.rows())
        basis, solved = at(skeleton.bases, vertex), skeleton.solved.gather(1, vertex)
        moved = derivatives.solution(at(skeleton.corners, vertex), at(rows, basis), at(right, basis), solved)
        return number + frame.outside(change(moved))

    def _extreme(self, direction: Float[Tensor, "B D 3"]) -> Float[Tensor, "B D 3"]:
        """A vertex extreme in each direction, as a function of its rows. They are an optimal basis: the direction is a
        combination of them with weights >= 0. So the derivatives are right also where more than three facets meet."""
        wanted, _ = self._numbers.frame.rows(direction.detach(), torch.zeros_like(direction[..., 0]))
        return self._solved(compiled.extreme(self.meets, self.vertex_count, self._numbers.y, self._unit_rows, wanted))

    def _resized(self, slots: int) -> tuple[Tensor, ...]:
        """The fields with slots for `slots` facets."""
        parts, padding = self.fields(), (None, None, 0.0, 1.0, nan, PRIOR, 0)
        resized = []
        for part, fill in zip(parts, padding, strict=False):
            length = 2 * slots - 4 if fill is None else slots
            extra = length - part.shape[1]
            if extra > 0:
                new = part[:, :1] if fill is None else torch.full_like(part[:, :1], fill)
                part = torch.cat([part, new.expand(-1, extra, *part.shape[2:])], dim=1)
            resized.append(part[:, :length])
        return *resized, self.count, self.reach

    def _pruned(self) -> Polyhedron:
        """This batch without the sheets whose rows are no longer facets."""
        sheets, label = self.sheets.in_use(self.label)
        return self if sheets is self.sheets else replace(self, label=label, sheets=sheets)
