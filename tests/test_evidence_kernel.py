"""The compiled reading of a measurement against torch: the same half-spaces up to round-off, the same events.

Scenes whose decisions hang on the last bit (a row exactly at a tolerance) are not among the random ones.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.problems import CASES, Scene, batch, paper_case, random_scene
from torchfsid.errors import InputError
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import Evidence, ObservationModel, evidence
from torchfsid.observers.set_membership import Event, SetMembershipObserver
from torchfsid.robots.affine_barrier import AffineBarrier
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.barriers import SpeedPolygon
from torchfsid.robots.bounds import NoiseBound, RowErrors
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import AffineTask, GoalTask, Saturation, UnknownGainGoalTask
from torchfsid.sets.feasible_set import FeasibleSet


def square(count: int, half: float = 6.0) -> FeasibleSet:
    corner = torch.full((count, 2), half, dtype=torch.float64)
    return FeasibleSet.from_box(-corner, corner)


def both(kind: Any, scenes: list[Scene], errors: bool = False, spoilt: bool = True) -> tuple[Evidence, Evidence]:
    """What the same scenes say in torch and compiled. Where `spoilt`, some rows are NaN, some robots are not measured,
    some are too fast; with `errors`, rows are turned and moved, some of them in any way."""
    safe_controls, _, u, C, d = batch(scenes)
    rng, (count, m) = np.random.default_rng(3), safe_controls.b.shape
    A, b, observed = safe_controls.A, safe_controls.b.clone(), torch.ones(count, dtype=torch.bool)
    if spoilt:
        u = u + torch.from_numpy(rng.uniform(-0.02, 0.02, u.shape))
        u[::11] *= 3.0
        b[::17, 0], d[::19, 1] = torch.nan, torch.inf
        observed[::13] = False
    angle, slack = (torch.from_numpy(rng.uniform(0, 0.3, (count, m))) for _ in range(2))
    angle[::7, 0] = torch.pi

    def barrier(j: int) -> AffineBarrier:
        told = RowErrors(angle[:, j : j + 1], slack[:, j : j + 1])
        return AffineBarrier(A[:, j : j + 1], b[:, j : j + 1], (str(j),), j % 3 == 1, lambda *_: told)

    task = AffineTask(C, d, ("p", "q"), sensitivity=0.3)
    noise = NoiseBound(0.02, slack=0.03, position=0.1 if errors else 0.0)
    model = ObservationModel(task, [barrier(j) for j in range(m)], kind, noise)
    velocity_error = torch.from_numpy(rng.uniform(0, 0.05, count)) if errors else None
    nobody = torch.zeros(count, 0, 2, dtype=torch.float64)
    seen = Measurement(
        0.0, torch.zeros_like(u), u, nobody, nobody[..., 0].bool(), observed=observed, velocity_error=velocity_error
    )
    return evidence(model, square(count), seen, False), evidence(model, square(count), seen, True)


def unordered(rows: Halfspaces) -> np.ndarray:
    """Each item's rows (A, b, source), padding left out, in an order of their own."""
    assert rows.source is not None
    table = torch.cat([rows.A, rows.b.unsqueeze(-1), rows.source.unsqueeze(-1).double()], dim=-1)
    kept = [item[(item[:, :2] != 0).any(-1)] for item in table]
    most = max(len(item) for item in kept)
    padded = torch.stack([torch.nn.functional.pad(item, (0, 0, 0, most - len(item))) for item in kept]).numpy()
    return np.stack([item[np.lexsort(item.round(9).T)] for item in padded])


def same_kkt(compiled: Evidence, reference: Evidence) -> None:
    for name in ("active", "n_active", "rank", "case"):
        assert torch.equal(getattr(compiled.kkt, name), getattr(reference.kkt, name)), name
    for name in ("G", "f", "projector", "free", "offset"):
        torch.testing.assert_close(getattr(compiled.kkt, name), getattr(reference.kkt, name), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("kind", ["inverse_optimal", "critical_region"])
@pytest.mark.parametrize("errors", [False, True], ids=["exact positions", "position errors"])
def test_what_a_measurement_says(kind: str, errors: bool) -> None:
    rng = np.random.default_rng(1)
    reference, compiled = both(
        kind, [random_scene(rng, int(rng.integers(1, 9)), crowded=0.3) for _ in range(300)], errors
    )
    assert 30 < int(reference.informative.sum()) < 290
    assert int(reference.alarmed.sum()) > 0
    for name in ("informative", "alarmed"):
        assert torch.equal(getattr(compiled, name), getattr(reference, name))
    for name in ("slack", "excess"):
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
    expected, found = (square(20).intersect(each.omega, 1.0).volume() for each in (reference, compiled))
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("angle", [1e-3, 1e-5, 4e-7])
def test_nearly_parallel_rows(angle: float) -> None:
    """Two active rows, barely independent: the vertex where they meet, to the digits that are there."""
    rng = np.random.default_rng(5)
    scenes = []
    for first, u in zip(rng.uniform(0, 2 * np.pi, 50), rng.normal(size=(50, 2)), strict=True):
        A = np.stack([[np.cos(first + k * angle), np.sin(first + k * angle)] for k in (0, 1)])
        scenes.append(Scene(A, A @ u, np.eye(2), np.zeros(2), u, u, np.array([True, True])))
    u = torch.from_numpy(np.stack([scene.u for scene in scenes]))
    for found in both("inverse_optimal", scenes, spoilt=False):
        assert (found.kkt.rank == 2).all()
        assert (found.kkt.f - u).abs().max() < 1e-14 / angle


@pytest.mark.parametrize("kind", ["inverse_optimal", "critical_region"])
def test_the_whole_observer(kind: Any) -> None:
    """Twelve measurements of 60 robots, some lying, some with speed limits reached: same sets, statuses and events."""
    rng = np.random.default_rng(8)
    barriers = [
        CollisionAvoidance(ClassK(1.5), safety_distance=0.4, neighbour_velocity="current"),
        SpeedPolygon(8, 1.0),
    ]
    noise = NoiseBound(0.05, position=0.01) if kind == "inverse_optimal" else NoiseBound(0.05)
    reference, compiled = (
        SetMembershipObserver(GoalTask(0.8), barriers, square(60), kind, noise, 0.02, compiled=wish)
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


SATURATIONS = [
    Saturation("norm", (0.5, 0.5)),
    Saturation("box", (0.5, 0.3)),
    Saturation("norm", (0.5, 0.5), dead_speed=0.1),
    Saturation("box", (0.5, 0.3), dead_speed=0.1),
    Saturation("norm", (np.inf, np.inf), dead_speed=0.1),
]


@pytest.mark.parametrize("saturation", SATURATIONS, ids=["norm", "box", "lazy norm", "lazy box", "dead zone only"])
@pytest.mark.parametrize("errors", [False, True], ids=["exact positions", "position errors"])
@pytest.mark.parametrize("m", [0, 1, 3])
def test_clipped_nominal_controls(saturation: Saturation, errors: bool, m: int) -> None:
    """Robots that are clipped for sure, perhaps, or never. Some have no theta left, and their u is out of reach.

    The rows that hold u back, directions and C theta + d are all wrong by up to their bounds: the truth stays inside.
    """
    rng, count = np.random.default_rng(7), 1500
    shift, turn = (0.05, rng.uniform(0, 0.2, (count, m))) if errors else (0.0, np.zeros((count, m)))
    delta, width = rng.uniform(1e-4, 0.03, count), np.exp(rng.uniform(np.log(0.02), np.log(3.0), (count, 1)))
    C, d, theta = np.eye(2) + rng.uniform(-0.2, 0.2, (count, 2, 2)), rng.normal(size=(count, 2)), np.zeros((count, 2))
    disc = rng.normal(size=(2, count, 2))
    disc *= rng.uniform(size=(2, count, 1)) / np.linalg.norm(disc, axis=-1, keepdims=True)
    direction, may_hold = rng.uniform(0, 2 * np.pi, (count, m)), rng.uniform(size=(count, m)) < 0.4

    def rows(angle: np.ndarray) -> np.ndarray:
        return np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    multipliers = rng.exponential(0.5, (count, m, 1)) * (may_hold & (rng.uniform(size=(count, m)) < 0.8))[..., None]
    held = (multipliers * rows(direction + rng.uniform(-1, 1, (count, m)) * turn)).sum(1)
    u = saturation(torch.from_numpy(d + shift * disc[0])).numpy() - held + delta[:, None] * disc[1]
    A = rows(direction)
    b = (A * u[:, None]).sum(-1) + np.where(may_hold, rng.uniform(-1, 1, (count, m)) * delta[:, None], 1.0)
    u[::10] *= 5.0
    u, A, b, turn = map(torch.from_numpy, (u, A, b, turn))
    told = RowErrors(turn, torch.zeros_like(turn))
    barrier = AffineBarrier(A, b, tuple("abc"[:m]), row_errors=lambda *_: told)
    task = AffineTask(torch.from_numpy(C), torch.from_numpy(d), ("p", "q"), sensitivity=1.0, saturation=saturation)
    noise = NoiseBound(torch.from_numpy(delta), position=shift)
    model = ObservationModel(task, [barrier], noise=noise)
    middle = theta + rng.uniform(-0.45, 0.45, (count, 2)) * width
    prior = FeasibleSet.from_box(torch.from_numpy(middle - width / 2), torch.from_numpy(middle + width / 2))
    nobody = torch.zeros(count, 0, 2, dtype=torch.float64)
    seen = Measurement(0.0, torch.zeros_like(u), u, nobody, nobody[..., 0].bool())
    reference, compiled = (evidence(model, prior, seen, wish) for wish in (False, True))

    honest = compiled.informative & (torch.arange(count) % 10 > 0)
    assert compiled.omega.slack(torch.from_numpy(theta))[honest].min() > -1e-9
    impossible = [((each.omega.A == 0).all(-1) & (each.omega.b < 0)).any(-1) for each in (reference, compiled)]
    assert torch.equal(*impossible)
    assert bool(impossible[0].any()) == (max(saturation.limits) < np.inf)
    assert torch.equal(reference.informative, compiled.informative)
    # Faces of a box count as touched within 1e-9, and steep edges enlarge this.
    off = 1e-9 if saturation.shape == "norm" else 1e-6
    np.testing.assert_allclose(unordered(compiled.omega), unordered(reference.omega), rtol=off, atol=off)


def test_compiled_code_is_used_only_where_it_can_be() -> None:
    model = ObservationModel(GoalTask(1.0), [SpeedPolygon(8, 1.0)], noise=NoiseBound(0.01))
    x = torch.zeros(1, 2, dtype=torch.float64)
    learned = x.clone().requires_grad_()

    def of(x: torch.Tensor, compiled: bool | None) -> Evidence:
        return evidence(model, square(1), Measurement.of_team(0.0, x, torch.zeros_like(x)), compiled)

    assert of(learned, None).omega.b.requires_grad
    with pytest.raises(InputError, match="gradients"):
        of(learned, True)
    with torch.no_grad():
        of(learned, True)
    cube = FeasibleSet.from_box(*torch.tensor([[[-1.0] * 3], [[1.0] * 3]], dtype=torch.float64))
    both_unknown = ObservationModel(UnknownGainGoalTask(saturation=SATURATIONS[0]), model.barriers, noise=model.noise)
    with pytest.raises(InputError, match="clipped"):
        evidence(both_unknown, cube, Measurement.of_team(0.0, x, x), True)
    clipped = ObservationModel(GoalTask(0.9, saturation=SATURATIONS[0]), model.barriers, noise=model.noise)
    corner = torch.ones(1, 2, dtype=torch.float64).requires_grad_()
    with pytest.raises(InputError, match="gradients"):
        evidence(clipped, FeasibleSet.from_box(-corner, corner), Measurement.of_team(0.0, x, x), True)


@pytest.mark.parametrize("kind", ["inverse_optimal", "critical_region"])
@pytest.mark.parametrize("scale", [1e-200, 1e-160, 1e160, 1e200])
def test_the_scale_of_a_row_does_not_matter_to_compiled_code(kind: Any, scale: float) -> None:
    rng = np.random.default_rng(9)
    scenes = [random_scene(rng, 3) for _ in range(20)]
    extreme = [replace(scene, A=scale * scene.A, b=scale * scene.b) for scene in scenes]
    plain, scaled = (both(kind, each, spoilt=False)[1] for each in (scenes, extreme))
    np.testing.assert_allclose(unordered(scaled.omega), unordered(plain.omega), rtol=1e-9, atol=1e-12)
