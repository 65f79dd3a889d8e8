r"""Half-spaces of the unclipped nominal control y, given half-spaces of the clipped one.

    uhat = clip(y),   y = C theta + d          clipped by norm, |uhat| <= v, or by axis, |uhat_i| <= v_i; zero in a dead
    zone

Treating a clipped control as linear may lose the truth. Let Q be the set in which uhat must lie (the measured control,
plus the cone of the rows that may be active, plus the bounds), and P the part of Q within the limit. If uhat is inside
the limit, y = uhat. If uhat is on the limit, y lies further out, in a direction of saturation. The closed convex hull
of these y is

    P (+) Cn,      Cn = the cone of the directions in which P touches the limit,

that is n.y <= h_P(n), h_P the support function, for the normals n in the polar cone of Cn. These are the normals of Q
that are polar, and the ends of the polar cone. Theta sharpens the set. If no possible theta is clipped, or Q does not
touch the limit, y = uhat, and the half-spaces are those of Q. If all of them are clipped by norm, uhat is on the limit,
and P is only the arcs in which Q meets the circle. One more normal, between the ends, stands for their chord.
In a dead zone |y| <= w the control is zero. If Q contains zero, the ball of radius w joins the hull. Every
approximation gives an outer set. In space the same holds for a box. Of a sphere, Cn and h_P are bounded by the corners
of Q within the box around it. Compiled code does the same (`kernels.saturation`, for planar theta, and
`kernels.saturation_in_space`).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.halfspaces import Halfspaces, lengths
from torchfsid.identification.normals import outward_normals
from torchfsid.kernels.cones import FAN
from torchfsid.kernels.saturation import AROUND
from torchfsid.outcome import Status
from torchfsid.robots.tasks import Saturation
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.sets.polygon import Polygon
from torchfsid.tolerances import ANGLE_TOLERANCE, CRITICAL_NORMALS, ON_LIMIT

LEAST_LIMIT = 1e-9
"""Half a side of the smallest box in which admissible controls in space are looked for, in their units."""


def unclipped(
    admissible: Halfspaces,
    saturation: Saturation,
    possible: Float[Tensor, "*batch v n"],
    margin: Float[Tensor, "*#batch"],
    no_row: int = -1,
) -> Halfspaces:
    """An outer set of y, given half-spaces that hold uhat = clip(y).

    Args:
        admissible: Q, unit rows over uhat, padded.
        saturation: how y is clipped.
        possible: points whose convex hull holds every possible y, namely C theta + d at the vertices of Theta [m/s].
        margin: the largest distance of y from that hull [m/s].
        no_row: the source of half-spaces that repeat no row of Q.

    Returns:
        Half-spaces of y. `source` is that of the row of Q that a half-space repeats.
    """
    shape, n, m = admissible.batch_shape, admissible.dim, admissible.rows
    flat = Halfspaces(admissible.A.reshape(-1, m, n), admissible.b.reshape(-1, m))
    wishes = possible.expand(*shape, *possible.shape[-2:]).reshape(-1, *possible.shape[-2:])
    rows = _unclipped(flat, saturation, wishes, margin.expand(shape).reshape(-1))
    source = None
    if admissible.source is not None:
        source = admissible.source.new_full((*shape, rows.rows), no_row)
        source[..., -m - 1 : -1] = admissible.source
    return Halfspaces(rows.A.reshape(*shape, *rows.A.shape[1:]), rows.b.reshape(*shape, rows.rows), source)


class _Contact(NamedTuple):
    """Where the admissible controls touch the limit.

    Attributes:
        limits: the limits, or finite ones in place of limits that no possible y reaches.
        vertices: points whose hull, with what touches the limit, holds P.
        within: a mask of those that exist.
        outward: directions whose cone holds Cn.
        touched: a mask of those that exist.
        can_clip: whether some possible y is beyond the limit: of a norm, or of each face of a box.
        may_touch: whether P may touch the limit.
        around: directions in which the distance of the possible y from the origin is measured.
    """

    limits: Float[Tensor, "B n"]
    vertices: Float[Tensor, "B v n"]
    within: Bool[Tensor, "B v"]
    outward: Float[Tensor, "B g n"]
    touched: Bool[Tensor, "B g"]
    can_clip: Bool[Tensor, "B f"]
    may_touch: Bool[Tensor, "B 1"]
    around: Float[Tensor, "*#B a n"]


def _unclipped(
    admissible: Halfspaces, saturation: Saturation, possible: Float[Tensor, "B v n"], margin: Float[Tensor, "B"]
) -> Halfspaces:
    own, b = admissible.A, admissible.b
    # A limit beyond every possible y is no limit, and may be replaced by any finite one.
    farthest = possible.norm(dim=-1).amax(-1, keepdim=True) + margin.unsqueeze(-1)
    limits = torch.minimum(b.new_tensor(saturation.limits), 2 * farthest.detach())
    find = _in_the_plane if admissible.dim == 2 else _in_space
    contact = find(admissible, saturation.shape == "norm", limits, farthest, possible, margin)
    limits, vertices, within, outward, touched, can_clip, may_touch, around = contact

    nearest = (around @ possible.mT).amin(-1).amax(-1, keepdim=True) - margin.unsqueeze(-1)
    dead = saturation.dead_speed
    idle = (b >= -ON_LIMIT * dead).all(-1, keepdim=True) & (nearest <= dead) & (dead > 0)
    impossible = can_clip.any(-1, keepdim=True) & ~may_touch & ~within.any(-1, keepdim=True)

    fan = outward_normals(outward, touched, CRITICAL_NORMALS).normals
    offsets = _support(fan, vertices, within)
    if saturation.shape == "norm":
        on_limit = limits[:, :1] * _support(fan, outward, touched)
        offsets = torch.where(nearest > limits[:, :1], on_limit, torch.maximum(on_limit, offsets))
    normals, offsets = torch.cat([fan, own], dim=1), torch.cat([offsets, b], dim=-1)
    offsets = torch.where(idle, offsets.clamp(min=dead), offsets)
    keep = torch.cat([may_touch.expand(-1, fan.shape[1]), _support(own, outward, touched) <= ANGLE_TOLERANCE], dim=-1)
    rows = Halfspaces(normals, offsets).where(keep & (normals != 0).any(-1) & ~impossible)
    return Halfspaces.stack([rows, Halfspaces(torch.zeros_like(own[:, :1]), torch.where(impossible, -1.0, 1.0))])


def _in_the_plane(
    admissible: Halfspaces, by_norm: bool, limits: Tensor, farthest: Tensor, possible: Tensor, margin: Tensor
) -> _Contact:
    own, b = admissible.A, admissible.b
    around = torch.from_numpy(AROUND).to(b.device)
    no_source = torch.zeros_like(b, dtype=torch.long)
    cut = Polygon.from_box(-limits, limits).clip(own, b, torch.zeros_like(b), no_source, admissible.rows + 4)
    vertices, within = cut.body.vertices, (cut.outcome != Status.EMPTY).unsqueeze(-1)
    if by_norm:
        outward, touched = _arcs(admissible, limits[:, :1], around)
        within = within & (vertices.detach().norm(dim=-1) <= limits[:, :1])
        can_clip = farthest > limits[:, :1]
    else:
        within = within.expand(-1, vertices.shape[1])
        outward, touched, can_clip = _touched_faces(vertices, within, limits, possible, margin)
    touched = touched & can_clip
    return _Contact(limits, vertices, within, outward, touched, can_clip, touched.any(-1, keepdim=True), around)


def _in_space(
    admissible: Halfspaces, by_norm: bool, limits: Tensor, farthest: Tensor, possible: Tensor, margin: Tensor
) -> _Contact:
    """The contact with a box as in the plane. Of a sphere, Cn is held by the cone of all of Q within the box around it.

    That is loose where Q is large, but tight where no row is active. h_P is at most the radius.
    """
    limits = limits.clamp(min=LEAST_LIMIT).detach()
    box = FeasibleSet.from_box(-limits, limits, max_facets=admissible.rows + 2 * admissible.dim)
    cut = box.intersect(Halfspaces(admissible.A, admissible.b))
    vertices = cut.vertices()
    exists = ~cut.is_empty.unsqueeze(-1) & vertices.detach().isfinite().all(-1)
    vertices = torch.where(exists.unsqueeze(-1), vertices, 1.0)
    mean = possible.detach().mean(-2, keepdim=True)
    around = torch.cat(
        [torch.from_numpy(FAN).to(mean).expand(len(mean), -1, -1), mean / lengths(mean).unsqueeze(-1)], 1
    )
    if by_norm:
        size, v = vertices.norm(dim=-1), limits[:, :1]
        can_clip = farthest > v
        may_touch = (exists & (size >= v * (1 - ON_LIMIT))).any(-1, keepdim=True) & can_clip
        touched = exists & (size > ON_LIMIT * v) & may_touch
        outward = vertices / torch.where(size > 0, size, 1.0).unsqueeze(-1)
        return _Contact(limits, vertices, exists, outward, touched, can_clip, may_touch, around)
    outward, touched, can_clip = _touched_faces(vertices, exists, limits, possible, margin)
    touched = touched & can_clip
    return _Contact(limits, vertices, exists, outward, touched, can_clip, touched.any(-1, keepdim=True), around)


def _touched_faces(
    vertices: Tensor, within: Tensor, limits: Tensor, possible: Tensor, margin: Tensor
) -> tuple[Float[Tensor, "B f n"], Bool[Tensor, "B f"], Bool[Tensor, "B f"]]:
    """The outward normals of the faces of a box, which of them P touches, and beyond which some possible y is."""
    n = limits.shape[-1]
    axes = torch.eye(n, dtype=limits.dtype, device=limits.device)
    outward, faces = torch.cat([axes, -axes]).expand(len(limits), 2 * n, n), limits.repeat(1, 2)
    touched = _support(outward, vertices, within) >= faces * (1 - ON_LIMIT)
    return outward, touched, (outward @ possible.mT).amax(-1) + margin.unsqueeze(-1) > faces


def _support(
    normals: Float[Tensor, "B k n"], points: Float[Tensor, "B v n"], are_points: Bool[Tensor, "B v"]
) -> Float[Tensor, "B k"]:
    """The support function of the hull of some points; -inf if there are none."""
    return (normals @ points.mT).masked_fill(~are_points.unsqueeze(1), -torch.inf).amax(-1)


def _arcs(
    admissible: Halfspaces, limit: Float[Tensor, "B 1"], around: Float[Tensor, "D 2"]
) -> tuple[Float[Tensor, "B G 2"], Bool[Tensor, "B G"]]:
    """Directions in which the circle of radius `limit` is admissible, and a mask of those that exist.

    They are the ends of the admissible arcs and all of `around` that lie in these arcs. So an arc of more than 180
    degrees is not taken for the gap between its ends.
    """
    angle = torch.atan2(admissible.A[..., 1], admissible.A[..., 0])
    half = (admissible.b / limit).clamp(-1, 1).arccos()
    ends = torch.cat([angle - half, angle + half], dim=-1)
    directions = torch.stack([ends.cos(), ends.sin()], dim=-1)
    directions = torch.cat([directions, around.expand(len(limit), -1, -1)], dim=1)
    over = limit.unsqueeze(-1) * (directions @ admissible.A.mT) - admissible.b.unsqueeze(1)
    return directions, (over <= ON_LIMIT * limit.unsqueeze(-1)).all(-1)
