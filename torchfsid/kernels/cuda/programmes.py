"""Searches over half-spaces and over polygons on a GPU, and implicit differentiation: one thread an item.

These are the item functions of `programmes`, `implicit`, `disc`, `foot` and `extent`. A kernel is compiled for each
dimension p, not for each number of rows m. So an item's scratch for p rows lies in its thread's local memory. Its
scratch for m rows is a tensor, because local memory is reserved for all threads that a device can hold.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import no_type_check

from numba import boolean, cuda, float64

from torchfsid.kernels.active_rows import simplex_around
from torchfsid.kernels.cuda.launch import Arrays, launch
from torchfsid.kernels.disc import disc_one
from torchfsid.kernels.extent import contains_one, farthest_one
from torchfsid.kernels.foot import foot_one
from torchfsid.kernels.implicit import ball_vjp_one, nearest_vjp_one, solve_one
from torchfsid.kernels.programmes import ball_one, nearest_one

Groups = Sequence[Arrays]


def nearest_point(given: Groups, values: tuple, results: Groups, stream: int = 0) -> None:
    """The nearest points, see `programmes.nearest_one`.

    Args:
        given: (A, b, y), and the metrics (H,), or () for the identity.
        values: none.
        results: the scratch for the rows in the frame, and (z, mu, rows, filled, status).
        stream: the address of the stream to run on.
    """
    (A, b, y), metric = given
    B, _, p = A.shape
    # An array in the place of a missing one is not read.
    launch(_nearest_point(p, len(metric) > 0), B, ((A, b, y), metric or (A,)), (B,), results, stream)


def inscribed_ball(given: Groups, values: tuple, results: Groups, stream: int = 0) -> None:
    """The largest balls, see `programmes.ball_one`.

    Args:
        given: (A, b).
        values: none.
        results: the scratch for the rows in the frame, and (centre, radius, rows, status).
        stream: the address of the stream to run on.
    """
    B, _, p = given[0][0].shape
    launch(_inscribed_ball(p), B, given, (B,), results, stream)


def solve_active(given: Groups, values: tuple, results: Groups, stream: int = 0) -> None:
    """The linear systems of active rows, see `implicit.solve_one`.

    Args:
        given: (N, filled, pull, offsets), and the metrics (H,), or () for the identity.
        values: none.
        results: (z, mu), mu zero before.
        stream: the address of the stream to run on.
    """
    system, metric = given
    B, n, p = system[0].shape
    launch(_solve_active(n, p, len(metric) > 0), B, (system, metric or system[:1]), (B,), results, stream)


def nearest_point_vjp(given: Groups, values: tuple, results: Groups, stream: int = 0) -> None:
    """The vector-Jacobian products of nearest points, see `implicit.nearest_vjp_one`.

    Args:
        given: (A, rows, filled, mu, z, status, grad_z, grad_mu).
        values: none.
        results: (grad_A, grad_b, grad_y), zero before.
        stream: the address of the stream to run on.
    """
    B, _, p = given[0][0].shape
    launch(_nearest_point_vjp(p), B, given, (B,), results, stream)


def inscribed_ball_vjp(given: Groups, values: tuple, results: Groups, stream: int = 0) -> None:
    """The vector-Jacobian products of largest balls, see `implicit.ball_vjp_one`.

    Args:
        given: (A, centre, radius, rows, grad_centre, grad_radius).
        values: none.
        results: (grad_A, grad_b), zero before.
        stream: the address of the stream to run on.
    """
    B, _, p = given[0][0].shape
    launch(_inscribed_ball_vjp(p), B, given, (B,), results, stream)


def inscribed(given: Groups, values: tuple, results: Groups, stream: int = 0) -> None:
    """The largest discs of polygons, see `disc.inscribed`.

    Args:
        given: (vertices, A, b, count).
        values: none.
        results: the scratch for the unit rows and their bounds, and (centre, radius, basis, found).
        stream: the address of the stream to run on.
    """
    B = len(given[0][0])
    launch(_inscribed(), B, given, (B,), results, stream)


def feet(given: Groups, values: tuple, results: Groups, stream: int = 0) -> None:
    """The nearest points of polygons, see `foot.feet`.

    Args:
        given: (vertices, A, b, count, point, metric).
        values: none.
        results: (foot, active).
        stream: the address of the stream to run on.
    """
    B = len(given[0][0])
    launch(_feet(), B, given, (B,), results, stream)


def farthest(given: Groups, values: tuple, results: Groups, stream: int = 0) -> None:
    """The farthest vertices, see `extent.farthest`.

    Args:
        given: (vertices,).
        values: none.
        results: (ends, distance).
        stream: the address of the stream to run on.
    """
    B = len(given[0][0])
    launch(_farthest(), B, given, (B,), results, stream)


def contains(given: Groups, values: tuple[float], results: Groups, stream: int = 0) -> None:
    """Whether points are in sets, see `extent.contains`.

    Args:
        given: (vertices, A, b, reach, points).
        values: (tolerance,).
        results: (inside,).
        stream: the address of the stream to run on.
    """
    B = len(given[0][0])
    launch(_contains(), B, given, (B, values[0]), results, stream)


@cache
def _nearest_point(p: int, metric: bool) -> Callable:
    @no_type_check
    def nearest_kernel(given, metrics, frame, found, values):
        i = cuda.grid(1)
        if i >= values[0]:
            return
        (A, b, y), (unit, offsets, sizes, lengths), (z, mu, rows, filled, status) = given, frame, found
        L, Q = cuda.local.array((p, p), float64), cuda.local.array((p, p), float64)
        T, N = cuda.local.array((p, p), float64), cuda.local.array((p, p), float64)
        D, x = cuda.local.array(p, float64), cuda.local.array(p, float64)
        scratch = L, Q, T, N, D, cuda.local.array((6, p), float64), x
        own = unit[i], offsets[i], sizes[i], lengths[i]
        nearest_one(i, A, b, y, metrics[0], metric, own, scratch, z, mu, rows, filled, status)

    return cuda.jit(nearest_kernel)


@cache
def _inscribed_ball(p: int) -> Callable:
    n, around = p + 1, simplex_around(p)

    @no_type_check
    def ball_kernel(given, frame, found, values):
        i = cuda.grid(1)
        if i >= values[0]:
            return
        (A, b), (unit, offsets, sizes, lengths), (centre, radius, rows, status) = given, frame, found
        M, V = cuda.local.array((n, n), float64), cuda.local.array((n, n), float64)
        Q, T = cuda.local.array((n, n), float64), cuda.local.array((n, n), float64)
        D, able = cuda.local.array(n, float64), cuda.local.array(n, boolean)
        search, work = cuda.local.array((5, n), float64), cuda.local.array((6, n), float64)
        scratch = M, V, Q, T, D, search, work, able
        own = unit[i], offsets[i], sizes[i], lengths[i]
        ball_one(i, A, b, cuda.const.array_like(around), own, scratch, centre, radius, rows, status)

    return cuda.jit(ball_kernel)


@cache
def _solve_active(n: int, p: int, metric: bool) -> Callable:
    most = max(n, p)

    @no_type_check
    def solve_kernel(given, metrics, found, values):
        i = cuda.grid(1)
        if i >= values[0]:
            return
        (N, filled, pull, offsets), (z, mu) = given, found
        L, T = cuda.local.array((p, p), float64), cuda.local.array((n, n), float64)
        Q, rows = cuda.local.array((n, p), float64), cuda.local.array((n, p), float64)
        scratch = L, Q, rows, T, cuda.local.array(n, float64), cuda.local.array((6, most), float64)
        solve_one(i, N, filled, pull, offsets, metrics[0], metric, scratch, z, mu)

    return cuda.jit(solve_kernel)


@cache
def _nearest_point_vjp(p: int) -> Callable:
    @no_type_check
    def nearest_vjp_kernel(given, gradients, values):
        i = cuda.grid(1)
        if i >= values[0]:
            return
        (A, rows, filled, mu, z, status, grad_z, grad_mu), (grad_A, grad_b, grad_y) = given, gradients
        Q, T = cuda.local.array((p, p), float64), cuda.local.array((p, p), float64)
        N, scaled = cuda.local.array((p, p), float64), cuda.local.array((p, p), float64)
        D, u, v = cuda.local.array(p, float64), cuda.local.array(p, float64), cuda.local.array(p, float64)
        scratch = Q, T, N, scaled, D, u, v, cuda.local.array((6, p), float64)
        nearest_vjp_one(i, A, rows, filled, mu, z, status, grad_z, grad_mu, scratch, grad_A, grad_b, grad_y)

    return cuda.jit(nearest_vjp_kernel)


@cache
def _inscribed_ball_vjp(p: int) -> Callable:
    n, around = p + 1, simplex_around(p)

    @no_type_check
    def ball_vjp_kernel(given, gradients, values):
        i = cuda.grid(1)
        if i >= values[0]:
            return
        (A, centre, radius, rows, grad_centre, grad_radius), (grad_A, grad_b) = given, gradients
        Q, T = cuda.local.array((n, n), float64), cuda.local.array((n, n), float64)
        N, scaled = cuda.local.array((n, n), float64), cuda.local.array((n, n), float64)
        D, u, v = cuda.local.array(n, float64), cuda.local.array(n, float64), cuda.local.array(n, float64)
        pull, nothing = cuda.local.array(n, float64), cuda.local.array(n, float64)
        scratch = Q, T, N, scaled, D, u, v, pull, nothing, cuda.local.array((6, n), float64)
        simplex = cuda.const.array_like(around)
        ball_vjp_one(i, A, centre, radius, rows, simplex, grad_centre, grad_radius, scratch, grad_A, grad_b)

    return cuda.jit(ball_vjp_kernel)


@cache
def _inscribed() -> Callable:
    @no_type_check
    def disc_kernel(given, lines, found, values):
        k = cuda.grid(1)
        if k >= values[0]:
            return
        (vertices, A, b, count), (centre, radius, basis, verified) = given, found
        scratch = lines[0][k], lines[1][k], cuda.local.array(3, float64), cuda.local.array(3, float64)
        disc_one(k, vertices, A, b, count, scratch, centre, radius, basis, verified)

    return cuda.jit(disc_kernel)


@cache
def _feet() -> Callable:
    @no_type_check
    def foot_kernel(given, found, values):
        k = cuda.grid(1)
        if k >= values[0]:
            return
        vertices, A, b, count, point, metric = given
        foot_one(k, vertices, A, b, count, point, metric, found[0], found[1])

    return cuda.jit(foot_kernel)


@cache
def _farthest() -> Callable:
    @no_type_check
    def farthest_kernel(given, found, values):
        i = cuda.grid(1)
        if i < values[0]:
            farthest_one(i, given[0], found[0], found[1])

    return cuda.jit(farthest_kernel)


@cache
def _contains() -> Callable:
    @no_type_check
    def contains_kernel(given, found, values):
        i = cuda.grid(1)
        if i < values[0]:
            vertices, A, b, reach, points = given
            contains_one(i, vertices, A, b, reach, points, values[1], found[0])

    return cuda.jit(contains_kernel)
