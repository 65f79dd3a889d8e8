r"""Batched convex polygons: the sets of parameters in the plane, and what is asked of them.

A polygon is a ring of vertices, counter-clockwise, and the half-space row of each edge:

    vertices (B, V, 2), edge i from vertex i to vertex i+1 on the line A_i.z = b_i,   A (B, V, 2),  b (B, V)

Polygon k has `count[k]` vertices; the slots behind them repeat its first vertex and carry padding rows, so sums and
extremes over the ring need no mask and no gradient is ever 0/0. Slots grow when a polygon does: nothing overflows.

Everything is differentiable in the vertices and rows, twice. Clipping is in `clipping`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.halfspaces import array
from torchfsid.kernels.compiled import use_kernel
from torchfsid.sets.body import PRIOR, Clipped
from torchfsid.tolerances import ROUND_OFF


@dataclass(frozen=True)
class Polygon:
    """A batch of convex polygons.

    `time` and `source` say when and from which constraint each edge came; `reach` is the largest |coordinate| that the
    set ever had, for round-off is inherited.
    """

    vertices: Float[Tensor, "B V 2"]
    A: Float[Tensor, "B V 2"]
    b: Float[Tensor, "B V"]
    time: Float[Tensor, "B V"]
    source: Int[Tensor, "B V"]
    count: Int[Tensor, "B"]
    reach: Float[Tensor, "B 2"]

    @classmethod
    def from_box(cls, lower: Float[Tensor, "B 2"], upper: Float[Tensor, "B 2"]) -> Polygon:
        """Axis-parallel rectangles; edges: bottom, right, top, left."""
        (x0, y0), (x1, y1) = lower.unbind(-1), upper.unbind(-1)
        ring = [torch.stack(corner, dim=-1) for corner in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
        A = lower.new_tensor([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]).expand(len(lower), 4, 2)
        return cls(
            vertices=torch.stack(ring, dim=1),
            A=A,
            b=torch.stack([-y0, x1, y1, -x0], dim=-1),
            time=lower.new_full((len(lower), 4), float("nan")),
            source=torch.full((len(lower), 4), PRIOR, device=lower.device),
            count=torch.full((len(lower),), 4, device=lower.device),
            reach=torch.maximum(lower.abs(), upper.abs()).detach(),
        )

    @property
    def slots(self) -> int:
        return self.vertices.shape[1]

    @property
    def valid(self) -> Bool[Tensor, "B V"]:
        """Slots that hold a vertex (and its edge)."""
        return torch.arange(self.slots, device=self.count.device) < self.count.unsqueeze(-1)

    def select(self, items: Int[Tensor, "k"]) -> Polygon:
        """The sub-batch at `items`, without the slots that none of it needs."""
        count = self.count[items]
        slots = int(count.max()) if len(count) > 0 else self.slots
        rings = (self.vertices, self.A, self.b, self.time, self.source)
        vertices, A, b, time, source = (field[:, :slots].index_select(0, items) for field in rings)
        return Polygon(vertices, A, b, time, source, count, self.reach[items])

    def replaced(self, items: Int[Tensor, "k"], other: Polygon) -> Polygon:
        """This batch with `other` in the places `items`, and no more slots than that needs."""
        if len(items) == 0:
            return self
        staying = self.count.index_fill(0, items, 0)
        slots = max(int(staying.max()), int(other.count.max()))
        mine, theirs = self._resized(slots).fields(), other._resized(slots).fields()
        return Polygon(*(field.index_copy(0, items, new) for field, new in zip(mine, theirs, strict=True)))

    @classmethod
    def join(cls, parts: Sequence[Polygon]) -> Polygon:
        """Batches behind each other."""
        slots = max(part.slots for part in parts)
        return cls(*map(torch.cat, zip(*(part._resized(slots).fields() for part in parts), strict=True)))

    def fields(self) -> tuple[Tensor, ...]:
        return self.vertices, self.A, self.b, self.time, self.source, self.count, self.reach

    def padding(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """A, b, time and source of a slot without an edge: 0.z <= 1."""
        nothing = torch.zeros_like(self.b[:, 0])
        return torch.zeros_like(self.A[:, 0]), nothing + 1, nothing + torch.nan, torch.full_like(self.count, PRIOR)

    def _resized(self, slots: int) -> Polygon:
        extra = slots - self.slots
        if extra == 0:
            return self
        fields = (self.vertices, self.A, self.b, self.time, self.source)
        if extra < 0:
            vertices, A, b, time, source = (field[:, :slots] for field in fields)
        else:
            vertices, A, b, time, source = (
                torch.cat([field, fill.unsqueeze(1).expand(-1, extra, *fill.shape[1:])], dim=1)
                for field, fill in zip(fields, (self.vertices[:, 0], *self.padding()), strict=True)
            )
        return Polygon(vertices, A, b, time, source, self.count, self.reach)

    def clip(
        self,
        A: Float[Tensor, "B R 2"],
        b: Float[Tensor, "B R"],
        time: Float[Tensor, "B"],
        source: Int[Tensor, "B R"],
        most: int,
    ) -> Clipped:
        from torchfsid.sets.clipping import clip

        return clip(self, A, b, time, source, most)

    # What is asked of a polygon ------------------------------------------------------------------------------------

    def volume(self) -> Float[Tensor, "B"]:
        """Area, by the shoelace formula about the first vertex, which keeps thin polygons exact."""
        return self._triangles().sum(-1)

    def centroid(self) -> Float[Tensor, "B 2"]:
        """Centre of area; of a polygon whose area is lost in round-off, the middle of its bounding box."""
        triangles = self._triangles()
        area = triangles.sum(-1, keepdim=True)
        origin = self.vertices[:, :1]
        spokes = self.vertices - origin
        moments = (triangles.unsqueeze(-1) * (spokes + spokes.roll(-1, 1)) / 3).sum(1)
        size = self.diameter().detach().unsqueeze(-1)
        has_area = area > ROUND_OFF * size**2
        middle = (self.vertices.amin(1) + self.vertices.amax(1)) / 2
        return torch.where(has_area, origin.squeeze(1) + moments / torch.where(has_area, area, 1.0), middle)

    def diameter(self) -> Float[Tensor, "B"]:
        """Largest distance between two points of the set."""
        with torch.no_grad():
            apart = (self.vertices.unsqueeze(1) - self.vertices.unsqueeze(2)).square().sum(-1).flatten(1)
            ends = apart.argmax(-1, keepdim=True)
        one, other = take(self.vertices, ends // self.slots), take(self.vertices, ends % self.slots)
        largest = (one - other).square().sum(-1).squeeze(-1)
        return torch.where(largest > 0, largest.clamp(min=1e-300).sqrt(), 0.0)

    def support(self, direction: Float[Tensor, "B D 2"]) -> Float[Tensor, "B D"]:
        """Support function h(n) = max n.z over the set; between tied vertices the derivatives of the first one."""
        values = direction @ self.vertices.transpose(1, 2)
        return values.gather(-1, values.detach().argmax(-1, keepdim=True)).squeeze(-1)

    def chebyshev(self) -> tuple[Float[Tensor, "B 2"], Float[Tensor, "B"]]:
        """Centre and radius of a largest inscribed disc.

        The linear programme max r s.t. n_i.z + r <= c_i (unit rows) by the dual simplex method: from a basis of three
        rows, exchange one for the row that is violated most until none is. The three last rows are then solved with
        gradients. Where the centre is not unique (two parallel edges touch the disc) the end of the segment of centres
        that the third row decides is returned; the radius and its gradient are right in any case.
        """
        basis = None
        if use_kernel(None, self.vertices.detach()):
            from torchfsid.kernels import disc as inscribed_kernel

            rows = array(self.vertices), array(self.A), array(self.b), array(self.count)
            basis, centre, radius = map(torch.from_numpy, inscribed_kernel.inscribed(*rows, ROUND_OFF))
            if use_kernel(None, self.vertices, self.A, self.b):
                return centre, radius
        norms = torch.where(self.valid, self.A.square().sum(-1), 1.0).sqrt()
        normals, offsets = self.A / norms.unsqueeze(-1), self.b / norms
        # About a point of the set, so that thin sets far from the origin lose no digits.
        centre = self.vertices.detach().mean(1)
        offsets = offsets - (normals @ centre.unsqueeze(-1)).squeeze(-1)
        offsets = torch.where(self.valid, offsets, torch.inf)
        if basis is None:
            basis = _inscribed_basis(normals.detach(), offsets.detach(), self.count)
        inverse = _inverse_with_ones(take(normals, basis))
        solution = (inverse @ offsets.gather(1, basis).unsqueeze(-1)).squeeze(-1)
        return centre + solution[:, :2], solution[:, 2]

    def nearest(
        self, point: Float[Tensor, "B 2"], metric: Float[Tensor, "B 2 2"] | None = None
    ) -> Float[Tensor, "B 2"]:
        """The point of the set nearest to `point` in the norm sqrt(z' metric z) (default: Euclidean)."""
        ends = self.vertices - point.unsqueeze(1)
        edges = self.vertices.roll(-1, 1) - self.vertices
        weighted = edges if metric is None else edges @ metric
        squared = (edges * weighted).sum(-1)
        real = squared > 0
        along = -(ends * weighted).sum(-1) / torch.where(real, squared, 1.0)
        feet = ends + torch.where(real, along, 0.0).clamp(0, 1).unsqueeze(-1) * edges
        distance = (feet * (feet if metric is None else feet @ metric)).sum(-1)
        foot = point + take(feet, distance.argmin(-1, keepdim=True)).squeeze(1)
        inside = (excess(self.A, self.b, point.unsqueeze(1)).squeeze(-1) <= 0).all(-1)
        return torch.where(inside.unsqueeze(-1), point, foot)

    def _triangles(self) -> Float[Tensor, "B V"]:
        """Areas of the triangles (first vertex, vertex i, vertex i+1)."""
        spokes = self.vertices - self.vertices[:, :1]
        after = spokes.roll(-1, 1)
        return (spokes[..., 0] * after[..., 1] - spokes[..., 1] * after[..., 0]) / 2


def _inscribed_basis(
    normals: Float[Tensor, "B V 2"], offsets: Float[Tensor, "B V"], count: Int[Tensor, "B"]
) -> Int[Tensor, "B 3"]:
    """The three rows that touch a largest inscribed disc of each polygon (dual simplex)."""
    V, last = normals.shape[1], count.unsqueeze(-1) - 1
    # Edge 0, the last edge up to 180 degrees further on, and the one after it: their normals span the plane positively.
    turned = cross(normals[:, :1], normals) >= 0
    half = turned[:, 1:].long().cumprod(-1).sum(-1, keepdim=True).clamp(min=1).minimum(last - 1)
    basis = torch.cat([torch.zeros_like(half), half, half + 1], dim=-1)
    scale = torch.where(offsets.isfinite(), offsets.abs(), 0.0).amax(-1)

    items = torch.arange(len(normals), device=normals.device)
    for _ in range(3 * V):  # far more exchanges than ever needed; only round-off could go on for longer
        inverse = _inverse_with_ones(take(normals[items], basis[items]))
        solution = (inverse @ offsets[items].gather(1, basis[items]).unsqueeze(-1)).squeeze(-1)
        violation = (normals[items] @ solution[:, :2].unsqueeze(-1)).squeeze(-1) + solution[:, 2:] - offsets[items]
        worst, entering = violation.max(-1)
        going_on = worst > ROUND_OFF * scale[items]
        items, inverse, entering = items[going_on], inverse[going_on], entering[going_on]
        if len(items) == 0:
            break
        multipliers = inverse[:, 2]
        entered = take(normals[items], entering.unsqueeze(-1)).squeeze(1)
        entered = torch.cat([entered, torch.ones_like(multipliers[:, :1])], dim=-1)
        share = (entered.unsqueeze(1) @ inverse).squeeze(1)
        ratio = torch.where(share > ROUND_OFF, multipliers.clamp(min=0) / share.clamp(min=ROUND_OFF), torch.inf)
        basis[items, ratio.argmin(-1)] = entering
    return basis


def _inverse_with_ones(normals: Float[Tensor, "B 3 2"]) -> Float[Tensor, "B 3 3"]:
    """Inverse of the rows (n_i, 1), by cofactors: its last row are the multipliers of the inscribed-disc programme."""
    rows = torch.cat([normals, torch.ones_like(normals[..., :1])], dim=-1)
    cofactors = torch.linalg.cross(rows.roll(-1, 1), rows.roll(-2, 1))
    determinant = (rows[:, 0] * cofactors[:, 0]).sum(-1)
    return cofactors.transpose(1, 2) / determinant[:, None, None]


def cross(v: Tensor, w: Tensor) -> Tensor:
    return v[..., 0] * w[..., 1] - v[..., 1] * w[..., 0]


def lengths(rows: Tensor) -> Tensor:
    """Lengths, with 1 for zero rows."""
    norms = rows.norm(dim=-1)
    return torch.where(norms > 0, norms, 1.0)


def take(table: Float[Tensor, "B V 2"], index: Int[Tensor, "B K"]) -> Float[Tensor, "B K 2"]:
    return table.gather(1, index.unsqueeze(-1).expand(-1, -1, 2))


def excess(A: Float[Tensor, "B R 2"], b: Float[Tensor, "B R"], z: Float[Tensor, "B V 2"]) -> Float[Tensor, "B R V"]:
    """A z - b, every row at every point."""
    return A @ z.transpose(1, 2) - b.unsqueeze(-1)


def round_off(A: Float[Tensor, "B R 2"], b: Float[Tensor, "B R"], reach: Float[Tensor, "B 2"]) -> Float[Tensor, "B R"]:
    """Round-off of A z - b at points that came from coordinates as large as `reach`."""
    return (ROUND_OFF * (A[..., 0].abs() * reach[:, :1] + A[..., 1].abs() * reach[:, 1:] + b.abs())).detach()
