r"""What a `FeasibleSet` is given, checked; and boxes around given half-spaces or corners, from which a set is cut.

Such a set is cut from a box that is wider than what is left of it, so that no side of the box remains: every facet is
then one of the given rows, with its gradient.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import linprog
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, array, finite, reals

INFEASIBLE, UNBOUNDED = 2, 3
"""Statuses of `scipy.optimize.linprog`."""

FLAT = 1e-9
"""Width of a polygon, relative to its length, from which on its corners are not on one line."""

Box = tuple[Float[Tensor, "*batch p"], Float[Tensor, "*batch p"]]


def box(lower: object, upper: object) -> Box:
    """The corners of a box, checked.

    Raises:
        InputError: shapes differ, p = 0, lower < upper fails somewhere, or the box is not bounded.
    """
    low, high = reals("lower", lower), reals("upper", upper)
    if low.shape != high.shape or low.ndim == 0 or low.shape[-1] == 0:
        raise InputError("lower, upper", "two tensors (*batch, p)", (tuple(low.shape), tuple(high.shape)))
    if not bool((low < high).all()):
        raise InputError("lower, upper", "lower < upper in every coordinate", (low.tolist(), high.tolist()))
    if not finite(low, high):
        raise InputError("lower, upper", "a bounded box", (low.tolist(), high.tolist()))
    return low, high


def box_around(halfspaces: Halfspaces) -> Box:
    """The corners of a box that is wider than the set that the half-spaces bound.

    The box of an empty set is that between -1 and 1.

    Raises:
        InputError: the half-spaces leave a set unbounded, or a row is NaN or infinite.
    """
    if not finite(halfspaces.A, halfspaces.b):
        raise InputError("halfspaces", "finite rows", "NaN or infinity")
    rows, p = halfspaces.normalised(), halfspaces.dim
    A, b = array(rows.A).reshape(-1, rows.rows, p), array(rows.b).reshape(-1, rows.rows)
    corners = np.array([_corners(A[i], b[i]) for i in range(len(b))]).reshape(*rows.batch_shape, 2, p)
    return _widened(*torch.from_numpy(corners).to(rows.A.device).unbind(-2))


def planar(points: object) -> Float[Tensor, "*batch v 2"]:
    """The corners of polygons, checked.

    Raises:
        InputError: they are no points in the plane, not finite, or on one line.
    """
    corners = reals("vertices", points)
    if corners.ndim < 2 or corners.shape[-1] != 2 or corners.shape[-2] < 3 or not finite(corners):
        raise InputError("vertices", "finite points (*batch, v, 2) in the plane, v >= 3", tuple(corners.shape))
    sizes = torch.linalg.svdvals((corners - corners.mean(-2, keepdim=True)).detach())
    if bool((sizes[..., 1] <= FLAT * sizes[..., 0]).any()):
        raise InputError("vertices", "points that are not on one line", corners.tolist())
    return corners


def edges_of(corners: Float[Tensor, "*batch v 2"]) -> Halfspaces:
    """The lines through any two of the points that have all points on one side, and others that only hold them.

    For every two points z_i, z_j the row n.z <= max_k n.z_k, n orthogonal to z_j - z_i. Together they are the convex
    hull: among them are its edges, and no row cuts it.
    """
    i, j = torch.cartesian_prod(*[torch.arange(corners.shape[-2], device=corners.device)] * 2).unbind(-1)
    along = (corners[..., j, :] - corners[..., i, :])[..., i != j, :]
    normal = torch.stack([along[..., 1], -along[..., 0]], dim=-1)
    reach = (normal @ corners.mT).amax(-1)
    return Halfspaces(normal, reach).where((normal != 0).any(-1)).normalised()


def box_around_points(points: Float[Tensor, "*batch v p"]) -> Box:
    """The corners of a box that is wider than the points."""
    return _widened(points.detach().amin(-2), points.detach().amax(-2))


def _corners(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    p = A.shape[1]
    extremes = np.zeros((2, p))
    for sign, side in ((1.0, extremes[0]), (-1.0, extremes[1])):
        for axis in range(p):
            found = linprog(sign * np.eye(p)[axis], A_ub=A, b_ub=b, bounds=(None, None))
            if found.status == INFEASIBLE:
                return -np.ones(p), np.ones(p)
            if found.status == UNBOUNDED or not found.success:
                raise InputError("halfspaces", "rows that bound the set", "an unbounded set")
            side[axis] = sign * found.fun
    return extremes[0], extremes[1]


def _widened(lower: Tensor, upper: Tensor) -> Box:
    """The box, wider by its size on every side."""
    size = (upper - lower).amax(-1, keepdim=True)
    around = size + 1e-3 * (lower.abs() + upper.abs()) + torch.where(size > 0, 0.0, 1.0)
    return lower - around, upper + around


def per_set(
    name: str, value: object, shape: tuple[int, ...], sets: torch.Size, broadcast: bool = False
) -> Float[Tensor, "..."]:
    """The value in float64. It must hold one item of `shape` per set. With `broadcast` it may hold several.

    Raises:
        InputError: it has another shape.
    """
    items = reals(name, value)
    batch, inner = items.shape[: items.ndim - len(shape)], items.shape[items.ndim - len(shape) :]
    if inner != shape or not fits(batch[max(0, len(batch) - len(sets)) if broadcast else 0 :], sets):
        raise InputError(name, f"(*batch, {', '.join(map(str, shape))}), batch {tuple(sets)}", tuple(items.shape))
    return items


def fits(shape: torch.Size, batch: torch.Size) -> bool:
    """Do rows of this batch shape broadcast to the sets' batch?"""
    return len(shape) <= len(batch) and all(n in (1, N) for n, N in zip(reversed(shape), reversed(batch), strict=False))


def definite(metric: Float[Tensor, "B p p"]) -> tuple[Float[Tensor, "B p p"], Bool[Tensor, "B"]]:
    """The metrics, with the identity for those that are not finite and positive definite, and a mask of the others."""
    known = metric.isfinite().all((-1, -2))
    identity = torch.eye(metric.shape[-1], dtype=metric.dtype, device=metric.device)
    _, fault = torch.linalg.cholesky_ex(torch.where(known[:, None, None], metric, identity).detach())
    known = known & (fault == 0)
    return torch.where(known[:, None, None], metric, identity), known


def stamp(time: float | Tensor, like: Tensor) -> Float[Tensor, "*#batch m"]:
    """The times of rows [s], in float64, on the device of another tensor. A number does not make the device wait."""
    if isinstance(time, Tensor):
        return torch.atleast_1d(time.to(like.device, torch.float64))
    return torch.full((1,), time, dtype=torch.float64, device=like.device)
