r"""Closed loops of planar robots that go to goals among bodies with known paths, one robot after the other.

    x(t + dt) = x(t) + dt u(t),   u = argmin |u - kp (theta - x)|^2  s.t.  -grad h_j . u <= alpha(h_j)

This computes what `robots.simulation.closed_loop` computes in torch, with a `GoalTask` and a `CollisionAvoidance` that
ignores neighbours' velocities. Tests compare the two.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.active_rows import nearest_rows
from torchfsid.kernels.compiled import item, launcher
from torchfsid.kernels.frame import to_frame
from torchfsid.kernels.programmes import finish_nearest
from torchfsid.outcome import Status
from torchfsid.tolerances import ROUND_OFF

OK = int(Status.OK)


@item
@no_type_check
def avoid(x, bodies, distance, squared, gain, power, A, b):
    """Fill the rows of `robots.barriers.CollisionAvoidance` for a robot at x."""
    for j in range(len(bodies)):
        p, q = x[0] - bodies[j, 0], x[1] - bodies[j, 1]
        apart = p * p + q * q
        if squared:
            h, length = apart - distance * distance, 0.5
        else:
            length = math.sqrt(apart)
            h = length - distance
        A[j, 0], A[j, 1] = -(p / length), -(q / length)
        b[j] = gain * (h if power == 1.0 else math.copysign(abs(h) ** power, h))


@launcher
@no_type_check
def run_to_goals(start, goals, bodies, kp, distance, squared, gain, power, dt):
    """Run P x S robots, robot k among the bodies `k // S`.

    Args:
        start: (2,), where all robots start [m].
        goals: (S, 2), their goals [m].
        bodies: (T, P, M, 2), the positions of the bodies at each sample [m].
        kp: gain of the goal task [1/s].
        distance: the safety distance [m].
        squared: whether h is |dx|^2 - distance^2. Otherwise it is |dx| - distance.
        gain: of the class-K function alpha.
        power: of the class-K function alpha.
        dt: time between samples [s].

    Returns:
        The positions x and controls u (T, P S, 2), the active rows and a mask of the places that they fill
        (T, P S, 2), and whether a verified control was found (T, P S). The robot stands still where it was not.
    """
    (T, P, M, _), S = bodies.shape, len(goals)
    x, u = np.empty((T, P * S, 2)), np.zeros((T, P * S, 2))
    rows, filled = np.zeros((T, P * S, 2), np.int64), np.zeros((T, P * S, 2), np.bool_)
    feasible = np.zeros((T, P * S), np.bool_)
    A, b, unit, offsets, sizes, lengths = (
        np.empty((M, 2)), np.empty(M), np.empty((M, 2)), np.empty(M), np.empty(M), np.empty((M, 2)),
    )  # fmt: skip
    L, Q, T_, N = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2))
    D, work, step, mu, wish = np.zeros(2), np.zeros((6, 2)), np.zeros(2), np.zeros(2), np.zeros(2)
    active = np.zeros(2, np.int64)
    for k in range(P * S):
        goal, placement = goals[k % S], k // S
        x[0, k, 0], x[0, k, 1], K = start[0], start[1], 0
        for t in range(T):
            avoid(x[t, k], bodies[t, placement], distance, squared, gain, power, A, b)
            for i in range(2):
                wish[i] = kp * goal[i] - kp * x[t, k, i]
            state = to_frame(A, b, wish, L, False, unit, offsets, sizes, lengths)
            if state == OK:
                # Most often the rows of the sample before are still active.
                step[0] = step[1] = 0.0
                state = finish_nearest(
                    A, b, wish, L, False, unit, sizes, lengths, active, K, Q, D, T_, work, N, step, u[t, k], mu
                )
                if state != OK:
                    K, state = nearest_rows(unit, offsets, sizes, ROUND_OFF, active, Q, D, T_, work, step)
                    if state == OK:
                        state = finish_nearest(
                            A, b, wish, L, False, unit, sizes, lengths, active, K, Q, D, T_, work, N, step, u[t, k], mu
                        )
            feasible[t, k] = state == OK
            for i in range(2):
                filled[t, k, i] = state == OK and i < K
                if filled[t, k, i]:
                    rows[t, k, i] = active[i]
                if state != OK:
                    u[t, k, i] = 0.0
                if t < T - 1:
                    x[t + 1, k, i] = x[t, k, i] + dt * u[t, k, i]
    return x, u, rows, filled, feasible
