r"""The two programmes in rational arithmetic, for the rare item whose floating-point answer could not be verified.

The searches are those of `kernels.active_rows`, called as plain Python on `fractions.Fraction`. No pivot is lost in
round-off, and the searches are known to end. Only the violation of a row is still compared with the round-off of the
given numbers, so that a set is EMPTY only if it is so beyond round-off. The answer is rounded and verified like any
other. An item takes milliseconds, a thousand times as long as with the kernel.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfsid.kernels import programmes as kernel
from torchfsid.kernels.active_rows import inscribed_rows, nearest_rows
from torchfsid.kernels.frame import cholesky, to_frame

Array = NDArray[Any]


def nearest_point(A: Array, b: Array, y: Array, H: Array, z: Array, mu: Array, rows: Array, filled: Array) -> int:
    """Find the nearest point of one item. Fills `z`, `mu`, `rows` and `filled`.

    Returns:
        Its `Status`.
    """
    try:
        status = _nearest_point(A, b, y, H, z, mu, rows, filled)
    except OverflowError:  # a rational number is beyond all floats
        status = kernel.UNSOLVED
    if status != kernel.OK:
        z[:], mu[:], rows[:], filled[:] = np.nan, 0.0, 0, False
    return status


def _nearest_point(A: Array, b: Array, y: Array, H: Array, z: Array, mu: Array, rows: Array, filled: Array) -> int:
    scale, (m, p) = powers_of_two(A), A.shape
    A, b = A * scale[:, None], b * scale
    unit, offsets, sizes, lengths, L = np.empty((m, p)), np.empty(m), np.empty(m), np.empty((m, 2)), np.zeros((p, p))
    metric = len(H) > 0 and cholesky(H[0], L)
    to_frame(A, b, y, L, metric, unit, offsets, sizes, lengths)
    real = np.flatnonzero(offsets < np.inf)
    N, o, noise = fractions(unit[real]), fractions(offsets[real]), fractions(sizes[real])
    if not metric:  # the given rows, scaled by powers of two
        N, noise = fractions(A[real] * lengths[real, :1]), fractions(sizes[real] * lengths[real, 1])
        o = fractions(b[real] * lengths[real, 0]) - N @ fractions(y)
    scratch = [fractions(np.zeros(shape)) for shape in ((p, p), p, (p, p), (6, p))]
    x, active = fractions(np.zeros(p)), np.zeros(p, dtype=np.int64)
    k, status = nearest_rows(N, o, noise, 0, active, *scratch, x)
    if status == kernel.OK:
        rows[:k], filled[:k] = real[active[:k]], True
        scratch = [np.zeros(shape) for shape in ((p, p), p, (p, p), (6, p), (p, p))]
        status = kernel.finish_nearest(
            A, b, y, L, metric, unit, sizes, lengths, rows, k, *scratch, x.astype(float), z, mu
        )
    mu[:k] *= scale[rows[:k]]
    return status


def inscribed_ball(A: Array, b: Array, simplex: Array, centre: Array, rows: Array) -> tuple[float, int]:
    """Find the largest ball of one item. Fills `centre` and `rows`.

    Returns:
        The radius and the `Status`.
    """
    try:
        return _inscribed_ball(A, b, simplex, centre, rows)
    except OverflowError:
        return kernel.write_ball(np.zeros(len(simplex)), len(b), kernel.UNSOLVED, centre, rows)


def _inscribed_ball(A: Array, b: Array, simplex: Array, centre: Array, rows: Array) -> tuple[float, int]:
    scale, (m, p), n = powers_of_two(A), A.shape, A.shape[1] + 1
    A, b = A * scale[:, None], b * scale
    unit, offsets, sizes, lengths = np.ones((m, n)), np.empty(m), np.empty(m), np.empty((m, 2))
    to_frame(A, b, np.zeros(p), np.zeros((p, p)), False, unit[:, :p], offsets, sizes, lengths)
    real = np.flatnonzero(offsets < np.inf)
    basis, able = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=bool)
    M, V, work = (fractions(np.zeros(shape)) for shape in ((n, n), (n, n), (5, n)))
    # The given rows, scaled by powers of two, and their lengths.
    N = np.column_stack([A[real] * lengths[real, :1], lengths[real, 1]])
    o, sides = fractions(b[real] * lengths[real, 0]), fractions(simplex)
    found = inscribed_rows(fractions(N), o, sides, 0, basis, M, V, work, able)
    rows[:] = np.append(real, m + np.arange(n))[basis]
    w, far = work[2:4].astype(float)
    status = kernel.UNSOLVED
    if found:
        inverse = (V * np.append(lengths[real, 1], np.ones(n))[basis]).astype(float)
        scratch = [np.zeros(shape) for shape in ((n, n), (n, n), n, (n, n), (6, n))]
        status = kernel.finish_ball(unit, offsets, simplex, rows, inverse, w, far, *scratch)
    return kernel.write_ball(w, m, status, centre, rows)


def powers_of_two(A: Array) -> Array:
    """For each row the power of two that brings its largest entry into [1/2, 1): round-off is judged at that length."""
    _, exponent = np.frexp(np.abs(A).max(-1))
    return np.ldexp(1.0, np.clip(-exponent, -1000, 1000))


def fractions(values: Array) -> Array:
    return np.vectorize(Fraction, otypes=[object])(values)
