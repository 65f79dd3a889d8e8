r"""The faces of a batch of polytopes, from `incident` (B, V, F), which says on which facets each vertex lies.

A face is given by the set of its vertices. Its sides are its intersections with facets. One of its vertices is its
apex. The pyramids from the apex over the sides that do not contain it fill the face, and so on down to the vertices:

    vol_k(F) = sum over the sides S of F of dist(apex, S) vol_{k-1}(S) / k.

This divides a facet into simplices (Cohen and Hickey, J. ACM 26, 1979). Vertices that are on no facet are padding.
Vertices are numbered through the whole batch: vertex v of item i has the number i V + v. Likewise for facets.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from torchfsid.tolerances import PARALLEL_ROWS

Reals = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

TABLE = 2**22
"""Entries (face, vertex, facet) of the tables that are looked at in one go: more polytopes are taken one part after the
other."""


class Level(NamedTuple):
    """All faces of one dimension, and the pyramids that fill them.

    Attributes:
        apex: the apex of each face.
        parent: the face that each pyramid is a part of.
        child: the base of each pyramid, a face of the level below.
        facet: the facet that the base of each pyramid lies on.
    """

    apex: Indices
    parent: Indices
    child: Indices
    facet: Indices


def pyramids(y: Reals, incident: Mask) -> tuple[Reals, Reals, Reals]:
    """Volumes (B,), centroids (B, p) and the areas of the facets (B, F) of polytopes with vertices y (B, V, p)."""
    (B, _, F), p = incident.shape, y.shape[2]
    volumes, centroids, areas = np.zeros(B), np.zeros((B, p)), np.zeros((B, F))
    for some in _parts(incident, p):
        volumes[some], centroids[some], areas[some] = _pyramids(y[some], incident[some])
    return volumes, centroids, areas


def _pyramids(y: Reals, incident: Mask) -> tuple[Reals, Reals, Reals]:
    (B, _, F), p = incident.shape, y.shape[2]
    levels, base = _descent(incident, p)
    y, areas = y.reshape(-1, p), np.zeros(B * F)
    volume: Reals = np.ones(len(base))
    centre, plane = y[base], np.zeros((len(base), 0, p))
    for k, (apex, parent, child, facet) in enumerate(reversed(levels), start=1):
        if k == p:
            areas[facet] = volume[child]
        height, flat = y[apex[parent]] - y[base[child]], plane[child]
        height = height - ((flat @ height[..., None]).transpose(0, 2, 1) @ flat)[:, 0]
        length = np.linalg.norm(height, axis=1)
        pyramid = length * volume[child] / k
        volume = np.asarray(np.bincount(parent, pyramid, len(apex)), dtype=float)
        share = pyramid / np.where(volume > 0, volume, 1.0)[parent] * k / (k + 1)
        arms = share[:, None] * (centre[child] - y[apex[parent]])
        centre = y[apex] + np.stack([np.bincount(parent, arm, len(apex)) for arm in arms.T], axis=1)
        basis = np.concatenate([flat, (height / np.where(length > 0, length, 1.0)[:, None])[:, None]], axis=1)
        rising = np.argsort(pyramid)  # the last and largest of the pyramids over a face gives its plane
        plane = np.zeros((len(apex), k, p))
        plane[parent[rising]] = basis[rising]
        base = apex
    return volume, centre, areas.reshape(B, F)


def simplices(incident: Mask, p: int) -> tuple[Indices, Indices]:
    """The facets divided into simplices: the vertices (S, p) of each, and the facet (S,) that it is a part of."""
    (_, V, F), found = incident.shape, []
    for some in _parts(incident, p):
        corners, facet = _simplices(incident[some], p)
        found.append((corners + some.start * V, facet + some.start * F))
    if not found:
        return np.zeros((0, p), dtype=np.int64), np.zeros(0, dtype=np.int64)
    corners, facet = (np.concatenate(part) for part in zip(*found, strict=True))
    return corners, facet


def _simplices(incident: Mask, p: int) -> tuple[Indices, Indices]:
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


def bases(rows: Reals, incident: Mask, needed: Mask | None = None) -> tuple[Indices, Mask]:
    """For each vertex, p independent facets that meet in it (B, V, p), and whether there are p of them (B, V).

    `rows` (B, F, p) are the facets' normals, of length 1 or 0. Where more than p facets meet, those marked by `needed`
    (B, V, F) are taken first. Of these, and then of the others, the facet whose normal is furthest from the span of
    those already taken is taken next. A facet within `PARALLEL_ROWS` [rad] of it is not taken.
    """
    (B, V, _), p = incident.shape, rows.shape[2]
    chosen, enough = np.zeros((B, V, p), dtype=np.int64), np.ones((B, V), dtype=bool)
    left = np.where(incident[..., None], rows[:, None], 0.0)
    for k in range(p):
        lengths = np.linalg.norm(left, axis=-1)
        if needed is not None:
            first = needed & (lengths > PARALLEL_ROWS)
            lengths = np.where(first.any(-1, keepdims=True), np.where(first, lengths, 0.0), lengths)
        chosen[..., k] = lengths.argmax(-1)
        length = np.take_along_axis(lengths, chosen[..., k, None], axis=-1)
        enough &= length[..., 0] > PARALLEL_ROWS
        along = np.take_along_axis(left, chosen[..., k, None, None], axis=-2)
        along = along / np.where(length > 0, length, 1.0)[..., None]
        left -= (left @ along.swapaxes(-1, -2)) * along
    return chosen, enough


def optimal_bases(rows: Reals, incident: Mask, directions: Reals) -> tuple[Indices, Mask]:
    """`bases` of vertices that are extreme in `directions` (B, V, p), with multipliers >= 0.

    Such a direction d is a combination of the normals of the facets that meet in the vertex, with weights y >= 0: the
    multipliers of the linear programme max d.z. The facets with y > 0 belong to the basis.
    """
    needed = np.zeros_like(incident)
    for i, v in np.argwhere((incident.sum(2) > rows.shape[2]) & np.isfinite(directions).all(2)):
        at, length = np.flatnonzero(incident[i, v]), np.linalg.norm(directions[i, v])
        try:
            y, _ = nnls(rows[i, at].T, directions[i, v] / (length if length > 0 else 1.0))
        except RuntimeError:  # the search stalled: any facets
            continue
        needed[i, v, at] = y > 0
    return bases(rows, incident, needed)


def _parts(incident: Mask, p: int) -> list[slice]:
    """Slices of the batch, so that no table becomes larger than about `TABLE`. A face is assumed to have p sides."""
    B, V, F = incident.shape
    size = max(1, TABLE // (p * V * F * F))
    return [slice(first, min(B, first + size)) for first in range(0, B, size)]


def _descent(incident: Mask, p: int) -> tuple[list[Level], Indices]:
    """The levels of faces from the polytopes down to their edges, and the vertices below the edges."""
    B, V, F = incident.shape
    on, owner = incident.astype(np.float32), np.arange(B)
    faces: Mask = np.asarray(incident.any(2))
    levels: list[Level] = []
    for k in range(p, 0, -1):
        apex = faces.argmax(1)
        is_side = (faces.astype(np.float32)[:, None] @ on[owner])[:, 0] >= k
        if k < p:  # at the top, sides that contain the apex are needed only for their areas
            is_side &= ~incident[owner, apex]
        parent, facet = np.nonzero(is_side)
        item = owner[parent]
        sides = faces[parent] & incident[item, :, facet]
        # Sorting strings of bytes is faster than sorting rows.
        keys = np.column_stack([item.astype(">u4").view(np.uint8).reshape(-1, 4), np.packbits(sides, axis=1)])
        keys = np.ascontiguousarray(keys)
        _, first, child = np.unique(keys.view(f"S{keys.shape[1]}")[:, 0], return_index=True, return_inverse=True)
        _, once = np.unique(parent * len(first) + child, return_index=True)
        levels.append(Level(apex + owner * V, parent[once], child[once], (facet + item * F)[once]))
        faces, owner = sides[first], item[first]
    return levels, faces.argmax(1) + owner * V
