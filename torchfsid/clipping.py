r"""Intersecting batched polygons with half-spaces, and keeping them small.

The rows that some vertex exceeds by more than round-off cut the polygon one after the other, the deepest first, so that
most of the others have become redundant when their turn comes; only polygons that are really cut are touched. The cut
is differentiable in the rows and in the polygon it started from. Whatever round-off leaves open stays in: the result is
an outer set.

Where no gradient is needed, `polygon_kernel` does the same in compiled code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.compiled import array, use_kernel
from torchfsid.halfspaces import ROUND_OFF
from torchfsid.polygon import PRIOR, Polygon, cross, excess, lengths, round_off, take

PARALLEL = 1e-14
"""Sine of the angle below which two edges are not extended to their intersection."""


class Outcome(IntEnum):
    """What an intersection came to: a three-way answer, so that round-off is never taken for knowledge."""

    NONEMPTY = 0
    UNDECIDED = 1  # the sets touch within round-off: the cut is not made, the set stays an outer set
    EMPTY = 2


@dataclass(frozen=True)
class Contradiction:
    """Three rows per item that no point satisfies together (Helly); NaN where there is none."""

    A: Float[Tensor, "B 3 2"]
    b: Float[Tensor, "B 3"]
    time: Float[Tensor, "B 3"]
    source: Int[Tensor, "B 3"]

    @classmethod
    def none(cls, batch: int, like: Tensor) -> Contradiction:
        nothing = like.new_full((batch, 3), float("nan"))
        return cls(
            nothing.unsqueeze(-1).repeat(1, 1, 2), nothing, nothing.clone(), nothing.new_full((batch, 3), PRIOR).long()
        )


@dataclass(frozen=True)
class Clipped:
    """Polygons after a clip.

    Attributes:
        body: the intersection; where it is empty, the polygon as it was.
        outcome: an `Outcome` per item.
        shrunk: the item was really cut.
        contradiction: for empty items, the rows that contradict each other.
    """

    body: Polygon
    outcome: Int[Tensor, "B"]
    shrunk: Bool[Tensor, "B"]
    contradiction: Contradiction


def clip(
    polygon: Polygon,
    A: Float[Tensor, "B R 2"],
    b: Float[Tensor, "B R"],
    time: Float[Tensor, "B"],
    source: Int[Tensor, "B R"],
    most: int | None = None,
    compiled: bool | None = None,
) -> Clipped:
    """Intersect every polygon with its R half-spaces A z <= b, stamping new edges with `time` and `source`.

    A polygon left with more than `most` edges is merged; where that costs more than the cut has gained, it stays as it
    was. `compiled`: see `use_kernel`.

    Raises:
        InputError: `compiled` is True and cannot be.
    """
    if use_kernel(compiled, A, b, polygon.vertices, polygon.A, polygon.b):
        return _clip_compiled(polygon, A, b, time, source, most)
    outcome = torch.full((len(A),), Outcome.NONEMPTY, device=A.device)
    shrunk = torch.zeros(len(A), dtype=torch.bool, device=A.device)
    against = Contradiction.none(len(A), A)
    cuts = _Cuts.of(polygon, A, b)
    if len(cuts.item) == 0:
        return Clipped(polygon, outcome, shrunk, against)

    items = cuts.item
    before = polygon.select(items)
    table = _Table.of(before, A[items], b[items], time[items], source[items])
    rings, finished = _Rings.of(before), []
    verdict, changed = outcome[items], shrunk[items]
    for r in range(cuts.b.shape[1]):
        live = int((cuts.number > r).sum())  # the first ones: they come in the order of how many rows they have
        finished.append(rings.part(slice(live, None)))
        rings, a, c = rings.part(slice(live)), cuts.A[:live, r], cuts.b[:live, r].unsqueeze(-1)
        tolerance, edge = cuts.tolerance[:live, r].unsqueeze(-1), cuts.edge[:live, r].unsqueeze(-1)
        over = rings.vertices[..., 0] * a[:, :1] + rings.vertices[..., 1] * a[:, 1:] - c
        kept, surely = over <= tolerance, (over < -tolerance).any(-1)
        beyond = ~kept.all(-1) & (verdict[:live] != Outcome.EMPTY)
        empty, cut = beyond & ~kept.any(-1), beyond & surely
        verdict[:live] = torch.where(empty, Outcome.EMPTY, verdict[:live])
        verdict[:live] = torch.where(beyond & ~empty & ~surely, Outcome.UNDECIDED, verdict[:live])
        changed[:live] |= cut
        if bool(empty.any()):
            count, closest = rings.count[empty, None], over[empty].argmin(-1, keepdim=True)
            met = rings.edge[empty].gather(1, torch.cat([(closest - 1) % count, closest % count], dim=-1))
            lost = empty.nonzero().squeeze(-1)
            table.select(lost).report(torch.cat([edge[lost], met], dim=-1), items[lost], against)
        if bool(cut.all()):
            rings = _cut(rings, over, tolerance, edge, table.padding)
        elif bool(cut.any()):
            some = cut.nonzero().squeeze(-1)
            smaller = _cut(rings.part(some), over[some], tolerance[some], edge[some], table.padding)
            rings = rings.replaced(some, smaller, table.padding)

    rings = _Rings.join([rings, *reversed(finished)], table.padding)
    outcome[items] = verdict
    kept = (changed & (verdict != Outcome.EMPTY)).nonzero().squeeze(-1)
    smaller = table.select(kept).polygon(rings.part(kept), before.reach[kept])
    where, keep = items[kept], torch.ones_like(kept, dtype=torch.bool)
    if most is not None and bool((over_full := smaller.count > most).any()):
        merged = merge(smaller.select(over_full), most)
        # The areas are sums in some order.
        keep[over_full] = merged.volume() <= polygon.select(where[over_full]).volume() * (1 - ROUND_OFF)
        smaller = smaller.replaced(over_full.nonzero().squeeze(-1), merged)
    shrunk[where] = keep
    if not bool(keep.all()):
        where, smaller = where[keep], smaller.select(keep)
    return Clipped(polygon.replaced(where, smaller), outcome, shrunk, against)


def _clip_compiled(polygon: Polygon, A: Tensor, b: Tensor, time: Tensor, source: Tensor, most: int | None) -> Clipped:
    from torchfsid import polygon_kernel

    fields, outcome, shrunk, against = polygon_kernel.clip(
        tuple(map(array, polygon.fields())), array(A), array(b), array(time), array(source),
        A.shape[1] + polygon.slots if most is None else most, ROUND_OFF, PARALLEL,
    )  # fmt: skip
    shrunk = torch.from_numpy(shrunk)
    smaller = Polygon(*map(torch.from_numpy, fields)) if bool(shrunk.any()) else polygon
    return Clipped(smaller, torch.from_numpy(outcome), shrunk, Contradiction(*map(torch.from_numpy, against)))


def merge(polygon: Polygon, most: int) -> Polygon:
    """Outer polygons with at most `most` edges: drop, one by one, the edge whose removal adds the least area.

    A polygon whose edges cannot be extended to meet (a parallelogram, extreme needles) keeps them.
    """
    while True:
        over = (polygon.count > most).nonzero().squeeze(-1)
        part = polygon.select(over)
        added, corners = _removals(part)
        possible = added.isfinite().any(-1)
        if not bool(possible.any()):
            return polygon
        dropped = added[possible].argmin(-1, keepdim=True)
        smaller = _without_edge(part.select(possible), dropped, take(corners[possible], dropped))
        polygon = polygon.replaced(over[possible], smaller)


class _Cuts(NamedTuple):
    """The rows that cut, of polygons that are cut: those that most rows cut first, of each the deepest row first.

    Attributes:
        item: which polygon. number: how many rows cut it; the others behind them do not.
        edge: the number of the edge that a row will make: old edges are numbered by their slots, new ones behind them.
    """

    item: Int[Tensor, "k"]
    number: Int[Tensor, "k"]
    A: Float[Tensor, "k R 2"]
    b: Float[Tensor, "k R"]
    tolerance: Float[Tensor, "k R"]
    edge: Int[Tensor, "k R"]

    @classmethod
    def of(cls, polygon: Polygon, A: Float[Tensor, "B R 2"], b: Float[Tensor, "B R"]) -> _Cuts:
        with torch.no_grad():
            # Bounding boxes rule most polygons out.
            lower, upper = polygon.vertices.amin(1).unsqueeze(1), polygon.vertices.amax(1).unsqueeze(1)
            boxed = excess(A.clamp(min=0), b, upper) + A.clamp(max=0) @ lower.mT
            item = (boxed > 0).flatten(1).any(-1).nonzero().squeeze(-1)
            rows, bounds, part = A[item], b[item], polygon.select(item)
            tolerance = round_off(rows, bounds, part.reach)
            beyond = excess(rows, bounds, part.trimmed()).amax(-1)
            cutting = beyond > tolerance
            number, order = cutting.sum(-1).sort(descending=True)
            order = order[: int((number > 0).sum())]
            number, item = number[: len(order)], item[order]
            depth = torch.where(cutting, beyond / lengths(rows), -torch.inf)[order]
            first = depth.argsort(dim=-1, descending=True)[:, : int(number.max()) if len(order) else 0]
        return cls(
            item=item,
            number=number,
            A=take(A[item], first),
            b=b[item].gather(1, first),
            tolerance=tolerance[order].gather(1, first),
            edge=polygon.slots + first,
        )


class _Rings(NamedTuple):
    """Rings being cut: the vertices, and for each vertex the number of the edge that it starts."""

    vertices: Float[Tensor, "k V 2"]
    edge: Int[Tensor, "k V"]
    count: Int[Tensor, "k"]

    @classmethod
    def of(cls, polygon: Polygon) -> _Rings:
        vertices = polygon.trimmed()
        slots = torch.arange(vertices.shape[1], device=vertices.device)
        return cls(vertices, slots.expand(vertices.shape[:2]), polygon.count)

    def part(self, items: Tensor | slice) -> _Rings:
        return _Rings(*(field[items] for field in self))

    def replaced(self, items: Tensor, other: _Rings, padding: int) -> _Rings:
        slots = max(self.vertices.shape[1], other.vertices.shape[1])
        mine, theirs = self._widened(slots, padding), other._widened(slots, padding)
        return _Rings(*(field.index_put((items,), new) for field, new in zip(mine, theirs, strict=True)))

    @classmethod
    def join(cls, parts: Sequence[_Rings], padding: int) -> _Rings:
        slots = max(part.vertices.shape[1] for part in parts)
        wide = (part._widened(slots, padding) for part in parts)
        return cls(*(torch.cat(fields) for fields in zip(*wide, strict=True)))

    def _widened(self, slots: int, padding: int) -> _Rings:
        extra = slots - self.vertices.shape[1]
        if extra == 0:
            return self
        return self._replace(
            vertices=torch.cat([self.vertices, self.vertices[:, :1].expand(-1, extra, 2)], dim=1),
            edge=torch.nn.functional.pad(self.edge, (0, extra), value=padding),
        )


class _Table(NamedTuple):
    """What edges there may be: of the polygons by their slots, then of the rows; the last one is padding."""

    A: Float[Tensor, "k E 2"]
    b: Float[Tensor, "k E"]
    time: Float[Tensor, "k E"]
    source: Int[Tensor, "k E"]

    @classmethod
    def of(cls, polygon: Polygon, A: Tensor, b: Tensor, time: Tensor, source: Tensor) -> _Table:
        old = (polygon.A, polygon.b, polygon.time, polygon.source)
        new = (A, b, time.unsqueeze(-1).expand_as(b), source)
        return cls(
            *(torch.cat([o, n, p.unsqueeze(1)], dim=1) for o, n, p in zip(old, new, polygon.padding(), strict=True))
        )

    @property
    def padding(self) -> int:
        return self.b.shape[1] - 1

    def select(self, items: Tensor) -> _Table:
        return _Table(*(field[items] for field in self))

    def polygon(self, rings: _Rings, reach: Tensor) -> Polygon:
        A, (b, time, source) = take(self.A, rings.edge), (column.gather(1, rings.edge) for column in self[1:])
        return Polygon(rings.vertices, A, b, time, source, rings.count, reach)

    def report(self, edges: Int[Tensor, "k 3"], items: Tensor, against: Contradiction) -> None:
        """Three edges that contradict each other."""
        against.A[items] = take(self.A, edges).detach()
        for known, column in zip((against.b, against.time, against.source), self[1:], strict=True):
            known[items] = column.gather(1, edges).detach()


def _cut(rings: _Rings, over: Tensor, tolerance: Tensor, new: Tensor, padding: int) -> _Rings:
    """The part of each ring on the inner side of a line that really cuts it: `over` is a.v - c at its vertices.

    The vertices kept form one arc of the ring, first..last, around the deepest vertex; it is closed by the points where
    the ring leaves and enters the half-plane, unless the arc already ends on the line. `new` numbers the line's edge.
    """
    count = rings.count.unsqueeze(-1)
    slot = torch.arange(over.shape[1], device=count.device)
    kept = over <= tolerance
    deepest = over.argmin(-1, keepdim=True)
    ahead = kept.gather(1, (deepest + slot) % count).long().cumprod(-1).sum(-1, keepdim=True).clamp(max=count)
    behind = kept.gather(1, (deepest - slot) % count).long().cumprod(-1).sum(-1, keepdim=True).clamp(max=count)
    length = ahead + behind - 1
    first, last = (deepest - behind + 1) % count, (deepest + ahead - 1) % count
    before, after = (first - 1) % count, (last + 1) % count
    leaves = over.gather(1, last) < -tolerance
    enters = over.gather(1, first) < -tolerance

    total = length + leaves + enters
    slot = torch.arange(int(total.max()), device=count.device)
    position = torch.where(slot < length, (first + slot) % count, first)
    vertices = take(rings.vertices, position)
    out, back = (slot == length) & leaves, (slot == length + leaves) & enters
    vertices = torch.where(out.unsqueeze(-1), _crossing(rings.vertices, over, last, after), vertices)
    vertices = torch.where(back.unsqueeze(-1), _crossing(rings.vertices, over, first, before), vertices)
    edge = rings.edge.gather(1, torch.where(slot < length, position, before))
    edge = torch.where(slot == length - 1 + leaves, new, edge).masked_fill(slot >= total, padding)
    return _Rings(vertices, edge, total.squeeze(-1))


def _crossing(vertices: Tensor, over: Tensor, inner: Tensor, outer: Tensor) -> Float[Tensor, "k 1 2"]:
    """Where the ring meets the line, between a vertex within and one beyond."""
    s_inner, s_outer = over.gather(1, inner), over.gather(1, outer)
    start, end = take(vertices, inner), take(vertices, outer)
    return start + (s_inner / (s_inner - s_outer)).unsqueeze(-1) * (end - start)


def _removals(polygon: Polygon) -> tuple[Float[Tensor, "B V"], Float[Tensor, "B V 2"]]:
    """For each edge, the area added if its neighbours are extended until they meet (inf: they do not), and where."""
    count = polygon.count.unsqueeze(-1)
    slot = torch.arange(polygon.slots, device=count.device)
    along = torch.stack([-polygon.A[..., 1], polygon.A[..., 0]], dim=-1)
    incoming, outgoing = take(along, (slot - 1) % count), take(along, (slot + 1) % count)
    chord = take(polygon.vertices, (slot + 1) % count) - polygon.vertices
    turn = cross(incoming, outgoing)
    meets = (turn > PARALLEL * lengths(incoming) * lengths(outgoing)) & polygon.valid
    extended = torch.where(meets, cross(chord, outgoing), 0.0) / torch.where(meets, turn, 1.0)
    added = torch.where(meets, extended * cross(incoming, chord), torch.inf)
    return added.detach(), polygon.vertices + extended.unsqueeze(-1) * incoming


def _without_edge(polygon: Polygon, dropped: Int[Tensor, "B 1"], corner: Float[Tensor, "B 1 2"]) -> Polygon:
    """Each ring without one edge, its two ends replaced by the corner in which the neighbours meet."""
    count, V = polygon.count.unsqueeze(-1), polygon.slots
    slot = torch.arange(V - 1, device=count.device)
    filled = slot < count - 1
    position = torch.where(filled, (dropped + 1 + slot) % count, 0)
    vertices = torch.where(((slot == 0) | ~filled).unsqueeze(-1), corner, take(polygon.vertices, position))
    fields = take(polygon.A, position), *(f.gather(1, position) for f in (polygon.b, polygon.time, polygon.source))
    A, b, time, source = (
        torch.where(filled if field.ndim == 2 else filled.unsqueeze(-1), field, nothing.unsqueeze(1))
        for field, nothing in zip(fields, polygon.padding(), strict=True)
    )
    return Polygon(vertices, A, b, time, source, polygon.count - 1, polygon.reach)
