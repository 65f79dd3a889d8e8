r"""Outward normals of a cone of rows: w is in cone{a_j : j present} iff n.w <= 0 for all of them.

In the plane the generators are sorted by angle. If there is an angular gap of at least 180 degrees, the polar cone
opens in it, from one end + 90 degrees to the other - 90. Otherwise the cone is the whole plane.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.tolerances import ANGLE_TOLERANCE


class OutwardNormals(NamedTuple):
    """Outward normals of a cone.

    Attributes:
        normals: unit vectors, zero where not needed.
        generator: the generator nearest to each; m for none.
        opening: by how much the widest angle without generators exceeds 180 degrees [rad]; 2 pi without generators. If
            it is positive, the cone contains no line: no positive combination of its generators is zero. Else it is 0.
    """

    normals: Float[Tensor, "*batch k 2"]
    generator: Int[Tensor, "*batch k"]
    opening: Float[Tensor, "*batch"]


def outward_normals(
    generators: Float[Tensor, "*batch m 2"], present: Bool[Tensor, "*batch m"], fan: int
) -> OutwardNormals:
    """Outward normals of cone{a_j : j present} in the plane: w is in the cone iff n.w <= 0 for all of them.

    Up to `fan` normals are spread evenly over the polar cone, both ends included. The two ends suffice for a pointed
    cone. A ray needs a cap as well. More normals round off the corners of a widened cone. One additional normal is for
    a line, so k = fan + 1. Without generators the cone is the origin, and the fan is a full turn.

    Raises:
        InputError: the generators are not planar, or `fan` < 3.
    """
    if generators.shape[-1] != 2:
        raise InputError("generators", "planar controls, (*batch, m, 2)", tuple(generators.shape))
    if fan < 3:
        raise InputError("fan", "at least 3 normals (two ends and a cap)", fan)
    m, shape = generators.shape[-2], present.shape[:-1]
    if m == 0:  # a generator that is never present
        generators, present = generators.new_zeros(*shape, 1, 2), present.new_zeros(*shape, 1)
    generators = generators.expand(*shape, max(m, 1), 2)
    gaps = _gaps(generators.detach(), present)

    # The rows at the ends of the gaps were found without gradients. Their normals are computed with gradients.
    ends = generators.gather(-2, gaps.ends.unsqueeze(-1).expand(*shape, 3, 2))
    none = ~gaps.some
    ends = ends.masked_fill(none.unsqueeze(-1), 1.0)
    first, last, second = torch.atan2(ends[..., 1], ends[..., 0]).unsqueeze(-1).unbind(-2)
    opening = (last - first + (gaps.turns - math.pi)).masked_fill(none, 2 * math.pi)
    start = (first + math.pi / 2).masked_fill(none, 0.0)
    step = torch.linspace(0.0, 1.0, fan, dtype=generators.dtype, device=generators.device)
    angles = torch.cat([start + step * opening.clamp(min=0), second + math.pi / 2], dim=-1)
    normals = torch.stack([angles.cos(), angles.sin()], dim=-1)

    inner = torch.where(gaps.some, gaps.is_wide | (gaps.is_open & (step == 0)), step < 1)
    needed = torch.cat([inner, gaps.is_line], dim=-1)
    from_first, from_last, from_second = gaps.ends.unsqueeze(-1).unbind(-2)
    near = torch.cat([torch.where(step < 0.5, from_first, from_last), from_second], dim=-1)
    opening = opening.detach().masked_fill(~(none | gaps.is_wide), 0.0).squeeze(-1)
    return OutwardNormals(normals.masked_fill(~needed.unsqueeze(-1), 0.0), near.masked_fill(none, m), opening)


class _Gaps(NamedTuple):
    """The widest angular gap between generators, and the second widest.

    Attributes:
        ends: the generators where the widest gap begins and ends, and the one where the second begins.
        turns: 2 pi where the widest gap contains the angle pi, at which angles wrap; 0 elsewhere.
        some: whether there are generators.
        is_open: whether the widest gap is at least 180 degrees.
        is_wide: whether the widest gap is more than 180 degrees.
        is_line: whether both gaps are 180 degrees.
    """

    ends: Int[Tensor, "*batch 3"]
    turns: Float[Tensor, "*batch 1"]
    some: Bool[Tensor, "*batch 1"]
    is_open: Bool[Tensor, "*batch 1"]
    is_wide: Bool[Tensor, "*batch 1"]
    is_line: Bool[Tensor, "*batch 1"]


@torch.no_grad()
def _gaps(generators: Float[Tensor, "*batch m 2"], present: Bool[Tensor, "*batch m"]) -> _Gaps:
    count = present.sum(-1, keepdim=True)
    angles = torch.atan2(generators[..., 1], generators[..., 0])
    angles, order = angles.masked_fill(~present, math.inf).sort(-1)
    slot = torch.arange(angles.shape[-1], device=angles.device)
    following = torch.where(slot == count - 1, angles[..., :1] + 2 * math.pi, angles.roll(-1, -1))
    gaps = torch.where(slot < count, following - angles, -math.inf)
    widest = gaps.argmax(-1, keepdim=True)
    opening = gaps.gather(-1, widest) - math.pi
    others = gaps.scatter(-1, widest, -math.inf)
    second = others.argmax(-1, keepdim=True)
    wraps = widest >= count - 1
    places = torch.cat([widest, torch.where(wraps, 0, widest + 1), second], dim=-1)
    return _Gaps(
        order.gather(-1, places),
        2 * math.pi * wraps.to(generators.dtype),
        count > 0,
        opening >= -ANGLE_TOLERANCE,
        opening > ANGLE_TOLERANCE,
        others.gather(-1, second) >= math.pi - ANGLE_TOLERANCE,
    )
