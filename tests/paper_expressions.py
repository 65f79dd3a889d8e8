r"""The paper's own expressions for Omega, cases A-E, transcribed once as printed (labels of its equations in comments).

Each function returns the set in lifted form, {theta : exists eta, T theta + E eta <= r}: eta are the paper's "floating"
multipliers of cases C and E; the other cases have no column for them. The paper's strict < is closed. Nothing here is
shared with the library: numpy's SVD and scipy's linear programmes only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog

BOX = 5.0
"""Suprema of the sets, which may be unbounded, are taken within this distance of a theta, per axis."""


class Lifted(NamedTuple):
    """{theta : exists eta, T theta + E eta <= r}."""

    T: np.ndarray
    E: np.ndarray
    r: np.ndarray

    def depth(self, theta: np.ndarray) -> float:
        """How far the rows can be satisfied at theta: max over eta of min(r - T theta - E eta), at most 1.

        Negative exactly where no eta exists.
        """
        rows = self.r - self.T @ theta
        k = self.E.shape[1]
        A = np.column_stack([self.E, np.ones(len(rows))])
        answer = linprog(np.append(np.zeros(k), -1.0), A_ub=A, b_ub=rows, bounds=[(None, None)] * k + [(None, 1.0)])
        assert answer.status == 0, answer.message
        return -answer.fun

    def support(self, direction: np.ndarray, around: np.ndarray) -> float:
        """max direction.theta over the set within `BOX` of `around`."""
        k = self.E.shape[1]
        bounds = [(c - BOX, c + BOX) for c in around] + [(None, None)] * k
        answer = linprog(
            np.append(-direction, np.zeros(k)), A_ub=np.column_stack([self.T, self.E]), b_ub=self.r, bounds=bounds
        )
        assert answer.status == 0, answer.message
        return -answer.fun


def omega(A: np.ndarray, b: np.ndarray, active: np.ndarray, C: np.ndarray, d: np.ndarray) -> Lifted:
    """The paper's Omega for an active set, by the case of its Table I."""
    A_ac, b_ac, A_inac, b_inac = A[active], b[active], A[~active], b[~active]
    K = len(b_ac)
    rank = np.linalg.matrix_rank(A_ac) if K else 0
    if K == 0:
        return case_a(A, b, C, d)
    if K == 1:
        return case_b(A_ac, b_ac, A_inac, b_inac, C, d)
    if rank == 1:
        return case_c(A_ac, b_ac, A_inac, b_inac, C, d)
    return case_d(A_ac, b_ac, C, d) if K == 2 else case_e(A_ac, b_ac, C, d)


def case_a(A, b, C, d) -> Lifted:
    # eq:omegaspecial_CaseA     (A C) theta < b - A d
    return Lifted(A @ C, np.zeros((len(b), 0)), b - A @ d)


def case_b(A_ac, b_ac, A_inac, b_inac, C, d) -> Lifted:
    # SVD of A_ac = U Sigma V^T with U = 1, Sigma_m = |a_i|, V_1 = a_i/|a_i|, V_2 = R_{pi/2} a_i/|a_i|
    a_i = A_ac[0]
    Sigma_m = np.linalg.norm(a_i)
    V_1 = (a_i / Sigma_m)[:, None]
    V_2 = (np.array([[0.0, -1.0], [1.0, 0.0]]) @ a_i / Sigma_m)[:, None]
    # eq:control_case2_optimalucap     G = V_2 V_2^T C,  f = V_1 Sigma_m^{-1} U^T b_i + V_2 V_2^T d
    G = V_2 @ V_2.T @ C
    f = (V_1 / Sigma_m * b_ac[0])[:, 0] + V_2 @ V_2.T @ d
    # eq:LMcaseB     G~ = C - G,  f~ = d - f
    G_tilde, f_tilde = C - G, d - f
    # eq:omegaspecialCaseB     (A_inac G) theta < b_inac - A_inac f,   -A_ac G~ theta <= A_ac f~
    T = np.concatenate([A_inac @ G, -A_ac @ G_tilde])
    return Lifted(T, np.zeros((len(T), 0)), np.concatenate([b_inac - A_inac @ f, A_ac @ f_tilde]))


def case_c(A_ac, b_ac, A_inac, b_inac, C, d) -> Lifted:
    K = len(b_ac)
    # eq:svdCaseB     A_ac = U Sigma V^T,  U = [U_1, U_2],  V = [V_1, V_2],  Sigma_r the one singular value
    U, S, Vt = np.linalg.svd(A_ac)
    U_1, Sigma_r, V_1, V_2 = U[:, :1], S[0], Vt[:1].T, Vt[1:].T
    # eq:control_case3_optimalucap     G = V_2 V_2^T C,  f = V_1 Sigma_r^{-1} U_1^T b_ac + V_2 V_2^T d
    G = V_2 @ V_2.T @ C
    f = V_1[:, 0] / Sigma_r * (U_1.T @ b_ac) + V_2 @ V_2.T @ d
    # eq:LMcaseC     G~ = C - G,  f~ = d - f
    G_tilde, f_tilde = C - G, d - f
    # eq:svdCaseBAacT     A_ac^T = U~ Sigma~ V~^T
    Ut, St, Vtt = np.linalg.svd(A_ac.T)
    Ut_1, Sigma_rt, Vt_1, Vt_2 = Ut[:, :1], St[0], Vtt[:1].T, Vtt[1:].T
    # eq:omegaspecialCaseC     (A_inac G) theta < b_inac - A_inac f,
    #                          -2 V~_1 Sigma~_r^{-1} U~_1^T G~ theta - V~_2 eta <= 2 V~_1 Sigma~_r^{-1} U~_1^T f~
    inverse = Vt_1 / Sigma_rt @ Ut_1.T
    T = np.concatenate([A_inac @ G, -2 * inverse @ G_tilde])
    E = np.concatenate([np.zeros((len(b_inac), K - 1)), -Vt_2])
    return Lifted(T, E, np.concatenate([b_inac - A_inac @ f, 2 * inverse @ f_tilde]))


def case_d(A_ac, b_ac, C, d) -> Lifted:
    # eq:omegaspecial_CaseD     -A_ac^{-T} C theta <= A_ac^{-T} (d - A_ac^{-1} b_ac)
    inverse = np.linalg.inv(A_ac)
    return Lifted(-inverse.T @ C, np.zeros((2, 0)), inverse.T @ (d - inverse @ b_ac))


def case_e(A_ac, b_ac, C, d) -> Lifted:
    # eq:svdCaseE     A_ac^T = U~ Sigma~ V~^T,  V~ = [V~_1, V~_2],  V~_1 of two columns
    Ut, St, Vtt = np.linalg.svd(A_ac.T)
    Vt_1, Vt_2 = Vtt[:2].T, Vtt[2:].T
    inverse = Vt_1 @ np.diag(1 / St) @ Ut.T
    # eq:omegaspecialCaseE     -2 V~_1 Sigma~_m^{-1} U~^T C theta - V~_2 eta
    #                                                             <= 2 V~_1 Sigma~_m^{-1} U~^T (d - A_ac^+ b_ac)
    return Lifted(-2 * inverse @ C, -Vt_2, 2 * inverse @ (d - np.linalg.pinv(A_ac) @ b_ac))
