"""Counts of what the host would wait for if tensors were on a device, by the operations of torch on a CPU."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

PACKAGE = str(Path(__file__).parents[1] / "torchfsid")

DOWN = {"_local_scalar_dense", "nonzero", "masked_select", "equal", "_unique2", "unique_dim", "unique_consecutive"}
"""Operations whose result the host waits for. So it does for the length of a result of a mask."""

UP = {"lift_fresh"}
"""Operations that copy numbers of the host: `torch.tensor` and its like."""

NO_LAUNCH = {"detach", "empty", "empty_like", "scalar_tensor"}
"""Operations that run nothing on a device, beside views. The scalar of `torch.where` stays on the CPU."""

AS_NUMBERS = {torch.Tensor.numpy, torch.Tensor.tolist, torch.Tensor.__array__}
"""Methods that give numbers to the host, which call no operation of a tensor on a CPU."""


ADDRESSES = {"_array"}
"""Functions of `device` in which arrays stand for addresses, in numba's simulator."""


class RoundTrips(TorchDispatchMode):
    """The number of operations, and where in the package they would make a device and the host wait.

    Attributes:
        operations: the number of launches on a device, kernels not counted.
        waits: for each (file, line, operation), how often.
    """

    def __init__(self) -> None:
        super().__init__()
        self.operations, self.waits = 0, Counter()
        self._functions = _Functions(self._wait)

    def __enter__(self) -> RoundTrips:
        self._functions.__enter__()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._functions.__exit__(*error)

    def __torch_dispatch__(self, operation: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        name = operation.__name__.split(".")[0]
        self.operations += not (operation.is_view or name in NO_LAUNCH)
        if name in DOWN | UP or (name.startswith("index") and any(map(_is_mask, args[1:2]))):
            self._wait(name)
        return operation(*args, **(kwargs or {}))

    def _wait(self, name: str) -> None:
        frames = [frame for frame in traceback.extract_stack() if frame.filename.startswith(PACKAGE)]
        if frames and frames[-1].name not in ADDRESSES:
            self.waits[Path(frames[-1].filename).name, frames[-1].lineno, name] += 1


class _Functions(TorchFunctionMode):
    def __init__(self, wait: Callable[[str], None]) -> None:
        super().__init__()
        self._wait = wait

    def __torch_function__(self, function: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        if function in AS_NUMBERS:
            self._wait(function.__name__)
        return function(*args, **(kwargs or {}))


def _is_mask(index: Any) -> bool:
    """Is a tensor indexed by a mask?"""
    indices = index if isinstance(index, list | tuple) else [index]
    return any(isinstance(part, Tensor) and part.dtype == torch.bool for part in indices)
