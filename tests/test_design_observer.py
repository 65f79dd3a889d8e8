"""Adaptive observers: their gains against least squares, the projection, gradients through it, and a whole run."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from experiments.__main__ import main
from experiments.design.adaptive import AdaptiveObserver, ConstantGain, NetworkGain, RlsGain, Step
from experiments.design.config import LearnedObserverConfig
from experiments.design.learning import learn
from experiments.design.rollouts import Rollouts, roll_out
from experiments.kinds import load as load_config
from torchfsid.halfspaces import Halfspaces

CONFIG = Path(__file__).parents[1] / "configs" / "learned_observer.yaml"
SMALL = (
    "teams={train: 1, validation: 1, test: 2}",
    "duration=0.2",
    "times=[0.1]",
    "gains=[0.3, 1.0]",
    "pulls=[0.05]",
    "noise=[0.01]",
    "unseen_noise=[0.02]",
    "training.epochs=2",
)

pytestmark = pytest.mark.usefixtures("unchecked")


def load(*overrides: str) -> LearnedObserverConfig:
    config = load_config(CONFIG, overrides)
    assert isinstance(config, LearnedObserverConfig)
    return config


@pytest.fixture(scope="module")
def recording() -> Rollouts:
    return roll_out(load("duration=0.5", "times=[0.1]"), 0.02, 2, np.random.SeedSequence(3), filters=False)


def inside(theta: Tensor, recording: Rollouts) -> Tensor:
    return torch.stack([step.theta_set.contains(at, 1e-9) for step, at in zip(recording.steps, theta, strict=True)])


def inputs(recording: Rollouts) -> tuple[Any, ...]:
    return recording.steps, recording.theta, recording.information


def test_rls_gain_is_regularised_least_squares():
    """Without a projection the estimate is the minimiser of |theta - theta_0|^2_Lambda + sum |u - G theta - f|^2/R."""
    random = np.random.default_rng(1)
    B, T, noise = 3, 6, 0.3
    G, f, u = (torch.from_numpy(random.normal(size=(T, B, *shape))) for shape in ((2, 2), (2,), (2,)))
    everywhere = Halfspaces(torch.zeros(B, 1, 2, dtype=torch.float64), torch.ones(B, 1, dtype=torch.float64))
    nothing = torch.zeros(B, dtype=torch.float64)
    steps = [Step(everywhere, nothing, nothing, nothing.long(), G[k], f[k], u[k], noise) for k in range(T)]
    theta, information = torch.from_numpy(random.normal(size=(B, 2))), torch.eye(2, dtype=torch.float64).expand(B, 2, 2)
    final = AdaptiveObserver(RlsGain(), projects=False)(steps, theta, information)[-1]
    for i in range(B):
        rows = np.concatenate([np.eye(2), *(G[k, i].numpy() * 2 / noise for k in range(T))])
        right = np.concatenate([theta[i].numpy(), *((u - f)[k, i].numpy() * 2 / noise for k in range(T))])
        np.testing.assert_allclose(final[i].numpy(), np.linalg.lstsq(rows, right)[0], rtol=1e-9)


def test_a_whole_constant_gain_inverts_a_free_motion():
    """Gamma = I/kp^2 with G = kp I: one sample is enough."""
    kp, goal = 1.7, torch.tensor([[0.4, -0.8]], dtype=torch.float64)
    G, f = kp * torch.eye(2, dtype=torch.float64).unsqueeze(0), torch.tensor([[0.1, 0.2]], dtype=torch.float64)
    everywhere = Halfspaces(torch.zeros(1, 1, 2, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64))
    step = Step(everywhere, goal[:, 0], goal, torch.zeros(1).long(), G, f, kp * goal + f, 0.01)
    estimate = AdaptiveObserver(ConstantGain(1.0, kp))([step], torch.zeros_like(goal), G)
    torch.testing.assert_close(estimate[0], goal)


def test_estimates_stay_in_the_set_and_truth_too(recording: Rollouts):
    network = NetworkGain(4, 36.0, 0.02, pulls=True)
    for gain in (ConstantGain(0.5, 1.0), RlsGain(), RlsGain(0.2), network):
        assert inside(AdaptiveObserver(gain)(*inputs(recording)), recording).all()
    assert not inside(AdaptiveObserver(RlsGain(), projects=False)(*inputs(recording)), recording).all()
    assert recording.contains == 1.0


def test_an_untrained_network_is_nearly_least_squares(recording: Rollouts):
    network = AdaptiveObserver(NetworkGain(4, 36.0, 0.02, pulls=False))(*inputs(recording))
    rls = AdaptiveObserver(RlsGain())(*inputs(recording))
    assert (network - rls).norm(dim=-1).max() < 1e-2


def test_gradients_through_the_projection(recording: Rollouts):
    """Of the mean error over the whole recording with respect to every parameter, against central differences."""
    torch.manual_seed(0)
    network = NetworkGain(2, 36.0, 0.02, pulls=True)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    observer = AdaptiveObserver(network)

    def error() -> Tensor:
        return (observer(*inputs(recording)) - recording.goals).norm(dim=-1).mean()

    error().backward()
    step = 1e-6
    for parameter in network.parameters():
        assert parameter.grad is not None
        flat, gradient = parameter.data.view(-1), parameter.grad.view(-1)
        for i in range(0, len(flat), 5):
            value = float(flat[i])
            with torch.no_grad():
                flat[i] = value + step
                ahead = float(error())
                flat[i] = value - step
                behind = float(error())
                flat[i] = value
            assert float(gradient[i]) == pytest.approx((ahead - behind) / (2 * step), rel=1e-4, abs=1e-7)


def test_a_run_can_be_repeated_and_is_drawn(tmp_path: Path):
    first, second = tmp_path / "first", tmp_path / "second"
    assert main(["design", str(CONFIG), "--out", str(first), *[word for o in SMALL for word in ("--set", o)]]) == 0
    config = load_config(first / "config.yaml")
    assert isinstance(config, LearnedObserverConfig)

    def silent(items: Iterable[Any], *_: Any) -> Iterable[Any]:
        return items

    second.mkdir()
    summary = learn(config, second, silent)
    assert summary == json.loads((first / "summary.json").read_text())
    for name in ("runs.csv", "curves.csv", "training.csv", "answers.csv", "gains.json"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
    assert (first / "figure.png").stat().st_size > 1000
    table = json.loads((first / "summary.json").read_text())["mean errors by noise [m]"]["0.02"]
    assert set(table) >= {"centroid", "ukf", "hybrid", "constant", "RLS", "network", "network with pull"}


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("team.robots=[3, 4]", "team.robots, team.obstacles"),
        ("times=[9]", "times"),
        ("pulls=[1.5]", "pulls[0]"),
        ("noise=[0]", "noise[0]"),
        ("training.epoch=3", "training.epoch"),
    ],
)
def test_wrong_config_is_one_line_and_exit_code_2(
    override: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["design", str(CONFIG), "--out", str(tmp_path / "out"), "--set", override]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert f": {named}: " in message
