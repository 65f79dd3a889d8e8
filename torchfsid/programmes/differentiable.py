r"""Two convex programmes over half-spaces {z : A z <= b}, exact and differentiable: nearest point and inscribed ball.

    nearest_point     min 1/2 (z - y)' H (z - y)   s.t.  A z <= b                (the metric H, I by default)
    inscribed_ball    max r                        s.t.  a_j.z + |a_j| r <= b_j  (the Chebyshev centre z)

The active rows N are found without gradients (`exact`). They alone decide the answer. Its derivatives follow from these
equations by implicit differentiation:

    point:  H z + N' mu = H y,  N z = b        ball:  (a_j, |a_j|) w = b_j, p + 1 rows, a square system

Derivatives of any order, forward and backward, are right as long as the active rows stay the same. Where the active set
switches, or rows are tied (several on one line, more than p through one point), they are those of one side. The matrix
N N' is never formed, because its condition number is that of N squared.
"""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchfsid.device import constant
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, lengths
from torchfsid.kernels.active_rows import simplex_around
from torchfsid.outcome import Status
from torchfsid.programmes import exact
from torchfsid.programmes.on_tensors import on_items


class NearestPoint(NamedTuple):
    """The nearest point, in the dtype of the given point, and a `Status` for each item."""

    point: Float[Tensor, "*batch p"]
    status: Int[Tensor, "*batch"]

    @property
    def status_names(self) -> Any:
        """The statuses in words, nested like the batch; one word for a single item."""
        return Status.names(self.status)


class InscribedBall(NamedTuple):
    """Centre and radius of the largest inscribed ball, and a `Status` for each item."""

    centre: Float[Tensor, "*batch p"]
    radius: Float[Tensor, "*batch"]
    status: Int[Tensor, "*batch"]

    @property
    def status_names(self) -> Any:
        """The statuses in words, nested like the batch; one word for a single item."""
        return Status.names(self.status)


def nearest_point(
    halfspaces: Halfspaces, point: Float[Tensor, "*#batch p"], metric: Float[Tensor, "*#batch p p"] | None = None
) -> NearestPoint:
    """The point of each set nearest to `point` in the norm sqrt(z' metric z) (default: Euclidean). Batches broadcast.

    Raises:
        InputError: dimensions or batches do not fit, or p = 0.
    """
    found, _, _, _, status = nearest(*broadcast(halfspaces, point, metric))
    return NearestPoint(found.to(point.dtype), status)


def nearest(halfspaces: Halfspaces, y: Tensor, metric: Tensor | None = None) -> tuple[Tensor, ...]:
    """The nearest point for arguments that are already `broadcast`.

    Returns:
        The point and the multipliers mu, both with gradients. Then the active rows, a mask of the places that they
        fill, and the status.
    """
    return _NearestPoint.apply(halfspaces.A, halfspaces.b, y, metric)  # type: ignore[return-value]


def inscribed_ball(halfspaces: Halfspaces) -> InscribedBall:
    """A largest ball inside each set. For an empty set the radius is negative.

    Where the centre is not unique, the one with the smallest z_1 is returned, among these the one with the smallest
    z_2, and so on. Its gradient is that of the rows that decide this choice. The radius and its gradient are right in
    any case.

    Raises:
        InputError: p = 0.
    """
    halfspaces, *_ = broadcast(halfspaces)
    centre, radius, _, status = _InscribedBall.apply(halfspaces.A, halfspaces.b)  # type: ignore[misc]
    return InscribedBall(centre, radius, status)


def broadcast(
    halfspaces: Halfspaces, point: Tensor | None = None, metric: Tensor | None = None
) -> tuple[Halfspaces, Any, Any]:
    """Half-spaces, point and metric in float64 with one batch shape. The half-spaces get a row if they have none."""
    p = halfspaces.dim
    if p == 0:
        raise InputError("halfspaces", "rows (*batch, m, p) with p >= 1", tuple(halfspaces.A.shape))
    if halfspaces.rows == 0:
        A, b = halfspaces.A, halfspaces.b
        halfspaces = Halfspaces(A.new_zeros(*A.shape[:-2], 1, p), b.new_ones(*b.shape[:-1], 1))
    if point is None:
        return halfspaces, None, None
    if point.shape[-1:] != (p,):
        raise InputError("point", f"(*batch, {p})", tuple(point.shape))
    if metric is not None and metric.shape[-2:] != (p, p):
        raise InputError("metric", f"(*batch, {p}, {p})", tuple(metric.shape))
    shapes = [halfspaces.batch_shape, point.shape[:-1]] + ([] if metric is None else [metric.shape[:-2]])
    if any(shape != shapes[0] for shape in shapes):
        try:
            batch = torch.broadcast_shapes(*shapes)
        except RuntimeError as error:
            raise InputError("halfspaces, point, metric", "batches that broadcast", [*map(tuple, shapes)]) from error
        A, b = halfspaces.A.expand(*batch, halfspaces.rows, p), halfspaces.b.expand(*batch, halfspaces.rows)
        halfspaces, point = Halfspaces(A, b), point.expand(*batch, p)
        metric = None if metric is None else metric.expand(*batch, p, p)
    return halfspaces, point.to(torch.float64), None if metric is None else symmetric(metric.to(torch.float64))


def symmetric(metric: Float[Tensor, "*batch p p"]) -> Float[Tensor, "*batch p p"]:
    """The symmetric part of a metric. Only this part counts, so the gradient of a metric is symmetric as well."""
    return (metric + metric.mT) / 2


def solve_active(
    N: Tensor, filled: Tensor, pull: Tensor, offsets: Tensor, metric: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Solve H z + N' mu = pull, N z = offsets for z and mu, with gradients, for the first rows of N, `filled`."""
    return _SolveActive.apply(N, filled, pull, offsets, metric)  # type: ignore[return-value]


# With gradients -----------------------------------------------------------------------------------------------------


def _signed(forward: Callable) -> Callable:
    """Store the signature of `forward`, which autograd reads at every call. This is quicker."""
    forward.__signature__ = signature(forward)  # type: ignore[attr-defined]
    return forward


class _NearestPoint(torch.autograd.Function):
    """(A, b, y, H) -> the point, the multipliers mu, the active rows, a mask of the places they fill, the status."""

    @staticmethod
    @_signed
    def forward(A: Tensor, b: Tensor, y: Tensor, metric: Tensor | None) -> tuple[Tensor, ...]:
        return on_items(exact.nearest_point, *((A, b, y) if metric is None else (A, b, y, metric)))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        A, _, y, metric = inputs
        ctx.mark_non_differentiable(*output[2:])
        ctx.save_for_backward(A, y, metric, *output)
        ctx.save_for_forward(A, y, metric, *output)

    @staticmethod
    def backward(ctx: Any, grad_z: Tensor, grad_mu: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        A, y, metric, z, mu, rows, filled, status = ctx.saved_tensors
        if metric is None and _first_derivatives_suffice():
            saved = A, rows, filled, mu, z, status
            return *on_items(exact.nearest_point_vjp, *saved, grad_z, grad_mu), None
        ok = status.unsqueeze(-1) == Status.OK
        z, metric = torch.where(ok, z, 0.0), _definite(metric, ok)
        N, index = _taken(A, rows)
        u, v = _SolveActive.apply(N, filled, torch.where(ok, grad_z, 0.0), grad_mu, metric)  # type: ignore[misc]
        grad_A = torch.zeros_like(A).scatter_add(-2, index, _of_rows(mu, u, v, z))
        grad_b = torch.zeros_like(A[..., 0]).scatter_add(-1, rows, v)
        if metric is None:
            return grad_A, grad_b, u, None
        return grad_A, grad_b, times(metric, u), u.unsqueeze(-1) * torch.where(ok, y - z, 0.0).unsqueeze(-2)

    @staticmethod
    def jvp(ctx: Any, dA: Any, db: Any, dy: Any, dmetric: Any) -> tuple[Tensor | None, ...]:
        A, y, metric, z, mu, rows, filled, status = ctx.saved_tensors
        ok = status.unsqueeze(-1) == Status.OK
        z, metric = torch.where(ok, z, 0.0), _definite(metric, ok)
        N, index = _taken(A, rows)
        pull, offsets = torch.zeros_like(z), torch.zeros_like(z)
        if dA is not None:
            dN = dA.gather(-2, index)
            pull, offsets = pull - times(dN.mT, mu), offsets - times(dN, z)
        if db is not None:
            offsets = offsets + db.gather(-1, rows)
        if dy is not None:
            pull = pull + (dy if metric is None else times(metric, dy))
        if dmetric is not None:
            pull = pull + times(dmetric, y - z)
        step, dmu = _SolveActive.apply(N, filled, torch.where(ok, pull, 0.0), offsets, metric)  # type: ignore[misc]
        return step, dmu, None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *inputs: Tensor | float | None) -> tuple:
        return _NearestPoint.apply(*in_front(info.batch_size, in_dims, inputs)), (0,) * 5


class _SolveActive(torch.autograd.Function):
    """(N, filled, pull, offsets, H) -> z and mu with H z + N' mu = pull, N z = offsets, for the rows `filled` of N.

    The system's matrix is symmetric. So a derivative of its solution solves the same system with another right-hand
    side.
    """

    @staticmethod
    @_signed
    def forward(
        N: Tensor, filled: Tensor, pull: Tensor, offsets: Tensor, metric: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        tensors = (N, filled, pull, offsets) if metric is None else (N, filled, pull, offsets, metric)
        z, mu = on_items(exact.solve_active, *tensors)
        return z, mu

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, Tensor]) -> None:
        N, filled, _, _, metric = inputs
        ctx.save_for_backward(N, filled, metric, *output)
        ctx.save_for_forward(N, filled, metric, *output)

    @staticmethod
    def backward(ctx: Any, grad_z: Tensor, grad_mu: Tensor) -> tuple[Tensor | None, ...]:
        N, filled, metric, z, mu = ctx.saved_tensors
        u, v = _SolveActive.apply(N, filled, grad_z, grad_mu, metric)  # type: ignore[misc]
        return _of_rows(mu, u, v, z), None, u, v, None if metric is None else -u.unsqueeze(-1) * z.unsqueeze(-2)

    @staticmethod
    def jvp(ctx: Any, dN: Any, _: None, dpull: Any, doffsets: Any, dmetric: Any) -> tuple[Tensor, Tensor]:
        N, filled, metric, z, mu = ctx.saved_tensors
        dpull = torch.zeros_like(z) if dpull is None else dpull
        doffsets = torch.zeros_like(mu) if doffsets is None else doffsets
        if dN is not None:
            dpull, doffsets = dpull - times(dN.mT, mu), doffsets - times(dN, z)
        if dmetric is not None:
            dpull = dpull - times(dmetric, z)
        return _SolveActive.apply(N, filled, dpull, doffsets, metric)  # type: ignore[return-value]

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *tensors: Tensor | None) -> tuple:
        return _SolveActive.apply(*in_front(info.batch_size, in_dims, tensors)), (0, 0)


class _InscribedBall(torch.autograd.Function):
    """(A, b) -> the centre, the radius, the rows that decide them, the status."""

    @staticmethod
    @_signed
    def forward(A: Tensor, b: Tensor) -> tuple[Tensor, ...]:
        return on_items(exact.inscribed_ball, A, b)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output[2:])
        ctx.save_for_backward(inputs[0], *output[:3])
        ctx.save_for_forward(inputs[0], *output[:3])

    @staticmethod
    def _system(A: Tensor, centre: Tensor, radius: Tensor, rows: Tensor) -> tuple[Tensor, ...]:
        """The rows (a, |a|), the points where the ball touches them, a mask of real rows, and their indices."""
        real, rows = rows < A.shape[-2], rows.clamp(max=A.shape[-2] - 1)
        N, index = _taken(A, rows)
        sides = constant(tuple(map(tuple, simplex_around(A.shape[-1])[:, :-1])), A.device)
        N = torch.where(real.unsqueeze(-1), N, sides)
        norms = lengths(N).unsqueeze(-1)
        touching = _finite(centre).unsqueeze(-2) + _finite(radius)[..., None, None] * N / norms
        return torch.cat([N, norms], dim=-1), touching, real, rows, index

    @staticmethod
    def backward(ctx: Any, grad_centre: Tensor, grad_radius: Tensor, *_: Tensor) -> tuple[Tensor, Tensor]:
        A, centre, radius, rows = ctx.saved_tensors
        if _first_derivatives_suffice():
            grad_A, grad_b = on_items(exact.inscribed_ball_vjp, A, centre, radius, rows, grad_centre, grad_radius)
            return grad_A, grad_b
        M, touching, real, rows, index = _InscribedBall._system(A, centre, radius, rows)
        given = torch.cat([grad_centre, grad_radius.unsqueeze(-1)], dim=-1)
        found = torch.cat([centre, radius.unsqueeze(-1)], dim=-1).isfinite()
        # Not by linalg.solve: its forward derivative over a backward one is wrong under vmap (torch 2.13).
        given, every = torch.where(found, given, 0.0), torch.ones_like(real)
        _, v = _SolveActive.apply(M, every, given, torch.zeros_like(given), None)  # type: ignore[misc]
        v = torch.where(real, v, 0.0)
        grad_A = torch.zeros_like(A).scatter_add(-2, index, -v.unsqueeze(-1) * touching)
        return grad_A, torch.zeros_like(A[..., 0]).scatter_add(-1, rows, v)

    @staticmethod
    def jvp(ctx: Any, dA: Any, db: Any) -> tuple[Tensor | None, ...]:
        A, centre, radius, rows = ctx.saved_tensors
        M, touching, real, rows, index = _InscribedBall._system(A, centre, radius, rows)
        right = torch.zeros_like(M[..., 0]) if db is None else db.gather(-1, rows)
        if dA is not None:
            right = right - (dA.gather(-2, index) * touching).sum(-1)
        right, every = torch.where(real, right, 0.0), torch.ones_like(real)
        ball, _ = _SolveActive.apply(M, every, torch.zeros_like(right), right, None)  # type: ignore[misc]
        found = centre.isfinite(), radius.isfinite()
        return torch.where(found[0], ball[..., :-1], 0.0), torch.where(found[1], ball[..., -1], 0.0), None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *tensors: Tensor | None) -> tuple:
        return _InscribedBall.apply(*in_front(info.batch_size, in_dims, tensors)), (0,) * 4


def _finite(values: Tensor) -> Tensor:
    return torch.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)


def _first_derivatives_suffice() -> bool:
    """Are only first derivatives asked for, without a graph and without a transform (vmap, jvp)? Then compiled
    vector-Jacobian products are used."""
    return not torch.is_grad_enabled() and not torch._C._are_functorch_transforms_active()


def _taken(A: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    index = rows.unsqueeze(-1).expand(*rows.shape, A.shape[-1])
    return A.gather(-2, index), index


def _of_rows(mu: Tensor, u: Tensor, v: Tensor, z: Tensor) -> Tensor:
    """The gradient with respect to the active rows, given a solution (z, mu) and its adjoint (u, v)."""
    return -(mu.unsqueeze(-1) * u.unsqueeze(-2) + v.unsqueeze(-1) * z.unsqueeze(-2))


def _definite(metric: Tensor | None, ok: Tensor) -> Tensor | None:
    """The metric, replaced by the identity in items whose status is not OK."""
    if metric is None:
        return None
    return torch.where(ok.unsqueeze(-1), metric, torch.eye(metric.shape[-1], dtype=metric.dtype, device=metric.device))


def times(M: Tensor, v: Tensor) -> Tensor:
    return (M @ v.unsqueeze(-1)).squeeze(-1)


def in_front(size: int, dims: tuple, inputs: tuple) -> list[Tensor | float | None]:
    """The inputs of a vmap, with its dimension moved to the front of every tensor."""
    return [
        t if not isinstance(t, Tensor) else t.expand(size, *t.shape) if dim is None else t.movedim(dim, 0)
        for t, dim in zip(inputs, dims, strict=True)
    ]
