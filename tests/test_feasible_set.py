"""Theta(t) keeps its promises (check 5): truth inside, volume never grows; the facet cap, provenance, emptiness."""

import math

import pytest
import torch

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.outcome import Status
from torchfsid.sets.feasible_set import MAX_FACETS, FeasibleSet

TRUTH = {1: [0.3], 2: [0.3, -1.2], 3: [0.3, -1.2, 0.8], 4: [0.3, -1.2, 0.8, 0.1]}


def box(p: int, batch: int = 3, **options: int) -> FeasibleSet:
    return FeasibleSet.from_box(torch.full((batch, p), -2.0), torch.full((batch, p), 2.0), **options)


def around(truth: torch.Tensor, rows: int, width: float, generator: torch.Generator) -> Halfspaces:
    """Random half-spaces whose boundaries pass within `width` of a truth they contain."""
    A = torch.randn(*truth.shape[:-1], rows, truth.shape[-1], generator=generator, dtype=torch.float64)
    margin = width * torch.rand(A.shape[:-1], generator=generator, dtype=torch.float64)
    return Halfspaces(A, (A @ truth.unsqueeze(-1)).squeeze(-1) + margin * A.norm(dim=-1))


@pytest.mark.parametrize("p", [1, 2, 3, 4])
def test_truth_stays_inside_and_volume_never_grows(p: int) -> None:
    generator = torch.Generator().manual_seed(p)
    truth = torch.tensor(TRUTH[p], dtype=torch.float64).expand(3, p)
    theta, volume = box(p), torch.full((3,), 4.0**p, dtype=torch.float64)
    for k in range(25):
        theta = theta.intersect(around(truth, 4, 0.85**k, generator), time=0.1 * k)
        smaller = theta.volume()
        assert theta.contains(truth).all()
        assert (smaller <= volume * (1 + 1e-12)).all()
        assert (theta.outcome == Status.OK).all()
        volume = smaller
    assert (volume < 0.5 * 4.0**p).all()


def regular(sides: int, turn: float) -> Halfspaces:
    angles = 2 * math.pi * torch.arange(sides, dtype=torch.float64) / sides + turn
    return Halfspaces(torch.stack([angles.cos(), angles.sin()], dim=-1), torch.ones(sides, dtype=torch.float64))


def test_facets_are_capped_outward_at_less_than_one_percent() -> None:
    """Tangents of the unit circle in ever new directions: the set tends to the disc, whatever the number of steps."""
    capped, free = box(2, batch=1), box(2, batch=1, max_facets=10_000)
    previous = capped.volume()
    for k in range(60):
        rows = regular(7, 0.37 * k)
        capped, free = capped.intersect(rows), free.intersect(rows)
        assert capped.volume() <= previous
        previous = capped.volume()
        assert (
            capped.facets().halfspaces.where(capped.facets().halfspaces.A.abs().sum(-1) > 0).rows <= capped.body.slots
        )
        assert int(capped.body.count) <= MAX_FACETS
    assert int(free.body.count) > 100
    inside = free.vertices()[0]
    assert bool((capped.facets().halfspaces.slack(inside.unsqueeze(0).transpose(0, 1)) >= -1e-12).all())
    assert free.volume() <= capped.volume() <= 1.01 * free.volume()


def test_memory_does_not_grow_with_the_steps() -> None:
    generator = torch.Generator().manual_seed(0)
    truth = torch.zeros(2, 2, dtype=torch.float64)
    theta, slots = box(2, batch=2), 0
    for _ in range(400):
        theta = theta.intersect(around(truth, 6, 0.5, generator))
        slots = max(slots, theta.body.slots)
    assert slots <= 2 * MAX_FACETS


def test_a_facet_knows_when_and_whence_it_came() -> None:
    theta = box(2, batch=1)
    east = Halfspaces(torch.tensor([[1.0, 0.0]]), torch.tensor([1.0]), source=torch.tensor([7]))
    theta = theta.intersect(east, time=0.5)
    facets = theta.facets()
    new = (facets.source == 7).squeeze(0)
    assert int(new.sum()) == 1
    assert facets.time[0, new].item() == 0.5
    assert facets.halfspaces.b[0, new].item() == 1.0
    assert theta.last_cut.item() == 0.5
    unchanged = theta.intersect(Halfspaces(torch.tensor([[1.0, 0.0]]), torch.tensor([1.5])), time=0.7)
    assert unchanged.last_cut.item() == 0.5
    assert (facets.source[0, ~new] == -1).all()


@pytest.mark.parametrize("p", [1, 2, 3])
def test_emptiness_comes_with_rows_that_contradict(p: int) -> None:
    """Item 0 is cut to nothing in two steps, item 1 is not: one bad item does not touch the other."""
    axis = torch.eye(p, dtype=torch.float64)[:1].expand(2, 1, p)
    first = Halfspaces(axis, torch.tensor([[-1.0], [1.0]]))
    second = Halfspaces(-axis, torch.tensor([[0.5], [0.5]]))
    theta = box(p, batch=2).intersect(first, time=1.0).intersect(second, time=2.0)
    verdict = theta.emptiness()
    assert verdict.outcome.tolist() == [Status.EMPTY, Status.OK]
    assert theta.volume()[0] == 0
    assert not theta.contains(torch.zeros(p, dtype=torch.float64).expand(2, p))[0]
    assert bool(theta.contains(verdict.witness)[1])
    rows = verdict.contradiction
    blamed = {time for time in rows.time[0].tolist() if not math.isnan(time)}
    assert blamed == {1.0, 2.0}
    assert rows.halfspaces.A[1].isnan().all()

    again = theta.intersect(Halfspaces(axis, torch.tensor([[10.0], [10.0]])), time=3.0)
    assert again.is_empty.tolist() == [True, False]
    kept = theta.where(~theta.is_empty, box(p, batch=2))
    assert kept.volume().tolist() == pytest.approx([4.0**p, 1.5 * 4.0 ** (p - 1)])


def test_touching_is_undecided_and_stays_in() -> None:
    """x <= -2 meets the box [-2, 2]^2 in an edge: neither surely empty nor of any size."""
    theta = box(2, batch=1).intersect(Halfspaces(torch.tensor([[1.0, 0.0]]), torch.tensor([-2.0])))
    assert theta.emptiness().outcome.item() == Status.UNDECIDED
    assert theta.emptiness().witness.isnan().all()
    assert 0 <= theta.volume().item() < 1e-12
    edge = torch.tensor([[[-2.0, y]] for y in (-2.0, 0.3, 2.0)], dtype=torch.float64)
    assert theta.contains(edge).all()
    assert not theta.contains(torch.tensor([[-1.9, 0.3]], dtype=torch.float64)).any()


def test_batch_shapes_and_questions_agree_with_single_sets() -> None:
    generator = torch.Generator().manual_seed(3)
    truth = torch.zeros(2, 3, 2, dtype=torch.float64)
    rows = around(truth, 5, 1.0, generator)
    prior = FeasibleSet.from_box(torch.full((2, 3, 2), -2.0), torch.full((2, 3, 2), 2.0))
    together = prior.intersect(rows)
    direction = torch.randn(2, 3, 2, generator=generator, dtype=torch.float64)
    point = 3 * torch.randn(2, 3, 2, generator=generator, dtype=torch.float64)
    for i in range(2):
        for j in range(3):
            alone = FeasibleSet.from_box(torch.full((2,), -2.0), torch.full((2,), 2.0))
            alone = alone.intersect(Halfspaces(rows.A[i, j], rows.b[i, j]))
            assert alone.volume() == pytest.approx(together.volume()[i, j].item(), rel=1e-12)
            assert torch.allclose(alone.centroid(), together.centroid()[i, j], atol=1e-12)
            assert torch.allclose(alone.chebyshev()[1], together.chebyshev()[1][i, j], atol=1e-12)
            assert torch.allclose(alone.support(direction[i, j]), together.support(direction)[i, j], atol=1e-12)
            assert torch.allclose(alone.project(point[i, j]), together.project(point)[i, j], atol=1e-12)


@pytest.mark.parametrize(
    ("lower", "upper", "expected"),
    [
        ([0.0, 1.0], [1.0, 1.0], "lower < upper"),
        ([0.0], [1.0, 1.0], r"\(\*batch, p\)"),
        ([0.0, float("nan")], [1.0, 1.0], "lower < upper"),
        ([-math.inf, 0.0], [1.0, 1.0], "bounded"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_wrong_priors_are_refused(lower: list[float], upper: list[float], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        FeasibleSet.from_box(torch.tensor(lower), torch.tensor(upper))


@pytest.mark.usefixtures("unchecked")
def test_wrong_halfspaces_are_refused() -> None:
    theta = box(2)
    with pytest.raises(InputError, match="R\\^2"):
        theta.intersect(Halfspaces(torch.ones(1, 3), torch.ones(1)))
    with pytest.raises(InputError, match="NaN"):
        theta.intersect(Halfspaces(torch.tensor([[1.0, float("nan")]]), torch.ones(1)))
    with pytest.raises(InputError, match="metric"):
        theta.project(torch.zeros(3, 2), torch.ones(3, 3))


def with_an_empty_item(p: int, **rows: bool) -> tuple[FeasibleSet, torch.Tensor]:
    """Item 0 is empty, by 3: z_1 <= -5 in [-2, 2]^p; item 1 is [-2, 1] x [-2, 2]^(p - 1). The bounds have gradients."""
    b = torch.tensor([[-5.0], [1.0]], dtype=torch.float64, requires_grad=rows.get("gradients", False))
    axis = torch.eye(p, dtype=torch.float64)[:1].expand(2, 1, p)
    return box(p, batch=2).intersect(Halfspaces(axis, b)), b


@pytest.mark.parametrize("p", [1, 2, 3])
def test_an_empty_item_says_so_in_every_answer(p: int) -> None:
    sets, _ = with_an_empty_item(p)
    one = torch.ones(2, p, dtype=torch.float64)
    centre, radius = sets.chebyshev()
    assert radius.tolist() == pytest.approx([-1.5, 1.5])
    assert sets.volume().tolist() == pytest.approx([0.0, 3 * 4.0 ** (p - 1)])
    assert sets.contains(-one).tolist() == [False, True]
    for answer in (centre, sets.centroid(), sets.vertices(), sets.diameter(), sets.support(one), sets.project(5 * one)):
        assert answer[0].isnan().all()
        assert answer[1].isfinite().all()


@pytest.mark.parametrize("p", [1, 2, 3])
def test_an_empty_item_has_zero_gradients(p: int) -> None:
    sets, b = with_an_empty_item(p, gradients=True)
    one = torch.ones(2, p, dtype=torch.float64)
    asked = (
        sets.volume(), *sets.chebyshev(), sets.centroid(), sets.vertices(), sets.diameter(), sets.support(one),
        sets.project(5 * one),
    )  # fmt: skip
    for answer in asked:
        (slope,) = torch.autograd.grad(answer.nansum(), b, retain_graph=True, materialize_grads=True)
        assert slope[0].item() == 0
        assert slope.isfinite().all()


@pytest.mark.parametrize("p", [1, 2, 3])
@pytest.mark.parametrize("bad", ["indefinite", "negative", "NaN", "point"])
def test_projection_with_a_bad_metric_or_point_is_nan_for_that_item(p: int, bad: str) -> None:
    metric = torch.eye(p, dtype=torch.float64).repeat(2, 1, 1)
    point = torch.full((2, p), 3.0, dtype=torch.float64)
    if bad == "indefinite":
        metric[0, 0, 0] = 0.0
        metric[0, 0, -1] = metric[0, -1, 0] = 2.0 if p > 1 else 0.0
    elif bad == "negative":
        metric[0] *= -1
    elif bad == "NaN":
        metric[0, 0, 0] = math.nan
    else:
        point[0, 0] = math.inf
    metric.requires_grad_()
    nearest = box(p, batch=2).project(point, metric)
    assert nearest[0].isnan().all()
    assert nearest[1].tolist() == pytest.approx([2.0] * p)
    (slope,) = torch.autograd.grad(nearest.nansum(), metric)
    assert slope.isfinite().all()


@pytest.mark.parametrize("p", [1, 2, 3])
def test_no_rows_change_nothing(p: int) -> None:
    sets = box(p)
    assert sets.intersect(Halfspaces(torch.zeros(0, p), torch.zeros(0))) is sets


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("p", [1, 2, 3])
def test_wrong_shapes_are_refused(p: int) -> None:
    sets = box(p)
    for wrong in (torch.ones(3, p + 1), torch.ones(2, p), torch.tensor(1.0)):
        with pytest.raises(InputError, match="theta"):
            sets.contains(wrong)
        with pytest.raises(InputError, match="direction"):
            sets.support(wrong)
        with pytest.raises(InputError, match="point"):
            sets.project(wrong)
    assert sets.contains(torch.zeros(7, 3, p)).shape == (7, 3)


@pytest.mark.parametrize("p", [1, 2, 3])
def test_a_batch_of_none(p: int) -> None:
    none = FeasibleSet.from_box(-torch.ones(0, p), torch.ones(0, p))
    chosen = FeasibleSet.from_box(-torch.ones(2, p), torch.ones(2, p)).select(torch.zeros(0, dtype=torch.long))
    for sets in (none, chosen):
        after = sets.intersect(Halfspaces(torch.ones(0, 1, p), torch.ones(0, 1)))
        assert after.facets().halfspaces.b.shape[0] == 0
        assert after.contains(torch.zeros(0, p)).shape == after.diameter().shape == after.volume().shape == (0,)
        assert after.centroid().shape == after.chebyshev()[0].shape == (0, p)


@pytest.mark.parametrize("p", [2, 3])
def test_a_tie_is_decided_alike_in_every_batch(p: int) -> None:
    """Two vertices are extreme; a neighbour with more vertices changes the padding, not the derivatives."""

    def slopes(batch: int) -> list[torch.Tensor]:
        direction = -torch.eye(p, dtype=torch.float64)[0].repeat(batch, 1).requires_grad_()
        b = torch.full((batch, 2), 0.5, dtype=torch.float64)
        b[0] = 9.0
        b.requires_grad_()
        A = torch.zeros(batch, 2, p, dtype=torch.float64)
        A[:, :, 0], A[:, 0, 1], A[:, 1, 1] = 1.0, 1.0, -1.0
        upper = torch.ones(batch, p, dtype=torch.float64, requires_grad=True)
        sets = FeasibleSet.from_box(-upper, upper).intersect(Halfspaces(A, b))
        asked = sets.support(direction)[0] + sets.diameter()[0]
        return [slope[0] for slope in torch.autograd.grad(asked, (direction, upper))]

    for alone, together in zip(slopes(1), slopes(2), strict=True):
        torch.testing.assert_close(alone, together)
