"""Contacts: where a body did not move as logged, the velocity it arrives with is uncertain, and nothing else is."""

import numpy as np

from torchfsid.logs.contacts import arrival_errors
from torchfsid.logs.log import Log


def log_of(x: np.ndarray, u: np.ndarray) -> Log:
    seen = np.ones(x.shape[:2], dtype=bool)
    return Log("test", ("a", "b"), 0.1 * np.arange(len(x)), x, u, seen, seen, radius=np.array([0.3, 0.3]))


def test_a_push_is_found_and_bounds_the_velocity_on_arrival() -> None:
    u = np.tile([[0.6, 0.0], [0.0, 0.5]], (5, 1, 1))
    x = np.cumsum(np.concatenate([np.zeros((1, 2, 2)), 0.1 * u[:-1]]), axis=0)
    x[:, 1] += 2.0
    log = log_of(x, u)
    assert not arrival_errors(log, 0.0, 1e-5).any()
    pushed = x.copy()
    pushed[3:, 0, 1] += 0.002  # between the samples 2 and 3, body a is moved aside by 2 mm
    log = log_of(pushed, u)
    found = arrival_errors(log, 0.0, 1e-5)
    assert np.argwhere(found > 0).tolist() == [[2, 0]]
    assert found[2, 0] == 2 * 0.6
    assert not arrival_errors(log, 0.001, 1e-5).any()  # explained by errors of positions
    samples = list(log.measurements(["a", "b"], {"previous"}, (), found))
    errors = [sample.body_velocity_error for sample in samples]
    assert [float(error[1, 0]) for error in errors if error is not None] == [0.0, 0.0, 0.0, 1.2, 0.0]
    assert [float(sample.arrival_error[0]) for sample in samples if sample.arrival_error is not None][3] == 1.2
    assert all(sample.velocity_error is None for sample in samples)  # the control itself is right
