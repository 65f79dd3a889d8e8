r"""The shape of a batch of polytopes, in numpy: principal axes, volume, centroid, vertices' bases, simplices.

It is computed in the frame of each set, z = middle + (y * scale) axes, with the principal axes of its vertices. In this
frame even a thin set is about equally wide in every direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from torchfsid.sets.faces import Indices, Mask, Reals, bases, pyramids, simplices
from torchfsid.tolerances import FLAT, ROUND_OFF

OPEN = 1e-9
"""The normals of a closed surface times their areas add up to zero: to this share of its area."""


class Frame(NamedTuple):
    """The frame z = middle + (y * scale) axes. `flat` marks the directions in which the set is as thin as round-off."""

    middle: Reals
    axes: Reals
    scale: Reals
    flat: Mask

    @classmethod
    def of(cls, vertices: Reals, real: Mask, reach: Reals) -> Frame:
        """The frame of vertices (B, V, p), V >= p. The mask `real` is (B, V). Other vertices repeat the first one."""
        count, largest = real.sum(1)[:, None], reach.max(1, keepdims=True)
        middle = mean(vertices, count)
        _, scale, axes = np.linalg.svd(np.where(real[..., None], vertices - middle[:, None], 0.0), full_matrices=False)
        scale = scale / np.sqrt(count)
        return cls(middle, axes, np.maximum(scale, ROUND_OFF / 8 * largest), scale <= FLAT * largest)

    def inside(self, z: Reals) -> Reals:
        """The coordinates y of points z (B, V, p)."""
        return (z - self.middle[:, None]) @ self.axes.swapaxes(1, 2) / self.scale[:, None]

    def outside(self, y: Reals) -> Reals:
        """The points z of coordinates y (B, p)."""
        return self.middle + ((y * self.scale)[:, None] @ self.axes)[:, 0]

    def rows(self, A: Reals, b: Reals) -> tuple[Reals, Reals]:
        """Rows A z <= b as rows over y, of length 1. Padding keeps A = 0."""
        unit, right = unit_rows(A, b)
        right = right - (unit @ self.middle[..., None])[..., 0]
        return unit_rows(unit @ (self.axes.swapaxes(1, 2) * self.scale[:, None]), right)


class Solid(NamedTuple):
    """Volume and centroid in the frame, and the vertices and incidences that they are computed from."""

    volume: Reals
    centroid: Reals
    y: Reals
    incident: Mask


@dataclass(frozen=True, eq=False)
class Shape:
    """The shape of polytopes {z : A z <= b}. Each property is computed at most once.

    Attributes:
        A: (B, F, p), the facets' rows.
        b: (B, F), their right-hand sides.
        vertices: (B, V, p), V >= p, padded by repeating the first one.
        count: (B,), the number of real vertices.
        incident: (B, V, F), which vertex is on which facet. Padding is on none.
        reach: (B, p), the largest |coordinates| that the set ever had.
    """

    A: Reals
    b: Reals
    vertices: Reals
    count: Indices
    incident: Mask
    reach: Reals

    @cached_property
    def middle(self) -> Reals:
        """The mean of the vertices, a point of the set."""
        return mean(self.vertices, self.count[:, None])

    @cached_property
    def frame(self) -> Frame:
        real = np.arange(self.vertices.shape[1]) < self.count[:, None]
        return Frame.of(self.vertices, real, self.reach)

    @cached_property
    def is_flat(self) -> Mask:
        return np.asarray(self.frame.flat.any(1))

    @cached_property
    def rows(self) -> tuple[Reals, Reals]:
        """Unit rows and right-hand sides over y."""
        return self.frame.rows(self.A, self.b)

    @cached_property
    def y(self) -> Reals:
        """The vertices, in the frame."""
        return self.frame.inside(self.vertices)

    @cached_property
    def bases(self) -> tuple[Indices, Mask]:
        """For each vertex, p independent facets that meet in it, and whether there are p of them."""
        return bases(self.rows[0], self.incident)

    @cached_property
    def content(self) -> Reals:
        """The volumes, for comparisons. Those of flat sets are not 0 but a multiple of round-off."""
        return self.solid.volume * self.frame.scale.prod(1)

    @cached_property
    def volume(self) -> Reals:
        """The volumes; 0 for a flat set."""
        return np.where(self.is_flat, 0.0, self.content)

    @cached_property
    def centroid(self) -> Reals:
        """The centroids. That of a flat set is computed in the directions in which it is not flat."""
        centre = np.where(self.is_flat[:, None], 0.0, self.solid.centroid)
        for i in np.flatnonzero(self.is_flat):
            wide = ~self.frame.flat[i]
            centre[i, wide] = _centre_of_hull(self.y[i][self.incident[i].any(1)][:, wide])
        return self.frame.outside(centre)

    @cached_property
    def solid(self) -> Solid:
        (rows, right), y, incident, frame = self.rows, self.y, self.incident, self.frame
        volume, centroid, areas = pyramids(y, incident)
        noise = ROUND_OFF * self.reach.max(1, initial=0.0) / frame.scale.min(1, initial=np.inf)
        gap = np.linalg.norm((areas[:, None] @ rows)[:, 0], axis=1)
        for i in np.flatnonzero(~self.is_flat & (gap > (OPEN + noise) * areas.sum(1))):
            # If facets are parallel almost to round-off, the facet that a vertex lies on is not clear. Then the
            # incidences are taken from the hull of the polar dual, joggled so that no two facets are parallel.
            joggled = _joggled(rows[i], right[i])
            if joggled is None:
                continue
            (volume[i],), (centroid[i],), _ = pyramids(joggled[0][None], joggled[1][None])
            more = max(0, len(joggled[0]) - y.shape[1])
            y = np.pad(y, ((0, 0), (0, more), (0, 0)))
            incident = np.pad(incident, ((0, 0), (0, more), (0, 0)))
            y[i], incident[i] = 0.0, False
            y[i, : len(joggled[0])], incident[i, : len(joggled[0])] = joggled
        return Solid(volume, centroid, y, incident)

    @cached_property
    def solid_bases(self) -> tuple[Indices, Mask]:
        """`bases` of the vertices of `solid`."""
        same = self.solid.incident is self.incident
        return self.bases if same else bases(self.rows[0], self.solid.incident)

    @cached_property
    def simplices(self) -> tuple[Indices, Indices]:
        """The facets of `solid` divided into simplices (see `faces.simplices`). A flat set has none."""
        return simplices(self.solid.incident & ~self.is_flat[:, None, None], self.A.shape[2])


def mean(vertices: Reals, count: Indices) -> Reals:
    """The mean of the vertices (B, V, p), of which `count` (B, 1) are real. The others repeat the first one."""
    # It is taken relative to the first vertex: the mean of a thin set far from the origin could round to a point
    # outside.
    first = vertices[:, 0]
    return first + (vertices - first[:, None]).sum(1) / count


def unit_rows(A: Reals, b: Reals) -> tuple[Reals, Reals]:
    """The rows scaled to length 1. Zero rows are left unchanged."""
    norms = lengths(A)
    return A / norms[..., None], b / norms


def lengths(A: Reals) -> Reals:
    """The lengths of rows of any scale. Zero rows give 1."""
    largest = np.abs(A).max(-1)
    largest = np.where(largest > 0, largest, 1.0)
    norms = np.linalg.norm(A / largest[..., None], axis=-1) * largest
    return np.where(norms > 0, norms, 1.0)


def _joggled(rows: Reals, right: Reals) -> tuple[Reals, Mask] | None:
    """Vertices and incidences of {y : rows y <= right} after its rows are joggled by about 1e-11.

    Every vertex is then on exactly p facets. None if Qhull finds no bounded set.
    """
    real = np.flatnonzero((rows != 0).any(1))
    if not (right[real] > 0).all():
        return None
    try:
        hull = ConvexHull(rows[real] / right[real, None], qhull_options="QJ Pp")
    except (QhullError, ValueError):
        return None
    if not (hull.equations[:, -1] < 0).all():
        return None
    incident = np.zeros((len(hull.simplices), len(rows)), dtype=bool)
    np.put_along_axis(incident, real[hull.simplices], True, axis=1)
    return -hull.equations[:, :-1] / hull.equations[:, -1:], incident


def _centre_of_hull(y: Reals) -> Reals:
    """The centroid of the convex hull of points (V, k). It is their mean if Qhull fails."""
    if y.shape[1] == 0:
        return np.zeros(0)
    if y.shape[1] == 1:
        return (y.min(0) + y.max(0)) / 2
    middle = y.mean(0)
    try:
        hull = ConvexHull(y, qhull_options="QJ Pp")
    except (QhullError, ValueError):
        return middle
    corners = y[hull.simplices] - middle
    parts = np.abs(np.linalg.det(corners))
    return middle + parts @ corners.sum(1) / (parts.sum() * (y.shape[1] + 1))
