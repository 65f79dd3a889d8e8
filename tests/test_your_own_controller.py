"""docs/your_own_controller.md: its code runs, and leaving members out costs what its table says, but no truth."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

import torchfsid as fsid
from torchfsid.errors import BarrierError
from torchfsid.testing import check_barrier

PAGE = Path(__file__).parents[1] / "docs" / "your_own_controller.md"


@pytest.fixture(scope="module")
def page() -> dict[str, Any]:
    """What the page's code defines."""
    names: dict[str, Any] = {"__name__": "page"}
    for block in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL):
        exec(compile(block, str(PAGE), "exec", dont_inherit=True), names)
    return names


class Without:
    """A barrier without some of its members."""

    def __init__(self, barrier: Any, *missing: str, **members: Any):
        self.barrier, self.missing, self.members = barrier, missing, members

    def __call__(self, measurement: fsid.Measurement) -> fsid.Halfspaces:
        return self.barrier(measurement)

    def __getattr__(self, name: str) -> Any:
        if name in self.__dict__["missing"]:
            raise AttributeError(name)
        return self.members[name] if name in self.members else getattr(self.barrier, name)


def observed(page: dict[str, Any], barrier: Any, error: float) -> fsid.SetMembershipObserver:
    """The page's team, seen with errors of positions up to `error`."""
    run, draw = page["run"], torch.Generator().manual_seed(1)
    noise = fsid.NoiseBound(velocity=1e-6, position=error)
    watching = fsid.SetMembershipObserver(page["task"], [barrier], page["prior"], noise=noise)
    for t, x, u in zip(run.t, run.x, run.u, strict=True):
        x_error = error * 0.7 * (2 * torch.rand(3, 2, generator=draw, dtype=torch.float64) - 1)
        estimate = watching.update(fsid.Measurement.of_team(float(t), x + x_error, u))
        assert estimate.feasible_set.contains(page["goals"]).all()
    assert (estimate.status == 0).all()
    return watching


@pytest.mark.usefixtures("unchecked")
def test_the_page_runs_in_forty_lines(page: dict[str, Any]) -> None:
    """Its own assertions hold, and the robots were held by their rows for a good part of the time."""
    code = re.search(r"^@dataclass.*?(?=^```)", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert code is not None
    assert len(code.group().splitlines()) <= 40
    assert page["run"].active.any(-1).double().mean() > 0.3
    assert page["estimate"].feasible_set.diameter().max() < 0.05


@pytest.mark.usefixtures("unchecked")
def test_what_is_missing_costs_samples_and_no_truth(page: dict[str, Any]) -> None:
    barrier = page["barrier"]
    every = 3 * len(page["run"].t)
    assert observed(page, barrier, 0.01).skipped.sum() == 0
    assert observed(page, Without(barrier, "errors", "rows_within"), 0.0).skipped.sum() == 0
    assert observed(page, Without(barrier, "errors", "rows_within"), 0.01).skipped.sum() == every
    assert 0 < observed(page, Without(barrier, "rows_within"), 0.01).skipped.sum() < every / 2


@pytest.mark.usefixtures("unchecked")
def test_bodies_left_out_and_teams_at_rest(page: dict[str, Any]) -> None:
    barrier, x = page["barrier"], torch.tensor([[0.0, 0.0], [2.0, 0.0], [0.0, 4.0]]).double()

    def used(barrier: Any, u: torch.Tensor, count: int) -> bool:
        watching = fsid.SetMembershipObserver(page["task"], [barrier], page["prior"], noise=fsid.NoiseBound(1e-3))
        return bool(watching.update(fsid.nearest_bodies(0.0, x, u, count=count)).informative.all())

    at_rest, moving = torch.zeros_like(x), torch.full_like(x, 0.1)
    assert used(barrier, moving, 1)
    assert not used(Without(barrier, "slack_left_out"), moving, 1)
    assert used(Without(barrier, "slack_left_out"), moving, 2)
    assert used(barrier, at_rest, 2)
    assert not used(Without(barrier, "neighbour_velocity"), at_rest, 2)
    assert used(Without(barrier, "neighbour_velocity"), moving, 2)


@pytest.mark.usefixtures("unchecked")
def test_the_kit_finds_a_switch_that_was_forgotten(page: dict[str, Any]) -> None:
    """What is left out is not checked; rows whose appearing is not announced lose the truth."""
    barrier = page["barrier"]
    check_barrier(Without(barrier, "rows_within", "slack_left_out", "neighbour_velocity"))

    def of_measured_rows(seen: fsid.Measurement, bounds: Any) -> Any:
        exists = (barrier(seen).A != 0).any(-1)
        return type(barrier.errors(seen, bounds))(*(e.where(exists, 0.0) for e in barrier.errors(seen, bounds)))

    with pytest.raises(BarrierError, match=r"check_errors(?s:.)*check_soundness.*the truth is outside its set"):
        check_barrier(Without(barrier, "rows_within", errors=of_measured_rows))
