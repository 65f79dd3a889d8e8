"""How kernels are compiled, and where the compiled code is kept.

A kernel is written twice over: an `item` function does the work for one item (one polygon, one set of rows), on arrays
that it is given, without allocating any; a `launcher` allocates, loops over the items of a batch, and is what torch
code calls. Items are plain Python functions until a launcher is compiled, so the same source can be called from another
launcher, of another machine.

Compiled code is kept in a folder whose name is a fingerprint of the kernels' sources: an edit anywhere in this room, or
in the tolerances, never meets code that was compiled before it. So kernels take tolerances and enums as globals.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
import torch
from numba import njit
from numba.extending import register_jitable
from torch import Tensor

_OPTIONS: dict[str, Any] = {"error_model": "numpy"}  # a division by zero is infinite or NaN, as in numpy


def item(function: Callable) -> Any:
    """A function of one item: compiled into every launcher that calls it."""
    return register_jitable(**_OPTIONS, _nrt=False)(function)


def item_of_ordered(function: Callable) -> Any:
    """An `item` whose minima and maxima are of finite numbers, in any order: these compile to vector instructions."""
    return register_jitable(**_OPTIONS, fastmath={"nnan", "nsz"})(function)


def launcher(function: Callable) -> Any:
    """A loop over the items of a batch, compiled on first use and kept in `folder()`."""
    before = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    kept = _is_writable(folder())
    numba.config.CACHE_DIR = str(folder()) if kept else before  # type: ignore[attr-defined]
    try:
        return njit(cache=kept, nogil=True, **_OPTIONS)(function)
    finally:
        numba.config.CACHE_DIR = before  # type: ignore[attr-defined]


@cache
def folder() -> Path:
    """Where the compiled code of these sources is kept: below NUMBA_CACHE_DIR or the user's cache folder."""
    package = Path(__file__).parent.parent
    sources = [*sorted((package / "kernels").glob("*.py")), package / "tolerances.py", package / "outcome.py"]
    fingerprint = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:16]
    caches = os.environ.get("NUMBA_CACHE_DIR") or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(caches) / "torchfsid" / fingerprint


@cache
def _is_writable(path: Path) -> bool:
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return True
    except OSError:
        return False


# Below here: to be removed when the last module stops asking.


def installed() -> bool:
    return True


def use_kernel(compiled: bool | None, *tensors: Tensor) -> bool:
    """Shall a function of these tensors run compiled? `compiled` is the caller's wish; None: wherever it can.

    Raises:
        InputError: it must, but a tensor needs a gradient or is not on the CPU.
    """
    from torchfsid.errors import InputError

    if compiled is False:
        return False
    obstacle = None
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        obstacle = "gradients are required"
    elif not all(tensor.is_cpu for tensor in tensors):
        obstacle = "tensors are not on the CPU"
    if compiled and obstacle is not None:
        raise InputError("compiled", "False or None", f"True, but {obstacle}")
    return obstacle is None
