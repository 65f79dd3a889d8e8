r"""Half-spaces: the one type for safe controls and for sets of parameters.

    {z in R^n : A z <= b},    A (*batch, m, n),  b (*batch, m),    closed, row by row.

A row 0.z <= 1 holds everywhere. Such rows are padding: they let scenes with different numbers of rows share a batch,
and a mask drops rows by turning them into padding. Rows may carry a `source`, an integer that names the constraint each
row came from. All operations keep it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np  # its broadcast_shapes does not wait for sympy
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.device import all_seen
from torchfsid.errors import InputError
from torchfsid.tolerances import ROUND_OFF

LONG = 1e100
"""Largest entry of rows that are not shortened."""


@dataclass(frozen=True)
class Halfspaces:
    """{z : A z <= b}. Tensors of any float type are cast to float64. Gradients flow back through the cast.

    Attributes:
        A: the rows (*batch, m, n).
        b: the right-hand sides (*batch, m).
        source: the constraint that each row came from (*batch, m), or None.

    Raises:
        InputError: the last dimensions of `A` and `b` do not match.
    """

    A: Float[Tensor, "*#batch m n"]
    b: Float[Tensor, "*#batch m"]
    source: Int[Tensor, "*#batch m"] | None = None

    def __post_init__(self) -> None:
        A, b = reals("A", self.A), reals("b", self.b)
        if A.ndim < 2 or A.shape[-2:-1] != b.shape[-1:]:
            raise InputError("Halfspaces(A, b)", "A (*batch, m, n) and b (*batch, m)", (tuple(A.shape), tuple(b.shape)))
        if A.shape[:-1] != b.shape:
            try:
                batch = np.broadcast_shapes(A.shape[:-2], b.shape[:-1])
            except ValueError as error:
                raise InputError("Halfspaces(A, b)", "equal batch shapes", (tuple(A.shape), tuple(b.shape))) from error
            A, b = A.expand(*batch, *A.shape[-2:]), b.expand(*batch, b.shape[-1])
        object.__setattr__(self, "A", A)
        object.__setattr__(self, "b", b)
        if self.source is not None and self.source.shape != b.shape:
            object.__setattr__(self, "source", self.source.expand(self.b.shape))

    @classmethod
    def stack(cls, parts: Sequence[Halfspaces]) -> Halfspaces:
        """The intersection of several sets: their rows, one below the other. Batches broadcast."""
        if len(parts) == 1:
            return parts[0]
        batch = np.broadcast_shapes(*(part.batch_shape for part in parts))
        sources = [part.source.expand(*batch, part.rows) for part in parts if part.source is not None]
        return cls(
            torch.cat([part.A.expand(*batch, part.rows, part.dim) for part in parts], dim=-2),
            torch.cat([part.b.expand(*batch, part.rows) for part in parts], dim=-1),
            torch.cat(sources, dim=-1) if len(sources) == len(parts) else None,
        )

    @property
    def batch_shape(self) -> torch.Size:
        """The shape of the batch."""
        return self.b.shape[:-1]

    @property
    def rows(self) -> int:
        """m, the number of rows, padding included."""
        return self.b.shape[-1]

    @property
    def dim(self) -> int:
        """n, the number of entries of z."""
        return self.A.shape[-1]

    def pullback(self, G: Float[Tensor, "*batch n p"], f: Float[Tensor, "*batch n"]) -> Halfspaces:
        """The preimage {theta in R^p : G theta + f in this set}, that is A G theta <= b - A f."""
        G, f = G.to(torch.float64), f.to(torch.float64)
        return Halfspaces(self.A @ G, self.b - (self.A @ f.unsqueeze(-1)).squeeze(-1), self.source)

    def select(self, items: Int[Tensor, "k"]) -> Halfspaces:
        """The items at these places of a batch (B,)."""
        return Halfspaces(self.A[items], self.b[items], None if self.source is None else self.source[items])

    def where(self, keep: Bool[Tensor, "*batch m"]) -> Halfspaces:
        """Keep the rows marked by `keep`. The others become padding 0.z <= 1."""
        if all_seen(keep):
            return self
        return Halfspaces(torch.where(keep.unsqueeze(-1), self.A, 0.0), torch.where(keep, self.b, 1.0), self.source)

    def norms(self) -> Float[Tensor, "*batch m"]:
        """The lengths |a_j|. Padding rows give 1, so that a division by the lengths and its gradient are finite."""
        return lengths(self.A)

    def normalised(self) -> Halfspaces:
        """The same set with unit rows. Padding rows are left unchanged."""
        A, b, norms = self._scaled()
        return Halfspaces(A / norms.unsqueeze(-1), b / norms, self.source)

    def shortened(self) -> Halfspaces:
        """The same set, with rows scaled if a product of one with a point could overflow."""
        if self.b.numel() == 0 or self.dim == 0 or _largest(self.A) < LONG:
            return self
        A, b, _ = self._scaled()
        return Halfspaces(A, b, self.source)

    def slack(self, z: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch m"]:
        """(b_j - a_j.z)/|a_j|: the signed distance of z to each boundary, positive inside, in the units of z."""
        A, b, norms = self._scaled()
        return (b - dot(A, z.to(torch.float64).unsqueeze(-2))) / norms

    def round_off(self, z: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch m"]:
        """A bound on the rounding error of `slack(z)`, in the units of z."""
        A, b, norms = self._scaled()
        sizes = dot(A.abs(), z.abs().to(torch.float64).unsqueeze(-2)) + b.abs()
        return (ROUND_OFF * sizes / norms).detach()

    def _scaled(self) -> tuple[Tensor, Tensor, Tensor]:
        """A and b, scaled exactly by powers of two to rows of about unit length, and the norms of the scaled rows."""
        scale = power_of_two(self.A)
        A = self.A / scale.unsqueeze(-1)
        return A, self.b / scale, _root_of_squares(A)

    def contains(self, z: Float[Tensor, "*batch n"], tolerance: float = 0.0) -> Bool[Tensor, "*batch"]:
        """Is z inside the set, or outside by a distance of at most `tolerance` (units of z)?"""
        return (self.slack(z) >= -tolerance).all(-1)


def as_halfspaces(value: Any) -> Halfspaces:
    """Half-spaces, given as such, as a pair (A, b), or as an object with `halfspaces()`, such as a `FeasibleSet`.

    Raises:
        InputError: it is none of these.
    """
    if isinstance(value, Halfspaces):
        return value
    if isinstance(value, tuple | list) and len(value) == 2:
        return Halfspaces(*value)
    if not hasattr(value, "halfspaces"):
        raise InputError("halfspaces", "Halfspaces, a FeasibleSet or a pair (A, b)", type(value).__name__)
    rows: Any = value
    return rows.halfspaces()


def dot(v: Float[Tensor, "*#batch n"], w: Float[Tensor, "*#batch n"]) -> Float[Tensor, "*#batch"]:
    """The inner product v.w. It is faster than a product of many small matrices, and rounds alike in every batch."""
    products = (v * w).unbind(-1) if v.shape[-1] else (torch.zeros_like(v).sum(-1),)
    return sum(products[1:], start=products[0])


def lengths(rows: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
    """The lengths |a|; zero rows give 1. No square over- or underflows, and the gradient is finite everywhere."""
    scale = power_of_two(rows)
    return scale * _root_of_squares(rows / scale.unsqueeze(-1))


def power_of_two(rows: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
    """A power of two about as large as the largest entry of each row. Zero rows and rows that are not finite give 1."""
    largest = rows.detach().abs().amax(-1) if rows.shape[-1] else rows.detach().sum(-1)
    scale = largest / (2 * torch.frexp(largest).mantissa)
    return torch.where((largest > 0) & scale.isfinite() & (scale > 0), scale, 1.0)


def _root_of_squares(rows: Tensor) -> Tensor:
    squared = dot(rows, rows)
    padding = squared == 0
    return torch.where(padding, 1.0, squared.masked_fill(padding, 1.0).sqrt())


def reals(name: str, value: object) -> Tensor:
    """The argument `name` as a tensor in float64. Gradients flow back through the cast.

    Raises:
        InputError: it is no tensor and cannot become one.
    """
    try:
        return torch.as_tensor(value).to(torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(name, "a tensor of numbers", value) from error


def finite(*tensors: Tensor) -> bool:
    """Are all numbers finite? The sum is tested first, because it is finite unless a number is not or it overflows."""
    return math.isfinite(sum(t.detach().sum().item() for t in tensors)) or all(
        bool(t.isfinite().all()) for t in tensors
    )


def _largest(tensor: Tensor) -> float:
    """The largest |entry| of a tensor that is not empty. Numpy is the fastest on the CPU."""
    if not tensor.is_cpu:
        return float(tensor.detach().abs().amax())
    values = array(tensor)
    return max(float(values.max()), -float(values.min()))


def array(tensor: Tensor) -> np.ndarray:
    """The tensor as a contiguous array on the CPU, which kernels take. It is copied only if it is not one already."""
    return tensor.contiguous().numpy(force=True)  # torch copies faster than numpy
