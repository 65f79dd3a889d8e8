"""Sets as values: parts of a batch, other ways to build them, points in them, and how they are saved and shown."""

import io

import pytest
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

import torchfsid as fsid


def random_sets(batch: int, p: int, seed: int = 0) -> fsid.FeasibleSet:
    random = torch.Generator().manual_seed(seed)
    A = torch.randn(batch, 5, p, generator=random, dtype=torch.float64)
    box = fsid.FeasibleSet.from_box(-torch.ones(batch, p), torch.ones(batch, p))
    return box.intersect(fsid.Halfspaces(A, 0.4 * A.norm(dim=-1)), time=1.0)


def with_an_empty_one() -> fsid.FeasibleSet:
    """Three sets, the last of which is empty."""
    rows = torch.tensor([[[1.0, 0.0]]] * 3), torch.tensor([[0.5], [0.5], [-3.0]])
    return random_sets(3, 2).intersect(fsid.Halfspaces(*rows), time=2.0)


def same(one: fsid.FeasibleSet, other: fsid.FeasibleSet) -> bool:
    pairs = [
        (one.volume(), other.volume()),
        (one.vertices(), other.vertices()),
        (one.last_cut, other.last_cut),
        (one.outcome, other.outcome),
        (one.facets().source, other.facets().source),
        (one.contradiction.halfspaces.A, other.contradiction.halfspaces.A),
    ]
    return all(torch.equal(torch.nan_to_num(a, nan=-7.0), torch.nan_to_num(b, nan=-7.0)) for a, b in pairs)


@pytest.mark.parametrize("p", [1, 2, 3])
def test_parts_of_a_batch_are_the_sets_there(p: int) -> None:
    sets = random_sets(4, p)
    assert len(sets) == 4
    assert sets[0].batch_shape == ()
    assert sets[1:3].batch_shape == (2,)
    volumes = torch.stack([one.volume() for one in sets])
    torch.testing.assert_close(volumes, sets.volume())
    torch.testing.assert_close(sets[1:3].volume(), sets.volume()[1:3])
    torch.testing.assert_close(
        sets[sets.volume() > volumes.median()].volume(), sets.volume()[volumes > volumes.median()]
    )
    assert sets[0].contains(sets.centroid()[0])


def test_an_empty_set_stays_empty_in_a_part() -> None:
    sets = with_an_empty_one()
    assert sets[2].is_empty
    assert sets[1:].is_empty.tolist() == [False, True]
    assert sets[2].chebyshev()[1] == sets.chebyshev()[1][2]


@pytest.mark.parametrize("p", [1, 2, 3, 4])
def test_a_set_is_built_again_from_its_halfspaces(p: int) -> None:
    sets = random_sets(3, p)
    again = fsid.FeasibleSet.from_halfspaces(sets.halfspaces())
    pair = fsid.FeasibleSet.from_halfspaces((sets.halfspaces().A, sets.halfspaces().b))
    assert torch.equal(pair.volume(), again.volume())
    torch.testing.assert_close(again.volume(), sets.volume())
    torch.testing.assert_close(again.centroid(), sets.centroid())
    assert (again.facets().source >= 0)[(again.facets().halfspaces.A != 0).any(-1)].all()


def test_halfspaces_that_leave_a_set_open_or_empty() -> None:
    with pytest.raises(fsid.InputError, match="unbounded"):
        fsid.FeasibleSet.from_halfspaces(fsid.Halfspaces(torch.eye(2), torch.ones(2)))
    contradiction = fsid.Halfspaces(torch.tensor([[1.0, 0.0], [-1.0, 0.0]]), torch.tensor([-1.0, -1.0]))
    assert fsid.FeasibleSet.from_halfspaces(contradiction).is_empty
    empty = with_an_empty_one()
    assert not empty.halfspaces().contains(torch.zeros(3, 2))[2]
    assert fsid.FeasibleSet.from_halfspaces(empty.halfspaces()).is_empty.tolist() == [False, False, True]


def test_from_vertices_is_the_convex_hull_with_its_gradient() -> None:
    points = torch.randn(5, 9, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64, requires_grad=True)
    hulls = fsid.FeasibleSet.from_vertices(points)
    areas = torch.tensor([ConvexHull(of_one.detach()).volume for of_one in points], dtype=torch.float64)
    torch.testing.assert_close(hulls.volume(), areas)
    assert hulls.contains(points.detach().transpose(0, 1)).all()
    torch.testing.assert_close(fsid.FeasibleSet.from_vertices(hulls.vertices().detach()).volume(), areas)
    (slope,) = torch.autograd.grad(hulls.volume().sum(), points)
    torch.testing.assert_close((slope * points.detach()).sum(), 2 * areas.sum())  # areas grow with the square
    with pytest.raises(fsid.InputError, match="one line"):
        fsid.FeasibleSet.from_vertices(torch.tensor([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]))


def half_of(sets: fsid.FeasibleSet, axis: int) -> Tensor:
    """The share of each set on one side of its centroid."""
    rows = torch.zeros(len(sets), 1, sets.dim, dtype=torch.float64)
    rows[..., axis] = 1.0
    return sets.intersect(fsid.Halfspaces(rows, sets.centroid()[:, axis : axis + 1])).volume() / sets.volume()


@pytest.mark.parametrize("p", [1, 2, 3])
def test_samples_are_uniform(p: int) -> None:
    sets, n = random_sets(3, p), 4000
    points = sets.sample(n, generator=torch.Generator().manual_seed(2))
    assert points.shape == (n, 3, p)
    assert sets.contains(points).all()
    torch.testing.assert_close(points, sets.sample(n, generator=torch.Generator().manual_seed(2)))
    for axis in range(p):
        below = (points[..., axis] <= sets.centroid()[:, axis]).double().mean(0)
        assert ((below - half_of(sets, axis)).abs() < 4 * 0.5 / n**0.5).all()
    assert ((points.mean(0) - sets.centroid()).abs() < 4 * points.std(0) / n**0.5).all()


def test_samples_of_flat_and_empty_sets() -> None:
    points = with_an_empty_one().sample(10)
    assert points[:, :2].isfinite().all()
    assert points[:, 2].isnan().all()
    rows = fsid.Halfspaces(torch.tensor([[1.0, 0.0], [-1.0, 0.0]]), torch.tensor([0.25, -0.25]))
    flat = fsid.FeasibleSet.from_box(-torch.ones(2), torch.ones(2)).intersect(rows)
    assert flat.contains(flat.sample(50)).all()
    assert flat.sample(50)[:, 1].std() > 0.2


@pytest.mark.parametrize("p", [2, 3])
def test_sets_are_saved_and_read_back(p: int) -> None:
    sets = with_an_empty_one() if p == 2 else random_sets(2, 3)
    file = io.BytesIO()
    torch.save(sets.state_dict(), file)
    file.seek(0)
    again = fsid.FeasibleSet.from_state_dict(torch.load(file, weights_only=True))
    assert same(again, sets)
    rows = fsid.Halfspaces(torch.ones(1, p), torch.tensor([0.1]))
    assert same(again.intersect(rows, time=3.0), sets.intersect(rows, time=3.0))
    assert same(sets.to("cpu"), sets)


def test_a_set_with_gradients_keeps_them_on_another_device_and_loses_them_in_a_file() -> None:
    bound = torch.tensor([0.3], requires_grad=True, dtype=torch.float64)
    sets = fsid.FeasibleSet.from_box(-torch.ones(2), torch.ones(2)).intersect(
        fsid.Halfspaces(torch.tensor([[1.0, 0.0]]), bound)
    )
    (slope,) = torch.autograd.grad(sets.to("cpu").volume(), bound)
    torch.testing.assert_close(slope, torch.tensor([2.0], dtype=torch.float64))
    assert not fsid.FeasibleSet.from_state_dict(sets.state_dict()).volume().requires_grad


def test_a_set_is_shown_in_one_line() -> None:
    for shown in (repr(with_an_empty_one()), repr(random_sets(2, 3)[0]), repr(random_sets(0, 2))):
        assert len(shown) < 100
        assert "\n" not in shown
        assert "FeasibleSet" in shown
