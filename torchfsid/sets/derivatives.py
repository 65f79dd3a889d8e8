r"""Derivatives of vertices, inscribed ball, volume and centroid of a bounded convex polytope {z : A z <= b} in R^p.

The facets that meet in a vertex, fill the boundary or touch the inscribed ball are found without gradients. They give
implicit equations for the answer, and implicit differentiation gives derivatives of any order:

    vertex            A_I z = b_I                  I: p of its facets
    inscribed ball    A_I z + |A_I| r = b_I        I: the p + 1 facets that decide it

An answer is written as its number plus one Newton step of these equations. The step is zero, its derivatives are not.
Volume V and centroid c change by the volume that the facets sweep,

    dV = sum_f int_f (db_f - z.dA_f) dS / |A_f|,     dc = sum_f int_f (z - c) (db_f - z.dA_f) dS / (|A_f| V),

integrated over the simplices that fill a facet. First derivatives do not depend on the facets chosen for a vertex, and
are right also where more than p facets meet in one. Second derivatives are those of the vertices' equations.
"""

from __future__ import annotations

from math import factorial
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.halfspaces import dot, lengths


class Skeleton(NamedTuple):
    """The combinatorial structure of a batch of polytopes, without gradients.

    Attributes:
        corners: the vertices.
        bases: p facets of each vertex.
        solved: whether these are independent, so that the vertex is their solution. Others are constant.
        simplices: the vertices of each simplex. The simplices fill the facets. Padding repeats one vertex.
        facet: the facet that each simplex is a part of.
        solid: whether the volume is more than round-off. Otherwise the centroid is constant.
    """

    corners: Float[Tensor, "B V p"]
    bases: Int[Tensor, "B V p"]
    solved: Bool[Tensor, "B V"]
    simplices: Int[Tensor, "B S p"]
    facet: Int[Tensor, "B S"]
    solid: Bool[Tensor, "B"]


def vertices(A: Float[Tensor, "B F p"], b: Float[Tensor, "B F"], skeleton: Skeleton) -> Float[Tensor, "B V p"]:
    """The corners as functions of the rows."""
    return solution(skeleton.corners, at(A, skeleton.bases), at(b, skeleton.bases), skeleton.solved)


def inscribed_ball(
    A: Float[Tensor, "B F p"],
    b: Float[Tensor, "B F"],
    centre: Float[Tensor, "B p"],
    radius: Float[Tensor, "B"],
    rows: Int[Tensor, "B p+1"],
    solved: Bool[Tensor, "B"],
) -> tuple[Float[Tensor, "B p"], Float[Tensor, "B"]]:
    """Centre and radius as functions of the p + 1 facets `rows` that decide them. Constant where not `solved`."""
    N, ball = at(A, rows), torch.cat([centre, radius.unsqueeze(-1)], dim=-1)
    M = torch.cat([N, torch.linalg.vector_norm(N, dim=-1, keepdim=True)], dim=-1)
    ball = solution(ball, M, at(b, rows), solved)
    return ball[:, :-1], ball[:, -1]


def measure(
    A: Float[Tensor, "B F p"],
    b: Float[Tensor, "B F"],
    volume: Float[Tensor, "B"],
    centroid: Float[Tensor, "B p"],
    skeleton: Skeleton,
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B p"]]:
    """Volume and centroid as functions of the rows."""
    return _Measure.apply(A, b, volume, centroid, skeleton)  # type: ignore[return-value]


class _Measure(torch.autograd.Function):
    """(A, b, volume and centroid as numbers, skeleton) -> volume and centroid as functions of A and b."""

    @staticmethod
    def forward(
        ctx: Any, A: Tensor, b: Tensor, volume: Tensor, centroid: Tensor, skeleton: Skeleton
    ) -> tuple[Tensor, Tensor]:
        volume, centroid = volume.clone(), centroid.clone()
        ctx.skeleton = skeleton
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(A, b, volume, centroid)
        return volume, centroid

    @staticmethod
    def backward(ctx: Any, grad_volume: Tensor | None, grad_centroid: Tensor | None) -> tuple[Tensor | None, ...]:
        if grad_volume is None and grad_centroid is None:
            return (None,) * 5
        A, b, volume, centroid = ctx.saved_tensors
        skeleton, p = ctx.skeleton, A.shape[-1]
        # Second derivatives are wanted if gradients are enabled here.
        z = vertices(A, b, skeleton) if torch.is_grad_enabled() else skeleton.corners
        ends, normal = at(z, skeleton.simplices), at(A, skeleton.facet)
        area, ends = _over_length(ends, normal), ends - centroid[:, None, None]
        total, grad_right, grad_row = added(ends, -2), torch.zeros_like(area), torch.zeros_like(normal)
        if grad_volume is not None:
            grad_right = area * grad_volume.unsqueeze(-1)
            grad_row = -(grad_right / p).unsqueeze(-1) * total
        if grad_centroid is not None:
            solid = skeleton.solid.unsqueeze(-1)
            pull = torch.where(solid, grad_centroid / torch.where(solid, volume.unsqueeze(-1), 1.0), 0.0)
            along = dot(ends, pull[:, None, None])
            along_all = added(along, -1)
            grad_right = grad_right + area * along_all / p
            moments = dot(ends.mT, along.unsqueeze(-2)) + total * along_all.unsqueeze(-1)
            grad_row = grad_row - area.unsqueeze(-1) * moments / (p * (p + 1))
        grad_b = torch.zeros_like(b).scatter_add(1, skeleton.facet, grad_right)
        index = skeleton.facet.unsqueeze(-1).expand_as(grad_row)
        grad_A = torch.zeros_like(A).scatter_add(1, index, grad_row) - grad_b.unsqueeze(-1) * centroid.unsqueeze(1)
        return grad_A, grad_b, None, None, None


def _over_length(ends: Float[Tensor, "B S p p"], normal: Float[Tensor, "B S p"]) -> Float[Tensor, "B S"]:
    """Each simplex's area divided by the length of its facet's row: |det(edges, normal)| / ((p - 1)! |normal|^2)."""
    p, squared = normal.shape[-1], dot(normal, normal)
    edges = ends[:, :, 1:] - ends[:, :, :1]
    if p == 2:
        determinant = edges[:, :, 0, 0] * normal[..., 1] - edges[:, :, 0, 1] * normal[..., 0]
    else:
        determinant = torch.linalg.det(torch.cat([edges, normal.unsqueeze(-2)], dim=-2))
    return determinant.abs() / (factorial(p - 1) * torch.where(squared > 0, squared, 1.0))


def solution(
    number: Float[Tensor, "*N k"], M: Float[Tensor, "*N k k"], right: Float[Tensor, "*N k"], solved: Bool[Tensor, "*N"]
) -> Float[Tensor, "*N k"]:
    """`number` with the derivatives of the solution of M z = right, which it equals. Constant where not `solved`."""
    residual = torch.where(solved.unsqueeze(-1), right - dot(M, number.unsqueeze(-2)), 0.0)
    identity = torch.eye(M.shape[-1], dtype=M.dtype, device=M.device)
    M = torch.where(solved[..., None, None], M, identity)
    if M.shape[-1] == 2:
        (p, q), (r, s) = M[..., 0, :].unbind(-1), M[..., 1, :].unbind(-1)
        c, d = residual.unbind(-1)
        step = torch.stack([c * s - d * q, p * d - r * c], dim=-1) / (p * s - q * r).unsqueeze(-1)
    else:
        step = torch.linalg.solve_ex(M, residual).result  # `solve` would wait for a device, to raise
    return number + (step - step.detach())


def distance(number: Float[Tensor, "B"], ends: Float[Tensor, "B 2 p"]) -> Float[Tensor, "B"]:
    """`number` with the derivatives of the distance between two points, which it equals. Constant where it is 0."""
    between = lengths(ends[:, 0] - ends[:, 1])
    return number + torch.where(number > 0, between - between.detach(), 0.0)


def added(terms: Tensor, dim: int) -> Tensor:
    """The sum over a dimension of a few entries. It is faster than `Tensor.sum`."""
    first, *others = terms.unbind(dim)
    return sum(others, start=first)


def at(table: Tensor, index: Int[Tensor, "B *K"]) -> Tensor:
    """The entries of `table` (B, F) or (B, F, p) at the places `index` of each item."""
    flat = index.flatten(1)
    if table.ndim == 2:
        return table.gather(1, flat).reshape(index.shape)
    p = table.shape[-1]
    return table.gather(1, flat.unsqueeze(-1).expand(-1, -1, p)).reshape(*index.shape, p)
