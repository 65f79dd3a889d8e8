"""Checks 4 and 7: what must not change a set does not, and a batch is the loop over its items.

Order, scale and duplication of rows, padding, rotation and translation, for the critical region and the inverse-optimal
set, in each of the paper's cases and in random scenes; then the same for polygons. Sets are compared by their supports.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.problems import CASES, Scene, batch, paper_case, random_scene, rotated, true_thetas
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.critical_region import critical_region
from torchfsid.identification.inverse_optimal import inverse_optimal_set
from torchfsid.robots.bounds import NoiseBound
from torchfsid.sets.polygon import Polygon

BOX = 8.0
ANGLES = np.linspace(0, 2 * np.pi, 48, endpoint=False) + 0.1
DIRECTIONS = torch.from_numpy(np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1))

SetOf = Callable[[Halfspaces, Tensor, Tensor, Tensor, Tensor], Halfspaces]

SETS: dict[str, SetOf] = {
    "critical region": lambda safe, active, u, C, d: critical_region(safe, active, C, d),
    "inverse optimal": lambda safe, active, u, C, d: inverse_optimal_set(safe, u, C, d, NoiseBound(0.05)),
}
every_set = pytest.mark.parametrize("set_of", SETS.values(), ids=SETS.keys())


def scenes() -> list[Scene]:
    rng = np.random.default_rng(0)
    return [paper_case(case, rng) for case in CASES for _ in range(3)] + [
        random_scene(rng, 1 + k % 8) for k in range(40)
    ]


SCENES = scenes()


def supports(theta: Halfspaces, around: Tensor) -> Tensor:
    """Supports within a box around each scene's theta, less what the theta itself contributes."""
    b = theta.b - (theta.A @ around.unsqueeze(-1)).squeeze(-1)
    return clipped(theta.A, b, box(len(b), BOX)).support(DIRECTIONS.expand(len(b), -1, -1))


def clipped(A: Tensor, b: Tensor, start: Polygon) -> Polygon:
    return start.clip(A, b, torch.zeros_like(b), torch.zeros(b.shape, dtype=torch.long), 1000).body


def box(count: int, half: float) -> Polygon:
    corner = torch.full((count, 2), half, dtype=torch.float64)
    return Polygon.from_box(-corner, corner)


def assert_same_sets(set_of: SetOf, changed: list[Scene]) -> None:
    """The changed scenes give the sets of `SCENES`, each about its own theta."""
    expected = supports(set_of(*batch(SCENES)), true_thetas(SCENES))
    assert torch.allclose(supports(set_of(*batch(changed)), true_thetas(changed)), expected, rtol=0, atol=1e-9)


# What must not matter (check 4) -------------------------------------------------------------------------------------


def reordered(scene: Scene, rng: np.random.Generator) -> Scene:
    order = rng.permutation(len(scene.b))
    return replace(scene, A=scene.A[order], b=scene.b[order], active=scene.active[order])


def scaled(scene: Scene, rng: np.random.Generator) -> Scene:
    scale = 10 ** rng.uniform(-3, 3, len(scene.b))
    return replace(scene, A=scene.A * scale[:, None], b=scene.b * scale)


def duplicated(scene: Scene, rng: np.random.Generator) -> Scene:
    """Every row once more, at another scale: case B becomes C, D becomes E."""
    again = scaled(scene, rng)
    joined = (np.concatenate([getattr(scene, part), getattr(again, part)]) for part in ("A", "b", "active"))
    return replace(scene, **dict(zip(("A", "b", "active"), joined, strict=True)))


def turned(scene: Scene, rng: np.random.Generator) -> Scene:
    """By any angle; without an active row by a multiple of 22.5 degrees, since there the inverse-optimal set has a
    polygon of 16 sides in place of a disc."""
    return rotated(scene, rng.uniform(0, 2 * np.pi) if scene.active.any() else rng.integers(16) * np.pi / 8)


def controls_translated(scene: Scene, rng: np.random.Generator) -> Scene:
    shift = rng.normal(size=2)
    return replace(scene, b=scene.b + scene.A @ shift, d=scene.d + shift, u=scene.u + shift)


def parameters_translated(scene: Scene, rng: np.random.Generator) -> Scene:
    shift = rng.normal(size=2)
    return replace(scene, theta=scene.theta + shift, d=scene.d - scene.C @ shift)


@every_set
@pytest.mark.parametrize("change", [reordered, scaled, duplicated, turned, controls_translated, parameters_translated])
def test_the_set_does_not_change(set_of: SetOf, change: Callable[[Scene, np.random.Generator], Scene]):
    rng = np.random.default_rng(1)
    assert_same_sets(set_of, [change(scene, rng) for scene in SCENES])


@every_set
def test_the_comparison_sees_a_change(set_of: SetOf):
    """The supports tell sets apart: moving the nominal control by 1e-6 is noticed wherever the set is bounded."""
    moved = [replace(scene, d=scene.d + 1e-6) for scene in SCENES]
    with pytest.raises(AssertionError):
        assert_same_sets(set_of, moved)


# Batches (check 7) --------------------------------------------------------------------------------------------------


@every_set
def test_a_batch_is_the_loop(set_of: SetOf):
    """Ragged scenes padded to 8 rows and more, against each alone and unpadded."""
    some = SCENES[::2]
    together = supports(set_of(*batch(some, rows=11)), true_thetas(some))
    alone = torch.cat([supports(set_of(*batch([scene])), true_thetas([scene])) for scene in some])
    assert torch.allclose(together, alone, rtol=0, atol=1e-9)


@every_set
def test_leading_dimensions(set_of: SetOf):
    safe, active, u, C, d = batch(SCENES[:24])
    flat = set_of(safe, active, u, C, d)
    safe = Halfspaces(safe.A.unflatten(0, (2, 3, 4)), safe.b.unflatten(0, (2, 3, 4)))
    folded = set_of(safe, *(part.unflatten(0, (2, 3, 4)) for part in (active, u, C, d)))
    single = set_of(Halfspaces(safe.A[1, 2, 3], safe.b[1, 2, 3]), active[23], u[23], C[23], d[23])
    assert folded.batch_shape == (2, 3, 4)
    assert torch.allclose(folded.A.flatten(0, 2), flat.A, rtol=0, atol=1e-14)
    assert torch.allclose(folded.b.flatten(0, 2), flat.b, rtol=0, atol=1e-12)
    assert torch.allclose(single.A, flat.A[23], rtol=0, atol=1e-14)


@every_set
def test_no_rows_at_all_are_the_same_as_padding(set_of: SetOf):
    scene = replace(SCENES[0], A=np.zeros((0, 2)), b=np.zeros(0), active=np.zeros(0, dtype=bool))
    padded, around = batch([scene], rows=1), true_thetas([scene])
    _, active, u, C, d = padded
    nothing = set_of(Halfspaces(torch.zeros(1, 0, 2), torch.zeros(1, 0)), active[:, :0], u, C, d)
    assert torch.allclose(supports(nothing, around), supports(set_of(*padded), around), rtol=0, atol=1e-12)


@every_set
def test_float32_is_cast_up_and_gradients_flow_back(set_of: SetOf):
    safe, active, u, C, d = batch(SCENES)
    single = [part.float().requires_grad_() for part in (safe.A, safe.b, u, C, d)]
    A, b, u, C, d = (part.detach().double() for part in single)
    expected = set_of(Halfspaces(A, b), active, u, C, d)
    theta = set_of(Halfspaces(*single[:2]), active, *single[2:])
    assert theta.A.dtype == theta.b.dtype == torch.float64
    assert torch.equal(theta.A, expected.A)
    assert torch.equal(theta.b, expected.b)
    (theta.A.sum() + theta.b.sum()).backward()
    assert all(part.grad is None or part.grad.dtype == torch.float32 for part in single)
    assert single[-1].grad is not None
    assert single[-2].grad is not None


# Polygons -----------------------------------------------------------------------------------------------------------


def polygon_rows(count: int, rows: int) -> tuple[Tensor, Tensor]:
    rng = np.random.default_rng(2)
    return torch.from_numpy(rng.normal(size=(count, rows, 2))), torch.from_numpy(rng.uniform(0.1, 3, (count, rows)))


def test_polygons_do_not_depend_on_order_scale_or_duplication_of_rows():
    A, b = polygon_rows(50, 7)
    rng = np.random.default_rng(3)
    order = torch.from_numpy(rng.permuted(np.tile(np.arange(14), (50, 1)), axis=1))
    scale = torch.from_numpy(10 ** rng.uniform(-3, 3, (50, 14)))
    changed_A = (torch.cat([A, A], 1) * scale[..., None]).gather(1, order[..., None].expand(-1, -1, 2))
    changed = clipped(changed_A, (torch.cat([b, b], 1) * scale).gather(1, order), box(50, BOX))
    expected = clipped(A, b, box(50, BOX))
    directions = DIRECTIONS.expand(50, -1, -1)
    assert torch.allclose(changed.support(directions), expected.support(directions), rtol=0, atol=1e-12)
    assert torch.allclose(changed.volume(), expected.volume(), rtol=1e-12)
    assert torch.equal(changed.count, expected.count)


def test_polygons_turn_and_move_with_their_rows():
    """A turn about a far point: box and rows as rows of a larger box."""
    A, b = polygon_rows(50, 7)
    sides = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=torch.float64).expand(50, 4, 2)
    A, b = torch.cat([A, sides], 1), torch.cat([b, torch.full((50, 4), BOX, dtype=torch.float64)], 1)
    cos, sin, shift = np.cos(1.0), np.sin(1.0), torch.tensor([5.0, -7.0], dtype=torch.float64)
    turn = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
    start, turned_rows, directions = box(50, 4 * BOX), A @ turn.T, DIRECTIONS.expand(50, -1, -1)
    before, after = clipped(A, b, start), clipped(turned_rows, b + turned_rows @ shift, start)
    expected = before.support(directions) + directions @ turn.T @ shift
    assert torch.allclose(after.support(directions @ turn.T), expected, atol=1e-11)
    assert torch.allclose(after.volume(), before.volume(), rtol=1e-11)
    assert torch.allclose(after.centroid(), before.centroid() @ turn.T + shift, atol=1e-11)
    assert torch.allclose(after.chebyshev()[1], before.chebyshev()[1], atol=1e-11)


def test_a_batch_of_polygons_is_the_loop():
    A, b = polygon_rows(50, 7)
    A[::3, 4:], b[::3, 4:] = 0.0, 1.0
    together = clipped(A, b, box(50, BOX))
    for i in range(50):
        rows = 4 if i % 3 == 0 else 7
        alone = clipped(A[i : i + 1, :rows], b[i : i + 1, :rows], box(1, BOX))
        n = int(alone.count)
        assert int(together.count[i]) == n
        assert torch.allclose(together.vertices[i, :n], alone.vertices[0, :n], rtol=0, atol=1e-13)
        for of_batch, of_item in zip(together.chebyshev(), alone.chebyshev(), strict=True):
            assert torch.allclose(of_batch[i], of_item[0], atol=1e-12)
        assert torch.allclose(together.centroid()[i], alone.centroid()[0], atol=1e-12)
