r"""A point estimator to compare the sets with: an unscented Kalman filter on [x; theta] (G., Secs. II-A, VII).

    x(t + dt) = x(t) + dt (G theta + f) + w_x,   theta(t + dt) = theta(t) + w_theta,   z = x + v

Of robots of second order, whose controls are accelerations, x is the measured velocity: it is what the control changes.
Their positions follow from it and say nothing more of theta.

Between two measurements the robot moves with the (G, f) of the active set observed at the earlier one. So the model is
linear, and the filter is a Kalman filter. While two independent rows are active, G = 0 and the filter learns nothing.
With `qp_inside` the velocity is instead the solution of the safety QP at each sigma point. The active rows then depend
on theta, and the filter learns earlier. Its covariance is a local one and far too small.

Failures of the data are reported as a status and raise nothing:
    - a robot was not seen, or its motion after a measurement is unknown (a neighbour's velocity is not known, a row is
      violated, the controller failed). The next position then says nothing about theta. The filter's position starts
      again from it, theta's mean stays, and its covariance grows by the drift. The last (G, f) is not held, since that
      motion was not observed;
    - the covariance is no longer positive definite (round-off). Its eigenvalues, in units of prior and position noise,
      are raised to `definite.DEFINITE` times the largest. The covariance only grows by this;
    - the filter fails (an overflow, a covariance that cannot be factored). It starts again from its prior.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter, unscented_transform
from jaxtyping import Float
from torch import Tensor

from torchfsid.errors import InputError, SolverError
from torchfsid.kernels.kalman import advance
from torchfsid.observers.blocks import times_of
from torchfsid.observers.definite import FLOOR, make_definite
from torchfsid.observers.motions import Array, Motion, Motions, ObservedMotion, read_motions
from torchfsid.observers.ukf_estimates import UkfEstimate, UkfEstimates
from torchfsid.outcome import Status
from torchfsid.robots.arguments import require_barriers, require_task
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Task
from torchfsid.tolerances import ACTIVE_TOLERANCE

FAILURES = (np.linalg.LinAlgError, ArithmeticError, ValueError)
"""What numpy, scipy and filterpy raise for numbers they cannot work with."""

FARTHEST = 1e100
"""A position beyond this is no measurement [m]: its square would overflow."""

SIGMA_POINTS = {"alpha": 1.0, "beta": 2.0, "kappa": 0.0}
"""No weight is negative, so that a prediction stays positive definite; alpha < 0.1 loses digits to cancellation."""


Engine = Literal["filterpy", "batch"]


@dataclass
class ParameterUkf:
    """One unscented Kalman filter on [x; theta] for each of B robots that share a task and barriers.

    Attributes:
        task: the task of all robots.
        barriers: the barriers of all robots.
        mean: theta's prior mean.
        spread: standard deviation of theta's prior: one number, one per parameter, or one per robot and parameter.
        position_noise: standard deviation of a measured position [m], of robots of second order of a measured velocity
            [m/s]; R is its square.
        process_noise: standard deviation of theta's drift [units of theta per sqrt(s)].
        motion_noise: standard deviation of the error of the model's motion [m/sqrt(s)]. At a step of 0.02 s the default
            allows for an error of the velocity of 7e-3 m/s, which is usual for inexact solvers.
        active_tolerance: the slack below which a row counts as active [m/s]. The motion is unknown if a row is violated
            by more than this.
        qp_inside: whether to solve the QP at every sigma point.
        engine: `filterpy`, or `batch`: the same filter for all robots at once in compiled code (`kernels.kalman`), for
            long logs. Its numbers are those of filterpy up to round-off. It needs a linear model: no QP inside, and
            nominal controls that are not clipped. filterpy still repairs covariances.
        filters: filterpy's filter for each robot; None while its position or its motion is not known.

    Raises:
        InputError: `mean` is not (B, p), `spread` does not fit it, a spread or noise is not positive (drift and motion
            noise may be zero), or `engine` is `batch` and the model not linear.
    """

    task: Task
    barriers: Sequence[Barrier]
    mean: Float[Tensor, "B p"]
    spread: float | Float[Tensor, "*robots p"]
    position_noise: float = 1e-3
    process_noise: float = 1e-4
    motion_noise: float = 1e-3
    active_tolerance: float = ACTIVE_TOLERANCE
    qp_inside: bool = False
    engine: Engine = "filterpy"
    filters: list[UnscentedKalmanFilter | None] = field(init=False)

    def __post_init__(self) -> None:
        require_task(self.task)
        require_barriers(self.barriers)
        p = len(self.task.parameter_names)
        if self.mean.ndim != 2 or self.mean.shape[-1] != p or not bool(self.mean.isfinite().all()):
            raise InputError("mean", f"finite means (B, {p})", self.mean)
        spread = torch.as_tensor(self.spread, dtype=torch.float64).detach()
        if not bool((spread > 0).all() & spread.isfinite().all()):
            raise InputError("spread", "positive standard deviations", self.spread)
        try:
            self._scale = spread.expand(self.mean.shape).numpy()
        except RuntimeError as error:
            raise InputError("spread", f"a shape that fits {tuple(self.mean.shape)}", tuple(spread.shape)) from error
        noises = (self.position_noise, self.process_noise, self.motion_noise, self.active_tolerance)
        positive = self.position_noise > 0 and self.active_tolerance > 0
        if not (positive and min(noises) >= 0 and math.isfinite(sum(noises))):
            raise InputError("noises", "position_noise > 0, active_tolerance > 0, the others >= 0", noises)
        if self.engine == "batch" and (self.qp_inside or self.task.saturation is not None):
            raise InputError("engine", "filterpy, since the model is not linear", self.engine)
        with np.errstate(over="ignore"):  # a spread whose square overflows: such a filter fails, later
            variances = self._scale[:, :, None] ** 2
        self._prior = self.mean.detach().to(torch.float64).numpy(), np.where(np.eye(p) > 0, variances, 0.0)
        self._theta, self._covariance = (values.copy() for values in self._prior)
        self.filters = [None] * len(self.mean)
        self._motions: list[Motion | None] = [None] * len(self.mean)
        self._t = -math.inf

    @classmethod
    def from_prior(
        cls,
        task: Task,
        barriers: Sequence[Barrier],
        lower: Float[Tensor, "B p"],
        upper: Float[Tensor, "B p"],
        **settings: Any,
    ) -> ParameterUkf:
        """Start from a prior box: its centre, and the standard deviation of a uniform distribution, width/sqrt(12)."""
        lower, upper = lower.to(torch.float64), upper.to(torch.float64)
        spread = upper / math.sqrt(12) - lower / math.sqrt(12)  # no overflow on the way
        return cls(task, barriers, lower / 2 + upper / 2, spread, **settings)

    def update(self, measurement: Measurement) -> UkfEstimate:
        """Take in one measurement of all robots.

        Raises:
            InputError: the measurement has no velocities or another batch, or its time does not increase.
        """
        self._require(measurement, len(measurement.x) == len(self.mean))
        return self.read(measurement)[0]

    def read(self, samples: Measurement) -> UkfEstimates:
        """Take in several measurements of all robots, concatenated in the order of time.

        Raises:
            InputError: see `update`.
        """
        robots = len(self.mean)
        self._require(samples, samples.u is not None)
        times = times_of(samples, robots)
        since = torch.cat([times.new_tensor([self._t]), times])
        late = ~(times.isfinite() & (since.diff() > 0))
        if bool(late.any()):
            raise InputError("measurement.t", f"a time after {float(since[:-1][late][0])}", float(times[late][0]))
        with torch.no_grad():
            motions = read_motions(self.task, self.barriers, samples, self.active_tolerance, self.qp_inside)
        state = samples.velocity if samples.is_second_order else samples.x
        if state is None:
            raise InputError("measurement.velocity", "the velocities of the robots, of second order", None)
        seen = (state.abs() < FARTHEST).all(-1)
        if samples.observed is not None:
            seen = seen & samples.observed

        shape = len(times), robots
        steps = since.diff().nan_to_num(posinf=0.0).numpy()
        x, seen = state.detach().to(torch.float64).numpy().reshape(*shape, -1), seen.numpy().reshape(shape)
        take_in = self._in_batch if self.engine == "batch" else self._in_turn
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            theta, covariance, status = map(torch.from_numpy, take_in(steps, x, seen, motions))
        self._t = float(times[-1])
        return UkfEstimates(times, theta, covariance, status)

    def _require(self, samples: Measurement, fits: bool) -> None:
        if samples.u is None or samples.x.ndim != 2 or not fits:
            expected = f"positions and velocities ({len(self.mean)}, n)"
            raise InputError("measurement", expected, tuple(samples.x.shape))

    def _in_turn(self, steps: Array, x: Array, seen: Array, motions: Motions) -> tuple[Array, Array, Array]:
        """Thetas, covariances and statuses after each sample, by filterpy."""
        robots, theta, covariance, statuses = len(self.mean), [], [], []
        for s, dt in enumerate(steps):
            statuses.append([self._update_robot(i, dt, x[s, i] if seen[s, i] else None) for i in range(robots)])
            self._motions = [motions[s * robots + i] for i in range(robots)]
            now = zip(self.filters, self._motions, strict=True)
            self.filters = [kalman if motion else None for kalman, motion in now]
            theta.append(self._theta.copy())
            covariance.append(self._covariance.copy())
        return np.stack(theta), np.stack(covariance), np.array(statuses, dtype=np.int64)

    def _in_batch(self, steps: Array, x: Array, seen: Array, motions: Motions) -> tuple[Array, Array, Array]:
        """The same by compiled code. filterpy takes in the samples at which that stops."""
        (samples, robots, n), p = x.shape, self._theta.shape[-1]
        known = motions.known.numpy().reshape(samples, robots)
        G, f = (part.numpy().reshape(samples, robots, *part.shape[1:]) for part in motions.linear)
        moved, G, f = (np.concatenate([now[:1], now[:-1]]) for now in (known, G, f))  # since the sample before
        for i, motion in enumerate(self._motions):
            moved[0, i] = motion is not None
            if isinstance(motion, ObservedMotion):
                G[0, i], f[0, i] = motion.linear
        running = np.array([kalman is not None for kalman in self.filters])
        mean, P = np.zeros((robots, n + p)), np.zeros((robots, n + p, n + p))
        for i, kalman in enumerate(self.filters):
            if kalman is not None:
                mean[i], P[i] = kalman.x, kalman.P
        state = running, mean, P, self._theta, self._covariance
        inputs = steps, x, seen, moved, known, G, f, self.position_noise**2, *self._noises(steps)
        theta, covariance = np.empty((samples, robots, p)), np.empty((samples, robots, p, p))
        status, start = np.empty((samples, robots), dtype=np.int64), np.zeros(robots, dtype=np.int64)
        while (start < samples).any():
            start = advance(start, *state, *inputs, theta, covariance, status)
            for i in np.flatnonzero(start < samples).tolist():
                s = int(start[i])
                kalman = self.filters[i] = self._start(i, x[s, i])
                kalman.x, kalman.P = mean[i].copy(), P[i].copy()
                self._motions[i] = motions[(s - 1) * robots + i] if s > 0 else self._motions[i]
                status[s, i] = self._update_robot(i, float(steps[s]), x[s, i])
                kalman = self.filters[i]
                assert kalman is not None
                mean[i], P[i], running[i] = kalman.x, kalman.P, known[s, i]
                theta[s, i], covariance[s, i] = self._theta[i], self._covariance[i]
                start[i] = s + 1
        self._motions = [motions[len(motions.known) - robots + i] for i in range(robots)]
        self.filters = [self._start(i, mean[i, :n]) if running[i] else None for i in range(robots)]
        for i, kalman in enumerate(self.filters):
            if kalman is not None:
                kalman.x, kalman.P = mean[i].copy(), P[i].copy()
        return theta, covariance, status

    def _noises(self, steps: Array) -> tuple[Array, Array]:
        """Variances of the motion's error (S,) and of theta's drift (S, B, p) in these times."""
        walk = np.maximum(self.motion_noise**2 * steps, (FLOOR * self.position_noise) ** 2)
        return walk, np.maximum(self.process_noise**2 * steps[:, None, None], (FLOOR * self._scale) ** 2)

    def correct(self, theta: Float[Tensor, "B p"]) -> None:
        """Replace the means of theta, keep the covariances.

        The position changes as far as it is correlated with theta. The new state is the nearest one with this theta, in
        the metric of the whole covariance.

        Raises:
            InputError: `theta` is not finite or not (B, p).
        """
        if theta.shape != self.mean.shape or not bool(theta.isfinite().all()):
            raise InputError("theta", f"finite parameters {tuple(self.mean.shape)}", theta)
        corrected = theta.detach().to(torch.float64).numpy().copy()
        for i, kalman in enumerate(self.filters):
            if kalman is not None:
                n = len(kalman.x) - theta.shape[-1]
                try:
                    change = np.linalg.solve(kalman.P[n:, n:], corrected[i] - kalman.x[n:])
                except FAILURES:  # the position starts afresh
                    self.filters[i] = None
                else:
                    kalman.x = np.concatenate([kalman.x[:n] + kalman.P[:n, n:] @ change, corrected[i]])
        self._theta = corrected

    def _update_robot(self, i: int, dt: float, position: Array | None) -> Status:
        """Bring robot i's filter, mean and covariance to the time of the measurement."""
        kalman, motion = self.filters[i], self._motions[i]
        (walk,), drift = self._noises(np.array([dt]))
        drift = drift[0, i]
        if kalman is not None and motion is not None and position is not None:
            n = len(position)
            kalman.Q = np.diag(np.concatenate([np.full(n, walk), drift]))
            scale = np.concatenate([np.full(n, self.position_noise), self._scale[i]])
            try:
                repaired = _advance(kalman, dt, motion, position, scale)
            except SolverError:
                pass  # the QP at some sigma point: the motion is not known after all
            except FAILURES:
                return self._restart(i, position)
            else:
                if not (np.isfinite(kalman.x).all() and np.isfinite(kalman.P).all()):
                    return self._restart(i, position)
                self._theta[i], self._covariance[i] = kalman.x[n:], kalman.P[n:, n:]
                return Status.REPAIRED if repaired else Status.OK
        if dt > 0:
            self._covariance[i] += np.diag(drift)
        self.filters[i] = None if position is None else self._start(i, position)
        return Status.PREDICTED

    def _restart(self, i: int, position: Array) -> Status:
        """Start robot i's filter again from its prior."""
        mean, covariance = self._prior
        self._theta[i], self._covariance[i] = mean[i], covariance[i]
        self.filters[i] = self._start(i, position)
        return Status.FAILED

    def _start(self, i: int, position: Array) -> UnscentedKalmanFilter:
        """A filter at a first measured position, with the current mean and covariance of theta."""
        n, p = len(position), self._theta.shape[-1]
        points = MerweScaledSigmaPoints(n + p, **SIGMA_POINTS)
        kalman = _Filter(n + p, n, dt=math.nan, hx=_position, fx=_move, points=points)
        kalman.x = np.concatenate([position, self._theta[i]])
        kalman.R = np.eye(n) * self.position_noise**2
        kalman.P = np.zeros((n + p, n + p))
        kalman.P[:n, :n], kalman.P[n:, n:] = kalman.R, self._covariance[i]
        return kalman


# The functions given to filterpy. They belong to the module and are no closures, so that an observer can be pickled.


class _Filter(UnscentedKalmanFilter):
    """filterpy's filter, with `fx` called once for all sigma points: a batch of QPs instead of one after the other."""

    def compute_process_sigmas(self, dt: float, fx: Callable[..., Array] | None = None, **fx_args: Any) -> None:
        self.sigmas_f = (fx or self.fx)(self.points_fn.sigma_points(self.x, self.P), dt, **fx_args)


def _move(states: Array, dt: float, motion: Motion, n: int) -> Array:
    return np.concatenate([states[:, :n] + dt * motion(states[:, n:]), states[:, n:]], axis=1)


def _position(state: Array, n: int) -> Array:
    return state[:n]


def _advance(kalman: UnscentedKalmanFilter, dt: float, motion: Motion, position: Array, scale: Array) -> bool:
    """Predict and update. The covariance is made definite before its square root. Returns whether it was repaired."""
    n, repairs = len(position), []

    def definite(covariance: Array) -> Array:
        made, repaired = make_definite(covariance, scale)
        repairs.append(repaired)
        return made

    def transform(*arguments: Any) -> tuple[Array, Array]:
        mean, covariance = unscented_transform(*arguments)
        return mean, definite(covariance)

    kalman.P = definite(kalman.P)
    kalman.predict(dt, UT=transform, motion=motion, n=n)
    kalman.update(position, n=n)
    kalman.P = definite(kalman.P)
    return any(repairs)
