"""Tensors on a GPU and the kernels there: when these can be used, and the way of tensors to them, which copies nothing.

Kernels on a device need the extra `cuda`. With NUMBA_ENABLE_CUDASIM=1 they run in numba's simulator, slowly, and
tensors on the CPU stand for those on a device: that is for tests.

The first index of a batch counts items. A kernel's neighbouring threads handle neighbouring items, so tensors for
kernels are laid out with neighbouring items side by side in memory (stride 1), and so are the results: as arrays are in
Fortran.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from importlib import import_module
from math import prod
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfsid.kernels.compiled import SIMULATED

INSTALL = "pip install 'torchfsid[cuda]', with numba-cuda[cu12] or [cu13] where there is no CUDA toolkit"

KINDS = {np.float64: torch.float64, np.int64: torch.int64, np.int32: torch.int32, np.bool_: torch.bool}

SCRATCH = 2**30
"""Largest size of the scratch of all threads of a kernel [bytes]."""


@cache
def missing() -> str:
    """Why there are no kernels for the device. It is empty if there are."""
    try:
        kernels = import_module("torchfsid.kernels.cuda.launch")
        kernels.probe()
    except (ImportError, AttributeError, RuntimeError) as error:
        return f"numba cannot use the device ({error}; {INSTALL})"
    return "" if kernels.cuda.is_available() else f"numba finds no driver or no compiler for the device ({INSTALL})"


def on_host(*tensors: Tensor) -> bool:
    """Are all tensors on the CPU, so that looking at their numbers waits for no device?"""
    return not SIMULATED and all(tensor.is_cpu for tensor in tensors)


def all_seen(mask: Tensor) -> bool:
    """Is all of a mask true, as far as nothing has to wait for it? On a device the answer is False.

    So it may choose a shorter way to the same result, and nothing else.
    """
    return on_host(mask) and bool(mask.all())


def any_of(*masks: Tensor) -> list[bool]:
    """For each mask, whether any of it is true. A device is waited for once."""
    return [bool(mask.any()) for mask in masks] if on_host(*masks) else torch.stack([m.any() for m in masks]).tolist()


def constant(values: tuple, where: torch.device, dtype: torch.dtype = torch.float64) -> Tensor:
    """Numbers of the host as a tensor on a device, to which they are copied once. It must not be changed."""
    if torch._C._are_functorch_transforms_active():  # tensors that are made there must not outlive the transform
        return torch.tensor(values, dtype=dtype, device=where)
    return _kept(values, where, dtype)


@lru_cache(maxsize=256)
def _kept(values: tuple, where: torch.device, dtype: torch.dtype) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=where)


def has_kernels(*tensors: Tensor) -> bool:
    """Are all tensors on a device that has kernels?"""
    return (SIMULATED or all(tensor.is_cuda for tensor in tensors)) and not missing()


def launch(kernel: str, tensors: Sequence[Sequence[Tensor]], values: Sequence[Any], results: Any) -> None:
    """Run a function of `kernels.cuda`, called with the tensors, the values and the results, which it fills.

    Args:
        kernel: the module and the name of the function, as in `planar.clip`.
        tensors: what it reads.
        values: what it takes as numbers.
        results: what it fills.
    """
    module, name = kernel.split(".")
    function: Callable = getattr(import_module(f"torchfsid.kernels.cuda.{module}"), name)
    given = [tuple(_array(side_by_side(tensor)) for tensor in part) for part in tensors]
    filled = [tuple(map(_array, part)) for part in results]
    if SIMULATED:
        function(given, values, filled)
        return
    where = results[0][0].device
    with torch.cuda.device(where):
        function(given, values, filled, torch.cuda.current_stream(where).cuda_stream)


def empty(shape: Sequence[int], like: Tensor, dtype: torch.dtype = torch.float64) -> Tensor:
    """A tensor on the device of another, with neighbouring items side by side. It is not filled."""
    return _reversed(torch.empty(tuple(shape)[::-1], dtype=dtype, device=like.device))


def scratch(places: Sequence[tuple[Sequence[int], type]], items: int, like: Tensor) -> list[Tensor]:
    """Tensors for the scratch of threads, with an entry of this shape and type of numpy for each thread, not filled.

    There is a thread for each item, or as many as fit in `SCRATCH`. These handle several items one after the other.
    """
    each = sum(prod(shape) * np.dtype(kind).itemsize for shape, kind in places)
    threads = min(items, max(SCRATCH // each, 1))
    return [empty((threads, *shape), like, KINDS[kind]) for shape, kind in places]


def side_by_side(tensor: Tensor) -> Tensor:
    """The tensor as kernels take it. It is copied on the device unless neighbours are adjacent."""
    tensor = tensor.detach() if tensor.requires_grad else tensor
    flipped = _reversed(tensor)
    return tensor if flipped.is_contiguous() else _reversed(flipped.contiguous())


def _reversed(tensor: Tensor) -> Tensor:
    """The tensor with its dimensions in reverse order."""
    return tensor if tensor.ndim < 2 else tensor.permute(*range(tensor.ndim)[::-1])


def _array(tensor: Tensor) -> Any:
    return tensor.numpy() if SIMULATED else tensor
