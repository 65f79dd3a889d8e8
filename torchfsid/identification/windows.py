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
from torchfsid.halfspaces import Halfspaces, array
from torchfsid.identification.by_robot import by_robot
from torchfsid.identification.evidence import Evidence, ObservationModel, Sample, read_sample, sample_of
from torchfsid.kernels.directions import extreme_directions
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

    def followed_by(self, others: _Moments) -> _Moments:
        """These samples and others."""
        names = [field.name for field in fields(self)]
        return _Moments(**{name: torch.cat([getattr(self, name), getattr(others, name)]) for name in names})

    def since(self, t: Tensor) -> _Moments:
        """The samples from the time t on."""
        first = int((self.t < t).sum())
        return _Moments(*(getattr(self, field.name)[first:] for field in fields(self)))


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
        """The evidence of a sample and of the windows that end at it, or of several samples concatenated.

        Args:
            theta: the robots' sets so far, batch (B,).
            measurement: positions, with the mean velocities until the next sample. `velocity_error` bounds their
                errors, (rho(t) + rho(t + dt))/dt.
            compiled: see `evidence`.

        Raises:
            InputError: see `evidence`. The positions are not planar, or times do not increase.
        """
        measurement, robots = measurement.observed_only(), theta.batch_shape.numel()
        if measurement.x.shape[-1] != 2:
            raise InputError("measurement", "planar positions, for windows", tuple(measurement.x.shape))
        sample = sample_of(self.model, theta, measurement)
        found = read_sample(self.model, sample, compiled)
        moments, new = self._moments_of(measurement, sample, found, robots), len(found.informative) // max(robots, 1)
        if self._moments is not None:
            moments = self._moments.followed_by(moments)
        late = ~(moments.t.diff() > 0)
        if bool(late.any()):
            t = moments.t[:-1][late][0]
            raise InputError("measurement.t", f"a time after {float(t)}", float(moments.t[1:][late][0]))
        self._moments = moments.since(moments.t[-1] - max(self.lengths) * (1 + TIME_ROUND_OFF))
        windows, whole = self._windows(moments, new, theta, sample)
        if not bool(whole.any()):
            return found
        of_windows = read_sample(self.model, windows, compiled)
        says = of_windows.informative.unflatten(0, (len(self.lengths), -1))
        self.used, self.ended = self.used + says.sum(1).cpu(), self.ended + whole.flatten(1).sum(1).cpu()
        omega, _ = by_robot(of_windows.omega, 0.0, len(measurement.x))
        return replace(found, omega=Halfspaces.stack([found.omega, omega]), informative=found.informative | says.any(0))

    def _moments_of(self, measurement: Measurement, sample: Sample, found: Evidence, robots: int) -> _Moments:
        noise, errors, A, observed = self.model.noise, sample.row_errors, sample.rows.A, measurement.observed
        assert noise is not None
        rho = torch.zeros_like(sample.u[:, 0]) + noise.of_samples(robots, len(sample.u)).position
        if measurement.position_error is not None:
            rho = rho + measurement.position_error
        of_items = (
            measurement.x, rho, torch.ones_like(found.informative) if observed is None else observed,
            found.informative, torch.atan2(A[..., 1], A[..., 0]),
            torch.zeros_like(sample.rows.b) if errors is None else errors.angle,
            (2 * found.slack + found.excess <= 0) & (A != 0).any(-1),  # slack <= room = -excess - slack
            sample.C, sample.d, sample.drift.expand(len(rho)),
        )  # fmt: skip
        t = torch.as_tensor(measurement.t, dtype=torch.float64, device=rho.device).expand(len(rho))[:: max(robots, 1)]
        return _Moments(t.contiguous(), *(value.unflatten(0, (-1, robots)) for value in of_items))

    def _windows(
        self, series: _Moments, new: int, theta: FeasibleSet, sample: Sample
    ) -> tuple[Sample, Bool[Tensor, "L S B"]]:
        """The L windows of each robot that end at the last S samples, as L*S*B samples whose rows are fans.

        Also returns which of them have no gap.
        """
        N, device, saturation = len(series.t), series.t.device, self.model.task.saturation
        length, last = series.t.new_tensor(self.lengths), torch.arange(N - new, N, device=device)
        t = series.t[last]
        # Of N samples, those from `first` on are inside, and the last one ends the window.
        first = torch.searchsorted(series.t, t - (length * (1 + TIME_ROUND_OFF)).unsqueeze(-1))
        count = last - first
        reached = length.unsqueeze(-1) * (1 - 0.5 / count.clamp(min=1)) <= t - series.t[first]
        T = torch.where(reached, t - series.t[first], 1.0)
        place = torch.arange(N, device=device)
        inside = (place >= first.unsqueeze(-1)) & (place < last.unsqueeze(-1))
        held = torch.cat([series.t.diff(), series.t.new_zeros(1)])
        weight = inside * held / T.unsqueeze(-1)

        def mean(values: Tensor) -> Tensor:
            return torch.tensordot(weight, values, dims=1)

        def never(values: Tensor) -> Tensor:
            """Is it so at no sample of the window?"""
            before = torch.cat([torch.zeros_like(values[:1], dtype=torch.long), values.long().cumsum(0)])
            return before[last] == before[first]

        middle, width, may_be = _hulls(series, first, count)
        A = torch.stack([middle.cos(), middle.sin()], dim=-1) * may_be.unsqueeze(-1)
        u = (series.x[last] - series.x[first]) / T[..., None, None]
        C, d, drift = mean(series.C), mean(series.d), mean(series.drift)
        whole = never(~series.observed) & series.observed[last] & reached.unsqueeze(-1)
        usable = whole & never(~series.usable)
        noise = self.model.noise
        assert noise is not None
        ball = torch.as_tensor(noise.velocity).to(u) + (series.rho[last] + series.rho[first]) / T.unsqueeze(-1)
        corners = theta.vertices()
        if saturation is not None:
            wishes = corners @ series.C.mT + series.d.unsqueeze(-2)
            away = (wishes - (corners @ C.mT + d.unsqueeze(-2)).unsqueeze(2)).norm(dim=-1)
            spread = (weight[..., None, None] * away).sum(2).amax(-1)
            may_clip, idle = _clipping(wishes, saturation, series.drift)
            ball = ball + spread * ~never(may_clip)
            usable = usable & never(idle)
        b = torch.where(may_be, (A * u.unsqueeze(-2)).sum(-1), 1.0)
        nothing = torch.zeros_like(b).flatten(0, 2)
        errors = RowErrors(width.flatten(0, 2), nothing)
        A, b, u, C, d, usable, ball, drift = (v.flatten(0, 2) for v in (A, b, u, C, d, usable, ball, drift))
        no_row = torch.zeros_like(sample.hard)
        corners = corners.expand(len(length), new, *corners.shape).flatten(0, 2)
        return Sample(Halfspaces(A, b), no_row, no_row, u, C, d, usable, nothing, ball, drift, errors, corners), whole


def _hulls(
    series: _Moments, first: Int[Tensor, "L S"], count: Int[Tensor, "L S"]
) -> tuple[Float[Tensor, "L S B m"], Float[Tensor, "L S B m"], Bool[Tensor, "L S B m"]]:
    """The middle and the half width of an interval of angles that holds all directions of a row in a window [rad].

    Directions count where the row may be active, among the `count` samples from `first` on. The mask tells where some
    do. The others have zeros.
    """
    searched = extreme_directions(*map(array, (series.angle, series.half, series.near, first, count)))
    low, high, reference = (torch.from_numpy(part).to(series.angle.device) for part in searched)

    def ahead(samples: Tensor, sign: float) -> Tensor:
        place = samples.clamp(min=0).flatten(0, 1)
        angle, half = (values.gather(0, place).view(samples.shape) for values in (series.angle, series.half))
        return torch.remainder(angle - reference + math.pi, 2 * math.pi) - math.pi + sign * half

    least, greatest, some = ahead(low, -1.0), ahead(high, 1.0), low >= 0
    middle = torch.where(some, reference + (greatest + least) / 2, 0.0)
    return middle, torch.where(some, (greatest - least) / 2, 0.0), some


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
