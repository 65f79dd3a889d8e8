r"""One bounded convex polytope in R^p, in numpy: a cell. Batches of them are `polytope`.

It is kept by facets and vertices together,

    facet f: A_f.z <= b_f,    vertex v: z_v,    incident[v, f]: vertex v lies on facet f.

A half-space a.z <= c is intersected by one step of the double-description method. With s = a.z - c, the vertices beyond
(s > 0) are dropped, and every edge from a vertex v to a vertex w beyond ends in the new vertex

    z_v + s_v / (s_v - s_w) (z_w - z_v);    an edge: v and w share p - 1 facets.

No equation is ever solved, so that a vertex lies on its facets to round-off however thin the set is. Whatever round-off
leaves open stays in: every set is an outer set.

What depends on the shape is computed in the frame of the set, z = centre + (y * scale) axes, the principal axes of its
vertices, in which it is about as wide in every direction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import inf
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import ConvexHull, QhullError

from torchfsid.errors import SolverError
from torchfsid.outcome import Outcome
from torchfsid.sets.faces import Indices, Mask, Reals, bases, pyramids
from torchfsid.tolerances import ROUND_OFF

OPEN = 1e-9
"""The normals of a closed surface times their areas add up to zero: to this share of its area."""

REACH = 100.0
"""What happens beyond this many times the size of a set is out of its sight: a set that grows further without a facet
is taken to be unbounded without it, and rows that only meet further away contradict each other."""

NOTHING = np.zeros(0, dtype=np.int64)

CANDIDATES = 4
"""Of the facets that could be dropped, this many, the smallest, are compared by the volume that they keep out."""


@dataclass(frozen=True, eq=False)
class Cell:
    """A polytope, by facets (F) and vertices (V); what follows from them is computed once."""

    A: Reals
    b: Reals
    vertices: Reals
    incident: Mask

    @cached_property
    def frame(self) -> tuple[Reals, Reals, Reals]:
        """Centre, axes (in rows) and scale; a scale of 0 where the set is flat to round-off."""
        centre = self.vertices.mean(0)
        _, scale, axes = np.linalg.svd(self.vertices - centre, full_matrices=False)
        scale = scale / np.sqrt(len(self.vertices))
        return centre, axes, np.where(scale > ROUND_OFF * np.abs(self.vertices).max(), scale, 0.0)

    @cached_property
    def in_frame(self) -> tuple[Reals, Reals]:
        """Rows (not unit ones) and vertices, in coordinates y; along a direction in which it is flat, a scale of 1."""
        centre, axes, scale = self.frame
        scale = np.where(scale > 0, scale, 1.0)
        return self.A @ (axes.T * scale), (self.vertices - centre) @ axes.T / scale

    @cached_property
    def bases(self) -> tuple[Indices, Mask]:
        """For each vertex p of its facets that it is the solution of, and whether there are so many."""
        return bases(self.in_frame[0], self.incident)

    @cached_property
    def measure(self) -> tuple[float, Reals]:
        """Volume and centroid."""
        centre, axes, scale = self.frame
        if not scale.all():
            return 0.0, (self.vertices.min(0) + self.vertices.max(0)) / 2
        volume, middle, _, _ = self.solid
        return volume * float(scale.prod()), centre + (middle * scale) @ axes

    @cached_property
    def solid(self) -> tuple[float, Reals, Reals, Mask]:
        """In the frame: volume, centroid, and the vertices and incidences that they are computed from."""
        (centre, _, scale), (rows, y), incident = self.frame, self.in_frame, self.incident
        volume, middle, areas = pyramids(y, incident)
        noise = ROUND_OFF * np.abs(self.vertices).max() / scale.min()
        if np.linalg.norm(areas @ (rows / _lengths(rows)[:, None])) > (OPEN + noise) * areas.sum():
            # Between facets that are parallel to almost round-off, no vertex can tell which of them it is on. Then the
            # incidences are taken from the hull of the polar dual, joggled so that no two facets are parallel.
            y, incident = _joggled(rows / (self.b - self.A @ centre)[:, None])
            volume, middle, _ = pyramids(y, incident)
        return volume, middle, y, incident

    @cached_property
    def ball(self) -> tuple[Reals, float, Indices]:
        """Centre and radius of a largest inscribed ball, and the p + 1 facets that decide it, by dual simplex steps.

        From a simplex far around the set, exchange one of p + 1 rows for the one that is violated most, until none is.
        """
        centre, axes, scale = self.frame
        if not scale.all():
            return self.measure[1], 0.0, NOTHING
        p, lengths = len(centre), _lengths(self.A)
        rows = self.A @ (axes.T * scale)
        norms = _lengths(rows)
        rows = np.column_stack([rows, lengths * scale.min()]) / norms[:, None]
        simplex = np.column_stack([np.vstack([np.eye(p), -np.ones(p)]), np.ones(p + 1)])
        far = 2.0 * p * len(self.vertices)  # no vertex is further from the centre than sqrt(V)
        right = np.append((self.b - self.A @ centre) / norms, np.full(p + 1, far))
        rows, tolerance = np.vstack([rows, simplex]), _round_off(self.A, self.b, self.vertices) / norms
        basis, best, deciding = np.arange(len(norms), len(rows)), np.zeros(p + 1), NOTHING
        for _ in range(50 * p):  # 2 p are usual; should round-off send it round in circles, the centre will do
            inverse = np.linalg.inv(rows[basis])
            solution = inverse @ right[basis]
            violation = (rows @ solution - right)[: len(norms)] - tolerance  # rows of the simplex never come back
            entering = violation.argmax()
            if violation[entering] <= 0:
                best = solution
                deciding = basis if basis.max() < len(norms) else NOTHING
                break
            share = rows[entering] @ inverse
            able = share > ROUND_OFF
            ratio = np.where(able, inverse[-1].clip(0) / np.where(able, share, 1.0), inf)
            basis[np.where(ratio <= ratio.min() + ROUND_OFF, share, 0.0).argmax()] = entering
        middle = centre + (best[:p] * scale) @ axes
        return middle, max(0.0, float(((self.b - self.A @ middle) / lengths).min())), deciding


def _joggled(dual: Reals) -> tuple[Reals, Mask]:
    """Vertices and incidences of {y : dual y <= 1}, its rows joggled by about 1e-11: every vertex is on p facets."""
    try:
        hull = ConvexHull(dual, qhull_options="QJ Pp")
    except QhullError as error:
        raise SolverError("Qhull found no hull for the polar dual of a set") from error
    incident = np.zeros((len(hull.simplices), len(dual)), dtype=bool)
    np.put_along_axis(incident, hull.simplices, True, axis=1)
    return -hull.equations[:, :-1] / hull.equations[:, -1:], incident


def nearest(cell: Cell, point: Reals, metric: Reals) -> tuple[Reals, Indices]:
    """The nearest point and the active facets.

    Least-distance programming (Lawson and Hanson): min |w| s.t. G w >= h, by non-negative least squares. Only
    which rows are active is taken from there; w is then solved for from these rows.
    """
    if (cell.A @ point <= cell.b).all():
        return point, NOTHING
    try:
        root = np.linalg.inv(np.linalg.cholesky(metric)).T
        norms = _lengths(cell.A @ root)
        G, h = cell.A @ -root / norms[:, None], (cell.A @ point - cell.b) / norms
        y, _ = nnls(np.vstack([G.T, h / h.max()]), np.append(np.zeros(len(point)), 1.0))
    except (np.linalg.LinAlgError, RuntimeError) as error:
        raise SolverError("no nearest point: the metric is not positive definite, or the solver stalled") from error
    active = y > 0
    foot = point + root @ np.linalg.lstsq(G[active], h[active])[0]
    # Once more from there: from far away, round-off has left the foot beside the set.
    correction = np.linalg.lstsq(G[active], ((cell.A @ foot - cell.b) / norms)[active])[0]
    return foot + root @ correction, np.flatnonzero(active)


class Intersection(NamedTuple):
    """A cell intersected with rows.

    Attributes:
        cell: what is left; where nothing is, the cell as it was.
        origin: where each of its facets comes from: its place among the rows, then the facets that the cell had before.
        outcome: see `Outcome`.
        contradiction: if nothing is left, the rows and facets that contradict each other, by the same count.
    """

    cell: Cell
    origin: Indices
    outcome: Outcome
    contradiction: Indices


class _Row(NamedTuple):
    """A half-space a.z <= c, and a.z - c at the vertices of the cell that it meets."""

    a: Reals
    c: float
    over: Reals
    tolerance: float


def intersect(cell: Cell, A: Reals, b: Reals) -> Intersection:
    """While a row cuts by more than round-off, cut by the one that cuts deepest; if nothing is left, say which rows."""
    origin = len(A) + np.arange(len(cell.b))
    before, outcome, pending = (cell, origin), Outcome.NONEMPTY, np.ones(len(A), dtype=bool)
    while True:
        over, tolerance = A @ cell.vertices.T - b[:, None], _round_off(A, b, cell.vertices)
        deepest = over.max(1)
        pending &= deepest > tolerance
        if not pending.any():
            return Intersection(cell, origin, outcome, NOTHING)
        i = int(np.where(pending, deepest / _lengths(A), -inf).argmax())
        pending[i] = False
        row = _Row(A[i], b[i], over[i], tolerance[i])
        contradiction = NOTHING
        if row.over.min() > row.tolerance:
            contradiction = _contradiction(cell, row, np.append(origin, i))
        if len(contradiction) > 0:
            return Intersection(*before, Outcome.EMPTY, contradiction)
        if row.over.min() < -row.tolerance:
            cell, needed = _cut(cell, row)
            origin = np.append(origin, i)[needed]
        else:
            outcome = Outcome.UNDECIDED


def _cut(cell: Cell, row: _Row) -> tuple[Cell, Mask]:
    """The part of a cell inside a half-space that really cuts it, and which of its facets and the row are needed."""
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

    # Where many facets meet, a pair may share p - 1 of them without an edge: its crossing is inside a face. Likewise
    # a facet may be left with no more than a side of another one.
    extreme = ~touching
    extreme[touching] = _maximal(incident[touching])
    vertices, incident = vertices[extreme], incident[extreme]
    needed = _maximal(incident.T)
    needed |= incident[incident[:, needed].sum(1) < p].any(0)
    A, b = np.vstack([cell.A, row.a])[needed], np.append(cell.b, row.c)[needed]
    return Cell(A, b, vertices, incident[:, needed]), needed


def _maximal(sets: Mask) -> Mask:
    """Which sets (rows, by their members) are in no other one; of equal sets, the first."""
    members = sets.astype(np.float32)
    common = members @ members.T
    size = common.diagonal()
    elsewhere = (size > size[:, None]) | np.tri(len(sets), k=-1, dtype=bool)
    return np.logical_not(((common >= size[:, None]) & elsewhere).any(axis=1))


def _contradiction(cell: Cell, row: _Row, origin: Indices) -> Indices:
    """The row that every vertex exceeds and facets at the vertex nearest to it, y >= 0: a + sum y_f A_f = 0, by their
    origin, the row's the last one.

    Nothing if round-off leaves open whether they contradict each other.
    """
    centre, axes, scale = cell.frame
    at = np.flatnonzero(cell.incident[row.over.argmin()])
    A, b = np.vstack([row.a, cell.A[at]]), np.append(row.c, cell.b[at])
    rows = A @ (axes.T * np.where(scale > 0, scale, 1.0))
    norms = _lengths(rows)
    rows, right = rows / norms[:, None], (b - A @ centre) / norms
    try:
        y = np.append(1.0, nnls(rows[1:].T, -rows[0])[0])
    except RuntimeError:  # it stalled: undecided
        return NOTHING
    noise = y @ (_round_off(A, b, cell.vertices) / norms) + REACH * np.linalg.norm(y @ rows)
    if y @ right >= -noise:
        return NOTHING
    return np.append(origin[-1], origin[at])[y > 0]


def without_cheapest_facet(cell: Cell) -> tuple[Cell, Indices] | None:
    """The cell without the facet that keeps out the least volume, and which facets it still has; None if each of them
    keeps it bounded."""
    _, y = cell.in_frame
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
        added = 0.0 if 0 not in beyond.origin else beyond.cell.measure[0] if cut_off.all() else inf
        if added < least:
            cheapest, least = facet, added
    others = np.arange(len(cell.b)) != cheapest
    A, b = cell.A[others], cell.b[others]
    rough = _nearby(cell, A, b, REACH).cell
    larger = _nearby(rough, A, b, 2.0)  # once more, with the round-off of its own size
    if least == inf or (larger.origin >= len(A)).any():
        return None
    return larger.cell, np.flatnonzero(others)[larger.origin]


def _nearby(cell: Cell, A: Reals, b: Reals, reach: float) -> Intersection:
    """{z : A z <= b} in a box around a cell, `reach` times as large; from it come the facets of origin len(A) on."""
    centre, axes, scale = cell.frame
    y = np.abs((cell.vertices - centre) @ axes.T).max(0) * reach
    half = np.where(scale > 0, y, np.abs(cell.vertices).max() * ROUND_OFF * reach)
    own = box(-half, half)
    rotated = replace(own, A=own.A @ axes, b=own.b + own.A @ axes @ centre, vertices=centre + own.vertices @ axes)
    return intersect(rotated, A, b)


def box(lower: Reals, upper: Reals) -> Cell:
    is_upper = np.array(list(product([False, True], repeat=len(lower))))
    unit = np.eye(len(lower))
    return Cell(
        A=np.vstack([-unit, unit]),
        b=np.append(-lower, upper),
        vertices=np.where(is_upper, upper, lower),
        incident=np.hstack([~is_upper, is_upper]),
    )


def _lengths(rows: Reals) -> Reals:
    """Lengths, with 1 for zero rows."""
    lengths = np.linalg.norm(rows, axis=1)
    return np.where(lengths > 0, lengths, 1.0)


def _round_off(A: Reals, b: Reals, z: Reals) -> Reals:
    """Round-off of A z - b over the points."""
    return ROUND_OFF * (np.abs(A) @ np.abs(z).max(0) + np.abs(b))
