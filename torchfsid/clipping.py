r"""Intersecting batched polygons with half-spaces, and keeping them small.

While any polygon is cut by more than round-off, cut it by the row that cuts it deepest; only polygons that are really
cut are touched, and later rows that the deep cuts made redundant never cost anything. The cut is differentiable in the
rows and in the polygon it started from. Whatever round-off leaves open stays in: the result is an outer set.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

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

    def record(
        self, items: Tensor, a: Tensor, c: Tensor, time: Tensor, source: Tensor, lost: Polygon, edges: Tensor
    ) -> None:
        """The row (a, c) with the two `edges` of the polygon that meet at the vertex nearest to it."""
        self.A[items] = torch.cat([a.unsqueeze(1), take(lost.A, edges)], dim=1).detach()
        self.b[items] = torch.cat([c.unsqueeze(1), lost.b.gather(1, edges)], dim=1).detach()
        self.time[items] = torch.cat([time.unsqueeze(1), lost.time.gather(1, edges)], dim=1)
        self.source[items] = torch.cat([source.unsqueeze(1), lost.source.gather(1, edges)], dim=1)


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
) -> Clipped:
    """Intersect every polygon with its R half-spaces A z <= b, stamping new edges with `time` and `source`."""
    B, before = len(A), polygon
    outcome = torch.full((B,), Outcome.NONEMPTY, device=A.device)
    shrunk = torch.zeros(B, dtype=torch.bool, device=A.device)
    against = Contradiction.none(B, A)
    cutting = _cuts(polygon, A, b)
    while len(items := cutting.any(-1).nonzero().squeeze(-1)) > 0:
        part = polygon.select(items)
        with torch.no_grad():
            depth = excess(A[items], b[items], part.vertices).amax(-1) / lengths(A[items])
            row = torch.where(cutting[items], depth, -torch.inf).argmax(-1)
        a, c = A[items, row], b[items, row]
        over = (part.vertices @ a.unsqueeze(-1)).squeeze(-1) - c.unsqueeze(-1)
        tolerance = round_off(a.unsqueeze(1), c.unsqueeze(1), part.reach)
        kept, strictly = over <= tolerance, over < -tolerance
        empty, surely = ~kept.any(-1), strictly.any(-1)
        outcome[items] = torch.where(empty, Outcome.EMPTY, torch.where(surely, outcome[items], Outcome.UNDECIDED))
        # Another order of the same sums may have found a vertex beyond the line that this one finds on it.
        cut = surely & ~kept.all(-1)
        cutting[items, row] = False

        if bool(empty.any()):
            lost, where = part.select(empty), items[empty]
            cutting[where] = False
            closest = over[empty].argmin(-1)
            edges = torch.stack([(closest - 1) % lost.count, closest % lost.count], dim=-1)
            against.record(where, a[empty], c[empty], time[where], source[where, row[empty]], lost, edges)
        if bool(cut.any()):
            where = items[cut]
            line = _Line(a[cut], c[cut], over[cut], tolerance[cut], time[where], source[where, row[cut]])
            smaller = _cut(part.select(cut), line)
            polygon = polygon.replaced(where, smaller)
            shrunk[where] = True
            cutting[where] &= _cuts(smaller, A[where], b[where])

    empty = (outcome == Outcome.EMPTY).nonzero().squeeze(-1)
    if len(empty) > 0:
        polygon = polygon.replaced(empty, before.select(empty))
        shrunk[empty] = False
    return Clipped(polygon, outcome, shrunk, against)


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


@dataclass(frozen=True)
class _Line:
    """A line a.z = c that cuts every polygon of a batch: `over` is a.v - c at its vertices."""

    a: Tensor
    c: Tensor
    over: Tensor
    tolerance: Tensor
    time: Tensor
    source: Tensor


def _cut(polygon: Polygon, line: _Line) -> Polygon:
    """The part of each polygon on the inner side of a line that really cuts it.

    The vertices kept form one arc of the ring, first..last, around the deepest vertex; it is closed by the points where
    the ring leaves and enters the half-plane, unless the arc already ends on the line.
    """
    V, count = polygon.slots, polygon.count.unsqueeze(-1)
    slot = torch.arange(V, device=count.device)
    kept = line.over <= line.tolerance
    deepest = line.over.argmin(-1, keepdim=True)
    ahead = kept.gather(1, (deepest + slot) % count).long().cumprod(-1).sum(-1, keepdim=True).clamp(max=count)
    behind = kept.gather(1, (deepest - slot) % count).long().cumprod(-1).sum(-1, keepdim=True).clamp(max=count)
    length = ahead + behind - 1
    first, last = (deepest - behind + 1) % count, (deepest + ahead - 1) % count
    before, after = (first - 1) % count, (last + 1) % count
    leaves = line.over.gather(1, last) < -line.tolerance
    enters = line.over.gather(1, first) < -line.tolerance

    total = length + leaves + enters
    slot = torch.arange(int(total.max()), device=count.device)
    on_arc = slot < length
    vertices = take(polygon.vertices, torch.where(on_arc, (first + slot) % count, first))
    vertices = torch.where(((slot == length) & leaves).unsqueeze(-1), _crossing(polygon, line, last, after), vertices)
    vertices = torch.where(
        ((slot == length + leaves) & enters).unsqueeze(-1), _crossing(polygon, line, first, before), vertices
    )

    edge = torch.where(on_arc, (first + slot) % count, before)
    edge = torch.where(slot == length - 1 + leaves, V, torch.where(slot >= total, V + 1, edge))
    return _ring(polygon, vertices, edge, total.squeeze(-1), line)


def _crossing(polygon: Polygon, line: _Line, inner: Tensor, outer: Tensor) -> Tensor:
    """Where the ring meets the line, between a vertex within and one beyond."""
    s_inner, s_outer = line.over.gather(1, inner), line.over.gather(1, outer)
    start, end = take(polygon.vertices, inner), take(polygon.vertices, outer)
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
    padding = slot >= count - 1
    position = torch.where(padding, 0, (dropped + 1 + slot) % count)
    vertices = torch.where(((slot == 0) | padding).unsqueeze(-1), corner, take(polygon.vertices, position))
    return _ring(polygon, vertices, torch.where(padding, V + 1, position), polygon.count - 1)


def _ring(
    polygon: Polygon,
    vertices: Float[Tensor, "B W 2"],
    edge: Int[Tensor, "B W"],
    count: Int[Tensor, "B"],
    line: _Line | None = None,
) -> Polygon:
    """New rings whose edges are old ones by their slot, or V: the new line, or V + 1: padding."""
    none = polygon.padding()
    new = none if line is None else (line.a, line.c, line.time, line.source)
    old = (polygon.A, polygon.b, polygon.time, polygon.source)
    tables = [torch.cat([o, n.unsqueeze(1), p.unsqueeze(1)], dim=1) for o, n, p in zip(old, new, none, strict=True)]
    A, *others = tables
    b, time, source = (table.gather(1, edge) for table in others)
    return Polygon(vertices, take(A, edge), b, time, source, count, polygon.reach)


@torch.no_grad()
def _cuts(polygon: Polygon, A: Float[Tensor, "B R 2"], b: Float[Tensor, "B R"]) -> Bool[Tensor, "B R"]:
    """Rows that some vertex exceeds by more than round-off."""
    return excess(A, b, polygon.vertices).amax(-1) > round_off(A, b, polygon.reach)
