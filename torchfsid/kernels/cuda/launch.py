"""How kernels are launched on a GPU: one thread an item.

Arguments and results are arrays with `__cuda_array_interface__`, such as torch's tensors on the device; with numba's
simulator (NUMBA_ENABLE_CUDASIM=1) numpy's arrays. Results are written to arrays that the caller has allocated. Threads
of neighbouring items read and write at the same time, so that arrays whose first index has stride 1 are the fastest.
Kernels that take addresses in the place of arrays (`arrays`) are launched some twenty times faster.
"""

from __future__ import annotations

import importlib
import importlib.util
import warnings
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numba import cuda

from torchfsid.kernels.compiled import SIMULATED

THREADS = 64
"""Threads in a block."""

Arrays = Sequence[Any]


def probe() -> None:
    """Import what a first kernel needs.

    Raises:
        AttributeError: numba-cuda does not fit numpy.
    """
    if importlib.util.find_spec("numba.cuda.np") is None:  # numba's own CUDA target, without numba-cuda, has none
        return
    dropped = "row_stack"  # numpy 2.5 has no such alias of `vstack`; numba-cuda, up to 0.30.4, imports it
    lent = not hasattr(np, dropped)
    if lent:
        setattr(np, dropped, np.vstack)
    try:
        importlib.import_module("numba.cuda.np.arrayobj")
    finally:
        if lent:
            delattr(np, dropped)


def launch(
    kernel: Any, count: int, given: Sequence[Arrays], values: tuple, results: Sequence[Arrays], stream: int
) -> None:
    """Run a kernel for `count` items on the stream with this address, or on the default stream if it is 0."""
    _start(kernel, count, [tuple(map(_array, part)) for part in (*given, *results)], values, stream)


def launch_by_address(
    kernel: Any, count: int, given: Sequence[Arrays], values: tuple, results: Sequence[Arrays], stream: int
) -> None:
    """`launch` a kernel that takes addresses of tensors, whose first index has stride 1, as in Fortran."""
    _start(kernel, count, [tuple(map(_address, part)) for part in (*given, *results)], values, stream)


def _start(kernel: Any, count: int, parts: Sequence[tuple], values: tuple, stream: int) -> None:
    if count > 0:
        _launcher(kernel, (count + THREADS - 1) // THREADS, stream)(*parts, values)


@lru_cache(maxsize=256)
def _launcher(kernel: Any, blocks: int, stream: int) -> Any:
    queue = cuda.external_stream(stream) if stream else 0
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Grid size")  # few items leave most of a device idle: so be it
        return kernel[blocks, THREADS, queue]


def _array(array: Any) -> Any:
    return array if SIMULATED else cuda.as_cuda_array(array, sync=False)


def _address(array: Any) -> Any:
    return array if SIMULATED else array.data_ptr()
