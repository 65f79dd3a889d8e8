r"""Layers over half-spaces {z : A z <= b}: the Chebyshev centre, and the projection in a norm of choice.

    ChebyshevCentre    max r                        s.t.  a_j.z + |a_j| r <= b_j
    ProjectOnto        min 1/2 (z - y)' H (z - y)   s.t.  A z <= b

Two backends give the same answers, with gradients. "exact" finds the active rows and solves for them (`programmes`). It
is accurate to round-off, has derivatives of any order, and works under vmap. "cvxpylayers" solves a conic programme
with DIFFCP and SCS (`conic`). It is slower and has first derivatives only. Where the centre is not unique it returns
any of the centres, while "exact" states which one.
"""

from __future__ import annotations

from typing import Literal, get_args

from jaxtyping import Float
from torch import Tensor, nn

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.programmes import differentiable as programmes
from torchfsid.programmes.differentiable import InscribedBall, NearestPoint

Backend = Literal["exact", "cvxpylayers"]


class ChebyshevCentre(nn.Module):
    """The centre and radius of a largest ball in each set, and a `ProgrammeStatus` per item: `layer(halfspaces)`.

    `programmes.inscribed_ball` says what is returned for a centre that is not unique and for an empty set.

    Raises:
        InputError: there is no such backend.
        SolverError: the conic solver SCS failed (cvxpylayers).
    """

    def __init__(self, backend: Backend = "exact"):
        super().__init__()
        self.backend = _known(backend)

    def forward(self, halfspaces: Halfspaces) -> InscribedBall:
        if self.backend == "exact":
            return programmes.inscribed_ball(halfspaces)
        from torchfsid.programmes import conic  # importing cvxpy takes longer than solving

        return conic.inscribed_ball(halfspaces)

    def extra_repr(self) -> str:
        return f"backend={self.backend!r}"


class ProjectOnto(nn.Module):
    """The point of each set nearest to a given one, and a `ProgrammeStatus` per item: `layer(halfspaces, point)`.

    Attributes:
        metric: symmetric positive definite, (p, p) or (*batch, p, p). The norm is sqrt(z' metric z), the Mahalanobis
            norm if the metric is an inverse covariance, and Euclidean for None. It is a buffer, or a parameter if it
            is given as one.

    Raises:
        InputError: there is no such backend, dimensions or batches do not fit, or the metric is no batch of matrices.
        SolverError: the conic solver SCS failed (cvxpylayers).
    """

    metric: Tensor | None

    def __init__(self, metric: Float[Tensor, "*batch p p"] | None = None, backend: Backend = "exact"):
        super().__init__()
        self.backend = _known(backend)
        if metric is not None and (metric.ndim < 2 or metric.shape[-1] != metric.shape[-2]):
            raise InputError("metric", "(*batch, p, p)", tuple(metric.shape))
        if isinstance(metric, nn.Parameter):
            self.metric = metric
        else:
            self.register_buffer("metric", metric)

    def forward(self, halfspaces: Halfspaces, point: Float[Tensor, "*batch p"]) -> NearestPoint:
        if self.backend == "exact":
            return programmes.nearest_point(halfspaces, point, self.metric)
        from torchfsid.programmes import conic

        return conic.nearest_point(halfspaces, point, self.metric)

    def extra_repr(self) -> str:
        return f"backend={self.backend!r}, metric={None if self.metric is None else tuple(self.metric.shape)}"


def _known(backend: Backend) -> Backend:
    if backend not in get_args(Backend):
        raise InputError("backend", " or ".join(map(repr, get_args(Backend))), repr(backend))
    return backend
