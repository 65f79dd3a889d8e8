"""The given rows whose gradients the facets of a set carry. They are kept as long as a facet of the set needs them.

A search works on numbers without gradients. The rows that have become facets are kept beside it, with gradients, in
sheets, one for each intersection. Every facet has a label: the place of its row among all sheets, or 0 if it has no
gradient. A sheet that no facet refers to is dropped with the autograd graph of its intersection. So memory is
proportional to the number of facets.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchfsid.halfspaces import Halfspaces, array


@dataclass(frozen=True)
class Sheets:
    """Rows A (N, p) and b (N,) with gradients, sheet by sheet. The first row of the first sheet has the label 1.

    Attributes:
        sheets: A and b of each sheet.
        rows: the number of rows in all sheets.
    """

    sheets: tuple[tuple[Tensor, Tensor], ...] = ()
    rows: int = 0

    def with_sheet(self, A: Float[Tensor, "N p"], b: Float[Tensor, "N"]) -> Sheets:
        """These sheets and one more. The labels of its rows continue those of the last sheet."""
        return Sheets((*self.sheets, (A, b)), self.rows + len(b)) if len(b) > 0 else self

    def in_use(self, label: Int[Tensor, "B F"]) -> tuple[Sheets, Int[Tensor, "B F"]]:
        """The sheets without the rows that are no facets, and the new labels of the facets.

        It is done only if there are more than twice as many rows as places for facets. A sheet is shortened only if
        more than half of it is unused. So it costs little, and a row passes through few tensors.
        """
        if self.rows <= 2 * label.numel():
            return self, label
        table = array(label)
        used, numbers = np.zeros(self.rows + 1, dtype=np.bool_), np.zeros(self.rows + 1, dtype=np.int64)
        used[table] = True
        sheets, old, new = [], 1, 1
        for A, b in self.sheets:
            kept = used[old : old + len(b)].nonzero()[0]
            if 2 * len(kept) >= len(b):
                kept = np.arange(len(b))
                sheets.append((A, b))
            elif len(kept) > 0:
                rows = torch.from_numpy(kept).to(b.device)
                sheets.append((A.index_select(0, rows), b.index_select(0, rows)))
            numbers[old + kept] = np.arange(new, new + len(kept))
            old, new = old + len(b), new + len(kept)
        return Sheets(tuple(sheets), new - 1), torch.from_numpy(numbers[table]).to(label.device)

    def joined(self, other: Sheets, label: Int[Tensor, "B F"]) -> tuple[Sheets, Int[Tensor, "B F"]]:
        """These sheets and those of `other`, and the new labels of `other`. A sheet of both is kept once."""
        new = [sheet for sheet in other.sheets if not any(sheet is mine for mine in self.sheets)]
        sheets, first, next_label = (*self.sheets, *new), {}, 1
        for sheet in sheets:
            first[id(sheet)] = next_label
            next_label += len(sheet[1])
        numbers = [
            torch.arange(first[id(sheet)], first[id(sheet)] + len(sheet[1]), device=label.device)
            for sheet in other.sheets
        ]
        return Sheets(sheets, next_label - 1), torch.cat([label.new_zeros(1), *numbers])[label]

    def attached(
        self, A: Float[Tensor, "B F p"], b: Float[Tensor, "B F"], label: Int[Tensor, "B F"]
    ) -> tuple[Float[Tensor, "B F p"], Float[Tensor, "B F"]]:
        """The facets' rows A and b, with the gradients of the rows that their labels refer to."""
        if not self.sheets:
            return A, b
        # A facet that was moved outward keeps its moved b.
        return _Attached.apply(A, b, label, *(part for sheet in self.sheets for part in sheet))  # type: ignore[return-value]


class _Attached(torch.autograd.Function):
    """(A, b, label, A and b of each sheet) -> A and b, as if each facet were the row of its label."""

    @staticmethod
    def forward(ctx: Any, A: Tensor, b: Tensor, label: Tensor, *sheets: Tensor) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(label)
        ctx.lengths = [len(b) for b in sheets[1::2]]
        return A.clone(), b.clone()

    @staticmethod
    def backward(ctx: Any, grad_A: Tensor, grad_b: Tensor) -> tuple[Tensor | None, ...]:
        label, lengths = ctx.saved_tensors[0].flatten(), [1, *ctx.lengths]
        parts = (
            part.new_zeros(sum(lengths), *part.shape[2:]).index_add(0, label, part.reshape(len(label), *part.shape[2:]))
            for part in (grad_A, grad_b)
        )
        pairs = zip(*(part.split(lengths)[1:] for part in parts), strict=True)
        return None, None, None, *(grad for pair in pairs for grad in pair)


def carried(sets: Any, facets: tuple[Int[Tensor, "N"], Int[Tensor, "N"]], rows: Halfspaces) -> Any:
    """A batch (B,) of sets without gradients, some of whose facets carry the gradients of the rows they came from.

    So rows that were found without gradients are computed again with gradients only where they have become facets.

    Args:
        sets: the sets.
        facets: these facets, as item and slot.
        rows: batch (N,): for each of them several rows, one of which is its own in numbers.
    """
    body = sets.body
    with torch.no_grad():
        apart = (rows.A - body.A[facets].unsqueeze(1)).square().sum(-1) + (
            rows.b - body.b[facets].unsqueeze(1)
        ).square()
        own = torch.arange(len(apart), device=apart.device), apart.argmin(-1)
    label = torch.zeros_like(body.label)
    label[facets] = own[0] + 1
    return replace(sets, body=replace(body, label=label, sheets=Sheets().with_sheet(rows.A[own], rows.b[own])))
