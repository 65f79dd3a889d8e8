"""Which rows a measured control touches (G., Eqs. (11), (12), (17)).

slack   s_j = (b_j - a_j.u)/|a_j|   [m/s], the distance of u to the boundary of row j, for any scale of the row
active  |s_j| < tolerance
"""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.tolerances import ACTIVE_TOLERANCE


def active_set(
    safe_controls: Halfspaces, u: Float[Tensor, "*batch n"], tolerance: float = ACTIVE_TOLERANCE
) -> Bool[Tensor, "*batch m"]:
    """The observed active set: rows whose boundary is closer to `u` than `tolerance` [m/s]. Padding is never active.

    Raises:
        InputError: `tolerance` is not positive, or `u` has another dimension than the rows.
    """
    if not tolerance > 0:
        raise InputError("tolerance", "a positive speed [m/s]", tolerance)
    if u.shape[-1] != safe_controls.dim:
        raise InputError("u", f"(*batch, {safe_controls.dim})", tuple(u.shape))
    return touched(safe_controls, safe_controls.slack(u), tolerance)


def touched(rows: Halfspaces, slack: Float[Tensor, "*batch m"], tolerance: float) -> Bool[Tensor, "*batch m"]:
    """The rows that are active, given their slacks [m/s]."""
    return (slack.abs() < tolerance) & (rows.A != 0).any(-1)
