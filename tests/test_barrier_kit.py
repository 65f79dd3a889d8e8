"""The test kit for barriers: those of the package pass, and each check finds what it is there to find."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import torchfsid as fsid
from torchfsid.errors import BarrierError
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification import compiled_evidence
from torchfsid.robots.barriers import Barrier
from torchfsid.robots.bounds import ErrorBounds, RowErrors
from torchfsid.robots.orca import Orca
from torchfsid.robots.speed_disc import SpeedDisc
from torchfsid.testing import (
    check_barrier,
    check_compiled,
    check_derivative,
    check_soundness,
    random_situations,
    second_order,
)

FORMS = [
    ("squared", "none", 1.0),
    ("squared", "current", 3.0),
    ("squared", "previous", 0.5),
    ("euclidean", "none", 3.0),
    ("euclidean", "current", 1.0),
    ("euclidean", "previous", 2.0),
]


def avoidance(distance: Any = "squared", velocity: Any = "current", power: float = 1.0) -> fsid.CollisionAvoidance:
    return fsid.CollisionAvoidance(
        fsid.ClassK(1.5, power), safety_distance=0.3, distance=distance, neighbour_velocity=velocity
    )


AVOIDANCE = avoidance()
ARENA = fsid.Arena((-1.5, -1.0), (1.5, 1.2), fsid.ClassK(2.0, 3.0), margin=0.05)
DISC, ORCA = SpeedDisc(0.6), Orca(1.0, 0.1, max_speed=1.2, count=5, distance=3.0)
OTHERS: dict[str, Barrier] = {
    "margin": fsid.CollisionAvoidance(fsid.ClassK(1.5), margin=0.1, neighbour_velocity="previous"),
    "speed box": fsid.SpeedBox((0.5, 0.4)),
    "speed polygon": fsid.SpeedPolygon(8, 0.5),
    "constant rows": fsid.AffineBarrier(torch.tensor([[3.0, 4.0]]), torch.tensor([1.0]), ("leash",), soft=True),
    "functions": fsid.AffineBarrier(
        lambda m: ARENA(m).A,
        lambda m: ARENA(m).b,
        ("e", "n", "w", "s"),
        row_errors=ARENA.errors,
        depends_on_bodies=False,
    ),
    "arena": ARENA,
}


def distances(measurement: fsid.Measurement) -> Tensor:
    return (measurement.x.unsqueeze(-2) - measurement.bodies).norm(dim=-1)


@pytest.mark.parametrize(("distance", "velocity", "power"), FORMS)
def test_avoidance_keeps_its_promises(distance: str, velocity: str, power: float) -> None:
    barrier = avoidance(distance, velocity, power)

    def h(measurement: fsid.Measurement) -> Tensor:
        r = distances(measurement)
        return r**2 - 0.3**2 if distance == "squared" else r - 0.3

    check_barrier(barrier, h=h, alpha=barrier.class_k)


@pytest.mark.parametrize("name", OTHERS)
def test_the_other_barriers_keep_theirs(name: str) -> None:
    check_barrier(OTHERS[name])


def test_walls_are_class_k_functions_of_the_distance() -> None:
    upper, lower = (torch.tensor(ends, dtype=torch.float64) for ends in (ARENA.upper, ARENA.lower))
    check_barrier(
        ARENA, h=lambda m: torch.cat([upper - m.x, m.x - lower], dim=-1) - ARENA.margin, alpha=ARENA.class_k, seed=1
    )


class Planted:
    """A barrier with some members replaced by wrong ones."""

    def __init__(
        self, of: Any = AVOIDANCE, rows: Callable[[fsid.Measurement], Halfspaces] | None = None, **members: Any
    ):
        self.of, self.rows, self.members = of, rows or of, members

    def __call__(self, measurement: fsid.Measurement) -> Halfspaces:
        return self.rows(measurement)

    def __getattr__(self, name: str) -> Any:
        members = self.__dict__["members"]
        return members[name] if name in members else getattr(self.__dict__["of"], name)


def scaled_errors(
    angle: float, slack: float, of: Any = AVOIDANCE
) -> Callable[[fsid.Measurement, ErrorBounds], RowErrors]:
    def errors(measurement: fsid.Measurement, bounds: ErrorBounds) -> RowErrors:
        told = of.errors(measurement, bounds)
        return RowErrors(torch.where(told.angle < math.pi, angle * told.angle, math.pi), slack * told.slack)

    return errors


def wrong_share(measurement: fsid.Measurement) -> Halfspaces:
    assert measurement.body_velocities is not None
    return AVOIDANCE(replace(measurement, body_velocities=-measurement.body_velocities))


def not_padded(measurement: fsid.Measurement) -> Halfspaces:
    return AVOIDANCE(replace(measurement, present=torch.ones_like(measurement.present)))


def other_padding(measurement: fsid.Measurement) -> Halfspaces:
    rows = AVOIDANCE(measurement)
    return Halfspaces(rows.A, torch.where(measurement.present, rows.b, 0.0))


def by_the_batch(measurement: fsid.Measurement) -> Halfspaces:
    rows = AVOIDANCE(measurement)
    return Halfspaces(rows.A, rows.b - 0.01 * rows.b.nan_to_num().mean())


class Moody:
    """Rows that move a little with every call."""

    calls = 0

    def __call__(self, measurement: fsid.Measurement) -> Halfspaces:
        self.calls += 1
        rows = AVOIDANCE(measurement)
        return Halfspaces(rows.A, rows.b + 1e-4 * self.calls * (rows.A != 0).any(-1))


def left_out_faster(measurement: fsid.Measurement) -> Tensor:
    """The speeds of the bodies left out are forgotten."""
    assert measurement.left_out is not None
    standing = measurement.left_out._replace(speed=torch.zeros_like(measurement.left_out.speed))
    return AVOIDANCE.slack_left_out(replace(measurement, left_out=standing))


PLANTED: dict[str, tuple[Any, set[str]]] = {
    "angle too small by 2 %": (Planted(errors=scaled_errors(0.98, 1.0)), {"errors"}),
    "slack too small by 10 %": (Planted(errors=scaled_errors(1.0, 0.9)), {"errors", "soundness"}),
    "share of the neighbour added": (Planted(rows=wrong_share), {"derivative", "soundness"}),
    "the row is reversed": (Planted(rows=lambda m: Halfspaces(-AVOIDANCE(m).A, AVOIDANCE(m).b)), {"derivative"}),
    "slack left out too large": (Planted(slack_left_out=left_out_faster), {"left_out"}),
    "slack left out by 1 mm/s": (Planted(slack_left_out=lambda m: AVOIDANCE.slack_left_out(m) + 1e-3), {"left_out"}),
    "absent bodies have rows": (Planted(rows=not_padded), {"padding"}),
    "padding 0.u <= 0": (Planted(rows=other_padding), {"padding"}),
    "rows depend on the batch": (Planted(rows=by_the_batch), {"batch"}),
    "rows change": (Planted(rows=Moody()), {"batch", "padding"}),
    "a name is missing": (Planted(labels=lambda bodies: AVOIDANCE.labels(bodies[1:])), {"labels"}),
    "one name for all": (Planted(labels=lambda bodies: ["avoid"] * len(bodies)), {"labels"}),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", PLANTED)
def test_planted_mistakes_are_found(name: str) -> None:
    barrier, expected = PLANTED[name]
    with pytest.raises(BarrierError) as failure:
        check_barrier(barrier, h=lambda m: distances(m) ** 2 - 0.3**2, alpha=AVOIDANCE.class_k)
    failed = set(re.findall(r"^check_(\w+):", str(failure.value), re.MULTILINE))
    assert expected <= failed


def test_robots_in_space() -> None:
    check_barrier(AVOIDANCE, random_situations(n=3), h=lambda m: distances(m) ** 2 - 0.3**2, alpha=AVOIDANCE.class_k)


def test_robots_of_second_order() -> None:
    """(d/dt + k1)(d/dt + k2) h >= 0 for bodies of constant velocity: the barrier function is dh/dt + k1 h."""
    k1, k2 = 1.5, 2.0
    of_all = random_situations()
    assert of_all.body_accelerations is not None
    steady = replace(of_all, body_accelerations=torch.zeros_like(of_all.body_accelerations))

    def parts(m: fsid.Measurement) -> tuple[Tensor, Tensor, Tensor]:
        assert m.velocity is not None
        assert m.body_velocities is not None
        dx, dv = m.x.unsqueeze(-2) - m.bodies, m.velocity.unsqueeze(-2) - m.body_velocities
        return dx, dv, dx.square().sum(-1) - 0.25

    def below(m: fsid.Measurement) -> Tensor:
        dx, dv, h = parts(m)
        return 2 * dv.square().sum(-1) + (k1 + k2) * 2 * (dx * dv).sum(-1) + k1 * k2 * h

    def first(m: fsid.Measurement) -> Tensor:
        dx, dv, h = parts(m)
        return 2 * (dx * dv).sum(-1) + k1 * h

    barrier = fsid.AffineBarrier(lambda m: -2 * parts(m)[0], below, tuple("abcd"))
    check_derivative(barrier, steady, h=first, alpha=lambda value: k2 * value, motion=second_order)
    with pytest.raises(BarrierError, match="not dh/dt"):
        check_derivative(barrier, steady, h=first, alpha=lambda value: k1 * value, motion=second_order)


@pytest.mark.usefixtures("unchecked")
def test_rows_that_depend_on_the_control() -> None:
    check_barrier(DISC)
    with pytest.raises(BarrierError, match=r"check_errors: .*rad off(?s:.)*check_soundness: .*the truth is outside"):
        check_barrier(Planted(DISC, errors=scaled_errors(0.98, 1.0, DISC)))


@pytest.mark.usefixtures("unchecked")
def test_robots_that_take_the_least_violation() -> None:
    """Their rows are soft: else a violation is an alarm."""
    crowd = random_situations(bodies=7)
    check_barrier(ORCA, crowd)
    with pytest.raises(BarrierError, match="a false alarm"):
        check_soundness(Planted(ORCA, soft=False), crowd)


def test_compiled_code_is_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    check_compiled(AVOIDANCE, random_situations())
    read = compiled_evidence.read
    wider = lambda model, sample: read(model, replace(sample, bound=sample.bound + 0.1))  # noqa: E731
    monkeypatch.setattr(compiled_evidence, "read", wider)
    with pytest.raises(BarrierError, match="distances to the set differ in compiled code"):
        check_compiled(AVOIDANCE, random_situations())


def test_a_kit_that_could_try_nothing_says_so() -> None:
    lonely = random_situations()
    lonely = replace(lonely, present=torch.zeros_like(lonely.present))
    with pytest.raises(BarrierError, match=r"check_errors: no row exists(?s:.)*check_soundness: no row is active"):
        check_barrier(AVOIDANCE, lonely)
