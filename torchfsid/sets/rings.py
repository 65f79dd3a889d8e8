r"""Rings of polygons while rows cut them, one column for each, so that whatever runs over vertices runs along columns.

A row a.z <= c that really cuts a ring keeps one arc of it, around the vertex deepest inside; the arc is closed by the
points where the ring crosses the line, unless it already ends on the line:

    kept: a.v - c <= tolerance;    a crossing, from v kept to w lost:  v + s_v/(s_v - s_w) (w - v),   s = a.z - c
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor


class Rings(NamedTuple):
    """The vertices, and for each vertex the number of the edge that it starts; slots behind `count` repeat the first
    vertex, and their edges mean nothing."""

    x: Float[Tensor, "V k"]
    y: Float[Tensor, "V k"]
    edge: Int[Tensor, "V k"]
    count: Int[Tensor, "k"]

    @classmethod
    def of(cls, vertices: Float[Tensor, "k V 2"], count: Int[Tensor, "k"]) -> Rings:
        """Edges are numbered by their slots."""
        x, y = columns(vertices)
        slots = torch.arange(len(x), device=count.device)
        return cls(x, y, slots.unsqueeze(-1).expand_as(x), count)

    def vertices(self) -> Float[Tensor, "k V 2"]:
        return torch.stack([self.x.T, self.y.T], dim=-1)

    def select(self, items: Int[Tensor, "s"]) -> Rings:
        if len(items) == len(self.count):
            return self
        x, y, edge = (chosen(field, items) for field in self[:3])
        return Rings(x, y, edge, self.count[items])

    def replaced(self, items: Int[Tensor, "s"], other: Rings) -> Rings:
        """These rings with `other` in the places `items`."""
        if len(items) == len(self.count):
            return other
        slots = max(len(self.x), len(other.x))
        mine, theirs = self._widened(slots), other._widened(slots)
        return Rings(*(field.index_copy(-1, items, new) for field, new in zip(mine, theirs, strict=True)))

    def _widened(self, slots: int) -> Rings:
        extra = slots - len(self.x)
        if extra == 0:
            return self
        x, y, edge = (torch.cat([field, field[:1].expand(extra, -1)]) for field in self[:3])
        return Rings(x, y, edge, self.count)

    def cut(
        self,
        over: Float[Tensor, "V k"],
        tolerance: Float[Tensor, "k"],
        deepest: Int[Tensor, "k"],
        new: Int[Tensor, "k"],
    ) -> Rings:
        """The part of each ring on the inner side of a line that really cuts it. `over` is a.v - c, `deepest` the
        vertex where it is least, `new` numbers the line's edge."""
        count, slot = self.count, _slots(len(over), over)
        lost = (over > tolerance) & (slot < count)
        # The first vertex lost after the deepest, and the last. In floats: torch's extremes of integers are slow.
        turned = (slot + torch.where(slot < deepest, count, 0)).to(over.dtype)
        after = torch.where(lost, turned, torch.inf).amin(0).long()
        before = torch.where(lost, turned, 0.0).amax(0).long()
        length = after + count - before - 1

        ends = torch.stack([after - 1, before + 1, after, before])
        ends = torch.where(ends >= count, ends - count, ends)  # before the deepest comes after it, a turn on
        (inner, outer), (x, x_lost), (y, y_lost) = (
            field.gather(0, ends).reshape(2, 2, -1).unbind(0) for field in (over, self.x, self.y)
        )
        share = inner / (inner - outer)
        x, y = x + share * (x_lost - x), y + share * (y_lost - y)
        leaves, enters = inner < -tolerance

        total, first = length + leaves + enters, ends[1]
        slot = _slots(int(total.max()), over)
        position = slot + torch.where(slot < count - first, first, first - count)
        position = torch.where(slot < length, position, first)
        out = slot == torch.where(leaves, length, -1)
        back = slot == torch.where(enters, total - 1, -1)
        edge = torch.where(back, self.edge.gather(0, ends[3:]), self.edge.gather(0, position))
        return Rings(
            torch.where(out, x[0], torch.where(back, x[1], self.x.gather(0, position))),
            torch.where(out, y[0], torch.where(back, y[1], self.y.gather(0, position))),
            torch.where(slot == length - 1 + leaves, new, edge),
            total,
        )


def chosen(table: Shaped[Tensor, "V k"], items: Int[Tensor, "s"]) -> Shaped[Tensor, "V s"]:
    """The columns of these items, faster than by an index."""
    return table.gather(1, items.expand(len(table), -1))


def _slots(number: int, like: Tensor) -> Int[Tensor, "V 1"]:
    return torch.arange(number, device=like.device).unsqueeze(-1)


def columns(points: Float[Tensor, "k V 2"]) -> tuple[Float[Tensor, "V k"], Float[Tensor, "V k"]]:
    """The coordinates, a column for each item."""
    x, y = points.unbind(-1)
    return x.T.contiguous(), y.T.contiguous()
