"""Both sets in space: theta sampled against daqp, the truth under errors, torch against compiled code."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.problems import Scene
from tests.scenes_in_space import DEPENDENT, random_scene, scene_of, unit
from tests.test_sampled_theta import check
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import Evidence, ObservationModel, SetKind, evidence
from torchfsid.identification.inverse_optimal import inverse_optimal_set
from torchfsid.identification.kkt import CASES, solve_kkt
from torchfsid.robots.affine_barrier import AffineBarrier
from torchfsid.robots.bounds import NoiseBound, RowErrors
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import AffineTask
from torchfsid.sets.feasible_set import FeasibleSet


@pytest.mark.parametrize("rows", range(1, 9))
def test_critical_region_is_where_the_qp_has_its_active_set(rows: int) -> None:
    """8 x 50 scenes, 20 000 samples."""
    rng = np.random.default_rng(rows)
    check([random_scene(rng, rows) for _ in range(50)], rng, per_scene=50)


@pytest.mark.parametrize("p", [1, 2, 4])
def test_with_parameters_of_another_dimension(p: int) -> None:
    rng = np.random.default_rng(100 + p)
    check([random_scene(rng, int(rng.integers(1, 9)), p) for _ in range(40)], rng, per_scene=25)


@pytest.mark.parametrize("name", DEPENDENT)
def test_dependent_rows(name: str) -> None:
    """Letters and ranks, and 500 samples of each cone that active rows can have."""
    rng = np.random.default_rng(list(DEPENDENT).index(name))
    scenes = [scene_of(name, rng) for _ in range(10)]
    for scene in scenes:
        kkt = solve_kkt(*scene.tensors)
        assert CASES[int(kkt.case)] == name[0]
        assert int(kkt.rank) == np.linalg.matrix_rank(scene.A[scene.active])
    check(scenes, rng, per_scene=50, everywhere=name == "E space")


def test_truth_is_inside_the_inverse_optimal_set() -> None:
    """800 random scenes, u wrong by the whole bound, and contained in the critical region where all is exact."""
    rng, lost = np.random.default_rng(9), 0
    for _ in range(800):
        scene = random_scene(rng, int(rng.integers(1, 9)), crowded=0.3)
        delta = 10.0 ** rng.uniform(-8, -1)
        u = scene.u + delta * unit(rng.normal(size=3))
        rows, _, C, d = scene.tensors
        omega = inverse_optimal_set(rows, torch.from_numpy(u), C, d, NoiseBound(delta))
        lost += not bool(omega.contains(torch.from_numpy(scene.theta), tolerance=1e-9))
    assert lost == 0


def both(kind: SetKind, scenes: list[Scene], errors: bool) -> tuple[Evidence, Evidence]:
    """What the same scenes say in torch and compiled. Some rows are NaN, some robots too fast, some rows turned."""
    rng, count, m = np.random.default_rng(3), len(scenes), max(len(scene.b) for scene in scenes)
    A, b = torch.zeros(count, m, 3, dtype=torch.float64), torch.ones(count, m, dtype=torch.float64)
    for i, scene in enumerate(scenes):
        A[i, : len(scene.b)], b[i, : len(scene.b)] = torch.from_numpy(scene.A), torch.from_numpy(scene.b)
    u, C, d = (torch.from_numpy(np.stack([getattr(scene, name) for scene in scenes])) for name in ("u", "C", "d"))
    u[::11] *= 3.0
    b[::17, 0], d[::19, 1] = torch.nan, torch.inf
    angle, slack = (torch.from_numpy(rng.uniform(0, 0.3, (count, m)) * (rng.uniform(size=m) < 0.7)) for _ in range(2))
    angle[::7, 0], angle[::5, 0] = torch.pi, 2.0
    barrier = AffineBarrier(A, b, tuple("abcdefgh"[:m]), row_errors=lambda *_: RowErrors(angle, slack))
    task = AffineTask(C, d, tuple("pqrs"[: C.shape[-1]]), sensitivity=0.3)
    model = ObservationModel(task, [barrier], kind, NoiseBound(0.02, slack=0.03, position=0.1 if errors else 0.0))
    corner = torch.full((count, C.shape[-1]), 6.0, dtype=torch.float64)
    nobody = torch.zeros(count, 0, 3, dtype=torch.float64)
    seen = Measurement(0.0, torch.zeros_like(u), u, nobody, nobody[..., 0].bool())
    prior = FeasibleSet.from_box(-corner, corner)
    return evidence(model, prior, seen, False), evidence(model, prior, seen, True)


def unordered(rows: Halfspaces) -> np.ndarray:
    """Each item's rows (A, b), padding left out, in an order of their own."""
    table = torch.cat([rows.A, rows.b.unsqueeze(-1)], dim=-1)
    kept = [item[(item[:, :-1] != 0).any(-1)] for item in table]
    most = max(len(item) for item in kept)
    padded = torch.stack([torch.nn.functional.pad(item, (0, 0, 0, most - len(item))) for item in kept]).numpy()
    return np.stack([item[np.lexsort(item.round(8).T)] for item in padded])


@pytest.mark.parametrize("kind", ["inverse_optimal", "critical_region"])
@pytest.mark.parametrize("errors", [False, True], ids=["exact positions", "position errors"])
@pytest.mark.parametrize("p", [3, 4])
def test_compiled_code_finds_the_same(kind: SetKind, errors: bool, p: int) -> None:
    rng = np.random.default_rng(1)
    scenes = [random_scene(rng, int(rng.integers(1, 9)), p, crowded=0.3) for _ in range(200)]
    scenes += [scene_of(name, rng) for name in DEPENDENT for _ in range(5)] if p == 3 else []
    reference, compiled = both(kind, scenes, errors)
    assert 30 < int(reference.informative.sum()) < 250
    for name in ("informative", "alarmed", "slack", "excess"):
        torch.testing.assert_close(getattr(compiled, name), getattr(reference, name), equal_nan=True, msg=name)
    for name in ("active", "n_active", "rank", "case", "G", "f", "projector", "free", "offset"):
        torch.testing.assert_close(
            getattr(compiled.kkt, name), getattr(reference.kkt, name), rtol=1e-9, atol=1e-9, equal_nan=True, msg=name
        )
    np.testing.assert_allclose(unordered(compiled.omega), unordered(reference.omega), rtol=1e-9, atol=1e-9)


def test_a_batch_that_says_nothing_has_padding() -> None:
    rng = np.random.default_rng(4)
    scenes = [random_scene(rng, 2) for _ in range(3)]
    for scene in scenes:
        scene.d[:] = np.nan
    for found in both("inverse_optimal", scenes, errors=False):
        assert not bool(found.informative.any())
        assert bool(((found.omega.A == 0).all(-1) & (found.omega.b == 1)).all())
        assert found.omega.rows > 0
