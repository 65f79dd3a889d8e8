"""The rows that need no neighbour, against how others write them; and controllers that fail."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial import HalfspaceIntersection

from torchfsid import (
    CbfQpController,
    CollisionAvoidance,
    FeasibleSet,
    GoalTask,
    NoiseBound,
    SetMembershipObserver,
    simulate,
)
from torchfsid.config.avoidance import AvoidanceConfig, UnknownClassKConfig
from torchfsid.errors import ConfigError, InputError
from torchfsid.robots.affine_barrier import AffineBarrier
from torchfsid.robots.avoidance import ClassK
from torchfsid.robots.barriers import Arena, SpeedPolygon
from torchfsid.robots.measurement import Measurement

AT_REST = Measurement.of_team(0.0, torch.zeros(1, 2), torch.zeros(1, 2))


def test_the_speed_polygon_is_the_usual_inner_approximation_of_the_disc() -> None:
    """u_x, (u_x + u_y)/sqrt 2, u_y ... <= v cos(pi/8), as the Robotarium writes its eight rows."""
    rows = SpeedPolygon(8, 0.2)(AT_REST)
    apothem, half = 0.2 * math.cos(math.pi / 8), math.sqrt(0.5)
    normals = [[1, 0], [half, half], [0, 1], [-half, half], [-1, 0], [-half, -half], [0, -1], [half, -half]]
    torch.testing.assert_close(rows.A[0], torch.tensor(normals, dtype=torch.float64), rtol=0, atol=1e-15)
    torch.testing.assert_close(rows.b[0], torch.full((8,), apothem, dtype=torch.float64), rtol=0, atol=1e-15)


def test_corners_of_a_speed_polygon_lie_on_the_circle() -> None:
    for sides in (3, 4, 5, 8):
        rows = SpeedPolygon(sides, 0.7)(AT_REST)
        halfspaces = np.concatenate([rows.A[0].numpy(), -rows.b[0].numpy()[:, None]], axis=1)
        corners = np.unique(HalfspaceIntersection(halfspaces, np.zeros(2)).intersections.round(9), axis=0)
        assert len(corners) == sides
        np.testing.assert_allclose(np.linalg.norm(corners, axis=1), 0.7, atol=1e-8)


def test_walls_slow_a_robot_down() -> None:
    """alpha(distance to the wall beyond the margin), on each side."""
    x = torch.tensor([[1.2, -0.4]], dtype=torch.float64)
    rows = Arena((-1.6, -1.0), (1.6, 1.0), ClassK(40.0, 3), margin=0.075)(Measurement.of_team(0.0, x))
    expected = {(1, 0): 1.6 - 1.2, (0, 1): 1.0 + 0.4, (-1, 0): 1.2 + 1.6, (0, -1): -0.4 + 1.0}
    for normal, b in zip(rows.A[0].tolist(), rows.b[0].tolist(), strict=True):
        assert math.isclose(b, 40.0 * (expected[int(normal[0]), int(normal[1])] - 0.075) ** 3, rel_tol=1e-12)


def test_a_team_whose_joint_controller_failed_says_nothing() -> None:
    """Robots 0 and 1 are too close: there is no joint solution, so robot 2, far away, is stopped too."""
    goals = torch.tensor([[3.0, 0.0], [-3.0, 0.0], [0.0, 4.0]], dtype=torch.float64)
    x = torch.tensor([[0.0, 0.0], [0.1, 0.0], [4.0, 4.0]], dtype=torch.float64)
    prior = FeasibleSet.from_box(torch.full((3, 2), -5.0), torch.full((3, 2), 5.0))
    team = CollisionAvoidance(ClassK(1.0), safety_distance=0.5, neighbour_velocity="current")
    watching = SetMembershipObserver(GoalTask(1.0), [team], prior, noise=NoiseBound(0.01))
    watching.update(Measurement.of_team(0.0, x, torch.zeros_like(x)))
    assert watching.skipped.tolist() == [1, 1, 1]
    assert watching.feasible_set.contains(goals).all()

    # Alone, a robot that stands still has arrived: only a joint QP stops robots that have nothing to fear.
    alone = CollisionAvoidance(ClassK(1.0), safety_distance=0.5)
    watching = SetMembershipObserver(GoalTask(1.0), [alone], prior, noise=NoiseBound(0.01))
    watching.update(Measurement.of_team(0.0, x, torch.zeros_like(x)))
    assert watching.skipped.tolist() == [1, 1, 0]
    assert watching.feasible_set.contains(x)[2]
    assert watching.feasible_set.diameter()[2] < 0.03


def test_a_body_may_have_a_distance_of_its_own() -> None:
    x = torch.tensor([[0.0, 0.0], [2.0, 0.0], [0.0, 3.0]], dtype=torch.float64)
    config = AvoidanceConfig(safety_distance=0.5, safety_distances={"wide": 1.5}, class_k=UnknownClassKConfig(gain=2.0))
    rows = config.build(["ego", "narrow", "wide"])(Measurement.of_team(0.0, x))
    assert rows.b[0, 1:].tolist() == [2.0 * (4.0 - 0.25), 2.0 * (9.0 - 2.25)]
    assert rows.b[1, [0, 2]].tolist() == [2.0 * (4.0 - 0.25), 2.0 * (13.0 - 2.25)]
    with pytest.raises(ConfigError, match=r"safety_distances\.wide: no body is called 'wide'"):
        config.build(["ego", "narrow"])


def test_any_rows_of_ones_own() -> None:
    """A leash, |x - home| + u.n <= 1, written by hand, is one more barrier for robots and observers."""

    def outward(measurement: Measurement) -> torch.Tensor:
        return (measurement.x / measurement.x.norm(dim=-1, keepdim=True)).unsqueeze(-2)

    leash = AffineBarrier(outward, lambda measurement: 1.0 - measurement.x.norm(dim=-1, keepdim=True), ("leash",))
    goal = torch.tensor([[3.0, 0.4]], dtype=torch.float64)
    run = simulate(CbfQpController(GoalTask(1.0), [leash]), goal, torch.tensor([[0.1, 0.0]]), dt=0.05, steps=100)
    assert run.active[-1].all()
    prior = FeasibleSet.from_box(torch.full((1, 2), -5.0), torch.full((1, 2), 5.0))
    watching = SetMembershipObserver(GoalTask(1.0), [leash], prior, noise=NoiseBound(1e-6))
    for measurement in run.measurements():
        theta = watching.update(measurement).feasible_set
        assert theta.contains(goal).all()
    assert float(theta.diameter()) < 0.1
    with pytest.raises(InputError, match="row_errors"):
        SetMembershipObserver(GoalTask(1.0), [leash], prior, noise=NoiseBound(1e-6, position=0.1)).update(measurement)
    with pytest.raises(InputError, match=r"A \(\*batch, 2, 2\)"):
        AffineBarrier(torch.eye(1, 2), torch.zeros(1), ("one", "two"))(AT_REST)
