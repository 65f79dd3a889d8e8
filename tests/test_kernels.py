"""The compiled clip and disc against torch, their reference: the same sets up to round-off, the same provenance.

Scenes whose decisions hang on the last bit (a row exactly at a tolerance) are not among the random ones.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from torchfsid.halfspaces import Halfspaces
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.sets.polygon import Polygon, _inscribed_basis


def square(count: int, half: float = 6.0, **options) -> FeasibleSet:
    corner = torch.full((count, 2), half, dtype=torch.float64)
    return FeasibleSet.from_box(-corner, corner, **options)


def rows_around(rng: np.random.Generator, truth: np.ndarray, width: float) -> Halfspaces:
    """Rows of all scales near the truth, a few of which exclude it by far more than round-off."""
    angle, count = rng.uniform(0, 2 * np.pi, (len(truth), 6)), len(truth)
    A = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * 10 ** rng.uniform(-2, 2, (count, 6, 1))
    distance = rng.uniform(0.1, 1.0, (count, 6)) * width
    distance[rng.uniform(size=count) < 0.02, 0] *= -3
    b = (A * truth[:, None]).sum(-1) + distance * np.linalg.norm(A, axis=-1)
    return Halfspaces(torch.from_numpy(A), torch.from_numpy(b))


@pytest.mark.parametrize("max_facets", [32, 5])
@pytest.mark.parametrize("width", [1e-3, 1e-9])
def test_clipping_and_merging(width: float, max_facets: int) -> None:
    """200 sets that get as thin as `width` in 20 updates: vertices, provenance, outcomes and contradictions."""
    rng = np.random.default_rng(6)
    truth = rng.uniform(-3, 3, (200, 2))
    reference, compiled = square(200, max_facets=max_facets), square(200, max_facets=max_facets)
    for step in range(20):
        rows = rows_around(rng, truth, max(width, 10.0 ** (-step / 2)))
        reference = reference.intersect(rows, float(step), compiled=False)
        compiled = compiled.intersect(rows, float(step), compiled=True)
    assert int(reference.is_empty.sum()) > 10
    assert torch.equal(compiled.outcome, reference.outcome)
    assert torch.equal(compiled.body.count, reference.body.count)
    assert int(compiled.body.count.max()) <= max_facets
    for mine, other in (
        (compiled.last_cut, reference.last_cut),
        *zip(facets(compiled), facets(reference), strict=True),
    ):
        torch.testing.assert_close(mine, other, rtol=1e-12, atol=1e-13, equal_nan=True)


def facets(sets: FeasibleSet) -> list[Tensor]:
    """Vertices and edges with their provenance, then the contradictions."""
    found, against, slots = sets.facets(), sets.contradiction, int(sets.body.count.max())
    columns = [sets.body.vertices, found.halfspaces.A, found.halfspaces.b, found.time, found.source]
    evidence = [against.halfspaces.A, against.halfspaces.b, against.time, against.source]
    return [column[:, :slots] for column in columns] + evidence


def test_inscribed_disc() -> None:
    """Polygons of all thicknesses: the search in scalar code finds a disc as large as the one in torch."""
    rng = np.random.default_rng(7)
    sets = square(300)
    for step in range(8):
        sets = sets.intersect(rows_around(rng, rng.uniform(-1, 1, (300, 2)) * 10.0**-step, 10.0**-step))
    centre, radius = sets.chebyshev()
    A, b = sets.body.A, sets.body.b
    unit = Halfspaces(A, b).normalised()
    padded = ~sets.body.valid
    offsets = (unit.b - (unit.A @ centre.unsqueeze(-1)).squeeze(-1)).masked_fill(padded, torch.inf)
    basis = _inscribed_basis(unit.A.masked_fill(padded.unsqueeze(-1), 0.0), offsets, sets.body.count)
    touching = offsets.gather(1, basis)
    torch.testing.assert_close(touching, radius.unsqueeze(-1).expand(-1, 3), rtol=1e-7, atol=1e-13)


def test_sets_are_values() -> None:
    """An update makes new polygons: what was kept of an earlier time does not change."""
    before = square(3)
    kept = replace(before.body, vertices=before.body.vertices.clone())
    after = before.intersect(rows_around(np.random.default_rng(9), np.zeros((3, 2)), 1.0), compiled=True)
    assert torch.equal(before.body.vertices, kept.vertices)
    assert (after.volume() < before.volume()).all()
    assert isinstance(after.body, Polygon)
    assert after.intersect(Halfspaces(torch.ones(3, 1, 2), torch.full((3, 1), 99.0)), compiled=True) is after
