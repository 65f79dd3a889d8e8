r"""Batched convex polytopes {z : A z <= b} in R^p, bounded: the sets of parameters beyond the plane.

The counterpart of `polygon` and `clipping` for p = 1 and p = 3..6, in numpy and scipy behind the same interface.
NOT differentiable: what comes in is detached, what goes out carries no gradient.

A polytope is kept twice, by its facets and by its vertices, with the table of which vertex lies on which facet:

    facet f: A_f.z <= b_f,   vertex v: z_v,   incident[v, f] = (A_f.z_v = b_f).

A half-space a.z <= c cuts it by one step of the double-description method: the vertices beyond are dropped, and each edge
from a vertex v inside to a vertex w beyond ends in the new vertex v + s_v / (s_v - s_w) (w - v), s = a.z - c. Two vertices
share an edge only if they share p - 1 facets. Nothing is ever solved for, so a vertex lies on its facets to round-off
however thin the set is. A point, or a facet, whose incidences are among those of another one is redundant and is dropped.
What depends on the shape (triangulating, linear programmes) happens in the set's own frame: z = centre + T y with T from
the principal axes of the vertices, in which the set is about one unit wide in every direction; then rows of length one.
Whatever round-off leaves open stays in: every result is an outer set.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from math import factorial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.optimize import linprog, nnls
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from torchfsid.clipping import Outcome
from torchfsid.errors import SolverError
from torchfsid.polygon import PRIOR, ROUND_OFF

Array = NDArray[np.float64]


class _Cell(NamedTuple):
    A: Array
    b: Array
    time: Array
    source: NDArray
    vertices: Array
    incident: NDArray[np.bool_]


def round_off(A, b, z):
    return ROUND_OFF * (np.abs(A) @ np.abs(z).max(0) + np.abs(b))


def box(lower, upper):
    p = len(lower)
    eye = np.eye(p)
    upper_side = np.array(list(product([False, True], repeat=p)))
    return _Cell(
        np.concatenate([-eye, eye]),
        np.concatenate([-lower, upper]),
        np.full(2 * p, np.nan),
        np.full(2 * p, PRIOR),
        np.where(upper_side, upper, lower),
        np.concatenate([~upper_side, upper_side], axis=1),
    )


def maximal(sets):
    """sets (n, m) bool: rows not contained in another (of equal ones the first)."""
    s = sets.astype(np.float32)
    common = s @ s.T
    size = common.diagonal()
    within = common >= size[:, None]  # i within j
    earlier = np.tri(len(s), k=-1, dtype=bool)  # j<i
    return ~(within & ((size[None] > size[:, None]) | earlier)).any(1)


def cut(cell, a, c, time, source, over, tol):
    p = len(a)
    inside, beyond = over < -tol, over > tol
    inc = cell.incident.astype(np.float32)
    i, w = np.nonzero(inc[inside] @ inc[beyond].T >= p - 1)
    i, w = np.flatnonzero(inside)[i], np.flatnonzero(beyond)[w]
    share = over[i] / (over[i] - over[w])
    new = cell.vertices[i] + share[:, None] * (cell.vertices[w] - cell.vertices[i])
    kept = ~beyond
    vertices = np.concatenate([cell.vertices[kept], new])
    incident = np.concatenate([cell.incident[kept], cell.incident[i] & cell.incident[w]])
    on = np.concatenate([~inside[kept], np.ones(len(i), bool)])
    incident = np.concatenate([incident, on[:, None]], axis=1)
    extreme = np.ones(len(vertices), bool)
    extreme[on] = maximal(incident[on])
    vertices, incident = vertices[extreme], incident[extreme]
    facets = maximal(incident.T)
    short = incident[:, facets].sum(1) < p
    if short.any():
        facets |= incident[short].any(0)
    return _Cell(
        np.concatenate([cell.A, a[None]])[facets],
        np.append(cell.b, c)[facets],
        np.append(cell.time, time)[facets],
        np.append(cell.source, source)[facets],
        vertices,
        incident[:, facets],
    )


def intersect(cell, A, b, time, source):
    undecided = False
    pending = np.ones(len(A), bool)
    norms = np.linalg.norm(A, axis=1)
    norms[norms == 0] = 1
    while True:
        over = A @ cell.vertices.T - b[:, None]
        tol = round_off(A, b, cell.vertices)
        pending &= over.max(1) > tol
        if not pending.any():
            return cell, undecided, None
        row = np.where(pending, over.max(1) / norms, -np.inf).argmax()
        pending[row] = False
        if (over[row] > tol[row]).all():
            return cell, undecided, row
        if (over[row] < -tol[row]).any():
            cell = cut(cell, A[row], b[row], time, source[row], over[row], tol[row])
        else:
            undecided = True


def frame(vertices):
    centre = vertices.mean(0)
    _, s, axes = np.linalg.svd(vertices - centre, full_matrices=False)
    s = s / np.sqrt(len(vertices))
    return centre, axes.T * s, s


def simplices(vertices):
    p = vertices.shape[1]
    if p == 1:
        return np.array([[vertices.argmin()], [vertices.argmax()]])
    centre, T, s = frame(vertices)
    y = np.linalg.solve(T, (vertices - centre).T).T
    return ConvexHull(y).simplices


def volume(vertices):
    p = vertices.shape[1]
    sp = simplices(vertices)
    return np.abs(np.linalg.det(vertices[sp] - vertices[0])).sum() / factorial(p)


def chebyshev(cell):
    p = cell.A.shape[1]
    centre, T, s = frame(cell.vertices)
    norms = np.linalg.norm(cell.A, axis=1)
    rows = cell.A @ T
    scale = np.linalg.norm(rows, axis=1)
    res = linprog(
        np.r_[np.zeros(p), -1],
        A_ub=np.c_[rows, norms * s.min()] / scale[:, None],
        b_ub=(cell.b - cell.A @ centre) / scale,
        bounds=(None, None),
        method="highs-ds",
        options=dict(primal_feasibility_tolerance=1e-10, dual_feasibility_tolerance=1e-10),
    )
    z = centre + T @ res.x[:p]
    return z, ((cell.b - cell.A @ z) / norms).min(), res.x[p] * s.min()
