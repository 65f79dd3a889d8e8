"""What the tests on the simulator share: the same on the CPU and on the device that the simulator stands for.

The simulator runs the kernels' Python source, and the other side is the same source compiled for the CPU. So the
numbers are the same to the last bit, but for libm's functions of angles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

from torchfsid import device

SIZES = [1, 7, 65]
"""Batches of one item, of a part of a block of threads, and of one item more than a block."""


def both(function: Callable[[], Any]) -> tuple[Any, Any]:
    """What a function returns with the kernels for the CPU, and with those for a device."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(device, "SIMULATED", False)
        on_cpu = function()
    return on_cpu, function()


@pytest.fixture(autouse=True)
def launched(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """The names of the kernels that a test has launched: there must be some."""
    names: list[str] = []
    real = device.launch
    monkeypatch.setattr(device, "launch", lambda name, *others: (names.append(name), real(name, *others)))
    yield names
    assert names


def same(one: torch.Tensor, other: torch.Tensor) -> None:
    torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)
