r"""Polygons cut in torch, every step differentiable: a second opinion on the compiled clip and its derivatives.

The rows cut one after the other, of each polygon the deepest first. A row a.z <= c that really cuts a ring keeps one
arc of it, around the vertex deepest inside, closed by the points where the ring crosses the line:

    kept: a.v - c <= tolerance;    a crossing, from v kept to w lost:  v + s_v/(s_v - s_w) (w - v),   s = a.z - c

Rows that only touch are left out; nothing is ever empty. Vertices of B rings stand in columns, padded by the first one.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfsid.tolerances import ROUND_OFF


class Rings(NamedTuple):
    """x, y (V, B) and count (B,); `reach` (B, 2), the largest coordinates."""

    x: Tensor
    y: Tensor
    count: Tensor
    reach: Tensor

    @classmethod
    def boxes(cls, lower: Tensor, upper: Tensor) -> Rings:
        """Rectangles between lower and upper (B, 2)."""
        (x0, y0), (x1, y1) = lower.unbind(-1), upper.unbind(-1)
        reach = torch.maximum(lower.abs(), upper.abs()).detach()
        count = torch.full((len(lower),), 4)
        return cls(torch.stack([x0, x1, x1, x0]), torch.stack([y0, y0, y1, y1]), count, reach)

    def vertices(self) -> Tensor:
        return torch.stack([self.x.T, self.y.T], dim=-1)

    def area(self) -> Tensor:
        return self._triangles().sum(0)

    def centroid(self) -> Tensor:
        triangles, (x, y) = self._triangles(), self._spokes()
        moments = [(triangles * (z + z.roll(-1, 0)) / 3).sum(0) / self.area() for z in (x, y)]
        return torch.stack([self.x[0] + moments[0], self.y[0] + moments[1]], dim=-1)

    def _spokes(self) -> tuple[Tensor, Tensor]:
        return self.x - self.x[0], self.y - self.y[0]

    def _triangles(self) -> Tensor:
        x, y = self._spokes()
        return (x * y.roll(-1, 0) - y * x.roll(-1, 0)) / 2

    def clip(self, A: Tensor, b: Tensor) -> Rings:
        """The rings cut by rows A (B, R, 2), b (B, R)."""
        rings = self
        with torch.no_grad():
            p, q = A.unbind(-1)
            tolerance = ROUND_OFF * (p.abs() * self.reach[:, :1] + q.abs() * self.reach[:, 1:] + b.abs())
            beyond = (p * self.x.unsqueeze(-1) + q * self.y.unsqueeze(-1)).amax(0) - b
            depth = torch.where(beyond > tolerance, beyond / A.norm(dim=-1).clamp(min=1e-300), -torch.inf)
            order = depth.argsort(dim=-1, descending=True)
            turns = int(depth.isfinite().sum(-1).max()) if len(b) > 0 else 0
        for r in order[:, :turns].unbind(-1):
            one = torch.arange(len(b)), r
            rings = rings._cut(A[one], b[one], tolerance[one])
        return rings

    def _cut(self, row: Tensor, bound: Tensor, tolerance: Tensor) -> Rings:
        over = self.x * row[:, 0] + self.y * row[:, 1] - bound
        lowest, deepest = over.detach().min(0)
        some = ((over.detach().amax(0) > tolerance) & (lowest < -tolerance)).nonzero().squeeze(-1)
        if len(some) == 0:
            return self
        x, y, over = (field.index_select(1, some) for field in (self.x, self.y, over))
        x, y, count = _kept_arc(x, y, self.count[some], over, tolerance[some], deepest[some])
        slots = max(len(x), len(self.x))
        wide_x, wide_y = (_widened(field, slots).index_copy(1, some, _widened(new, slots))
                          for field, new in ((self.x, x), (self.y, y)))  # fmt: skip
        return Rings(wide_x, wide_y, self.count.index_copy(0, some, count), self.reach)


def _widened(field: Tensor, slots: int) -> Tensor:
    return torch.cat([field, field[:1].expand(slots - len(field), -1)])


def _kept_arc(x: Tensor, y: Tensor, count: Tensor, over: Tensor, tolerance: Tensor, deepest: Tensor) -> tuple:
    slot = torch.arange(len(over)).unsqueeze(-1)
    lost = (over > tolerance) & (slot < count)
    # The first vertex lost after the deepest, and the last.
    turned = (slot + torch.where(slot < deepest, count, 0)).to(over.dtype)
    after = torch.where(lost, turned, torch.inf).amin(0).long()
    before = torch.where(lost, turned, 0.0).amax(0).long()
    length = after + count - before - 1

    ends = torch.stack([after - 1, before + 1, after, before])
    ends = torch.where(ends >= count, ends - count, ends)
    (inner, outer), (x_kept, x_lost), (y_kept, y_lost) = (
        field.gather(0, ends).reshape(2, 2, -1).unbind(0) for field in (over, x, y)
    )
    share = inner / (inner - outer)
    x_new, y_new = x_kept + share * (x_lost - x_kept), y_kept + share * (y_lost - y_kept)
    leaves, enters = inner < -tolerance

    total, first = length + leaves + enters, ends[1]
    slot = torch.arange(int(total.max())).unsqueeze(-1)
    position = slot + torch.where(slot < count - first, first, first - count)
    position = torch.where(slot < length, position, first)
    out, back = slot == torch.where(leaves, length, -1), slot == torch.where(enters, total - 1, -1)
    kept_x, kept_y = x.gather(0, position), y.gather(0, position)
    # Padding repeats the first vertex.
    return (
        torch.where(out, x_new[0], torch.where(back, x_new[1], kept_x)),
        torch.where(out, y_new[0], torch.where(back, y_new[1], kept_y)),
        total,
    )
