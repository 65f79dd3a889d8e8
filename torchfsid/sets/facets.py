"""The rows that form a set, with where they came from, and the answer to whether a set is empty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.sets.body import PRIOR


class Facets(NamedTuple):
    """Rows A z <= b of a set, with the time [s] and the constraint (`source`) of each. The prior has NaN and -1."""

    halfspaces: Halfspaces
    time: Float[Tensor, "*batch f"]
    source: Int[Tensor, "*batch f"]

    @classmethod
    def of(cls, parts: Sequence[Tensor], batch: torch.Size) -> Facets:
        """The facets with these A, b, time and source, whose batch is flattened."""
        A, b, time, source = (part.reshape(*batch, *part.shape[1:]) for part in parts)
        return cls(Halfspaces(A, b), time, source)

    @classmethod
    def none(cls, batch: torch.Size, p: int, like: Tensor) -> Facets:
        """p + 1 rows over R^p that are missing: NaN."""
        nothing = like.detach().new_full((*batch, p + 1), torch.nan)
        rows = nothing.unsqueeze(-1).expand(*batch, p + 1, p)
        return cls(Halfspaces(rows, nothing), nothing, torch.full_like(nothing, PRIOR).long())

    @classmethod
    def joined(cls, several: Sequence[Facets]) -> Facets:
        """Those of several batches, one after the other."""
        A, b, time, source = (torch.cat(parts) for parts in zip(*(facets.parts for facets in several), strict=True))
        return cls(Halfspaces(A, b), time, source)

    def where(self, mask: Bool[Tensor, "*batch"], other: Facets) -> Facets:
        """These rows where `mask`, the `other` ones elsewhere. Both have the same number."""
        rows = mask.unsqueeze(-1)
        return Facets(
            Halfspaces(
                torch.where(rows.unsqueeze(-1), self.halfspaces.A, other.halfspaces.A),
                torch.where(rows, self.halfspaces.b, other.halfspaces.b),
            ),
            torch.where(rows, self.time, other.time),
            torch.where(rows, self.source, other.source),
        )

    def at(self, places: Int[Tensor, "*places"], batch: int) -> Facets:
        """The rows at these places of the batch, whose dimensions, `batch` in number, are flattened."""
        A, b, time, source = (part.flatten(0, batch - 1) if batch else part.unsqueeze(0) for part in self.parts)
        return Facets(Halfspaces(A[places], b[places]), time[places], source[places])

    @property
    def known(self) -> Halfspaces:
        """The rows, with padding in place of those that are NaN."""
        A, b = self.halfspaces.A, self.halfspaces.b
        return self.halfspaces.where(~(A.isnan().any(-1) | b.isnan()))

    @property
    def parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """A, b, time and source."""
        return self.halfspaces.A, self.halfspaces.b, self.time, self.source


class Emptiness(NamedTuple):
    """Whether a set is empty, with a proof.

    Attributes:
        outcome: a `Status` per item. UNDECIDED means that a half-space touches the others within round-off. The set
            is what they leave after that half-space is moved outward by its round-off.
        witness: a point inside. NaN unless OK.
        contradiction: the rows that contradict each other. NaN unless EMPTY.
    """

    outcome: Int[Tensor, "*batch"]
    witness: Float[Tensor, "*batch p"]
    contradiction: Facets
