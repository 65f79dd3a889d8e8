"""Largest ball and nearest point of sets {z : A z <= b} in any dimension, asked with a point of each set as the origin.

The round-off is then proportional to the size of a set, not to its distance from the origin.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.outcome import Status
from torchfsid.programmes.differentiable import inscribed_ball, nearest_point, times
from torchfsid.tolerances import FLAT, ROUND_OFF


def chebyshev(
    A: Float[Tensor, "B F p"], b: Float[Tensor, "B F"], middle: Float[Tensor, "B p"], reach: Float[Tensor, "B p"]
) -> tuple[Float[Tensor, "B p"], Float[Tensor, "B"]]:
    """Centre and radius of a largest inscribed ball: max r s.t. A_f.z + |A_f| r <= b_f.

    Where the centre is not unique, the one with the smallest z_1 is returned, among these the one with the smallest
    z_2, and so on. Its gradient is that of the p + 1 facets that decide this choice. The radius and its gradient are
    right in any case. A flat set has the radius 0, and its centre is a point of the set. Where no ball could be
    verified as a largest one, it is the largest about a point of the set.

    Args:
        A: the facets' rows.
        b: their right-hand sides.
        middle: a point of each set, without gradients.
        reach: the largest |coordinates| that each set ever had.
    """
    rows = Halfspaces(A, b - times(A, middle))
    centre, radius, status = inscribed_ball(rows)
    # The rows of a set as small as round-off need not bound it.
    flat, lost = radius <= FLAT * reach.amax(-1), (status == Status.UNSOLVED) | (status == Status.UNBOUNDED)
    if bool(lost.any()):
        radius = torch.where(lost, rows.slack(torch.zeros_like(centre)).amin(-1).clamp(min=0.0), radius)
    centre = middle + torch.where((flat | lost).unsqueeze(-1), 0.0, centre)
    return centre, torch.where(flat, 0.0, radius)


def nearest(
    A: Float[Tensor, "B F p"],
    b: Float[Tensor, "B F"],
    middle: Float[Tensor, "B p"],
    reach: Float[Tensor, "B p"],
    point: Float[Tensor, "B p"],
    metric: Float[Tensor, "B p p"] | None,
) -> Float[Tensor, "B p"]:
    """The point of each set nearest to `point` in the norm sqrt(z' metric z) (default: Euclidean).

    The result is NaN where `point` or `metric` is not finite, or `metric` is not positive definite. See `chebyshev` for
    the other arguments.
    """
    rows, point = Halfspaces(A, b - times(A, middle)), point - middle
    found = nearest_point(rows, point, metric)
    lost = found.status == Status.EMPTY
    if bool(lost.any()):  # lost to the round-off of the middle, as in a flat set
        round_off = ROUND_OFF * (times(A.detach().abs(), reach) + b.detach().abs())
        wider = rows.b + torch.where(lost.unsqueeze(-1), 2 * round_off, 0.0)
        found = nearest_point(Halfspaces(A, wider), point, metric)
    return middle + found.point
