r"""A point-wise adaptive observer that stays in the set Theta of possible parameters. Its gain is exchangeable.

    theta+ = Proj_Theta( theta + Gamma G'(u - G theta - f) )         (G, f: u* = G theta + f at the observed active set)

The projection is `torchfsid.layers.ProjectOnto`, so every gain can be trained through it. Gains:

    ConstantGain    Gamma = g/kp^2 I, g a parameter
    RlsGain         recursive least squares: Lambda+ = Lambda + G'G/R, Gamma = (Lambda+)^-1/R, Lambda_0 the prior's
                    information and R = delta^2/4 the variance, along an axis, of a disturbance even in a disc
    NetworkGain     the same with Lambda+ = r Lambda + G'G/(s R), Gamma = (Lambda+)^-1/(s R); a network computes the
                    distrust s > 0 of this sample and the memory 0 < r < 1 from the area of Theta, the case, the noise

No gain moves the estimate while G = 0, or along the row of case B. There only the set gains information. A gain with a
`pull` a then moves the projected estimate towards the centroid c of Theta: theta+ + a (c - theta+), 0 < a < 1. The
result is in Theta because Theta is convex.

Gamma G' = P G'(G P G' + R I)^-1 with P = Lambda^-1. The right-hand side is the Kalman gain, Gamma its information form.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.kkt import CASES
from torchfsid.programmes.differentiable import times
from torchfsid.programmes.layers import ProjectOnto

UNTRAINED = (0.0, 7.0, -3.0)
"""What the network puts out before training: s = 1, r = 0.999, a = 0.05."""


class Step(NamedTuple):
    """What one sample says about B robots.

    Attributes:
        theta_set: the set Theta(t).
        area: area of Theta(t) [m^2].
        centroid: centroid of Theta(t) [m].
        case: index into `CASES`.
        G: matrix of u* = G theta + f at the observed active set [1/s].
        f: vector of u* = G theta + f [m/s].
        u: measured control [m/s].
        noise: bound of its disturbance [m/s].
    """

    theta_set: Halfspaces
    area: Float[Tensor, "B"]
    centroid: Float[Tensor, "B 2"]
    case: Int[Tensor, "B"]
    G: Float[Tensor, "B 2 2"]
    f: Float[Tensor, "B 2"]
    u: Float[Tensor, "B 2"]
    noise: float


class Update(NamedTuple):
    """The answer of a gain to one sample.

    Attributes:
        Gamma: the gain matrix.
        information: the information matrix Lambda+, passed on to the next sample.
        pull: the pull a towards the centroid, or None for no pull.
    """

    Gamma: Float[Tensor, "B 2 2"]
    information: Float[Tensor, "B 2 2"]
    pull: Float[Tensor, "B"] | None = None


class ConstantGain(nn.Module):
    """Gamma = `share`/kp^2 I, with a trainable `share`."""

    def __init__(self, share: float, kp: float):
        super().__init__()
        self.log_share = nn.Parameter(torch.tensor(math.log(share), dtype=torch.float64))
        self.kp = kp

    def forward(self, step: Step, information: Tensor) -> Update:
        """The gain for this sample. The information matrix is passed on unchanged."""
        identity = torch.eye(2, dtype=torch.float64).expand_as(information)
        return Update(self.log_share.exp() / self.kp**2 * identity, information)


class RlsGain(nn.Module):
    """Recursive least squares with the declared noise, and optionally a constant `pull`."""

    def __init__(self, pull: float | None = None):
        super().__init__()
        self.pull = pull

    def forward(self, step: Step, information: Tensor) -> Update:
        """The gain for this sample, from the information before it."""
        R = step.noise**2 / 4
        information = information + step.G.mT @ step.G / R
        pull = None if self.pull is None else torch.full_like(step.area, self.pull)
        return Update(_inverse(information) / R, information, pull)


class Answer(NamedTuple):
    """The output of the network for B robots (module docstring).

    Attributes:
        distrust: s, the factor on the variance of this sample.
        memory: r, the factor on the earlier information.
        pull: a, the step towards the centroid.
    """

    distrust: Float[Tensor, "B"]
    memory: Float[Tensor, "B"]
    pull: Float[Tensor, "B"]


class NetworkGain(nn.Module):
    """Recursive least squares with distrust and memory from a network. Before training it is nearly `RlsGain`.

    Attributes:
        prior_area: unit of areas [m^2].
        speed: unit of noise [m/s].
        pulls: the network also gives a pull towards the centroid.
    """

    def __init__(self, hidden: int, prior_area: float, speed: float, pulls: bool):
        super().__init__()
        self.prior_area, self.speed, self.pulls = prior_area, speed, pulls
        self.inner = nn.Linear(2 + len(CASES), hidden, dtype=torch.float64)
        self.outer = nn.Linear(hidden, len(Answer._fields), dtype=torch.float64)
        nn.init.zeros_(self.outer.weight)
        with torch.no_grad():
            self.outer.bias.copy_(torch.tensor(UNTRAINED))

    def answer(self, area: Tensor, case: Tensor, noise: float) -> Answer:
        """Distrust, memory and pull for areas [m^2], cases and a noise bound [m/s]."""
        level = torch.full_like(area, math.log(noise / self.speed) / 5)
        sizes = torch.stack([(area / self.prior_area).log() / 10, level], dim=-1)
        cases = nn.functional.one_hot(case, len(CASES)).to(torch.float64)
        distrust, memory, pull = self.outer(torch.tanh(self.inner(torch.cat([sizes, cases], dim=-1)))).unbind(-1)
        return Answer(distrust.exp(), memory.sigmoid(), pull.sigmoid())

    def forward(self, step: Step, information: Tensor) -> Update:
        """The gain for this sample, from the information before it."""
        distrust, memory, pull = self.answer(step.area, step.case, step.noise)
        R = (distrust * step.noise**2 / 4)[:, None, None]
        information = memory[:, None, None] * information + step.G.mT @ step.G / R
        return Update(_inverse(information) / R, information, pull if self.pulls else None)


class AdaptiveObserver(nn.Module):
    """theta+ = Proj_Theta(theta + Gamma G'(u - G theta - f)), over a whole recording.

    Attributes:
        gain: the module that gives Gamma.
        project: the projection onto Theta(t), or None for no projection.
    """

    def __init__(self, gain: nn.Module, projects: bool = True):
        super().__init__()
        self.gain = gain
        self.project = ProjectOnto() if projects else None

    def forward(
        self, steps: list[Step], theta: Float[Tensor, "B 2"], information: Float[Tensor, "B 2 2"]
    ) -> Float[Tensor, "T B 2"]:
        """The estimates after each sample.

        Args:
            steps: the samples.
            theta: first estimate [m].
            information: its information matrix, the inverse of the covariance.
        """
        estimates = []
        for step in steps:
            Gamma, information, pull = self.gain(step, information)
            innovation = step.u - times(step.G, theta) - step.f
            theta = theta + times(Gamma, times(step.G.mT, innovation))
            if self.project is not None:
                theta = self.project(step.theta_set, theta).point
            if pull is not None:
                theta = theta + pull.unsqueeze(-1) * (step.centroid - theta)
            estimates.append(theta)
        return torch.stack(estimates)


def _inverse(M: Float[Tensor, "B 2 2"]) -> Float[Tensor, "B 2 2"]:
    (a, b), (c, d) = M[:, 0].unbind(-1), M[:, 1].unbind(-1)
    adjugate = torch.stack([torch.stack([d, -b], dim=-1), torch.stack([-c, a], dim=-1)], dim=1)
    return adjugate / (a * d - b * c)[:, None, None]
