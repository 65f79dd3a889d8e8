r"""How vertices, volume and centroid of polytopes change with their rows A z <= b.

The numbers come from `shape`, the derivatives from here.
Which facets meet in a vertex and fill the boundary is known from there. A vertex is the solution of p of its facets,

    A_I z = b_I.

It is corrected by an equation for what is left of its residual, nothing but round-off: its number stays as it was, its
derivatives, of any order, are those of the equation. Volume V and centroid c change by what the facets sweep,

    dV = sum_f int_f (db_f - z.dA_f) dS / |A_f|,     dc = sum_f int_f (z - c) (db_f - z.dA_f) dS / (|A_f| V),

integrals over the simplices that fill a facet. So their first derivatives do not depend on how a vertex is written, and
are right also where more than p facets meet in one; the second ones need vertices that do not (a simple polytope).
All of it in the frame of each set, in which a thin set is as wide as long. Flat sets do not depend on the rows.
"""

from __future__ import annotations

from math import factorial
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.programmes.differentiable import times
from torchfsid.sets.faces import Indices, Mask
from torchfsid.sets.shape import Shape


def vertices(
    A: Float[Tensor, "B F p"], b: Float[Tensor, "B F"], corners: Float[Tensor, "B V p"], shape: Shape
) -> Float[Tensor, "B V p"]:
    """The corners as functions of the rows; one that is not the solution of p facets does not depend on them."""
    frame, unit = _Frame.of(shape, A), Halfspaces(A, b).normalised()
    step = _step(*frame.rows(unit.A, unit.b), torch.as_tensor(shape.y, device=A.device), shape.bases)
    moved, real = corners + frame.outside(step), torch.as_tensor(shape.incident.any(2), device=A.device)
    return torch.where(real.unsqueeze(-1), moved, moved[:, :1])


def measure(
    A: Float[Tensor, "B F p"], b: Float[Tensor, "B F"], shape: Shape
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B p"]]:
    """Volume and centroid."""
    unit = Halfspaces(A, b).normalised()
    return _Measure.apply(unit.A, unit.b, shape)  # type: ignore[return-value]


class _Frame(NamedTuple):
    """The frames of the sets: z = middle + (y * scale) axes."""

    middle: Float[Tensor, "B p"]
    axes: Float[Tensor, "B p p"]
    scale: Float[Tensor, "B p"]

    @classmethod
    def of(cls, shape: Shape, like: Tensor) -> _Frame:
        return cls(*(torch.as_tensor(field, device=like.device) for field in shape.frame[:3]))

    def rows(self, A: Tensor, b: Tensor) -> tuple[Float[Tensor, "B F p"], Float[Tensor, "B F"]]:
        """The rows, for y."""
        return A @ self.axes.mT * self.scale.unsqueeze(-2), b - times(A, self.middle)

    def outside(self, step: Float[Tensor, "B N p"]) -> Float[Tensor, "B N p"]:
        """Changes of y as changes of z."""
        return step * self.scale.unsqueeze(-2) @ self.axes


class _Measure(torch.autograd.Function):
    """(A, b, shape) -> volume and centroid; unit rows."""

    @staticmethod
    def forward(ctx: Any, A: Tensor, b: Tensor, shape: Shape) -> tuple[Tensor, Tensor]:
        volume, centroid = (torch.tensor(field, device=A.device) for field in (shape.volume, shape.centroid))
        ctx.shape = shape
        ctx.save_for_backward(A, b, volume, centroid)
        return volume, centroid

    @staticmethod
    def backward(ctx: Any, grad_volume: Tensor, grad_centroid: Tensor) -> tuple[Tensor, Tensor, None]:
        A, b, volume, centroid = ctx.saved_tensors
        (B, F, p), frame = A.shape, _Frame.of(ctx.shape, A)
        y = torch.as_tensor(ctx.shape.solid.y, device=A.device)
        corner, facet = (torch.as_tensor(index, device=A.device) for index in ctx.shape.simplices)
        item, V = facet // F, y.shape[1]

        rows, right = frame.rows(A, b)
        if torch.is_grad_enabled():  # second derivatives are wanted
            y = y + _step(rows, right, y, ctx.shape.solid_bases)
        ends, normal = y.reshape(-1, p)[corner], rows.reshape(-1, p)[facet]
        edges = ends[:, 1:] - ends[:, :1]
        area = torch.linalg.det(torch.cat([edges, normal.unsqueeze(1)], dim=1)).abs() / factorial(p - 1)
        area = area * frame.scale.prod(-1)[item] / normal.square().sum(-1)  # over the length of the row

        ends = (frame.outside(y) + (frame.middle - centroid).unsqueeze(1)).reshape(B * V, p)[corner]
        pull = (grad_centroid / torch.where(volume > 0, volume, 1.0).unsqueeze(-1))[item]
        along, total, push = times(ends, pull), ends.sum(1), grad_volume[item]
        swept = area * (push + along.sum(-1) / p)
        moments = times(ends.mT, along) + total * along.sum(-1, keepdim=True)
        turned = -area.unsqueeze(-1) * (push.unsqueeze(-1) * total / p + moments / (p * (p + 1)))
        grad_b = torch.zeros_like(b).reshape(-1).index_add(0, facet, swept).reshape(B, F)
        grad_A = torch.zeros_like(A).reshape(-1, p).index_add(0, facet, turned).reshape(B, F, p)
        return grad_A - grad_b.unsqueeze(-1) * centroid.unsqueeze(-2), grad_b, None


def _step(
    rows: Float[Tensor, "B F p"], right: Float[Tensor, "B F"], y: Float[Tensor, "B V p"], bases: tuple[Indices, Mask]
) -> Float[Tensor, "B V p"]:
    """Zero, and how the solutions y of p rows each change with the rows."""
    basis: Int[Tensor, "B V p"]
    solved: Bool[Tensor, "B V"]
    basis, solved = (torch.as_tensor(field, device=rows.device) for field in bases)
    item, p = torch.arange(len(rows), device=rows.device)[:, None, None], y.shape[-1]
    identity = torch.eye(p, dtype=rows.dtype, device=rows.device)
    M = torch.where(solved[..., None, None], rows[item, basis], identity)
    step = torch.linalg.solve(M, torch.where(solved.unsqueeze(-1), right[item, basis], y) - times(M, y))
    return step - step.detach()
