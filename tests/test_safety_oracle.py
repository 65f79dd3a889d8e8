r"""Sets of safety parameters against an oracle: all active sets in one mixed-integer linear programme (HiGHS).

Over psi, the theta of every robot, and for every sample and row a multiplier lambda and a binary z:

    C theta + d - u - sum lambda_j a_j  in  a polygon around the ball        0 <= lambda_j <= L z_j
    w_j >= low_j for all rows,    w_j <= high_j + M (1 - z_j)

No rule, polygon or split of the library is used. Its outer fan of normals replaces the ball by something between the
ball and 1/cos(11.25 deg) times the ball. So a polygon inside the ball gives parameters that the library must keep, and
one around the larger ball those that it may keep.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from scipy.optimize import LinearConstraint, linprog, milp

from tests.safety_teams import Team, crossing
from torchfsid.identification.safety_parameters import Possible
from torchfsid.observers.second_look import second_look
from torchfsid.sets.feasible_set import FeasibleSet

LARGEST = 40.0
"""L: larger than any multiplier [m/s]."""

SIDES = 64
FAN = 1 / math.cos(math.radians(11.25))
"""The reach of the library's outer polygon of the ball."""


class Oracle:
    """The mixed-integer programme of a team's samples."""

    def __init__(self, team: Team, samples: Sequence[int], outer: bool):
        unknown, robots = team.unknown, len(team.theta)
        self.samples, gain = samples, team.task.gain  # type: ignore[attr-defined]
        delta = float(team.noise.velocity)
        turn = 2 * np.pi * (np.arange(SIDES) + 0.37) / SIDES
        normals = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        radius = delta * (FAN if outer else math.cos(math.pi / SIDES))
        pairs = [(k, i, j) for k in samples for i in range(robots) for j in range(robots) if j != i]
        self.first, self.size = 2 + 2 * robots, 2 + 2 * robots + 2 * len(pairs)
        self.pairs = len(pairs)
        rows, bounds = [], []

        def add(row: np.ndarray, bound: float) -> None:
            rows.append(row)
            bounds.append(bound)

        (low, high), (near, far) = unknown.betas, unknown.distances
        for sign, end in ((-1, near), (1, far)):
            row = np.zeros(self.size)
            row[:2] = -sign * end, sign
            add(row, 0.0)
        stationary: dict[tuple[int, int], list[tuple[int, np.ndarray]]] = {}
        for place, (k, i, j) in enumerate(pairs):
            seen = team.measurements[k]
            assert seen.u is not None
            x, u, other = (part.numpy() for part in (seen.x, seen.u, seen.bodies))
            away = x[i] - other[i, j]
            r = float(np.linalg.norm(away))
            a = -away / r
            q, s = (r**2, 2 * r) if unknown.distance == "squared" else (r, 1.0)
            vlow, vhigh = (
                np.sign(v) * abs(v) ** (1 / unknown.power) for v in ((a @ u[i] - delta) * s, (a @ u[i] + delta) * s)
            )
            kept, active = np.zeros(self.size), np.zeros(self.size)
            kept[:2], active[:2] = (-q, 1.0), (q, -1.0)
            add(kept, -vlow)
            most = max(beta * (q - D) for beta in (low, high) for D in (near, far))
            active[self.first + self.pairs + place] = max(most - vhigh, 0.0)
            add(active, vhigh + max(most - vhigh, 0.0))
            link = np.zeros(self.size)
            link[self.first + place], link[self.first + self.pairs + place] = 1.0, -LARGEST
            add(link, 0.0)
            stationary.setdefault((k, i), []).append((place, a))
        for (k, i), multipliers in stationary.items():
            seen = team.measurements[k]
            assert seen.u is not None
            x, u = seen.x[i].numpy(), seen.u[i].numpy()
            for n in normals:
                row = np.zeros(self.size)
                row[2 + 2 * i : 4 + 2 * i] = gain * n
                for place, a in multipliers:
                    row[self.first + place] = -(n @ a)
                add(row, radius + n @ (gain * x + u))
        self.A, self.b = np.array(rows), np.array(bounds)
        box = [(low, high), (None, None)] + [(-6.0, 6.0)] * (2 * robots)
        self.bounds = [*box, *[(0.0, LARGEST)] * self.pairs, *[(0.0, 1.0)] * self.pairs]

    def most(self, direction: tuple[float, float]) -> tuple[float, float]:
        """The largest direction.psi: (attained by an exact active set, upper bound)."""
        c = np.zeros(self.size)
        c[:2] = -np.array(direction)
        integral = np.arange(self.size) >= self.first + self.pairs
        lower = [-np.inf if low is None else low for low, _ in self.bounds]
        upper = [np.inf if high is None else high for _, high in self.bounds]
        found = milp(
            c, integrality=integral, bounds=(lower, upper), constraints=LinearConstraint(self.A, -np.inf, self.b)
        )
        assert found.status == 0, found.message
        # Integers are met within 1e-6 only. With z fixed there is no such error.
        z = np.round(found.x[self.first + self.pairs :])
        fixed = [*self.bounds[: self.first], *[(0.0, LARGEST * on) for on in z], *[(on, on) for on in z]]
        exact = linprog(c, A_ub=self.A, b_ub=self.b, bounds=fixed)
        return (-exact.fun if exact.status == 0 else -np.inf), -found.mip_dual_bound


def looked_twice(team: Team, samples: Sequence[int], most: int) -> FeasibleSet:
    """Psi from the samples alone."""
    robots, half = len(team.theta), torch.full(team.theta.shape, 6.0, dtype=torch.float64)
    model = team.observer().model
    everything = Possible(FeasibleSet.from_box(-half, half), team.unknown.prior(1), torch.zeros(robots).long())
    return second_look(model, everything, [team.measurements[k] for k in samples], most).psi


@pytest.mark.parametrize(
    ("seed", "robots", "shape", "gain", "prior", "samples"),
    [
        (0, 2, {}, 1.5, (0.15, 15.0), range(2, 27, 3)),
        (1, 2, {"power": 3.0}, 6.0, (0.6, 60.0), range(2, 27, 3)),
        (2, 3, {"distance": "euclidean"}, 1.5, (0.15, 15.0), range(2, 27, 5)),
        (3, 2, {"distance": "euclidean", "power": 3.0}, 6.0, (0.6, 60.0), range(2, 27, 3)),
        # A jam: one of two rows of each robot must be active, so that Psi has to be split.
        (15, 3, {}, 3.0, (1.0, 90.0), (12, 23, 28)),
    ],
)
def test_the_bounds_are_those_of_the_oracle(
    seed: int, robots: int, shape: dict, gain: float, prior: tuple[float, float], samples: Sequence[int]
) -> None:
    team = crossing(seed, robots=robots, shape=shape, gain=gain, velocity=2e-3, size=None, unknown={"gain": prior})
    psi = looked_twice(team, samples, 200)
    assert psi.contains(team.psi.unsqueeze(0)).all()
    beta, D = team.unknown.split(psi.vertices()[0])
    directions = {
        "least beta": (-1.0, 0.0),
        "largest beta": (1.0, 0.0),
        "least D": (float(D.min()), -1.0),
        "largest D": (-float(D.max()), 1.0),
    }
    inner, outer = Oracle(team, samples, False), Oracle(team, samples, True)
    for name, direction in directions.items():
        ours = float(psi.support(torch.tensor([direction], dtype=torch.float64)))
        scale = float(beta.max())
        assert inner.most(direction)[0] <= ours + 1e-7 * scale, f"{name}: parameters that explain the motions are lost"
        assert outer.most(direction)[1] >= ours - 1e-4 * scale, f"{name}: looser than it could be"
