r"""The faces of a polytope, from its vertices (V) and `incident` (V, F), which says on which facets each of them lies.

A face is the set of its vertices; its sides are its intersections with facets. Seen from one of its vertices, its apex,
a face is filled by the pyramids over the sides that the apex is not on, and so on down to the vertices:

    vol_k(F) = sum over the sides S of F of dist(apex, S) vol_{k-1}(S) / k.

Taken apart all the way, a facet is a set of simplices (Cohen and Hickey, J. ACM 26, 1979).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchfsid.tolerances import PARALLEL_ROWS

Reals = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


class Level(NamedTuple):
    """Faces of one dimension, and the pyramids that fill them: over the face `child` of the level below, which lies on
    `facet`, with the apex of the face `parent` of this level."""

    apex: Indices
    parent: Indices
    child: Indices
    facet: Indices


def pyramids(y: Reals, incident: Mask) -> tuple[float, Reals, Reals]:
    """Volume, centroid and the areas of the facets."""
    p, areas = y.shape[1], np.zeros(incident.shape[1])
    levels, base = _descent(incident, p)
    volume, centre, plane = np.ones(len(base)), y[base], np.zeros((len(base), 0, p))
    for k, (apex, parent, child, facet) in enumerate(reversed(levels), start=1):
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


def simplices(incident: Mask, p: int) -> tuple[Indices, Indices]:
    """The facets, taken apart: the vertices (S, p) of each simplex, and which facet (S,) it is a part of."""
    (top, *levels), base = _descent(incident, p)
    face, facet = top.child, top.facet
    corners = np.zeros((len(face), 0), dtype=np.int64)
    for apex, parent, child, _ in levels:
        corners = np.column_stack([corners, apex[face]])
        number = np.bincount(parent, minlength=len(apex))  # of pyramids in each face; they stand in its order
        first, times = (number.cumsum() - number)[face], number[face]
        nth = np.arange(times.sum()) - np.repeat(times.cumsum() - times, times)
        corners, facet = np.repeat(corners, times, axis=0), np.repeat(facet, times)
        face = child[np.repeat(first, times) + nth]
    return np.column_stack([corners, base[face]]), facet


def bases(rows: Reals, incident: Mask) -> tuple[Indices, Mask]:
    """For each vertex p of its facets (V, p) that it is the solution of, and whether there are so many (V,).

    `rows` (F, p) are the facets' normals, of any length. Where more than p facets meet, the one that is furthest from
    the span of those taken already is taken next; one within `PARALLEL_ROWS` [rad] of it is none.
    """
    V, p = len(incident), rows.shape[1]
    chosen, enough, at = np.zeros((V, p), dtype=np.int64), np.ones(V, dtype=bool), np.arange(V)
    left = np.where(incident[..., None], rows / np.linalg.norm(rows, axis=1, keepdims=True), 0.0)
    for k in range(p):
        lengths = np.linalg.norm(left, axis=-1)
        chosen[:, k] = lengths.argmax(1)
        length = lengths[at, chosen[:, k]]
        enough &= length > PARALLEL_ROWS
        along = left[at, chosen[:, k]] / np.where(length > 0, length, 1.0)[:, None]
        left -= (left @ along[..., None]) * along[:, None]
    return chosen, enough


def _descent(incident: Mask, p: int) -> tuple[list[Level], Indices]:
    """From the polytope down to its edges, level by level; below them the vertices."""
    on = incident.astype(np.float32)
    faces, levels = np.ones((1, len(incident)), dtype=bool), []
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
        levels.append(Level(apex, parent[once], child[once], facet[once]))
        faces = sides[first]
    return levels, faces.argmax(1)
