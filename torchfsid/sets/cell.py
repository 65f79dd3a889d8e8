r"""One bounded convex polytope in R^p, in numpy: a cell, and how it is cut. `polytope` handles batches of cells.

A cell is stored by its facets and its vertices,

    facet f: A_f.z <= b_f,    vertex v: z_v,    incident[v, f]: vertex v lies on facet f.

A cell is cut by a half-space a.z <= c in one step of the double-description method. Let s = a.z - c. The vertices
beyond the half-space (s > 0) are dropped. Every edge from a vertex v inside to a vertex w beyond ends in the new vertex

    z_v + s_v / (s_v - s_w) (z_w - z_v);    an edge: v and w share p - 1 facets.

No equation is solved. So a vertex lies on its facets to round-off, however thin the set is.

A point is removed only if it is outside beyond round-off: every set is an outer set. A row that would leave less than
twice its round-off of the cell is moved outward until it leaves that much. So a cell always has an interior, and a set
without one (a facet, an edge, a point) is a cell as thin as round-off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from math import inf
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from torchfsid.outcome import Status
from torchfsid.sets.faces import Indices, Mask, Reals
from torchfsid.sets.shape import Frame, Shape, lengths
from torchfsid.tolerances import ROUND_OFF

REACH = 100.0
"""A set that grows to more than this many times its size without a facet is taken to be unbounded without it."""

NOTHING = np.zeros(0, dtype=np.int64)

CANDIDATES = 4
"""Of the facets that could be dropped, this many, the smallest, are compared by the volume that they keep out."""


@dataclass(frozen=True, eq=False)
class Cell:
    """A polytope with F facets and V vertices. `reach` (p,) holds the largest |coordinates| that it ever had, to which
    its round-off is proportional."""

    A: Reals
    b: Reals
    vertices: Reals
    incident: Mask
    reach: Reals

    @classmethod
    def box(cls, lower: Reals, upper: Reals) -> Cell:
        """The cell lower <= z <= upper. Its facets are the lower sides -z_i <= -lower_i, then the upper sides."""
        is_upper, unit = np.array(list(product([False, True], repeat=len(lower)))), np.eye(len(lower))
        return cls(
            A=np.vstack([-unit, unit]),
            b=np.append(-lower, upper),
            vertices=np.where(is_upper, upper, lower),
            incident=np.hstack([~is_upper, is_upper]),
            reach=np.maximum(np.abs(lower), np.abs(upper)),
        )

    @property
    def frame(self) -> Frame:
        return Frame.of(self.vertices[None], np.ones((1, len(self.vertices)), dtype=bool), self.reach[None])

    @property
    def content(self) -> float:
        """The volume. That of a flat cell is a multiple of round-off."""
        count = np.array([len(self.vertices)])
        shape = Shape(self.A[None], self.b[None], self.vertices[None], count, self.incident[None], self.reach[None])
        return float(shape.content[0])

    def round_off(self, A: Reals, b: Reals) -> Reals:
        """A bound on the rounding error of A z - b over the cell."""
        return ROUND_OFF * (np.abs(A) @ self.reach + np.abs(b))


class Intersection(NamedTuple):
    """A cell intersected with rows.

    Attributes:
        cell: the intersection, or the cell from before if it is empty.
        origin: the index of each facet among the rows followed by the facets that the cell had before.
        outcome: a `Status`.
        contradiction: the rows and facets that contradict each other if it is empty, by the same indices.
    """

    cell: Cell
    origin: Indices
    outcome: Status
    contradiction: Indices


class _Row(NamedTuple):
    """A half-space a.z <= c, and a.z - c at the vertices of the cell that it meets."""

    a: Reals
    c: float
    over: Reals
    tolerance: float

    def moved_outward(self) -> _Row:
        """The row if it leaves more than round-off of the cell. Otherwise it is moved until it leaves twice that."""
        step = self.over.min() + 2 * self.tolerance
        return self if step <= 0 else self._replace(c=self.c + step, over=self.over - step)


def intersect(cell: Cell, A: Reals, b: Reals) -> Intersection:
    """Cut a cell by the rows A z <= b, the deepest first, as long as one cuts by more than round-off."""
    origin = len(A) + np.arange(len(cell.b))
    before, outcome, pending = (cell, origin), Status.OK, np.ones(len(A), dtype=bool)
    while True:
        over, tolerance = A @ cell.vertices.T - b[:, None], cell.round_off(A, b)
        deepest = over.max(1)
        pending &= deepest > tolerance
        if not pending.any():
            return Intersection(cell, origin, outcome, NOTHING)
        i = int(np.where(pending, deepest / lengths(A), -inf).argmax())
        pending[i] = False
        row = _Row(A[i], b[i], over[i], tolerance[i])
        if row.over.min() > row.tolerance:
            contradiction = _contradiction(cell, row, np.append(origin, i))
            if len(contradiction) > 0:
                return Intersection(*before, Status.EMPTY, contradiction)
        if row.over.min() >= -row.tolerance:
            outcome = Status.UNDECIDED
        row = row.moved_outward()
        if row.over.max() > row.tolerance:
            cell, needed = _cut(cell, row)
            origin = np.append(origin, i)[needed]


def _cut(cell: Cell, row: _Row) -> tuple[Cell, Mask]:
    """The part of a cell inside a half-space that cuts it, and a mask of the facets and the row that it needs."""
    p, on = len(row.a), cell.incident.astype(np.float32)
    inside, beyond = row.over < -row.tolerance, row.over > row.tolerance
    v, w = np.nonzero(on[inside] @ on[beyond].T >= p - 1)
    v, w = np.flatnonzero(inside)[v], np.flatnonzero(beyond)[w]
    share = row.over[v] / (row.over[v] - row.over[w])
    crossings = cell.vertices[v] + share[:, None] * (cell.vertices[w] - cell.vertices[v])
    vertices = np.concatenate([cell.vertices[~beyond], crossings])
    touching = np.append(~inside[~beyond], np.ones(len(v), dtype=bool))
    incident = np.concatenate([cell.incident[~beyond], cell.incident[v] & cell.incident[w]])
    incident = np.column_stack([incident, touching])

    # Where many facets meet, two vertices may share p - 1 of them without an edge. Their crossing is then inside a
    # face. Likewise, what is left of a facet may be only a side of another one.
    extreme = ~touching
    extreme[touching] = _maximal(incident[touching])
    vertices, incident = vertices[extreme], incident[extreme]
    needed = _maximal(incident.T)
    needed |= incident[incident[:, needed].sum(1) < p].any(0)
    A, b = np.vstack([cell.A, row.a])[needed], np.append(cell.b, row.c)[needed]
    return Cell(A, b, vertices, incident[:, needed], cell.reach), needed


def _maximal(sets: Mask) -> Mask:
    """A mask of the sets (rows that mark their members) that are in no other set. Of equal sets the first is kept."""
    members = sets.astype(np.float32)
    common = members @ members.T
    size = common.diagonal()
    elsewhere = (size > size[:, None]) | np.tri(len(sets), k=-1, dtype=bool)
    return np.logical_not(((common >= size[:, None]) & elsewhere).any(axis=1))


def _contradiction(cell: Cell, row: _Row, origin: Indices) -> Indices:
    """The origins of rows that contradict each other: facets at the vertex nearest to `row`, and last `row` itself.

    Every vertex exceeds the row. The proof is a y >= 0 with a + sum y_f A_f = 0. The result is empty if round-off
    leaves open whether they contradict each other.
    """
    at, frame = np.flatnonzero(cell.incident[row.over.argmin()]), cell.frame
    A, b = np.vstack([row.a, cell.A[at]]), np.append(row.c, cell.b[at])
    rows = A @ (frame.axes[0].T * frame.scale[0])
    norms = lengths(rows)
    try:
        y, _ = nnls((rows[1:] / norms[1:, None]).T, -rows[0] / norms[0])
    except RuntimeError:  # the search stalled: undecided
        return NOTHING
    y = np.append(1.0, y) / norms
    # Points z that satisfy the rows, with |z| <= reach as in the whole set, have y'b >= y'A z >= -|y'A| reach.
    if y @ b >= -(y @ cell.round_off(A, b) + np.abs(y @ A) @ cell.reach):
        return NOTHING
    return np.append(origin[-1], origin[at])[y > 0]


def merged(cell: Cell, most: int) -> tuple[Cell, Indices]:
    """An outer cell with at most `most` facets, and the indices of the facets that it keeps.

    The facet whose removal adds the least volume is dropped, one by one. A facet without which the set would be
    unbounded is never dropped. So more than `most` may remain.
    """
    origin = np.arange(len(cell.b))
    while len(cell.b) > most and (larger := _without_cheapest_facet(cell)) is not None:
        cell, kept = larger
        origin = origin[kept]
    return cell, origin


def _without_cheapest_facet(cell: Cell) -> tuple[Cell, Indices] | None:
    """The cell without the facet whose removal adds the least volume, and the indices of the facets that it keeps.

    None if the cell would be unbounded without any one of them.
    """
    (y,) = cell.frame.inside(cell.vertices[None])
    spreads = [y[on] - y[on].mean(0) for on in cell.incident.T]
    areas = [np.linalg.svd(spread, compute_uv=False)[: y.shape[1] - 1].prod() for spread in spreads]
    cheapest, least = -1, inf
    for tried, facet in enumerate(np.argsort(areas)):
        if tried >= CANDIDATES and least < inf:
            break
        others = np.arange(len(cell.b)) != facet
        A, b = np.vstack([-cell.A[facet], cell.A[others]]), np.append(-cell.b[facet], cell.b[others])
        beyond = _nearby(cell, A, b, REACH)
        cut_off = beyond.origin < len(A)
        added = 0.0 if 0 not in beyond.origin else beyond.cell.content if cut_off.all() else inf
        if added < least:
            cheapest, least = facet, added
    others = np.arange(len(cell.b)) != cheapest
    A, b = cell.A[others], cell.b[others]
    rough = replace(_nearby(cell, A, b, REACH).cell, reach=cell.reach)
    larger = _nearby(rough, A, b, 2.0)  # again, with the round-off of its own size
    if least == inf or (larger.origin >= len(A)).any():
        return None
    reach = np.maximum(cell.reach, np.abs(larger.cell.vertices).max(0))
    return replace(larger.cell, reach=reach), np.flatnonzero(others)[larger.origin]


def _nearby(cell: Cell, A: Reals, b: Reals, times: float) -> Intersection:
    """{z : A z <= b} in a box around a cell, `times` as large. Facets of the box have origins from len(A) on."""
    frame = cell.frame
    middle, axes = frame.middle[0], frame.axes[0]
    # The sides of the box are beyond the cell by more than their round-off. Otherwise the rows would not cut it.
    half = np.abs((cell.vertices - middle) @ axes.T).max(0) * times + 16 * ROUND_OFF * cell.reach.sum()
    own = Cell.box(-half, half)
    vertices = middle + own.vertices @ axes
    reach = np.maximum(cell.reach, np.abs(vertices).max(0))
    return intersect(Cell(own.A @ axes, own.b + own.A @ axes @ middle, vertices, own.incident, reach), A, b)
