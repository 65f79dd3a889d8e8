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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import nan
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchfsid.device import has_kernels
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces, array, as_halfspaces, finite
from torchfsid.outcome import Status
from torchfsid.programmes.differentiable import inscribed_ball, symmetric
from torchfsid.sets import given, sampling, saved, searches
from torchfsid.sets.facets import Emptiness, Facets

MAX_FACETS = 32
"""Facets kept; more are merged outward. Costs below 1 % of the volume (tests/test_feasible_set.py)."""


@dataclass(frozen=True)
class FeasibleSet:
    """A batch of bounded convex sets of parameters. Build it with `from_box`, shrink it with `intersect`.

    `sets[0]` and `sets[1:3]` are parts of a batch, `one[None]` is a batch of one. Its shape is free, but
    `torch.func.vmap` does not run over sets: searches look at the numbers. The layers of `programmes` take sets, too.

    Attributes:
        body: the sets with the batch flattened, a `Polygon` for p = `dim` = 2, a `Polyhedron` for 3, else a `Polytope`.
        batch_shape: the shape of the batch.
        outcome: a `Status` per item, EMPTY where `is_empty`: it contains nothing and stays so, whatever its body.
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
        lower, upper = given.box(lower, upper)
        batch, p = lower.shape[:-1], lower.shape[-1]
        if max_facets < 2 * p:
            raise InputError("max_facets", f"at least {2 * p}, the facets of the prior box", max_facets)
        return cls(
            body=saved.kind_of(p).from_box(lower.reshape(-1, p), upper.reshape(-1, p)),
            batch_shape=batch,
            outcome=torch.full(batch, Status.OK, device=lower.device),
            contradiction=Facets.none(batch, p, lower),
            last_cut=lower.new_full(batch, float("nan")),
            max_facets=max_facets,
        )

    @classmethod
    def from_halfspaces(
        cls, halfspaces: Halfspaces | tuple[Tensor, Tensor], max_facets: int = MAX_FACETS
    ) -> FeasibleSet:
        """The sets {theta : A theta <= b}, given as `Halfspaces` or as a pair (A, b), with the gradients of their rows.

        Raises:
            InputError: they are neither, a set is not bounded, or a row is NaN or infinite.
        """
        rows = as_halfspaces(halfspaces)
        return cls.from_box(*given.box_around(rows), max_facets).intersect(rows)

    @classmethod
    def from_vertices(cls, vertices: Float[Tensor, "*batch v 2"], max_facets: int = MAX_FACETS) -> FeasibleSet:
        """The convex hulls of points in the plane, in any order, with the gradients of the points.

        Raises:
            InputError: they are no points in the plane, not finite, or on one line.
        """
        corners = given.planar(vertices)
        return cls.from_box(*given.box_around_points(corners), max_facets).intersect(given.edges_of(corners))

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> FeasibleSet:
        """The sets that `state_dict` was called for. They have no gradients."""
        return cls(**saved.read(state))

    def state_dict(self) -> dict[str, Any]:
        """The sets as tensors by name, for `torch.save`, without gradients. `torch.load` needs no more than them."""
        return saved.state_of(self)

    def to(self, device: torch.device | str) -> FeasibleSet:
        """The sets on another device, with their gradients. The numbers stay in float64."""
        return saved.mapped(self, lambda part: part.to(device))

    def __repr__(self) -> str:
        return saved.described(self)

    def __len__(self) -> int:
        return len(self.outcome)

    def __getitem__(self, index: Any) -> FeasibleSet:
        """The sets at the places `index` of the batch, which indexes it like a tensor."""
        places = torch.arange(self.batch_shape.numel(), device=self.outcome.device).reshape(self.batch_shape)
        return self._at(places[index])

    @property
    def dim(self) -> int:
        return self.body.A.shape[-1]

    @cached_property
    def is_empty(self) -> Bool[Tensor, "*batch"]:
        return self.outcome == Status.EMPTY

    @cached_property
    def any_empty(self) -> bool:
        return bool(((array(self.outcome) if self.outcome.is_cpu else self.outcome) == Status.EMPTY).any())

    def intersect(self, halfspaces: Halfspaces, time: float | Float[Tensor, "*#batch m"] = nan) -> FeasibleSet:
        """The part of the set inside the half-spaces.

        New facets keep the `time` [s] and the `source` of their rows (default: 0, 1, ...). A row that only touches the
        set within round-off is moved outward by that round-off and then applied, so that the result is an outer set. If
        merging facets would cost more than the cut has gained, the set stays as it was. On a GPU with kernels nothing
        waits for the check that rows are finite: those that are not do not cut.

        Raises:
            InputError: dimension or batch do not fit, or a row is NaN or infinite.
        """
        p, m = self.dim, halfspaces.rows
        if halfspaces.dim != p or not given.fits(halfspaces.batch_shape, self.batch_shape):
            expected = f"rows over R^{p} for a batch {tuple(self.batch_shape)}"
            raise InputError("halfspaces", expected, (tuple(halfspaces.A.shape), tuple(halfspaces.b.shape)))
        waits = p not in (2, 3) or not has_kernels(halfspaces.A, halfspaces.b, self.outcome)
        if waits and not finite(halfspaces.A, halfspaces.b):
            raise InputError("halfspaces", "finite rows", "NaN or infinity")
        if m == 0:
            return self
        halfspaces = halfspaces.shortened() if waits else halfspaces
        if self.any_empty:
            halfspaces = halfspaces.where(~self.is_empty.unsqueeze(-1))
        source = torch.arange(m, device=self.outcome.device) if halfspaces.source is None else halfspaces.source
        stamp = given.stamp(time, self.outcome)
        rows = (halfspaces.A, (m, p)), (halfspaces.b, (m,)), (stamp.expand(*self.batch_shape, m), (m,)), (source, (m,))
        clipped = self.body.clip(*(self._flat(part, shape) for part, shape in rows), self.max_facets)
        body, lost, shape = clipped.body, clipped.contradiction, self.batch_shape
        decided = lost is None or (waits and not bool(clipped.outcome.any()))
        if body is self.body and decided:
            return self
        last_cut = torch.where(clipped.shrunk.reshape(shape), stamp.amax(-1), self.last_cut)
        if lost is None or decided:
            return replace(self, body=body, last_cut=last_cut).knowing(self.any_empty)
        outcome = torch.maximum(self.outcome, clipped.outcome.reshape(shape))
        against = self.contradiction.where(self.is_empty, Facets.of(lost.parts, shape))
        return replace(self, body=body, outcome=outcome, contradiction=against, last_cut=last_cut)

    def knowing(self, any_empty: bool) -> FeasibleSet:
        """This set. Whether any of it is EMPTY was found out with something else, so that nobody has to look again."""
        vars(self)["any_empty"] = any_empty
        return self

    def where(self, mask: Bool[Tensor, "*batch"], other: FeasibleSet) -> FeasibleSet:
        """This set where `mask`, `other` elsewhere."""
        items = (~mask).expand(self.batch_shape).reshape(-1).nonzero().squeeze(-1)
        return replace(
            self,
            body=self.body.replaced(items, other.body.select(items)),
            outcome=torch.where(mask, self.outcome, other.outcome),
            contradiction=self.contradiction.where(mask, other.contradiction),
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
        return self._at(items)

    def _at(self, places: Int[Tensor, "*places"]) -> FeasibleSet:
        """The sets at these places of the flattened batch."""
        return replace(
            self,
            body=self.body.select(places.reshape(-1)),
            batch_shape=places.shape,
            outcome=self.outcome.reshape(-1)[places],
            contradiction=self.contradiction.at(places, len(self.batch_shape)),
            last_cut=self.last_cut.reshape(-1)[places],
        )

    @classmethod
    def concatenate(cls, parts: Sequence[FeasibleSet]) -> FeasibleSet:
        """Several batches (B,) of sets as one, one after the other.

        Raises:
            InputError: there are no parts, or they have different dimensions or no batch.
        """
        return saved.joined(parts)

    def emptiness(self) -> Emptiness:
        """Whether a parameter is left, with a proof of either answer."""
        sure = (self.outcome == Status.OK).unsqueeze(-1)
        return Emptiness(self.outcome, torch.where(sure, self.chebyshev()[0], float("nan")), self.contradiction)

    def facets(self) -> Facets:
        """The half-spaces that form the set, padded with 0.z <= 1. An EMPTY item gives those of the set before."""
        A, b = self.body.rows()
        return Facets.of((A, b, self.body.time, self.body.source), self.batch_shape)

    def halfspaces(self) -> Halfspaces:
        """Rows A theta <= b that say what the set is, padded. Those of an EMPTY item contradict each other."""
        rows = self.facets().halfspaces
        if not self.any_empty:
            return rows
        lost, against = self.is_empty.unsqueeze(-1), self.contradiction.known
        return Halfspaces.stack([rows.where((~lost).expand_as(rows.b)), against.where(lost.expand_as(against.b))])

    def sample(self, n: int, generator: torch.Generator | None = None) -> Float[Tensor, "n *batch p"]:
        """`n` points of each set, uniformly distributed, without gradients. NaN for an EMPTY item.

        Args:
            n: the number of points.
            generator: the source of randomness. None: torch's own.
        """
        corners = self.vertices()
        points = sampling.uniform(corners.reshape(-1, *corners.shape[-2:]), n, generator)
        return points.reshape(n, *self.batch_shape, self.dim)

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
        inside = searches.contains(*sets, points.reshape(shape).transpose(0, 1), tolerance)
        return inside.transpose(0, 1).reshape(points.shape[:-1]) & ~self.is_empty

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
            metric, is_definite = given.definite(metric)
            known = known & is_definite
        nearest = self.body.nearest(torch.where(known.unsqueeze(-1), flat, 0.0), metric)
        return self._unless_empty(torch.where(known.unsqueeze(-1), nearest, nan))

    def _depth(self) -> Float[Tensor, "*batch"]:
        """The depth of the contradictions. NaN where there is none, or where it has no finite depth."""
        _, radius, _ = inscribed_ball(self.contradiction.known)
        return torch.where(radius.detach() < 0, -radius.detach(), nan)

    def _unless_empty(self, flat: Tensor, instead: float | Tensor = nan) -> Tensor:
        """The values `flat` in the shape of the batch, with `instead` for the EMPTY items."""
        answer = self._batched(flat)
        if not self.any_empty:
            return answer
        return torch.where(self.is_empty.reshape((*self.batch_shape, *[1] * (flat.ndim - 1))), instead, answer)

    def _given(self, name: str, value: object, shape: tuple[int, ...], broadcast: bool = False) -> Tensor:
        return given.per_set(name, value, shape, self.batch_shape, broadcast)

    def _flat(self, rows: Tensor, shape: tuple[int, ...]) -> Tensor:
        """One item of `shape` for each set, with the batch flattened."""
        expanded = (*self.batch_shape, *shape)
        rows = rows if rows.shape == expanded else rows.expand(expanded)
        return rows if len(self.batch_shape) == 1 else rows.reshape(-1, *shape)

    def _batched(self, flat: Tensor) -> Tensor:
        return flat.reshape((*self.batch_shape, *flat.shape[1:]))
