"""The control of a robot as a function of theta, from one measurement on. The filter predicts with it.

Motions are records, not closures, so that an observer can be pickled. They take an array of S parameters (S, p) and
return an array of S controls (S, n).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.active_set import active_set
from torchfsid.identification.kkt import solve_kkt
from torchfsid.robots.barriers import Barrier, controller_failed, stack_barriers
from torchfsid.robots.controller import solve_safe_qp
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Saturation, Task, feedback_of

Array = np.ndarray
Motion = Callable[[Array], Array]
"""Controls (S, n) as a function of parameters (S, p)."""


@dataclass(frozen=True)
class Wish:
    """The nominal control uhat = clip(C theta + d) + feedback (`Task`)."""

    C: Float[Tensor, "*k n p"]
    d: Float[Tensor, "*k n"]
    feedback: Float[Tensor, "*k n"]
    clip: Saturation | None

    def __call__(self, theta: Array) -> Float[Tensor, "s n"]:
        wish = torch.from_numpy(theta) @ self.C.T + self.d
        return (wish if self.clip is None else self.clip(wish)) + self.feedback


@dataclass(frozen=True)
class ObservedMotion:
    """The motion u = (I - P) uhat + A_a^+ b_a, which is G theta + f where nothing is clipped."""

    wish: Wish
    free: Float[Tensor, "n n"]
    offset: Float[Tensor, "n"]

    def __call__(self, theta: Array) -> Array:
        return (self.wish(theta) @ self.free.T + self.offset).numpy()

    @property
    def linear(self) -> tuple[Array, Array]:
        """(G, f) of u = G theta + f, where the nominal control is not clipped."""
        return (self.free @ self.wish.C).numpy(), (self.free @ (self.wish.d + self.wish.feedback) + self.offset).numpy()


@dataclass(frozen=True)
class QpMotion:
    """The motion u = argmin |u - uhat|^2 over the safe controls. It is zero where there are none."""

    wish: Wish
    safe_controls: Halfspaces

    def __call__(self, theta: Array) -> Array:
        return solve_safe_qp(self.safe_controls, self.wish(theta)).u.numpy()


@dataclass(frozen=True)
class Motions:
    """The motions of k robots.

    Attributes:
        known: whether the motion is known.
        wish: the nominal controls, batch (k,).
        free: I - P of `KktSolution`, or None with the QP inside.
        offset: the offset of `KktSolution`, or None with the QP inside.
        safe_controls: the rows of the QP.
    """

    known: Bool[Tensor, "k"]
    wish: Wish
    free: Float[Tensor, "k n n"] | None
    offset: Float[Tensor, "k n"] | None
    safe_controls: Halfspaces

    def __getitem__(self, k: int) -> Motion | None:
        """The motion of robot k. None if it is unknown."""
        if not self.known[k]:
            return None
        wish = Wish(self.wish.C[k], self.wish.d[k], self.wish.feedback[k], self.wish.clip)
        if self.free is None or self.offset is None:
            return QpMotion(wish, Halfspaces(self.safe_controls.A[k], self.safe_controls.b[k]))
        return ObservedMotion(wish, self.free[k], self.offset[k])

    @property
    def linear(self) -> tuple[Float[Tensor, "k n p"], Float[Tensor, "k n"]]:
        """(G, f) of u = G theta + f, where the nominal controls are not clipped."""
        assert self.free is not None
        assert self.offset is not None
        wish = self.wish.d + self.wish.feedback
        return self.free @ self.wish.C, (self.free @ wish.unsqueeze(-1)).squeeze(-1) + self.offset


def read_motions(
    task: Task, barriers: Sequence[Barrier], measurement: Measurement, active_tolerance: float, qp_inside: bool
) -> Motions:
    """The motions of all robots from a measurement on, as functions of theta.

    Args:
        task: the task of all robots.
        barriers: the barriers of all robots.
        measurement: the measurement, or several concatenated.
        active_tolerance: the slack below which a row counts as active [units of the control]. The motion is unknown if
            a row is violated by more than this.
        qp_inside: whether the motion solves the QP, instead of keeping the active rows.
    """
    assert measurement.u is not None
    rows = stack_barriers(barriers, measurement)
    C, d = task(measurement)
    finite = [rows.A.flatten(1), rows.b, C.flatten(1), d, measurement.u]
    known = torch.stack([values.isfinite().all(-1) for values in finite]).all(0)
    if measurement.observed is not None:
        known = known & measurement.observed
    safe_controls = rows.where(known.unsqueeze(-1))
    C = torch.where(known[:, None, None], C, 0.0).to(torch.float64)
    d = torch.where(known[:, None], d, 0.0).to(torch.float64)
    u = torch.where(known[:, None], measurement.u, 0.0).to(torch.float64)
    slack = safe_controls.slack(u)
    failed = controller_failed(barriers, measurement, safe_controls)
    known = known & ~failed & (slack >= -active_tolerance).all(-1)
    feedback = feedback_of(task, measurement)
    feedback = torch.zeros_like(u) if feedback is None else torch.where(known[:, None], feedback, 0.0)
    wish = Wish(C, d, feedback, task.saturation)
    if qp_inside:
        return Motions(known, wish, None, None, safe_controls)
    kkt = solve_kkt(safe_controls, active_set(safe_controls, u, active_tolerance), C, d)
    return Motions(known, wish, kkt.free, kkt.offset, safe_controls)
