r"""`UnknownAvoidance` at a given set Psi of its parameters: a barrier with errors, and half-planes of psi.

    closing = (-grad h . u + grad h . u_j)/s                the speed at which the body is approached [m/s]
    low  = spow((closing - slack) s, 1/p),    high = spow((closing + slack) s, 1/p)

A row that is kept has w >= low, since the true control keeps it and the measured slack is wrong by at most `slack`. An
active row has w <= high as well. With errors of positions or unequal radii q is an interval. Then low belongs to the
largest distance and q, high to the smallest, because the largest speed of approach phi = spow(w, p)/s grows with the
distance.

A row may be active for some psi in Psi if the least w over Psi is at most high. This is the slack test of the
inverse-optimal set for the barrier's rows, whose errors cover all of Psi.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.device import all_seen
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, dot
from torchfsid.robots.avoidance import Geometry, NeighbourVelocity, Sight
from torchfsid.robots.bounds import ErrorBounds, RowErrors
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.unknown_avoidance import UnknownAvoidance, extremes, lines, spow
from torchfsid.tolerances import ROUND_OFF

NEAREST = 1e-9
"""The least distance at which rows are evaluated [m]."""


class SafetyRows(NamedTuple):
    """What the rows of a measurement say about psi.

    Attributes:
        kept_q: q of the half-planes w >= low, true of every row that the controller keeps.
        low: their right-hand sides.
        active_q: q of the half-planes w <= high, true of every active row.
        high: their right-hand sides.
        cuts: whether w >= low cuts Psi.
        undecided: whether Psi leaves it open that the row is active.
    """

    kept_q: Float[Tensor, "*batch m"]
    low: Float[Tensor, "*batch m"]
    active_q: Float[Tensor, "*batch m"]
    high: Float[Tensor, "*batch m"]
    cuts: Bool[Tensor, "*batch m"]
    undecided: Bool[Tensor, "*batch m"]


class _At(NamedTuple):
    """Distances r [m], the least and the largest q there, and w over Psi for the least q: its extremes and mean."""

    r: Float[Tensor, "B m"]
    least: Float[Tensor, "B m"]
    largest: Float[Tensor, "B m"]
    reach: tuple[Float[Tensor, "B m"], Float[Tensor, "B m"], Float[Tensor, "B m"]]


class _Look(NamedTuple):
    """The geometry of a measurement, |grad h|, alpha(h) at the mean of the vertices, and how well bodies are seen."""

    measurement: Measurement
    seen: Geometry
    at: _At
    size: Float[Tensor, "B m"]
    typical: Float[Tensor, "B m"]
    sights: list[tuple[Sight, _At, _At]]


@dataclass(frozen=True)
class AvoidanceWithin:
    """The barrier of robots whose parameters psi lie in the hull of given vertices.

    Its rows are those of the mean of the vertices. The errors of the rows say how much smaller their slacks can be for
    other parameters. Whether a row is violated is judged by `safety_rows`, so that the rows count as soft.

    Attributes:
        unknown: the form of the barrier.
        psi: vertices of Psi, for each robot of the batch.
    """

    unknown: UnknownAvoidance
    psi: Float[Tensor, "B v 2"]
    _looks: list[_Look] = field(init=False, default_factory=list, repr=False, compare=False)
    uncertain: ClassVar[bool] = True

    @property
    def soft(self) -> bool:
        return True

    @property
    def neighbour_velocity(self) -> NeighbourVelocity:
        return self.unknown.neighbour_velocity

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return self.unknown.labels(bodies)

    def __call__(self, measurement: Measurement) -> Halfspaces:
        look = self._look(measurement)
        return Halfspaces(-look.seen.gradient, look.typical - look.seen.share).where(measurement.present)

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        """See `CollisionAvoidance.errors`. The least phi over Psi, at the least distance, replaces phi(r - e)."""
        look, unknown, present = self._look(measurement), self.unknown, measurement.present
        sight, nearest, _ = self._sight(look, measurement, bounds)
        least, phi = nearest.reach[0], look.typical / look.size
        slack = (phi - spow(least, unknown.power) / unknown.size(nearest.r)).clamp(min=0.0) + sight.loose
        slack = torch.where(sight.clear, slack, inf)
        return RowErrors(torch.where(present, sight.angle, 0.0), torch.where(present, slack, 0.0))

    def slack_left_out(self, measurement: Measurement) -> Float[Tensor, "*batch"]:
        """The least slack that the row of a body without a slot can have [m/s], for all of Psi."""
        left_out, u, unknown = measurement.left_out, measurement.u, self.unknown
        assert left_out is not None
        assert u is not None
        unknown.pattern.require_monotone("bodies are left out")
        nearest = torch.where(left_out.distance.isfinite(), left_out.distance, 1.0).unsqueeze(-1)
        r = (nearest * (1 - ROUND_OFF)).clamp(min=NEAREST)
        least, _, _ = self._reach(self._q(measurement, r, left_out.radius.unsqueeze(-1))[0])
        phi = (spow(least, unknown.power) / unknown.size(r)).squeeze(-1)
        speed = u.norm(dim=-1)
        if self.neighbour_velocity != "none":
            speed = speed + left_out.speed
        return phi - speed - ROUND_OFF * (phi.abs() + speed)

    def safety_rows(self, measurement: Measurement, bounds: ErrorBounds, slack: Float[Tensor, "*#B #m"]) -> SafetyRows:
        """What the rows say about psi. Those of bodies that are not present or not clearly seen say nothing.

        They are differentiable with respect to the measurement, except where closing + or - slack is zero and the power
        is above 1.

        Args:
            measurement: the measurement, with controls.
            bounds: bounds on its errors.
            slack: the largest measured slack of an active row whose position is exact [m/s].
        """
        look, unknown, u = self._look(measurement), self.unknown, measurement.u
        assert u is not None
        sight, nearest, farthest = self._sight(look, measurement, bounds)
        direction, share = look.seen.gradient / look.size.unsqueeze(-1), look.seen.share / look.size
        closing = share - dot(direction, u.unsqueeze(-2))
        round_off = ROUND_OFF * (dot(direction.abs(), u.abs().unsqueeze(-2)) + share.abs()).detach()
        slack = slack + sight.loose + round_off
        low = spow((closing - slack) * unknown.size(farthest.r), 1 / unknown.power)
        high = spow((closing + slack) * unknown.size(nearest.r), 1 / unknown.power)
        known = measurement.present & sight.clear & (low + high + nearest.least).isfinite()
        least, largest, _ = nearest.reach
        smallest = least if farthest.largest is nearest.least else self._reach(farthest.largest.detach())[0]
        cuts, undecided = known & (smallest < low), known & (least <= high) & (largest > high)
        return SafetyRows(farthest.largest, low, nearest.least, high, cuts, undecided)

    def _look(self, measurement: Measurement) -> _Look:
        """The rows' geometry. It is kept, since rows, errors and half-planes of one measurement ask for it in turn."""
        last = self._looks[-1] if self._looks else None
        if last is None or last.measurement is not measurement:
            seen = self.unknown.pattern.geometry(measurement)
            at = self._at(measurement, seen.r)
            size = self.unknown.size(seen.r).clamp(min=NEAREST)
            last = _Look(measurement, seen, at, size, spow(at.reach[2], self.unknown.power), [])
            self._looks[:] = [last]
        return last

    def _sight(self, look: _Look, measurement: Measurement, bounds: ErrorBounds) -> tuple[Sight, _At, _At]:
        """How well the bodies are seen, and q at their least and at their largest distances. Kept like `_look`."""
        if look.sights:
            return look.sights[0]
        pattern = self.unknown.pattern
        sight = pattern.sight(measurement, bounds, look.seen)
        nearest = farthest = look.at
        if not all_seen(sight.e == 0):
            pattern.require_monotone("positions have errors")
            nearest = self._at(measurement, (sight.r - sight.e).clamp(min=NEAREST))
            farthest = self._at(measurement, sight.r + sight.e)
        look.sights.append((sight, nearest, farthest))
        return look.sights[0]

    def _at(self, measurement: Measurement, r: Float[Tensor, "B m"]) -> _At:
        least, largest = self._q(measurement, r)
        return _At(r, least, largest, self._reach(least.detach()))

    def _q(
        self, measurement: Measurement, r: Float[Tensor, "B m"], others: Tensor | None = None
    ) -> tuple[Float[Tensor, "B m"], Float[Tensor, "B m"]]:
        """The smallest and the largest q at distances r, for the margins of Psi. `others` are the bodies' radii."""
        unknown = self.unknown
        if unknown.margin is None:
            q = unknown.q(r, 0.0, 0.0)
            return q, q
        others = measurement.body_radii if others is None else others
        if measurement.radius is None or others is None:
            raise InputError("measurement.radius", "radii, since the barrier is given by a margin", None)
        radii = measurement.radius.unsqueeze(-1) + others
        if unknown.distance == "euclidean" or all_seen(radii == unknown.reference):
            q = unknown.q(r, radii, 0.0)
            return q, q
        first, last = (unknown.q(r, radii, margin) for margin in self._margins)
        return torch.minimum(first, last), torch.maximum(first, last)

    @cached_property
    def _margins(self) -> tuple[Float[Tensor, "B 1"], Float[Tensor, "B 1"]]:
        """The least and the largest margin that Psi allows."""
        low, high = extremes(self.unknown.length(self.unknown.split(self.psi)[1])).unsqueeze(-2).unbind(-1)
        return low, high

    def _reach(
        self, q: Float[Tensor, "B k"]
    ) -> tuple[Float[Tensor, "B k"], Float[Tensor, "B k"], Float[Tensor, "B k"]]:
        """The least and the largest w over Psi, with their round-off, and w at the mean of the vertices."""
        w = lines(self.psi, q)
        least, largest = torch.aminmax(w, dim=-1)
        round_off = ROUND_OFF * (self._largest_beta * q.abs() + torch.maximum(-least, largest))
        return least - round_off, largest + round_off, w.mean(-1)

    @cached_property
    def _largest_beta(self) -> Float[Tensor, "B 1"]:
        return self.psi[..., 0].amax(-1, keepdim=True)
