"""The compiled kernels against torch, their reference: the same sets up to round-off, the same events and evidence.

Scenes whose decisions hang on the last bit (a row exactly at a tolerance) are not among the random ones.
"""

import numpy as np
import pytest
import torch

from tests.problems import CASES, batch, paper_case, random_scene
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import Bounds, Model, Reading, read
from torchfsid.kernels.compiled import use_kernel
from torchfsid.observers.set_membership import Event, SetMembershipObserver
from torchfsid.robots.barriers import ClassK, CollisionAvoidance, SpeedPolygon
from torchfsid.robots.bounds import NoiseBound, Uncertainty
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import GoalTask, Saturation
from torchfsid.sets.feasible_set import FeasibleSet

NOISE = NoiseBound(0.02, slack=0.03)


def square(count: int, half: float = 6.0, **options) -> FeasibleSet:
    corner = torch.full((count, 2), half, dtype=torch.float64)
    return FeasibleSet.from_box(-corner, corner, **options)


def uncertain(count: int, rows: int) -> Uncertainty:
    rng = np.random.default_rng(3)
    velocity, drift = (torch.from_numpy(rng.uniform(0, 0.05, count)) for _ in range(2))
    slack, angle = (torch.from_numpy(rng.uniform(0, 0.3, (count, rows))) for _ in range(2))
    return Uncertainty(velocity, slack, angle, drift)


def both(kind: str, scenes: list, uncertainty: Uncertainty | None = None) -> tuple[Reading, Reading]:
    """What the same scenes say in torch and compiled; some rows are NaN, some robots are not measured, some are
    too fast."""
    safe_controls, _, u, C, d = batch(scenes)
    u = u + torch.from_numpy(np.random.default_rng(4).uniform(-0.02, 0.02, u.shape))
    u[::11] *= 3.0
    b = safe_controls.b.clone()
    b[::17, 0], d[::19, 1] = torch.nan, torch.inf
    usable = torch.arange(len(u)) % 13 != 0
    model = Model(Halfspaces(safe_controls.A, b), torch.arange(b.shape[1]) % 3 != 1, C, d, None, None)
    bounds = Bounds(NOISE, uncertainty, 1e-3)
    reference, compiled = (read(kind, model, u, usable, bounds, wish) for wish in (False, True))  # type: ignore[arg-type]
    return reference, compiled


def unordered(rows: Halfspaces) -> np.ndarray:
    """Each item's rows (A, b, source), padding left out, in an order of their own."""
    assert rows.source is not None
    table = torch.cat([rows.A, rows.b.unsqueeze(-1), rows.source.unsqueeze(-1).double()], dim=-1)
    kept = [item[(item[:, :2] != 0).any(-1)] for item in table]
    most = max(len(item) for item in kept)
    padded = torch.stack([torch.nn.functional.pad(item, (0, 0, 0, most - len(item))) for item in kept]).numpy()
    return np.stack([item[np.lexsort(item.round(9).T)] for item in padded])


@pytest.mark.parametrize("kind", ["inverse_optimal", "critical_region"])
@pytest.mark.parametrize("errors", [False, True], ids=["exact positions", "position errors"])
def test_what_a_measurement_says(kind: str, errors: bool) -> None:
    rng = np.random.default_rng(1)
    scenes = [random_scene(rng, int(rng.integers(1, 9)), crowded=0.3) for _ in range(300)]
    reference, compiled = both(kind, scenes, uncertain(300, 8) if errors else None)
    assert 30 < int(reference.informative.sum()) < 290
    assert int(reference.alarmed.sum()) > 0
    for name in ("informative", "alarmed"):
        assert torch.equal(getattr(compiled, name), getattr(reference, name))
    for name in ("slack", "excess", "C", "d"):
        torch.testing.assert_close(getattr(compiled, name), getattr(reference, name), rtol=1e-13, atol=1e-13)
    same_kkt(compiled, reference)
    np.testing.assert_allclose(unordered(compiled.omega), unordered(reference.omega), rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("kind", ["inverse_optimal", "critical_region"])
@pytest.mark.parametrize("case", CASES)
def test_every_case_of_the_paper(kind: str, case: str) -> None:
    """Opposite, parallel and many active rows; equal angles may name another of the equal rows as the source."""
    rng = np.random.default_rng(2)
    reference, compiled = both(kind, [paper_case(case, rng) for _ in range(20)])
    same_kkt(compiled, reference)
    expected = square(20).intersect(reference.omega, 1.0)
    found = square(20).intersect(compiled.omega, 1.0)
    torch.testing.assert_close(found.volume(), expected.volume(), rtol=1e-9, atol=1e-12)


def same_kkt(compiled: Reading, reference: Reading) -> None:
    for name in ("active", "n_active", "rank", "case"):
        assert torch.equal(getattr(compiled.kkt, name), getattr(reference.kkt, name)), name
    for name in ("G", "f", "projector", "free", "offset"):
        torch.testing.assert_close(getattr(compiled.kkt, name), getattr(reference.kkt, name), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("angle", [1e-3, 1e-5, 4e-7])
def test_nearly_parallel_rows(angle: float) -> None:
    """Two active rows, barely independent: the vertex where they meet, to the digits that are there."""
    rng = np.random.default_rng(5)
    first = rng.uniform(0, 2 * np.pi, 50)
    normals = np.stack([np.stack([np.cos(first + k * angle), np.sin(first + k * angle)], -1) for k in (0, 1)], 1)
    u = rng.normal(size=(50, 2))
    b = (normals * u[:, None]).sum(-1)
    rows, C = (
        Halfspaces(torch.from_numpy(normals), torch.from_numpy(b)),
        torch.eye(2, dtype=torch.float64).repeat(50, 1, 1),
    )
    model = Model(rows, torch.ones(2, dtype=torch.bool), C, torch.zeros(50, 2, dtype=torch.float64), None, None)
    for wish in (False, True):
        usable, bounds = torch.ones(50, dtype=torch.bool), Bounds(NOISE, None, 1e-3)
        reading = read("inverse_optimal", model, torch.from_numpy(u), usable, bounds, wish)
        assert (reading.kkt.rank == 2).all()
        assert (reading.kkt.f - torch.from_numpy(u)).abs().max() < 1e-14 / angle


@pytest.mark.parametrize("kind", ["inverse_optimal", "critical_region"])
def test_the_whole_observer(kind: str) -> None:
    """Twelve measurements of 60 robots, some lying, some with speed limits reached: same sets, statuses and events."""
    rng = np.random.default_rng(8)
    barriers = [
        CollisionAvoidance(ClassK(1.5), safety_distance=0.4, neighbour_velocity="current"),
        SpeedPolygon(8, 1.0),
    ]
    noise = NoiseBound(0.05, position=0.01) if kind == "inverse_optimal" else NoiseBound(0.05)
    reference, compiled = (
        SetMembershipObserver(GoalTask(0.8), barriers, square(60), kind, noise, 0.02, compiled=wish)  # type: ignore[arg-type]
        for wish in (False, True)
    )
    for step in range(12):
        x, bodies = rng.normal(size=(60, 2)), rng.normal(size=(60, 4, 2)) * 2
        u = np.clip(0.8 * (1.0 - x) + rng.uniform(-0.03, 0.03, (60, 2)), -0.6, 0.6)
        measurement = Measurement(
            t=float(step), x=torch.from_numpy(x), u=torch.from_numpy(u), bodies=torch.from_numpy(bodies),
            present=torch.from_numpy(rng.uniform(size=(60, 4)) < 0.6), body_velocities=torch.zeros(60, 4, 2).double(),
        )  # fmt: skip
        mine, other = compiled.update(measurement), reference.update(measurement)
        assert torch.equal(mine.informative, other.informative)
        assert torch.equal(mine.status, other.status)
        torch.testing.assert_close(mine.feasible_set.volume(), other.feasible_set.volume(), rtol=1e-9, atol=1e-12)
    assert [outline(event) for event in compiled.events] == [outline(event) for event in reference.events]
    assert {event.status.name for event in reference.events} == {"ALARM", "INCONSISTENT"}
    assert torch.equal(compiled.skipped, reference.skipped)


def outline(event: Event) -> tuple:
    """An event and the row that raised it; where many edges meet in a corner, the last bit names two of them."""
    return event.t, event.robot, event.status, event.reset, event.rows[0]


def test_the_kernel_is_used_only_where_it_can_be() -> None:
    plain, learned = torch.zeros(3), torch.zeros(3, requires_grad=True)
    assert use_kernel(None, plain)
    assert not use_kernel(False, plain)
    assert not use_kernel(None, plain, learned)
    with torch.no_grad():
        assert use_kernel(True, learned)
    with pytest.raises(InputError, match="gradients"):
        use_kernel(True, plain, learned)
    saturated = GoalTask(0.9, saturation=Saturation("norm", (1.0, 1.0)))
    with pytest.raises(InputError, match="compiled"):
        SetMembershipObserver(saturated, [], square(1), noise=NOISE, compiled=True)
