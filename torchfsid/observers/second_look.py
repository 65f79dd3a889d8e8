r"""A second look at a whole log, for robots with unknown safety parameters: smaller sets Psi and Theta.

An observer reads a sample once, with the Psi of its time. In a file, samples are read again once Psi is small. What may
still be active or not is settled by splitting Psi along a row's own line w_j = high_j:

    w_j <= high_j    the row may be active, and is a generator
    w_j >= high_j    the row is inactive

Each cell is contracted by itself (`safety_parameters`), with the samples that still have an undecided row. A cell in
which a set is empty is dropped. The solutions lie in the union of the cells that are left, and the sets returned are
convex sets around it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.safety_parameters import LearningModel, Possible
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.unknown_avoidance import UnknownAvoidance, extremes
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.tolerances import ROUND_OFF

ITEMS = 16384
"""Robots times samples that are read at once."""

MOST_CELLS = 16
"""Cells of Psi, beyond which none is split."""

ROUNDS = 3
"""Times that samples are read in turn at most."""

SHRUNK = 0.95
"""Samples are read again while that leaves less than this fraction of Psi."""

LEAST_SHARE = 1e-3
"""A line divides Psi only if it leaves at least this fraction of the width on either side. A wide Psi has its small
gains, which differ most in the speeds that they allow, in such a corner."""

BESIDE = 1e-9
"""A split is moved to the permissive side by this fraction of the width of Psi, so that no row stays on its line."""


@dataclass(frozen=True)
class Samples:
    """Some samples of all robots, and what is known of their rows.

    Attributes:
        measurement: the samples concatenated, items = samples x robots.
        settled: rows that a split has decided.
        undecided: rows that Psi leaves undecided, and no split has settled.
        high: the half-planes w_j <= high_j.
    """

    measurement: Measurement
    settled: Bool[Tensor, "items m"]
    undecided: Bool[Tensor, "items m"]
    high: Halfspaces

    def open(self, robots: int) -> Samples:
        """The samples in which a row of some robot is undecided."""
        items = self.undecided.any(-1).unflatten(0, (-1, robots)).any(-1).repeat_interleave(robots)
        if bool(items.all()):
            return self
        high = Halfspaces(self.high.A[items], self.high.b[items])
        return Samples(self.measurement.select(items), self.settled[items], self.undecided[items], high)


@dataclass(frozen=True)
class Cell:
    """A part of the solutions, with the samples whose rows it leaves undecided."""

    possible: Possible
    samples: tuple[Samples, ...]

    def split(self) -> tuple[Cell, Cell] | None:
        """Two cells, one on each side of the line of an undecided row that divides Psi best. None if there is none."""
        corners = self.possible.psi.vertices()[0]
        best: tuple[float, int, int, int] = (LEAST_SHARE, -1, -1, -1)
        for k, samples in enumerate(self.samples):
            items, rows = samples.undecided.nonzero().unbind(-1)
            if len(items) == 0:
                continue
            w = samples.high.A[items, rows] @ corners.T - samples.high.b[items, rows].unsqueeze(-1)
            low, high = extremes(w).unbind(-1)
            balance = torch.minimum(-low, high) / (high - low)
            place = int(balance.argmax())
            if float(balance[place]) > best[0]:
                best = (float(balance[place]), k, int(items[place]), int(rows[place]))
        _, k, item, row = best
        if k < 0:
            return None
        settled = self.samples[k].settled.clone()
        settled[item, row] = True
        samples = (*self.samples[:k], replace(self.samples[k], settled=settled), *self.samples[k + 1 :])
        a, b = self.samples[k].high.A[item, row], self.samples[k].high.b[item, row]
        w = corners @ a
        beside = b + BESIDE * (w.max() - w.min())
        possible = self.possible
        sides = (
            Halfspaces(sign * a[None, None], sign * beside[None, None], torch.full((1, 1), -1)) for sign in (1, -1)
        )
        active, inactive = (Cell(replace(possible, psi=possible.psi.intersect(side)), samples) for side in sides)
        return active, inactive


def second_look(
    model: LearningModel, possible: Possible, measurements: Sequence[Measurement], most: int = MOST_CELLS
) -> Possible:
    """The sets that are left of robots who share one Psi, after samples are read again.

    Args:
        model: the declared model.
        possible: the sets so far, with one Psi.
        measurements: the samples of these robots.
        most: the largest number of cells.

    Returns:
        Smaller sets. If no parameters explain the motions, some of them are EMPTY.
    """
    robots, first = len(possible.owner), Cell(possible, ())
    size = max(1, ITEMS // max(robots, 1))
    samples = []
    for k in range(0, len(measurements), size):
        together = Measurement.concatenate(measurements[k : k + size])
        unread = torch.zeros(len(together.x), together.bodies.shape[-2], dtype=torch.bool)
        samples.append(
            Samples(together, unread, unread, Halfspaces(torch.zeros(*unread.shape, 2), torch.ones(unread.shape)))
        )
    first = _contracted(model, replace(first, samples=tuple(samples)))
    if bool(first.possible.is_empty.any()):
        return first.possible
    cells, leaves = [first], []
    while cells and len(cells) + len(leaves) < most:
        cells.sort(key=lambda cell: float(cell.possible.psi.volume()))
        cell = cells.pop()
        children = cell.split()
        if children is None:
            leaves.append(cell)
            continue
        for child in children:
            if not bool(child.possible.is_empty.any()):
                contracted = _contracted(model, child)
                if not bool(contracted.possible.is_empty.any()):
                    cells.append(contracted)
    return _around(model.unknown, first.possible, [cell.possible for cell in (*leaves, *cells)])


def _contracted(model: LearningModel, cell: Cell) -> Cell:
    """The cell after its samples are read, again and again while that pays. Samples without undecided rows are left."""
    possible, samples, robots = cell.possible, cell.samples, len(cell.possible.owner)
    for _ in range(ROUNDS):
        before, found = float(possible.psi.volume()), []
        for part in samples:
            read = model.read(possible, part.measurement)
            times = torch.as_tensor(part.measurement.t, dtype=torch.float64)
            psi = read.cuts.apply(possible.psi, possible.owner, times)
            possible = replace(possible, theta=read.theta, psi=psi)
            if bool(possible.is_empty.any()):
                return Cell(possible, ())
            undecided = read.undecided & ~part.settled
            found.append(Samples(part.measurement, part.settled, undecided, read.high).open(robots))
        samples = tuple(part for part in found if len(part.measurement.x) > 0)
        if not samples or float(possible.psi.volume()) > SHRUNK * before:
            break
    return Cell(possible, samples)


def _around(unknown: UnknownAvoidance, before: Possible, cells: Sequence[Possible]) -> Possible:
    """Convex sets around the union of the cells, inside the sets before. EMPTY if there are no cells."""
    if len(cells) == 0:
        nothing = Halfspaces(torch.zeros(1, 2), torch.full((1,), -1.0))
        return replace(before, psi=before.psi.intersect(nothing))
    if len(cells) == 1:
        return cells[0]
    corners = torch.cat([cell.psi.vertices() for cell in cells], dim=-2)
    ratio = extremes(unknown.split(corners)[1])
    zero, one = torch.zeros_like(ratio[..., 0]), torch.ones_like(ratio[..., 0])
    rays = [torch.stack(pair, -1) for pair in ((one, zero), (-one, zero), (ratio[..., 0], -one), (-ratio[..., 1], one))]
    psi = before.psi.intersect(_rows_around([cell.psi for cell in cells], torch.stack(rays, dim=-2)))
    theta = before.theta.intersect(_rows_around([cell.theta for cell in cells]))
    return replace(before, theta=theta, psi=psi)


def _rows_around(sets: Sequence[FeasibleSet], more: Float[Tensor, "B k p"] | None = None) -> Halfspaces:
    """Half-spaces around the union of sets, with the normals of all their facets, and `more`."""
    facets = [each.facets() for each in sets]
    normals, source = torch.cat([of.halfspaces.A for of in facets], dim=-2), torch.cat([of.source for of in facets], -1)
    if more is not None:
        normals = torch.cat([normals, more], dim=-2)
        source = torch.cat([source, torch.full(more.shape[:-1], -1)], dim=-1)
    corners = torch.cat([each.vertices() for each in sets], dim=-2)
    reach = normals @ corners.mT
    round_off = ROUND_OFF * (normals.abs() @ corners.abs().mT).amax(-1)
    return Halfspaces(normals, reach.amax(-1) + round_off, source).where((normals != 0).any(-1))
