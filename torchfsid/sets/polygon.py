r"""Batched convex polygons: the sets of parameters in the plane.

A polygon is a counter-clockwise ring of vertices, with the half-space row of each edge:

    corners (B, V, 2), edge i from corner i to corner i+1 on the line A_i.z = b_i,   A (B, V, 2),  b (B, V)

Polygon k has `count[k]` corners. The slots behind them repeat its first corner and hold padding rows. So sums and
extremes over the ring need no mask, and no gradient is 0/0. The number of slots grows with the largest polygon.

The compiled kernels find the rows that form the ring, touch the largest disc or are active at the nearest point. These
are found without gradients. Vertices, area, disc and nearest point are then formulae of these rows, and are twice
differentiable.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid import device
from torchfsid.halfspaces import Halfspaces, array
from torchfsid.kernels import polygon as kernel
from torchfsid.outcome import Status
from torchfsid.programmes.differentiable import inscribed_ball
from torchfsid.sets import derivatives, searches
from torchfsid.sets.body import PRIOR, Clipped, Contradiction
from torchfsid.sets.derivatives import Skeleton, at
from torchfsid.sets.provenance import Sheets
from torchfsid.tolerances import PARALLEL_EDGES, ROUND_OFF


@dataclass(frozen=True)
class Polygon:
    """A batch of convex polygons.

    Attributes:
        corners: the vertices, without gradients.
        A: the rows of the edges, without gradients.
        b: their right-hand sides, without gradients.
        time: the time when each edge came [s]; NaN for the edges of the prior.
        source: the constraint that each edge came from; `PRIOR` for the edges of the prior.
        label: the place of each edge's row in `sheets`; 0 if it has no gradient.
        count: the number of corners.
        reach: the largest |coordinates| that the set ever had, to which its round-off is proportional.
        sheets: the rows with gradients.
    """

    corners: Float[Tensor, "B V 2"]
    A: Float[Tensor, "B V 2"]
    b: Float[Tensor, "B V"]
    time: Float[Tensor, "B V"]
    source: Int[Tensor, "B V"]
    label: Int[Tensor, "B V"]
    count: Int[Tensor, "B"]
    reach: Float[Tensor, "B 2"]
    sheets: Sheets = field(default_factory=Sheets)

    @classmethod
    def from_box(cls, lower: Float[Tensor, "B 2"], upper: Float[Tensor, "B 2"]) -> Polygon:
        """Axis-parallel rectangles with the edges bottom, right, top, left."""
        (x0, y0), (x1, y1) = lower.unbind(-1), upper.unbind(-1)
        ring = [torch.stack(corner, dim=-1) for corner in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
        A = lower.new_tensor([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]).expand(len(lower), 4, 2)
        b = torch.stack([-y0, x1, y1, -x0], dim=-1)
        label, sheets = torch.zeros(len(lower), 4, dtype=torch.long, device=lower.device), Sheets()
        if torch.is_grad_enabled() and b.requires_grad:
            label = 1 + torch.arange(b.numel(), device=lower.device).reshape(b.shape)
            sheets = sheets.with_sheet(A.flatten(0, 1), b.flatten())
        return cls(
            corners=torch.stack(ring, dim=1).detach(),
            A=A,
            b=b.detach(),
            time=lower.new_full((len(lower), 4), float("nan")),
            source=torch.full_like(label, PRIOR),
            label=label,
            count=torch.full((len(lower),), 4, device=lower.device),
            reach=torch.maximum(lower.abs(), upper.abs()).detach(),
            sheets=sheets,
        )

    @property
    def slots(self) -> int:
        return self.corners.shape[1]

    @property
    def valid(self) -> Bool[Tensor, "B V"]:
        """A mask of the slots that hold a corner and its edge."""
        return torch.arange(self.slots, device=self.count.device) < self.count.unsqueeze(-1)

    def fields(self) -> tuple[Tensor, ...]:
        """All fields except the sheets."""
        return self.corners, self.A, self.b, self.time, self.source, self.label, self.count, self.reach

    def select(self, items: Int[Tensor, "k"]) -> Polygon:
        """The sub-batch at `items`, with no more slots than it needs."""
        slots = int(self.count[items].max()) if len(items) > 0 else self.slots
        return Polygon(*(part.index_select(0, items) for part in self._resized(slots)), sheets=self.sheets)._pruned()

    def replaced(self, items: Int[Tensor, "k"], other: Polygon) -> Polygon:
        """This batch with the polygons of `other` at the places `items`, with no more slots than it needs."""
        if len(items) == 0:
            return self
        sheets, label = self.sheets.joined(other.sheets, other.label)
        staying = self.count.index_fill(0, items, 0)
        slots = max(int(staying.max()), int(other.count.max()))
        mine, theirs = self._resized(slots), replace(other, label=label)._resized(slots)
        parts = (part.index_copy(0, items, new) for part, new in zip(mine, theirs, strict=True))
        return Polygon(*parts, sheets=sheets)._pruned()

    def _pruned(self) -> Polygon:
        """This batch without the sheets whose rows are no longer edges."""
        sheets, label = self.sheets.in_use(self.label)
        return self if sheets is self.sheets else replace(self, label=label, sheets=sheets)

    def _resized(self, slots: int) -> tuple[Tensor, ...]:
        """The fields with `slots` slots."""
        rings, extra = self.fields()[:6], slots - self.slots
        if extra <= 0:
            rings = tuple(part[:, :slots] for part in rings)
        else:
            padding = (self.corners[:, :1], 0.0, 1.0, torch.nan, PRIOR, 0)
            rings = tuple(
                torch.cat([part, torch.zeros_like(part[:, :1]).expand(-1, extra, *part.shape[2:]) + fill], dim=1)
                for part, fill in zip(rings, padding, strict=True)
            )
        return *rings, self.count, self.reach

    def clip(
        self,
        A: Float[Tensor, "B R 2"],
        b: Float[Tensor, "B R"],
        time: Float[Tensor, "B R"],
        source: Int[Tensor, "B R"],
        most: int,
    ) -> Clipped:
        """See `Body.clip`. An edge with parallel neighbours, as in a parallelogram, is never merged."""
        time = once(time)
        differentiable = torch.is_grad_enabled() and (A.requires_grad or b.requires_grad)
        first = 1 + self.sheets.rows if differentiable else 0
        if b.shape[1] > 0 and device.has_kernels(A, b, self.b):
            return self._clipped_on_device(A, b, time, source, most, first)
        parts, outcome, shrunk, entered, against = kernel.clip(
            tuple(map(array, self.fields())), array(A), array(b), array(time), array(source), first, most
        )
        back = torch.from_numpy if A.is_cpu else lambda part: torch.from_numpy(part).to(A.device)
        contradiction = Contradiction(*map(back, against)) if outcome.any() else None
        outcomes, smaller = back(outcome), back(shrunk)
        if not shrunk.any():
            return Clipped(self, outcomes, smaller, contradiction)
        body = Polygon(*map(back, parts), sheets=self.sheets)
        if differentiable:
            body = body._with_sheet(A, b, back(entered))
        return Clipped(body._pruned(), outcomes, smaller, contradiction)

    def _clipped_on_device(self, A: Tensor, b: Tensor, time: Tensor, source: Tensor, most: int, first: int) -> Clipped:
        """`clip` by the device's kernel. Nothing waits for its results, except gradients for the rows that entered."""
        (B, R), ints = b.shape, torch.long
        V = max(self.slots, min(self.slots + R, most))
        ring = *(device.empty((B, V, 2), b) for _ in range(2)), *(device.empty((B, V), b) for _ in range(2))
        numbers = *(device.empty((B, V), b, ints) for _ in range(2)), device.empty((B,), b, ints)
        found = device.empty((B,), b, ints), device.empty((B,), b, torch.bool)
        lost = (
            device.empty((B, 3, 2), b), device.empty((B, 3), b), device.empty((B, 3), b), device.empty((B, 3), b, ints),
        )  # fmt: skip
        late = torch.zeros(B + 1, dtype=torch.int32, device=b.device)
        fields = tuple(map(device.side_by_side, self.fields()))
        parts, rows = (*ring, *numbers, fields[-1]), (A, b, time, source)
        device.launch("planar.clip", (fields, rows), (most, first > 0), (parts, found, lost, (late,)))
        body = Polygon(*parts, sheets=self.sheets)
        if first > 0:
            new = (body.label < 0).nonzero(as_tuple=True)
            entered = -1 - body.label[new]
            body.label[new] = torch.arange(first, first + len(entered), device=b.device)
            body = body._with_sheet(A, b, entered)
        return Clipped(body._pruned(), *found, Contradiction(*lost))

    def _with_sheet(self, A: Tensor, b: Tensor, entered: Int[Tensor, "N"]) -> Polygon:
        """This batch with the rows `entered` of all rows as one more sheet."""
        rows = A.flatten(0, 1).index_select(0, entered), b.flatten().index_select(0, entered)
        return replace(self, sheets=self.sheets.with_sheet(*rows))

    # Geometry -------------------------------------------------------------------------------------------------------

    def rows(self) -> tuple[Float[Tensor, "B V 2"], Float[Tensor, "B V"]]:
        """A and b, with the gradients of the given rows that have become edges."""
        return self.sheets.attached(self.A, self.b, self.label)

    @property
    def vertices(self) -> Float[Tensor, "B V 2"]:
        """The corners, each the solution of its two rows."""
        if not self._differentiable():
            return self.corners
        return derivatives.vertices(*self.rows(), self._skeleton(self._triangles().sum(-1)))

    def volume(self) -> Float[Tensor, "B"]:
        """The area by the shoelace formula about the first corner, which is accurate for thin polygons."""
        area = self._triangles().sum(-1)
        if not self._differentiable():
            return area
        return derivatives.measure(*self.rows(), area, self.corners[:, 0], self._skeleton(area))[0]

    def centroid(self) -> Float[Tensor, "B 2"]:
        """The centre of area. If the area is lost in round-off, it is the middle of the bounding box."""
        return self._measure()[1]

    def diameter(self) -> Float[Tensor, "B"]:
        """The largest distance between two points of the set."""
        ends, distance = searches.farthest(self.corners)
        return derivatives.distance(distance, at(self.vertices, ends)) if self._differentiable() else distance

    def support(self, direction: Float[Tensor, "B D 2"]) -> Float[Tensor, "B D"]:
        """The support function h(n) = max n.z over the set. Tied vertices give the derivatives of the first one."""
        furthest = (direction.detach() @ self.corners.mT).argmax(-1)
        return (direction * at(self.vertices, furthest)).sum(-1)

    def chebyshev(self) -> tuple[Float[Tensor, "B 2"], Float[Tensor, "B"]]:
        """Centre and radius of a largest inscribed disc: max r s.t. A_i.z + |A_i| r <= b_i.

        Where the centre is not unique (two parallel edges touch the disc), an end of the segment of centres is
        returned. Its gradient is that of the three rows that decide this choice. The radius and its gradient are right
        in any case. Where no disc could be verified as a largest one, it is the largest about a point of the set.
        """
        centre, radius, rows, found = searches.inscribed(self.corners, self.A, self.b, self.count)
        if not bool(found.all()):
            lost = (~found).nonzero().squeeze(-1)
            centre[lost], radius[lost] = self.select(lost)._disc_by_programme()
        if not self._differentiable():
            return centre, radius
        centre, radius = derivatives.inscribed_ball(*self.rows(), centre, radius, rows, found)
        return centre, torch.where(radius > 0, radius, 0.0)

    def nearest(
        self, point: Float[Tensor, "B 2"], metric: Float[Tensor, "B 2 2"] | None = None
    ) -> Float[Tensor, "B 2"]:
        """The point of the set nearest to `point` in the norm sqrt(z' metric z) (default: Euclidean)."""
        H = torch.eye(2, dtype=point.dtype, device=point.device).expand(len(point), 2, 2) if metric is None else metric
        found, active = searches.feet(self.corners, self.A, self.b, self.count, point, H)
        if not self._differentiable(point, H):
            return found
        # Two equations M z = right. At a vertex they are the active rows. On an edge t, the second one is
        # t'H (z - point) = 0. Inside, they are z = point.
        A, b = self.rows()
        N, right = at(A, active.clamp(min=0)), at(b, active.clamp(min=0))
        along = torch.stack([-N[:, 0, 1], N[:, 0, 0]], dim=-1)
        on_edge = (H @ along.unsqueeze(-1)).squeeze(-1)
        eye = torch.eye(2, dtype=N.dtype, device=N.device)
        number = (active >= 0).sum(-1)
        M = torch.stack([N[:, 0], torch.where((number == 2).unsqueeze(-1), N[:, 1], on_edge)], dim=1)
        right = torch.stack([right[:, 0], torch.where(number == 2, right[:, 1], (on_edge * point).sum(-1))], dim=1)
        inside = number == 0
        M, right = torch.where(inside[:, None, None], eye, M), torch.where(inside.unsqueeze(-1), point, right)
        return derivatives.solution(found, M, right, independent(M[:, 0], M[:, 1]))

    # Parts of the computation ---------------------------------------------------------------------------------------

    def _differentiable(self, *others: Tensor) -> bool:
        return torch.is_grad_enabled() and (bool(self.sheets.sheets) or any(other.requires_grad for other in others))

    def _triangles(self) -> Float[Tensor, "B V"]:
        """The areas of the triangles (first corner, corner i, corner i+1)."""
        spokes = self.corners - self.corners[:, :1]
        return cross(spokes, spokes.roll(-1, 1)) / 2

    def _measure(self) -> tuple[Float[Tensor, "B"], Float[Tensor, "B 2"]]:
        triangles, origin = self._triangles(), self.corners[:, :1]
        area, spokes = triangles.sum(-1), self.corners - origin
        moments = (triangles.unsqueeze(-1) * (spokes + spokes.roll(-1, 1)) / 3).sum(1)
        solid = self._solid(area)
        centroid = origin.squeeze(1) + moments / torch.where(solid, area, 1.0).unsqueeze(-1)
        middle = (self.corners.amin(1) + self.corners.amax(1)) / 2
        centroid = torch.where(solid.unsqueeze(-1), centroid, middle)
        if self._differentiable():
            return derivatives.measure(*self.rows(), area, centroid, self._skeleton(area))
        return area, centroid

    def _solid(self, area: Float[Tensor, "B"]) -> Bool[Tensor, "B"]:
        """Is the area larger than its own round-off, given the size of the coordinates?"""
        size = (self.corners.amax(1) - self.corners.amin(1)).amax(-1)
        return area > ROUND_OFF * size * torch.maximum(size, self.corners.abs().amax((1, 2)))

    def _skeleton(self, area: Float[Tensor, "B"]) -> Skeleton:
        slot, count = torch.arange(self.slots, device=self.count.device), self.count.unsqueeze(-1)
        here = torch.where(slot < count, slot, 0)
        bases = torch.stack([(here - 1) % count, here], dim=-1)
        rows = at(self.A, bases)
        ends = torch.stack([here, torch.where(slot < count, (slot + 1) % count, 0)], dim=-1)
        solved, facet = independent(rows[:, :, 0], rows[:, :, 1]), slot.expand(self.b.shape)
        return Skeleton(self.corners, bases, solved, ends, facet, self._solid(area))

    def _disc_by_programme(self) -> tuple[Float[Tensor, "B 2"], Float[Tensor, "B"]]:
        """The inscribed disc by `programmes.inscribed_ball`, which works in any dimension."""
        centre = self.corners.mean(1)
        rows = Halfspaces(self.A, self.b - (self.A @ centre.unsqueeze(-1)).squeeze(-1))
        step, radius, status = inscribed_ball(rows)
        ok, lost = status == Status.OK, status == Status.UNSOLVED
        about = torch.where(lost, rows.slack(torch.zeros_like(centre)).amin(-1), 0.0)
        # Where there is no disc, the set is flat to round-off.
        return centre + torch.where(ok.unsqueeze(-1), step, 0.0), torch.where(ok, radius, about)


def independent(v: Float[Tensor, "*B 2"], w: Float[Tensor, "*B 2"]) -> Bool[Tensor, "*B"]:
    """Do two lines with the normals v and w meet in a point?"""
    v, w = v.detach(), w.detach()
    return cross(v, w).abs() > PARALLEL_EDGES * torch.linalg.vector_norm(v, dim=-1) * torch.linalg.vector_norm(
        w, dim=-1
    )


def once(tensor: Tensor) -> Tensor:
    """The tensor with one entry along each dimension along which it was expanded."""
    for dim, stride in enumerate(tensor.stride()):
        tensor = tensor.narrow(dim, 0, 1) if stride == 0 and tensor.shape[dim] > 1 else tensor
    return tensor


def cross(v: Tensor, w: Tensor) -> Tensor:
    return v[..., 0] * w[..., 1] - v[..., 1] * w[..., 0]
