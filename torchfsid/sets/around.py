"""Half-spaces moved outward until they hold other sets."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.halfspaces import Halfspaces, array, dot
from torchfsid.kernels import around as kernel
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.tolerances import ROUND_OFF


def reach(rows: Halfspaces, sets: FeasibleSet) -> Float[Tensor, "B m"]:
    """The support functions h(n) = max n.theta over the sets (B,) for the normals n of rows (B, m), rounded up.

    It is -inf for an EMPTY set. Gradients are those of one farthest vertex.
    """
    sizes = dot(rows.A.detach().abs(), sets.body.reach.unsqueeze(-2)) + rows.b.detach().abs()
    return torch.where(sets.is_empty.unsqueeze(-1), -torch.inf, sets.body.support(rows.A) + ROUND_OFF * sizes)


def moved_around(rows: Halfspaces, sets: FeasibleSet) -> Halfspaces:
    """The rows n.theta <= max(b, h(n)), see `reach`. In the plane, where no gradient is needed, they are compiled."""
    body = sets.body
    differentiable = torch.is_grad_enabled() and (rows.A.requires_grad or rows.b.requires_grad or body.sheets.sheets)
    if rows.dim != 2 or differentiable:
        return Halfspaces(rows.A, torch.maximum(rows.b, reach(rows, sets)), rows.source)
    arrays = map(array, (body.corners, body.count, body.reach, rows.A, rows.b))
    b = torch.from_numpy(kernel.moved_around(*arrays)).to(rows.b.device)
    b = torch.where(sets.is_empty.unsqueeze(-1), rows.b, b) if sets.any_empty else b
    return Halfspaces(rows.A, b, rows.source)
