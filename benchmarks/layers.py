"""Projection and Chebyshev centre in the plane, forward and backward: cvxpylayers' solvers and torchfsid's exact one.

Every row of the tables is the same work, one process, one thread: m random half-planes that hold a disc around the
origin, a point outside, and the gradient of a weighted sum of the answer. The first rows are plain `CvxpyLayer`s, as
their documentation shows them; the last ones the layers of torchfsid. An error is the largest distance from the same
problem solved in rational arithmetic: over the answers, and over the gradients with respect to all the rows.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from fractions import Fraction
from functools import cache, partial
from importlib.util import find_spec
from statistics import median
from time import perf_counter
from typing import Any

import cvxpy as cp
import numpy as np
import torch
from cvxpylayers.torch.cvxpylayer import CvxpyLayer
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchmarks import save
from torchfsid import ChebyshevCentre, Halfspaces, ProjectOnto
from torchfsid.programmes import conic

ROWS = (8, 24, 64)
BATCHES = (1, 32, 256, 1024)
ITEMS_CHECKED = 8
ONE_THREAD = {"n_jobs_forward": 1, "n_jobs_backward": 1}
SCS = {"solve_method": "SCS", "eps": 1e-9, "mode": "dense"}

Programme = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Measured:
    """Medians over the repeats, and the largest errors. NaN: the solver failed.

    Attributes:
        problem: the problem.
        solver: the solver.
        rows: number of rows m.
        batch: number of sets B.
        seconds: time for forward and backward [s].
        error: largest error of the answers.
        gradient_error: largest error of the gradients.
    """

    problem: str
    solver: str
    rows: int
    batch: int
    seconds: float
    error: float
    gradient_error: float


def workload(m: int, B: int) -> tuple[Tensor, Tensor, Tensor]:
    """Random half-planes A z <= b and points y.

    The first three of the unit rows A are 120 degrees apart, so that no set is unbounded. cvxpylayers fails for the
    whole batch if one is. Offsets b are in [0.5, 1.5]. Most of the points y are outside.
    """
    rng = np.random.default_rng(m)
    angle = rng.uniform(0, 2 * np.pi, (B, m))
    angle[:, :3] = angle[:, :1] + np.arange(3) * 2 * np.pi / 3
    A = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    drawn = A, rng.uniform(0.5, 1.5, size=(B, m)), 3 * rng.normal(size=(B, 2))
    return tuple(torch.from_numpy(part).requires_grad_() for part in drawn)  # type: ignore[return-value]


def weighted(problem: str, answer: Tensor) -> Tensor:
    """The weighted sum that is differentiated. The answer for the ball is (centre, radius) in one tensor."""
    weights = {"projection": (1.0, -0.5), "chebyshev": (1.0, -0.5, 2.0)}[problem]
    return answer @ torch.tensor(weights, dtype=torch.float64)


# Who is measured ----------------------------------------------------------------------------------------------------


@cache
def plain_layer(problem: str, m: int, solver: str) -> CvxpyLayer:
    z, r = cp.Variable(2), cp.Variable()
    A, b, y, norms = cp.Parameter((m, 2)), cp.Parameter(m), cp.Parameter(2), cp.Parameter(m, nonneg=True)
    if problem == "projection":
        return CvxpyLayer(cp.Problem(cp.Minimize(cp.sum_squares(z - y)), [A @ z <= b]), [A, b, y], [z], solver=solver)
    return CvxpyLayer(cp.Problem(cp.Maximize(r), [A @ z + norms * r <= b]), [A, b, norms], [z, r], solver=solver)


def plain(problem: str, solver: str, options: dict[str, Any], A: Tensor, b: Tensor, y: Tensor) -> Tensor:
    layer = plain_layer(problem, A.shape[-2], solver)
    if problem == "projection":
        return layer(A, b, y, solver_args=options)[0]
    z, r = layer(A, b, A.norm(dim=-1), solver_args=options)
    return torch.cat([z, r.unsqueeze(-1)], dim=-1)


def projection(layer: ProjectOnto, A: Tensor, b: Tensor, y: Tensor) -> Tensor:
    return layer(Halfspaces(A, b), y).point


def chebyshev(layer: ChebyshevCentre, A: Tensor, b: Tensor, y: Tensor) -> Tensor:
    ball = layer(Halfspaces(A, b))
    return torch.cat([ball.centre, ball.radius.unsqueeze(-1)], dim=-1)


def ours(problem: str, backend: Any) -> Programme:
    if problem == "projection":
        return partial(projection, ProjectOnto(backend=backend))
    return partial(chebyshev, ChebyshevCentre(backend))


def solvers(problem: str) -> dict[str, Programme]:
    found: dict[str, Programme] = {
        "cvxpylayers DIFFCP, defaults": partial(plain, problem, "DIFFCP", ONE_THREAD),
        "cvxpylayers DIFFCP, SCS 1e-9 dense": partial(plain, problem, "DIFFCP", SCS | ONE_THREAD),
    }
    if find_spec("moreau"):
        found["cvxpylayers MOREAU"] = partial(plain, problem, "MOREAU", {})
    found["torchfsid cvxpylayers"] = ours(problem, "cvxpylayers")
    found["torchfsid exact"] = ours(problem, "exact")
    return found


# What is right ------------------------------------------------------------------------------------------------------


def solve_rational(M: list[list[Fraction]], right: list[Fraction]) -> list[Fraction] | None:
    """Solve M x = right by Gauss-Jordan elimination. None if M is singular."""
    rows = [[*row, value] for row, value in zip(M, right, strict=True)]
    for i in range(len(rows)):
        pivot = next((row for row in rows[i:] if row[i] != 0), None)
        if pivot is None:
            return None
        rows.remove(pivot)
        rows.insert(i, [value / pivot[i] for value in pivot])
        rows = [r if r is rows[i] else [v - r[i] * w for v, w in zip(r, rows[i], strict=True)] for r in rows]
    return [row[-1] for row in rows]


def reference(problem: str, A: np.ndarray, b: np.ndarray, y: np.ndarray) -> tuple[list[float], list[int]]:
    """The answer and its active rows in rational arithmetic, by trying subsets of the rows nearest to the answer.

    For the ball |a| is the rounded root as a double, as the solvers get it.
    """
    order = candidates(problem, A, b, y)
    rows = {j: [Fraction(float(v)) for v in A[j]] for j in range(len(b))}
    norms = {j: Fraction(float(np.linalg.norm(A[j]))) for j in rows}
    bound = {j: Fraction(float(b[j])) for j in rows}
    point = [Fraction(float(v)) for v in y]

    def inside(z: list[Fraction], r: Fraction) -> bool:
        return all(rows[j][0] * z[0] + rows[j][1] * z[1] + norms[j] * r <= bound[j] for j in rows)

    if problem == "chebyshev":
        for chosen in itertools.combinations(order, 3):
            M = [[*rows[j], norms[j]] for j in chosen]
            w = solve_rational(M, [bound[j] for j in chosen])
            duals = solve_rational([list(column) for column in zip(*M, strict=True)], [Fraction(v) for v in (0, 0, 1)])
            if w and duals and min(duals) >= 0 and inside(w[:2], w[2]):
                return [float(v) for v in w], list(chosen)
    for k in range(3):
        for chosen in itertools.combinations(order, k):
            # z + N' mu = y, N z = b
            M = [[Fraction(int(i == other)) for other in range(2)] + [rows[j][i] for j in chosen] for i in range(2)]
            M += [rows[j] + [Fraction(0)] * k for j in chosen]
            w = solve_rational(M, point + [bound[j] for j in chosen])
            if w and min(w[2:], default=0) >= 0 and inside(w[:2], Fraction(0)):
                return [float(v) for v in w[:2]], list(chosen)
    raise AssertionError("no subset of the nearest rows solves the problem")


def candidates(problem: str, A: np.ndarray, b: np.ndarray, y: np.ndarray) -> list[int]:
    """The rows nearest to the answer of a conic solver (Clarabel): only a hint, which is checked in rationals."""
    z, r = cp.Variable(2), cp.Variable()
    if problem == "projection":
        cp.Problem(cp.Minimize(cp.sum_squares(z - y)), [A @ z <= b]).solve(solver="CLARABEL")
        slack = b - A @ z.value  # type: ignore[operator]
    else:
        norms = np.linalg.norm(A, axis=1)
        cp.Problem(cp.Maximize(r), [A @ z + norms * r <= b]).solve(solver="CLARABEL")
        slack = b - A @ z.value - norms * r.value  # type: ignore[operator]
    return [int(j) for j in np.argsort(slack)[:5]]


def gradient_of(problem: str, A: Tensor, b: Tensor, y: Tensor, active: list[int]) -> list[Tensor]:
    """The gradients of the solution with respect to the rows, by autograd through one solve of the KKT matrix."""
    A, b, y = (t.detach().requires_grad_() for t in (A, b, y))
    N, right = A[active], b[active]
    if problem == "chebyshev":
        answer = torch.linalg.solve(torch.cat([N, N.norm(dim=1, keepdim=True)], dim=1), right)
    else:
        k = len(active)
        kkt = torch.cat([torch.cat([torch.eye(2).double(), N.mT], 1), torch.cat([N, N.new_zeros(k, k)], 1)])
        answer = torch.linalg.solve(kkt, torch.cat([y, right]))[:2]
    return list(torch.autograd.grad(weighted(problem, answer), (A, b, y), materialize_grads=True, allow_unused=True))


@cache
def right_answers(problem: str, m: int, B: int) -> list[tuple[list[float], list[Tensor]]]:
    tensors = [t.detach() for t in workload(m, B)]
    found = []
    for i in range(min(B, ITEMS_CHECKED)):
        A, b, y = (t[i] for t in tensors)
        answer, active = reference(problem, A.numpy(), b.numpy(), y.numpy())
        found.append((answer, gradient_of(problem, A, b, y, active)))
    return found


# Measuring ----------------------------------------------------------------------------------------------------------


def measure(problem: str, name: str, solver: Programme, m: int, B: int, seconds: float) -> Measured:
    """Time the solver for about this number of seconds. A first run warms up, and its answers are checked."""
    inputs = workload(m, B)

    def once() -> tuple[Tensor, tuple[Tensor, ...]]:
        answer = solver(*inputs)
        wanted = inputs if problem == "projection" else inputs[:2]
        return answer, torch.autograd.grad(weighted(problem, answer).sum(), wanted)

    try:
        answer, gradients = once()
    except Exception as error:  # a solver that fails is a result
        print(f"{name}, {problem}, m={m}, B={B}: {type(error).__name__}: {error}")
        return Measured(problem, name, m, B, *[float("nan")] * 3)
    right = right_answers(problem, m, B)
    off = max(
        float((answer[i].detach() - torch.tensor(z, dtype=torch.float64)).abs().max()) for i, (z, _) in enumerate(right)
    )
    slope = max(
        float((mine[i] - theirs).abs().max())
        for i, (_, wanted) in enumerate(right)
        for mine, theirs in zip(gradients, wanted, strict=False)
    )
    times: list[float] = []
    while len(times) < 3 or (sum(times) < seconds and len(times) < 1000):
        start = perf_counter()
        once()
        times.append(perf_counter() - start)
    return Measured(problem, name, m, B, median(times), off, slope)


def show(console: Console, problem: str, results: list[Measured]) -> None:
    table = Table(title=f"{problem}, p = 2, forward + backward; the ratio is to the first row of each block")
    for column in ("B", "m", "solver", "ms", "ratio", "error", "gradient error"):
        table.add_column(column, justify="left" if column == "solver" else "right")
    for (B, m), block in itertools.groupby(results, key=lambda r: (r.batch, r.rows)):
        base = None
        for r in block:
            base = base or r.seconds
            ratio = f"{base / r.seconds:.1f}x"
            numbers = f"{1e3 * r.seconds:.3g}", ratio, f"{r.error:.0e}", f"{r.gradient_error:.0e}"
            table.add_row(str(B), str(m), r.solver, *numbers)
        table.add_section()
    console.print(table)


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks layers", description=__doc__)
    parser.add_argument("--batches", type=int, nargs="+", default=BATCHES, help="batch sizes")
    parser.add_argument("--rows", type=int, nargs="+", default=ROWS, help="numbers of rows")
    parser.add_argument("--seconds", type=float, default=1.0, help="to repeat each measurement for, at least 3 times")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    conic.SOLVE.update(ONE_THREAD)
    console, results = Console(width=110), []
    for problem in ("projection", "chebyshev"):
        block = [
            measure(problem, name, solver, m, B, options.seconds)
            for B, m in itertools.product(options.batches, options.rows)
            for name, solver in solvers(problem).items()
        ]
        show(console, problem, block)
        results += block
    packages = ["torch", "numpy", "numba", "cvxpy", "cvxpylayers", "diffcp", "scs"]
    packages += ["moreau"] if find_spec("moreau") else []
    where = save("layers", {"cores": os.cpu_count(), "measured": [asdict(r) for r in results]}, packages)
    print(f"saved: {where}")
