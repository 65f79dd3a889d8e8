r"""Closed loops of planar robots that go to goals among bodies with known paths, one robot after the other.

    x(t + dt) = x(t) + dt u(t),   u = argmin |u - uhat|^2  s.t.  a_j.u <= b_j
    uhat = kp (theta - x),        a_j = -grad h_j,  b_j = alpha(h_j)

This computes what `robots.simulation.closed_loop` computes in torch, with a `GoalTask` and a `CollisionAvoidance` that
ignores neighbours' velocities. Tests compare the two, and their derivatives.

Derivatives are computed backwards. Let g_t and l_t be the derivatives of a loss with respect to u_t and x_t, with all
that follows from these. Then from the last sample to the first

    g_t = dL/du_t + dt l_(t+1),      l_t = dL/dx_t + l_(t+1) + (du_t/dx_t)' g_t.

The control solves u + N' mu = uhat, N u = b, with the active rows N. Its vector-Jacobian product for g is the solution
of the same equations with other right-hand sides, s + N' v = g, N s = 0: it is s for uhat, v_j for b_j, and
-(mu_j s + v_j u) for a_j.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from torchfsid.kernels.active_rows import nearest_rows
from torchfsid.kernels.compiled import item_in_place, launcher
from torchfsid.kernels.frame import to_frame
from torchfsid.kernels.programmes import finish_nearest
from torchfsid.outcome import Status
from torchfsid.tolerances import ROUND_OFF

OK = int(Status.OK)


@item_in_place
@no_type_check
def row_of(p, q, keeping):
    """The row (a, b) of `robots.avoidance.CollisionAvoidance` for a body from which the way to the robot is (p, q)."""
    distance, squared, gain, power = keeping
    apart = p * p + q * q
    length = 0.5 if squared else math.sqrt(apart)
    h = apart - distance * distance if squared else length - distance
    return -(p / length), -(q / length), gain * (h if power == 1.0 else math.copysign(abs(h) ** power, h))


@item_in_place
@no_type_check
def row_vjp(p, q, keeping, of_a, of_b):
    """The vector-Jacobian product of `row_of` with respect to (p, q)."""
    distance, squared, gain, power = keeping
    apart = p * p + q * q
    length = 0.5 if squared else math.sqrt(apart)
    h = apart - distance * distance if squared else length - distance
    slope = of_b * gain * (1.0 if power == 1.0 else power * abs(h) ** (power - 1.0)) / length
    if not squared:
        slope += (of_a[0] * p + of_a[1] * q) / (apart * length)
    return slope * p - of_a[0] / length, slope * q - of_a[1] / length


@item_in_place
@no_type_check
def run_one(k, start, goals, bodies, robot, run, scratch):
    """Run robot k, see `run_to_goals`."""
    kp, dt, keeping = robot
    x, u, rows, filled, feasible = run
    A, b, unit, offsets, sizes, lengths, L, Q, T, N, D, work, step, mu, wish, active = scratch
    (_, samples, M, _), S, K = bodies.shape, len(goals), 0
    for i in range(2):
        x[k, 0, i] = start[i]
        for j in range(2):
            L[i, j] = 0.0
    for t in range(samples):
        for j in range(M):
            p, q = x[k, t, 0] - bodies[k // S, t, j, 0], x[k, t, 1] - bodies[k // S, t, j, 1]
            A[j, 0], A[j, 1], b[j] = row_of(p, q, keeping)
        for i in range(2):
            wish[i] = kp * goals[k % S, i] - kp * x[k, t, i]
        state = to_frame(A, b, wish, L, False, unit, offsets, sizes, lengths)
        if state == OK:
            # Most often the rows of the sample before are still active.
            step[0] = step[1] = 0.0
            state = finish_nearest(
                A, b, wish, L, False, unit, sizes, lengths, active, K, Q, D, T, work, N, step, u[k, t], mu
            )
            if state != OK:
                K, state = nearest_rows(unit, offsets, sizes, ROUND_OFF, active, Q, D, T, work, step)
                if state == OK:
                    state = finish_nearest(
                        A, b, wish, L, False, unit, sizes, lengths, active, K, Q, D, T, work, N, step, u[k, t], mu
                    )
        feasible[k, t] = state == OK
        for i in range(2):
            filled[k, t, i] = state == OK and i < K
            rows[k, t, i] = active[i] if filled[k, t, i] else 0
            if state != OK:
                u[k, t, i] = 0.0
            if t < samples - 1:
                x[k, t + 1, i] = x[k, t, i] + dt * u[k, t, i]


@item_in_place
@no_type_check
def weights(first, second, count, v, w):
    """The y of (v, w) = s + y_1 first + y_2 second, N s = 0, for the first `count` of the two rows N."""
    if count == 2:
        turn = first[0] * second[1] - first[1] * second[0]
        return (v * second[1] - w * second[0]) / turn, (first[0] * w - first[1] * v) / turn
    square = first[0] * first[0] + first[1] * first[1]
    return (first[0] * v + first[1] * w) / square if count == 1 else 0.0, 0.0


@item_in_place
@no_type_check
def return_one(k, goals, bodies, robot, run, grad_x, grad_u, grad_path):
    """Fill `grad_path` for robot k, see `return_to_path`."""
    kp, dt, keeping = robot
    x, u, rows, filled, feasible = run
    (_, samples, M, _), S, later_x, later_y = bodies.shape, len(goals), 0.0, 0.0
    for t in range(samples - 1, -1, -1):
        v, w = grad_u[k, t, 0] + dt * later_x, grad_u[k, t, 1] + dt * later_y
        later_x, later_y = later_x + grad_x[k, t, 0], later_y + grad_x[k, t, 1]
        grad_path[k, t, 0], grad_path[k, t, 1] = 0.0, 0.0
        if not feasible[k, t] or (v == 0.0 and w == 0.0):
            continue
        x_t, y_t, u_x, u_y = x[k, t, 0], x[k, t, 1], u[k, t, 0], u[k, t, 1]
        i, j, count = rows[k, t, 0], rows[k, t, 1], int(filled[k, t, 0]) + int(filled[k, t, 1])
        p, q = x_t - bodies[k // S, t, i, 0], y_t - bodies[k // S, t, i, 1]
        r, s = x_t - bodies[k // S, t, j, 0], y_t - bodies[k // S, t, j, 1]
        first, second = row_of(p, q, keeping), row_of(r, s, keeping)
        mu, nu = weights(first, second, count, kp * (goals[k % S, 0] - x_t) - u_x, kp * (goals[k % S, 1] - y_t) - u_y)
        y, z = weights(first, second, count, v, w)
        # What is left along no active row passes to the nominal control.
        v = v - y * first[0] - z * second[0] if count < 2 else 0.0
        w = w - y * first[1] - z * second[1] if count < 2 else 0.0
        later_x, later_y = later_x - kp * v, later_y - kp * w
        for place in range(count):
            if place == 0:
                to_x, to_y = row_vjp(p, q, keeping, (-(mu * v + y * u_x), -(mu * w + y * u_y)), y)
            else:
                to_x, to_y = row_vjp(r, s, keeping, (-(nu * v + z * u_x), -(nu * w + z * u_y)), z)
            later_x, later_y = later_x + to_x, later_y + to_y
            if (i if place == 0 else j) == M - 1:
                grad_path[k, t, 0] -= to_x
                grad_path[k, t, 1] -= to_y


@launcher
@no_type_check
def run_to_goals(start, goals, bodies, robot):
    """Run P x S robots, robot k among the bodies `k // S`.

    Args:
        start: (2,), where all robots start [m].
        goals: (S, 2), their goals [m].
        bodies: (P, T, M, 2), the positions of the bodies at each sample [m].
        robot: the gain kp of the goal task, the time dt between samples [s], and of the avoidance the safety distance
            [m], whether h is |dx|^2 - distance^2 (otherwise it is |dx| - distance), and gain and power of alpha.

    Returns:
        The positions x and controls u (P S, T, 2), the active rows and a mask of the places that they fill
        (P S, T, 2), and whether a verified control was found (P S, T). The robot stands still where it was not.
    """
    (P, T, M, _), S = bodies.shape, len(goals)
    B = P * S
    x, u = np.empty((B, T, 2)), np.zeros((B, T, 2))
    rows, filled, feasible = np.empty((B, T, 2), np.int64), np.empty((B, T, 2), np.bool_), np.empty((B, T), np.bool_)
    scratch = (
        np.empty((M, 2)), np.empty(M), np.empty((M, 2)), np.empty(M), np.empty(M), np.empty((M, 2)),
        np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2)), np.zeros(2), np.zeros((6, 2)),
        np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2, np.int64),
    )  # fmt: skip
    run = x, u, rows, filled, feasible
    for k in range(B):
        run_one(k, start, goals, bodies, robot, run, scratch)
    return run


@launcher
@no_type_check
def return_to_path(goals, bodies, robot, run, grad_x, grad_u):
    """The vector-Jacobian product of `run_to_goals` with respect to the path of the last body.

    Args:
        goals: see `run_to_goals`.
        bodies: see `run_to_goals`.
        robot: see `run_to_goals`.
        run: what `run_to_goals` returns.
        grad_x: (P S, T, 2), the derivatives of a loss with respect to all positions.
        grad_u: (P S, T, 2), and with respect to all controls.

    Returns:
        The derivatives (P S, T, 2), for each robot.
    """
    grad_path = np.empty_like(grad_x)
    for k in range(len(grad_x)):
        return_one(k, goals, bodies, robot, run, grad_x, grad_u, grad_path)
    return grad_path
