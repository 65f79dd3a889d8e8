r"""Outward normals of a cone of rows: w is in cone{a_j : j present} iff n.w <= 0 for all of them.

In the plane the generators are sorted by angle. If there is an angular gap of at least 180 degrees, the polar cone
opens in it, from one end + 90 degrees to the other - 90. Otherwise the cone is the whole plane.

In space the polar cone {n : n.a_j <= 0} is found by its edges and by projections d -> n of a fan of fixed directions.
By Moreau's theorem n is the projection of d exactly if n is polar, d - n is in the cone, and n.(d - n) = 0. So

    n = d                      if d is polar, the inside of the polar cone
    n = d - (d.a_j) a_j        if that is polar and d.a_j > 0, its sides
    n = +-a_i x a_j            if that is polar, its edges

No other case matters: d is then projected on an edge, or on the origin. Each n is tested, so whatever round-off makes
of it, the cone described is an outer one. It is the cone itself, whatever the rank of the generators. If the polar cone
contains no line, its edges alone describe it. A plane or a half-plane in the polar cone is spanned by projections,
because every quarter of a space holds a ball of 45 degrees, and every direction is within 37.4 of the fan.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import dot
from torchfsid.kernels.cones import EDGES, FAN, NARROW, SAME_EDGE
from torchfsid.tolerances import ANGLE_TOLERANCE, PARALLEL_ROWS


class OutwardNormals(NamedTuple):
    """Outward normals of a cone.

    Attributes:
        normals: unit vectors, zero where not needed.
        generator: a generator near each; m for none.
        opening: by how much the widest angle without generators exceeds 180 degrees [rad]; 2 pi without generators. If
            it is positive, the cone contains no line: no positive combination of its generators is zero. Else it is 0.
            In space, the opening of a circular cone inside the polar cone.
    """

    normals: Float[Tensor, "*batch k n"]
    generator: Int[Tensor, "*batch k"]
    opening: Float[Tensor, "*batch"]


def outward_normals(
    generators: Float[Tensor, "*batch m n"], present: Bool[Tensor, "*batch m"], fan: int
) -> OutwardNormals:
    """Outward normals of cone{a_j : j present}: w is in the cone iff n.w <= 0 for all of them.

    In the plane up to `fan` normals are spread evenly over the polar cone, both ends included. The two ends suffice for
    a pointed cone. A ray needs a cap as well. More normals round off the corners of a widened cone. One additional
    normal is for a line, so k = fan + 1. Without generators the cone is the origin, and the fan is a full turn.

    In space the generators are unit vectors, and `fan` is not used: up to 12 normals are projections of fixed
    directions, the others are the edges of the polar cone, k is as large as the batch needs.

    Raises:
        InputError: the generators are neither in the plane nor in space, or `fan` < 3.
    """
    if generators.shape[-1] not in (2, 3):
        raise InputError(
            "generators", "controls in the plane or in space, (*batch, m, 2 or 3)", tuple(generators.shape)
        )
    if fan < 3:
        raise InputError("fan", "at least 3 normals (two ends and a cap)", fan)
    m, shape, n = generators.shape[-2], present.shape[:-1], generators.shape[-1]
    if m == 0:  # a generator that is never present
        generators, present = generators.new_zeros(*shape, 1, n), present.new_zeros(*shape, 1)
    generators = generators.expand(*shape, max(m, 1), n)
    return _in_space(generators, present, m) if n == 3 else _in_the_plane(generators, present, fan, m)


def _in_the_plane(
    generators: Float[Tensor, "*batch g 2"], present: Bool[Tensor, "*batch g"], fan: int, m: int
) -> OutwardNormals:
    shape = present.shape[:-1]
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


def _in_space(generators: Float[Tensor, "*batch g 3"], present: Bool[Tensor, "*batch g"], m: int) -> OutwardNormals:
    count = present.sum(-1)
    order = (
        (~present).to(torch.int8).argsort(dim=-1, stable=True)[..., : max(int(count.max()) if count.numel() else 0, 1)]
    )
    there = present.gather(-1, order)
    a = _taken(generators, order).masked_fill(~there.unsqueeze(-1), 0.0)
    fan = torch.from_numpy(FAN).to(a)
    with torch.no_grad():
        inner, owner = _faces(fan, a)
        first, second, sign = _edges(a)
    onto = _taken(a, owner.clamp(min=0))
    sides = fan - dot(fan.expand_as(onto), onto).unsqueeze(-1) * onto * (owner >= 0).unsqueeze(-1)
    of_first = _taken(a, first)
    edges = sign.unsqueeze(-1) * torch.linalg.cross(of_first, _taken(a, second), dim=-1)
    is_edge = sign != 0
    edges = torch.where(is_edge.unsqueeze(-1), edges, 1.0)
    edges = edges / edges.norm(dim=-1, keepdim=True)
    edges = edges - dot(edges, of_first).unsqueeze(-1) * of_first
    needed = torch.cat([inner | (owner >= 0), is_edge], dim=-1)
    normals = torch.cat([torch.where(needed[..., : len(FAN), None], sides, 1.0), edges], dim=-2)
    normals = (normals / normals.norm(dim=-1, keepdim=True)).masked_fill(~needed.unsqueeze(-1), 0.0)

    nearest = (fan @ a.detach().mT).masked_fill(~there.unsqueeze(-2), -math.inf).argmax(-1)
    near = order.gather(-1, torch.cat([torch.where(owner >= 0, owner, nearest), first], dim=-1))
    none = count.unsqueeze(-1) == 0
    return OutwardNormals(normals, near.masked_fill(none, m), _opening(normals.detach(), a.detach(), none.squeeze(-1)))


def _faces(
    fan: Float[Tensor, "d 3"], a: Float[Tensor, "*batch g 3"]
) -> tuple[Bool[Tensor, "*batch d"], Int[Tensor, "*batch d"]]:
    """Whether each direction is polar, and otherwise the generator along which it is projected on a side, or -1."""
    along, gram = fan @ a.mT, a @ a.mT
    inner = (along <= ANGLE_TOLERANCE).all(-1)
    size = (1 - along.square()).clamp(min=0.0).sqrt()
    left = along.unsqueeze(-2) - along.unsqueeze(-1) * gram.unsqueeze(-3)
    polar = (left <= ANGLE_TOLERANCE * size.unsqueeze(-1)).all(-1)
    onto = polar & (along > ANGLE_TOLERANCE) & (size > NARROW)
    return inner, torch.where(onto.any(-1), onto.to(torch.int8).argmax(-1), -1)


def _edges(
    a: Float[Tensor, "*batch g 3"],
) -> tuple[Int[Tensor, "*batch e"], Int[Tensor, "*batch e"], Float[Tensor, "*batch e"]]:
    """The edges sign a_i x a_j of the polar cone as (i, j, sign), each once. The sign is 0 where there are no more."""
    shape = a.shape[:-2]
    i, j = torch.triu_indices(a.shape[-2], a.shape[-2], 1, device=a.device)
    n = torch.linalg.cross(a[..., i, :], a[..., j, :], dim=-1)
    size = n.norm(dim=-1, keepdim=True)
    n = n / torch.where(size > 0, size, 1.0)
    n = n - dot(n, a[..., i, :]).unsqueeze(-1) * a[..., i, :]
    along = n @ a.mT
    polar = [(side <= ANGLE_TOLERANCE).all(-1) & (size.squeeze(-1) > PARALLEL_ROWS) for side in (along, -along)]
    both = torch.stack(polar, dim=-1).flatten(-2)  # in the order i, j, sign
    n = torch.stack([n, -n], dim=-2).flatten(-3, -2)
    most = int(both.sum(-1).max()) if both.numel() else 0
    found = (~both).to(torch.int8).argsort(dim=-1, stable=True)[..., :most]
    is_edge, n = both.gather(-1, found), _taken(n, found)
    same = ((n.unsqueeze(-2) - n.unsqueeze(-3)).square().sum(-1) < SAME_EDGE**2) & is_edge.unsqueeze(-2)
    is_edge = is_edge & ~same.tril(-1).any(-1)
    most = min(int(is_edge.sum(-1).max()), EDGES) if is_edge.numel() else 0
    kept = (~is_edge).to(torch.int8).argsort(dim=-1, stable=True)[..., :most]
    found, is_edge = found.gather(-1, kept), is_edge.gather(-1, kept)
    pair = found // 2
    sign = torch.where(is_edge, 1.0 - 2.0 * (found % 2), 0.0).to(a.dtype)
    return i.expand(*shape, -1).gather(-1, pair), j.expand(*shape, -1).gather(-1, pair), sign


def _opening(normals: Tensor, a: Tensor, none: Tensor) -> Float[Tensor, "*batch"]:
    """Twice the angle by which the mean normal keeps clear of the planes across the generators."""
    middle = normals.sum(-2)
    size = middle.norm(dim=-1, keepdim=True)
    middle = middle / torch.where(size > ANGLE_TOLERANCE, size, 1.0)
    clear = -dot(middle.unsqueeze(-2), a).masked_fill((a == 0).all(-1), -math.inf).amax(-1)
    opening = 2 * clear.clamp(0.0, 1.0).arcsin()
    return torch.where(none, 2 * math.pi, torch.where(opening > ANGLE_TOLERANCE, opening, 0.0))


def _taken(vectors: Float[Tensor, "*batch g 3"], places: Int[Tensor, "*batch k"]) -> Float[Tensor, "*batch k 3"]:
    return vectors.gather(-2, places.unsqueeze(-1).expand(*places.shape, 3))
