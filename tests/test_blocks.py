"""Samples in blocks: the same sets, statuses, events and counts as one by one, whatever is wrong with the data."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from tests.filters import TEAM_BARRIERS, TEAM_GOALS, TEAM_STARTS, TEAM_TASK
from torchfsid.errors import InconsistentError, InputError
from torchfsid.observers.blocks import depends_on_theta
from torchfsid.observers.fleet import FleetObserver
from torchfsid.observers.hybrid import HybridObserver
from torchfsid.observers.set_membership import SetEstimate, SetMembershipObserver
from torchfsid.observers.ukf import ParameterUkf
from torchfsid.outcome import Status
from torchfsid.robots.avoidance import ClassK, CollisionAvoidance
from torchfsid.robots.bounds import NoiseBound
from torchfsid.robots.controller import CbfQpController
from torchfsid.robots.measurement import Measurement
from torchfsid.robots.simulation import simulate
from torchfsid.robots.tasks import GoalTask, Saturation, UnknownGainGoalTask
from torchfsid.sets.feasible_set import FeasibleSet

DT, SAMPLES, ERROR, RHO = 0.02, 60, 0.01, 5e-4
PREVIOUS = CollisionAvoidance(ClassK(1.5704), safety_distance=0.3515, neighbour_velocity="previous")
CLIPPED = GoalTask(0.8434, saturation=Saturation("norm", (1.2, 1.2)))


@cache
def team(
    seed: int, task: GoalTask = TEAM_TASK, barrier: Any = TEAM_BARRIERS[0], broken: bool = True
) -> list[Measurement]:
    """Four robots that cross each other's way, with errors. If broken: lost samples, wild controls, changed goals."""
    rng = np.random.default_rng(seed)
    run = simulate(CbfQpController(task, [barrier]), TEAM_GOALS, TEAM_STARTS, dt=DT, steps=SAMPLES)
    found = []
    for k in range(SAMPLES):
        u = run.u[k] + ERROR / 2 * torch.from_numpy(rng.uniform(-1, 1, (4, 2)))
        seen = torch.from_numpy(rng.uniform(size=4) > 0.1) if broken else None
        if broken and k in (21, 40):
            u[k % 4] += torch.from_numpy(rng.normal(0, 3, 2))
        if broken and k >= 50:
            u[1] -= TEAM_TASK.gain * 1.5
        sample = Measurement.of_team(k * DT, run.x[k], u, previous_u=run.u[max(k - 1, 0)], seen=seen)
        assert sample.observed is not None
        unseen, u = ~sample.observed.unsqueeze(-1), u.masked_fill(~sample.observed.unsqueeze(-1), 0.0)
        found.append(replace(sample, x=sample.x.masked_fill(unseen, torch.nan), u=u))
    return found


def made(p: int = 2, task: Any = TEAM_TASK, barrier: Any = TEAM_BARRIERS[0], **options: Any) -> SetMembershipObserver:
    box = torch.full((4, p), 4.0, dtype=torch.float64)
    noise = options.pop("noise", NoiseBound(ERROR))
    return SetMembershipObserver(task, [barrier], FeasibleSet.from_box(-box, box), noise=noise, **options)


def blocks(samples: Sequence[Measurement], size: int) -> list[Measurement]:
    return [Measurement.concatenate(samples[k : k + size]) for k in range(0, len(samples), size)]


def assert_same_sets(one: FeasibleSet, other: FeasibleSet) -> None:
    assert torch.equal(one.body.count, other.body.count)
    slots = int(one.body.count.max())
    for name in ("A", "b", "time", "source"):
        mine, theirs = (getattr(of.body, name)[:, :slots] for of in (one, other))  # behind them is padding
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12, equal_nan=True)
    torch.testing.assert_close(one.last_cut, other.last_cut, rtol=0, atol=0, equal_nan=True)


def assert_same(one: SetMembershipObserver, other: SetMembershipObserver) -> None:
    assert_same_sets(one.feasible_set, other.feasible_set)
    for name in ("status", "skipped", "infeasible", "unexplained"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name
    assert repr(one.events) == repr(other.events)  # times of the prior are NaN
    assert repr(one.set_aside()) == repr(other.set_aside())
    assert one.windows_used == other.windows_used


SETTINGS: dict[str, Callable[[], SetMembershipObserver]] = {
    "hold": made,
    "in torch": lambda: made(compiled=False),
    "reset": lambda: made(on_inconsistent="reset"),
    "outliers": lambda: made(outliers=2),
    "critical region": lambda: made(kind="critical_region", active_tolerance=ERROR),
    "previous velocities": lambda: made(barrier=PREVIOUS),
    "clipped": lambda: made(task=CLIPPED),
    "unknown gain": lambda: made(3, task=UnknownGainGoalTask()),
    "position errors": lambda: made(noise=NoiseBound(ERROR, position=RHO)),
}


@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize("size", [7, SAMPLES])
def test_blocks_are_samples(setting: str, size: int) -> None:
    samples, one_by_one, in_blocks = team(3), SETTINGS[setting](), SETTINGS[setting]()
    samples = samples[:24] if setting == "unknown gain" else samples  # three parameters take long
    singles = [one_by_one.update(sample) for sample in samples]
    together: list[SetEstimate] = []
    for block in blocks(samples, size):
        together += [estimates[s] for estimates in in_blocks.read(block) for s in range(len(estimates))]
    assert_same(in_blocks, one_by_one)
    assert len(together) == len(singles)
    for found, expected in zip(together, singles, strict=True):
        assert found.t == expected.t
        assert torch.equal(found.informative, expected.informative)
        assert torch.equal(found.status, expected.status)
        assert torch.equal(found.kkt.active, expected.kkt.active)
        assert_same_sets(found.feasible_set, expected.feasible_set)
    assert int(one_by_one.skipped.sum()) > 0
    if setting in ("hold", "reset", "outliers"):  # the faults are noticed
        assert one_by_one.events
        assert one_by_one.feasible_set.last_cut.isfinite().any()


@pytest.mark.parametrize("size", [7, SAMPLES])
def test_an_empty_set_raises_at_its_sample(size: int) -> None:
    samples, one_by_one, in_blocks = team(3), made(on_inconsistent="raise"), made(on_inconsistent="raise")
    count = 0
    with pytest.raises(InconsistentError) as expected:  # noqa: PT012
        for sample in samples:
            one_by_one.update(sample)
            count += 1
    read = 0
    with pytest.raises(InconsistentError) as found:  # noqa: PT012
        for block in blocks(samples, size):
            for estimates in in_blocks.read(block):
                read += len(estimates)
    assert (found.value.t, found.value.robot, found.value.rows) == (
        expected.value.t,
        expected.value.robot,
        expected.value.rows,
    )
    assert read == count > 0
    assert_same(in_blocks, one_by_one)
    assert one_by_one.status.max() == Status.INCONSISTENT


def positions(seed: int) -> list[Measurement]:
    """Positions with errors, the means of the velocities between them, and gaps."""
    rng = np.random.default_rng(seed)
    run = simulate(CbfQpController(TEAM_TASK, TEAM_BARRIERS), TEAM_GOALS, TEAM_STARTS, dt=DT, steps=SAMPLES)
    x = run.x + RHO * torch.from_numpy(rng.uniform(-0.7, 0.7, run.x.shape))
    error = torch.full((4,), 2 * RHO / DT, dtype=torch.float64)
    gone = rng.uniform(size=(SAMPLES, 4)) < 0.04
    return [
        Measurement.of_team(k * DT, x[k], (x[k + 1] - x[k]) / DT, velocity_error=error, seen=torch.from_numpy(~gone[k]))
        for k in range(SAMPLES)
    ]


@pytest.mark.parametrize("task", [TEAM_TASK, CLIPPED])
def test_windows_in_blocks(task: GoalTask) -> None:
    def watching() -> SetMembershipObserver:
        return made(task=task, noise=NoiseBound(1e-6, position=RHO), windows=(0.1, 0.3, 0.7))

    samples, one_by_one = positions(5), watching()
    for sample in samples:
        one_by_one.update(sample)
    assert all(share > 0.3 for share in one_by_one.windows_used.values())
    for size in (9, SAMPLES):
        in_blocks = watching()
        for block in blocks(samples, size):
            assert sum(len(estimates) for estimates in in_blocks.read(block)) * 4 == len(block.x)
        assert_same(in_blocks, one_by_one)


def test_what_depends_on_the_sets() -> None:
    exact, uncertain = NoiseBound(ERROR), NoiseBound(ERROR, position=RHO)
    sample = team(3)[5].observed_only()
    assert not depends_on_theta(made(noise=uncertain).model, sample, 4)
    assert not depends_on_theta(made(3, UnknownGainGoalTask(), noise=exact).model, sample, 4)
    assert depends_on_theta(made(3, UnknownGainGoalTask(), noise=uncertain).model, sample, 4)
    assert depends_on_theta(made(task=CLIPPED).model, sample, 4)
    assert depends_on_theta(made(task=GoalTask(1.0, gain_error=0.1)).model, sample, 4)


def test_the_hybrid_in_blocks() -> None:
    def watching() -> HybridObserver:
        box = torch.full((4, 2), 4.0, dtype=torch.float64)
        return HybridObserver(
            made(), ParameterUkf.from_prior(TEAM_TASK, TEAM_BARRIERS, -box, box, active_tolerance=0.02)
        )

    samples, one_by_one, in_blocks = team(3), watching(), watching()
    singles = [one_by_one.update(sample) for sample in samples]
    together = [estimates for block in blocks(samples, 13) for estimates in in_blocks.read(block)]
    for name in ("theta", "status"):
        found = torch.cat([getattr(estimates, name) for estimates in together])
        expected = torch.stack([getattr(estimate, name) for estimate in singles])
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    fed = HybridObserver(made(), watching().ukf, feedback=True)
    assert sum(len(estimates) for block in blocks(samples, 13) for estimates in fed.read(block)) == SAMPLES


def test_a_measurement_of_a_team_at_several_times() -> None:
    rng = np.random.default_rng(0)
    x, u = (torch.from_numpy(rng.normal(size=(5, 6, 2))) for _ in range(2))
    errors, radius = torch.from_numpy(rng.uniform(size=(5, 6))), torch.from_numpy(rng.uniform(size=6))
    seen, t = torch.from_numpy(rng.uniform(size=(5, 6)) > 0.3), torch.arange(5).double()
    fields = {"robots": [4, 1], "radius": radius}
    block = Measurement.of_team(
        t, x, u, previous_u=u - 1, seen=seen, position_error=errors, neighbour_error=2 * errors, **fields
    )
    parts = [
        Measurement.of_team(
            k,
            x[k],
            u[k],
            previous_u=u[k] - 1,
            seen=seen[k],
            position_error=errors[k],
            neighbour_error=2 * errors[k],
            **fields,
        )
        for k in range(5)
    ]
    expected = Measurement.concatenate([replace(part, t=float(k)) for k, part in enumerate(parts)])
    for name, values in vars(expected).items():
        assert (values is None) == (getattr(block, name) is None), name
        if values is not None:
            torch.testing.assert_close(getattr(block, name), values, rtol=0, atol=0)


def test_wrong_blocks_are_refused() -> None:
    sample = team(3)[0]
    with pytest.raises(InputError, match="4 robots, concatenated"):
        list(made().read(sample.select(torch.tensor([0, 1, 2]))))
    several = Measurement.concatenate([sample, replace(sample, t=1.0)])
    with pytest.raises(InputError, match="one time for all robots"):
        list(made().read(several.select(torch.tensor([0, 5, 1, 4, 2, 6, 3, 7]))))
    with pytest.raises(InputError, match="4 robots"):
        made().update(several)


def test_a_bound_for_each_robot() -> None:
    """In blocks, and in the parts of a fleet, each robot has its own."""
    bounds = torch.tensor([0.01, 0.2, 0.05, 0.01], dtype=torch.float64)
    samples = team(3, broken=False)[:24]
    for noise in (NoiseBound(bounds), NoiseBound(ERROR, bounds), NoiseBound(bounds, position=RHO)):
        one_by_one, in_blocks, alone = made(noise=noise), made(noise=noise), made(noise=noise)
        fleets = [FleetObserver(alone, threads=threads) for threads in (2, 4)]
        for sample in samples:
            one_by_one.update(sample)
            for fleet in fleets:
                fleet.update(sample)
        assert sum(len(found) for block in blocks(samples, 10) for found in in_blocks.read(block)) == 24
        assert_same(in_blocks, one_by_one)
        for fleet in fleets:
            assert_same_sets(fleet.feasible_set, one_by_one.feasible_set)
    with pytest.raises(InputError, match="a bound for each of 4 robots"):
        made(noise=NoiseBound(bounds[:3])).update(samples[0])
    with pytest.raises(InputError, match="a bound for each of 4 robots"):
        FleetObserver(made(noise=NoiseBound(bounds[:3])), 2)
    FleetObserver(made(noise=NoiseBound(bounds[:1])), 2).update(samples[0])


@pytest.mark.usefixtures("unchecked")
def test_a_gain_for_each_robot() -> None:
    gains = torch.tensor([[1.2], [1.5704], [2.0], [3.0]], dtype=torch.float64)
    own = CollisionAvoidance(ClassK(gains), safety_distance=0.3515)
    samples, one_by_one, in_blocks = team(3, broken=False)[:20], made(barrier=own), made(barrier=own)
    for sample in samples:
        one_by_one.update(sample)
    for block in blocks(samples, 7):
        list(in_blocks.read(block))
    assert_same(in_blocks, one_by_one)
    for robot, gain in enumerate(gains.flatten().tolist()):
        alone = replace(own, class_k=ClassK(gain))
        torch.testing.assert_close(own(samples[5]).b[robot], alone(samples[5]).b[robot], rtol=0, atol=0)
    for threads in (2, 4):
        with pytest.raises(InputError, match=f"class_k.gain: .* each of {4 // threads} robots"):
            FleetObserver(made(barrier=own), threads).update(samples[0])
    task = GoalTask(gains.flatten())
    C, d = task(Measurement.concatenate(samples[:3]))
    for robot, gain in enumerate(gains.flatten().tolist()):
        torch.testing.assert_close(C[8 + robot], GoalTask(gain)(samples[2])[0][robot], rtol=0, atol=0)
        torch.testing.assert_close(d[8 + robot], GoalTask(gain)(samples[2])[1][robot], rtol=0, atol=0)
    with pytest.raises(InputError, match=r"task.gain: .* each of 4 robots"):
        GoalTask(gains.flatten()[:3])(samples[0])
    with pytest.raises(InputError, match=r"class_k.gain: .* each of 4 robots"):
        made(barrier=replace(own, class_k=ClassK(gains[:2]))).update(samples[0])
