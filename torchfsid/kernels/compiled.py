"""How kernels are compiled, and where the compiled code is kept.

A kernel has two kinds of functions. An `item` function does the work for one item (one polygon, one set of rows). It
works on arrays that it is given and allocates none. A `launcher` allocates arrays and loops over the items of a batch.
Torch code calls launchers only. Items stay plain Python functions until a launcher is compiled, so that launchers for
another device can use the same source.

The name of the folder with compiled code is a fingerprint of the kernels' sources and of the tolerances. After an edit
of either, old compiled code is never used. So kernels can take tolerances and enums as globals.
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
from numba import njit
from numba.extending import register_jitable

SIMULATED = bool(numba.config.ENABLE_CUDASIM)  # type: ignore[attr-defined]
"""Does numba's simulator stand for a GPU (NUMBA_ENABLE_CUDASIM=1)?"""

_OPTIONS: dict[str, Any] = {"error_model": "numpy"}  # a division by zero is infinite or NaN, as in numpy


def item(function: Callable) -> Any:
    """Mark a function of one item, which is compiled into every launcher that calls it.

    It keeps no reference counts (`_nrt`), since those of slices took half of the time. So it cannot allocate arrays.
    """
    return register_jitable(**_OPTIONS, _nrt=False)(function)


def item_in_place(function: Callable) -> Any:
    """Mark an `item` that is compiled in place of its calls.

    A call passes every array as some ten numbers. With a dozen arrays this takes longer than a short item itself.
    """
    return register_jitable(**_OPTIONS, _nrt=False, forceinline=True)(function)


def item_of_ordered(function: Callable) -> Any:
    """Mark an `item` whose minima and maxima are those of finite numbers. They compile to vector instructions."""
    return register_jitable(**_OPTIONS, fastmath={"nnan", "nsz"})(function)


def launcher(function: Callable) -> Any:
    """Mark a loop over the items of a batch. It is compiled on first use and kept in `folder()`."""
    before = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    kept = _is_writable(folder())
    numba.config.CACHE_DIR = str(folder()) if kept else before  # type: ignore[attr-defined]
    try:
        return njit(cache=kept, nogil=True, **_OPTIONS)(function)
    finally:
        numba.config.CACHE_DIR = before  # type: ignore[attr-defined]


@cache
def folder() -> Path:
    """The folder with the compiled code of these sources, below NUMBA_CACHE_DIR or the user's cache folder."""
    package = Path(__file__).parent.parent
    sources = [*sorted((package / "kernels").rglob("*.py")), package / "tolerances.py", package / "outcome.py"]
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
