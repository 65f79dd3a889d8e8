r"""cvxpylayers: the two programmes of `programmes` through DIFFCP, and the exact solver inside a `CvxpyLayer`.

    min |w|^2   s.t.  N w <= o              max rho   s.t.  N w + s rho <= o

Conic solvers and the derivatives of their solutions are accurate to a tolerance, and only on problems of order one. So
the problem is scaled first. The rows are made unit rows. The exact answer, found without gradients, gives the unit of
length (the distance from the point, or the radius) and, for the ball, the origin. Rows further away than `FAR` units
cannot be active and are left out. Items without an answer are replaced by an easy problem, because they would make the
solver raise for the whole batch.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import cvxpy as cp
import torch
from cvxpylayers.interfaces.base import SolverInterface
from cvxpylayers.torch.cvxpylayer import CvxpyLayer
from diffcp import SolverError as DiffcpError
from torch import Tensor

from torchfsid.errors import InputError, SolverError
from torchfsid.halfspaces import Halfspaces
from torchfsid.outcome import Status
from torchfsid.programmes import differentiable as programmes
from torchfsid.programmes.differentiable import InscribedBall, NearestPoint, broadcast, times

FAR = 1e2
"""Units of length beyond which a row is left out."""

SOLVE: dict[str, Any] = {"solve_method": "SCS", "eps": 1e-11, "max_iters": 100_000}
"""SCS's options. Its default tolerance is no use for gradients."""

DIFFERENTIATE = {"mode": "dense"}
"""Options that crash where there is nothing to differentiate."""


def nearest_point(halfspaces: Halfspaces, point: Tensor, metric: Tensor | None = None) -> NearestPoint:
    """The nearest point as in `programmes.nearest_point`, by cvxpylayers.

    Raises:
        InputError: dimensions or batches do not fit.
        SolverError: the conic solver SCS failed.
    """
    halfspaces, y, metric = broadcast(halfspaces, point, metric)
    with torch.no_grad():
        exact, status = programmes.nearest_point(halfspaces, y, metric)
    ok, p = status == Status.OK, halfspaces.dim
    A, offsets = halfspaces.A, halfspaces.b - times(halfspaces.A, y)
    root = None
    if metric is not None:
        identity = torch.eye(p, dtype=A.dtype, device=A.device)
        root = torch.linalg.cholesky(torch.where(ok[..., None, None], metric, identity))
        A = torch.linalg.solve_triangular(root, A.mT, upper=False).mT
    unit = Halfspaces(A, offsets).where(ok.unsqueeze(-1).expand_as(offsets)).normalised()
    with torch.no_grad():
        step = exact - y if root is None else times(root.mT, exact - y)
        clear = torch.where(unit.b > 0, unit.b, torch.inf).amin(-1)
        size = torch.where(ok, step.norm(dim=-1), 0.0)
        size = torch.where(size > 0, size, torch.where(clear.isfinite(), clear, 1.0)).unsqueeze(-1)
    near = Halfspaces(unit.A, unit.b / size).where(unit.b <= FAR * size)
    (w,) = _solve(_projection(halfspaces.rows, p), near.A, near.b)
    w = size * w
    if root is not None:
        w = torch.linalg.solve_triangular(root.mT, w.unsqueeze(-1), upper=True).squeeze(-1)
    return NearestPoint(torch.where(ok.unsqueeze(-1), y + w, torch.nan).to(point.dtype), status)


def inscribed_ball(halfspaces: Halfspaces) -> InscribedBall:
    """The largest ball as in `programmes.inscribed_ball`, by cvxpylayers. A centre that is not unique is any of them.

    Raises:
        SolverError: the conic solver SCS failed.
    """
    halfspaces, *_ = broadcast(halfspaces)
    with torch.no_grad():
        centre, radius, status = programmes.inscribed_ball(halfspaces)
        solvable = centre.isfinite().all(-1) & radius.isfinite()
        origin = torch.where(solvable.unsqueeze(-1), centre, 0.0)
        size = torch.where(solvable & (status != Status.DEGENERATE), radius.abs(), 1.0).unsqueeze(-1)
    unit = halfspaces.where(solvable.unsqueeze(-1).expand_as(halfspaces.b)).normalised()
    distance = (unit.b - times(unit.A, origin)) / size
    near = Halfspaces(unit.A, distance).where(distance <= FAR)
    is_row = (near.A != 0).any(-1).to(near.A.dtype)
    # A ball of radius one for the items without rows.
    w, rho = _solve(_ball(halfspaces.rows, halfspaces.dim), near.A, near.b, is_row)
    ball = torch.where(solvable.unsqueeze(-1), origin + size * w, centre)
    return InscribedBall(ball, torch.where(solvable, size.squeeze(-1) * rho, radius), status)


@cache
def _projection(m: int, p: int) -> CvxpyLayer:
    w, N, o = cp.Variable(p), cp.Parameter((m, p)), cp.Parameter(m)
    return CvxpyLayer(cp.Problem(cp.Minimize(cp.sum_squares(w)), [N @ w <= o]), [N, o], [w], solver="DIFFCP")


@cache
def _ball(m: int, p: int) -> CvxpyLayer:
    w, rho, N, o, s = cp.Variable(p), cp.Variable(), cp.Parameter((m, p)), cp.Parameter(m), cp.Parameter(m, nonneg=True)
    # rho is bounded, which matters where there is no row.
    problem = cp.Problem(cp.Maximize(rho), [N @ w + cp.multiply(s, rho) <= o, rho <= 2 * FAR])
    return CvxpyLayer(problem, [N, o, s], [w, rho], solver="DIFFCP")


def _solve(layer: CvxpyLayer, *tensors: Tensor) -> list[Tensor]:
    """Apply the layer to the parameters N, o, ..., with their batch dimensions flattened to one."""
    batch = tensors[1].shape[:-1]
    if batch.numel() == 0:
        return [tensors[0].new_zeros((*batch, *v.shape)) for v in layer.ctx.variables or ()]
    flat = [t.reshape(batch.numel(), *t.shape[len(batch) :]) for t in tensors]
    differentiate = torch.is_grad_enabled() and any(t.requires_grad for t in flat)
    try:
        found = layer(*flat, solver_args=SOLVE | (DIFFERENTIATE if differentiate else {}))
    except DiffcpError as error:
        raise SolverError(f"SCS gave up: {error}") from error
    return [v.reshape((*batch, *v.shape[1:])) for v in found]


class ActiveRowsSolver(SolverInterface):
    """The exact solver for quadratic programmes, given to a `CvxpyLayer` as `solver=`.

        min 1/2 x'P x + q'x   s.t.  E x = e,  N x <= o

    P has to be positive definite on the null space of E, as in projections. The solution of an infeasible item is NaN.

    Raises:
        InputError: the problem has other constraints, or its objective is linear.
    """

    canon_solver = "CLARABEL"
    supports_quad_obj = True

    def setup(self, ctx: Any) -> None:
        cones = ctx.cone_dims
        others = cones.exp, *cones.soc, *cones.psd, *cones.p3d
        if ctx.reduced_P.problem_data_index is None or any(others):
            raise InputError("problem", "a strictly convex quadratic programme with linear constraints", str(cones))
        self._P, self._A = (_coordinates(*form.problem_data_index) for form in (ctx.reduced_P, ctx.reduced_A))
        self._equalities, self._rows = cones.zero, cones.zero + cones.nonneg

    def solve_torch_batch(
        self, P: Tensor | None, q: Tensor, A: Tensor, dims: Any, solver_args: dict, needs_grad: bool
    ) -> tuple[Tensor, Tensor, Any]:
        assert P is not None
        inputs = [t.detach().to(torch.float64).requires_grad_(needs_grad) for t in (P, q, A)]
        with torch.set_grad_enabled(needs_grad):
            solution = self._solve(*inputs)
        primal, dual = (t.detach().to(q.dtype) for t in solution)
        return primal, dual, (inputs, solution)

    def derivative_torch_batch(self, dprimal: Tensor, ddual: Tensor, saved_state: Any) -> tuple[Tensor, ...]:
        inputs, solution = saved_state
        given = [d.to(torch.float64) for d in (dprimal, ddual)]
        return torch.autograd.grad(solution, inputs, given, allow_unused=True, materialize_grads=True)

    def _solve(self, P: Tensor, q: Tensor, A: Tensor) -> tuple[Tensor, Tensor]:
        """Solve by elimination: x = x0 + Z v with E Z = 0. Then v is a nearest point in the metric Z'P Z."""
        n, k = q.shape[-1] - 1, self._equalities
        upper, q = self._dense(P, self._P, (n, n)), q[:, :n]
        H = upper + upper.triu(1).mT
        stacked = self._dense(A, self._A, (self._rows, n + 1))
        E, e, N, o = -stacked[:, :k, :n], stacked[:, :k, n], -stacked[:, k:, :n], stacked[:, k:, n]
        # E is completed by constant rows orthogonal to it. The square matrix maps x to (e, v).
        free = torch.linalg.qr(E.detach().mT, mode="complete").Q[..., k:].mT if k > 0 else torch.eye(n).to(q)
        back = torch.linalg.inv(torch.cat([E, free.expand(len(q), -1, -1)], dim=1))
        x0, Z = times(back[..., :k], e), back[..., k:]
        metric = Z.mT @ H @ Z
        metric = programmes.symmetric(metric)
        y = -torch.linalg.solve(metric, times(Z.mT, times(H, x0) + q))
        v, mu, rows, filled, status = programmes.nearest(Halfspaces(N @ Z, o - times(N, x0)), y, metric)
        # NaN is filled in only at the end: earlier it would spoil shared gradients.
        solved = (status == Status.OK).unsqueeze(-1)
        x = x0 + times(Z, torch.where(solved, v, 0.0))
        multipliers = torch.zeros_like(o).scatter_add(-1, rows, torch.where(filled & solved, mu, 0.0))
        pull = times(H, x) + q + times(N.mT, multipliers)
        dual = torch.cat([-times(back[..., :k].mT, pull), multipliers], dim=-1)
        return torch.where(solved, x, torch.nan), torch.where(solved, dual, torch.nan)

    @staticmethod
    def _dense(values: Tensor, at: tuple[Tensor, Tensor], shape: tuple[int, int]) -> Tensor:
        rows, columns = at
        flat = torch.zeros(len(values), shape[0] * shape[1], dtype=values.dtype, device=values.device)
        return flat.index_add(1, (rows * shape[1] + columns).to(values.device), values).reshape(-1, *shape)


def _coordinates(indices: Any, pointers: Any, shape: Any) -> tuple[Tensor, Tensor]:
    """Row and column of each value of a compressed sparse column matrix."""
    pointers = torch.as_tensor(pointers).long()
    columns = torch.arange(len(pointers) - 1).repeat_interleave(pointers.diff())
    return torch.as_tensor(indices).long(), columns
