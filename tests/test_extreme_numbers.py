"""Rows and sets of extreme size, programmes without an answer, unfit arguments: an answer or an InputError."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.kernels import disc
from torchfsid.outcome import Status
from torchfsid.programmes import exact
from torchfsid.programmes.layers import ChebyshevCentre, ProjectOnto
from torchfsid.sets.feasible_set import FeasibleSet

DIMENSIONS = [1, 2, 3]


def tensor(values: object) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float64)


def box(p: int, half: float = 2.0, batch: tuple[int, ...] = ()) -> FeasibleSet:
    return FeasibleSet.from_box(-half * torch.ones(*batch, p).double(), half * torch.ones(*batch, p).double())


@pytest.mark.parametrize("size", [1e-308, 1e160, 1e308])
@pytest.mark.parametrize("p", DIMENSIONS)
def test_rows_of_any_length_cut_alike(p: int, size: float) -> None:
    row = torch.linspace(1.0, 0.4, p, dtype=torch.float64)[None]
    scaled, plain = (box(p).intersect(Halfspaces(by * row, by * tensor([0.5]))) for by in (size, 1.0))
    for ask in (FeasibleSet.volume, FeasibleSet.centroid, FeasibleSet.diameter, lambda sets: sets.chebyshev()[1]):
        torch.testing.assert_close(ask(scaled), ask(plain), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("half", [1e-300, 1e-160, 1e160, 1e300])
@pytest.mark.parametrize("p", DIMENSIONS)
def test_the_diameter_of_any_size(p: int, half: float) -> None:
    upper = torch.full((p,), half, dtype=torch.float64, requires_grad=True)
    sets = FeasibleSet.from_box(-upper.detach(), upper)
    assert sets.diameter().item() == pytest.approx(2 * half * math.sqrt(p), rel=1e-12)
    (slopes,) = torch.autograd.grad(sets.diameter(), upper)
    assert slopes.tolist() == pytest.approx([p**-0.5] * p, rel=1e-12)


@pytest.mark.parametrize("p", [2, 3])
def test_numbers_beyond_all_floats_are_unsolved(p: int) -> None:
    """Bounds of about 1e308: the rational search meets larger numbers."""
    A = 1e-308 * torch.cat([torch.eye(p), -torch.eye(p)]).double()
    ball = ChebyshevCentre()(Halfspaces(A, tensor([1e-308 if p == 3 else 1.0] * p + [1.0] * p)))
    nearest = ProjectOnto()(Halfspaces(A, tensor([1e-160] * p + [-1.0] * p)), torch.full((p,), 9.0))
    assert ball.status == nearest.status == Status.UNSOLVED
    assert ball.radius.isnan()


@pytest.mark.parametrize("p", DIMENSIONS)
def test_a_ball_that_cannot_be_verified_is_still_in_the_set(p: int, monkeypatch: pytest.MonkeyPatch) -> None:
    sets = box(p, batch=(2,)).intersect(Halfspaces(torch.ones(1, p).double(), tensor([0.3])))
    largest = sets.chebyshev()[1]

    def unsolved(A: object, b: object) -> tuple:
        centre, radius, rows, status = inscribed_ball(A, b)
        return centre * math.nan, radius * math.nan, rows, status * 0 + Status.UNSOLVED

    inscribed_ball, inscribed = exact.inscribed_ball, disc.inscribed
    monkeypatch.setattr(exact, "inscribed_ball", unsolved)
    monkeypatch.setattr(disc, "inscribed", lambda *given: (*inscribed(*given)[:3], inscribed(*given)[3] & False))
    centre, radius = sets.chebyshev()
    assert sets.contains(centre).all()
    assert (0.1 * largest < radius).all()
    assert (radius <= (1 + 1e-12) * sets.facets().halfspaces.slack(centre).amin(-1)).all()


@pytest.mark.parametrize("p", DIMENSIONS)
def test_containment_is_up_to_a_share_of_the_diameter(p: int) -> None:
    """At the middle of a side: inside up to 1e-9 of the diameter, for each of K points and for a set of any size."""
    for half in (1e-150, 1.0, 1e150):
        sets, side = box(p, half, (2,)), torch.zeros(2, p).double()
        side[:, 0] = half
        width = 2 * half * math.sqrt(p)
        points = torch.stack([side, side * (1 + 0.9e-9 * width / half), side * (1 + 1.1e-9 * width / half)])
        assert sets.contains(points).tolist() == [[True, True], [True, True], [False, False]]
        for unknown in (math.inf, -math.inf, math.nan):
            assert not sets.contains(torch.full((2, p), unknown)).any()


@pytest.mark.parametrize("p", DIMENSIONS)
@pytest.mark.usefixtures("unchecked")
def test_masks_and_lists_are_taken(p: int) -> None:
    sets = FeasibleSet.from_box(torch.zeros(3, p), torch.tensor([[1.0], [2.0], [3.0]]).expand(3, p))
    assert sets.select(torch.tensor([True, False, True])).volume().tolist() == pytest.approx([1.0, 3.0**p])
    assert sets.select(torch.tensor([-1])).volume().tolist() == pytest.approx([3.0**p])
    assert sets.contains([1.5] * p).tolist() == [False, True, True]
    assert box(p).support([1.0] * p).item() == pytest.approx(2.0 * p)
    assert box(p).project([5.0] * p).tolist() == pytest.approx([2.0] * p)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: FeasibleSet.from_box(torch.zeros(3, 0), torch.zeros(3, 0)), "lower, upper"),
        (lambda: FeasibleSet.from_box("a", torch.zeros(2)), "lower"),
        (lambda: Halfspaces(torch.ones(1, 2), torch.tensor(1.0)), "Halfspaces"),
        (lambda: Halfspaces([[1.0, 2.0], [3.0]], torch.ones(2)), "A: expected a tensor"),
        (lambda: ChebyshevCentre()(Halfspaces(torch.ones(1, 0), torch.ones(1))), "p >= 1"),
        (lambda: ProjectOnto()(Halfspaces(torch.ones(1, 0), torch.ones(1)), torch.ones(0)), "p >= 1"),
        (lambda: box(2, batch=(3,)).select(torch.tensor([True, False])), "items"),
        (lambda: box(2, batch=(3,)).select(torch.tensor([3])), "items"),
        (lambda: box(2).select(torch.tensor([0])), "items"),
        (lambda: box(2).contains("here"), "theta"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_does_not_fit_is_refused(wrong: Callable, message: str) -> None:
    with pytest.raises(InputError, match=message):
        wrong()
