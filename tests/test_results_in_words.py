"""Statuses and estimates as text, and the layers with sets, pairs and fixed half-spaces."""

import pytest
import torch
from torch import Tensor, nn

import torchfsid as fsid
from torchfsid.outcome import Status

TASK, WALL = fsid.GoalTask(0.9), fsid.SpeedDisc(1.0)


def sets() -> fsid.FeasibleSet:
    """Three sets, the last of which is empty."""
    rows = torch.tensor([[[1.0, 0.3]]] * 3), torch.tensor([[0.5], [0.2], [-3.0]])
    return fsid.FeasibleSet.from_box(-torch.ones(3, 2), torch.ones(3, 2)).intersect(fsid.Halfspaces(*rows))


POINTS = torch.tensor([[2.0, 0.1], [0.0, 0.0], [1.0, 1.0]], dtype=torch.float64)


def test_a_status_is_a_number_and_a_word() -> None:
    assert f"{fsid.Status.ALARM}" == str(Status(1)) == "alarm"
    assert Status.ALARM < Status.INCONSISTENT
    assert Status.names(torch.tensor([[0, 2], [4, 12]])) == [["ok", "inconsistent"], ["empty", "euclidean"]]
    assert Status.names(torch.tensor(0)) == "ok"
    assert len({int(status) for status in Status}) == len(Status)


@pytest.mark.parametrize("backend", ["exact", "cvxpylayers"])
def test_layers_take_sets_and_pairs_like_rows(backend: str) -> None:
    rows = sets().halfspaces()
    layer, centre = fsid.ProjectOnto(backend=backend), fsid.ChebyshevCentre(backend)  # type: ignore[arg-type]
    for given in (sets(), (rows.A, rows.b)):
        for found, expected in ((layer(given, POINTS), layer(rows, POINTS)), (centre(given), centre(rows))):
            for one, other in zip(found, expected, strict=True):
                torch.testing.assert_close(one, other, equal_nan=True)
    assert layer(sets(), POINTS).status_names == ["ok", "ok", "empty"]
    assert centre(sets()).status_names[2] == "empty"
    torch.testing.assert_close(layer(sets(), POINTS).point[:2], sets().project(POINTS)[:2], atol=1e-6, rtol=0)


def test_fixed_halfspaces_are_part_of_a_network() -> None:
    torch.manual_seed(0)
    A, b = nn.Parameter(torch.randn(5, 2, dtype=torch.float64)), nn.Parameter(torch.ones(5, dtype=torch.float64))
    network = nn.Sequential(nn.Linear(3, 2), fsid.ProjectOnto(halfspaces=fsid.Halfspaces(A, b)))
    found = network(4 * torch.randn(20, 3))
    assert found.point.dtype == torch.float32
    assert fsid.Halfspaces(A, b).contains(found.point.double(), tolerance=1e-5).all()
    found.point.sum().backward()
    assert A.grad is not None
    assert b.grad is not None
    assert {"1.A", "1.b"} <= set(network.state_dict())
    fixed = fsid.ProjectOnto(halfspaces=sets()[0])
    assert not list(fixed.parameters())
    torch.testing.assert_close(fixed(POINTS), fsid.ProjectOnto()(sets()[0], POINTS))
    torch.testing.assert_close(fsid.ChebyshevCentre(halfspaces=sets()[:2])().radius, sets()[:2].chebyshev()[1])


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: fsid.ProjectOnto()(torch.eye(2), POINTS), "halfspaces: .* FeasibleSet or a pair"),
        (lambda: fsid.ProjectOnto()(POINTS), "halfspaces: .* no fixed ones"),
        (lambda: fsid.ProjectOnto()(sets(), [0.0, 0.0]), "point: .* a tensor"),
        (lambda: fsid.ProjectOnto()(sets(), torch.zeros(3, 2, dtype=torch.long)), "point: .* floats"),
        (lambda: fsid.ProjectOnto(halfspaces=3), "halfspaces: .* FeasibleSet"),
        (lambda: fsid.ChebyshevCentre()("rows"), "halfspaces: .* FeasibleSet"),
        (lambda: fsid.FeasibleSet.from_box(torch.zeros(2), torch.ones(2)).project("a"), "point: .* tensor"),
    ],
)
def test_layers_name_the_argument_that_does_not_fit(call, told: str) -> None:
    with pytest.raises(fsid.InputError, match=told):
        call()


def test_estimates_are_shown_in_a_line() -> None:
    start, goals = torch.tensor([[0.0, 0.0], [3.0, 0.0]]), torch.tensor([[2.0, 0.0], [0.0, 1.0]])
    avoid = fsid.CollisionAvoidance(fsid.ClassK(1.0), safety_distance=0.3)
    run = fsid.simulate(fsid.CbfQpController(TASK, [avoid]), goals, start, dt=0.1, steps=3)
    prior = fsid.FeasibleSet.from_box(torch.full((2, 2), -5.0), torch.full((2, 2), 5.0))
    noise = fsid.NoiseBound(1e-3)
    hybrid = fsid.HybridObserver(
        fsid.SetMembershipObserver(TASK, [avoid], prior, noise=noise),
        fsid.ParameterUkf(TASK, [avoid], torch.zeros(2, 2), 1.0),
    )
    estimates: list[fsid.HybridEstimate] = [hybrid.update(measurement) for measurement in run.measurements()]
    for shown in (repr(estimates[-1]), repr(estimates[-1].set_estimate)):
        assert "\n" not in shown
        assert len(shown) < 300
    assert estimates[-1].set_estimate.status_names == ["ok", "ok"]


def test_only_public_names_are_listed() -> None:
    listed = [name for name in dir(fsid) if name != "__version__"]
    assert sorted(fsid.__all__) == listed
    for name in listed:
        shown = getattr(fsid, name)
        assert not isinstance(shown, Tensor)
        assert shown.__doc__
