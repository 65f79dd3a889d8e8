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
approximation gives an outer set. Compiled code does the same for planar theta (`kernels.saturation`).
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.normals import outward_normals
from torchfsid.kernels.saturation import AROUND
from torchfsid.outcome import Status
from torchfsid.robots.tasks import Saturation
from torchfsid.sets.polygon import Polygon
from torchfsid.tolerances import ANGLE_TOLERANCE, CRITICAL_NORMALS, ON_LIMIT


def unclipped(
    admissible: Halfspaces,
    saturation: Saturation,
    possible: Float[Tensor, "*batch v 2"],
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
    shape = admissible.batch_shape
    flat = Halfspaces(admissible.A.reshape(-1, admissible.rows, 2), admissible.b.reshape(-1, admissible.rows))
    wishes = possible.expand(*shape, *possible.shape[-2:]).reshape(-1, *possible.shape[-2:])
    rows = _unclipped(flat, saturation, wishes, margin.expand(shape).reshape(-1))
    source = None
    if admissible.source is not None:
        source = admissible.source.new_full((*shape, rows.rows), no_row)
        source[..., CRITICAL_NORMALS + 1 : -1] = admissible.source
    return Halfspaces(rows.A.reshape(*shape, *rows.A.shape[1:]), rows.b.reshape(*shape, rows.rows), source)


def _unclipped(
    admissible: Halfspaces, saturation: Saturation, possible: Float[Tensor, "B v 2"], margin: Float[Tensor, "B"]
) -> Halfspaces:
    own, b = admissible.A, admissible.b
    around = torch.from_numpy(AROUND).to(b.device)
    by_norm = saturation.shape == "norm"
    # A limit beyond every possible y is no limit, and may be replaced by any finite one.
    farthest = possible.norm(dim=-1).amax(-1, keepdim=True) + margin.unsqueeze(-1)
    limits = torch.minimum(b.new_tensor(saturation.limits), 2 * farthest.detach())
    no_source = torch.zeros_like(b, dtype=torch.long)
    cut = Polygon.from_box(-limits, limits).clip(own, b, torch.zeros_like(b), no_source, admissible.rows + 4)
    vertices, within = cut.body.vertices, (cut.outcome != Status.EMPTY).unsqueeze(-1)
    if by_norm:
        outward, touched = _arcs(admissible, limits[:, :1], around)
        within = within & (vertices.detach().norm(dim=-1) <= limits[:, :1])
        can_clip = farthest > limits[:, :1]
    else:
        axes = torch.eye(2, dtype=b.dtype, device=b.device)
        outward, faces = torch.cat([axes, -axes]).expand(len(b), 4, 2), limits.repeat(1, 2)
        within = within.expand(-1, vertices.shape[1])
        touched = _support(outward, vertices, within) >= faces * (1 - ON_LIMIT)
        can_clip = (outward @ possible.mT).amax(-1) + margin.unsqueeze(-1) > faces
    touched = touched & can_clip
    may_touch = touched.any(-1, keepdim=True)

    nearest = (around @ possible.mT).amin(-1).amax(-1, keepdim=True) - margin.unsqueeze(-1)
    dead = saturation.dead_speed
    idle = (b >= -ON_LIMIT * dead).all(-1, keepdim=True) & (nearest <= dead) & (dead > 0)
    impossible = can_clip.any(-1, keepdim=True) & ~may_touch & ~within.any(-1, keepdim=True)

    fan = outward_normals(outward, touched, CRITICAL_NORMALS).normals
    offsets = _support(fan, vertices, within)
    if by_norm:
        on_limit = limits[:, :1] * _support(fan, outward, touched)
        offsets = torch.where(nearest > limits[:, :1], on_limit, torch.maximum(on_limit, offsets))
    normals, offsets = torch.cat([fan, own], dim=1), torch.cat([offsets, b], dim=-1)
    offsets = torch.where(idle, offsets.clamp(min=dead), offsets)
    keep = torch.cat([may_touch.expand(-1, fan.shape[1]), _support(own, outward, touched) <= ANGLE_TOLERANCE], dim=-1)
    rows = Halfspaces(normals, offsets).where(keep & (normals != 0).any(-1) & ~impossible)
    return Halfspaces.stack([rows, Halfspaces(torch.zeros_like(own[:, :1]), torch.where(impossible, -1.0, 1.0))])


def _support(
    normals: Float[Tensor, "B k 2"], points: Float[Tensor, "B v 2"], are_points: Bool[Tensor, "B v"]
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
