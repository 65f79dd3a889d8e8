r"""The inverse-optimal set: every theta for which the measured control is optimal, up to bounds on all errors.

    { theta : C theta + d - u  in  cone{a_j : s_j <= slack} (+) ball(velocity) }

The truth is inside if |u - u*| <= `velocity` and the slack of every truly active row is measured below `slack`. By KKT,
its C theta + d - u* lies in the cone of its active rows, which are among the generators. Replacing u* by u moves this
vector by at most `velocity`. The slack test is one-sided, so violated (soft) rows count as active. Each outward normal
n of the cone gives one half-space n.(C theta + d - u) <= velocity. A fan of normals rounds off the corners of the sum
by an outer polygon. An intersection over time never recovers from one wrong set. Unlike the critical region, this set
stays right if a solver is inexact or a row is nearly active.

Errors of positions turn the rows, move their boundaries and shift C theta + d. So generators become fans (in space: the
edges of pyramids around circular cones), the slack test widens (`RowErrors`), and the ball grows by the drift of
C theta + d. A row of unknown direction that may be active is a generator in all directions, and the set is the whole
space. Only a zero row without such an error is padding. A clipped nominal control opens the set in the directions of
saturation (`saturation`). Each widening gives an outer set.
This set is not in the paper; docs/theory.md has the proofs.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, dot
from torchfsid.identification.normals import OutwardNormals, outward_normals
from torchfsid.identification.saturation import unclipped
from torchfsid.kernels.cones import RING
from torchfsid.robots.bounds import NoiseBound, RowErrors
from torchfsid.robots.tasks import Saturation
from torchfsid.tolerances import NORMALS, SPREAD


def inverse_optimal_set(
    safe_controls: Halfspaces,
    u: Float[Tensor, "*batch n"],
    C: Float[Tensor, "*batch n p"],
    d: Float[Tensor, "*batch n"],
    noise: NoiseBound,
    *,
    row_errors: RowErrors | None = None,
    drift: Float[Tensor, "*batch"] | float = 0.0,
    saturation: Saturation | None = None,
    possible: Float[Tensor, "*batch v n"] | None = None,
) -> Halfspaces:
    """The set as half-spaces of theta, with unneeded rows as padding. Controls are in the plane or in space, p is any.

    `source` is m + j where a half-space comes from the multiplier of row j, and 2 m where it comes from no single row.

    Args:
        safe_controls: the rows A u <= b.
        u: the measured control [m/s].
        C: of the nominal control C theta + d.
        d: of the nominal control C theta + d [m/s].
        noise: `velocity` and `slack` are used. `row_errors` and `drift` cover errors of positions and neighbours.
        row_errors: bounds on the errors of the rows; None if they are exact.
        drift: a bound on the error of C theta + d [m/s].
        saturation: how the nominal control is clipped; None if it is not.
        possible: points whose convex hull holds every C theta + d that is still possible [m/s]. Required with a
            saturation.

    Raises:
        InputError: a saturation without `possible`, or controls of another dimension.
    """
    u, C, d = u.to(torch.float64), C.to(torch.float64), d.to(torch.float64)
    unit = safe_controls.normalised()
    bound = per_row(noise.slack, u) + (0.0 if row_errors is None else row_errors.slack)
    near = unit.slack(u) <= bound + unit.round_off(u)
    ball = per_row(noise.velocity, u).squeeze(-1)
    outward = normals_of(unit, near, row_errors)
    return set_around(outward, unit.rows, u, C, d, ball, per_row(drift, u).squeeze(-1), saturation, possible)


def normals_of(unit: Halfspaces, near: Bool[Tensor, "*batch m"], row_errors: RowErrors | None) -> OutwardNormals:
    """The outward normals of the cone of the unit rows that may be active (`near`), turned by up to their errors.

    The generators are the rows, several times if they are turned: generator g belongs to row g mod m.
    """
    generators = unit.A
    if row_errors is None:
        may_be_active = near & (generators != 0).any(-1)
    else:
        unknown = without_direction(unit, row_errors)
        may_be_active = near & ((generators != 0).any(-1) | unknown)
        east = torch.eye(unit.dim, dtype=generators.dtype, device=generators.device)[0]
        generators = torch.where(unknown.unsqueeze(-1), east, generators)
        angle = torch.where(unknown, math.pi, row_errors.angle)
        generators, may_be_active = (_pyramid if unit.dim == 3 else _fan)(generators, may_be_active, angle)
    outward = outward_normals(generators, may_be_active, NORMALS)
    none = outward.generator == generators.shape[-2]
    return outward._replace(generator=torch.where(none, unit.rows, outward.generator % max(unit.rows, 1)))


def set_around(
    outward: OutwardNormals,
    m: int,
    u: Float[Tensor, "*batch n"],
    C: Float[Tensor, "*batch n p"],
    d: Float[Tensor, "*batch n"],
    ball: Float[Tensor, "*#batch"],
    drift: Float[Tensor, "*#batch"],
    saturation: Saturation | None,
    possible: Float[Tensor, "*batch v n"] | None,
) -> Halfspaces:
    """`inverse_optimal_set`, given the outward normals of the cone of the m rows (`normals_of`)."""
    normals, source = outward.normals, m + outward.generator
    needed = (normals != 0).any(-1)
    room = (ball + drift).unsqueeze(-1)
    if saturation is None:
        return Halfspaces(normals @ C, (dot(normals, (u - d).unsqueeze(-2)) + room).masked_fill(~needed, 1.0), source)
    if possible is None:
        raise InputError("possible", "the nominal controls that are still possible, for a saturation", None)
    nominal = Halfspaces(normals, dot(normals, u.unsqueeze(-2)) + ball.unsqueeze(-1), source).where(needed)
    nominal = unclipped(nominal, saturation, possible, drift, 2 * m)
    is_row = (nominal.A != 0).any(-1)
    return Halfspaces(nominal.A, nominal.b + drift.unsqueeze(-1) * is_row, nominal.source).pullback(C, d)


def without_direction(unit: Halfspaces, row_errors: RowErrors) -> Bool[Tensor, "*batch m"]:
    """A mask of rows of unknown direction: turned by up to pi, or zero where errors could have turned them."""
    return (row_errors.angle >= math.pi) | ((row_errors.angle > 0) & (unit.A == 0).all(-1))


def per_row(bound: float | Float[Tensor, "*batch"], like: Tensor) -> Float[Tensor, "*batch 1"]:
    """A bound of `NoiseBound` as a tensor that broadcasts with the rows of a batch."""
    return (bound.to(like) if isinstance(bound, Tensor) else like.new_full((), bound)).unsqueeze(-1)


def _fan(
    rows: Float[Tensor, "*batch m 2"], present: Bool[Tensor, "*batch m"], angle: Float[Tensor, "*batch m"]
) -> tuple[Float[Tensor, "*batch g 2"], Bool[Tensor, "*batch g"]]:
    """Rows turned by fractions of an angle, whose cone holds all of the rows turned by up to the angle."""
    generators = torch.cat([_turned(rows, fraction * angle) for fraction in SPREAD], dim=-2)
    return generators, torch.cat([present] * len(SPREAD), dim=-1)


def _turned(rows: Float[Tensor, "*batch m 2"], angle: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m 2"]:
    cos, sin = angle.cos(), angle.sin()
    x, y = rows.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)


def _pyramid(
    rows: Float[Tensor, "*batch m 3"], present: Bool[Tensor, "*batch m"], angle: Float[Tensor, "*batch m"]
) -> tuple[Float[Tensor, "*batch g 3"], Bool[Tensor, "*batch g"]]:
    """The edges of a pyramid around all of the unit rows turned by up to an angle. A row that is exact comes once.

    The k = `RING` edges are at the angle atan(tan(angle)/cos(pi/k)), so that the faces touch the circular cone. From a
    right angle on the cone is all of space, and so is that of edges that are in turn at 60 and at 120 degrees.
    """
    steep = angle >= math.pi / 2
    slope = torch.where(steep, math.sqrt(3.0), torch.where(steep, 0.0, angle).tan() / math.cos(math.pi / RING))
    cos = 1 / (1 + slope.square()).sqrt()
    sin = cos * slope
    least = rows.detach().abs().argmin(-1, keepdim=True)
    across = torch.linalg.cross(rows, torch.zeros_like(rows).scatter(-1, least, 1.0), dim=-1)
    across = across / torch.where((across == 0).all(-1, keepdim=True), 1.0, across).norm(dim=-1, keepdim=True)
    upward = torch.linalg.cross(rows, across, dim=-1)
    edges = []
    for k in range(RING):
        turn, along = 2 * math.pi * k / RING, torch.where(steep & (k % 2 == 1), -cos, cos)
        aside = math.cos(turn) * across + math.sin(turn) * upward
        edges.append(along.unsqueeze(-1) * rows + sin.unsqueeze(-1) * aside)
    turned = present & (angle > 0)
    return torch.cat(edges, dim=-2), torch.cat([present, *[turned] * (RING - 1)], dim=-1)
