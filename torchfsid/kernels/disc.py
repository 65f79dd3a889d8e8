r"""The largest disc in a polygon, in scalar code, compiled by numba: what `Polygon.chebyshev` does in torch.

The linear programme max r s.t. n_i.z + r <= c_i (unit rows) by the dual simplex method: from a basis of three rows,
exchange one for the row that is violated most, until none is. `polygon` is the reference; tests compare the two.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

compiled = njit(cache=True, error_model="numpy", nogil=True)  # no_type_check: these must stay plain functions


@compiled
@no_type_check
def inscribed(vertices, A, b, count, epsilon):
    """A largest inscribed disc of each polygon, as in `Polygon.chebyshev`: its rows, centre and radius."""
    B, V = b.shape
    basis, centre, radius = np.empty((B, 3), np.int64), np.zeros((B, 2)), np.empty(B)
    row, right, inverse, solution = np.empty((V, 2)), np.empty(V), np.empty((3, 3)), np.empty(3)
    for k in range(B):
        n, half, scale = count[k], 1, 0.0
        for i in range(n):
            centre[k, 0] += vertices[k, i, 0] / n
            centre[k, 1] += vertices[k, i, 1] / n
        for i in range(n):
            norm = math.sqrt(A[k, i, 0] ** 2 + A[k, i, 1] ** 2)
            row[i, 0], row[i, 1] = A[k, i, 0] / norm, A[k, i, 1] / norm
            right[i] = b[k, i] / norm - (row[i, 0] * centre[k, 0] + row[i, 1] * centre[k, 1])
            scale = max(scale, abs(right[i]))
        while half < n - 2 and row[0, 0] * row[half + 1, 1] - row[0, 1] * row[half + 1, 0] >= 0:
            half += 1
        basis[k, 0], basis[k, 1], basis[k, 2] = 0, half, half + 1
        for _ in range(3 * V):
            _inverse_with_ones(row, basis[k], inverse)
            for i in range(3):
                solution[i] = 0.0
                for j in range(3):
                    solution[i] += inverse[i, j] * right[basis[k, j]]
            worst, entering = -np.inf, 0
            for i in range(n):
                violation = row[i, 0] * solution[0] + row[i, 1] * solution[1] + solution[2] - right[i]
                if violation > worst:
                    worst, entering = violation, i
            if not worst > epsilon * scale:
                break
            least, leaving = np.inf, 0
            for j in range(3):
                share = row[entering, 0] * inverse[0, j] + row[entering, 1] * inverse[1, j] + inverse[2, j]
                if share > epsilon and max(inverse[2, j], 0.0) / share < least:
                    least, leaving = max(inverse[2, j], 0.0) / share, j
            basis[k, leaving] = entering
        centre[k, 0] += solution[0]
        centre[k, 1] += solution[1]
        radius[k] = solution[2]
    return basis, centre, radius


@compiled
@no_type_check
def _inverse_with_ones(rows, basis, inverse):
    for i in range(3):
        p, q = basis[(i + 1) % 3], basis[(i + 2) % 3]
        inverse[0, i] = rows[p, 1] - rows[q, 1]
        inverse[1, i] = rows[q, 0] - rows[p, 0]
        inverse[2, i] = rows[p, 0] * rows[q, 1] - rows[p, 1] * rows[q, 0]
    determinant = rows[basis[0], 0] * inverse[0, 0] + rows[basis[0], 1] * inverse[1, 0] + inverse[2, 0]
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= determinant
