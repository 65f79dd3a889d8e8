r"""What one measurement says about theta, for B robots at once.

    rows A u <= b, task (C, d), control u  ->  slacks  ->  active rows  ->  KKT conditions  ->  half-spaces of theta

A sample is used where the model could be evaluated and no hard row is violated by more than its bound. In the plane,
where no gradient is needed, `reading_kernel` does all of it in compiled code.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.halfspaces import Halfspaces, array, finite
from torchfsid.identification.active_set import active_set
from torchfsid.identification.critical_region import FAN as CRITICAL_FAN
from torchfsid.identification.critical_region import critical_region
from torchfsid.identification.inverse_optimal import FAN, SPREAD, inverse_optimal_set, per_row
from torchfsid.identification.kkt import KktSolution, solve_kkt
from torchfsid.kernels.compiled import use_kernel
from torchfsid.robots.bounds import NoiseBound, Uncertainty
from torchfsid.robots.tasks import Saturation
from torchfsid.tolerances import ANGLE_TOLERANCE, RANK_TOLERANCE, ROUND_OFF

SetKind = Literal["critical_region", "inverse_optimal"]

_SPREAD = np.array(SPREAD)
_AROUND = {
    kind: np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    for kind, turn in (
        ("critical_region", np.linspace(0.0, 2 * np.pi, CRITICAL_FAN)),
        ("inverse_optimal", np.linspace(0.0, 2 * np.pi, FAN)),
    )
}


class Model(NamedTuple):
    """The declared model at one instant; NaN and infinite where it could not be evaluated.

    Attributes:
        safe_controls: the rows. hard: those that no controller may violate.
        C, d: the task. saturation, possible: see `inverse_optimal_set`.
    """

    safe_controls: Halfspaces
    hard: Bool[Tensor, "m"]
    C: Float[Tensor, "B n p"]
    d: Float[Tensor, "B n"]
    saturation: Saturation | None
    possible: Float[Tensor, "B v n"] | None


class Bounds(NamedTuple):
    """What may be off: the declared bounds, what errors of positions come to, and when a row counts as active [m/s]."""

    noise: NoiseBound | None
    uncertainty: Uncertainty | None
    active_tolerance: float

    def slack(self, like: Tensor) -> Tensor:
        """How far from its boundary an active row may be measured [m/s], broadcasting with slacks (B, m)."""
        bound = per_row(self.active_tolerance if self.noise is None else self.noise.slack, like)
        return bound if self.uncertainty is None else bound + self.uncertainty.slack

    def ball(self, like: Tensor) -> Tensor:
        """The error of C theta + d - u [m/s], broadcasting with (B,)."""
        bound = torch.as_tensor(
            0.0 if self.noise is None else self.noise.velocity, dtype=like.dtype, device=like.device
        )
        return bound if self.uncertainty is None else bound + self.uncertainty.velocity + self.uncertainty.drift

    def tensors(self) -> list[Tensor]:
        noise = () if self.noise is None else (self.noise.velocity, self.noise.slack)
        return [bound for bound in (*noise, *(self.uncertainty or ())) if isinstance(bound, Tensor)]


class Reading(NamedTuple):
    """What one measurement says by itself.

    Attributes:
        omega: half-spaces of theta; padding where the sample is not used.
        kkt: u* = G theta + f at the observed active set.
        informative: the sample is used. alarmed: it is not, because a hard row is violated beyond its bound.
        safe_controls, C, d: the model at this measurement, zeros where it could not be evaluated.
        slack: of the measured control to every row [m/s]. excess: its violation beyond the bound, positive if there is
            any [m/s]. hard: the rows that no controller may violate.
    """

    omega: Halfspaces
    kkt: KktSolution
    informative: Bool[Tensor, "B"]
    alarmed: Bool[Tensor, "B"]
    safe_controls: Halfspaces
    C: Float[Tensor, "B n p"]
    d: Float[Tensor, "B n"]
    slack: Float[Tensor, "B m"]
    excess: Float[Tensor, "B m"]
    hard: Bool[Tensor, "m"]


def read(
    kind: SetKind,
    model: Model,
    u: Float[Tensor, "B n"],
    usable: Bool[Tensor, "B"],
    bounds: Bounds,
    compiled: bool | None = None,
) -> Reading:
    """What a measurement says about theta. `usable` marks the robots that were measured under control; `compiled`:
    see `use_kernel`, for planar u and theta without saturation only.

    Raises:
        InputError: `compiled` is True and cannot be.
    """
    rows, C, d = model.safe_controls, model.C, model.d
    planar = rows.dim == C.shape[-1] == 2 and model.saturation is None
    if planar and use_kernel(compiled, rows.A, rows.b, C, d, u, *bounds.tensors()):
        return _read_compiled(kind, model, u, usable, bounds)
    if not finite(rows.A, rows.b, C, d):
        rows, C, d, known = _evaluated(rows, C, d)
        usable = usable & known
    slack = rows.slack(u)
    excess = -slack - bounds.slack(slack) - rows.round_off(u)
    alarmed = usable & ((excess > 0) & model.hard).any(-1)
    informative = usable & ~alarmed
    active = active_set(rows, u, bounds.active_tolerance)
    kkt = solve_kkt(rows, active, C, d)
    if kind == "critical_region":
        omega = critical_region(rows, active, C, d)
    else:
        assert bounds.noise is not None
        omega = inverse_optimal_set(
            rows, u, C, d, bounds.noise,
            uncertainty=bounds.uncertainty, saturation=model.saturation, possible=model.possible,
        )  # fmt: skip
    omega = omega.where(informative.unsqueeze(-1))
    return Reading(omega, kkt, informative, alarmed, rows, C, d, slack, excess, model.hard)


def _read_compiled(kind: SetKind, model: Model, u: Tensor, usable: Bool[Tensor, "B"], bounds: Bounds) -> Reading:
    from torchfsid.kernels import evidence as reading_kernel

    paper, rows, C, d = kind == "critical_region", model.safe_controls, model.C, model.d
    angles = u[:, :0] if paper or bounds.uncertainty is None else bounds.uncertainty.angle
    tensors = (
        rows.A, rows.b, model.hard, C, d, u, usable,
        torch.atleast_2d(bounds.slack(u)), angles, torch.atleast_1d(bounds.ball(u)),
    )  # fmt: skip
    tolerances = bounds.active_tolerance, ROUND_OFF, RANK_TOLERANCE, ANGLE_TOLERANCE
    arguments: tuple[Any, ...] = (*map(array, tensors), _SPREAD, _AROUND[kind], paper, *tolerances)
    omega, judged, kkt, evaluated = reading_kernel.read(*arguments)
    if not evaluated:
        rows, C, d, _ = _evaluated(rows, C, d)
    informative, alarmed, slack, excess = map(torch.from_numpy, judged)
    omega, kkt = Halfspaces(*map(torch.from_numpy, omega)), KktSolution(*map(torch.from_numpy, kkt))
    return Reading(omega, kkt, informative, alarmed, rows, C, d, slack, excess, model.hard)


def _evaluated(rows: Halfspaces, C: Tensor, d: Tensor) -> tuple[Halfspaces, Tensor, Tensor, Bool[Tensor, "B"]]:
    """Padding and zeros in place of what could not be evaluated, and which robots' models could be as a whole."""
    are_known = rows.b.isfinite() & rows.A.isfinite().all(-1)
    wish_known = C.isfinite().all(-1).all(-1) & d.isfinite().all(-1)
    C, d = torch.where(wish_known[:, None, None], C, 0.0), torch.where(wish_known[:, None], d, 0.0)
    return rows.where(are_known), C, d, are_known.all(-1) & wish_known
