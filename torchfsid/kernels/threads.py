"""Threads that share the items of a large batch. Results do not depend on their number.

Kernels and torch let go of Python's lock while they compute, so plain threads use all cores.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from typing import TypeVar

import numpy as np

from torchfsid.errors import InputError

ITEMS = 4096
"""Fewest items of a kernel that are worth a thread of their own: some milliseconds of work."""

T = TypeVar("T")


def _available() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_number = _available()
_pool = ThreadPoolExecutor(256, thread_name_prefix="torchfsid")
_here = threading.local()


def set_num_threads(number: int) -> None:
    """Set how many threads share large batches. The default is the number of cores that the process may use.

    Raises:
        InputError: the number is less than 1.
    """
    global _number
    if number < 1:
        raise InputError("number", "1 thread or more", number)
    _number = number


def get_num_threads() -> int:
    """How many threads share large batches."""
    return _number


def at_once(tasks: Sequence[Callable[[], T]]) -> list[T]:
    """The results of the tasks, each run in a thread of its own; inside such a task, one after the other.

    If some raise an exception, the first of these is raised after all have ended.
    """
    if len(tasks) < 2 or getattr(_here, "is_worker", False):
        return [task() for task in tasks]
    running = [_pool.submit(_as_worker, task) for task in tasks]
    wait(running)
    return [task.result() for task in running]


def over_items(kernel: Callable[..., None], *of_items: np.ndarray) -> None:
    """Run a kernel that fills arrays, `kernel(*of_items)`, on parts of a large batch at once."""
    count = len(of_items[0])
    parts = max(1, min(_number, count // ITEMS))
    limits = [count * part // parts for part in range(parts + 1)]
    spans = map(slice, limits[:-1], limits[1:])
    at_once([partial(kernel, *(array[span] for array in of_items)) for span in spans])


def _as_worker(task: Callable[[], T]) -> T:
    _here.is_worker = True
    return task()


def _new_pool() -> None:
    global _pool
    _pool = ThreadPoolExecutor(256, thread_name_prefix="torchfsid")


if hasattr(os, "register_at_fork"):  # threads do not survive a fork
    os.register_at_fork(after_in_child=_new_pool)
