r"""The two programmes in rational arithmetic, for the rare item whose floating-point answer could not be verified.

The searches are those of `kernels.active_rows`, called as plain Python on `fractions.Fraction`: no pivot is then lost in
round-off, and the searches are known to end. Only a row's violation is still compared with round-off, that of the numbers
given, so that a set is EMPTY only if it is so beyond round-off. What was found is rounded, and verified like any answer.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfsid.kernels import programmes as kernel
from torchfsid.kernels.active_rows import inscribed_rows, nearest_rows

Array = NDArray[Any]


def nearest_point(A: Array, b: Array, y: Array, H: Array, z: Array, mu: Array, rows: Array, filled: Array) -> int:
    """Solve one item: fills the last four.

    Returns:
        Its `ProgrammeStatus`.
    """
    m, p = A.shape
    unit, offsets, sizes, lengths, L = np.empty((m, p)), np.empty(m), np.empty(m), np.empty((m, 2)), np.zeros((p, p))
    metric = len(H) > 0 and kernel.cholesky(H[0], L)
    kernel.to_frame(A, b, y, L, metric, unit, offsets, sizes, lengths)
    real = np.flatnonzero(offsets < np.inf)
    N, o, noise = fractions(unit[real]), fractions(offsets[real]), fractions(sizes[real])
    if not metric:  # the rows as they were given, up to powers of two
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
    if status != kernel.OK:
        z[:], mu[:], rows[:], filled[:] = np.nan, 0.0, 0, False
    return status


def inscribed_ball(A: Array, b: Array, simplex: Array, centre: Array, rows: Array) -> tuple[float, int]:
    """Solve one item: fills the last two.

    Returns:
        The radius, and the `ProgrammeStatus`.
    """
    (m, p), n = A.shape, A.shape[1] + 1
    unit, offsets, sizes, lengths = np.ones((m, n)), np.empty(m), np.empty(m), np.empty((m, 2))
    kernel.to_frame(A, b, np.zeros(p), np.zeros((p, p)), False, unit[:, :p], offsets, sizes, lengths)
    real = np.flatnonzero(offsets < np.inf)
    basis, able = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=bool)
    M, V, work = (fractions(np.zeros(shape)) for shape in ((n, n), (n, n), (5, n)))
    found = inscribed_rows(
        fractions(unit[real]), fractions(offsets[real]), fractions(simplex), 0, basis, M, V, work, able
    )
    rows[:] = np.where(basis < len(real), np.append(real, np.arange(n))[basis], basis - len(real) + m)
    w, far = work[2:4].astype(float)
    status = kernel.UNSOLVED
    if found:
        scratch = [np.zeros(shape) for shape in ((n, n), (n, n), n, (n, n), (6, n))]
        status = kernel.finish_ball(unit, offsets, simplex, rows, V.astype(float), w, far, *scratch)
    return kernel.write_ball(w, m, status, centre, rows)


def fractions(values: Array) -> Array:
    return np.vectorize(Fraction, otypes=[object])(values)
