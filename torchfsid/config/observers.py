"""Prior, bounds on errors and filter, as configuration files give them."""

from __future__ import annotations

import math
import reprlib
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import field_validator, model_validator

from torchfsid.config.documents import Strict, wrong
from torchfsid.config.quantities import Flag, NonNegative, Positive, Vector, as_number, require_box
from torchfsid.errors import ConfigError

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from torchfsid.config.given import GivenPrior
    from torchfsid.observers.ukf import ParameterUkf
    from torchfsid.robots.barriers import Barrier
    from torchfsid.robots.bounds import NoiseBound
    from torchfsid.robots.tasks import Task
    from torchfsid.sets.feasible_set import FeasibleSet


LONG_LOG = 2000
"""Updates of filters, one per robot and sample, beyond which a log takes the compiled filter: about a second's."""

FARTHEST = 1e9
"""The furthest that a prior may reach, in the units of theta. Doubles have 16 digits: from here, sets keep 1e-7."""


class PriorConfig(Strict):
    """The prior set of theta: a box, in the units of theta.

    Attributes:
        lower: the least value of every entry of theta.
        upper: the greatest value of every entry of theta.
    """

    lower: Vector
    upper: Vector

    @model_validator(mode="after")
    def _is_a_box(self) -> PriorConfig:
        require_box(self.lower, self.upper)
        for name, corner in (("lower", self.lower), ("upper", self.upper)):
            if max(map(abs, corner)) > FARTHEST:
                raise wrong(
                    f"expected no number beyond {FARTHEST:g}, because sets in a larger prior lose their digits, "
                    f"got {list(corner)}",
                    name,
                )
        return self

    def build(self, robots: int) -> FeasibleSet:
        """The prior set, once for each robot."""
        from torchfsid.sets.feasible_set import FeasibleSet

        return FeasibleSet.from_box(*self.corners(robots))

    def corners(self, robots: int) -> tuple[Float[Tensor, "robots p"], Float[Tensor, "robots p"]]:
        """The lower and the upper corner of the prior, once for each robot."""
        import torch

        lower, upper = torch.tensor([self.lower, self.upper], dtype=torch.float64)
        return lower.expand(robots, -1), upper.expand(robots, -1)


class _Errors(Strict):
    slack: NonNegative | None = None
    position: NonNegative = 0.0
    neighbour_velocity: NonNegative = 0.0


Bound = float | Literal["auto"]


def _bound_or_auto(value: object, unit: str) -> Bound:
    if value == "auto":
        return "auto"
    bound = as_number(value)
    if not isinstance(bound, int | float) or isinstance(bound, bool) or not 0 <= bound <= sys.float_info.max:
        raise wrong(f"expected a bound of at least 0 {unit} or 'auto', got {reprlib.repr(value)}")
    return float(bound)


class _ObservedErrors(_Errors):
    """Bounds on the errors of a log, where that on controls may be `auto`.

    Attributes:
        quantity: what the controls are; the key of their bound.
        unit: their unit.
    """

    quantity: ClassVar[Literal["velocity", "acceleration"]]
    unit: ClassVar[str]

    @property
    def control(self) -> Bound:
        """The bound on the error of controls."""
        return getattr(self, self.quantity)

    def with_control(self, bound: float) -> _ObservedErrors:
        """The same bounds with another one on the error of controls."""
        return self.model_copy(update={self.quantity: bound})

    def build(self) -> NoiseBound:
        """The `NoiseBound` with these bounds.

        Raises:
            ConfigError: the bound on controls is `auto`. Determine it first, and use `ObserveConfig.with_bound`.
        """
        if self.control == "auto":
            raise ConfigError(f"noise.{self.quantity}: expected a number, got 'auto'")
        return self._built()

    def build_others(self) -> NoiseBound:
        """The same with zero in place of the bound on controls."""
        return self.with_control(0.0)._built()

    def _built(self) -> NoiseBound:
        from torchfsid.robots.bounds import NoiseBound

        assert self.control != "auto"
        others = self.neighbour_velocity
        return NoiseBound(self.control, self.slack, self.position, others, arrival=others)


class ObservedNoiseConfig(_ObservedErrors):
    """`NoiseBound` for a log. With `velocity: auto` the bound on controls is determined from the log itself.

    Attributes:
        velocity: bound on the error of controls [m/s], or `auto`.
        slack: bound on the error of slacks [m/s].
        position: bound on the error of positions [m].
        neighbour_velocity: bound on the error of other bodies' velocities, and of the robots' own before t [m/s].
        heading: bound on the error of the headings of unicycles [rad].
    """

    velocity: Bound
    heading: NonNegative = 0.0
    quantity: ClassVar[Literal["velocity", "acceleration"]] = "velocity"
    unit: ClassVar[str] = "m/s"

    @field_validator("velocity", mode="plain")
    @classmethod
    def _is_bound_or_auto(cls, value: object) -> Bound:
        return _bound_or_auto(value, cls.unit)


class AccelerationNoiseConfig(_ObservedErrors):
    """`NoiseBound` for a log of robots that are driven by accelerations.

    Attributes:
        acceleration: bound on the error of controls [m/s2], or `auto`.
        slack: bound on the error of slacks [m/s2].
        position: bound on the error of positions [m].
        velocity: bound on the error of the measured velocities of all bodies [m/s].
        neighbour_velocity: a larger one for those of other bodies [m/s].
        neighbour_acceleration: bound on the error of other bodies' accelerations, where rows use them [m/s2].
    """

    acceleration: Bound
    velocity: NonNegative = 0.0
    neighbour_acceleration: NonNegative = 0.0
    quantity: ClassVar[Literal["velocity", "acceleration"]] = "acceleration"
    unit: ClassVar[str] = "m/s2"

    @field_validator("acceleration", mode="plain")
    @classmethod
    def _is_bound_or_auto(cls, value: object) -> Bound:
        return _bound_or_auto(value, cls.unit)

    def _built(self) -> NoiseBound:
        from torchfsid.robots.bounds import NoiseBound

        assert self.acceleration != "auto"
        others = max(self.velocity, self.neighbour_velocity)
        pull = self.neighbour_acceleration
        return NoiseBound(self.acceleration, self.slack, self.position, others, pull, arrival=self.velocity)


class UkfConfig(Strict):
    """The unscented Kalman filter on [x; theta], and how the hybrid observer combines it with the set.

    Attributes:
        position_noise: standard deviation of a measured position [m], and of a measured velocity [m/s] of robots that
            are driven by accelerations. R is its square.
        process_noise: standard deviation of theta's drift in one second [units of theta].
        prior_std: standard deviation of theta at the start. Default: that of a uniform distribution over the prior.
        qp_inside: solve the QP inside the filter's dynamics. Otherwise the measurement determines the active rows.
        feedback: the filter goes on from the hybrid observer's projected estimate instead of its own.
        engine: `filterpy`, or `batch`: the same filter in compiled code. Default: `filterpy`, and `batch` for sweeps
            and for logs of more than `LONG_LOG` updates, where it can be used (`for_log`).
    """

    position_noise: Positive = 1e-3
    process_noise: NonNegative = 1e-4
    prior_std: Positive | None = None
    qp_inside: Flag = False
    feedback: Flag = False
    engine: Literal["filterpy", "batch"] | None = None

    def for_log(self, updates: int, is_linear: bool) -> UkfConfig:
        """The configuration with an engine.

        Args:
            updates: the number of samples times that of robots.
            is_linear: whether nominal controls are not clipped.

        Raises:
            ConfigError: the declared engine cannot be used.
        """
        linear = is_linear and not self.qp_inside
        if self.engine == "batch" and not linear:
            reason = "the QP is inside" if self.qp_inside else "nominal controls are clipped"
            raise ConfigError(f"ukf.engine: 'batch' needs a linear model, but {reason} (use 'filterpy')")
        engine = self.engine or ("batch" if linear and updates > LONG_LOG else "filterpy")
        return self.model_copy(update={"engine": engine})

    def spread(self, prior: PriorConfig) -> tuple[float, ...]:
        """Standard deviations of theta at the start, one per entry of theta."""
        if self.prior_std is not None:
            return (self.prior_std,) * len(prior.lower)
        return tuple((high - low) / math.sqrt(12) for low, high in zip(prior.lower, prior.upper, strict=True))

    def build(
        self,
        task: Task,
        barriers: Sequence[Barrier],
        prior: PriorConfig | GivenPrior,
        robots: int,
        active_tolerance: float,
    ) -> ParameterUkf:
        """The filter of this number of robots. It starts from the centre of the prior."""
        import torch

        from torchfsid.observers.ukf import ParameterUkf

        lower, upper = prior.corners(robots)
        return ParameterUkf(
            task,
            barriers,
            mean=(lower + upper) / 2,
            spread=torch.full_like(lower, self.prior_std) if self.prior_std else (upper - lower) / math.sqrt(12),
            position_noise=self.position_noise,
            process_noise=self.process_noise,
            active_tolerance=active_tolerance,
            qp_inside=self.qp_inside,
            engine=self.engine or "filterpy",
        )
