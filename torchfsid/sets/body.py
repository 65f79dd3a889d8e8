"""The interface of a batch of sets: a `Polygon` in the plane, a `Polyhedron` for p = 3, else a `Polytope`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

PRIOR = -1
"""`source` of the facets that a set began with."""


@dataclass(frozen=True)
class Contradiction:
    """Up to p + 1 rows per item that no point satisfies together (Helly), without gradients. Missing rows are NaN.

    The proof is a y >= 0 with y'A = 0 and y'b < 0 by more than round-off.
    """

    A: Float[Tensor, "B R p"]
    b: Float[Tensor, "B R"]
    time: Float[Tensor, "B R"]
    source: Int[Tensor, "B R"]

    @classmethod
    def none(cls, batch: int, dim: int, like: Tensor) -> Contradiction:
        """No contradiction in any of the items."""
        nothing = like.detach().new_full((batch, dim + 1), torch.nan)
        rows = nothing.unsqueeze(-1).repeat(1, 1, dim)
        return cls(rows, nothing, nothing.clone(), torch.full_like(nothing, PRIOR).long())

    @property
    def parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """A, b, time and source."""
        return self.A, self.b, self.time, self.source


@dataclass(frozen=True)
class Clipped:
    """Bodies after a clip.

    Attributes:
        body: the intersection. Empty items keep the body from before the clip.
        outcome: a `Status` per item.
        shrunk: whether the clip made the item smaller.
        contradiction: the rows that contradict each other, for empty items. None if all outcomes are known to be OK.
    """

    body: Any
    outcome: Int[Tensor, "B"]
    shrunk: Bool[Tensor, "B"]
    contradiction: Contradiction | None


class Body(Protocol):
    """A batch of bounded convex sets {z : A z <= b} in R^p, without redundant rows.

    Attributes:
        A: the facets' rows, padded with 0.z <= 1.
        b: their right-hand sides.
        count: the number of real facets.
        time: the time when each facet came [s]; NaN for the facets of the prior.
        source: the constraint that each facet came from; `PRIOR` for the facets of the prior.
    """

    A: Float[Tensor, "B F p"]
    b: Float[Tensor, "B F"]
    time: Float[Tensor, "B F"]
    source: Int[Tensor, "B F"]
    count: Int[Tensor, "B"]

    @property
    def reach(self) -> Float[Tensor, "B p"]:
        """The largest |coordinates| that the sets ever had. The round-off of the sets is proportional to them."""
        ...

    @property
    def corners(self) -> Float[Tensor, "B V p"]:
        """The vertices without gradients, padded by repeating the first one."""
        ...

    @property
    def vertices(self) -> Float[Tensor, "B V p"]:
        """The vertices, padded by repeating the first one."""
        ...

    def rows(self) -> tuple[Float[Tensor, "B F p"], Float[Tensor, "B F"]]:
        """A and b, with the gradients of the given rows that have become facets."""
        ...

    def select(self, items: Int[Tensor, "k"]) -> Body:
        """The sub-batch at `items`."""
        ...

    def replaced(self, items: Int[Tensor, "k"], other: Any) -> Body:
        """This batch with the sets of `other` at the places `items`."""
        ...

    def clip(
        self,
        A: Float[Tensor, "B R p"],
        b: Float[Tensor, "B R"],
        time: Float[Tensor, "B R"],
        source: Int[Tensor, "B R"],
        most: int,
    ) -> Clipped:
        """Intersect every body with its R half-spaces A z <= b, stamping new facets with `time` and `source`.

        A row that only touches a body within round-off is moved outward by that round-off and then applied. A body
        with more than `most` facets after the clip is merged outward. Where merging costs more than the cut has
        gained, the body stays as it was.
        """
        ...

    def volume(self) -> Float[Tensor, "B"]: ...

    def centroid(self) -> Float[Tensor, "B p"]: ...

    def diameter(self) -> Float[Tensor, "B"]: ...

    def support(self, direction: Float[Tensor, "B D p"]) -> Float[Tensor, "B D"]: ...

    def chebyshev(self) -> tuple[Float[Tensor, "B p"], Float[Tensor, "B"]]: ...

    def nearest(
        self, point: Float[Tensor, "B p"], metric: Float[Tensor, "B p p"] | None = None
    ) -> Float[Tensor, "B p"]:
        """The point of each body nearest to `point` in the norm sqrt(z' metric z); `metric` is positive definite."""
        ...
