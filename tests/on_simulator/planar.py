"""Polygons and evidence. A test for a process with NUMBA_ENABLE_CUDASIM=1, see `tests.test_cuda` and `_both`."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from tests import test_evidence_kernel as scenes
from tests.on_simulator._both import SIZES, both, launched, same
from tests.problems import CASES, paper_case, random_scene
from torchfsid import device
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification import compiled_evidence
from torchfsid.identification.evidence import Evidence
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import SpeedPolygon
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import GoalTask, Saturation
from torchfsid.sets.feasible_set import FeasibleSet
from torchfsid.sets.polygon import Polygon

pytestmark = pytest.mark.filterwarnings("ignore:divide by zero")  # in Python, a row 0.z <= -1 is noticed


def same_sets(one: FeasibleSet, other: FeasibleSet) -> None:
    """The same edges in the same slots, of which there may be more."""
    slots = max(one.body.slots, other.body.slots)
    for mine, theirs in zip(one.body._resized(slots), other.body._resized(slots), strict=True):
        same(mine, theirs)
    for name in ("outcome", "last_cut"):
        same(getattr(one, name), getattr(other, name))
    for part in ("halfspaces", "time", "source"):
        mine, theirs = getattr(one.contradiction, part), getattr(other.contradiction, part)
        for a, b in ((mine.A, theirs.A), (mine.b, theirs.b)) if part == "halfspaces" else ((mine, theirs),):
            same(a, b)


def cut(count: int, rows: int, times: int, most: int = 32, width: float = 1.0, seed: int = 0) -> FeasibleSet:
    """Squares of this half width, cut again and again by tangents of discs around points inside."""
    rng = np.random.default_rng(seed)
    corner = torch.full((count, 2), width, dtype=torch.float64)
    sets = FeasibleSet.from_box(-corner, corner, most)
    for time in range(times):
        angle = torch.from_numpy(rng.uniform(0, 2 * np.pi, (count, rows)))
        A = torch.stack([angle.cos(), angle.sin()], dim=-1)
        about = torch.from_numpy(rng.uniform(0.2, 1.2, (count, rows))) * width * (0.9**time)
        sets = sets.intersect(Halfspaces(A, about), float(time))
    return sets


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("rows", [1, 6])
def test_polygons_are_cut_alike(count: int, rows: int) -> None:
    one, other = both(lambda: cut(count, rows, 6))
    assert (one.last_cut > 0).any()
    same_sets(one, other)


@pytest.mark.parametrize("width", [1e-3, 1e-8])
def test_thin_polygons_are_cut_alike(width: float) -> None:
    one, other = both(lambda: cut(20, 4, 5, width=width))
    same_sets(one, other)


def test_full_rings_are_merged_alike() -> None:
    one, other = both(lambda: cut(33, 9, 8, most=6))
    same_sets(one, other)
    assert int(other.body.count.max()) == 6


def cut_by_hand(square: Polygon, A: torch.Tensor, b: torch.Tensor) -> tuple[list, torch.Tensor, torch.Tensor]:
    """The polygons that the kernel fills, with as many slots, whether they are smaller, and the list of the late."""
    B, nothing = len(b), torch.zeros(len(b), 3, dtype=torch.float64)
    parts = [torch.full_like(part, -7) for part in square.fields()[:7]]
    found, late = (torch.zeros(B).long(), torch.zeros(B, dtype=torch.bool)), torch.zeros(B + 1, dtype=torch.int32)
    lost = nothing.unsqueeze(-1).repeat(1, 1, 2), nothing.clone(), nothing.clone(), nothing.long()
    rows = A, b, torch.zeros(1, 1, dtype=torch.float64), torch.zeros_like(b).long()
    device.launch("planar.clip", (square.fields(), rows), (32, False), ((*parts, square.reach), found, lost, (late,)))
    return parts, found[1], late


def test_a_ring_that_does_not_fit_stays_as_it_was() -> None:
    """Neither more edges than slots, nor a smaller set than is true."""
    corner = torch.ones(3, 2, dtype=torch.float64)
    square = FeasibleSet.from_box(-corner, corner).body
    A, b = torch.ones(3, 1, 2, dtype=torch.float64), torch.ones(3, 1, dtype=torch.float64)
    A[1] = A[1] * torch.tensor([1.0, 0.0])
    b[1] = 0.5
    parts, shrunk, late = cut_by_hand(square, A, b)
    assert shrunk.tolist() == [False, True, False]
    assert late.tolist() == [0, 0, 0, 0]
    assert parts[6].tolist() == [4, 4, 4]
    for part, before in zip(parts, square.fields()[:7], strict=True):
        same(part[::2], before[::2])
    assert parts[0][1, :, 0].max() == 0.5


def test_polygons_with_many_cuts_are_late() -> None:
    """The same row five times is five cuts, of which the first is the only one that removes anything."""
    corner = torch.ones(70, 2, dtype=torch.float64)
    square = FeasibleSet.from_box(-corner, corner).body
    A, b = torch.tensor([1.0, 0.0]).double().repeat(70, 5, 1), torch.full((70, 5), 9.0).double()
    b[1], b[66], b[2, 0] = 0.5, 0.5, 0.5
    parts, shrunk, late = cut_by_hand(square, A, b)
    assert late[0] == 2
    assert set(late[1:3].tolist()) == {1, 66}
    assert shrunk.nonzero().flatten().tolist() == [1, 2, 66]
    same(parts[0][..., 0].amax(1), torch.where(shrunk, 0.5, 1.0).double())
    assert (parts[6] == 4).all()


def test_emptiness_comes_with_its_proof() -> None:
    """Rows beyond the square, rows that contradict each other, and rows that only touch."""
    A = torch.tensor([[[1.0, 0], [0, 1]], [[1, 0], [-1, 0]], [[1, 1], [-1, -1]], [[0, 1], [1, 0]]]).double()
    b = torch.tensor([[-3.0, 5], [0.2, -0.4], [0.5, -0.5], [-1, 9]]).double()
    corner = torch.ones(4, 2, dtype=torch.float64)
    one, other = both(lambda: FeasibleSet.from_box(-corner, corner).intersect(Halfspaces(A, b), 2.0))
    same_sets(one, other)
    assert other.outcome.tolist() == [Status.EMPTY, Status.EMPTY, Status.UNDECIDED, Status.UNDECIDED]
    assert (other.contradiction.source[1].max(), other.emptiness().outcome[0]) == (1, Status.EMPTY)


def test_gradients_are_alike() -> None:
    """The rows that become edges are found on the device. Areas are formulae of them."""
    rng = np.random.default_rng(4)
    angle, about = torch.from_numpy(rng.uniform(0, 2 * np.pi, (5, 8))), torch.from_numpy(rng.uniform(0.5, 1.2, (5, 8)))

    def gradients() -> tuple[torch.Tensor, torch.Tensor]:
        turn, bound = angle.clone().requires_grad_(), about.clone().requires_grad_()
        sets = FeasibleSet.from_box(-torch.ones(5, 2).double(), torch.ones(5, 2).double())
        for part in range(2):
            some = slice(4 * part, 4 * part + 4)
            A = torch.stack([turn[:, some].cos(), turn[:, some].sin()], dim=-1)
            sets = sets.intersect(Halfspaces(A, bound[:, some]))
        return torch.autograd.grad(sets.volume().log().sum(), (turn, bound))

    for mine, theirs in zip(*both(gradients), strict=True):
        assert mine.abs().max() > 0
        torch.testing.assert_close(mine, theirs, rtol=1e-13, atol=1e-13)


def same_evidence(one: Evidence, other: Evidence) -> None:
    for name in ("informative", "alarmed", "infeasible", "slack", "excess"):
        same(getattr(one, name), getattr(other, name))
    for mine, theirs in (
        *((getattr(one.kkt, part.name), getattr(other.kkt, part.name)) for part in fields(one.kkt)),
        (one.omega.A, other.omega.A), (one.omega.b, other.omega.b), (one.omega.source, other.omega.source),
    ):  # fmt: skip
        torch.testing.assert_close(mine, theirs, rtol=1e-13, atol=1e-13, equal_nan=True)


@pytest.mark.parametrize("kind", ["inverse_optimal", "critical_region"])
@pytest.mark.parametrize("errors", [False, True], ids=["exact positions", "position errors"])
@pytest.mark.parametrize("count", SIZES)
def test_measurements_are_read_alike(kind: str, errors: bool, count: int, launched: list[str]) -> None:
    rng = np.random.default_rng(1)
    chosen = [random_scene(rng, int(rng.integers(1, 7)), crowded=0.3) for _ in range(count)]
    one, other = both(lambda: scenes.both(kind, chosen, errors)[1])
    assert launched == ["planar.evidence"]  # slacks and KKT conditions follow when they are asked for
    same_evidence(one, other)
    assert launched == ["planar.evidence", "planar.details"]


def test_relaxed_rows_are_read_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every case of the paper, as if the controller took the least violation of infeasible rows."""
    rng, read = np.random.default_rng(2), compiled_evidence.read
    monkeypatch.setattr(
        compiled_evidence, "read", lambda model, sample: read(model, replace(sample, relaxed=~sample.hard))
    )
    chosen = [paper_case(case, rng) for case in CASES * 4]
    one, other = both(lambda: scenes.both("inverse_optimal", chosen)[1])
    assert other.infeasible.any()
    same_evidence(one, other)


@pytest.mark.parametrize("saturation", [None, Saturation("norm", (0.5, 0.5), 0.1), Saturation("box", (0.5, 0.3))])
def test_the_observer_is_the_same(saturation: Saturation | None, launched: list[str]) -> None:
    """Some robots lie and some are too fast. Sets, statuses and events are the same."""

    def observed() -> tuple[SetMembershipObserver, list]:
        rng, estimates = np.random.default_rng(8), []
        barriers = [CollisionAvoidance(ClassK(1.5), safety_distance=0.4), SpeedPolygon(6, 1.0)]
        task = GoalTask(0.8, saturation=saturation)
        corner = torch.full((21, 2), 6.0, dtype=torch.float64)
        watching = SetMembershipObserver(task, barriers, FeasibleSet.from_box(-corner, corner), noise=NoiseBound(0.05))
        for step in range(4):
            x, bodies = rng.normal(size=(21, 2)), rng.normal(size=(21, 2, 2)) * 2
            u = np.clip(0.8 * (1.0 - x) + rng.uniform(-0.03, 0.03, (21, 2)), -0.6, 0.6)
            seen = torch.from_numpy(rng.uniform(size=(21, 2)) < 0.6)
            x, u, bodies = map(torch.from_numpy, (x, u, bodies))
            estimates.append(watching.update(Measurement(float(step), x, u, bodies, seen)))
        return watching, estimates

    (mine, ours), (other, theirs) = both(observed)
    assert {"planar.clip", "planar.evidence"} <= set(launched)
    for one, two in zip(ours, theirs, strict=True):
        same(one.status, two.status)
        same(one.informative, two.informative)
        torch.testing.assert_close(one.feasible_set.volume(), two.feasible_set.volume(), rtol=1e-12, atol=1e-13)
    assert [scenes.outline(event) for event in mine.events] == [scenes.outline(event) for event in other.events]
    assert {event.status for event in mine.events} == {Status.ALARM, Status.INCONSISTENT}
    same(mine.skipped, other.skipped)


def test_there_may_be_no_robots() -> None:
    def nobody() -> tuple[FeasibleSet, Evidence]:
        read = scenes.both("inverse_optimal", [random_scene(np.random.default_rng(1), 2)], spoilt=False)[1]
        sets = FeasibleSet.from_box(torch.zeros(0, 2).double(), torch.zeros(0, 2).double())
        return sets.intersect(Halfspaces(read.omega.A[:0], read.omega.b[:0])), read.select(torch.arange(0))

    for sets, read in both(nobody):
        assert sets.volume().shape == (0,)
        assert read.omega.batch_shape == (0,)
