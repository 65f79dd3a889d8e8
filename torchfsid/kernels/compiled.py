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
from numba import njit
from numba.extending import register_jitable

_OPTIONS: dict[str, Any] = {"error_model": "numpy"}  # a division by zero is infinite or NaN, as in numpy


def item(function: Callable) -> Any:
    """A function of one item: compiled into every launcher that calls it.

    Without reference counts (`_nrt`), so it cannot allocate; counting those of slices took half of the time.
    """
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
