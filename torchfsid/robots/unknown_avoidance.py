r"""Avoidance whose gain and safety distance are known only to lie in a set Psi.

With alpha(h) = gamma sgn(h) |h|^p, beta = gamma^(1/p) and spow(v, e) = sgn(v) |v|^e,

    alpha(h) >= v    <=>    w >= spow(v, 1/p),    w = psi_1 q - psi_2,    psi = (beta, beta D)

    squared     D = Ds^2    q = r^2                  s = |grad h| = 2 r
    euclidean   D = Ds      q = r - radii            s = 1              (radii only where D is a margin)

So every test of every row at every sample is a half-plane of psi (`avoidance_within`), and Psi is a polygon like Theta.
It starts as a trapezoid, all gains and distances in their intervals.

Squared distances with a margin m have D = (R + m)^2, R the sum of the radii of a reference pair. A pair whose radii sum
to R' has q = r^2 - (R' - R)(R' + R + 2 m), an interval that follows from the margins that Psi allows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance, NeighbourVelocity
from torchfsid.sets.feasible_set import FeasibleSet

Interval = tuple[float, float]


class SafetyIntervals(NamedTuple):
    """Intervals [low, high] that Psi allows for the gain and for the safety distance (or margin) [m]."""

    gain: Float[Tensor, "*batch 2"]
    distance: Float[Tensor, "*batch 2"]


@dataclass(frozen=True)
class UnknownAvoidance:
    """`CollisionAvoidance` with a gain and a safety distance (or a margin) that lie in intervals [low, high].

    It stands among the barriers of an observer, which learns the set Psi of its parameters. Equal ends of an interval
    mean a known value.

    Attributes:
        gain: the gain of the class-K function.
        safety_distance: the distance between centres [m], or None.
        margin: the distance between discs [m], or None. Exactly one of the two is given.
        power: the power of the class-K function.
        distance: see `CollisionAvoidance`.
        neighbour_velocity: see `CollisionAvoidance`.
        soft: whether the controller may violate the rows.
        shared: whether all robots have the same parameters (`team`) or each its own (`robot`).
        reference: R, the sum of radii of the commonest pair [m]. It matters where there is a margin.

    Raises:
        InputError: an interval is not low <= high; a gain or distance is not positive (for squared distances R + margin
            must be); not exactly one of the distances is given; or the power is not positive.
    """

    gain: Interval
    safety_distance: Interval | None = None
    margin: Interval | None = None
    power: float = 1.0
    distance: Literal["squared", "euclidean"] = "squared"
    neighbour_velocity: NeighbourVelocity = "none"
    soft: bool = False
    shared: Literal["team", "robot"] = "team"
    reference: float = 0.0

    def __post_init__(self) -> None:
        if (self.safety_distance is None) == (self.margin is None):
            raise InputError("safety_distance, margin", "exactly one of them", (self.safety_distance, self.margin))
        for name in ("gain", "safety_distance", "margin"):
            interval = getattr(self, name)
            least = -math.inf if name == "margin" else 0.0
            if interval is not None and not least < interval[0] <= interval[1] < math.inf:
                raise InputError(name, "an interval (low, high) of positive numbers", interval)
        if not self.power > 0:
            raise InputError("power", "a positive number", self.power)
        if self.distance == "squared" and not self.lengths[0] > 0:
            raise InputError("margin", "margin + reference > 0 for squared distances", (self.margin, self.reference))

    @property
    def declared(self) -> Interval:
        """The interval of the safety distance or margin [m]."""
        interval = self.safety_distance if self.margin is None else self.margin
        assert interval is not None
        return interval

    @property
    def lengths(self) -> Interval:
        """The interval of the safety distance, for the reference pair if it is given by a margin [m]."""
        added = 0.0 if self.margin is None else self.reference
        return self.declared[0] + added, self.declared[1] + added

    @property
    def betas(self) -> Interval:
        """The interval of beta."""
        return self.gain[0] ** (1 / self.power), self.gain[1] ** (1 / self.power)

    @property
    def distances(self) -> Interval:
        """The interval of D."""
        return (self.lengths[0] ** 2, self.lengths[1] ** 2) if self.distance == "squared" else self.declared

    @cached_property
    def pattern(self) -> CollisionAvoidance:
        """The barrier with some values of the parameters. Its geometry does not depend on them."""
        low = self.declared[0]
        Ds, margin = (low, None) if self.margin is None else (None, low)
        class_k = ClassK(self.gain[0], self.power)
        return CollisionAvoidance(class_k, Ds, margin, self.distance, self.neighbour_velocity, self.soft)

    def labels(self, bodies: Sequence[str]) -> list[str]:
        """A name for each row, given the names of the bodies."""
        return self.pattern.labels(bodies)

    def prior(self, sets: int) -> FeasibleSet:
        """Psi before any measurement, in a batch of this size."""
        (low, high), (near, far) = self.betas, self.distances
        A = torch.tensor([[-1.0, 0.0], [1.0, 0.0], [near, -1.0], [-far, 1.0]], dtype=torch.float64)
        b = torch.tensor([-low, high, 0.0, 0.0], dtype=torch.float64)
        corner = torch.tensor([2 * high, 1 + 2 * high * max(abs(near), abs(far))], dtype=torch.float64)
        box = FeasibleSet.from_box(-corner.expand(sets, 2), corner.expand(sets, 2))
        return box.intersect(Halfspaces(A, b, torch.full((4,), -1)))

    def intervals(self, psi: FeasibleSet) -> SafetyIntervals:
        """The gains and distances that each set Psi allows. NaN for an EMPTY set."""
        beta, D = self.split(psi.vertices().detach())
        gain, distance = (beta**self.power).clamp(*self.gain), self.length(D).clamp(*self.declared)
        return SafetyIntervals(extremes(gain), extremes(distance))

    def bounded_by_data(self, psi: FeasibleSet) -> tuple[Bool[Tensor, "*batch 2"], Bool[Tensor, "*batch 2"]]:
        """Whether the ends of the two intervals come from data alone.

        They do not where the prior bounds Psi as well at the points that reach them. Known values are no prior.
        """
        beta, D = self.split(psi.vertices().detach())
        at_prior = torch.zeros_like(beta, dtype=torch.bool)
        for values, (low, high) in ((beta, self.betas), (D, self.distances)):
            if low < high:
                least, largest = extremes(values).unsqueeze(-2).unbind(-1)
                close = 1e-6 * (largest - least) + 1e-9 * values.abs()  # not of high - low, which may be huge
                at_prior = at_prior | (values <= low + close) | (values >= high - close)

        def free_ends(values: Tensor) -> Tensor:
            low, high = extremes(values).unsqueeze(-2).unbind(-1)
            close = 1e-9 * (high - low)
            return ~torch.stack([at_prior & (values <= low + close), at_prior & (values >= high - close)], -1).any(-2)

        return free_ends(beta), free_ends(D)

    def approach_speed(self, psi: FeasibleSet, r: Float[Tensor, "k"]) -> Float[Tensor, "*batch k 2"]:
        """The band of speeds at which a robot of Psi may approach a standing body at distances r [m] [m/s].

        Where the safety distance is a margin, it is that of the reference pair.
        """
        w = lines(psi.vertices().detach(), self.q(r, self.reference, 0.0))
        return extremes(spow(w, self.power)) / self.size(r).unsqueeze(-1)

    def size(self, r: Tensor) -> Tensor:
        """s = |grad h| at distances r."""
        return 2 * r if self.distance == "squared" else torch.ones_like(r)

    def q(self, r: Tensor, radii: Tensor | float, margin: Tensor | float) -> Tensor:
        """q at distances r [m], for pairs of this sum of radii [m] and for this margin [m]."""
        if self.distance == "euclidean":
            return r if self.margin is None else r - radii
        if self.margin is None:
            return r**2
        return r**2 - (radii - self.reference) * (radii + self.reference + 2 * margin)

    def split(self, psi: Float[Tensor, "*batch v 2"]) -> tuple[Float[Tensor, "*batch v"], Float[Tensor, "*batch v"]]:
        """beta and D = psi_2 / psi_1 at vertices of Psi, kept in their intervals against round-off.

        D is monotone along every edge, so that its extremes over Psi are at vertices.
        """
        beta = psi[..., 0].clamp(*self.betas)
        return beta, (psi[..., 1] / beta).clamp(*self.distances)

    def length(self, D: Tensor) -> Tensor:
        """The safety distance or margin that belongs to D [m]."""
        if self.distance == "euclidean":
            return D
        return D.sqrt() - (0.0 if self.margin is None else self.reference)


def spow(v: Tensor, e: float) -> Tensor:
    """sgn(v) |v|^e. Its gradient at v = 0 is zero where it does not exist (e < 1)."""
    if e == 1:
        return v
    return torch.where(v == 0, 0.0, v.sign() * torch.where(v == 0, 1.0, v.abs()) ** e)


def lines(psi: Float[Tensor, "*batch v 2"], q: Float[Tensor, "*#batch k"]) -> Float[Tensor, "*batch k v"]:
    """w = psi_1 q - psi_2 at vertices of Psi."""
    return psi[..., None, :, 0] * q.unsqueeze(-1) - psi[..., None, :, 1]


def extremes(values: Float[Tensor, "*batch v"]) -> Float[Tensor, "*batch 2"]:
    """The least and the largest value."""
    return torch.stack([values.amin(-1), values.amax(-1)], dim=-1)
