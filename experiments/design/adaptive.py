r"""A point-wise adaptive observer that stays in the set of possible parameters, with the gain as a part of its own.

    theta+ = Proj_Theta( theta + Gamma G'(u - G theta - f) )         (G, f: u* = G theta + f at the observed active set)

The projection is `torchfsid.layers.ProjectOnto`, so whatever the gain is made of can be trained through it. Gains:

    ConstantGain    Gamma = g/kp^2 I, g a parameter
    RlsGain         recursive least squares: Lambda+ = Lambda + G'G/R, Gamma = (Lambda+)^-1/R, Lambda_0 the prior's
                    information and R = delta^2/4 the variance, along an axis, of a disturbance even in a disc
    NetworkGain     the same with Lambda+ = r Lambda + G'G/(s R), Gamma = (Lambda+)^-1/(s R); the distrust s > 0 of this
                    sample and the memory 0 < r < 1 are a network's answer to how large Theta is, the case, the noise

Gamma G' = P G'(G P G' + R I)^-1 with P = Lambda^-1: the second is the Kalman gain, in its information form.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchfsid.halfspaces import Halfspaces
from torchfsid.kkt import CASES
from torchfsid.layers import ProjectOnto

FORGETS_LITTLE = 7.0
"""The network's memory before training: r = exp(-softplus(-7)) = 0.999."""


class Step(NamedTuple):
    """What an instant says about B robots.

    Attributes:
        theta_set: Theta(t). area: its area [m^2]. case: index into `CASES`.
        G, f: of the observed active set. u: measured [m/s]. noise: bound of its disturbance [m/s].
    """

    theta_set: Halfspaces
    area: Float[Tensor, "B"]
    case: Int[Tensor, "B"]
    G: Float[Tensor, "B 2 2"]
    f: Float[Tensor, "B 2"]
    u: Float[Tensor, "B 2"]
    noise: float


class Gain(Protocol):
    """Gamma (B, 2, 2), and the information matrix (B, 2, 2) that is carried on."""

    def __call__(self, step: Step, information: Tensor) -> tuple[Tensor, Tensor]: ...


class ConstantGain(nn.Module):
    """Gamma = `share`/kp^2 I."""

    def __init__(self, share: float, kp: float):
        super().__init__()
        self.log_share = nn.Parameter(torch.tensor(math.log(share), dtype=torch.float64))
        self.kp = kp

    def forward(self, step: Step, information: Tensor) -> tuple[Tensor, Tensor]:
        identity = torch.eye(2, dtype=torch.float64).expand_as(information)
        return self.log_share.exp() / self.kp**2 * identity, information


class RlsGain(nn.Module):
    """Recursive least squares with the noise as it is declared."""

    def forward(self, step: Step, information: Tensor) -> tuple[Tensor, Tensor]:
        R = step.noise**2 / 4
        information = information + step.G.mT @ step.G / R
        return _inverse(information) / R, information


class NetworkGain(nn.Module):
    """Recursive least squares, with distrust and memory from a network; before training nearly `RlsGain`.

    Attributes:
        prior_area: [m^2], the unit of areas. speed: [m/s], the unit of noise.
    """

    def __init__(self, hidden: int, prior_area: float, speed: float):
        super().__init__()
        self.prior_area, self.speed = prior_area, speed
        self.inner = nn.Linear(2 + len(CASES), hidden, dtype=torch.float64)
        self.outer = nn.Linear(hidden, 2, dtype=torch.float64)
        nn.init.zeros_(self.outer.weight)
        with torch.no_grad():
            self.outer.bias.copy_(torch.tensor([0.0, FORGETS_LITTLE]))

    def answer(self, area: Tensor, case: Tensor, noise: float) -> tuple[Tensor, Tensor]:
        """Distrust s and memory r."""
        level = torch.full_like(area, math.log(noise / self.speed) / 5)
        sizes = torch.stack([(area / self.prior_area).log() / 10, level], dim=-1)
        cases = nn.functional.one_hot(case, len(CASES)).to(torch.float64)
        distrust, memory = self.outer(torch.tanh(self.inner(torch.cat([sizes, cases], dim=-1)))).unbind(-1)
        return distrust.exp(), (-nn.functional.softplus(-memory)).exp()

    def forward(self, step: Step, information: Tensor) -> tuple[Tensor, Tensor]:
        distrust, memory = self.answer(step.area, step.case, step.noise)
        R = (distrust * step.noise**2 / 4)[:, None, None]
        information = memory[:, None, None] * information + step.G.mT @ step.G / R
        return _inverse(information) / R, information


class AdaptiveObserver(nn.Module):
    """theta+ = Proj_Theta(theta + Gamma G'(u - G theta - f)), over a whole recording.

    Attributes:
        gain: Gamma. project: onto Theta(t); None: not at all.
    """

    def __init__(self, gain: nn.Module, projects: bool = True):
        super().__init__()
        self.gain = gain
        self.project = ProjectOnto() if projects else None

    def forward(
        self, steps: list[Step], theta: Float[Tensor, "B 2"], information: Float[Tensor, "B 2 2"]
    ) -> Float[Tensor, "T B 2"]:
        """The estimates after each sample, from a first estimate and its information matrix (inverse covariance)."""
        estimates = []
        for step in steps:
            Gamma, information = self.gain(step, information)
            innovation = step.u - _times(step.G, theta) - step.f
            theta = theta + _times(Gamma, _times(step.G.mT, innovation))
            if self.project is not None:
                theta = self.project(step.theta_set, theta).point
            estimates.append(theta)
        return torch.stack(estimates)


def _times(M: Float[Tensor, "B 2 2"], v: Float[Tensor, "B 2"]) -> Float[Tensor, "B 2"]:
    return (M @ v.unsqueeze(-1)).squeeze(-1)


def _inverse(M: Float[Tensor, "B 2 2"]) -> Float[Tensor, "B 2 2"]:
    (a, b), (c, d) = M[:, 0].unbind(-1), M[:, 1].unbind(-1)
    adjugate = torch.stack([torch.stack([d, -b], dim=-1), torch.stack([-c, a], dim=-1)], dim=1)
    return adjugate / (a * d - b * c)[:, None, None]
