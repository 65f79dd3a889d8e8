"""What the host waits for, for a process with NUMBA_ENABLE_CUDASIM=1: code takes the ways that it takes on a device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import pytest
import torch

from benchmarks.scenario import BARRIER, TASK, Fleet, measured
from tests.on_simulator._both import both, same
from tests.round_trips import RoundTrips
from torchfsid.halfspaces import Halfspaces
from torchfsid.identification.evidence import ObservationModel, Sample, sample_of
from torchfsid.observers.set_membership import SetMembershipObserver
from torchfsid.robots.barriers import Arena, Barrier, SpeedBox
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.tasks import Saturation

ROBOTS = 30
WALLS = Arena((-9.0, -9.0), (9.0, 9.0), BARRIER.class_k)
EXACT, ERRORS = NoiseBound(5e-3), NoiseBound(5e-3, position=1e-3, neighbour_velocity=1e-3)


@pytest.fixture
def measurement() -> Measurement:
    *_, last = islice(Fleet(ROBOTS, noisy=True), 3)
    return measured(*last)


def counted(function: Callable) -> RoundTrips:
    with RoundTrips() as counting:
        function()
    return counting


@pytest.mark.parametrize("barriers", [[BARRIER], [BARRIER, SpeedBox((2.0, 2.0)), WALLS]])
@pytest.mark.parametrize("noise", [EXACT, ERRORS])
def test_the_model_at_a_measurement_waits_for_nothing(
    barriers: list[Barrier], noise: NoiseBound, measurement: Measurement
) -> None:
    prior = Fleet(ROBOTS).prior()
    model = ObservationModel(replace(TASK, saturation=Saturation("norm", (3.0, 3.0))), barriers, noise=noise)
    sample_of(model, prior, measurement)  # constants are copied to the device once
    found = counted(lambda: sample_of(model, prior, measurement))
    assert not found.waits
    if noise is EXACT:
        assert found.operations <= 61 + 10 * len(barriers)  # one of them keeps a copy of the controls


def test_an_update_waits_once(measurement: Measurement) -> None:
    """It is when the host learns whether anything is empty or alarming. Times are on the CPU."""
    observer = SetMembershipObserver(TASK, [BARRIER], Fleet(ROBOTS).prior(), noise=EXACT)
    observer.update(measurement)
    found = counted(lambda: observer.update(measurement))
    assert [times for (file, _, _), times in found.waits.items() if file == "device.py"] == [1]
    assert {file for file, _, _ in found.waits} <= {"device.py", "blocks.py", "set_membership.py"}
    assert found.operations <= 110


def test_a_controller_waits_once(measurement: Measurement) -> None:
    """It is when the host learns whether all programmes are solved."""
    controller, seen = CbfQpController(TASK, [BARRIER, WALLS]), replace(measurement, u=None)
    controller(seen, Fleet(ROBOTS).goals)
    found = counted(lambda: controller(seen, Fleet(ROBOTS).goals))
    assert [(file, times) for (file, _, _), times in found.waits.items()] == [("on_tensors.py", 1)]


@pytest.mark.parametrize("noise", [EXACT, ERRORS])
def test_ways_without_waiting_lead_to_the_same_model(noise: NoiseBound, measurement: Measurement) -> None:
    """Robots of which some stand still, all with slots for bodies that are not there."""
    u, absent = measurement.u, torch.arange(ROBOTS) % 3 == 0
    assert u is not None
    present = measurement.present & ~(absent.unsqueeze(-1) & (torch.arange(8) > 4))
    seen = replace(measurement, u=torch.where(absent.unsqueeze(-1), 0.0, u), present=present)
    model = ObservationModel(TASK, [BARRIER, WALLS], noise=noise)
    one, other = both(lambda: sample_of(model, Fleet(ROBOTS).prior(), seen))
    for mine, theirs in zip(numbers_of(one), numbers_of(other), strict=True):
        same(mine, theirs)


def numbers_of(sample: Sample) -> list[torch.Tensor]:
    errors = () if sample.row_errors is None else sample.row_errors
    rows: Halfspaces = sample.rows
    return [rows.A, rows.b, sample.u, sample.C, sample.d, sample.usable, sample.bound, sample.ball, *errors]
