r"""The two programmes on numpy arrays (B, ...), with the active rows and multipliers that their derivatives need.

They are solved by the kernels, large batches on several threads. An item whose answer a kernel could not verify is
solved again in rational arithmetic (`rational`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfsid.kernels import implicit
from torchfsid.kernels import programmes as kernel
from torchfsid.kernels.active_rows import simplex_around
from torchfsid.kernels.threads import over_items
from torchfsid.programmes import rational

Reals = Indices = Mask = NDArray[Any]  # of float64, int64, bool


def nearest_point(A: Reals, b: Reals, y: Reals, metric: Reals | None = None) -> tuple:
    """The point of each {z : A z <= b} nearest to y in the norm sqrt(z' metric z).

    Args:
        A: (B, m, p).
        b: (B, m).
        y: (B, p).
        metric: (B, p, p), symmetric; None for the identity.

    Returns:
        The point (B, p), the multipliers of its active rows (B, p), the indices of these rows (B, p), a mask of the
        places that are filled, the first ones (B, p), and a `Status` (B,).
    """
    B, _, p = A.shape
    z, mu, rows = np.zeros((B, p)), np.zeros((B, p)), np.zeros((B, p), dtype=np.int64)
    filled, status = np.zeros((B, p), dtype=bool), np.zeros(B, dtype=np.int64)
    H = _or_identity(metric, p)
    over_items(kernel.nearest_point, A, b, y, H, z, mu, rows, filled, status)
    for i in np.flatnonzero(status == kernel.UNSOLVED):
        status[i] = rational.nearest_point(A[i], b[i], y[i], H[i : i + 1], z[i], mu[i], rows[i], filled[i])
    return z, mu, rows, filled, status


def inscribed_ball(A: Reals, b: Reals) -> tuple:
    """A largest ball in each {z : A z <= b}.

    Args:
        A: (B, m, p).
        b: (B, m).

    Returns:
        The centre (B, p), the radius (B,), the rows that decide them (B, p + 1), and a `Status` (B,). An index
        of m or more stands for no row: the set is open there.
    """
    B, _, p = A.shape
    centre, radius = np.zeros((B, p)), np.zeros(B)
    rows, status = np.zeros((B, p + 1), dtype=np.int64), np.zeros(B, dtype=np.int64)
    simplex = simplex_around(p)
    over_items(lambda A, b, *found: kernel.inscribed_ball(A, b, simplex, *found), A, b, centre, radius, rows, status)
    for i in np.flatnonzero(status == kernel.UNSOLVED):
        radius[i], status[i] = rational.inscribed_ball(A[i], b[i], simplex, centre[i], rows[i])
    return centre, radius, rows, status


def solve_active(N: Reals, filled: Mask, pull: Reals, offsets: Reals, metric: Reals | None = None) -> tuple:
    """Solve H z + N' mu = pull, N z = offsets for z and mu, for the first rows of N, `filled`. Others get mu = 0."""
    z, mu = np.zeros_like(pull), np.zeros_like(offsets)
    over_items(implicit.solve_active, N, filled, pull, offsets, _or_identity(metric, N.shape[-1]), z, mu)
    return z, mu


def nearest_point_vjp(
    A: Reals, rows: Indices, filled: Mask, mu: Reals, z: Reals, status: Indices, grad_z: Reals, grad_mu: Reals
) -> tuple:
    """The vector-Jacobian products (grad_A, grad_b, grad_y) of the nearest point in the metric I."""
    grad_A, grad_b, grad_y = np.zeros_like(A), np.zeros(A.shape[:2]), np.zeros_like(z)
    given, gradients = (A, rows, filled, mu, z, status, grad_z, grad_mu), (grad_A, grad_b, grad_y)
    over_items(implicit.nearest_point_vjp, *given, *gradients)
    return grad_A, grad_b, grad_y


def inscribed_ball_vjp(
    A: Reals, centre: Reals, radius: Reals, rows: Indices, grad_centre: Reals, grad_radius: Reals
) -> tuple:
    """The vector-Jacobian products (grad_A, grad_b) of the largest ball's centre and radius."""
    grad_A, grad_b = np.zeros_like(A), np.zeros(A.shape[:2])
    simplex = simplex_around(A.shape[2])
    over_items(
        lambda A, centre, radius, rows, *gradients: implicit.inscribed_ball_vjp(
            A, centre, radius, rows, simplex, *gradients
        ),
        A, centre, radius, rows, grad_centre, grad_radius, grad_A, grad_b,
    )  # fmt: skip
    return grad_A, grad_b


def _or_identity(metric: Reals | None, p: int) -> Reals:
    """The metric in the form that the kernels take: an array (0, p, p) for the identity."""
    return np.empty((0, p, p)) if metric is None else metric
