r"""Layers over half-spaces {z : A z <= b}: the Chebyshev centre, and the projection in a norm of choice.

    ChebyshevCentre    max r                        s.t.  a_j.z + |a_j| r <= b_j
    ProjectOnto        min 1/2 (z - y)' H (z - y)   s.t.  A z <= b

Two backends give the same answers, with gradients. "exact" finds the active rows and solves for them (`programmes`). It
is accurate to round-off, has derivatives of any order, and works under vmap. "cvxpylayers" solves a conic programme
with DIFFCP and SCS (`conic`). It is slower and has first derivatives only. Where the centre is not unique it returns
any of the centres, while "exact" states which one.

Half-spaces may be given as `Halfspaces`, as a `FeasibleSet` or as a pair (A, b), at every call or once and for all:

    ProjectOnto()(halfspaces, point)                                                 they differ from call to call
    nn.Sequential(network, ProjectOnto(halfspaces=halfspaces))(input).point          they are fixed

Fixed ones are buffers of the layer, or parameters if A and b are given as such.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

from jaxtyping import Float
from torch import Tensor, nn

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, as_halfspaces
from torchfsid.programmes import differentiable as programmes
from torchfsid.programmes.differentiable import InscribedBall, NearestPoint

Backend = Literal["exact", "cvxpylayers"]

Rows = Any
"""Half-spaces: `Halfspaces`, a `FeasibleSet`, or a pair (A, b)."""


class _OverHalfspaces(nn.Module):
    """Holds the fixed half-spaces of a layer, if it has some, and the backend."""

    A: Tensor | None
    b: Tensor | None

    def __init__(self, halfspaces: Rows | None, backend: Backend):
        super().__init__()
        self.backend = _known(backend)
        fixed = None if halfspaces is None else as_halfspaces(halfspaces)
        self._hold("A", None if fixed is None else fixed.A)
        self._hold("b", None if fixed is None else fixed.b)

    def _hold(self, name: str, value: Tensor | None) -> None:
        """Keep a tensor as a buffer, or as a parameter if it is one."""
        if isinstance(value, nn.Parameter):
            self.register_parameter(name, value)
        else:
            self.register_buffer(name, value)

    def _rows(self, given: Rows | None) -> Halfspaces:
        """The half-spaces of a call."""
        if given is not None:
            return as_halfspaces(given)
        if self.A is None or self.b is None:
            raise InputError("halfspaces", "half-spaces, since the layer has no fixed ones", None)
        return Halfspaces(self.A, self.b)

    def extra_repr(self) -> str:
        fixed = "" if self.A is None else f", halfspaces={tuple(self.A.shape)}"
        return f"backend={self.backend!r}{fixed}"


class ChebyshevCentre(_OverHalfspaces):
    """The centre and radius of a largest ball in each set, and a `Status` per item: `layer(halfspaces)`.

    `programmes.inscribed_ball` says what is returned for a centre that is not unique and for an empty set.

    Args:
        backend: "exact" or "cvxpylayers".
        halfspaces: fixed half-spaces, for `layer()`.

    Raises:
        InputError: there is no such backend, or what is given is no half-spaces.
        SolverError: the conic solver SCS failed (cvxpylayers).
    """

    def __init__(self, backend: Backend = "exact", halfspaces: Rows | None = None):
        super().__init__(halfspaces, backend)

    def forward(self, halfspaces: Rows | None = None) -> InscribedBall:
        rows = self._rows(halfspaces)
        if self.backend == "exact":
            return programmes.inscribed_ball(rows)
        from torchfsid.programmes import conic  # importing cvxpy takes longer than solving

        return conic.inscribed_ball(rows)


class ProjectOnto(_OverHalfspaces):
    """The point of each set nearest to a given one, and a `Status` per item: `layer(halfspaces, point)`.

    With fixed half-spaces it is `layer(point)`.

    Args:
        metric: symmetric positive definite, (p, p) or (*batch, p, p). The norm is sqrt(z' metric z), the Mahalanobis
            norm if the metric is an inverse covariance, and Euclidean for None. It is a buffer, or a parameter if it
            is given as one.
        backend: "exact" or "cvxpylayers".
        halfspaces: fixed half-spaces.

    Raises:
        InputError: there is no such backend, dimensions or batches do not fit, an argument has a wrong type, or the
            metric is no batch of matrices.
        SolverError: the conic solver SCS failed (cvxpylayers).
    """

    metric: Tensor | None

    def __init__(
        self,
        metric: Float[Tensor, "*batch p p"] | None = None,
        backend: Backend = "exact",
        halfspaces: Rows | None = None,
    ):
        super().__init__(halfspaces, backend)
        if metric is not None and (metric.ndim < 2 or metric.shape[-1] != metric.shape[-2]):
            raise InputError("metric", "(*batch, p, p)", tuple(metric.shape))
        self._hold("metric", metric)

    def forward(self, halfspaces: Rows, point: Float[Tensor, "*batch p"] | None = None) -> NearestPoint:
        if point is None:  # the only argument is the point
            rows, point = self._rows(None), halfspaces
        else:
            rows = self._rows(halfspaces)
        if not isinstance(point, Tensor) or not point.is_floating_point():
            raise InputError("point", f"a tensor (*batch, {rows.dim}) of floats", _described(point))
        if self.backend == "exact":
            return programmes.nearest_point(rows, point, self.metric)
        from torchfsid.programmes import conic

        return conic.nearest_point(rows, point, self.metric)

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, metric={None if self.metric is None else tuple(self.metric.shape)}"


def _described(value: Any) -> str:
    return f"{value.dtype}" if isinstance(value, Tensor) else type(value).__name__


def _known(backend: Backend) -> Backend:
    if backend not in get_args(Backend):
        raise InputError("backend", " or ".join(map(repr, get_args(Backend))), repr(backend))
    return backend
