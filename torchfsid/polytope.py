r"""Batched convex polytopes: the sets of parameters beyond the plane (p = 1, 3, 4, ...), and what is asked of them.

The counterpart of `polygon` and `clipping`, in numpy and scipy behind the same interface, and NOT differentiable: what
comes in is detached, what goes out carries no gradient. A bounded polytope is kept by facets and vertices together,

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
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

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


@dataclass(frozen=True)
class Polytope:
    """A batch of bounded convex polytopes {z : A z <= b} in R^p, float64.

    `count` facets and `vertex_count` vertices are real; behind them stand padding rows 0.z <= 1 and copies of the first
    vertex. `time` and `source` say when and from which constraint each facet came (NaN and `PRIOR`: the first box).
    """

    A: Float[Tensor, "B F p"]
    b: Float[Tensor, "B F"]
    time: Float[Tensor, "B F"]
    source: Int[Tensor, "B F"]
    count: Int[Tensor, "B"]
    vertices: Float[Tensor, "B V p"]
    incident: Bool[Tensor, "B V F"]
    vertex_count: Int[Tensor, "B"]

    @classmethod
    def from_box(cls, lower: Float[Tensor, "B p"], upper: Float[Tensor, "B p"]) -> Polytope:
        """Axis-parallel boxes; facets: the lower sides -z_i <= -lower_i, then the upper sides z_i <= upper_i."""
        boxes = [_box(low, high) for low, high in zip(_array(lower), _array(upper), strict=True)]
        return cls._of(boxes, lower.shape[-1], lower.device)

    @property
    def dim(self) -> int:
        return self.A.shape[-1]

    @property
    def valid(self) -> Bool[Tensor, "B F"]:
        """Slots that hold a facet."""
        return torch.arange(self.A.shape[1], device=self.count.device) < self.count.unsqueeze(-1)

    def select(self, items: Tensor) -> Polytope:
        """The sub-batch at `items` (indices or a mask)."""
        return self._of([self._cells[i] for i in self._positions(items)], self.dim, self.A.device)

    def replaced(self, items: Tensor, other: Polytope) -> Polytope:
        """This batch with `other` in the places `items` (indices or a mask)."""
        cells = list(self._cells)
        for i, cell in zip(self._positions(items), other._cells, strict=True):
            cells[i] = cell
        return self._of(cells, self.dim, self.A.device)

    def _positions(self, items: Tensor) -> list[int]:
        return torch.arange(len(self.A), device=items.device)[items].tolist()

    @classmethod
    def _of(cls, cells: list[_Cell], dim: int, device: torch.device) -> Polytope:
        """The batch of these cells, padded to the largest. It keeps them, and what is already known about them."""
        counts = np.array([[len(cell.b), len(cell.vertices)] for cell in cells], dtype=np.int64).reshape(-1, 2)
        B, (F, V) = len(cells), counts.max(0, initial=1)
        A, b, time = np.zeros((B, F, dim)), np.ones((B, F)), np.full((B, F), nan)
        source, vertices, incident = np.full((B, F), PRIOR), np.zeros((B, V, dim)), np.zeros((B, V, F), dtype=bool)
        for i, (cell, (f, v)) in enumerate(zip(cells, counts, strict=True)):
            A[i, :f], b[i, :f], time[i, :f], source[i, :f] = cell.A, cell.b, cell.time, cell.source
            vertices[i], incident[i, :, :f] = cell.vertices[0], cell.incident[0]
            vertices[i, :v], incident[i, :v, :f] = cell.vertices, cell.incident
        table = (A, b, time, source, counts[:, 0], vertices, incident, counts[:, 1])
        batch = cls(*(torch.as_tensor(field, device=device) for field in table))
        batch.__dict__["_cells"] = cells
        return batch

    @cached_property
    def _cells(self) -> list[_Cell]:
        """The polytopes one by one, without padding."""
        A, b, time, source = (_array(field) for field in (self.A, self.b, self.time, self.source))
        vertices, incident = _array(self.vertices), _array(self.incident)
        counts = zip(self.count.tolist(), self.vertex_count.tolist(), strict=True)
        return [
            _Cell(A[i, :f], b[i, :f], time[i, :f], source[i, :f], vertices[i, :v], incident[i, :v, :f])
            for i, (f, v) in enumerate(counts)
        ]

    def _tensor(self, rows: list[Reals] | list[float], *shape: int) -> Tensor:
        return torch.as_tensor(np.array(rows, dtype=float).reshape(len(self.A), *shape), device=self.A.device)

    # What is asked of a polytope ------------------------------------------------------------------------------------

    def volume(self) -> Float[Tensor, "B"]:
        """Volume (in one dimension, length); 0 for a set whose width is lost in round-off."""
        return self._tensor([cell.measure[0] for cell in self._cells])

    def centroid(self) -> Float[Tensor, "B p"]:
        """Centre of volume; of a set without volume, the middle of its bounding box."""
        return self._tensor([cell.measure[1] for cell in self._cells], self.dim)

    def diameter(self) -> Float[Tensor, "B"]:
        """Largest distance between two points of the set."""
        apart = torch.cdist(self.vertices, self.vertices, compute_mode="donot_use_mm_for_euclid_dist")
        return apart.flatten(1).amax(-1)

    def support(self, direction: Float[Tensor, "B D p"]) -> Float[Tensor, "B D"]:
        """Support function h(n) = max n.z over the set."""
        return (direction.detach() @ self.vertices.transpose(1, 2)).amax(-1)

    def chebyshev(self) -> tuple[Float[Tensor, "B p"], Float[Tensor, "B"]]:
        """Centre and radius of a largest inscribed ball: max r s.t. A_f.z + |A_f| r <= b_f.

        The radius is the distance from the returned centre to the nearest facet. Where the centre is not unique, an end
        of the set of centres is returned.
        """
        centres, radii = [cell.ball[0] for cell in self._cells], [cell.ball[1] for cell in self._cells]
        return self._tensor(centres, self.dim), self._tensor(radii)

    def nearest(
        self, point: Float[Tensor, "B p"], metric: Float[Tensor, "B p p"] | None = None
    ) -> Float[Tensor, "B p"]:
        """The point of the set nearest to `point` in the norm sqrt(z' metric z) (default: Euclidean).

        Raises `SolverError` if a `metric` is not positive definite, or if the solver stalls.
        """
        metrics = [np.eye(self.dim)] * len(point) if metric is None else _array(metric)
        feet = [_nearest(*each) for each in zip(self._cells, _array(point), metrics, strict=True)]
        return self._tensor(feet, self.dim)


@dataclass(frozen=True)
class Contradiction:
    """Up to p + 1 rows per item that no point satisfies together, NaN behind them: some y >= 0 has y'A = 0, y'b < 0."""

    A: Float[Tensor, "B R p"]
    b: Float[Tensor, "B R"]
    time: Float[Tensor, "B R"]
    source: Int[Tensor, "B R"]


@dataclass(frozen=True)
class ClippedPolytope:
    """Polytopes after a clip.

    Attributes:
        body: the intersection; where it is empty, the polytope as it was.
        outcome: an `Outcome` per item.
        shrunk: the item was really cut.
        contradiction: for empty items, the rows that contradict each other.
    """

    body: Polytope
    outcome: Int[Tensor, "B"]
    shrunk: Bool[Tensor, "B"]
    contradiction: Contradiction


def clip_polytope(
    polytope: Polytope,
    A: Float[Tensor, "B R p"],
    b: Float[Tensor, "B R"],
    time: Float[Tensor, "B"],
    source: Int[Tensor, "B R"],
) -> ClippedPolytope:
    """Intersect every polytope with its R half-spaces A z <= b, stamping new facets with `time` and `source`."""
    B, p, device = len(A), polytope.dim, polytope.A.device
    cells, outcome, shrunk = list(polytope._cells), np.full(B, int(Outcome.NONEMPTY)), np.zeros(B, dtype=bool)
    against = (np.full((B, p + 1, p), nan), *np.full((2, B, p + 1), nan), np.full((B, p + 1), PRIOR))
    for i, item in enumerate(zip(cells, _array(A), _array(b), _array(time), _array(source), strict=True)):
        cells[i], outcome[i], contradiction = _intersect(*item)
        shrunk[i] = cells[i] is not item[0]
        for table, rows in zip(against, contradiction, strict=False):
            table[i, : len(rows)] = rows
    outcomes, cut, *rows = (torch.as_tensor(table, device=device) for table in (outcome, shrunk, *against))
    body = Polytope._of(cells, p, device) if shrunk.any() else polytope
    return ClippedPolytope(body, outcomes, cut, Contradiction(*rows))


def merge_polytope(polytope: Polytope, most: int) -> Polytope:
    """Outer polytopes with at most `most` facets: drop, one by one, the facet whose removal adds the least volume.

    A facet that keeps the set bounded is never dropped, so that more than `most` may remain.
    """
    cells = list(polytope._cells)
    for i, cell in enumerate(cells):
        larger: _Cell | None = cell
        while larger is not None:
            cells[i] = larger
            larger = _without_cheapest_facet(larger) if len(larger.b) > most else None
    return Polytope._of(cells, polytope.dim, polytope.A.device)


# One polytope, in numpy ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Cell:
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


def _nearest(cell: _Cell, point: Reals, metric: Reals) -> Reals:
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


def _intersect(
    cell: _Cell, A: Reals, b: Reals, time: float, source: NDArray[np.int64]
) -> tuple[_Cell, Outcome, tuple[NDArray, ...]]:
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


def _cut(cell: _Cell, row: _Row) -> _Cell:
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
    return _Cell(
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


def _contradiction(cell: _Cell, row: _Row) -> tuple[NDArray, ...]:
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


def _without_cheapest_facet(cell: _Cell) -> _Cell | None:
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


def _nearby(cell: _Cell, A: Reals, b: Reals, reach: float) -> _Cell:
    """{z : A z <= b} in a box around a cell, `reach` times as large; `source` is the row, or `PRIOR` for the box."""
    centre, axes, scale = cell.frame
    y = np.abs((cell.vertices - centre) @ axes.T).max(0) * reach
    half = np.where(scale > 0, y, np.abs(cell.vertices).max() * ROUND_OFF * reach)
    box = _box(-half, half)
    rotated = replace(box, A=box.A @ axes, b=box.b + box.A @ axes @ centre, vertices=centre + box.vertices @ axes)
    return _intersect(rotated, A, b, nan, np.arange(len(b)))[0]


def _box(lower: Reals, upper: Reals) -> _Cell:
    is_upper = np.array(list(product([False, True], repeat=len(lower))))
    unit = np.eye(len(lower))
    return _Cell(
        A=np.vstack([-unit, unit]),
        b=np.append(-lower, upper),
        time=np.full(2 * len(lower), nan),
        source=np.full(2 * len(lower), PRIOR),
        vertices=np.where(is_upper, upper, lower),
        incident=np.hstack([~is_upper, is_upper]),
    )


def _array(tensor: Tensor) -> NDArray:
    return tensor.detach().cpu().numpy()


def _lengths(rows: Reals) -> Reals:
    """Lengths, with 1 for zero rows."""
    lengths = np.linalg.norm(rows, axis=1)
    return np.where(lengths > 0, lengths, 1.0)


def _round_off(A: Reals, b: Reals, z: Reals) -> Reals:
    """Round-off of A z - b over the points."""
    return ROUND_OFF * (np.abs(A) @ np.abs(z).max(0) + np.abs(b))
