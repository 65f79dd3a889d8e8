r"""Half-spaces of theta from positions alone, by windows of time.

The velocity from two positions that are wrong by rho is wrong by 2 rho/dt, which may be as much as the velocity itself.
Over a window [s, s + T] the mean velocity (x(s + T) - x(s))/T is wrong by 2 rho/T only. At every sample the KKT
conditions hold, C theta + d - u in cone{a_j : j active}, and cones are convex. So with means over the window, weighted
by the time for which each control was held,

    mean(C) theta + mean(d) - (x(s + T) - x(s))/T    in    cone{a_j(t) : row j may be active at some t of the window}

up to the bound on the controller's own errors, the mean drift of C theta + d, and (rho(s) + rho(s + T))/T. The cone
grows with T and the bound falls, so windows of several lengths are read at once, and each sample as the shortest.

Which rows may be active is decided sample by sample. There the measured velocity has its own, larger error. A row that
may be active at some samples is one generator, a fan from its least to its greatest direction.

A clipped nominal control is averaged as well: clip is nonexpansive, so that the mean of clip(y) differs from
clip(mean(y)) by at most mean |y - mean(y)|, where y = C theta + d. This is added to the bound if some theta may be
clipped. In a dead zone clip is not nonexpansive: a window at which one may matter is not used.

A window is not used if one of its samples is not: the robot was not seen, a row that may be active has no known
direction, and so on (`evidence`). docs/theory.md has the proofs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.by_robot import by_robot
from torchfsid.identification.evidence import Evidence, ObservationModel, Sample, read_sample, sample_of
from torchfsid.robots.bounds import RowErrors
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Saturation
from torchfsid.sets.feasible_set import FeasibleSet

TIME_ROUND_OFF = 1e-6
"""Times of a log count as equal up to this, relative to a window's length."""

AROUND = 16
"""Directions in which the distance of the nominal controls from zero is bounded."""


@dataclass(frozen=True)
class _Moments:
    """What windows need of S samples.

    Attributes:
        t: times [s].
        x: positions [m].
        rho: bounds on their errors [m].
        observed: whether the robot was observed. A gap of its own ends a window.
        usable: whether the sample may be part of a window.
        angle: directions of the rows [rad].
        half: bounds on their errors [rad].
        near: the rows that may be active.
        C: of the nominal control C theta + d.
        d: of the nominal control C theta + d [m/s].
        drift: bounds on the error of C theta + d [m/s].
    """

    t: Float[Tensor, "S"]
    x: Float[Tensor, "S B 2"]
    rho: Float[Tensor, "S B"]
    observed: Bool[Tensor, "S B"]
    usable: Bool[Tensor, "S B"]
    angle: Float[Tensor, "S B m"]
    half: Float[Tensor, "S B m"]
    near: Bool[Tensor, "S B m"]
    C: Float[Tensor, "S B 2 p"]
    d: Float[Tensor, "S B 2"]
    drift: Float[Tensor, "S B"]

    def followed_by(self, last: _Moments, since: float) -> _Moments:
        """These samples from the time `since` on, and another one."""
        kept = int((self.t >= since).sum())
        names = [field.name for field in fields(self)]
        first = len(self.t) - kept
        return _Moments(**{name: torch.cat([getattr(self, name)[first:], getattr(last, name)]) for name in names})


@dataclass
class Windows:
    """The newest window of each length, sample by sample.

    Attributes:
        model: the declared model. Its `noise.velocity` is the error of the controllers alone.
        lengths: the lengths of the windows [s].
        used: for each length, how many windows of all robots were used.
        ended: for each length, how many windows of all robots there were so far, without a gap of the robot.

    Raises:
        InputError: there are no lengths or they are not positive, or the model's set is not `inverse_optimal`.
    """

    model: ObservationModel
    lengths: Sequence[float]
    used: Int[Tensor, "L"] = field(init=False)
    ended: Int[Tensor, "L"] = field(init=False)
    _moments: _Moments | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        if not self.lengths or not min(self.lengths) > 0:
            raise InputError("windows", "positive lengths [s]", self.lengths)
        if self.model.kind != "inverse_optimal":
            raise InputError("kind", "inverse_optimal, for windows", self.model.kind)
        self.used = self.ended = torch.zeros(len(self.lengths), dtype=torch.long)

    def read(self, theta: FeasibleSet, measurement: Measurement, compiled: bool | None = None) -> Evidence:
        """The evidence of a sample and of the windows that end at it.

        Args:
            theta: the robots' sets so far, batch (B,).
            measurement: positions, with the mean velocities until the next sample. `velocity_error` bounds their
                errors, (rho(t) + rho(t + dt))/dt.
            compiled: see `evidence`.

        Raises:
            InputError: see `evidence`. The positions are not planar, or times do not increase.
        """
        measurement = measurement.observed_only()
        if measurement.x.shape[-1] != 2:
            raise InputError("measurement", "planar positions, for windows", tuple(measurement.x.shape))
        sample = sample_of(self.model, theta, measurement)
        found = read_sample(self.model, sample, compiled)
        now, before = self._moment(measurement, sample, found), self._moments
        if before is None:
            self._moments = now
            return found
        t = measurement.time
        if not t > float(before.t[-1]):
            raise InputError("measurement.t", f"a time after {float(before.t[-1])}", t)
        self._moments = before.followed_by(now, t - max(self.lengths) * (1 + TIME_ROUND_OFF))
        windows, whole = self._windows(before, now, theta, sample)
        if not bool(whole.any()):
            return found
        of_windows = read_sample(self.model, windows, compiled)
        says = of_windows.informative.unflatten(0, (len(self.lengths), -1))
        self.used, self.ended = self.used + says.sum(1), self.ended + whole.sum(1)
        omega, _ = by_robot(of_windows.omega, t, len(measurement.x))
        return replace(found, omega=Halfspaces.stack([found.omega, omega]), informative=found.informative | says.any(0))

    def _moment(self, measurement: Measurement, sample: Sample, found: Evidence) -> _Moments:
        noise, errors, A, observed = self.model.noise, sample.row_errors, sample.rows.A, measurement.observed
        assert noise is not None
        rho = torch.full_like(sample.u[:, 0], noise.position)
        if measurement.position_error is not None:
            rho = rho + measurement.position_error
        of_robots = (
            measurement.x, rho, torch.ones_like(found.informative) if observed is None else observed,
            found.informative, torch.atan2(A[..., 1], A[..., 0]),
            torch.zeros_like(sample.rows.b) if errors is None else errors.angle,
            (2 * found.slack + found.excess <= 0) & (A != 0).any(-1),  # slack <= room = -excess - slack
            sample.C, sample.d, sample.drift.expand(len(rho)),
        )  # fmt: skip
        return _Moments(measurement.x.new_tensor([measurement.time]), *(value.unsqueeze(0) for value in of_robots))

    def _windows(
        self, before: _Moments, now: _Moments, theta: FeasibleSet, sample: Sample
    ) -> tuple[Sample, Bool[Tensor, "L B"]]:
        """The L windows of each robot as L*B samples, whose rows are fans, and which of them have no gap."""
        L, B, t, saturation = len(self.lengths), now.x.shape[1], now.t, self.model.task.saturation
        length = before.t.new_tensor(self.lengths)
        inside = before.t >= (t - length * (1 + TIME_ROUND_OFF)).unsqueeze(-1)
        count = inside.sum(-1)
        first = (len(before.t) - count).clamp(max=len(before.t) - 1)
        T = t - before.t[first]
        reached = (count > 0) & (length * (1 - 0.5 / count.clamp(min=1)) <= T)
        weight = inside * torch.cat([before.t, t]).diff() / T.unsqueeze(-1)

        def mean(values: Tensor) -> Tensor:
            return torch.tensordot(weight, values, dims=1)

        near = before.near & inside[..., None, None]
        middle, width = _hull(before.angle, before.half, near)
        may_be = near.any(1)
        A = torch.stack([middle.cos(), middle.sin()], dim=-1) * may_be.unsqueeze(-1)
        u, C, d, drift = (
            (now.x - before.x[first]) / T[:, None, None],
            mean(before.C),
            mean(before.d),
            mean(before.drift),
        )
        whole = (before.observed | ~inside.unsqueeze(-1)).all(1) & now.observed & reached.unsqueeze(-1)
        usable = whole & (before.usable | ~inside.unsqueeze(-1)).all(1)
        noise = self.model.noise
        assert noise is not None
        ball = torch.as_tensor(noise.velocity).to(u) + (now.rho + before.rho[first]) / T.unsqueeze(-1)
        corners = theta.vertices()
        if saturation is not None:
            wishes = corners @ before.C.mT + before.d.unsqueeze(-2)
            away = (wishes - (corners @ C.mT + d.unsqueeze(-2)).unsqueeze(1)).norm(dim=-1)
            spread = (weight[..., None, None] * away).sum(1).amax(-1)
            may_clip, idle = _clipping(wishes, saturation, before.drift)
            ball = ball + spread * (may_clip & inside.unsqueeze(-1)).any(1)
            usable = usable & ~(idle & inside.unsqueeze(-1)).any(1)
        b = torch.where(may_be, (A * u.unsqueeze(-2)).sum(-1), 1.0)
        nothing = torch.zeros_like(b).flatten(0, 1)
        errors = RowErrors(torch.where(may_be, width, 0.0).flatten(0, 1), nothing)
        A, b, u, C, d, usable, ball, drift = (v.flatten(0, 1) for v in (A, b, u, C, d, usable, ball, drift))
        no_row = torch.zeros_like(sample.hard)
        corners = corners.expand(L, B, *corners.shape[1:]).flatten(0, 1)
        return Sample(Halfspaces(A, b), no_row, no_row, u, C, d, usable, nothing, ball, drift, errors, corners), whole


def _hull(
    angle: Float[Tensor, "S B m"], half: Float[Tensor, "S B m"], near: Bool[Tensor, "L S B m"]
) -> tuple[Float[Tensor, "L B m"], Float[Tensor, "L B m"]]:
    """The middle and the half width of an interval of angles that holds all directions of a row [rad]."""
    reference = torch.atan2((angle.sin() * near).sum(1), (angle.cos() * near).sum(1)).unsqueeze(1)
    ahead = torch.remainder(angle - reference + math.pi, 2 * math.pi) - math.pi
    high = (ahead + half).masked_fill(~near, -math.inf).amax(1)
    low = (ahead - half).masked_fill(~near, math.inf).amin(1)
    some = near.any(1)
    middle = torch.where(some, reference.squeeze(1) + (high + low) / 2, 0.0)
    return middle, torch.where(some, (high - low) / 2, 0.0)


def _clipping(
    wishes: Float[Tensor, "S B v 2"], saturation: Saturation, drift: Float[Tensor, "S B"]
) -> tuple[Bool[Tensor, "S B"], Bool[Tensor, "S B"]]:
    """May a wish of the hull be clipped, and may it lie in the dead zone?"""
    sizes = wishes.norm(dim=-1, keepdim=True) if saturation.shape == "norm" else wishes.abs()
    limits = wishes.new_tensor(saturation.limits)[: sizes.shape[-1]]
    may_clip = (sizes.amax(-2) + drift.unsqueeze(-1) > limits).any(-1)
    if saturation.dead_speed == 0:
        return may_clip, torch.zeros_like(may_clip)
    turn = 2 * math.pi * torch.arange(AROUND, dtype=torch.float64, device=wishes.device) / AROUND
    around = torch.stack([turn.cos(), turn.sin()], dim=-1)
    nearest = (around @ wishes.mT).amin(-1).amax(-1) - drift
    return may_clip, nearest <= saturation.dead_speed
