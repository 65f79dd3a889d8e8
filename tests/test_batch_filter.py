"""The filter in compiled code: filterpy's numbers, whatever is wrong with the data."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.filters import TEAM_BARRIERS, TEAM_TASK, box, lost, team_run
from tests.test_blocks import CLIPPED, blocks
from torchfsid.errors import InputError
from torchfsid.kernels.kalman import factor
from torchfsid.observers.ukf import ParameterUkf
from torchfsid.outcome import Status
from torchfsid.robots.measurement import Measurement


def measured(seed: int, wild: float = 0.0) -> list[Measurement]:
    """A team with errors and lost robots. Wild controls violate rows, so that motions are unknown, or are not true."""
    rng, found = np.random.default_rng(seed), []
    for k, sample in enumerate(team_run().measurements()):
        assert sample.u is not None
        u = sample.u + torch.from_numpy(rng.uniform(-3e-4, 3e-4, (4, 2)))
        u[k % 4] += wild * (k % 9 == 5)
        sample = replace(sample, x=sample.x + torch.from_numpy(rng.normal(0, 1e-3, (4, 2))), u=u)
        found.append(lost(sample, rng.choice(4, 2, replace=False).tolist()) if k % 7 == 3 else sample)
    return found


def compare(filterpy: ParameterUkf, samples: list[Measurement], size: int, tolerance: float = 1e-10) -> torch.Tensor:
    """Compare the engines. Returns the statuses of all samples."""
    batch = replace(filterpy, engine="batch")
    expected = [filterpy.update(sample) for sample in samples]
    found = [batch.read(block) for block in blocks(samples, size)]
    for name in ("theta", "covariance", "status"):
        together = torch.cat([getattr(estimates, name) for estimates in found])
        one_by_one = torch.stack([getattr(estimate, name) for estimate in expected])
        torch.testing.assert_close(together, one_by_one, rtol=tolerance, atol=tolerance)
    assert [kalman is None for kalman in batch.filters] == [kalman is None for kalman in filterpy.filters]
    return torch.stack([estimate.status for estimate in expected])


@pytest.mark.parametrize("size", [1, 8, 51])
@pytest.mark.parametrize("settings", [{}, {"process_noise": 0.0, "motion_noise": 0.0}, {"active_tolerance": 0.05}])
def test_numbers_are_those_of_filterpy(settings: dict[str, Any], size: int) -> None:
    """Up to round-off of filterpy: against extended precision it is off by 6e-10 here, the compiled filter by 5e-13."""
    statuses = compare(ParameterUkf.from_prior(TEAM_TASK, TEAM_BARRIERS, *box(4), **settings), measured(1), size, 1e-9)
    assert (statuses == Status.OK).float().mean() > 0.5
    assert (statuses[1:] == Status.PREDICTED).any()


def test_numbers_on_exact_data() -> None:
    samples = list(team_run().measurements())
    compare(ParameterUkf.from_prior(TEAM_TASK, TEAM_BARRIERS, *box(4, 2.0)), samples, 20, 1e-10)


def test_wild_controls() -> None:
    """Means are then off by hundreds of standard deviations, and so is round-off."""
    compare(ParameterUkf.from_prior(TEAM_TASK, TEAM_BARRIERS, *box(4)), measured(1, wild=2.0), 51, 1e-8)


@pytest.mark.parametrize(
    ("broken", "status"), [(np.ones((4, 4)), Status.REPAIRED), (np.full((4, 4), np.nan), Status.FAILED)]
)
def test_filterpy_takes_over_where_the_compiled_filter_stops(broken: np.ndarray, status: Status) -> None:
    samples, filterpy = measured(2), ParameterUkf.from_prior(TEAM_TASK, TEAM_BARRIERS, *box(4))
    batch = replace(filterpy, engine="batch")
    batch.read(Measurement.concatenate(samples[:12]))
    for sample in samples[:12]:
        filterpy.update(sample)
    for kalman in (batch.filters[1], filterpy.filters[1]):
        assert kalman is not None
        kalman.P = broken
    found = batch.read(Measurement.concatenate(samples[12:]))
    expected = [filterpy.update(sample) for sample in samples[12:]]
    assert found.status[0, 1] == status
    assert torch.equal(found.status, torch.stack([estimate.status for estimate in expected]))
    torch.testing.assert_close(found.theta, torch.stack([estimate.theta for estimate in expected]), rtol=0, atol=1e-8)


def test_engines_go_on_from_each_other() -> None:
    samples, whole = measured(2), ParameterUkf.from_prior(TEAM_TASK, TEAM_BARRIERS, *box(4))
    mixed = replace(whole)
    for k, block in enumerate(blocks(samples, 5)):
        mixed.engine = "batch" if k % 2 else "filterpy"
        found = mixed.read(block)
    for sample in samples:
        expected = whole.update(sample)
    torch.testing.assert_close(found.theta[-1], expected.theta, rtol=0, atol=1e-9)


def test_a_model_that_is_not_linear_is_refused() -> None:
    for settings in ({"task": CLIPPED}, {"task": TEAM_TASK, "qp_inside": True}):
        with pytest.raises(InputError, match="not linear"):
            ParameterUkf.from_prior(
                barriers=TEAM_BARRIERS, lower=box(1)[0], upper=box(1)[1], engine="batch", **settings
            )


def test_factor() -> None:
    rng = np.random.default_rng(0)
    for n in (1, 2, 4):
        M, L = rng.normal(size=(n, n)), np.zeros((n, n))
        assert factor(M @ M.T, n, L)
        np.testing.assert_allclose(L, np.linalg.cholesky(M @ M.T), atol=1e-12)
        assert not factor(-M @ M.T, n, L)
        assert not factor(np.full((n, n), np.nan), n, L)
