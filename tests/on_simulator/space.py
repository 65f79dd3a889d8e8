"""Polyhedra and evidence in space in numba's simulator, against the same source compiled for the CPU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks import cuda_space
from tests import test_evidence_kernel as scenes_in_the_plane
from tests import test_saturation_in_space as clipped
from tests import test_sets_in_space as scenes
from tests.on_simulator._both import SIZES, both, launched, same
from tests.on_simulator.planar import same_evidence
from tests.scenes_in_space import DEPENDENT, random_scene, scene_of
from torchfsid import device
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import Evidence, SetKind, evidence
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import GoalTask, Task, UnknownGainGoalTask
from torchfsid.sets import compiled_polyhedron
from torchfsid.sets.feasible_set import FeasibleSet

__all__ = ["launched"]  # a fixture
pytestmark = pytest.mark.filterwarnings("ignore:divide by zero", "ignore:invalid value")


def same_sets(one: FeasibleSet, other: FeasibleSet) -> None:
    """The same facets and vertices in the same slots, and the same answers."""
    slots = max(one.body.b.shape[1], other.body.b.shape[1])
    for mine, theirs in zip(one.body._resized(slots), other.body._resized(slots), strict=True):
        same(mine, theirs)
    for part in ("outcome", "last_cut"):
        same(getattr(one, part), getattr(other, part))
    for part in ("known.A", "known.b", "time", "source"):
        mine, theirs = (_part(sets.contradiction, part) for sets in (one, other))
        same(mine, theirs)
    for part in ("volume", "centroid", "diameter"):
        same(getattr(one, part)(), getattr(other, part)())


def _part(record: object, path: str) -> torch.Tensor:
    for name in path.split("."):
        record = getattr(record, name)
    assert isinstance(record, torch.Tensor)
    return record


def cubes(count: int, most: int = 32) -> FeasibleSet:
    corner = torch.ones(count, 3, dtype=torch.float64)
    return FeasibleSet.from_box(-corner, corner, most)


def rows(count: int, number: int, seed: int, width: float = 1.0) -> Halfspaces:
    """Tangents of balls around the origin, some of them thin: there, two rows face each other."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(count, number, 3))
    b = np.linalg.norm(A, axis=-1) * rng.uniform(0.5, 1.2, (count, number))
    if width < 1 and number > 1:
        A[:, 1] = -A[:, 0] + width * A[:, 1]
        b[:, :2] *= width
    return Halfspaces(torch.from_numpy(A), torch.from_numpy(b))


@pytest.mark.parametrize(("count", "number"), [(1, 1), (7, 6), (65, 2)])
def test_polyhedra_are_cut_alike(count: int, number: int) -> None:
    def cut() -> FeasibleSet:
        sets = cubes(count)
        for time in range(2):
            sets = sets.intersect(rows(count, number, time), float(time))
        return sets

    one, other = both(cut)
    assert (one.last_cut >= 0).any()
    same_sets(one, other)


@pytest.mark.parametrize("width", [1e-3, 1e-8, 0.0])
def test_thin_polyhedra_are_cut_alike(width: float) -> None:
    """Flat ones, too."""
    same_sets(*both(lambda: cubes(3).intersect(rows(3, 6, 5, width)).intersect(rows(3, 2, 6))))


def test_full_polyhedra_are_merged_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several by one thread, whose scratch is that of the one before."""
    monkeypatch.setattr(device, "SCRATCH", 1)
    one, other = both(lambda: cubes(3, most=8).intersect(rows(3, 7, 1)).intersect(rows(3, 4, 2)))
    same_sets(one, other)
    assert int(other.body.count.max()) == 8
    one, other = both(lambda: cubes(2).intersect(rows(2, 5, 3)).body.merge(7))
    for mine, theirs in zip(one._resized(7), other._resized(7), strict=True):
        same(mine, theirs)


def test_a_polyhedron_that_does_not_fit_stays_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither more facets than slots, nor a smaller set than is true: only the second row replaces a facet."""
    real = compiled_polyhedron._empty
    monkeypatch.setattr(compiled_polyhedron, "_empty", lambda B, F, like: real(B, 6, like))
    A, b = torch.ones(3, 1, 3, dtype=torch.float64), torch.ones(3, 1, dtype=torch.float64)
    A[1] *= torch.tensor([1.0, 0, 0])
    b[1] = 0.5
    found = cubes(3).intersect(Halfspaces(A, b), 1.0)
    assert found.volume().tolist() == [8.0, 6.0, 8.0]
    assert found.last_cut.isnan().tolist() == [True, False, True]


def test_emptiness_comes_with_its_proof() -> None:
    """Rows beyond the cube, rows that contradict each other, rows that only touch, and a row that is beyond nothing."""
    A = torch.tensor(
        [[[1.0, 0, 0], [0, 1, 0]], [[1, 1, 0], [-1, -1, 0]], [[1, 1, 1], [-1, -1, -1]], [[0, 0, 1], [1, 0, 0]]]
    )
    b = torch.tensor([[-3.0, 5], [0.2, -0.4], [0.5, -0.5], [7.0, 9]])
    one, other = both(lambda: cubes(4).intersect(Halfspaces(A.double(), b.double()), 2.0))
    same_sets(one, other)
    assert other.outcome.tolist() == [Status.EMPTY, Status.EMPTY, Status.UNDECIDED, Status.OK]
    assert other.contradiction.source[1].max() == 1


def test_gradients_are_alike() -> None:
    """Which rows become facets is found on the device. What polyhedra answer are formulae of them."""
    A, b = rows(2, 6, 8).A, rows(2, 6, 8).b

    def gradients() -> tuple[torch.Tensor, ...]:
        N, c = A.clone().requires_grad_(), b.clone().requires_grad_()
        sets = cubes(2).intersect(Halfspaces(N[:, :3], c[:, :3])).intersect(Halfspaces(N[:, 3:], c[:, 3:]))
        answers = sets.volume().log().sum() + sets.diameter().sum() + sets.centroid()[:, 0].sum()
        answers = answers + sets.support(torch.ones(2, 3, dtype=torch.float64)).sum() + sets.vertices()[:, 1].sum()
        return sets.body._resized(16)[6], *torch.autograd.grad(answers, (N, c))

    for mine, theirs in zip(*both(gradients), strict=True):
        assert mine.abs().max() > 0
        same(mine, theirs)


@pytest.mark.parametrize("kind", ["inverse_optimal", "critical_region"])
@pytest.mark.parametrize("errors", [False, True], ids=["exact positions", "position errors"])
@pytest.mark.parametrize("count", SIZES[:2])
def test_measurements_are_read_alike(kind: SetKind, errors: bool, count: int) -> None:
    rng = np.random.default_rng(1)
    chosen = [random_scene(rng, int(rng.integers(1, 4)), crowded=0.3) for _ in range(count)]
    one, other = both(lambda: scenes.both(kind, chosen, errors)[1])
    same_in_space(one, other)


def same_in_space(one: Evidence, other: Evidence) -> None:
    """The device has a place for each row that there could be. Those that the CPU leaves out are padding."""
    R = one.omega.rows
    assert (other.omega.A[:, R:] == 0).all()
    assert (other.omega.b[:, R:] == 1).all()
    assert other.omega.source is not None
    kept = Halfspaces(other.omega.A[:, :R], other.omega.b[:, :R], other.omega.source[:, :R])
    same_evidence(one, replace(other, omega=kept))


@pytest.mark.parametrize("name", DEPENDENT)
def test_dependent_rows_are_read_alike(name: str) -> None:
    same_in_space(*both(lambda: scenes.both("critical_region", [scene_of(name, np.random.default_rng(2))], False)[1]))


@pytest.mark.parametrize("name", ["norm", "lazy box"])
def test_clipped_controls_are_read_alike(name: str, launched: list[str]) -> None:
    same_in_space(*both(lambda: evidence(*clipped.scene(name, errors=True, count=5), compiled=True)))
    assert launched == ["space.evidence", "space.clip", "space.unclipped"]


@pytest.mark.parametrize("task", [GoalTask(0.8, dimension=3), UnknownGainGoalTask()], ids=["in space", "unknown gain"])
def test_the_observer_is_the_same(task: Task, launched: list[str]) -> None:
    """Robots in space, and planar ones whose gain is unknown. Some lie. Sets, statuses and events are the same."""
    n = 3 if isinstance(task, GoalTask) else 2
    low = torch.full((5, 3), -6.0, dtype=torch.float64) if n == 3 else torch.tensor([[0.1, -6, -6]] * 5).double()

    def observed() -> tuple[SetMembershipObserver, list]:
        rng, estimates = np.random.default_rng(8), []
        sets = FeasibleSet.from_box(low, torch.full_like(low, 6.0))
        watching = SetMembershipObserver(task, [CollisionAvoidance(ClassK(1.5), 0.4)], sets, noise=NoiseBound(0.05))
        for step in range(3):
            x, bodies = rng.normal(size=(5, n)), rng.normal(size=(5, 2, n)) * 2
            u = 0.8 * (1.0 - x) + rng.uniform(-0.03, 0.03, (5, n))
            seen = torch.from_numpy(rng.uniform(size=(5, 2)) < 0.6)
            x, u, bodies = map(torch.from_numpy, (x, u, bodies))
            estimates.append(watching.update(Measurement(float(step), x, u, bodies, seen)))
        return watching, estimates

    (mine, ours), (other, theirs) = both(observed)
    assert {"space.clip", "space.evidence" if n == 3 else "planar.evidence"} <= set(launched)
    for one, two in zip(ours, theirs, strict=True):
        same(one.status, two.status)
        same(one.informative, two.informative)
        same(one.feasible_set.volume(), two.feasible_set.volume())
    assert [scenes_in_the_plane.outline(event) for event in mine.events] == [
        scenes_in_the_plane.outline(event) for event in other.events
    ]
    assert mine.events


def test_the_section_of_the_benchmark_runs() -> None:
    for run in cuda_space.compare(2, "cpu", 3)["runs"]:
        assert run["truths_lost"] == 0
        assert run["largest_relative_difference"] == 0


def test_there_may_be_no_robots() -> None:
    def nobody() -> FeasibleSet:
        return cubes(0).intersect(Halfspaces(torch.zeros(0, 2, 3).double(), torch.zeros(0, 2).double()))

    for sets in both(nobody):
        assert sets.volume().shape == (0,)
        assert sets.body.merge(6).A.shape[0] == 0
