"""What every batch of sets answers, planar or not: a `Polygon` in the plane, a `Polytope` elsewhere."""

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
    """Up to p + 1 rows per item that no point satisfies together (Helly), without gradients; NaN where there is none.

    With some y >= 0, y'A = 0 and y'b < 0 by more than round-off.
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


@dataclass(frozen=True)
class Clipped:
    """Bodies after a clip.

    Attributes:
        body: the intersection; where it is empty, the body as it was.
        outcome: an `Outcome` per item.
        shrunk: the item was really cut.
        contradiction: for empty items, the rows that contradict each other.
    """

    body: Any
    outcome: Int[Tensor, "B"]
    shrunk: Bool[Tensor, "B"]
    contradiction: Contradiction


class Body(Protocol):
    """A batch of bounded convex sets {z : A z <= b} in R^p, without redundant rows.

    Attributes:
        A, b: the facets' rows, padded with 0.z <= 1.
        count: how many of them are real.
        time, source: when and from which constraint each facet came; NaN and `PRIOR` for those it began with.
    """

    A: Float[Tensor, "B F p"]
    b: Float[Tensor, "B F"]
    time: Float[Tensor, "B F"]
    source: Int[Tensor, "B F"]
    count: Int[Tensor, "B"]

    @property
    def reach(self) -> Float[Tensor, "B p"]:
        """The largest |coordinates| that the sets ever had, for round-off is inherited."""
        ...

    @property
    def vertices(self) -> Float[Tensor, "B V p"]:
        """The vertices, padded by repeating the first one."""
        ...

    def rows(self) -> tuple[Float[Tensor, "B F p"], Float[Tensor, "B F"]]:
        """A and b with the gradients of the rows that they are."""
        ...

    def select(self, items: Int[Tensor, "k"]) -> Body:
        """The sub-batch at `items`."""
        ...

    def replaced(self, items: Int[Tensor, "k"], other: Any) -> Body:
        """This batch with `other` in the places `items`."""
        ...

    def clip(
        self,
        A: Float[Tensor, "B R p"],
        b: Float[Tensor, "B R"],
        time: Float[Tensor, "B"],
        source: Int[Tensor, "B R"],
        most: int,
    ) -> Clipped:
        """Intersect every body with its R half-spaces A z <= b, stamping new facets with `time` and `source`.

        A row that only touches a body within round-off is moved outward by that round-off and then applied. A body left
        with more than `most` facets is merged outward; where that costs more than the cut has gained, it stays as it
        was.
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
        """The point of each body nearest to `point`; `metric` is symmetric and positive definite."""
        ...
