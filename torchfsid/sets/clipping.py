r"""Intersecting batched polygons with half-spaces, and keeping them small.

The rows that some vertex exceeds by more than round-off cut the polygon one after the other, the deepest first, so that
most of the others have become redundant when their turn comes; only polygons that are really cut are touched. The cut
is differentiable in the rows and in the polygon it started from. Whatever round-off leaves open stays in: the result is
an outer set.

Where no gradient is needed, `polygon_kernel` does the same in compiled code.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.halfspaces import array
from torchfsid.kernels.compiled import use_kernel
from torchfsid.outcome import Outcome
from torchfsid.sets.body import Clipped, Contradiction
from torchfsid.sets.polygon import Polygon, cross, lengths, round_off, take
from torchfsid.sets.rings import Rings, chosen, columns
from torchfsid.tolerances import PARALLEL_EDGES, ROUND_OFF

CHUNK = 2048
"""Polygons that are cut at a time; an eighth of them where every row is looked at on every vertex."""


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
    against, cuts, smaller = Contradiction.none(len(A), 2, A), _Cuts.of(polygon, A, b), []
    for some in cuts.chunks():
        part = polygon.select(some.item)
        table = _Table.of(part, *(field.index_select(0, some.item) for field in (A, b, time, source)))
        rings, verdict, cut = _cut(part, some, table, against)
        outcome[some.item] = verdict
        kept = (cut & (verdict != Outcome.EMPTY)).nonzero().squeeze(-1)
        shrunk[some.item[kept]] = True
        smaller.append(table.select(kept).polygon(rings.select(kept), part.reach[kept]))
    if not bool(shrunk.any()):
        return Clipped(polygon, outcome, shrunk, against)
    where, body = cuts.item[shrunk[cuts.item]], Polygon.join(smaller)
    if most is not None and len(full := (body.count > most).nonzero().squeeze(-1)) > 0:
        merged = merge(body.select(full), most)
        # The areas are sums in some order.
        worth = merged.volume() <= polygon.select(where[full]).volume() * (1 - ROUND_OFF)
        shrunk[where[full[~worth]]] = False
        kept = shrunk[where].nonzero().squeeze(-1)
        where, body = where[kept], body.replaced(full, merged).select(kept)
    return Clipped(polygon.replaced(where, body), outcome, shrunk, against)


def _clip_compiled(polygon: Polygon, A: Tensor, b: Tensor, time: Tensor, source: Tensor, most: int | None) -> Clipped:
    from torchfsid.kernels import polygon as polygon_kernel

    fields, outcome, shrunk, against = polygon_kernel.clip(
        tuple(map(array, polygon.fields())), array(A), array(b), array(time), array(source),
        A.shape[1] + polygon.slots if most is None else most, ROUND_OFF, PARALLEL_EDGES,
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
        possible = added.isfinite().any(-1).nonzero().squeeze(-1)
        if len(possible) == 0:
            return polygon
        dropped = added[possible].argmin(-1, keepdim=True)
        smaller = _without_edge(part.select(possible), dropped, take(corners[possible], dropped))
        polygon = polygon.replaced(over[possible], smaller)


class _Cuts(NamedTuple):
    """The rows that cut, of polygons that are cut: those that most rows cut first, of each the deepest row first.

    Attributes:
        item: which polygon. number: how many rows cut it; the others behind them do not.
        row: which of its rows.
        p, q, b: p x + q y <= b. tolerance: round-off of p x + q y - b.
    """

    item: Int[Tensor, "k"]
    number: Int[Tensor, "k"]
    row: Int[Tensor, "R k"]
    p: Float[Tensor, "R k"]
    q: Float[Tensor, "R k"]
    b: Float[Tensor, "R k"]
    tolerance: Float[Tensor, "R k"]

    @classmethod
    def of(cls, polygon: Polygon, A: Float[Tensor, "B R 2"], b: Float[Tensor, "B R"]) -> _Cuts:
        with torch.no_grad():
            item = _boxed(polygon, A, b)
            item = item[polygon.count[item].argsort(descending=True)]  # rings of like size have little padding
            depths, tolerances = [A.new_zeros(0, A.shape[1])], [A.new_zeros(0, A.shape[1])]
            for some in item.split(CHUNK // 8) if len(item) > 0 else ():
                rows, bounds = A.index_select(0, some), b.index_select(0, some)
                slots = int(polygon.count[some[0]])
                (p, q), (x, y) = columns(rows), columns(polygon.vertices[:, :slots].index_select(0, some))
                beyond = (p * x.unsqueeze(1) + q * y.unsqueeze(1)).amax(0).T - bounds
                tolerances.append(round_off(rows, bounds, polygon.reach[some]))
                depths.append(torch.where(beyond > tolerances[-1], beyond / lengths(rows), -torch.inf))
            depth, tolerance = torch.cat(depths), torch.cat(tolerances)
            number, order = depth.isfinite().sum(-1).sort(descending=True, stable=True)
            number, order = number[: (live := int((number > 0).sum()))], order[:live]
            item = item[order]
            row = depth[order].argsort(dim=-1, descending=True)[:, : int(number[0]) if live else 0]
        return cls(
            item=item,
            number=number,
            row=row.T.contiguous(),
            p=A[..., 0].index_select(0, item).gather(1, row).T.contiguous(),
            q=A[..., 1].index_select(0, item).gather(1, row).T.contiguous(),
            b=b.index_select(0, item).gather(1, row).T.contiguous(),
            tolerance=tolerance[order].gather(1, row).T.contiguous(),
        )

    def chunks(self) -> Iterator[_Cuts]:
        """Some items at a time, so that what is computed of them stays in the processor's cache."""
        for first in range(0, len(self.item), CHUNK):
            rows = int(self.number[first])
            yield _Cuts(*(f[first : first + CHUNK] if f.ndim == 1 else f[:rows, first : first + CHUNK] for f in self))


def _boxed(polygon: Polygon, A: Float[Tensor, "B R 2"], b: Float[Tensor, "B R"]) -> Int[Tensor, "k"]:
    """The polygons whose bounding boxes some row cuts."""
    (x, y), (p, q) = columns(polygon.vertices), columns(A)
    beyond = p * torch.where(p > 0, x.amax(0), x.amin(0)) + q * torch.where(q > 0, y.amax(0), y.amin(0)) > b.T
    return beyond.any(0).nonzero().squeeze(-1)


def _cut(polygon: Polygon, cuts: _Cuts, table: _Table, against: Contradiction) -> tuple[Rings, Tensor, Tensor]:
    """The rings after all cuts, the `Outcome` of each, and whether it was cut; reports contradictions to `against`."""
    rings = Rings.of(polygon.vertices, polygon.count)
    verdict = torch.full_like(cuts.number, Outcome.NONEMPTY)
    changed, first_row = torch.zeros_like(verdict, dtype=torch.bool), len(rings.x)
    turns = torch.arange(len(cuts.b), device=cuts.number.device).unsqueeze(-1)
    for r, live in enumerate((cuts.number > turns).sum(-1).tolist()):  # the first ones: they have most rows
        p, q, b, tolerance, row = (f[r, :live] for f in (cuts.p, cuts.q, cuts.b, cuts.tolerance, cuts.row))
        over = rings.x[:, :live] * p + rings.y[:, :live] * q - b
        known = over.detach()
        lowest, deepest = known.min(0)
        beyond = (known.amax(0) > tolerance) & (verdict[:live] != Outcome.EMPTY)
        cut = beyond & (lowest < -tolerance)
        touched = (beyond & ~cut).nonzero().squeeze(-1)
        if len(touched) > 0:
            verdict[touched] = Outcome.UNDECIDED
            lost = touched[lowest[touched] > tolerance[touched]]
            closest, count = deepest[lost], rings.count[lost]
            met = rings.edge[:, lost].gather(0, torch.stack([(closest - 1) % count, closest]))
            edges, rows = torch.cat([first_row + row[None, lost], met]).T, table.select(lost)
            proven = _contradict(take(rows.A, edges), rows.b.gather(1, edges), polygon.reach[lost])
            proven = proven.nonzero().squeeze(-1)
            verdict[lost[proven]] = Outcome.EMPTY
            rows.select(proven).report(edges[proven], cuts.item[lost[proven]], against)
        some = cut.nonzero().squeeze(-1)
        if len(some) > 0:
            changed[some] = True
            row = first_row + row[some]
            smaller = rings.select(some).cut(chosen(over, some), tolerance[some], deepest[some], row)
            rings = rings.replaced(some, smaller)
    return rings, verdict, changed


def _contradict(A: Float[Tensor, "k 3 2"], b: Float[Tensor, "k 3"], reach: Float[Tensor, "k 2"]) -> Bool[Tensor, "k"]:
    """Is it proven that no point within `reach` satisfies the three rows? The first one is beyond all vertices, the
    others are the edges at the nearest vertex, which is itself uncertain where they are nearly parallel.

    The proof is a y >= 0 with y_1 = 1 and y'b + |y'A| reach < 0 by more than round-off: the y for which y'A = 0, or, if
    an edge alone will do, the y for which |y'A| is least.
    """
    A, b = A.detach(), b.detach()
    row, first, second = A.unbind(1)
    turn = cross(first, second)
    both = torch.stack([cross(second, row), cross(row, first)], dim=-1) / turn.unsqueeze(-1)
    alone = torch.diag_embed(-(A[:, 1:] * A[:, :1]).sum(-1) / A[:, 1:].square().sum(-1))
    y = torch.cat([both.unsqueeze(1), alone], dim=1).nan_to_num(0.0, 0.0, 0.0).clamp(min=0)
    y = torch.nn.functional.pad(y, (1, 0), value=1.0)
    noise = (y @ round_off(A, b, reach).unsqueeze(-1)).squeeze(-1) + ((y @ A).abs() @ reach.unsqueeze(-1)).squeeze(-1)
    return ((y @ b.unsqueeze(-1)).squeeze(-1) < -noise).any(-1)


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
        parts = zip(old, new, polygon.padding(), strict=True)
        return cls(*(torch.cat([o, n, p.unsqueeze(1)], dim=1) for o, n, p in parts))

    @property
    def padding(self) -> int:
        return self.b.shape[1] - 1

    def select(self, items: Tensor) -> _Table:
        if len(items) == len(self.b):
            return self
        return _Table(*(field.index_select(0, items) for field in self))

    def polygon(self, rings: Rings, reach: Tensor) -> Polygon:
        slot = torch.arange(len(rings.edge), device=reach.device)
        edge = torch.where(slot < rings.count.unsqueeze(-1), rings.edge.T, self.padding)
        b, time, source = (column.gather(1, edge) for column in self[1:])
        return Polygon(rings.vertices(), take(self.A, edge), b, time, source, rings.count, reach)

    def report(self, edges: Int[Tensor, "k 3"], items: Tensor, against: Contradiction) -> None:
        """Three edges that contradict each other."""
        against.A[items] = take(self.A, edges).detach()
        for known, column in zip((against.b, against.time, against.source), self[1:], strict=True):
            known[items] = column.gather(1, edges).detach()


def _removals(polygon: Polygon) -> tuple[Float[Tensor, "B V"], Float[Tensor, "B V 2"]]:
    """For each edge, the area added if its neighbours are extended until they meet (inf: they do not), and where."""
    count = polygon.count.unsqueeze(-1)
    slot = torch.arange(polygon.slots, device=count.device)
    along = torch.stack([-polygon.A[..., 1], polygon.A[..., 0]], dim=-1)
    incoming, outgoing = take(along, (slot - 1) % count), take(along, (slot + 1) % count)
    chord = take(polygon.vertices, (slot + 1) % count) - polygon.vertices
    turn = cross(incoming, outgoing)
    meets = (turn > PARALLEL_EDGES * lengths(incoming) * lengths(outgoing)) & polygon.valid
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
