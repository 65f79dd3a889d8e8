"""What the tests on the simulator share: the same on the CPU and on the device that the simulator stands for.

The simulator runs the kernels' Python source, and the other side is the same source compiled for the CPU. So the
numbers are the same to the last bit, but for libm's functions of angles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from torchfsid import device

SIZES = [1, 7, 65]
"""Batches of one item, of a part of a block of threads, and of one item more than a block."""

WAITING = ("_local_scalar_dense", "nonzero", "equal", "is_nonzero", "masked_select", "unique_dim", "_unique2")
"""Operations whose result or its shape the host has to know, besides indexing by masks."""


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


class Waits(TorchDispatchMode):
    """Notes the operations for which the host would wait until a device has reached them.

    Attributes:
        for_ops: their names.
    """

    def __init__(self) -> None:
        super().__init__()
        self.for_ops: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        indexed = name in ("index", "index_put", "index_put_", "_index_put_impl_")
        masked = indexed and any(i is not None and i.dtype == torch.bool for i in args[1])
        if masked or name in WAITING:
            self.for_ops.append(name)
        return func(*args, **kwargs or {})
