r"""Nested sets: the parameters that explain all samples, all but one, ..., all but q (a q-relaxed intersection).

A sample that breaks the declared model or its bounds is an outlier. Its half-spaces Omega may exclude the truth, or it
raises the alarm, and then Omega is empty. The parameters that explain all samples but j are

    T_0(t) = T_0(t-1) & Omega(t),        T_j(t) = (T_j(t-1) & Omega(t))  |  T_(j-1)(t-1),

since a parameter explains the new sample, or it takes one of its j skips. The level S_j is a convex set around T_j:

    S_0(t) = S_0(t-1) & Omega(t),        S_j(t) = S_j(t-1) & {theta : n.theta <= max(b, h(n)), (n, b) a row of Omega},

h the support function of S_(j-1)(t-1), -inf where that is empty. If no parameter of S_j(t-1) explains the sample,
S_j(t) is S_(j-1)(t-1). So a gross outlier moves every level up by one, and S_0 is empty from then on.

**S_j contains the truth if at most j samples are outliers.** By induction: if this sample is none, the truth is in
S_j & Omega, and n.theta <= b. If it is one, at most j - 1 samples before were outliers, the truth was in S_(j-1), and
n.theta <= h(n).

Where the levels 0 to k - 1 are empty, at least k samples are outliers. The rows that emptied a level contradict each
other, so one of their samples is an outlier. If no parameter of S_q satisfies the row of a sample, it is that one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import Evidence
from torchfsid.sets.around import moved_around, reach
from torchfsid.sets.feasible_set import FeasibleSet

Levels = tuple[FeasibleSet, ...]
"""S_0, ..., S_q, each a batch (B,)."""


@dataclass(frozen=True)
class SetAside:
    """A sample of a robot that is left unexplained.

    Attributes:
        t: its time [s].
        robot: the robot.
        sources: the rows by which it contradicts other samples, as in `critical_region` or `inverse_optimal_set`. For
            an alarm it is the violated row.
        is_certain: whether no parameter of the set explains it. Otherwise it is one of several that contradict each
            other, and it is open which of them is the outlier.
    """

    t: float
    robot: int
    sources: tuple[int, ...]
    is_certain: bool


def possible(found: Evidence) -> Halfspaces:
    """The half-spaces of theta. Those of an alarming sample are empty: 0.theta <= -1, from the row that is violated."""
    omega = found.omega
    if not bool(found.alarmed.any()):
        return omega
    nothing = found.alarmed.unsqueeze(-1) & (torch.arange(omega.rows, device=omega.b.device) == 0)
    source = torch.zeros_like(nothing, dtype=torch.long) if omega.source is None else omega.source
    return Halfspaces(
        torch.where(nothing.unsqueeze(-1), 0.0, omega.A),
        torch.where(nothing, -1.0, omega.b),
        torch.where(nothing, found.slack.argmin(-1, keepdim=True), source),
    )


def narrowed(levels: Levels, omega: Halfspaces, t: float | Float[Tensor, "B"]) -> tuple[Levels, Bool[Tensor, "B"]]:
    """The levels after one more sample of each robot at t [s], and whether a parameter of the last one explains it.

    A level is EMPTY if no parameter is left of it.
    """
    stamp = t.unsqueeze(-1) if isinstance(t, Tensor) else t
    found = [levels[0].intersect(omega, stamp)]
    found += [level.intersect(moved_around(omega, below), stamp) for below, level in pairwise(levels)]
    explained = ~found[-1].is_empty
    if len(levels) == 1 or not any(level.any_empty for level in found):
        return tuple(found), explained
    # While the sample leaves something of the lowest level that is not empty, it does so of all levels above.
    emptied = torch.stack([new.is_empty & ~old.is_empty for new, old in zip(found, levels, strict=True)]).any(0)
    if bool(emptied.any()):
        suspect = omega.where(emptied.unsqueeze(-1))
        for j, (below, level) in enumerate(pairwise(levels), start=1):
            explained = ~level.intersect(suspect, stamp).is_empty
            times = torch.as_tensor(t, dtype=torch.float64, device=below.last_cut.device)
            shifted = replace(below, last_cut=times.expand_as(below.last_cut))
            found[j] = found[j].where(explained | below.is_empty, shifted)
    return tuple(found), explained


def set_aside(levels: Levels) -> list[SetAside]:
    """The samples that may be outliers, robot by robot, in the order of time: those that emptied a level.

    For every EMPTY level these are the certain ones among the samples that contradict each other, if there are any.
    """
    found: dict[tuple[int, float], tuple[bool, set[int]]] = {}
    for level in levels[:-1]:
        against = level.contradiction
        rows, real = against.halfspaces, level.is_empty.unsqueeze(-1) & ~against.time.isnan()
        opposite = Halfspaces(-rows.A.nan_to_num(), rows.b)
        certain = real & (-reach(opposite, levels[-1]) > rows.b)
        named = torch.where(certain.any(-1, keepdim=True), certain, real)
        for robot, row in named.nonzero().tolist():
            key = robot, float(against.time[robot, row])
            is_certain, sources = found.setdefault(key, (False, set()))
            found[key] = is_certain or bool(certain[robot, row]), sources | {int(against.source[robot, row])}
    return [
        SetAside(t, robot, tuple(sorted(sources)), is_certain)
        for (robot, t), (is_certain, sources) in sorted(found.items(), key=lambda item: item[0])
    ]
