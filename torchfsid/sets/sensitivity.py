r"""How what is asked of polytopes changes with their rows A z <= b: numbers from `cells`, derivatives in torch.

Which facets meet in a vertex, fill the boundary, touch the ball or are active is known from there; these are solved:

    vertex            A_I z = b_I                      I: p of its facets (`faces.bases`)
    inscribed ball    A_I z + |A_I| r = b_I            I: the p + 1 facets that decide it
    nearest point     H (z - q) + A_I' mu = 0, A_I z = b_I        I: the active facets

A solution is corrected by an equation for what is left of its residual, nothing but round-off: its number stays as it
was, its derivatives, of any order, are those of the equation. Volume V and centroid c change by what the facets sweep,

    dV = sum_f int_f (db_f - z.dA_f) dS / |A_f|,     dc = sum_f int_f (z - c) (db_f - z.dA_f) dS / (|A_f| V),

integrals over the simplices that fill a facet. So their first derivatives do not depend on how a vertex is written, and
are right also where more than p facets meet in one; the second ones need vertices that do not (a simple polytope).
All of it in the frame of each cell, in which a thin set is as wide as long.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.programmes.differentiable import solve_active, times
from torchfsid.sets.cell import Cell
from torchfsid.sets.faces import Indices, Mask, Reals, bases, simplices


def vertices(
    A: Float[Tensor, "B F p"], b: Float[Tensor, "B F"], corners: Float[Tensor, "B V p"], cells: Sequence[Cell]
) -> Float[Tensor, "B V p"]:
    """The corners as functions of the rows; one that is not the solution of p facets does not depend on them."""
    frame = _Frame.of(cells, A)
    points = _Points.of([(cell.in_frame[1], *cell.bases) for cell in cells], A)
    moved = corners[points.item, points.slot] + frame.outside(points.step(*frame.rows(A, b)), points.item)
    slot = torch.arange(corners.shape[1], device=A.device)
    place = points.first.unsqueeze(-1) + torch.where(slot < points.number.unsqueeze(-1), slot, 0)
    return moved[place]


def measure(
    A: Float[Tensor, "B F p"], b: Float[Tensor, "B F"], cells: Sequence[Cell]
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B p"]]:
    """Volume and centroid; those of a set that is flat within round-off do not depend on the rows."""
    return _Measure.apply(A, b, cells)  # type: ignore[return-value]


def inscribed_ball(
    A: Float[Tensor, "B F p"], b: Float[Tensor, "B F"], cells: Sequence[Cell]
) -> tuple[Float[Tensor, "B p"], Float[Tensor, "B"]]:
    """Centre and radius; those of a set that is flat within round-off do not depend on the rows."""
    p = A.shape[-1]
    centre, radius = _stacked([cell.ball[0] for cell in cells], A), _stacked([cell.ball[1] for cell in cells], A)
    decided = [i for i, cell in enumerate(cells) if len(cell.ball[2]) > 0]
    if not decided:
        return centre, radius
    items = torch.tensor(decided, device=A.device)
    facets = torch.as_tensor(np.array([cells[i].ball[2] for i in decided]), device=A.device)
    frame = _Frame.of(cells, A)
    rows, right = (table[items.unsqueeze(-1), facets] for table in frame.rows(A, b))
    width = frame.scale[items].amin(-1, keepdim=True)
    lengths = torch.linalg.vector_norm(A[items.unsqueeze(-1), facets], dim=-1) * width
    ball = torch.cat([frame.inside(centre)[items], radius[items].unsqueeze(-1) / width], dim=-1)
    step = _step(torch.cat([rows, lengths.unsqueeze(-1)], dim=-1), right, ball)
    moved = torch.zeros_like(centre).index_put((items,), frame.outside(step[:, :p], items))
    return centre + moved, radius + torch.zeros_like(radius).index_put((items,), step[:, p] * width.squeeze(-1))


def nearest(
    A: Float[Tensor, "B F p"],
    b: Float[Tensor, "B F"],
    point: Float[Tensor, "B p"],
    metric: Float[Tensor, "B p p"] | None,
    feet: Float[Tensor, "B p"],
    active: Sequence[Indices],
) -> Float[Tensor, "B p"]:
    """The feet as functions of rows, point and metric."""
    p, counts = A.shape[-1], [min(len(facets), A.shape[-1]) for facets in active]
    facets = np.zeros((len(active), p), dtype=np.int64)
    for i, count in enumerate(counts):
        facets[i, :count] = active[i][:count]
    items, index = torch.arange(len(active), device=A.device)[:, None], torch.as_tensor(facets, device=A.device)
    filled = torch.arange(p, device=A.device) < torch.tensor(counts, device=A.device).unsqueeze(-1)
    unit = Halfspaces(A[items, index], b[items, index]).normalised()
    pull = point - feet
    step, _ = solve_active(
        torch.where(filled.unsqueeze(-1), unit.A, 0.0),
        filled,
        pull if metric is None else times(metric, pull),
        torch.where(filled, unit.b - times(unit.A, feet), 0.0),
        metric,
    )
    return feet + step - step.detach()


class _Frame(NamedTuple):
    """The frames of the cells: z = centre + (y * scale) axes."""

    centre: Float[Tensor, "B p"]
    axes: Float[Tensor, "B p p"]
    scale: Float[Tensor, "B p"]

    @classmethod
    def of(cls, cells: Sequence[Cell], like: Tensor) -> _Frame:
        centre, axes, scale = (_stacked([cell.frame[k] for cell in cells], like) for k in range(3))
        return cls(centre, axes, torch.where(scale > 0, scale, 1.0))

    def rows(self, A: Tensor, b: Tensor) -> tuple[Float[Tensor, "B F p"], Float[Tensor, "B F"]]:
        """The rows, for y."""
        return A @ self.axes.mT * self.scale.unsqueeze(-2), b - times(A, self.centre)

    def inside(self, z: Float[Tensor, "B p"]) -> Float[Tensor, "B p"]:
        return times(self.axes, z - self.centre) / self.scale

    def outside(self, step: Float[Tensor, "N p"], item: Int[Tensor, "N"]) -> Float[Tensor, "N p"]:
        """A change of y as one of z."""
        return times(self.axes.mT[item], step * self.scale[item])


class _Points(NamedTuple):
    """Vertices of all cells in one row, in their frames.

    Attributes:
        y: where they are. item, slot: of which cell, and which of its vertices. basis: the facets that they solve.
        solved: they do. first, number: of each cell, its first vertex and how many it has.
    """

    y: Float[Tensor, "N p"]
    item: Int[Tensor, "N"]
    slot: Int[Tensor, "N"]
    basis: Int[Tensor, "N p"]
    solved: Tensor
    first: Int[Tensor, "B"]
    number: Int[Tensor, "B"]

    @classmethod
    def of(cls, parts: Sequence[tuple[Reals, Indices, Mask]], like: Tensor) -> _Points:
        y, basis, solved = (np.concatenate(field) for field in zip(*parts, strict=True))
        number = np.array([len(part[0]) for part in parts])
        first = number.cumsum() - number
        item = np.repeat(np.arange(len(parts)), number)
        fields = (y, item, np.arange(len(y)) - first[item], basis, solved, first, number)
        return cls(*(torch.as_tensor(field, device=like.device) for field in fields))

    def step(self, rows: Float[Tensor, "B F p"], right: Float[Tensor, "B F"]) -> Float[Tensor, "N p"]:
        """Zero, and how they change with the rows."""
        index, solved = (self.item.unsqueeze(-1), self.basis), self.solved.unsqueeze(-1)
        identity = torch.eye(self.y.shape[-1], dtype=rows.dtype, device=rows.device)
        M = torch.where(solved.unsqueeze(-1), rows[index], identity)
        return _step(M, torch.where(solved, right[index], self.y), self.y)


class _Measure(torch.autograd.Function):
    """(A, b, cells) -> volume and centroid."""

    @staticmethod
    def forward(ctx: Any, A: Tensor, b: Tensor, cells: Sequence[Cell]) -> tuple[Tensor, Tensor]:
        volume, centroid = (_stacked([cell.measure[k] for cell in cells], A) for k in range(2))
        ctx.cells = cells
        ctx.save_for_backward(A, b, volume, centroid)
        return volume, centroid

    @staticmethod
    def backward(ctx: Any, of_volume: Tensor, of_centroid: Tensor) -> tuple[Tensor, Tensor, None]:
        A, b, volume, centroid = ctx.saved_tensors
        (B, F, p), cells = A.shape, ctx.cells
        frame, filled = _Frame.of(cells, A), [_filled(cell) for cell in cells]
        points = _Points.of([part for part, _, _ in filled], A)
        item = np.repeat(np.arange(B), [len(facet) for _, _, facet in filled])
        corner = np.concatenate([corner for _, corner, _ in filled])
        facet = np.concatenate([facet for _, _, facet in filled]) + F * item
        item, corner, facet = (torch.as_tensor(index, device=A.device) for index in (item, corner, facet))
        corner = corner + points.first[item].unsqueeze(-1)

        rows, right = frame.rows(A, b)
        y, normal = points.y, rows.reshape(-1, p)[facet]
        if torch.is_grad_enabled():  # second derivatives are wanted
            y = y + points.step(rows, right)
        edges = y[corner[:, 1:]] - y[corner[:, :1]]
        area = torch.linalg.det(torch.cat([edges, normal.unsqueeze(1)], dim=1)).abs() / factorial(p - 1)
        area = area * frame.scale.prod(-1)[item] / normal.square().sum(-1)  # over the length of the row

        ends = (frame.outside(y, points.item) + (frame.centre - centroid)[points.item])[corner]
        pull = (of_centroid / torch.where(volume > 0, volume, 1.0).unsqueeze(-1))[item]
        along, total, push = times(ends, pull), ends.sum(1), of_volume[item]
        of_right = area * (push + along.sum(-1) / p)
        moments = times(ends.mT, along) + total * along.sum(-1, keepdim=True)
        of_row = -area.unsqueeze(-1) * (push.unsqueeze(-1) * total / p + moments / (p * (p + 1)))
        of_b = torch.zeros_like(b).reshape(-1).index_add(0, facet, of_right).reshape(B, F)
        of_A = torch.zeros_like(A).reshape(-1, p).index_add(0, facet, of_row).reshape(B, F, p)
        return of_A - of_b.unsqueeze(-1) * centroid.unsqueeze(-2), of_b, None


def _filled(cell: Cell) -> tuple[tuple[Reals, Indices, Mask], Indices, Indices]:
    """For `_Points`, the vertices that fix the volume; the simplices that fill the facets, and of which facet they are.

    Nothing if the cell is flat."""
    p, (rows, y), incident = cell.A.shape[1], cell.in_frame, cell.incident
    if not cell.frame[2].all():
        y, incident = y[:0], incident[:0]
        return (y, *bases(rows, incident)), np.zeros((0, p), dtype=np.int64), np.zeros(0, dtype=np.int64)
    _, _, y, incident = cell.solid
    solutions = cell.bases if incident is cell.incident else bases(rows, incident)
    return (y, *solutions), *simplices(incident, p)


def _step(M: Float[Tensor, "N k k"], right: Float[Tensor, "N k"], solution: Float[Tensor, "N k"]) -> Tensor:
    """Zero, and how the solution of M w = right changes."""
    step = torch.linalg.solve(M, right - times(M, solution.detach()))
    return step - step.detach()


def _stacked(values: Sequence[Any], like: Tensor) -> Tensor:
    return torch.as_tensor(np.array(values), dtype=like.dtype, device=like.device)
