r"""Avoidance by robots of second order, whose controls are accelerations: one row A a <= b for each other body.

    x' = v,   v' = a;      dx = x - x_j,   dv = v - v_j;      h = |dx|^2 - Ds^2 >= 0 the safe side

    (d/dt + k1)(d/dt + k2) h >= 0:      -2 dx.a  <=  2 |dv|^2 + (k1 + k2) 2 dx.dv + k1 k2 h   [- 2 dx.a_j]

The bracket is the neighbour's share. It is absent (`none`), or uses the neighbour's acceleration now (`current`: one
joint QP over the team). The velocities v and v_j are states at t, like positions, and are measured.

With r = |dx|, e = dx/r, s = |dv| and K = k1 + k2, the unit row has the slack

    s^2/r  +  e.(K dv + a [- a_j])  +  k1 k2 (r - Ds^2/r)/2        [m/s2].

The gains occur in K and k1 k2 only: k1 and k2 can be exchanged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, dot
from torchfsid.robots.avoidance import NeighbourVelocity, away_from_bodies, distance_kept, require_distance
from torchfsid.robots.bounds import ErrorBounds, RowErrors
from torchfsid.robots.measurement import Measurement
from torchfsid.tolerances import ROUND_OFF

NeighbourAcceleration = Literal["none", "current"]

NEAREST = 1e-9
"""The least distance at which errors are evaluated [m]."""


@dataclass(frozen=True)
class SecondOrderAvoidance:
    """One row per body: keep the distance `safety_distance`, or radius_i + radius_j + `margin`, both in [m].

    Attributes:
        gains: k1 and k2 [1/s].
        safety_distance: one for all bodies, or a tensor (m,), one per body [m].
        margin: distance between the discs of two bodies [m].
        neighbour_acceleration: which accelerations of other bodies the rows use.
        soft: the controller may violate the rows.
        gain_errors: by how much k1 and k2 may be wrong [1/s].
        distance_error: by how much the safety distance or the margin may be wrong [m].

    Raises:
        InputError: a gain is not positive, an error is negative, or not exactly one of the distances is given. When
            called: the measurement lacks velocities, or radii or accelerations that the rows use.
    """

    gains: tuple[float | Tensor, float | Tensor]
    safety_distance: float | Tensor | None = None
    margin: float | None = None
    neighbour_acceleration: NeighbourAcceleration = "none"
    soft: bool = False
    gain_errors: tuple[float, float] = (0.0, 0.0)
    distance_error: float = 0.0
    order: ClassVar[int] = 2

    def __post_init__(self) -> None:
        require_distance(self.safety_distance, self.margin)
        if len(self.gains) != 2 or not min(self.gains) > 0:
            raise InputError("gains", "two positive numbers [1/s]", self.gains)
        if not min(*self.gain_errors, self.distance_error) >= 0:
            raise InputError("gain_errors, distance_error", ">= 0", (self.gain_errors, self.distance_error))

    @property
    def uncertain(self) -> bool:
        return max(*self.gain_errors, self.distance_error) > 0

    @property
    def neighbour_velocity(self) -> NeighbourVelocity:
        """See `Barrier`: the controls of other bodies that the rows use."""
        return self.neighbour_acceleration

    def __call__(self, measurement: Measurement) -> Halfspaces:
        dx, dv = away_from_bodies(measurement), self._relative_velocity(measurement)
        Ds = self._distance_kept(measurement, measurement.body_radii)
        h, rate = dot(dx, dx) - Ds**2, 2 * dot(dx, dv)
        b = 2 * dot(dv, dv) + self._sum * rate + self._product * h
        if self.neighbour_acceleration == "current":
            b = b - 2 * dot(dx, self._accelerations(measurement))
        return Halfspaces(-2 * dx, b).where(measurement.present)

    def errors(self, measurement: Measurement, bounds: ErrorBounds) -> RowErrors:
        """Bounds on the errors of the rows, with r known up to rho, dv up to sigma, a_j up to tau, K up to kappa, k1 k2
        up to pi and Ds up to eps.

        e is wrong by at most the angle asin(rho/r), and is unknown if rho >= r. The slack at the measured control a is
        wrong by at most

              (s + sigma)^2/(r - rho) - s^2/r                 s^2/r is convex in (s, r), grows with s, falls with r:
                                                              no change is as large as that to this corner
            + c |K dv + a [- a_j]|                            of turning e, with c = 2 sin(angle/2)
            + (K + kappa) sigma [+ tau]
            + kappa (|e.dv| + c s)
            + (k1 k2 + pi) (rho + (Ds + eps)^2/(r - rho) - Ds^2/r)/2
                                                              r - Ds^2/r is concave and grows in r: as above, downward
            + pi |r - Ds^2/r|/2

        on either side: an active row is not measured as inactive, and a row that is kept not as violated.
        """
        dx, dv = away_from_bodies(measurement), self._relative_velocity(measurement)
        squared, speed = dot(dx, dx), dv.norm(dim=-1)
        rho = bounds.position.unsqueeze(-1) + bounds.body_position
        sigma = bounds.velocity.unsqueeze(-1) + bounds.body_velocity
        clear = squared > rho.square()
        r, rho = torch.where(clear, squared, 1.0).sqrt(), torch.where(clear, rho, 0.0)
        angle = torch.where(clear, (rho / r).clamp(max=1.0).arcsin(), math.pi)
        nearer = (r - rho).clamp(min=NEAREST)
        Ds = self._distance_kept(measurement, measurement.body_radii)

        pull = self._sum * dv
        if measurement.u is not None:
            pull = pull + measurement.u.unsqueeze(-2)
        of_sum, of_product = self._gain_errors
        chord = 2 * (angle / 2).sin()
        loose = (self._sum + of_sum) * sigma + of_sum * (dot(dx, dv).abs() / r + chord * speed)
        if self.neighbour_acceleration == "current":
            pull, loose = pull - self._accelerations(measurement), loose + bounds.body_acceleration
        slack = (speed + sigma).square() / nearer - speed.square() / r + chord * pull.norm(dim=-1) + loose
        of_distance = rho + (Ds + self.distance_error) ** 2 / nearer - Ds**2 / r
        slack = slack + (self._product + of_product) * of_distance / 2 + of_product * (r - Ds**2 / r).abs() / 2
        slack = torch.where(clear, slack, math.inf)
        present = measurement.present
        return RowErrors(torch.where(present, angle, 0.0), torch.where(present, slack, 0.0))

    def slack_left_out(self, measurement: Measurement) -> Float[Tensor, "*batch"]:
        """k1 k2 (R - Ds^2/R)/2 - K (|v| + V) - |a| [- A], the least slack of the row of a body without a slot [m/s2],
        over all values that K, k1 k2 and Ds may have.

        R is the least distance of these bodies, V their largest speed, A their largest acceleration.
        """
        left_out, a, v = measurement.left_out, measurement.u, self._velocity(measurement)
        assert left_out is not None
        assert a is not None
        Ds = self._distance_kept(measurement, left_out.radius.unsqueeze(-1)) + self.distance_error
        largest = Ds.amax(-1) if isinstance(Ds, Tensor) and Ds.ndim > 0 else Ds
        nearest = torch.where(left_out.distance.isfinite(), left_out.distance, 1.0)
        R = (nearest * (1 - ROUND_OFF)).clamp(min=NEAREST)
        closing = v.norm(dim=-1) + left_out.speed
        if measurement.arrival_error is not None:
            closing = closing + measurement.arrival_error
        of_sum, of_product = self._gain_errors
        pull = (self._sum + of_sum) * closing + a.norm(dim=-1)
        if self.neighbour_acceleration == "current":
            pull = pull + left_out.acceleration
        ahead = (R - largest**2 / R) / 2
        away = self._product * ahead - of_product * ahead.abs()
        return away - pull - ROUND_OFF * (away.abs() + pull)

    def labels(self, bodies: Sequence[str]) -> list[str]:
        return [f"avoid {body}" for body in bodies]

    @property
    def _sum(self) -> float | Tensor:
        return self.gains[0] + self.gains[1]

    @property
    def _product(self) -> float | Tensor:
        return self.gains[0] * self.gains[1]

    @property
    def _gain_errors(self) -> tuple[float | Tensor, float | Tensor]:
        """kappa and pi."""
        (k1, k2), (of_1, of_2) = self.gains, self.gain_errors
        return of_1 + of_2, k1 * of_2 + k2 * of_1 + of_1 * of_2

    def _distance_kept(self, measurement: Measurement, radii: Tensor | None) -> float | Tensor:
        return distance_kept(self.safety_distance, self.margin, measurement.radius, radii)

    def _velocity(self, measurement: Measurement) -> Tensor:
        if measurement.velocity is None:
            raise InputError("measurement.velocity", "the velocities of the robots, of second order", None)
        return measurement.velocity

    def _relative_velocity(self, measurement: Measurement) -> Float[Tensor, "*batch m n"]:
        """v - v_j [m/s]. Zero for slots without a body."""
        if measurement.body_velocities is None:
            raise InputError("measurement.body_velocities", "the velocities of the bodies", None)
        dv = self._velocity(measurement).unsqueeze(-2) - measurement.body_velocities
        return torch.where(measurement.present.unsqueeze(-1), dv, 0.0)

    def _accelerations(self, measurement: Measurement) -> Float[Tensor, "*batch m n"]:
        if measurement.body_accelerations is None:
            raise InputError("measurement.body_accelerations", "the accelerations of the bodies", None)
        return torch.where(measurement.present.unsqueeze(-1), measurement.body_accelerations, 0.0)
