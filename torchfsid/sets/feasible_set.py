r"""The feasible set Theta(t): where the parameter must lie, given everything seen so far (G., Eq. (3)).

    Theta(t) = Theta_0  intersected with all  Omega(tau), tau <= t          Theta_0 a box, the prior

A set is a value: `intersect` returns a new one. It is a batch of polygons, of polyhedra for p = 3, or of polytopes. All
are differentiable. Up to round-off, a set contains the truth if all half-spaces do. Its volume never grows, and it
stays bounded. The order of the half-spaces does not matter, and a smaller bound never gives a larger set. Its memory is
that of its facets. More than `max_facets` are merged outward. Each facet keeps its time and constraint.

An EMPTY item has volume 0 and contains nothing. Its centroid, vertices, diameter, support, Chebyshev centre and nearest
points are NaN. Its radius is minus the depth of the contradiction: the least distance by which the rows that contradict
each other have to be moved outward. All its gradients are zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import nan
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, array, finite, reals
from torchfsid.kernels import extent
from torchfsid.outcome import Outcome
from torchfsid.programmes.differentiable import inscribed_ball, symmetric
from torchfsid.sets.polygon import Polygon
from torchfsid.sets.polyhedron import Polyhedron
from torchfsid.sets.polytope import Polytope

MAX_FACETS = 32
"""Facets kept; more are merged outward. Costs below 1 % of the volume (tests/test_feasible_set.py)."""


class Facets(NamedTuple):
    """Rows A z <= b of a set, with the time [s] and the constraint (`source`) of each. The prior has NaN and -1."""

    halfspaces: Halfspaces
    time: Float[Tensor, "*batch f"]
    source: Int[Tensor, "*batch f"]


class Emptiness(NamedTuple):
    """Whether a set is empty, with a proof.

    Attributes:
        outcome: an `Outcome` per item. UNDECIDED means that a half-space touches the others within round-off. The set
            is what they leave after that half-space is moved outward by its round-off.
        witness: a point inside. NaN unless NONEMPTY.
        contradiction: the rows that contradict each other. NaN unless EMPTY.
    """

    outcome: Int[Tensor, "*batch"]
    witness: Float[Tensor, "*batch p"]
    contradiction: Facets


@dataclass(frozen=True)
class FeasibleSet:
    """A batch of bounded convex sets of parameters. Build it with `from_box`, shrink it with `intersect`.

    Attributes:
        body: the sets with the batch flattened, a `Polygon` for p = 2, a `Polyhedron` for p = 3, else a `Polytope`.
        batch_shape: the shape of the batch.
        outcome: an `Outcome` per item. An EMPTY item contains nothing and stays empty, whatever its body.
        contradiction: the rows that no parameter satisfies together, for EMPTY items.
        last_cut: the time of the intersection that last shrank the set [s]; NaN if there was none.
        max_facets: the largest number of facets that are kept.
    """

    body: Any
    batch_shape: torch.Size
    outcome: Int[Tensor, "*batch"]
    contradiction: Facets
    last_cut: Float[Tensor, "*batch"]
    max_facets: int

    @classmethod
    def from_box(
        cls, lower: Float[Tensor, "*batch p"], upper: Float[Tensor, "*batch p"], max_facets: int = MAX_FACETS
    ) -> FeasibleSet:
        """The prior Theta_0 = [lower, upper].

        Raises:
            InputError: shapes differ, p = 0, lower < upper fails somewhere, the box is not bounded, or `max_facets` are
                too few to bound a set.
        """
        lower, upper = reals("lower", lower), reals("upper", upper)
        if lower.shape != upper.shape or lower.ndim == 0 or lower.shape[-1] == 0:
            raise InputError("lower, upper", "two tensors (*batch, p)", (tuple(lower.shape), tuple(upper.shape)))
        if not bool((lower < upper).all()):
            raise InputError("lower, upper", "lower < upper in every coordinate", (lower.tolist(), upper.tolist()))
        if not finite(lower, upper):
            raise InputError("lower, upper", "a bounded box", (lower.tolist(), upper.tolist()))
        batch, p = lower.shape[:-1], lower.shape[-1]
        if max_facets < 2 * p:
            raise InputError("max_facets", f"at least {2 * p}, the facets of the prior box", max_facets)
        kind = Polygon if p == 2 else Polyhedron if p == 3 else Polytope
        nothing = lower.new_full((*batch, p + 1), float("nan"))
        return cls(
            body=kind.from_box(lower.reshape(-1, p), upper.reshape(-1, p)),
            batch_shape=batch,
            outcome=torch.full(batch, Outcome.NONEMPTY, device=lower.device),
            contradiction=Facets(
                Halfspaces(nothing.unsqueeze(-1).expand(*batch, p + 1, p), nothing),
                nothing,
                torch.full_like(nothing, -1).long(),
            ),
            last_cut=lower.new_full(batch, float("nan")),
            max_facets=max_facets,
        )

    @property
    def dim(self) -> int:
        return self.body.A.shape[-1]

    @property
    def is_empty(self) -> Bool[Tensor, "*batch"]:
        return self.outcome == Outcome.EMPTY

    @cached_property
    def any_empty(self) -> bool:
        """Is any of the sets empty?"""
        return bool((array(self.outcome) == Outcome.EMPTY).any())

    def intersect(
        self,
        halfspaces: Halfspaces,
        time: float | Float[Tensor, "*#batch m"] = float("nan"),
    ) -> FeasibleSet:
        """The part of the set inside the half-spaces.

        New facets keep the `time` [s] and the `source` of their rows (default: 0, 1, ...). A row that only touches the
        set within round-off is moved outward by that round-off and then applied, so that the result is an outer set. If
        merging facets would cost more than the cut has gained, the set stays as it was.

        Raises:
            InputError: dimension or batch do not fit, or a row is NaN or infinite.
        """
        p, m = self.dim, halfspaces.rows
        if halfspaces.dim != p or not _fits(halfspaces.batch_shape, self.batch_shape):
            expected = f"rows over R^{p} for a batch {tuple(self.batch_shape)}"
            raise InputError("halfspaces", expected, (tuple(halfspaces.A.shape), tuple(halfspaces.b.shape)))
        if not finite(halfspaces.A, halfspaces.b):
            raise InputError("halfspaces", "finite rows", "NaN or infinity")
        if m == 0:
            return self
        halfspaces = halfspaces.shortened()
        if self.any_empty:
            halfspaces = halfspaces.where(~self.is_empty.unsqueeze(-1))
        source = torch.arange(m, device=self.outcome.device) if halfspaces.source is None else halfspaces.source
        stamp = torch.as_tensor(time, dtype=torch.float64, device=self.outcome.device).expand(*self.batch_shape, m)
        rows = (
            self._flat(halfspaces.A, (m, p)),
            self._flat(halfspaces.b, (m,)),
            self._flat(stamp, (m,)).contiguous(),
            self._flat(source, (m,)),
        )
        clipped = self.body.clip(*rows, self.max_facets)
        body, decided = clipped.body, not bool(clipped.outcome.any())
        if body is self.body and decided:
            return self
        shape, outcome, against = self.batch_shape, self.outcome, self.contradiction
        if not decided:
            outcome = torch.maximum(outcome, clipped.outcome.reshape(shape))
            found = clipped.contradiction
            fresh = Facets(
                Halfspaces(found.A.reshape(*shape, p + 1, p), found.b.reshape(*shape, p + 1)),
                found.time.reshape((*shape, p + 1)),
                found.source.reshape((*shape, p + 1)),
            )
            against = _choose(self.is_empty, against, fresh)
        last_cut = torch.where(clipped.shrunk.reshape(shape), stamp.amax(-1), self.last_cut)
        return replace(self, body=body, outcome=outcome, contradiction=against, last_cut=last_cut)

    def where(self, mask: Bool[Tensor, "*batch"], other: FeasibleSet) -> FeasibleSet:
        """This set where `mask`, `other` elsewhere."""
        items = (~mask).expand(self.batch_shape).reshape(-1).nonzero().squeeze(-1)
        return replace(
            self,
            body=self.body.replaced(items, other.body.select(items)),
            outcome=torch.where(mask, self.outcome, other.outcome),
            contradiction=_choose(mask, self.contradiction, other.contradiction),
            last_cut=torch.where(mask, self.last_cut, other.last_cut),
        )

    def select(self, items: Int[Tensor, "k"] | Bool[Tensor, "B"]) -> FeasibleSet:
        """The sets at the places `items` of a batch (B,), or where the mask `items` is True. A place may occur twice.

        Raises:
            InputError: there is no batch, or no such place.
        """
        try:
            items = torch.arange(len(self.outcome), device=self.outcome.device)[items]
        except (IndexError, TypeError) as error:
            expected = f"places in, or a mask of, a batch (B,) of sets, here {tuple(self.batch_shape)}"
            raise InputError("items", expected, items) from error
        against = self.contradiction
        rows = Halfspaces(against.halfspaces.A[items], against.halfspaces.b[items])
        return replace(
            self,
            body=self.body.select(items),
            batch_shape=items.shape,
            outcome=self.outcome[items],
            contradiction=Facets(rows, against.time[items], against.source[items]),
            last_cut=self.last_cut[items],
        )

    @classmethod
    def concatenate(cls, parts: Sequence[FeasibleSet]) -> FeasibleSet:
        """Several batches (B,) of sets as one, one after the other.

        Raises:
            InputError: there are no parts, or they have different dimensions or no batch.
        """
        if len({part.dim for part in parts}) != 1 or any(len(part.batch_shape) != 1 for part in parts):
            expected = "batches (B,) of sets of the same dimension"
            raise InputError("parts", expected, [(tuple(part.batch_shape), part.dim) for part in parts])
        places = torch.arange(sum(len(part.outcome) for part in parts), device=parts[0].outcome.device)
        whole, last = parts[0].select(torch.zeros_like(places)), 0
        for part in parts:
            first, last = last, last + len(part.outcome)
            whole = replace(whole, body=whole.body.replaced(places[first:last], part.body))
        against = [part.contradiction for part in parts]
        rows = [facets.halfspaces for facets in against]
        return replace(
            whole,
            outcome=torch.cat([part.outcome for part in parts]),
            contradiction=Facets(
                Halfspaces(torch.cat([row.A for row in rows]), torch.cat([row.b for row in rows])),
                torch.cat([facets.time for facets in against]),
                torch.cat([facets.source for facets in against]),
            ),
            last_cut=torch.cat([part.last_cut for part in parts]),
        )

    def emptiness(self) -> Emptiness:
        """Whether a parameter is left, with a proof of either answer."""
        sure = (self.outcome == Outcome.NONEMPTY).unsqueeze(-1)
        return Emptiness(self.outcome, torch.where(sure, self.chebyshev()[0], float("nan")), self.contradiction)

    def facets(self) -> Facets:
        """The half-spaces that form the set, padded with 0.z <= 1. An EMPTY item gives those of the set before."""
        A, b = self.body.rows()
        return Facets(
            Halfspaces(self._batched(A), self._batched(b)),
            self._batched(self.body.time),
            self._batched(self.body.source),
        )

    def contains(self, theta: Float[Tensor, "*batch p"], tolerance: float = 1e-9) -> Bool[Tensor, "*batch"]:
        """Is theta in the set, up to round-off and `tolerance` times the set's diameter?

        Raises:
            InputError: theta is not (*batch, p).
        """
        batch, p = self.batch_shape, self.dim
        points = self._given("theta", theta, (p,), broadcast=True).detach()
        points = points.expand(torch.broadcast_shapes(points.shape, (*batch, p)))
        shape = points.shape[: points.ndim - 1 - len(batch)].numel(), batch.numel(), p
        sets = self.body.corners, self.body.A, self.body.b, self.body.reach
        inside = torch.from_numpy(extent.contains(*map(array, sets), array(points.reshape(shape)), tolerance))
        return inside.to(self.outcome.device).reshape(points.shape[:-1]) & ~self.is_empty

    def volume(self) -> Float[Tensor, "*batch"]:
        """The length for p = 1, the area in the plane, the volume for p >= 3. 0 for an EMPTY item."""
        return self._unless_empty(self.body.volume(), 0.0)

    def vertices(self) -> Float[Tensor, "*batch v p"]:
        """The vertices, padded by repeating the first one, counter-clockwise in the plane. NaN for an EMPTY item."""
        return self._unless_empty(self.body.vertices)

    def chebyshev(self) -> tuple[Float[Tensor, "*batch p"], Float[Tensor, "*batch"]]:
        """Centre and radius of a largest inscribed ball.

        In elongated sets the centre may jump from one measurement to the next; `centroid` does not. The centre of an
        EMPTY item is NaN, its radius minus the depth of the contradiction.
        """
        centre, radius = self.body.chebyshev()
        return self._unless_empty(centre), self._unless_empty(radius, -self._depth() if self.any_empty else nan)

    def centroid(self) -> Float[Tensor, "*batch p"]:
        """The centre of volume. NaN for an EMPTY item."""
        return self._unless_empty(self.body.centroid())

    def diameter(self) -> Float[Tensor, "*batch"]:
        """The largest distance between two points of the set. NaN for an EMPTY item."""
        return self._unless_empty(self.body.diameter())

    def support(self, direction: Float[Tensor, "*batch p"]) -> Float[Tensor, "*batch"]:
        """The support function h(n) = max n.theta over the set, n the `direction`. NaN for an EMPTY item.

        Raises:
            InputError: direction is not (*batch, p).
        """
        flat = self._flat(self._given("direction", direction, (self.dim,)), (self.dim,))
        return self._unless_empty(self.body.support(flat.unsqueeze(1)).squeeze(-1))

    def project(
        self, point: Float[Tensor, "*batch p"], metric: Float[Tensor, "*batch p p"] | None = None
    ) -> Float[Tensor, "*batch p"]:
        """The point of the set nearest to `point` in the norm sqrt(z' metric z) (default: Euclidean).

        Only the symmetric part of the metric counts. The result is NaN, with zero gradients, for an EMPTY item, and
        where the metric is not positive definite, or the point or the metric is not finite.

        Raises:
            InputError: point is not (*batch, p), or metric is not (*batch, p, p).
        """
        p = self.dim
        flat = self._flat(self._given("point", point, (p,)), (p,))
        known = flat.isfinite().all(-1)
        if metric is not None:
            metric = self._flat(symmetric(self._given("metric", metric, (p, p))), (p, p))
            known = known & metric.isfinite().all((-1, -2))
            identity = torch.eye(p, dtype=metric.dtype, device=metric.device)
            _, fault = torch.linalg.cholesky_ex(torch.where(known[:, None, None], metric, identity).detach())
            known = known & (fault == 0)
            metric = torch.where(known[:, None, None], metric, identity)
        nearest = self.body.nearest(torch.where(known.unsqueeze(-1), flat, 0.0), metric)
        return self._unless_empty(torch.where(known.unsqueeze(-1), nearest, nan))

    def _depth(self) -> Float[Tensor, "*batch"]:
        """The depth of the contradictions. NaN where there is none, or where it has no finite depth."""
        against = self.contradiction.halfspaces
        known = ~(against.A.isnan().any(-1) | against.b.isnan())
        _, radius, _ = inscribed_ball(Halfspaces(against.A, against.b).where(known))
        return torch.where(radius.detach() < 0, -radius.detach(), nan)

    def _unless_empty(self, flat: Tensor, instead: float | Tensor = nan) -> Tensor:
        """The values `flat` in the shape of the batch, with `instead` for the EMPTY items."""
        answer = self._batched(flat)
        if not self.any_empty:
            return answer
        return torch.where(self.is_empty.reshape((*self.batch_shape, *[1] * (flat.ndim - 1))), instead, answer)

    def _given(self, name: str, value: Tensor, shape: tuple[int, ...], broadcast: bool = False) -> Tensor:
        """The value in float64. It must hold one item of `shape` per set. With `broadcast` it may hold several."""
        value = reals(name, value)
        batch, inner = value.shape[: value.ndim - len(shape)], tuple(value.shape[value.ndim - len(shape) :])
        fits = inner == shape and _fits(
            batch[max(0, len(batch) - len(self.batch_shape)) if broadcast else 0 :], self.batch_shape
        )
        if not fits:
            raise InputError(
                name, f"(*batch, {', '.join(map(str, shape))}), batch {tuple(self.batch_shape)}", tuple(value.shape)
            )
        return value

    def _flat(self, rows: Tensor, shape: tuple[int, ...]) -> Tensor:
        """One item of `shape` for each set, with the batch flattened."""
        expanded = (*self.batch_shape, *shape)
        rows = rows if rows.shape == expanded else rows.expand(expanded)
        return rows if len(self.batch_shape) == 1 else rows.reshape(-1, *shape)

    def _batched(self, flat: Tensor) -> Tensor:
        return flat.reshape((*self.batch_shape, *flat.shape[1:]))


def _fits(shape: torch.Size, batch: torch.Size) -> bool:
    """Do rows of this batch shape broadcast to the sets' batch?"""
    return len(shape) <= len(batch) and all(n in (1, N) for n, N in zip(reversed(shape), reversed(batch), strict=False))


def _choose(mask: Bool[Tensor, "*batch"], mine: Facets, other: Facets) -> Facets:
    rows = mask.unsqueeze(-1)
    return Facets(
        Halfspaces(
            torch.where(rows.unsqueeze(-1), mine.halfspaces.A, other.halfspaces.A),
            torch.where(rows, mine.halfspaces.b, other.halfspaces.b),
        ),
        torch.where(rows, mine.time, other.time),
        torch.where(rows, mine.source, other.source),
    )
