r"""One bounded convex polytope in R^p, in numpy: a cell. Batches of them are `polytope`.

It is kept by facets and vertices together,

    facet f: A_f.z <= b_f,    vertex v: z_v,    incident[v, f]: vertex v lies on facet f.

A half-space a.z <= c is intersected by one step of the double-description method. With s = a.z - c, the vertices beyond
(s > 0) are dropped, and every edge from a vertex v to a vertex w beyond ends in the new vertex

    z_v + s_v / (s_v - s_w) (z_w - z_v);    an edge: v and w share p - 1 facets.

No equation is ever solved, so that a vertex lies on its facets to round-off however thin the set is. Whatever round-off
leaves open stays in: every set is an outer set.

What depends on the shape is computed in the frame of the set, z = centre + (y * scale) axes, the principal axes of its
vertices, in which it is about as wide in every direction. Its volume is that of the pyramids over its facets with their
apex at one vertex, and so on down the faces: vol_k(F) = sum over the sides S of F of dist(apex, S) vol_{k-1}(S) / k.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import inf, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial import ConvexHull, QhullError

from torchfsid.clipping import Outcome
from torchfsid.errors import SolverError
from torchfsid.halfspaces import ROUND_OFF
from torchfsid.polygon import PRIOR

OPEN = 1e-9
"""The normals of a closed surface times their areas add up to zero: to this share of its area."""

REACH = 100.0
"""What happens beyond this many times the size of a set is out of its sight: a set that grows further without a facet
is taken to be unbounded without it, and rows that only meet further away contradict each other."""

CANDIDATES = 4
"""Of the facets that could be dropped, this many, the smallest, are compared by the volume that they keep out."""

Reals = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Cell:
    """A polytope, by facets (F) and vertices (V); what follows from them is computed once."""

    A: Reals
    b: Reals
    time: Reals
    source: NDArray[np.int64]
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
    def measure(self) -> tuple[float, Reals]:
        """Volume and centroid."""
        centre, axes, scale = self.frame
        if not scale.all():
            return 0.0, (self.vertices.min(0) + self.vertices.max(0)) / 2
        volume, middle, areas = _pyramids((self.vertices - centre) @ axes.T / scale, self.incident)
        rows = self.A @ (axes.T * scale)
        noise = ROUND_OFF * np.abs(self.vertices).max() / scale.min()
        if np.linalg.norm(areas @ (rows / _lengths(rows)[:, None])) > (OPEN + noise) * areas.sum():
            # Between facets that are parallel to almost round-off, no vertex can tell which of them it is on. Then the
            # incidences are taken from the hull of the polar dual, joggled so that no two facets are parallel.
            volume, middle, _ = _pyramids(*_joggled(rows / (self.b - self.A @ centre)[:, None]))
        return volume * float(scale.prod()), centre + (middle * scale) @ axes

    @cached_property
    def ball(self) -> tuple[Reals, float]:
        """Centre and radius of a largest inscribed ball, by the dual simplex method.

        From a simplex far around the set, exchange one of p + 1 rows for the one that is violated most, until none is.
        """
        centre, axes, scale = self.frame
        if not scale.all():
            return self.measure[1], 0.0
        p, lengths = len(centre), _lengths(self.A)
        rows = self.A @ (axes.T * scale)
        norms = _lengths(rows)
        rows = np.column_stack([rows, lengths * scale.min()]) / norms[:, None]
        simplex = np.column_stack([np.vstack([np.eye(p), -np.ones(p)]), np.ones(p + 1)])
        far = 2.0 * p * len(self.vertices)  # no vertex is further from the centre than sqrt(V)
        right = np.append((self.b - self.A @ centre) / norms, np.full(p + 1, far))
        rows, tolerance = np.vstack([rows, simplex]), _round_off(self.A, self.b, self.vertices) / norms
        basis, best = np.arange(len(norms), len(rows)), np.zeros(p + 1)
        for _ in range(50 * p):  # 2 p are usual; should round-off send it round in circles, the centre will do
            inverse = np.linalg.inv(rows[basis])
            solution = inverse @ right[basis]
            violation = (rows @ solution - right)[: len(norms)] - tolerance  # rows of the simplex never come back
            entering = violation.argmax()
            if violation[entering] <= 0:
                best = solution
                break
            share = rows[entering] @ inverse
            able = share > ROUND_OFF
            ratio = np.where(able, inverse[-1].clip(0) / np.where(able, share, 1.0), inf)
            basis[np.where(ratio <= ratio.min() + ROUND_OFF, share, 0.0).argmax()] = entering
        middle = centre + (best[:p] * scale) @ axes
        return middle, max(0.0, float(((self.b - self.A @ middle) / lengths).min()))


def _pyramids(y: Reals, incident: Mask) -> tuple[float, Reals, Reals]:
    """Volume, centroid and the areas of the facets, from the vertices and which facets each is on."""
    p, on, areas = y.shape[1], incident.astype(np.float32), np.zeros(incident.shape[1])
    faces, descent = np.ones((1, len(y)), dtype=bool), []
    for k in range(p, 0, -1):
        apex = faces.argmax(1)
        is_side = faces.astype(np.float32) @ on >= k
        if k < p:  # at the top, the sides at the apex are only wanted for their areas
            is_side &= ~incident[apex]
        parent, facet = np.nonzero(is_side)
        sides = faces[parent] & incident.T[facet]
        keys = np.packbits(sides, axis=1)  # sorted as strings of bytes: faster than as rows
        _, first, child = np.unique(keys.view(f"S{keys.shape[1]}")[:, 0], return_index=True, return_inverse=True)
        _, once = np.unique(parent * len(first) + child, return_index=True)
        descent.append((apex, parent[once], child[once], facet[once]))
        faces = sides[first]

    base = faces.argmax(1)
    volume, centre, plane = np.ones(len(base)), y[base], np.zeros((len(base), 0, p))
    for k, (apex, parent, child, facet) in enumerate(reversed(descent), start=1):
        if k == p:
            areas[facet] = volume[child]
        height, flat = y[apex[parent]] - y[base[child]], plane[child]
        height = height - ((flat @ height[..., None]).transpose(0, 2, 1) @ flat)[:, 0]
        length = np.linalg.norm(height, axis=1)
        pyramid = length * volume[child] / k
        volume = np.bincount(parent, pyramid, len(apex))
        share = pyramid / np.where(volume > 0, volume, 1.0)[parent] * k / (k + 1)
        arms = share[:, None] * (centre[child] - y[apex[parent]])
        centre = y[apex] + np.stack([np.bincount(parent, arm, len(apex)) for arm in arms.T], axis=1)
        basis = np.concatenate([flat, (height / np.where(length > 0, length, 1.0)[:, None])[:, None]], axis=1)
        rising = np.argsort(pyramid)  # of the pyramids over one face, the last one, the largest, gives its plane
        plane = np.zeros((len(apex), k, p))
        plane[parent[rising]] = basis[rising]
        base = apex
    return float(volume[0]), centre[0], areas


def _joggled(dual: Reals) -> tuple[Reals, Mask]:
    """Vertices and incidences of {y : dual y <= 1}, its rows joggled by about 1e-11: every vertex is on p facets."""
    try:
        hull = ConvexHull(dual, qhull_options="QJ Pp")
    except QhullError as error:
        raise SolverError("Qhull found no hull for the polar dual of a set") from error
    incident = np.zeros((len(hull.simplices), len(dual)), dtype=bool)
    np.put_along_axis(incident, hull.simplices, True, axis=1)
    return -hull.equations[:, :-1] / hull.equations[:, -1:], incident


def nearest(cell: Cell, point: Reals, metric: Reals) -> Reals:
    """Least-distance programming (Lawson and Hanson): min |w| s.t. G w >= h, by non-negative least squares.

    Only which rows are active is taken from there; w is then solved for from these rows.
    """
    if (cell.A @ point <= cell.b).all():
        return point
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
    return foot + root @ np.linalg.lstsq(G[active], ((cell.A @ foot - cell.b) / norms)[active])[0]


class _Row(NamedTuple):
    """A half-space a.z <= c, and a.z - c at the vertices of the cell that it meets."""

    a: Reals
    c: float
    time: float
    source: int
    over: Reals
    tolerance: float


def intersect(
    cell: Cell, A: Reals, b: Reals, time: float, source: NDArray[np.int64]
) -> tuple[Cell, Outcome, tuple[NDArray, ...]]:
    """While a row cuts by more than round-off, cut by the one that cuts deepest; if nothing is left, say which rows."""
    before, outcome, pending = cell, Outcome.NONEMPTY, np.ones(len(A), dtype=bool)
    while True:
        over, tolerance = A @ cell.vertices.T - b[:, None], _round_off(A, b, cell.vertices)
        deepest = over.max(1)
        pending &= deepest > tolerance
        if not pending.any():
            return cell, outcome, ()
        i = int(np.where(pending, deepest / _lengths(A), -inf).argmax())
        pending[i] = False
        row = _Row(A[i], b[i], time, source[i], over[i], tolerance[i])
        contradiction = _contradiction(cell, row) if row.over.min() > row.tolerance else ()
        if len(contradiction) > 0:
            return before, Outcome.EMPTY, contradiction
        if row.over.min() < -row.tolerance:
            cell = _cut(cell, row)
        else:
            outcome = Outcome.UNDECIDED


def _cut(cell: Cell, row: _Row) -> Cell:
    """The part of a cell inside a half-space that really cuts it."""
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
    return Cell(
        A=np.vstack([cell.A, row.a])[needed],
        b=np.append(cell.b, row.c)[needed],
        time=np.append(cell.time, row.time)[needed],
        source=np.append(cell.source, row.source)[needed],
        vertices=vertices,
        incident=incident[:, needed],
    )


def _maximal(sets: Mask) -> Mask:
    """Which sets (rows, by their members) are in no other one; of equal sets, the first."""
    members = sets.astype(np.float32)
    common = members @ members.T
    size = common.diagonal()
    elsewhere = (size > size[:, None]) | np.tri(len(sets), k=-1, dtype=bool)
    return np.logical_not(((common >= size[:, None]) & elsewhere).any(axis=1))


def _contradiction(cell: Cell, row: _Row) -> tuple[NDArray, ...]:
    """The row that every vertex exceeds and facets at the vertex nearest to it, y >= 0: a + sum y_f A_f = 0.

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
        return ()
    noise = y @ (_round_off(A, b, cell.vertices) / norms) + REACH * np.linalg.norm(y @ rows)
    if y @ right >= -noise:
        return ()
    used = y > 0
    time, source = np.append(row.time, cell.time[at]), np.append(row.source, cell.source[at])
    return A[used], b[used], time[used], source[used]


def without_cheapest_facet(cell: Cell) -> Cell | None:
    """The cell without the facet that keeps out the least volume; None if each of them keeps it bounded."""
    centre, axes, scale = cell.frame
    y = (cell.vertices - centre) @ axes.T / np.where(scale > 0, scale, 1.0)
    spreads = [y[on] - y[on].mean(0) for on in cell.incident.T]
    areas = [np.linalg.svd(spread, compute_uv=False)[: len(centre) - 1].prod() for spread in spreads]
    cheapest, least = -1, inf
    for tried, facet in enumerate(np.argsort(areas)):
        if tried >= CANDIDATES and least < inf:
            break
        others = np.arange(len(cell.b)) != facet
        beyond = _nearby(
            cell, np.vstack([-cell.A[facet], cell.A[others]]), np.append(-cell.b[facet], cell.b[others]), REACH
        )
        added = 0.0 if 0 not in beyond.source else inf if PRIOR in beyond.source else beyond.measure[0]
        if added < least:
            cheapest, least = facet, added
    others = np.arange(len(cell.b)) != cheapest
    A, b = cell.A[others], cell.b[others]
    larger = _nearby(_nearby(cell, A, b, REACH), A, b, 2.0)  # the second time with the round-off of its own size
    if least == inf or PRIOR in larger.source:
        return None
    return replace(larger, time=cell.time[others][larger.source], source=cell.source[others][larger.source])


def _nearby(cell: Cell, A: Reals, b: Reals, reach: float) -> Cell:
    """{z : A z <= b} in a box around a cell, `reach` times as large; `source` is the row, or `PRIOR` for the box."""
    centre, axes, scale = cell.frame
    y = np.abs((cell.vertices - centre) @ axes.T).max(0) * reach
    half = np.where(scale > 0, y, np.abs(cell.vertices).max() * ROUND_OFF * reach)
    own = box(-half, half)
    rotated = replace(own, A=own.A @ axes, b=own.b + own.A @ axes @ centre, vertices=centre + own.vertices @ axes)
    return intersect(rotated, A, b, nan, np.arange(len(b)))[0]


def box(lower: Reals, upper: Reals) -> Cell:
    is_upper = np.array(list(product([False, True], repeat=len(lower))))
    unit = np.eye(len(lower))
    return Cell(
        A=np.vstack([-unit, unit]),
        b=np.append(-lower, upper),
        time=np.full(2 * len(lower), nan),
        source=np.full(2 * len(lower), PRIOR),
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
