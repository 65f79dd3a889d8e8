"""Layers and searches over sets. A test for a process with NUMBA_ENABLE_CUDASIM=1, see `test_cuda` and `_both`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from benchmarks import cuda_layers
from tests.hard_sets import hard_sets, padded
from tests.on_simulator._both import SIZES, both, launched, same
from tests.round_trips import RoundTrips
from torchfsid.halfspaces import Halfspaces
from torchfsid.kernels import programmes as kernel
from torchfsid.outcome import Status
from torchfsid.programmes.layers import ChebyshevCentre, ProjectOnto
from torchfsid.sets.feasible_set import FeasibleSet

pytestmark = pytest.mark.filterwarnings("ignore:.*encountered in:RuntimeWarning")  # Python notices 1 / 0 and inf - inf

LAYERS = pytest.mark.parametrize("layer", ["point", "metric", "ball"])
DIMENSIONS = pytest.mark.parametrize("p", [1, 2, 3, 4])


def drawn(count: int, m: int, p: int) -> tuple[Tensor, Tensor, Tensor]:
    """Random rows around the origin, half of the sets open, and points in and outside."""
    rng = np.random.default_rng([count, m, p])
    drawn = rng.normal(size=(count, m, p)), rng.uniform(0.3, 1.5, (count, m)), 2 * rng.normal(size=(count, p))
    return tuple(map(torch.from_numpy, drawn))  # type: ignore[return-value]


def metrics(count: int, p: int) -> Tensor:
    root = torch.from_numpy(np.random.default_rng(p).normal(size=(count, p, p)))
    return root @ root.mT + torch.eye(p).double()


def answers(layer: str, A: Tensor, b: Tensor, y: Tensor) -> tuple[Tensor, ...]:
    if layer == "ball":
        return ChebyshevCentre()(Halfspaces(A, b))
    return ProjectOnto(metrics(len(A), A.shape[-1]) if layer == "metric" else None)(Halfspaces(A, b), y)


def with_gradients(layer: str, *given: Tensor) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """The answers, and the gradients of a weighted sum of them."""
    leaves = [part.clone().requires_grad_() for part in given]
    found = answers(layer, *leaves)
    weights = [torch.arange(1.0, 1.0 + part.numel()).reshape(part.shape) for part in found[:-1]]
    total = sum(((weight * part).sum() for weight, part in zip(weights, found[:-1], strict=True)), torch.zeros(()))
    gradients = torch.autograd.grad(total, leaves, materialize_grads=True, allow_unused=True)
    return tuple(part.detach() for part in found), gradients


def alike(layer: str, *given: Tensor) -> tuple[Tensor, ...]:
    """The answers, which are the same on the CPU and on the device. The gradients are so up to the products' sums."""
    one, other = both(lambda: with_gradients(layer, *given))
    for mine, theirs in zip(one[0], other[0], strict=True):
        same(mine, theirs)
    for mine, theirs in zip(one[1], other[1], strict=True):
        close(mine, theirs)
    return other[0]


def close(one: Tensor, other: Tensor) -> None:
    assert one.shape == other.shape
    if one.numel() > 0:
        torch.testing.assert_close(one, other, rtol=0, atol=1e-14 * max(1.0, float(one.abs().max())))


@DIMENSIONS
@LAYERS
def test_random_sets(layer: str, p: int, launched: list[str]) -> None:
    for count in SIZES if p == 2 else (5,):
        alike(layer, *drawn(count, 2 * p + 1, p))
    assert {name.split(".")[0] for name in launched} == {"programmes"}
    assert len(launched) == 2 * (len(SIZES) if p == 2 else 1)


@DIMENSIONS
@LAYERS
def test_hard_sets(layer: str, p: int) -> None:
    A, b = map(torch.from_numpy, padded(hard_sets(p, each=1)[::2]))
    *_, status = answers(layer, A, b, A[:, 0] * 7)
    assert (status == Status.OK).all()
    alike(layer, A, b, A[:, 0] * 7)


@LAYERS
def test_every_status(layer: str) -> None:
    """Empty, impossible, open, flat, NaN and infinite items, beside an ordinary one."""
    A = torch.tensor([[[1.0, 0], [-1, 0], [0, 1], [0, -1]]]).double().repeat(8, 1, 1)
    b, y = torch.ones(8, 4).double(), torch.full((8, 2), 3.0).double()
    b[1, 1], A[2, 0], b[2, 0], A[3] = -2.0, 0.0, -1.0, 0.0
    A[4, 3], b[5, 1], A[6, 0, 0], b[7, 2], y[7] = 0.0, -1.0, torch.nan, torch.inf, torch.inf
    status = alike(layer, A, b, y)[2 if layer == "ball" else 1]
    assert len(status.unique()) >= 3


@LAYERS
def test_no_items_and_one_row(layer: str) -> None:
    A, b, y = drawn(6, 5, 2)
    alike(layer, A[:0], b[:0], y[:0])
    alike(layer, A[:, :1], b[:, :1], y)


def test_batches_of_any_shape() -> None:
    """With two batch dimensions, with none, without rows, and a metric that is not definite."""
    A, b, y = drawn(6, 5, 2)
    rows = [
        Halfspaces(A.reshape(2, 3, 5, 2), b.reshape(2, 3, 5)), Halfspaces(A[0], b[0]), Halfspaces(A[:, :0], b[:, :0])
    ]  # fmt: skip
    points = [y.reshape(2, 3, 2), y[0], y]
    indefinite = torch.tensor([[1.0, 2], [2, 1]]).double()

    def every() -> list[Any]:
        layers = ProjectOnto(), ProjectOnto(torch.eye(2).double() * 3), ProjectOnto(indefinite)
        found = [each(*given) for each in layers for given in zip(rows, points, strict=True)]
        return [*found, *map(ChebyshevCentre(), rows)]

    for mine, theirs in zip(*both(every), strict=True):
        for one, other in zip(mine, theirs, strict=True):
            same(one, other)


@LAYERS
def test_the_host_waits_once(layer: str) -> None:
    """For the number of items that could not be verified, and not at all in the gradients."""
    leaves = [part.requires_grad_() for part in drawn(4, 5, 2)]
    found = answers(layer, *leaves)  # compiles, and copies constants
    torch.autograd.grad(found[0].nansum(), leaves, create_graph=True, allow_unused=True)
    with RoundTrips() as forward:
        found = answers(layer, *leaves)
    assert [name for *_, name in forward.waits] == ["nonzero"]
    for graph in (False, True):
        with RoundTrips() as backward:
            torch.autograd.grad(found[0].nansum(), leaves, create_graph=graph, retain_graph=True, allow_unused=True)
        assert not backward.waits


@LAYERS
def test_second_derivatives_and_transforms(layer: str) -> None:
    leaves = [part.requires_grad_() for part in drawn(2, 4, 2)]
    A, b, y = leaves
    b = (b + 1).detach().requires_grad_()

    def function(*given: Tensor) -> tuple[Tensor, ...]:
        found = answers(layer, *given)[:-1]
        return tuple(torch.where(part.isfinite(), part, 0.0) for part in found)

    assert gradcheck(function, (A, b, y), check_forward_ad=True, fast_mode=True)
    assert gradgradcheck(function, (A, b, y), fast_mode=True)
    for mine, theirs in zip(*both(lambda: torch.func.jacfwd(function, 1)(A, b, y)), strict=True):
        torch.testing.assert_close(mine, theirs)


def test_what_the_device_cannot_verify_is_solved_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    given = drawn(5, 6, 2)
    expected = [answers(layer, *given) for layer in ("point", "ball")]
    for name in ("finish_nearest", "finish_ball"):  # compiled launchers do not see this
        monkeypatch.setattr(kernel, name, lambda *_: Status.UNSOLVED)
    for layer, before in zip(("point", "ball"), expected, strict=True):
        for mine, theirs in zip(answers(layer, *given), before, strict=True):
            same(mine, theirs)


def test_sets_are_searched_alike(launched: list[str]) -> None:
    """Disc, nearest points, diameters and points inside: of polygons, flat ones too, and of boxes in space."""
    A, b, y = drawn(7, 5, 2)
    A[0], b[0] = torch.tensor([0.0, 1.0]), 0.0
    A[0, 1] = -A[0, 1]  # a segment
    corner = torch.full((7, 2), 2.0).double()

    def searched() -> list[Tensor]:
        rows = Halfspaces(A.clone().requires_grad_(), b.clone().requires_grad_())
        point = y.clone().requires_grad_()
        sets = FeasibleSet.from_box(-corner, corner).intersect(rows)
        space = FeasibleSet.from_box(-torch.ones(3, 3).double(), torch.arange(1.0, 10).reshape(3, 3).double())
        found = [*sets.chebyshev(), sets.project(point), sets.project(point, metrics(7, 2)), sets.diameter()]
        total = sum((k + 1.0) * part.sum() for k, part in enumerate(found))
        assert isinstance(total, Tensor)
        gradients = torch.autograd.grad(total, (rows.A, rows.b, point))
        inside = sets.contains(torch.stack([y / 3, sets.vertices().detach()[:, 1], y]))
        assert inside.any()
        assert not inside.all()
        return [*(part.detach() for part in found), *gradients, inside, space.diameter()]

    for mine, theirs in zip(*both(searched), strict=True):
        same(mine, theirs)
    assert {f"programmes.{name}" for name in ("inscribed", "feet", "farthest", "contains")} <= set(launched)


def test_no_sets() -> None:
    def searched() -> list[Tensor]:
        nothing = torch.zeros(0, 2).double()
        sets = FeasibleSet.from_box(nothing, nothing + 1)
        return [*sets.chebyshev(), sets.project(nothing), sets.diameter(), sets.contains(nothing)]

    for mine, theirs in zip(*both(searched), strict=True):
        same(mine, theirs)


def test_the_benchmark_runs(capsys: pytest.CaptureFixture[str]) -> None:
    runs = cuda_layers.compare((3,), "cpu")["runs"]
    assert {(run["layer"], run["dimension"]) for run in runs} == {
        (n, p) for n in ("projection", "chebyshev") for p in (2, 3)
    }
    assert all(run["largest_difference"] == run["largest_difference_of_gradients"] == 0 for run in runs)
    assert capsys.readouterr().out.count("one core") == len(runs)
