r"""Half-spaces of the unclipped nominal control y, given half-spaces of the clipped one.

    uhat = clip(y),   y = C theta + d          clipped by norm, |uhat| <= v, or by axis, |uhat_i| <= v_i; zero in a dead
    zone

Treating a clipped control as linear may lose the truth. Let Q be the set in which uhat must lie (the measured control,
plus the cone of the rows that may be active, plus the bounds), and P the part of Q within the limit. If uhat is inside
the limit, y = uhat. If uhat is on the limit, y lies further out, in a direction of saturation. The closed convex hull
of these y is

    P (+) Cn,      Cn = the cone of the directions in which P touches the limit,

that is n.y <= h_P(n), h_P the support function, for the normals n in the polar cone of Cn. Without saturation Cn = {0}
and the hull is P. Theta sharpens the set. If no possible theta is clipped, Cn = {0}. If all of them are clipped by
norm, y lies in Cn itself, beyond the chord between the ends of the arc in which Q meets the circle. In a dead zone |y|
<= w the control is zero. If Q contains zero, the ball of radius w joins the hull. Every approximation gives an outer
set.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.kkt import outward_normals
from torchfsid.outcome import Outcome
from torchfsid.robots.tasks import Saturation
from torchfsid.sets.polygon import Polygon

DIRECTIONS = 32
"""Directions in which a circle is sampled, and tangents that stand for it: 0.5 % more radius."""

FAN = 17
"""Normals over the polar of the cone of directions of saturation."""

ON_LIMIT = 1e-9
"""A control this close to the limit, relative to it, touches it."""

ROUND_OFF = 1e-12
"""A unit normal counts as polar to a direction if their product is at most this."""


def unclipped(
    admissible: Halfspaces,
    saturation: Saturation,
    possible: Float[Tensor, "*batch v 2"],
    margin: Float[Tensor, "*#batch"],
) -> Halfspaces:
    """An outer set of y, given half-spaces that hold uhat = clip(y).

    Args:
        admissible: Q, unit rows over uhat, padded.
        saturation: how y is clipped.
        possible: points whose convex hull holds every possible y, namely C theta + d at the vertices of Theta [m/s].
        margin: the largest distance of y from that hull [m/s].

    Returns:
        Half-spaces of y. `source` is that of the row of Q that a half-space repeats. Elsewhere it is the largest of
        these, which means "no single row".
    """
    shape = admissible.batch_shape
    flat = Halfspaces(admissible.A.reshape(-1, admissible.rows, 2), admissible.b.reshape(-1, admissible.rows))
    wishes = possible.expand(*shape, *possible.shape[-2:]).reshape(-1, *possible.shape[-2:])
    rows = _unclipped(flat, saturation, wishes, margin.expand(shape).reshape(-1))
    source = None
    if admissible.source is not None:
        blurred = admissible.source.amax(-1, keepdim=True)
        fan, rest = FAN + 1, rows.rows - FAN - 1 - admissible.rows
        source = torch.cat([blurred.expand(*shape, fan), admissible.source, blurred.expand(*shape, rest)], dim=-1)
    return Halfspaces(rows.A.reshape(*shape, *rows.A.shape[1:]), rows.b.reshape(*shape, rows.rows), source)


def _unclipped(
    admissible: Halfspaces, saturation: Saturation, possible: Float[Tensor, "B v 2"], margin: Float[Tensor, "B"]
) -> Halfspaces:
    batch, like = len(admissible.b), admissible.b
    turn = 2 * math.pi * torch.arange(DIRECTIONS, dtype=like.dtype, device=like.device) / DIRECTIONS
    around = torch.stack([turn.cos(), turn.sin()], dim=-1)
    by_norm = saturation.shape == "norm"
    # A limit beyond every possible y is no limit, and may be replaced by any finite one.
    farthest = possible.norm(dim=-1).amax(-1, keepdim=True) + margin.unsqueeze(-1)
    limits = torch.minimum(like.new_tensor(saturation.limits), 2 * farthest.detach())
    corner = Polygon.from_box(-limits, limits)
    reach = limits[:, :1] if by_norm else 2 * limits.amax(-1, keepdim=True)
    tangents = Halfspaces(around, reach.expand(-1, DIRECTIONS))
    inside = Halfspaces.stack([admissible, tangents])
    no_source = torch.zeros_like(inside.b, dtype=torch.long)
    clipped = corner.clip(inside.A, inside.b, torch.zeros_like(inside.b), no_source, most=inside.rows + 4)

    if by_norm:
        outward, touched = _arcs(admissible, limits[:, :1], around)
        can_clip = farthest > limits[:, :1]
    else:
        axes = torch.eye(2, dtype=like.dtype, device=like.device)
        outward, faces = torch.cat([axes, -axes]).expand(batch, 4, 2), limits.repeat(1, 2)
        touched = clipped.body.support(outward) >= faces * (1 - ON_LIMIT)
        can_clip = (outward @ possible.mT).amax(-1) + margin.unsqueeze(-1) > faces
    touched = touched & can_clip

    fan = outward_normals(outward, touched, FAN).normals
    normals = torch.cat([fan, admissible.A], dim=1)
    away = (normals @ outward.mT).masked_fill(~touched.unsqueeze(1), -torch.inf).amax(-1)
    polar = (away <= ROUND_OFF) & (normals != 0).any(-1)
    offsets = clipped.body.support(normals)

    nearest = (around @ possible.mT).amin(-1).amax(-1) - margin
    surely_clipped = (nearest > limits[:, 0]) & by_norm
    zero_admissible = (admissible.b >= 0).all(-1)
    idle = zero_admissible & (nearest <= saturation.dead_speed)
    offsets = torch.where(idle.unsqueeze(-1), offsets.clamp(min=saturation.dead_speed), offsets)
    offsets = torch.where(surely_clipped.unsqueeze(-1), 0.0, offsets)

    # The chord: with m the middle of Cn, m.y >= v min m.g over its directions g.
    middle = -fan[:, FAN // 2]
    chord = limits[:, 0] * (outward @ middle.unsqueeze(-1)).squeeze(-1).masked_fill(~touched, torch.inf).amin(-1)
    has_chord = surely_clipped & touched.any(-1) & (middle != 0).any(-1)

    impossible = (clipped.outcome == Outcome.EMPTY) | (surely_clipped & ~touched.any(-1))
    return Halfspaces.stack(
        [
            Halfspaces(normals, offsets).where(polar & ~(surely_clipped & ~touched.any(-1)).unsqueeze(-1)),
            Halfspaces(-middle.unsqueeze(1), -torch.where(has_chord, chord, 0.0).unsqueeze(1)).where(
                has_chord.unsqueeze(-1)
            ),
            Halfspaces(torch.zeros_like(middle).unsqueeze(1), torch.where(impossible, -1.0, 1.0).unsqueeze(1)),
        ]
    )


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
